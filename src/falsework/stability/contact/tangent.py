"""Tangent stiffness of a state at its spring forces."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.law import gauge, gauge_gradient
from falsework.stability.cpu.layout import FAST
from falsework.stability.cpu.panels import add_block, clear_panels
from falsework.utils.kernels import njit


@njit(inline="always", fastmath=True)
def _multiply(left, e, right, q, out, t):
    """`out[t] = left[e] right[q]`."""
    for r in range(6):
        x0, x1, x2 = left[e, r, 0], left[e, r, 1], left[e, r, 2]
        x3, x4, x5 = left[e, r, 3], left[e, r, 4], left[e, r, 5]
        for c in range(6):
            out[t, r, c] = (
                x0 * right[q, 0, c]
                + x1 * right[q, 1, c]
                + x2 * right[q, 2, c]
                + x3 * right[q, 3, c]
                + x4 * right[q, 4, c]
                + x5 * right[q, 5, c]
            )


@njit(fastmath=FAST, cache=True)
def assemble_tangent(structure, contact_structure, work, contact, pairs, shift):
    """Write the tangent stiffness at the spring forces `contact.trial`, plus `shift` times the identity.

    A contact that just touches counts as closed and sticking, so the first step from rest is that of a bonded one.
    """
    basis, start, cone, friction = work.basis, work.start, structure.cone, work.friction
    kn, kt, trial, pull, stick = contact.normal, contact.tangential, contact.trial, contact.pull, contact.stick
    turned_a, turned_b = contact_structure.turned_a, contact_structure.turned_b
    ta, tb, supernode = structure.transfer_a, structure.transfer_b, structure.elimination.supernode
    pair, slot_a, slot_b, panels = work.pair, work.slot_a, work.slot_b, work.panels
    upper, lower, diagonal, block, width = panels.upper, panels.lower, panels.diagonal, panels.block, panels.width
    clear_panels(panels, shift, pairs < 0)
    local, left, right = np.empty((2, 6, 6)), np.empty((2, 6, 6)), np.empty((1, 6, 6))
    for p in range(pairs):
        for i in range(6):
            for k in range(6):
                local[0, i, k] = 0.0
        closed, slides = False, False
        for j in range(start[p], start[p + 1]):
            n, x, y = trial[j, 0] + pull[j], trial[j, 1], trial[j, 2]
            if n < 0.0 and stick[j] <= 0.0:
                continue
            closed = True
            k00 = kn[j] if n >= 0.0 else 0.0
            k10, k20, k11, k12, k21, k22 = 0.0, 0.0, kt[j], 0.0, 0.0, kt[j]
            size, mu = gauge(cone, x, y), friction[j]
            limit = mu * max(n, 0.0) + stick[j]
            if size > limit:
                slides = True
                ex, ey = x / size, y / size
                gx, gy = gauge_gradient(cone, x, y)
                k10, k20 = mu * k00 * ex, mu * k00 * ey
                share = kt[j] * limit / size
                k11, k12 = share * (1.0 - ex * gx), -share * ex * gy
                k21, k22 = -share * ey * gx, share * (1.0 - ey * gy)
            for i in range(6):
                b0, b1, b2 = basis[j, i, 0], basis[j, i, 1], basis[j, i, 2]
                h0 = b0 * k00 + b1 * k10 + b2 * k20
                h1 = b1 * k11 + b2 * k21
                h2 = b1 * k12 + b2 * k22
                for k in range(6):
                    local[0, i, k] += h0 * basis[j, k, 0] + h1 * basis[j, k, 1] + h2 * basis[j, k, 2]
        if not closed:
            continue
        q, a, b = pair[p], slot_a[p], slot_b[p]
        if a >= 0:
            _multiply(ta, q, local, 0, left, 0)
            _multiply(left, 0, turned_a, q, right, 0)
            add_block(right, 0, upper, diagonal[a], width[supernode[a]])
        if b >= 0:
            _multiply(tb, q, local, 0, left, 1)
            _multiply(left, 1, turned_b, q, right, 0)
            add_block(right, 0, upper, diagonal[b], width[supernode[b]])
        if a < 0 or b < 0:
            continue
        at, wide = block[q], width[supernode[min(a, b)]]
        if a < b:
            _multiply(left, 0, turned_b, q, right, 0)
        else:
            _multiply(left, 1, turned_a, q, right, 0)
        add_block(right, 0, upper, at, wide)
        if slides:  # the blocks on both sides of the diagonal differ
            for r in range(6):
                for c in range(6):
                    local[1, c, r] = local[0, r, c]
            if a < b:
                _multiply(ta, q, local, 1, left, 0)
                _multiply(left, 0, turned_b, q, right, 0)
            else:
                _multiply(tb, q, local, 1, left, 1)
                _multiply(left, 1, turned_a, q, right, 0)
        add_block(right, 0, lower, at, wide)

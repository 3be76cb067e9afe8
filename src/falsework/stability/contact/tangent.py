"""Tangent stiffness of a state at its spring forces."""

from __future__ import annotations

import numpy as np

from falsework.stability.contact.hold_kernel import LOCKED
from falsework.stability.contact.law import gauge, gauge_gradient
from falsework.stability.cpu.cones import NEGLIGIBLE
from falsework.stability.cpu.layout import FAST
from falsework.stability.cpu.panels import clear_panels
from falsework.stability.cpu.products import congruence, square_product
from falsework.utils.kernels import njit

_add_product, _set_product = square_product(), square_product(adds=False)


@njit(fastmath=FAST)
def _add_images(turned, q, images, panel, place, width):
    """Add a transfer matrix times the six rows `images` to a block of a panel."""
    _add_product(turned, 48 * q, 8, images, 0, 8, panel, place, width)


@njit(fastmath=FAST)
def _apply(matrix, turned, q, images):
    """Set `images` to the transpose of a matrix times that of a transfer matrix."""
    _set_product(matrix, 0, 8, turned, 48 * q, 8, images, 0, 8)


@njit(fastmath=FAST, cache=True)
def assemble_tangent(law, contact, pairs, shift):
    """Write the tangent stiffness at the spring forces `contact.trial`, plus `shift` times the identity.

    A contact that just touches counts as closed and sticking, so the first step from rest is that of a bonded one.
    """
    structure, work = law.structure, contact.work
    start, cone, friction, first = work.start, structure.cone, work.friction, structure.pair_start
    kn, kt, trial, pull, stick = contact.normal, contact.tangential, contact.trial, contact.pull, contact.stick
    turned_a, turned_b, rows = law.turned_a, law.turned_b, law.rows
    supernode, tangent = structure.elimination.supernode, contact.tangent
    pair, slot_a, slot_b, panels = work.pair, work.slot_a, work.slot_b, work.panels
    upper, lower, diagonal, block, width = panels.upper, panels.lower, panels.diagonal, panels.block, panels.width
    clear_panels(panels, shift, pairs < 0)
    grip, free = contact.grip, work.free
    for j in range(len(free)):
        if free[j] and grip[j] > 0.0:
            for r in range(6):
                upper[diagonal[j] + r * (width[supernode[j]] + 1)] += grip[j]
            if contact.across[j] != 0.0:
                # Relative to the median contact; the step across the line is dropped.
                more = (1.0 / NEGLIGIBLE if contact.across[j] == LOCKED else contact.across[j]) - grip[j]
                for r in range(3):
                    at = diagonal[j] + r * width[supernode[j]]
                    for c in range(3):
                        upper[at + c] -= more * contact.line[j, r] * contact.line[j, c]
                    upper[at + r] += more
                    upper[diagonal[j] + (3 + r) * (width[supernode[j]] + 1)] += more
    turned, local, images_a, images_b = np.empty((6, 8)), np.zeros((6, 8)), np.empty((6, 8)), np.empty((6, 8))
    for p in range(pairs):
        closed, slides, begin = False, False, start[p]
        for j in range(begin, start[p + 1]):
            n, x, y = trial[j, 0] + pull[j], trial[j, 1], trial[j, 2]
            k00, k10, k20, k11, k12, k21, k22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            if n >= 0.0 or stick[j] > 0.0:
                closed = True
                k00, k11, k22 = kn[j] if n >= 0.0 else 0.0, kt[j], kt[j]
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
            m = j - begin
            tangent[m, 0], tangent[m, 1], tangent[m, 2] = k00, 0.0, 0.0
            tangent[m, 3], tangent[m, 4], tangent[m, 5] = k10, k11, k12
            tangent[m, 6], tangent[m, 7], tangent[m, 8] = k20, k21, k22
        if not closed:
            continue
        q, a, b = pair[p], slot_a[p], slot_b[p]
        congruence(rows, first[q], tangent, start[p + 1] - begin, turned)
        if a >= 0:
            _apply(turned, turned_a, q, images_a)
            _add_images(turned_a, q, images_a, upper, diagonal[a], width[supernode[a]])
        if b >= 0:
            _apply(turned, turned_b, q, images_b)
            _add_images(turned_b, q, images_b, upper, diagonal[b], width[supernode[b]])
        if a < 0 or b < 0:
            continue
        at, wide = block[q], width[supernode[min(a, b)]]
        if a < b:
            _add_images(turned_a, q, images_b, upper, at, wide)
        else:
            _add_images(turned_b, q, images_a, upper, at, wide)
        if slides:  # the blocks on both sides of the diagonal differ
            for r in range(6):
                for c in range(6):
                    local[c, r] = turned[r, c]
            if a < b:
                _apply(local, turned_b, q, images_b)
            else:
                _apply(local, turned_a, q, images_a)
        if a < b:
            _add_images(turned_a, q, images_b, lower, at, wide)
        else:
            _add_images(turned_b, q, images_a, lower, at, wide)

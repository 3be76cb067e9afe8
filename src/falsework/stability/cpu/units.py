"""Units of force of contact pairs, by which ADMM changes large forces more than small ones.

An iteration moves all forces, in their units, towards balance by the same measure. Where known forces are a start, most
of those that have to grow or shrink are large already: they lie along the ways on which weights reach the supports.
With larger units there, fewer iterations are needed. One unit for each pair keeps the cones, and the pattern of the
matrix.
"""

from __future__ import annotations

import math

from falsework.stability.cpu.layout import FAST, load_forces
from falsework.utils.kernels import njit

_LEAST = 0.4
"""Least unit, so that a pair without force can take some up."""


@njit(fastmath=FAST, cache=True)
def scale_units(work, pairs):
    """Set the unit of each pair to the fourth root of its known force in `work.u`, and express the scratch in units.

    The mean of the units of pairs with a force is 1.
    """
    basis, scale, pull, stick = work.basis, work.force_scale, work.pull, work.stick
    start, unit, u = work.start, work.unit, work.u
    total, count = 0.0, 0
    for p in range(pairs):
        force = 0.0
        for j in range(start[p], start[p + 1]):
            force += max(u[j, 0], 0.0)
        unit[p] = math.sqrt(math.sqrt(force / max(start[p + 1] - start[p], 1)))
        total += unit[p]
        count += unit[p] > 0.0
    for p in range(pairs):
        unit[p] = max(unit[p] * count / total, _LEAST) if count > 0 else 1.0
        share = 1.0 / unit[p]
        for j in range(start[p], start[p + 1]):
            for i in range(6):
                for k in range(3):
                    basis[j, i, k] *= unit[p]
            scale[j] *= unit[p]
            pull[j] *= share
            stick[j] *= share
            for k in range(3):
                u[j, k] *= share


@njit(cache=True)
def start_forces(structure, work, pairs, forces, warm, scaled):
    """Write the start of ADMM to `work.u`: contact forces in N where `warm`, in their units if `scaled`, else none."""
    if warm:
        load_forces(structure, work, pairs, forces, work.u)
        if scaled:
            scale_units(work, pairs)
        return
    for j in range(work.start[pairs]):
        work.u[j, 0], work.u[j, 1], work.u[j, 2] = work.pull[j], 0.0, 0.0

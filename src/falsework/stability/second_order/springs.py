"""Contact points as springs at a displacement, for the certificate checker: without any code of the solvers."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.criterion import StabilityCriterion
from falsework.stability.stiffness import MOVEMENT, SETTLEMENT, normal_stiffness, spring_stiffness, structure_size
from falsework.stability.strength import TEARS, Strength, strength_of

Array = NDArray[np.float64]

ROUNDING = 1e-9
"""Largest distance of a force from its cone, as a share of the force and of the structure's weight; such a force
is moved into the cone before the residual is computed."""
CLOSES = 1e-12
"""Least share of a motion by which it closes an open point, above rounding: stiff contacts bear light parts by far less
than `ROUNDING` of what these move."""

_size = lru_cache(maxsize=4)(structure_size)


class Springs(NamedTuple):
    """Contact points as springs at a displacement: how they answer small further motions; zero where none acts."""

    forces: Array
    """Contact forces `(n, t1, t2)` in N, shape (batch, points, 3)."""
    normal: Array
    """Normal stiffness of each point where it is closed, for small further motions, N/m, shape (batch, points).

    At least that at which the point settles by `SETTLEMENT` of the structure: how much small bearings settle must not
    decide whether parts on them tip.
    """
    tangential: Array
    """Tangential stiffness of each point where it sticks, N/m, shape (batch, points)."""
    closed: NDArray[np.bool_]
    """Whether each point bears more than the tolerance times the weight of the lighter part, shape (batch, points)."""
    open: NDArray[np.bool_]
    """Whether it bears none but would if a motion closed it, shape (batch, points)."""
    gap: Array
    """How far it is open, m, shape (batch, points)."""
    pull: Array
    """Unit vector along the force of friction at its limit, zero where the point sticks, shape (batch, points, 2)."""
    across: Array
    """Share of the tangential stiffness across `pull`: 1 where the point sticks, shape (batch, points)."""

    @property
    def slips(self) -> NDArray[np.bool_]:
        """Whether friction is at its limit, shape (batch, points, 1)."""
        return (self.across < 1.0)[..., None]


def springs_of_displacement(
    assembly: Assembly, states: States, displacement: Array, claim: StabilityCriterion
) -> Springs:
    """Return the contact forces that the law gives at a displacement, and the stiffness of the contact points there.

    Arguments as for `residual_of_displacement`.
    """
    relative = geometry_of(assembly.contacts, assembly.mass).relative(displacement)
    stiffness = spring_stiffness(assembly, claim.gravity, claim.stiffness_ratio)
    return springs_at(assembly, states, -stiffness * relative, claim)


def springs_at(
    assembly: Assembly, states: States, springs: Array, claim: StabilityCriterion, strength: Strength | None = None
) -> Springs:
    """Return the contact points of states whose spring forces are known, with or without history.

    Args:
        states: shape (batch, parts).
        springs: spring forces `(n, t1, t2)` in N, negative normal ones where points are open, shape (batch, points, 3).
        claim: cone, gravity, tolerance, stiffness ratio and reserve.
        strength: of the contact points, where joints have torn or not set yet.
    """
    geometry, stiffness = geometry_of(assembly.contacts, assembly.mass), normal_stiffness(assembly, claim.gravity)
    strength = strength or strength_of(assembly, claim.gravity, claim.reserve)
    acts = geometry.acts(states) & ~strength.idle
    at = np.flatnonzero(acts.any(axis=0))
    acts, springs, stiffness, strength = acts[:, at], springs[:, at], stiffness[at], strength.take(at)
    normal, tangent = springs[..., 0], springs[..., 1:]
    whole = ~strength.tears | (normal >= -TEARS * strength.pull)
    forces, outside = into_cone(springs, strength, claim.cone)
    forces = np.where((acts & whole)[:, :, None], forces, 0.0)
    lighter = np.minimum(assembly.mass.mass[geometry.part_a[at]], assembly.mass.mass[geometry.part_b[at]])
    closed = acts & whole & (normal + strength.pull > claim.tolerance * claim.gravity * lighter)
    slips = closed & (outside >= -ROUNDING * np.linalg.norm(springs, axis=2))
    size, trial = np.linalg.norm(forces[..., 1:], axis=2), np.linalg.norm(tangent, axis=2)
    pull = np.divide(
        forces[..., 1:], size[..., None], out=np.zeros_like(tangent), where=(slips & (size > 0))[..., None]
    )
    share = np.divide(size, trial, out=np.zeros_like(size), where=trial > 0)
    across = np.where(slips, np.minimum(share, 1.0 - ROUNDING), 1.0)
    firm = np.maximum(stiffness, forces[..., 0] / (SETTLEMENT * _size(assembly)))
    gap = -normal / stiffness
    of_acting = Springs(forces, firm, claim.stiffness_ratio * firm, closed, acts & ~closed, gap, pull, across)
    return Springs(*(_spread(values, at, len(geometry.part_a)) for values in of_acting))


def _spread(values: NDArray, at: NDArray[np.int64], points: int) -> NDArray:
    """Return values at some contact points, shape (batch, some, ...), as those of all, zero at the others."""
    every = np.zeros((len(values), points, *values.shape[2:]), values.dtype)
    every[:, at] = values
    return every


def closing_points(assembly: Assembly, springs: Springs, motion: Array, relative: Array) -> NDArray[np.bool_]:
    """Return the open points that a motion closes before a part moves by more than the displacement limit.

    Args:
        springs: at rest.
        motion: shape (batch, parts, 6).
        relative: the motion at every contact point in its frame, shape (batch, points, 3).
    """
    turn = np.linalg.norm(motion[..., 3:], axis=2) * assembly.mass.gyration
    moved = np.maximum(np.linalg.norm(motion[..., :3], axis=2), turn).max(axis=1, initial=0.0)
    limit = MOVEMENT * _size(assembly)
    return (
        springs.open
        & (relative[..., 0] < -CLOSES * moved[:, None])
        & (springs.gap * moved[:, None] <= -relative[..., 0] * limit)
    )


def into_cone(forces: Array, strength: Strength, cone: str) -> tuple[Array, Array]:
    """Return forces with tangents shrunk until they are admissible, and how far outside the cone they were, in N.

    Those of idle points are zero and count as inside.

    Shapes (batch, points, 3) and (batch, points).
    """
    normal, tangent = forces[..., 0], forces[..., 1:]
    radius = strength.friction * np.maximum(normal + strength.pull, 0.0) + strength.stick
    if cone == "quadratic":
        reach, limit = np.hypot(tangent[..., 0], tangent[..., 1]), radius
    else:
        # The octagon has its corners at multiples of 45 degrees, so the normals of its sides are half way between; the
        # nearest normal is 22.5 degrees from the axis along which the tangent is larger.
        x, y = np.abs(tangent[..., 0]), np.abs(tangent[..., 1])
        reach = np.cos(np.pi / 8) * np.maximum(x, y) + np.sin(np.pi / 8) * np.minimum(x, y)
        limit = np.cos(np.pi / 8) * radius
    inside = forces.copy()
    inside[..., 0] = np.maximum(normal, -strength.pull)
    inside[..., 1:] *= np.divide(limit, reach, out=np.ones_like(reach), where=reach > limit)[..., None]
    outside = np.maximum(reach - limit, -normal - strength.pull)
    if strength.idle.any():
        inside = np.where(strength.idle[..., None], 0.0, inside)
        outside = np.where(strength.idle, -np.inf, outside)
    return inside, outside

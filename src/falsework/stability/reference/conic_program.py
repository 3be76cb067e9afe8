"""Textbook conic programs of equilibrium, in a form that any conic solver takes.

They use nothing but the wrench maps of `Problem`: no scaling, factoring or projection of the fast solvers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from falsework.stability.certificate import StabilityCriterion
from falsework.stability.problem import Problem

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Program:
    """`min 1/2 x . (curvature * x) + cost . x` over rows `A x` that are bound in one of three ways.

    The first `equalities` rows say `A x = b`, the next `inequalities` rows `A x <= b`, and the rest come in
    threes that say that `b - A x` lies in the cone `s0 >= |(s1, s2)|`.
    """

    curvature: Array
    """Shape (variables,)."""
    cost: Array
    """Shape (variables,)."""
    rows: sp.csc_matrix
    """`A`, shape (rows, variables)."""
    bound: Array
    """`b`, shape (rows,)."""
    equalities: int
    inequalities: int
    read: Callable[[Array, Array], tuple[Array, Array]]
    """Turns solution and multipliers (of rows `A x <= b`, so not negative there) into contact forces of the
    active points in N, shape (active, 3), and a velocity of the free parts, shape (free, 6)."""

    @property
    def cones(self) -> int:
        """Number of second-order cones."""
        return (len(self.bound) - self.equalities - self.inequalities) // 3


def block_diagonal(blocks: Array) -> sp.csc_matrix:
    """Square blocks along a diagonal, shape (count, size, size) to (count size, count size), without their zeros."""
    count, size, _ = blocks.shape
    layout = (blocks, np.arange(count), np.arange(count + 1))
    matrix = sp.csc_matrix(sp.bsr_matrix(layout, shape=(count * size, count * size)))
    matrix.eliminate_zeros()
    return matrix


def least_squares(problem: Problem, free: Mask, active: Mask, claim: StabilityCriterion) -> Program:
    """`min 1/2 |y|^2` with `y = L^-1 (G f + g)` up to a factor, `f` in the cones (paper, equation 6).

    Args:
        problem: the structure.
        free: parts that can move, shape (parts,).
        active: contact points that act, shape (points,).
        claim: cone and force bound.
    """
    # Forces in shares of the weight and accelerations in shares of gravity keep the numbers near one, and make them
    # the same whatever the size of the structure.
    rows, columns = 6 * int(free.sum()), 3 * int(active.sum())
    units = _force_units(problem, columns // 3)
    lightest = (problem.momentum[free, 2, 2] / problem.measure[free, 0]).min()
    whiten = block_diagonal(problem.whitening[free] / lightest)
    wrenches = whiten @ wrench_matrix(problem, free, active) @ sp.diags(units)
    gravity = whiten @ problem.gravity_wrench[free].ravel()
    cone = _cone_rows(problem, columns // 3, claim.cone)
    cone_rows = cone.shape[0]  # type: ignore[index]
    linear = claim.cone == "octagon"

    def read(x: Array, _: Array) -> tuple[Array, Array]:
        return (units * x[:columns]).reshape(-1, 3), _normalised(whiten.T @ x[columns:])

    return Program(
        curvature=np.repeat([0.0, 1.0], [columns, rows]),
        cost=np.zeros(columns + rows),
        rows=_stack([[wrenches, -sp.eye(rows)], [cone, sp.csc_matrix((cone_rows, rows))]]),
        bound=np.concatenate([-gravity, np.zeros(cone_rows)]),
        equalities=rows,
        inequalities=cone_rows if linear else 0,
        read=read,
    )


def least_acceleration(problem: Problem, free: Mask, active: Mask, claim: StabilityCriterion) -> Program:
    """`min t` with `|D M^-1 (G f + g)| <= t`, `f` in the cones, sum of normals below the bound; `D` is `measure`.

    Its multipliers are the best virtual velocity there is: by duality they prove the very residual that its
    solution reaches. Arguments as for `least_squares`.
    """
    rows, columns = 6 * int(free.sum()), 3 * int(active.sum())
    units = _force_units(problem, columns // 3)
    whiten = block_diagonal(problem.whitening[free])
    measured = sp.csc_matrix(sp.diags(np.repeat(problem.measure[free], 3)) @ (whiten.T @ whiten))  # D M^-1
    accelerations = measured @ wrench_matrix(problem, free, active) @ sp.diags(units)
    gravity = measured @ problem.gravity_wrench[free].ravel()
    cone = _cone_rows(problem, columns // 3, claim.cone)
    cone_rows = cone.shape[0]  # type: ignore[index]
    linear = claim.cone == "octagon"
    normals = sp.csc_matrix((np.tile([1.0, 0.0, 0.0], columns // 3) * units / problem.weight)[None])
    one = sp.csc_matrix(np.ones((rows, 1)))

    def read(x: Array, multipliers: Array) -> tuple[Array, Array]:
        velocity = measured.T @ (multipliers[:rows] - multipliers[rows : 2 * rows])
        return (units * x[:columns]).reshape(-1, 3), _normalised(velocity)

    return Program(
        curvature=np.zeros(columns + 1),
        cost=np.append(np.zeros(columns), 1.0),
        rows=_stack(
            [
                [accelerations, -one],
                [-accelerations, -one],
                [normals, sp.csc_matrix((1, 1))],
                [cone, sp.csc_matrix((cone_rows, 1))],
            ]
        ),
        bound=np.concatenate([-gravity, gravity, [claim.force_bound], np.zeros(cone_rows)]),
        equalities=0,
        inequalities=2 * rows + 1 + (cone_rows if linear else 0),
        read=read,
    )


def wrench_matrix(problem: Problem, free: Mask, active: Mask) -> sp.csc_matrix:
    """Return wrenches on the free parts per force at the active points, shape (6 free, 3 active)."""
    slot = np.full(problem.parts, -1)
    slot[free] = np.arange(free.sum())
    points = np.flatnonzero(active)
    entries: list[tuple[Array, NDArray, NDArray]] = []
    for part, blocks in ((problem.part_a, problem.wrench_a), (problem.part_b, problem.wrench_b)):
        rows = slot[part[points]]
        on = rows >= 0
        block = blocks[points[on]]
        row = np.broadcast_to(6 * rows[on][:, None, None] + np.arange(6)[:, None], block.shape)
        column = np.broadcast_to(3 * np.flatnonzero(on)[:, None, None] + np.arange(3), block.shape)
        entries.append((block.ravel(), row.ravel(), column.ravel()))
    values, row, column = (np.concatenate(arrays) for arrays in zip(*entries, strict=True))
    return sp.csc_matrix((values, (row, column)), shape=(6 * int(free.sum()), 3 * len(points)))


def into_cone(forces: Array, friction: float, cone: str) -> Array:
    """Shrink the tangents of forces that stand outside the cone by a solver's last digits. Shape (points, 3)."""
    forces = forces.copy()
    forces[:, 0] = np.maximum(forces[:, 0], 0.0)
    x, y = np.abs(forces[:, 1]), np.abs(forces[:, 2])
    if cone == "quadratic":
        size = np.hypot(x, y)
    else:
        size = np.maximum(x, y) + (np.sqrt(2.0) - 1.0) * np.minimum(x, y)
    limit = friction * forces[:, 0]
    shrink = np.divide(limit, size, out=np.ones_like(size), where=size > limit)
    forces[:, 1:] *= shrink[:, None]
    return forces


def without_slip(problem: Problem, free: Mask, active: Mask, velocity: Array) -> Array:
    """Return the nearest velocity of the free parts at which no acting contact point slips, shape (free, 6).

    Friction counts the last digits of a slip in full; where it is very large, only a motion without any proves much.
    """
    slip = wrench_matrix(problem, free, active).T.toarray().reshape(-1, 3, 6 * int(free.sum()))[:, 1:]
    lengths = np.repeat(problem.measure[free] / problem.measure[free, :1], 3)  # so that all components are in m/s
    slip = slip.reshape(-1, len(lengths)) / lengths
    scaled = velocity.ravel() * lengths
    for _ in range(2):  # once more for the digits that the first time rounds off
        scaled = scaled - np.linalg.lstsq(slip, slip @ scaled, rcond=1e-10)[0]
    return (scaled / lengths).reshape(-1, 6)


def _force_units(problem: Problem, points: int) -> Array:
    """Return forces in N of variables of 1 at every contact point, shape (3 points,).

    Where friction is below 1, tangential variables count in shares of it, so that the cone keeps its slope. Without
    friction their columns vanish, and the cone still says that the normal force is not negative.
    """
    tangent = min(problem.friction, 1.0)
    return np.tile(np.array([1.0, tangent, tangent]) * problem.weight, points)


def _cone_rows(problem: Problem, points: int, cone: str) -> sp.csc_matrix:
    """Return rows `A` that keep variables in the friction cones: `A x <= 0`, or `-A x` in a second-order cone."""
    slope = max(problem.friction, 1.0)
    if cone == "quadratic":
        block = -np.diag([slope, 1.0, 1.0])
    else:
        angle = (np.arange(8) + 0.5) * np.pi / 4
        block = np.stack([np.full(8, -slope * np.cos(np.pi / 8)), np.cos(angle), np.sin(angle)], axis=1)
    return sp.csc_matrix(sp.kron(sp.eye(points), block))


def _stack(blocks: list[list]) -> sp.csc_matrix:
    return sp.csc_matrix(sp.bmat(blocks))


def _normalised(velocity: Array) -> Array:
    """Return velocities of the free parts with largest entry 1, shape (free, 6)."""
    largest = np.abs(velocity).max(initial=0.0)
    return (velocity / largest if largest > 0 else velocity).reshape(-1, 6)

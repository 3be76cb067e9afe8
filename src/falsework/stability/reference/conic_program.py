"""Textbook conic programs of equilibrium, in a form that any conic solver accepts.

They use only the wrench maps of `Problem`: no scaling, factorisation or projection of the fast solvers.
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
    """`min 1/2 x . (curvature * x) + cost . x` over rows `A x` that are constrained in one of three ways.

    The first `equalities` rows are `A x = b`, the next `inequalities` rows `A x <= b`, and the rest come in
    threes in which `b - A x` lies in the cone `s0 >= |(s1, s2)|`.
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
    """Maps solution and multipliers (nonnegative for rows `A x <= b`) to contact forces of the
    active points in N, shape (active, 3), and a velocity of the free parts, shape (free, 6)."""

    @property
    def cones(self) -> int:
        """Number of second-order cones."""
        return (len(self.bound) - self.equalities - self.inequalities) // 3


def block_diagonal(blocks: Array) -> sp.csc_matrix:
    """Return square blocks along a diagonal, shape (count, size, size) to (count size, count size), without zeros."""
    count, size, _ = blocks.shape
    layout = (blocks, np.arange(count), np.arange(count + 1))
    matrix = sp.csc_matrix(sp.bsr_matrix(layout, shape=(count * size, count * size)))
    matrix.eliminate_zeros()
    return matrix


def least_squares(problem: Problem, free: Mask, active: Mask, claim: StabilityCriterion) -> Program:
    """Return `min 1/2 |y|^2` with `y = L^-1 (G f + g)` up to a factor, `f` in the cones (paper, equation 6).

    Args:
        problem: the structure.
        free: parts that can move in the state, shape (parts,).
        active: contact points that act, shape (points,).
        claim: cone and force bound.
    """
    # Forces as shares of the weight and accelerations as shares of gravity keep the numbers near one, and make them
    # independent of the size of the structure.
    rows, columns = 6 * int(free.sum()), 3 * int(active.sum())
    units = _force_units(problem, active)
    lightest = (problem.momentum[free, 2, 2] / problem.measure[free, 0]).min()
    whiten = block_diagonal(problem.whitening[free] / lightest)
    wrench = wrench_matrix(problem, free, active)
    tension = _tension(problem, active)
    gravity = whiten @ (problem.gravity_wrench[free].ravel() + wrench @ tension)
    cone = _cone_rows(problem, active, claim.cone)

    def read(x: Array, _: Array) -> tuple[Array, Array]:
        return (units * x[:columns] + tension).reshape(-1, 3), _normalised(whiten.T @ x[columns:])

    return Program(
        curvature=np.repeat([0.0, 1.0], [columns, rows]),
        cost=np.zeros(columns + rows),
        rows=_stack(
            [[whiten @ wrench @ sp.diags(units), -sp.eye(rows)], [cone.rows, sp.csc_matrix((len(cone.bound), rows))]]
        ),
        bound=np.concatenate([-gravity, cone.bound]),
        equalities=rows,
        inequalities=cone.inequalities,
        read=read,
    )


def least_acceleration(problem: Problem, free: Mask, active: Mask, claim: StabilityCriterion) -> Program:
    """Return `min t` with `|D M^-1 (G f + g)| <= t`, `f` in the cones, sum of normals bounded; `D` is `measure`.

    Its multipliers are the best virtual velocity: by strong duality they prove exactly the residual that its
    solution reaches. Arguments as for `least_squares`.
    """
    rows, columns = 6 * int(free.sum()), 3 * int(active.sum())
    units = _force_units(problem, active)
    whiten = block_diagonal(problem.whitening[free])
    measured = sp.csc_matrix(sp.diags(np.repeat(problem.measure[free], 3)) @ (whiten.T @ whiten))  # D M^-1
    wrench = wrench_matrix(problem, free, active)
    accelerations = measured @ wrench @ sp.diags(units)
    tension = _tension(problem, active)
    gravity = measured @ (problem.gravity_wrench[free].ravel() + wrench @ tension)
    cone = _cone_rows(problem, active, claim.cone)
    most = claim.force_bound - tension.sum() / problem.weight
    normals = sp.csc_matrix((np.tile([1.0, 0.0, 0.0], columns // 3) * units / problem.weight)[None])
    one = sp.csc_matrix(np.ones((rows, 1)))

    def read(x: Array, multipliers: Array) -> tuple[Array, Array]:
        velocity = measured.T @ (multipliers[:rows] - multipliers[rows : 2 * rows])
        return (units * x[:columns] + tension).reshape(-1, 3), _normalised(velocity)

    return Program(
        curvature=np.zeros(columns + 1),
        cost=np.append(np.zeros(columns), 1.0),
        rows=_stack(
            [
                [accelerations, -one],
                [-accelerations, -one],
                [normals, sp.csc_matrix((1, 1))],
                [cone.rows, sp.csc_matrix((len(cone.bound), 1))],
            ]
        ),
        bound=np.concatenate([-gravity, gravity, [most], cone.bound]),
        equalities=0,
        inequalities=2 * rows + 1 + cone.inequalities,
        read=read,
    )


def wrench_matrix(problem: Problem, free: Mask, active: Mask) -> sp.csc_matrix:
    """Return wrenches on the free parts per force at the active points, shape (6 free, 3 active)."""
    rows, columns = np.repeat(free, 6), np.repeat(active, 3)
    return sp.csc_matrix(problem.wrench[np.flatnonzero(rows)][:, np.flatnonzero(columns)])


def without_slip(problem: Problem, free: Mask, active: Mask, velocity: Array) -> Array:
    """Return the nearest velocity of the free parts at which no acting contact point slips, shape (free, 6).

    Friction multiplies rounding errors of a slip; where it is very large, only a motion without slip proves much.
    """
    slip = wrench_matrix(problem, free, active).T.toarray().reshape(-1, 3, 6 * int(free.sum()))[:, 1:]
    lengths = np.repeat(problem.measure[free] / problem.measure[free, :1], 3)  # all components in m/s
    slip = slip.reshape(-1, len(lengths)) / lengths
    scaled = velocity.ravel() * lengths
    for _ in range(2):  # twice, as in iterative refinement
        scaled = scaled - np.linalg.lstsq(slip, slip @ scaled, rcond=1e-10)[0]
    return (scaled / lengths).reshape(-1, 6)


def _tension(problem: Problem, active: Mask) -> Array:
    """Return the forces of the acting points at their tensile strength, N, shape (3 points,).

    Variables are forces relative to these, so that the apex of each cone is at zero.
    """
    return np.concatenate([-problem.strength.pull[active, None], np.zeros((int(active.sum()), 2))], axis=1).ravel()


def _tangent_units(problem: Problem, active: Mask) -> Array:
    """Return units of tangential variables: the friction coefficient where below 1 and without cohesion, else 1.

    So the cone keeps its slope. Without friction their columns vanish, and the cone still requires a nonnegative
    normal force.
    """
    friction = problem.strength.friction[active]
    return np.where(problem.strength.stick[active] > 0.0, 1.0, np.minimum(friction, 1.0))


def _force_units(problem: Problem, active: Mask) -> Array:
    """Return the force in N of a unit variable at every acting point, shape (3 points,)."""
    tangent = _tangent_units(problem, active)
    return np.stack([np.ones_like(tangent), tangent, tangent], axis=1).ravel() * problem.weight


@dataclass(frozen=True)
class _Cone:
    """Rows that keep variables admissible, in the order of `Program`."""

    rows: sp.csc_matrix
    bound: Array
    inequalities: int


def _cone_rows(problem: Problem, active: Mask, cone: str) -> _Cone:
    """Return rows `A` and bounds `b` of the friction cones, with tension cut-off at contact points with cohesion."""
    friction, stick = problem.strength.friction[active], problem.strength.stick[active] / problem.weight
    tangent = _tangent_units(problem, active)
    slope = np.divide(friction, tangent, out=np.ones_like(friction), where=tangent > 0)
    points, sticky = len(friction), np.flatnonzero(stick > 0)
    cut = sp.csc_matrix((-np.ones(len(sticky)), (np.arange(len(sticky)), 3 * sticky)), (len(sticky), 3 * points))
    if cone == "quadratic":
        diagonal = np.stack([slope, np.ones(points), np.ones(points)], axis=1).ravel()
        rows, inequalities = _stack([[cut], [-sp.diags(diagonal)]]), len(sticky)
        return _Cone(rows, np.r_[np.zeros(len(sticky)), np.outer(stick, [1.0, 0.0, 0.0]).ravel()], inequalities)
    angle = (np.arange(8) + 0.5) * np.pi / 4
    blocks = np.zeros((points, 8, 3))
    blocks[:, :, 0] = -slope[:, None] * np.cos(np.pi / 8)
    blocks[:, :, 1], blocks[:, :, 2] = np.cos(angle), np.sin(angle)
    layout = (blocks, np.arange(points), np.arange(points + 1))
    rows = _stack([[cut], [sp.bsr_matrix(layout, shape=(8 * points, 3 * points))]])
    bound = np.r_[np.zeros(len(sticky)), np.repeat(stick * np.cos(np.pi / 8), 8)]
    return _Cone(rows, bound, len(bound))


def _stack(blocks: list[list]) -> sp.csc_matrix:
    return sp.csc_matrix(sp.bmat(blocks))


def _normalised(velocity: Array) -> Array:
    """Return velocities of the free parts scaled to a largest entry of 1, shape (free, 6)."""
    largest = np.abs(velocity).max(initial=0.0)
    return (velocity / largest if largest > 0 else velocity).reshape(-1, 6)

"""Exact solver: the textbook equilibrium problem solved by Clarabel's interior point method; slow and accurate.

It shares only the wrench maps of `Problem` with the fast solvers, no scaling, factorisation or projection, and serves
as their reference in tests, in `validate_plan`, and for the few states that they leave undecided.
"""

from __future__ import annotations

from typing import Any

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States, as_states
from falsework.stability.certificate import residual_bound_of_velocity, residual_of_forces
from falsework.stability.problem import Problem, build_problem
from falsework.stability.second_order.springs import into_cone
from falsework.stability.settings import EQUILIBRIUM, StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

Array = NDArray[np.float64]

_clarabel: Any = clarabel  # its classes come from a compiled module without type information


class ExactSolver:
    """Exact solver with Clarabel, one state at a time.

    It solves the convex program that minimises the residual of `certificate.py` itself: `min t` with
    `|D M^-1 (G f + g)| <= t`, `f` in the cones, sum of normals bounded; `D` is `measure`. By strong duality its
    multipliers are the best virtual velocity there is. Where that proves that forces leave more than the resolution,
    the state is unstable, though they may leave less than the tolerance.
    """

    def __init__(
        self, assembly: Assembly, settings: StabilitySettings = EQUILIBRIUM, problem: Problem | None = None
    ) -> None:
        self.assembly = assembly
        self.settings = settings
        self.problem = problem or build_problem(
            assembly, cone=settings.friction_cone, gravity=settings.gravity, reserve=settings.reserve
        )

    def check(self, states: ArrayLike) -> Verdicts:
        """Check states; forces and velocity are always returned.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)`.

        Raises:
            StateError: states of the wrong length or with other values.
        """
        batch = as_states(states, self.assembly.boundary)
        verdicts = self.problem.undecided(len(batch))
        for row in range(len(batch)):
            verdicts.put(np.array([row]), self._check_one(batch[row : row + 1]))
        return verdicts

    def _check_one(self, state: States) -> Verdicts:
        claim, problem = self.settings.claim, self.problem
        verdict = problem.undecided(1)
        assert verdict.forces is not None
        assert verdict.velocity is not None
        free, active = problem.free(state)[0], problem.active(state)[0]
        if free.any():
            forces, verdict.velocity[0, free], verdict.iterations[0] = self._solve(free, active)
            verdict.forces[:, active] = into_cone(forces[None], problem.strength.take(active), claim.cone)[0]
        left = residual_of_forces(self.assembly, state, verdict.forces, claim)[0]
        bound = residual_bound_of_velocity(self.assembly, state, verdict.velocity, claim)[0]
        verdict.residual[0] = left
        if bound > claim.resolution:
            verdict.verdict[0], verdict.residual[0] = Verdict.UNSTABLE, bound
        elif left <= claim.tolerance:
            verdict.verdict[0] = Verdict.STABLE
        verdict.on_tolerance[:] = claim.on_tolerance(verdict)
        verdict.proof[:] = proof_of(verdict.verdict)
        verdict.decided_by[:] = np.where(verdict.undecided, Solver.NONE, Solver.EXACT)
        return verdict

    def _solve(self, free: Mask, active: Mask) -> tuple[Array, Array, int]:
        """Return forces at the active points, velocities of the free parts, largest entry 1, and iterations."""
        problem, strength, claim = self.problem, self.problem.strength.take(active), self.settings.claim
        rows, points = 6 * int(free.sum()), int(active.sum())
        # Tangential variables keep the slope of the cone; without friction their columns vanish.
        tangent = np.where(strength.stick > 0.0, 1.0, np.minimum(strength.friction, 1.0))
        # Forces as shares of the weight and accelerations as shares of gravity keep the numbers near one. Variables are
        # forces relative to those at the tensile strength, so that the apex of each cone is at zero.
        units = np.stack([np.ones(points), tangent, tangent], axis=1).ravel() * problem.weight
        tension = np.stack([-strength.pull, np.zeros(points), np.zeros(points)], axis=1).ravel()
        whiten = block_diagonal(problem.whitening[free])
        measured = sp.csc_matrix(sp.diags(np.repeat(problem.measure[free], 3)) @ (whiten.T @ whiten))  # D M^-1
        wrench = wrench_matrix(problem, free, active)
        accelerations, one = measured @ wrench @ sp.diags(units), np.ones((rows, 1))
        gravity = measured @ (problem.gravity_wrench[free].ravel() + wrench @ tension)
        normals = sp.csc_matrix((np.tile([1.0, 0.0, 0.0], points) * units / problem.weight)[None])
        cone, bound, cones = _cone_rows(strength.friction, strength.stick / problem.weight, tangent, claim.cone)
        matrix = sp.csc_matrix(
            sp.bmat(
                [[accelerations, -one], [-accelerations, -one], [normals, None], [cone, sp.csc_matrix((len(bound), 1))]]
            )
        )
        limit = np.concatenate([-gravity, gravity, [claim.force_bound - tension.sum() / problem.weight], bound])
        settings = _clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
        kinds = [_clarabel.NonnegativeConeT(len(limit) - 3 * cones), *[_clarabel.SecondOrderConeT(3)] * cones]
        cost = np.append(np.zeros(3 * points), 1.0)
        nothing = sp.csc_matrix((len(cost), len(cost)))
        solution = _clarabel.DefaultSolver(nothing, cost, matrix, limit, kinds, settings).solve()
        multipliers = np.array(solution.z)
        velocity = measured.T @ (multipliers[:rows] - multipliers[rows : 2 * rows])
        forces = (units * np.array(solution.x)[:-1] + tension).reshape(-1, 3)
        largest = np.abs(velocity).max()
        return forces, (velocity / (largest or 1.0)).reshape(-1, 6), int(solution.iterations)


def block_diagonal(blocks: Array) -> sp.csc_matrix:
    """Return square blocks along a diagonal, shape (count, size, size) to (count size, count size), without zeros."""
    count, size, _ = blocks.shape
    layout = (blocks, np.arange(count), np.arange(count + 1))
    matrix = sp.csc_matrix(sp.bsr_matrix(layout, shape=(count * size, count * size)))
    matrix.eliminate_zeros()
    return matrix


def wrench_matrix(problem: Problem, free: Mask, active: Mask) -> sp.csc_matrix:
    """Return wrenches on the free parts per force at the active points, shape (6 free, 3 active)."""
    rows, columns = np.repeat(free, 6), np.repeat(active, 3)
    return sp.csc_matrix(problem.wrench[np.flatnonzero(rows)][:, np.flatnonzero(columns)])


def _cone_rows(friction: Array, stick: Array, tangent: Array, cone: str) -> tuple[sp.csc_matrix, Array, int]:
    """Return rows `A` and bounds `b` that keep scaled forces `x` admissible, and the number of second-order cones.

    The last rows come in threes in which `b - A x` lies in the cone `s0 >= |(s1, s2)|`; of the others `A x <= b`. Where
    there is cohesion, some cut off tension.

    Args:
        friction, stick, tangent: friction, cohesion and unit of tangential forces, shape (points,).
        cone: `octagon` or `quadratic`.
    """
    slope = np.divide(friction, tangent, out=np.ones_like(friction), where=tangent > 0)
    points, sticky = len(friction), np.flatnonzero(stick > 0)
    cut = sp.csc_matrix((-np.ones(len(sticky)), (np.arange(len(sticky)), 3 * sticky)), (len(sticky), 3 * points))
    if cone == "quadratic":
        diagonal = np.stack([slope, np.ones(points), np.ones(points)], axis=1).ravel()
        bound = np.r_[np.zeros(len(sticky)), np.outer(stick, [1.0, 0.0, 0.0]).ravel()]
        return sp.csc_matrix(sp.vstack([cut, -sp.diags(diagonal)])), bound, points
    angle = (np.arange(8) + 0.5) * np.pi / 4
    blocks = np.zeros((points, 8, 3))
    blocks[:, :, 0] = -slope[:, None] * np.cos(np.pi / 8)
    blocks[:, :, 1], blocks[:, :, 2] = np.cos(angle), np.sin(angle)
    facets = sp.bsr_matrix((blocks, np.arange(points), np.arange(points + 1)), shape=(8 * points, 3 * points))
    bound = np.r_[np.zeros(len(sticky)), np.repeat(stick * np.cos(np.pi / 8), 8)]
    return sp.csc_matrix(sp.vstack([cut, facets])), bound, 0

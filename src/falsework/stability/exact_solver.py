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
from falsework.assembly.state import INSTALLED, Mask, States, as_states
from falsework.stability.certificate import residual_bound_of_velocity, residual_of_forces
from falsework.stability.problem import Problem, build_problem
from falsework.stability.second_order.springs import ROUNDING, into_cone
from falsework.stability.settings import EQUILIBRIUM, StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

Array = NDArray[np.float64]

_clarabel: Any = clarabel  # its classes come from a compiled module without type information


class ExactSolver:
    """Exact solver with Clarabel, one state at a time.

    It first solves the least-squares problem of the residual (docs/how-it-works; paper, equation 6), whose forces prove
    nearly every stable state and whose residual nearly every unstable one. The rest is settled by the program that
    minimises the residual of `certificate.py` itself: `min t` with `|D M^-1 (G f + g)| <= t`, `f` in the cones, sum of
    normals bounded; `D` is `measure`. By strong duality its multipliers are the best virtual velocity there is. Where a
    velocity proves that forces leave more than the resolution, the state is unstable, though they may leave less than
    the tolerance.
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
        free, active = state[0] == INSTALLED, problem.active(state)[0]
        above, below = np.inf, 0.0
        for squares in (True, False):
            forces, velocity = np.zeros_like(verdict.forces), np.zeros_like(verdict.velocity)
            if free.any():
                found, velocity[0, free], steps = self._solve(free, active, squares=squares)
                forces[:, active] = into_cone(found[None], problem.strength.take(active), claim.cone)[0]
                verdict.iterations[0] += steps
            left = residual_of_forces(self.assembly, state, forces, claim)[0]
            bound = residual_bound_of_velocity(self.assembly, state, velocity, claim)[0]
            rough = problem.strength.friction.max(initial=0.0) > claim.tolerance / ROUNDING
            if rough and left > claim.tolerance >= bound:
                velocity[0, free] = _without_slip(problem, free, active, velocity[0, free])
                bound = residual_bound_of_velocity(self.assembly, state, velocity, claim)[0]
            if left < above:
                verdict.forces[:], above = forces, left
            if bound > below:
                verdict.velocity[:], below = velocity, bound
            if above <= claim.resolution or below > claim.tolerance:
                break
        verdict.residual[0] = above
        if below > claim.resolution:
            verdict.verdict[0], verdict.residual[0] = Verdict.UNSTABLE, below
        elif above <= claim.tolerance:
            verdict.verdict[0] = Verdict.STABLE
        verdict.on_tolerance[:] = claim.on_tolerance(verdict)
        verdict.proof[:] = proof_of(verdict.verdict)
        verdict.decided_by[:] = np.where(verdict.undecided, Solver.NONE, Solver.EXACT)
        return verdict

    def _solve(self, free: Mask, active: Mask, *, squares: bool) -> tuple[Array, Array, int]:
        """Return forces at the active points, velocities of the free parts, largest entry 1, and iterations."""
        problem, strength, claim = self.problem, self.problem.strength.take(active), self.settings.claim
        rows, points = 6 * int(free.sum()), int(active.sum())
        # Tangential variables keep the slope of the cone; without friction their columns vanish.
        tangent = np.where(strength.stick > 0.0, 1.0, np.minimum(strength.friction, 1.0))
        # Forces as shares of the weight and accelerations as shares of gravity keep the numbers near one. Variables are
        # forces relative to those at the tensile strength, so that the apex of each cone is at zero.
        units = np.stack([np.ones(points), tangent, tangent], axis=1).ravel() * problem.weight
        tension = np.stack([-strength.pull, np.zeros(points), np.zeros(points)], axis=1).ravel()
        measured = block_diagonal(problem.whitening[free])
        if squares:
            measured = measured / (problem.momentum[free, 2, 2] / problem.measure[free, 0]).min()
        else:
            measured = sp.diags(np.repeat(problem.measure[free], 3)) @ (measured.T @ measured)  # D M^-1
        wrench = wrench_matrix(problem, free, active)
        accelerations = measured @ wrench @ sp.diags(units)
        gravity = measured @ (problem.gravity_wrench[free].ravel() + wrench @ tension)
        cone, bound, cones = _cone_rows(strength.friction, strength.stick / problem.weight, tangent, claim.cone)
        if squares:  # min 1/2 |y|^2 with y = accelerations x + gravity
            matrix = [[accelerations, -sp.eye(rows)], [cone, sp.csc_matrix((len(bound), rows))]]
            limit, equal = np.concatenate([-gravity, bound]), rows
            curvature, cost = np.repeat([0.0, 1.0], [3 * points, rows]), np.zeros(3 * points + rows)
        else:
            one, last = np.ones((rows, 1)), sp.csc_matrix((len(bound), 1))
            normals = sp.csc_matrix((np.tile([1.0, 0.0, 0.0], points) * units / problem.weight)[None])
            matrix = [[accelerations, -one], [-accelerations, -one], [normals, None], [cone, last]]
            most = claim.force_bound - tension.sum() / problem.weight
            limit, equal = np.concatenate([-gravity, gravity, [most], bound]), 0
            curvature, cost = np.zeros(3 * points + 1), np.append(np.zeros(3 * points), 1.0)
        settings = _clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
        kinds = [_clarabel.ZeroConeT(equal), _clarabel.NonnegativeConeT(len(limit) - equal - 3 * cones)]
        kinds += [_clarabel.SecondOrderConeT(3)] * cones
        quadratic, constraints = sp.diags(curvature, format="csc"), sp.csc_matrix(sp.bmat(matrix))
        solution = _clarabel.DefaultSolver(quadratic, cost, constraints, limit, kinds, settings).solve()
        x, multipliers = np.array(solution.x), np.array(solution.z)
        velocity = measured.T @ (x[3 * points :] if squares else multipliers[:rows] - multipliers[rows : 2 * rows])
        forces = (units * x[: 3 * points] + tension).reshape(-1, 3)
        return forces, (velocity / (np.abs(velocity).max() or 1.0)).reshape(-1, 6), int(solution.iterations)


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
    return sp.csc_matrix(problem.geometry.wrench[np.flatnonzero(rows)][:, np.flatnonzero(columns)])


def _without_slip(problem: Problem, free: Mask, active: Mask, velocity: Array) -> Array:
    """Return the nearest velocity of the free parts at which no acting contact point slips, shape (free, 6).

    Friction multiplies rounding errors of a slip; where it is very large, only a motion without slip proves much.
    """
    slip = wrench_matrix(problem, free, active).T.toarray().reshape(-1, 3, 6 * int(free.sum()))[:, 1:]
    lengths = np.repeat(problem.measure[free] / problem.measure[free, :1], 3)  # all components in m/s
    slip, scaled = slip.reshape(-1, len(lengths)) / lengths, velocity.ravel() * lengths
    for _ in range(2):  # twice, as in iterative refinement
        scaled = scaled - np.linalg.lstsq(slip, slip @ scaled, rcond=1e-10)[0]
    return (scaled / lengths).reshape(-1, 6)


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

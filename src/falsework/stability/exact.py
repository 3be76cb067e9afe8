"""The exact solver: a textbook interior point method on the textbook problem, slow and right (Clarabel).

It shares nothing with the fast solvers but the wrench maps of `Problem`, and sits in judgement over them in
tests, in `Plan.validate`, and for the few states that they leave undecided.
"""

from __future__ import annotations

from typing import Any

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.certificate import Claim, residual_bound_of_velocity, residual_of_forces
from falsework.stability.problem import Problem, build_problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

Array = NDArray[np.float64]


class ExactSolver:
    """Judges states one at a time, with Clarabel.

    First the least-squares problem of DESIGN section 4; its forces prove nearly every stable state, its
    residual nearly every unstable one. What lies between (the least-squares residual is above the tolerance,
    yet other forces might stay below it) is settled by the linear program that minimises the largest
    acceleration itself, whose dual is the best virtual velocity there is.
    """

    def __init__(
        self,
        assembly: Assembly,
        settings: StabilitySettings = StabilitySettings(),
        problem: Problem | None = None,
    ) -> None:
        self.assembly = assembly
        self.settings = settings
        self.problem = problem or build_problem(assembly, cone=settings.cone, gravity=settings.gravity)

    def check(self, states: States) -> Verdicts:
        """Judge a batch; forces and velocity are always returned. Shape (batch, parts)."""
        verdicts = Verdicts.blank(len(states), points=self.problem.points, parts=self.problem.parts)
        for row, state in enumerate(states):
            verdicts.put(np.array([row]), self._check_one(state))
        return verdicts

    def _check_one(self, state: States) -> Verdicts:
        claim, problem = self.settings.claim, self.problem
        verdict = Verdicts.blank(1, points=problem.points, parts=problem.parts)
        assert verdict.forces is not None
        assert verdict.velocity is not None
        free, active = problem.free(state[None])[0], problem.active(state[None])[0]
        for program in (_least_squares, _least_acceleration):
            if free.any():
                forces, velocity, steps = program(problem, free, active, claim)
                verdict.forces[0][active] = into_cone(forces, problem.friction, claim.cone)
                verdict.velocity[0][free] = velocity
                verdict.iterations[0] += steps
            above = residual_of_forces(self.assembly, state[None], verdict.forces, claim)[0]
            below = residual_bound_of_velocity(self.assembly, state[None], verdict.velocity, claim)[0]
            if above <= claim.tolerance:
                verdict.verdict[0], verdict.residual[0] = Verdict.STABLE, above
                break
            if below > claim.tolerance:
                verdict.verdict[0], verdict.residual[0] = Verdict.UNSTABLE, below
                break
            verdict.residual[0] = above
        verdict.proof[:] = proof_of(verdict.verdict)
        verdict.decided_by[:] = np.where(verdict.verdict != 0, Solver.EXACT, Solver.NONE)
        return verdict


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


def _wrench_matrix(problem: Problem, free: NDArray[np.bool_], active: NDArray[np.bool_]) -> sp.csc_matrix:
    """Wrenches on the free parts per force at the active points, shape (6 free, 3 active)."""
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


def _cone_rows(problem: Problem, points: int, cone: str) -> tuple[sp.csc_matrix, list[Any]]:
    """Rows `A` and cones such that `-A f` in the cones says that forces are inside their friction cones."""
    mu = problem.friction
    if cone == "quadratic":
        block = -np.diag([mu, 1.0, 1.0])
        return sp.csc_matrix(sp.kron(sp.eye(points), block)), [clarabel.SecondOrderConeT(3)] * points
    angle = (np.arange(8) + 0.5) * np.pi / 4
    block = np.stack([np.full(8, -mu * np.cos(np.pi / 8)), np.cos(angle), np.sin(angle)], axis=1)
    if mu * np.cos(np.pi / 8) <= 0:  # the sides alone would leave the normal's sign open
        block = np.vstack([block, [-1.0, 0.0, 0.0]])
    return sp.csc_matrix(sp.kron(sp.eye(points), block)), [clarabel.NonnegativeConeT(len(block) * points)]


def _least_squares(
    problem: Problem, free: NDArray[np.bool_], active: NDArray[np.bool_], claim: Claim
) -> tuple[Array, Array, int]:
    """`min 1/2 |y|^2` with `y = L^-1 (G f + g)`, `f` in the cones (DESIGN, section 4; paper, equation 6)."""
    # Forces in shares of the weight keep the numbers near one.
    unit = problem.weight
    whiten = sp.block_diag(list(problem.whitening[free]), format="csc")
    wrenches = whiten @ _wrench_matrix(problem, free, active) * unit
    gravity = whiten @ problem.gravity_wrench[free].ravel()
    rows, columns = wrenches.shape
    cone_rows, cones = _cone_rows(problem, columns // 3, claim.cone)
    solution = _solve(
        P=sp.block_diag([sp.csc_matrix((columns, columns)), sp.eye(rows)], format="csc"),
        q=np.zeros(columns + rows),
        A=sp.vstack(
            [
                sp.hstack([wrenches, -sp.eye(rows)]),
                sp.hstack([cone_rows, sp.csc_matrix((cone_rows.shape[0], rows))]),
            ],
            format="csc",
        ),
        b=np.concatenate([-gravity, np.zeros(cone_rows.shape[0])]),
        cones=[clarabel.ZeroConeT(rows), *cones],
    )
    x = np.array(solution.x)
    velocity = whiten.T @ x[columns:]
    return unit * x[:columns].reshape(-1, 3), _normalised(velocity), int(solution.iterations)


def _least_acceleration(
    problem: Problem, free: NDArray[np.bool_], active: NDArray[np.bool_], claim: Claim
) -> tuple[Array, Array, int]:
    """`min t` with `|M^-1 (G f + g)| <= t`, `f` in the cones, sum of normals below the bound."""
    unit = problem.weight
    whiten = sp.block_diag(list(problem.whitening[free]), format="csc")
    inverse_mass = whiten.T @ whiten
    accelerations = inverse_mass @ _wrench_matrix(problem, free, active) * unit
    gravity = inverse_mass @ problem.gravity_wrench[free].ravel()
    rows, columns = accelerations.shape
    cone_rows, cones = _cone_rows(problem, columns // 3, claim.cone)
    normals = sp.csc_matrix(np.tile([1.0, 0.0, 0.0], columns // 3)[None])
    one = sp.csc_matrix(np.ones((rows, 1)))
    solution = _solve(
        P=sp.csc_matrix((columns + 1, columns + 1)),
        q=np.concatenate([np.zeros(columns), [1.0]]),
        A=sp.vstack(
            [
                sp.hstack([accelerations, -one]),
                sp.hstack([-accelerations, -one]),
                sp.hstack([normals, sp.csc_matrix((1, 1))]),
                sp.hstack([cone_rows, sp.csc_matrix((cone_rows.shape[0], 1))]),
            ],
            format="csc",
        ),
        b=np.concatenate([-gravity, gravity, [claim.force_bound], np.zeros(cone_rows.shape[0])]),
        cones=[clarabel.NonnegativeConeT(2 * rows + 1), *cones],
    )
    x, dual = np.array(solution.x), np.array(solution.z)
    velocity = inverse_mass @ (dual[:rows] - dual[rows : 2 * rows])
    return unit * x[:columns].reshape(-1, 3), _normalised(velocity), int(solution.iterations)


def _normalised(velocity: Array) -> Array:
    """Velocities of the free parts with largest entry 1, shape (free, 6)."""
    largest = np.abs(velocity).max(initial=0.0)
    return (velocity / largest if largest > 0 else velocity).reshape(-1, 6)


def _solve(P: sp.csc_matrix, q: Array, A: sp.csc_matrix, b: Array, cones: list[Any]) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    settings.max_iter = 200
    return clarabel.DefaultSolver(sp.triu(P, format="csc"), q, A, b, cones, settings).solve()

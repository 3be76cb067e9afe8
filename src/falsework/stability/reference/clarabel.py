"""Exact solver: the textbook equilibrium problem solved by Clarabel's interior point method; slow and accurate.

It shares only the wrench maps of `Problem` with the fast solvers, and serves as their reference in
tests, in `validate_plan`, and for the few states that they leave undecided.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States, as_states
from falsework.stability.certificate import StabilityCriterion, residual_bound_of_velocity, residual_of_forces
from falsework.stability.problem import Problem, build_problem
from falsework.stability.reference.conic_program import (
    Program,
    into_cone,
    least_acceleration,
    least_squares,
    without_slip,
)
from falsework.stability.settings import EQUILIBRIUM, StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

Array = NDArray[np.float64]
ProgramOf = Callable[[Problem, NDArray[np.bool_], NDArray[np.bool_], StabilityCriterion], Program]

_ROUGH = 1e4
"""Friction above which rounding errors of the slip in a velocity can spoil its proof."""

_clarabel: Any = clarabel  # its classes come from a compiled module without type information


class ExactSolver:
    """Exact solver with Clarabel, one state at a time.

    It first solves the least-squares problem of the residual (docs/how-it-works), whose forces prove nearly every
    stable state and whose residual nearly every unstable one. The rest is settled by the linear program that minimises
    the residual of `certificate.py` itself, whose dual is the best virtual velocity there is. Where a velocity proves
    that forces leave more than the resolution, the state is unstable, though they may leave less than the tolerance.
    """

    _programs: ClassVar[tuple[ProgramOf, ...]] = (least_squares, least_acceleration)
    _name: ClassVar[Solver] = Solver.EXACT

    def __init__(
        self,
        assembly: Assembly,
        settings: StabilitySettings = EQUILIBRIUM,
        problem: Problem | None = None,
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
        verdicts = Verdicts.all_undecided(len(batch), points=self.problem.points, parts=self.problem.parts)
        for row in range(len(batch)):
            verdicts.put(np.array([row]), self._check_one(batch[row : row + 1]))
        return verdicts

    def _check_one(self, state: States) -> Verdicts:
        """Check a single state."""
        claim, problem = self.settings.claim, self.problem
        verdict = Verdicts.all_undecided(1, points=problem.points, parts=problem.parts)
        assert verdict.forces is not None
        assert verdict.velocity is not None
        free, active = problem.free(state)[0], problem.active(state)[0]
        above, below = np.inf, 0.0
        for program_of in self._programs:
            forces, velocity = np.zeros_like(verdict.forces), np.zeros_like(verdict.velocity)
            if free.any():
                program = program_of(problem, free, active, claim)
                solution, multipliers, steps = self._solve(program)
                found, velocity[0][free] = program.read(solution, multipliers)
                forces[0][active] = into_cone(found, problem.strength.take(active), claim.cone)
                verdict.iterations[0] += steps
            left = residual_of_forces(self.assembly, state, forces, claim)[0]
            bound = residual_bound_of_velocity(self.assembly, state, velocity, claim)[0]
            if problem.strength.friction.max(initial=0.0) > _ROUGH and left > claim.tolerance >= bound:
                velocity[0][free] = without_slip(problem, free, active, velocity[0][free])
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
        verdict.decided_by[:] = np.where(verdict.undecided, Solver.NONE, self._name)
        return verdict

    def _solve(self, program: Program) -> tuple[Array, Array, int]:
        """Return the solution, the multipliers of the rows, and the number of iterations."""
        settings = _clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
        settings.max_iter = 200
        cones = [
            _clarabel.ZeroConeT(program.equalities),
            _clarabel.NonnegativeConeT(program.inequalities),
            *[_clarabel.SecondOrderConeT(3)] * program.cones,
        ]
        curvature = sp.diags(program.curvature, format="csc")
        solver = _clarabel.DefaultSolver(curvature, program.cost, program.rows, program.bound, cones, settings)
        solution = solver.solve()
        return np.array(solution.x), np.array(solution.z), int(solution.iterations)

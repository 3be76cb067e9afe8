"""Stability of single states of one structure under modified friction and additional loads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.stability.certificate import (
    forces_of_displacement,
    residual_bound_of_velocity,
    residual_of_displacement,
    resistance_to_velocity,
    verify_certificates,
)
from falsework.stability.contact.kernel import rest_under
from falsework.stability.contact.layout import ContactOptions, StepSchedule
from falsework.stability.contact.newton import MOVES_AWAY, OPEN, RESTS
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.layout import KernelArrays, strength_arrays
from falsework.stability.cpu.solver import CpuSolver, kernel_options
from falsework.stability.cpu.termination import STABLE, UNSTABLE, Options
from falsework.stability.exact_solver import ExactSolver
from falsework.stability.margins.conditions import Answer, Condition, OutOfTime, some_idle
from falsework.stability.strength import strength_of
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.stability.settings import StabilitySettings

Array = NDArray[np.float64]

_SCHEDULE = StepSchedule(growth=4.0, patience=0, late_growth=4.0, growth_after_rise=2.0, memory=1.0)
"""Rules by which time steps grow: where iterations alternate between two residuals, these mostly end that."""
_ABOVE = 2.0
"""Multiple of the tolerance that the proof of a velocity must exceed to cut off a load: so it also proves a tilt, which
is the same load made smaller. The bound moves by less than a thousandth."""
_MANY, _RARELY = 4000, 20
"""Iterations in which a large load is balanced by itself, and those between two tests."""


class Prober:
    """Solver of single states under conditions; it may be used from several threads."""

    def __init__(self, assembly: Assembly, settings: StabilitySettings, solver: CpuSolver) -> None:
        """Share the layout of a solver for a structure.

        Args:
            settings: criterion, cone and tolerances.
            solver: of the criterion, with the same settings.
        """
        self.assembly, self.settings, self.problem = assembly, settings, solver.problem
        self.contact = settings.criterion == "contact"
        self._structure = solver.structure
        self._options = kernel_options(self.settings)
        self._contact = solver.contact_structure if isinstance(solver, ContactSolver) else None
        if isinstance(solver, ContactSolver):
            self.contact_options = solver.contact_options
            # No state is loaded from rest in the search for a bound. Iterations at the outer end of a bracket are
            # continued by twice as many, until parts are seen to move away.
            quick = self.contact_options.steps // 4
            self._quick_options = self.contact_options._replace(warm_steps=quick, steps=0, schedule=_SCHEDULE)
            self.further_options = self._quick_options._replace(warm_steps=2 * quick)
        self._no_motion = np.zeros((0, 3))
        self._end = np.inf

    def until(self, end: float) -> Prober:
        """Return a prober that raises `OutOfTime` from a time on, as `time.perf_counter` counts it."""
        prober = copy(self)
        prober._end = end
        return prober

    @property
    def limited(self) -> bool:
        """Whether the time of this prober ends."""
        return self._end < np.inf

    def own(self) -> Condition:
        """Return the condition of the unmodified structure."""
        return Condition(self.assembly.friction, np.zeros((self.problem.parts, 6)))

    def ask(
        self,
        state: States,
        condition: Condition,
        near: Answer | None = None,
        *,
        moved: Array | None = None,
        coarse: bool = False,
    ) -> Answer:
        """Check the stability of a state under a condition.

        Args:
            state: shape (parts,).
            condition: friction and loads.
            near: the answer under a nearby condition, for a warm start.
            moved: under `contact`, prescribed displacements of fixed parts, shape (parts, 6), m and rad.
            coarse: under `contact`, only iterate from the nearby answer; if that fails, it may rest nonetheless.

        Raises:
            OutOfTime: the time of this prober is over.
        """
        if time.perf_counter() > self._end:
            raise OutOfTime
        if self.contact:
            known = near is not None and near.displacement is not None
            options = self._quick_options if coarse and known else self.contact_options
            (answer,) = self._ask_contact(state, [condition], [near if known else None], [-1], moved, options)
            if answer.reached is not None and not answer.coarse:
                # What the rules of verdicts leave undecided, the other ones often decide.
                return self.refine(state, answer)
            return answer
        if some_idle(self.assembly, condition.friction):
            return self._exactly(state, condition)
        answer = self.balance(state, condition, near)
        if not answer.stands and answer.velocity is None and (size := self._size(state, condition.extra)) > 1.0:
            answer = self._balance_apart(state, condition, size)
        if answer.stands or answer.velocity is not None:
            return answer
        return self._exactly(state, condition)

    def _exactly(self, state: States, condition: Condition) -> Answer:
        """Check whether a state is in equilibrium with the exact solver."""
        exact = self.exact(state, condition)
        forces = exact.forces[0] if exact.stable[0] and exact.forces is not None else None
        velocity = exact.velocity[0] if exact.unstable[0] and exact.velocity is not None else None
        return Answer(condition, forces is not None, forces=forces, velocity=velocity)

    def balance(self, state: States, condition: Condition, near: Answer | None = None) -> Answer:
        """Check whether a state is in equilibrium, whatever the criterion; arguments as for `ask`."""
        return self._balance(state, condition, self._whitened(condition.extra), self._options, near)

    def _size(self, state: States, extra: Array) -> float:
        """Return the largest additional force on a part that can move, in weights of the part; 0 where joints pull."""
        strength, moved = self.problem.strength, state == 1
        if strength.pull.any() or strength.stick.any():
            return 0.0
        weights = self.settings.gravity * self.assembly.mass.mass
        return float((np.linalg.norm(extra[moved, :3], axis=1) / weights[moved]).max(initial=0.0))

    def _balance_apart(self, state: States, condition: Condition, size: float) -> Answer:
        """Balance a large load by itself, and then the weights with what that leaves.

        Beside a load of many weights, the weights may be below the precision of one solution. The cones of dry contacts
        are closed under addition, so both forces together balance both. First-order iterations stay close to the
        smallest forces, which matters for the force bound: an interior point is far from them.

        Args:
            state: shape (parts,).
            condition: friction and loads.
            size: the load in weights of a part.
        """
        alone, options = condition.extra / size, self._options
        options = options._replace(
            force_bound=options.force_bound / size, iterations=_MANY, check_every=_RARELY, interior_steps=0
        )
        found = self._balance(state, condition, self._whitened(alone - self.problem.gravity_wrench), options)
        if found.forces is not None:
            left = self.contact_wrench(state, found.forces) + alone
            rest = self.balance(state, Condition(condition.friction, size * np.where((state == 1)[:, None], left, 0.0)))
            if rest.forces is not None:
                forces = size * found.forces + rest.forces
                within = forces[:, 0].sum() <= self._options.force_bound * self.problem.weight
                return Answer(condition, bool(within), forces=forces if within else None)
        if found.velocity is not None:
            changed, velocity = condition.applied_to(self.assembly), found.velocity
            least = residual_bound_of_velocity(changed, state[None], velocity[None], self.settings.claim)[0]
            return Answer(condition, False, velocity=velocity if least > self.settings.tolerance else None)
        return Answer(condition, False)

    def _balance(
        self, state: States, condition: Condition, load: Array, options: Options, near: Answer | None = None
    ) -> Answer:
        """Check whether a state is in equilibrium under whitened wrenches on its parts, shape (parts, 6)."""
        load.setflags(write=False)  # as the kernels are compiled for
        structure = self._under(condition.friction)._replace(gravity=load)
        warm = near is not None and near.forces is not None
        forces, velocity = np.zeros((1, self.problem.points, 3)), np.zeros((1, self.problem.parts, 6))
        if warm and near is not None and near.forces is not None:
            forces[0] = near.forces
        verdict, batch = np.zeros(1, np.int8), np.array(state[None])
        solve_range(structure, batch, options, forces, velocity, warm, verdict, np.zeros(1), np.zeros(1, np.int32))
        stands, fails = bool(verdict[0] == STABLE), bool(verdict[0] == UNSTABLE)
        return Answer(condition, stands, forces=forces[0] if stands else None, velocity=velocity[0] if fails else None)

    def ask_each(self, state: States, conditions: Sequence[Condition], near: Sequence[Answer | int]) -> list[Answer]:
        """Check a state under conditions with the same friction, until it fails under one; quickly under `contact`.

        Args:
            state: shape (parts,).
            conditions: friction and loads.
            near: for each the stable answer under a nearby condition, or the index of an earlier one of these.
        """
        if not self.contact:
            answers: list[Answer] = []
            for condition, start in zip(conditions, near, strict=True):
                answers.append(self.ask(state, condition, answers[start] if isinstance(start, int) else start))
                if not answers[-1].stands:
                    break
            return answers
        if time.perf_counter() > self._end:
            raise OutOfTime
        known = [answer if isinstance(answer, Answer) else None for answer in near]
        after = [answer if isinstance(answer, int) else -1 for answer in near]
        return self._ask_contact(state, conditions, known, after, None, self._quick_options)

    def _ask_contact(
        self,
        state: States,
        conditions: Sequence[Condition],
        near: Sequence[Answer | None],
        after: Sequence[int],
        moved: Array | None,
        options: ContactOptions,
    ) -> list[Answer]:
        count = len(conditions)
        displacement = np.zeros((count, self.problem.parts, 6))
        for row, answer in enumerate(near):
            if answer is not None and answer.displacement is not None:
                displacement[row] = answer.displacement
        warm = near[0] is not None
        result = np.zeros(count, np.int8)
        law, structure = self._contact, self._under(conditions[0].friction)
        assert law is not None
        tried = rest_under(
            law if structure is law.structure else law._replace(structure=structure),
            np.array(state),
            self.problem.gravity_wrench + np.array([condition.extra for condition in conditions]),
            self._no_motion if moved is None else self._offsets(moved),
            options,
            displacement,
            warm,
            np.array(after, np.int64),
            result,
        )
        if some_idle(self.assembly, conditions[0].friction):
            for row in np.flatnonzero(result == RESTS).tolist():
                changed, claim = conditions[row].applied_to(self.assembly), self.settings.claim
                left = residual_of_displacement(changed, state[None], displacement[row : row + 1], claim)[0]
                # Of displaced supports the checker knows nothing.
                result[row] = RESTS if left <= claim.tolerance and moved is None else OPEN
        coarse = options.steps == 0
        return [
            Answer(
                condition,
                bool(result[row] == RESTS),
                moves_away=bool(result[row] == MOVES_AWAY),
                coarse=coarse,
                displacement=displacement[row] if result[row] == RESTS else None,
                reached=displacement[row] if result[row] == OPEN else None,
            )
            for row, condition in enumerate(conditions[:tried])
        ]

    def refine(self, state: States, answer: Answer) -> Answer:
        """Continue the iterations of an answer from where they ended undecided, if they did; under `contact`."""
        if answer.reached is None:
            return answer
        if time.perf_counter() > self._end:
            raise OutOfTime
        guess, options = replace(answer, displacement=answer.reached), self.further_options
        (found,) = self._ask_contact(state, [answer.condition], [guess], [-1], None, options)
        return replace(found, coarse=answer.coarse)

    def contact_wrench(self, state: States, forces: Array) -> Array:
        """Return the wrenches of contact forces, N, shape (points, 3), on all parts, N and Nm, shape (parts, 6)."""
        active = self.problem.active(state[None])[0]
        return (self.problem.wrench @ np.where(active[:, None], forces, 0.0).ravel()).reshape(-1, 6)

    def forces(self, state: States, answer: Answer) -> Array:
        """Return the contact forces of a stable answer, N, shape (points, 3)."""
        if answer.displacement is None:
            assert answer.forces is not None
            return answer.forces
        changed = answer.condition.applied_to(self.assembly)
        return forces_of_displacement(changed, state[None], answer.displacement[None], self.settings.claim)[0]

    def cut(self, state: States, answer: Answer, direction: Array) -> float:
        """Return the largest multiple of a load not ruled out by the velocity of an answer; infinity without a limit.

        Args:
            state: shape (parts,).
            answer: answer under a condition with the same friction.
            direction: the load, N and Nm, shape (parts, 6).
        """
        if answer.velocity is None:
            return np.inf
        velocity = np.where((state == 1)[:, None], answer.velocity, 0.0)
        power = float((velocity * direction).sum())
        if power <= 0.0:
            return np.inf
        assembly = self.assembly.at_friction(answer.condition.friction)
        claim = self.settings.claim
        taken, momentum = resistance_to_velocity(assembly, state[None], velocity[None], claim)
        present = float((velocity * self.problem.gravity_wrench).sum())
        return (float(taken[0]) + _ABOVE * claim.tolerance * float(momentum[0]) - present) / power

    def certify(self, state: States, answer: Answer, near: Verdicts | None = None) -> Verdicts:
        """Return the verdict of an answer with a proof that the certificate checker accepts, else undecided.

        Under `contact` a state that fails is unstable if a velocity proves it; else it slides if parts were seen to
        move away, and comes with forces in equilibrium.

        Args:
            state: shape (parts,).
            answer: the answer to prove.
            near: verdict under a nearby condition, whose forces are a first guess.
        """
        verdicts = self.problem.undecided(1, displaced=self.contact)
        assert verdicts.forces is not None
        assert verdicts.velocity is not None
        changed, claim = answer.condition.applied_to(self.assembly), self.settings.claim
        verdicts.decided_by[:] = Solver.CPU
        if answer.stands and answer.displacement is not None:
            assert verdicts.displacement is not None
            verdicts.displacement[0] = answer.displacement
            verdicts.forces[:] = forces_of_displacement(changed, state[None], answer.displacement[None], claim)
            verdicts.verdict[0] = Verdict.STABLE
        elif answer.stands and answer.forces is not None:
            verdicts.forces[0], verdicts.verdict[0] = answer.forces, Verdict.STABLE
        elif self._certify_failure(state, answer, near, verdicts):
            return verdicts
        verdicts.proof[:] = proof_of(verdicts.verdict, self.settings.criterion)
        if not verify_certificates(changed, state[None], verdicts, claim)[0]:
            exact = self.exact(state, answer.condition)
            if exact.unstable[0] or not self.contact:
                verdicts.put(np.array([0]), exact)
            else:
                verdicts.verdict[0] = Verdict.UNDECIDED
        return verdicts

    def exact(self, state: States, condition: Condition) -> Verdicts:
        """Return the verdict of the exact solver on a state under a condition."""
        settings = replace(self.settings, criterion="equilibrium", cone=self.settings.friction_cone)
        return ExactSolver(condition.applied_to(self.assembly), settings).check(state)

    def _certify_failure(self, state: States, answer: Answer, near: Verdicts | None, verdicts: Verdicts) -> bool:
        """Write the proof of a state that is not stable; return whether it stays undecided although in equilibrium."""
        assert verdicts.forces is not None
        assert verdicts.velocity is not None
        velocity = answer.velocity
        if velocity is None:
            forces = None if near is None or near.forces is None else near.forces[0]
            balanced = self.balance(state, answer.condition, replace(answer, forces=forces))
            velocity = balanced.velocity
            if self.contact and balanced.forces is not None:
                verdicts.forces[0] = balanced.forces
                verdicts.verdict[0] = Verdict.SLIDES if answer.moves_away else Verdict.UNDECIDED
                return not answer.moves_away
        if velocity is not None:
            verdicts.velocity[0], verdicts.verdict[0] = velocity, Verdict.UNSTABLE
        return False

    def _under(self, friction: float) -> KernelArrays:
        """Return the structure with another coefficient of friction, each point's own changed as by `at_friction`."""
        if friction == self.assembly.friction:
            return self._structure
        if self.assembly.joints is None and self.assembly.contacts.lean is None:
            coefficients = np.full(self.problem.points, friction)
            coefficients.setflags(write=False)  # as the kernels are compiled for
            return self._structure._replace(friction=coefficients)
        strength = strength_of(self.assembly.at_friction(friction), self.settings.gravity)
        return self._structure._replace(**strength_arrays(self.problem, strength))  # type: ignore[arg-type]

    def _whitened(self, extra: Array) -> Array:
        """Return the weights with additional wrenches, shape (parts, 6), as the kernels of equilibrium have them."""
        return np.einsum("prc,pc->pr", self.problem.whitening, self.problem.gravity_wrench + extra, order="C")

    def _offsets(self, moved: Array) -> Array:
        """Return the scaled spring forces that displaced fixed parts cause at contact points, shape (points, 3)."""
        problem, law = self.problem, self._contact
        assert law is not None
        relative = (problem.wrench.T @ moved.ravel()).reshape(-1, 3)
        stiffness = np.stack([law.normal, law.tangential, law.tangential], axis=1)
        # Scaled springs act on relative displacements times `force_scale`, in units of `scale`.
        return -stiffness * relative * (problem.force_scale / law.scale)[:, None]

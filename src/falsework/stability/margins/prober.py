"""Equilibrium of single states of one structure under modified friction and additional loads."""

from __future__ import annotations

import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.stability.certificate import (
    residual_bound_of_velocity,
    resistance_to_velocity,
    verify_certificates,
)
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
    from falsework.stability.contact.history import History

Array = NDArray[np.float64]

_ABOVE = 2.0
"""Multiple of the tolerance that the proof of a velocity must exceed to cut off a load: so it also proves a tilt, which
is the same load made smaller. The bound moves by less than a thousandth."""
_MANY, _RARELY = 4000, 20
"""Iterations in which a large load is balanced by itself, and those between two tests."""


class Prober:
    """Solver of single states under conditions; it may be used from several threads.

    Of the criterion `equilibrium`, and base of that of the other one, `ContactProber`.
    """

    convex = True
    """Whether a state that is stable at two values of a family is stable between them."""

    def __init__(self, assembly: Assembly, solver: CpuSolver) -> None:
        """Share settings and layout of a solver of the structure."""
        self.assembly, self.settings, self.problem = assembly, solver.settings, solver.problem
        self.criterion, self.displaced = solver.criterion, solver.displaced
        self._structure = solver.structure
        self._options = kernel_options(self.settings)
        self._end = np.inf

    @property
    def scales(self) -> bool:
        """Whether forces that balance the weights balance any multiple of them."""
        return self.assembly.loads is None and self.assembly.joints is None

    def as_built(self, history: History) -> Prober:
        """Return a prober of a state with the history of its contacts, of which forces in equilibrium know nothing."""
        return self

    def until(self, end: float) -> Prober:
        """Return a prober that raises `OutOfTime` from a time on, as `time.perf_counter` counts it."""
        prober = copy(self)
        prober._end = end
        return prober

    def check_time(self) -> None:
        """Raise `OutOfTime` if the time of this prober is over."""
        if time.perf_counter() > self._end:
            raise OutOfTime

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
            near: the answer under a nearby condition, for a warm start.
            moved: where displacements are part of the proof, those of fixed parts, shape (parts, 6), m and rad.
            coarse: whether states that rest need not be found if iterations from the nearby answer do not end there.

        Raises:
            OutOfTime: the time of this prober is over.
        """
        self.check_time()
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

    def ask_each(self, state: States, conditions: Sequence[Condition], near: Sequence[Answer]) -> list[Answer]:
        """Check a state under conditions with the same friction, until it fails under one; not from rest.

        Args:
            state: shape (parts,).
            near: for each the stable answer under a nearby condition.
        """
        answers: list[Answer] = []
        for condition, start in zip(conditions, near, strict=True):
            answers.append(self.ask(state, condition, start))
            if not answers[-1].stands:
                break
        return answers

    def refine(self, state: States, answer: Answer) -> Answer:
        """Continue the iterations of an answer from where they ended undecided, if they did."""
        return answer

    def contact_wrench(self, state: States, forces: Array) -> Array:
        """Return the wrenches of contact forces, N, shape (points, 3), on all parts, N and Nm, shape (parts, 6)."""
        active = self.problem.active(state[None])[0]
        return self.problem.geometry.wrenches(np.where(active[:, None], forces, 0.0)[None])[0]

    def forces(self, state: States, answer: Answer) -> Array:
        """Return the contact forces of a stable answer, N, shape (points, 3)."""
        assert answer.forces is not None
        return answer.forces

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

        A state that fails is unstable if a velocity proves it. Else, where displacements are part of the proof, it
        slides if parts were seen to move away, and comes with forces in equilibrium.

        Args:
            state: shape (parts,).
            near: verdict under a nearby condition, whose forces are a first guess.
        """
        verdicts = self.problem.undecided(1, displaced=self.displaced)
        assert verdicts.forces is not None
        verdicts.decided_by[:] = Solver.CPU
        if answer.stands:
            verdicts.forces[0], verdicts.verdict[0] = self.forces(state, answer), Verdict.STABLE
            if verdicts.displacement is not None:
                verdicts.displacement[0] = answer.displacement
        else:
            failed = answer
            if failed.velocity is None:
                forces = None if near is None or near.forces is None else near.forces[0]
                failed = self.balance(state, answer.condition, replace(answer, forces=forces))
            if failed.velocity is not None and verdicts.velocity is not None:
                verdicts.velocity[0], verdicts.verdict[0] = failed.velocity, Verdict.UNSTABLE
            elif failed.forces is not None and self.displaced:
                verdicts.forces[0] = failed.forces
                if not answer.moves_away:
                    return verdicts
                verdicts.verdict[0] = Verdict.SLIDES
        verdicts.proof[:] = proof_of(verdicts.verdict, self.criterion)
        changed = answer.condition.applied_to(self.assembly)
        if not verify_certificates(changed, state[None], verdicts, self.settings.claim)[0]:
            exact = self.exact(state, answer.condition)
            if exact.unstable[0] or not self.displaced:
                verdicts.put(np.array([0]), exact)
            else:
                verdicts.verdict[0] = Verdict.UNDECIDED
        return verdicts

    def exact(self, state: States, condition: Condition) -> Verdicts:
        """Return the verdict of the exact solver on a state under a condition."""
        settings = replace(self.settings, criterion="equilibrium", cone=self.settings.friction_cone)
        return ExactSolver(condition.applied_to(self.assembly), settings).check(state)

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

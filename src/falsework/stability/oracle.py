"""Stability oracle: batches, cache, warm starts, and the exact solver for undecided states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.state import States, as_states
from falsework.errors import InputError
from falsework.stability.cache import VerdictCache, unique_rows, unique_states
from falsework.stability.certificate import verify_certificates
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.counters import Counters
from falsework.stability.cpu.solver import LEFT_OPEN, CpuSolver
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.margins.margins import QUICK, MarginFinder
from falsework.stability.margins.prober import Prober
from falsework.stability.margins.state_margins import StateMargins
from falsework.stability.optional_solvers import gpu_solver, gurobi_solver
from falsework.stability.problem import build_problem
from falsework.stability.second_order.growing_motion import SecondOrder
from falsework.stability.settings import StabilitySettings
from falsework.stability.state_memory import Guesses, WholeMemory, remembered_forces
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

if TYPE_CHECKING:
    from falsework.stability.reference.clarabel import ExactSolver

_BATCH = 32 * 1024 * 1024
"""Memory for contact forces or displacements of one batch, bytes."""
_WORTH_A_GPU = 8
"""States from which `auto` uses the GPU: a launch costs as much as a few states on the CPU."""
_LOOKED_AT = 64
"""States whose proofs are in memory at the same time while they are looked at more closely."""


class Stability:
    """Stability oracle of one structure, with proofs.

    One object serves one structure under one set of settings. It caches verdicts, so reuse it instead of making a
    new one.
    """

    def __init__(self, assembly: AnyStructure, settings: StabilitySettings = StabilitySettings()) -> None:
        assembly = as_assembly(assembly)
        if settings.criterion == "equilibrium" and assembly.joints is not None and assembly.joints.setting:
            raise InputError("joints that set need the criterion contact; equilibrium has no steps")
        self.assembly, self.settings, self._contact = assembly, settings, settings.criterion == "contact"
        self.problem = build_problem(
            assembly, cone=settings.friction_cone, gravity=settings.gravity, reserve=settings.reserve
        )
        self._gurobi = gurobi_solver(assembly, settings, self.problem)
        self.counters = Counters()
        self._cpu, self._gpu = self._make_cpu(), gpu_solver(assembly, settings, self.problem)
        self._cache = VerdictCache(holds_keep_stable=not self._contact)
        self._guess_shape = (self.problem.parts, 6) if self._contact else (self.problem.points, 3)
        memory = WholeMemory(self._guess_bytes) if self._contact else remembered_forces(self.problem.points)
        self._guesses = Guesses(memory, assembly.boundary, holds_keep_stable=not self._contact)

    @cached_property
    def exact(self) -> ExactSolver:
        """Exact solver for states that the others leave undecided; most searches never need it."""
        if self._gurobi is not None:
            return self._gurobi
        from falsework.stability.reference.clarabel import ExactSolver

        return ExactSolver(self.assembly, self.settings, self.problem)

    @property
    def holds_keep_stable(self) -> bool:
        """Whether a stable state stays stable when a part is held: under `equilibrium`, not under `contact`."""
        return not self._contact

    @cached_property
    def replayer(self) -> Replayer | None:
        """Replayer of state sequences of the structure; None under `equilibrium`, which has no history."""
        if not isinstance(self._cpu, ContactSolver):
            return None
        return Replayer(self.assembly, self.settings, solver=self._cpu)

    def check(self, states: ArrayLike) -> Verdicts:
        """Check states and return verdicts with certificates, each verified by the certificate checker.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)`; 0 removed, 1 installed, 2 held.

        Returns:
            Verdicts with forces, velocity and, under `contact`, displacement; a batch of one for one state.

        Raises:
            StateError: states of the wrong length or with other values.
        """
        batch = as_states(states, self.assembly.boundary)
        self.counters.asked += len(batch)
        unique, back = unique_states(batch)
        solver = self._choose(len(unique))
        if solver is None:
            verdicts = self.exact.check(unique)
        else:
            verdicts = solver.check(unique, certificates=True)
            # A GPU may stop at residuals above the resolution; they are proofs where no solver finds better ones.
            accepted = self._accept(unique, verdicts)
            rough = np.flatnonzero(accepted & verdicts.stable & (verdicts.residual > self.settings.resolution))
            kept = verdicts[rough]
            accepted[rough] = False
            rest = np.flatnonzero(~accepted)
            if len(rest) and solver is self._gpu and self._cpu is not None:
                again = self._cpu.check(unique[rest], certificates=True)
                verdicts.put(rest, again)
                rest = rest[~self._accept(unique[rest], again)]
            if len(rest):
                verdicts.put(rest, self._decide_exactly(unique[rest], verdicts[rest]))
            lost = verdicts.undecided[rough]
            verdicts.put(rough[lost], kept[lost])
            self._look_closer(unique, verdicts)
        verdicts.on_tolerance[:] = self.settings.claim.on_tolerance(verdicts)
        self._count(verdicts)
        self._cache.store(unique, verdicts.verdict, verdicts.residual)
        self.counters.cached += len(batch) - len(unique)
        return replace(verdicts[back], assembly=self.assembly, states=batch)

    def check_beside(self, state: States, neighbours: States) -> Verdicts:
        """Check a state from the displacements of neighbouring states where none is found from rest.

        Under `contact` a state may have several rest positions, and iterations from rest may
        miss them all. Each one is a proof.

        Args:
            state: shape (parts,).
            neighbours: states before and after it in a plan, shape (batch, parts).

        Returns:
            A batch of one: the first stable verdict, else the one from rest.
        """
        verdict = self.check(state)
        for neighbour in neighbours[(neighbours != state).any(axis=1)]:
            if not verdict.stable[0]:
                verdict = self.check_next(state[None], neighbour[None], self.check(neighbour))
        return verdict

    def check_again(self, states: States) -> Verdicts:
        """Check states `(batch, parts)` from the displacements or forces by which `judge` found them stable.

        Returns:
            Stable verdicts with certificates, or that a state tips; undecided where none are stored or they no longer
            prove the state.
        """
        found = Verdicts.blank(
            len(states), points=self.problem.points, parts=self.problem.parts, displaced=self._contact
        )
        stored = {row: guess for row, state in enumerate(states) if (guess := self._guesses.of(state)) is not None}
        if self._cpu is None or not stored or self._choose(len(stored)) is not self._cpu:
            return found
        rows, guess = np.array(list(stored)), np.array(list(stored.values()), dtype=np.float64)
        again = self._cpu.check(states[rows], parents=states[rows], guess=guess)
        good = again.stable & self._accept(states[rows], again)
        self._look_closer(states[rows[good]], proven := again[good])
        self._put(states[rows[good]], proven)
        found.put(rows[good], proven)
        return found

    def check_next(self, states: States, before: States, known: Verdicts) -> Verdicts:
        """Check states `(batch, parts)` first from the displacements, or forces, `known` of their predecessors."""
        proof = known.displacement if self._contact else known.forces
        if self._cpu is None or proof is None or self._choose(len(states)) is not self._cpu:
            return self.check(states)
        guess = np.where(known.stable[:, None, None], proof, np.nan if self._contact else 0.0)
        found = self._cpu.check(states, parents=before, guess=guess)
        good = found.stable & self._accept(states, found)
        self._look_closer(states, found)
        good &= found.stable
        self._put(states[good], found[good])
        if not good.all():
            found.put(np.flatnonzero(~good), self.check(states[~good]))
        return found

    def judge(self, states: ArrayLike, *, parents: ArrayLike | None = None) -> Verdicts:
        """Check states without certificates, from the cache if possible.

        Every verdict is based on a proof found in float64; the cache keeps the verdict, not the proof. Whether a state
        tips is not asked here, see `keeps`; one that is known to tip is not stable.

        Args:
            states: shape (batch, parts).
            parents: for each state a stable one that differs from it in few parts, such as its predecessor. Its forces
                are the initial guess, and a mechanism is sought near the difference first. What is left undecided in
                structures of 1,000 parts and more stays so, without the exact solver. Shape (batch, parts).

        Returns:
            Verdicts without certificates.

        Raises:
            StateError: states of the wrong length or with other values.
        """
        batch = as_states(states, self.assembly.boundary)
        if self.problem.strength.idle.any():  # which the kernels take to bear pressure: only proofs count
            return self.check(batch).without_certificates()
        self.counters.asked += len(batch)
        verdicts = Verdicts.blank(len(batch))
        verdict, residual, by_monotonicity = self._cache.look_up(batch)
        verdicts.verdict[:], verdicts.residual[:] = verdict, residual
        verdicts.decided_by[:] = np.where(verdict != 0, Solver.RULE, Solver.NONE)
        self.counters.by_monotonicity += int(by_monotonicity.sum())
        self.counters.cached += int(((verdict != 0) & ~by_monotonicity).sum())
        origins = None if parents is None else as_states(parents, self.assembly.boundary)
        if origins is not None:
            self._guesses.pass_on(batch[verdict == Verdict.STABLE], origins[verdict == Verdict.STABLE])
        rest = np.flatnonzero(verdict == 0)
        if len(rest):
            first, back = unique_rows(batch[rest])
            rows = rest[first]
            solved = self._solve(batch[rows], None if origins is None else origins[rows])
            self._count(solved)
            self._cache.store(batch[rows], solved.verdict, solved.residual)
            self.counters.cached += len(rest) - len(rows)
            verdicts.put(rest, solved[back])
        verdicts.proof[:] = proof_of(verdicts.verdict, self.settings.criterion)
        verdicts.on_tolerance[:] = self.settings.claim.on_tolerance(verdicts)
        return verdicts

    def margins(
        self, states: ArrayLike, kinds: Sequence[str] | None = None, *, deadline: float | None = None
    ) -> list[StateMargins]:
        """Return how far friction, tilt, loads and pushes are from the limit of stability.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)`.
            kinds: margins to compute; by default all but the polygon of tilts and the settlement of supports.
            deadline: seconds after which searches return what they have proven, see `StateMargins.unfinished`.

        Returns:
            One object per state, each value with a certificate on both sides of its bound.

        Raises:
            InputError: a margin that is not defined under the criterion, or a deadline of zero or less.
            StateError: states of the wrong length or with other values.
        """
        return self._margins.of(states, QUICK if kinds is None else kinds, deadline=deadline)

    @cached_property
    def _second_order(self) -> SecondOrder | None:
        return SecondOrder(self.assembly, self.settings.claim) if self._contact else None

    @cached_property
    def prober(self) -> Prober:
        """Solver of single states under modified friction and additional loads, which count from the true friction."""
        if self.settings.reserve != 1.0:
            return Stability(self.assembly, replace(self.settings, reserve=1.0)).prober
        return Prober(self.assembly, self.problem, self.settings, self._cpu)

    @cached_property
    def _margins(self) -> MarginFinder:
        return MarginFinder(self.prober)

    def stable(self, states: ArrayLike, *, parents: ArrayLike | None = None) -> NDArray[np.bool_]:
        """Return whether states are proven stable; arguments as for `judge`. Shape (batch,)."""
        return self.judge(states, parents=parents).stable

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states a replay may find at rest: those without a proven mechanism near where they differ.

        Args:
            states: shape (batch, parts).
            parents: states at rest one move away, shape (batch, parts).
        """
        self.counters.asked += len(states)
        verdict, residual, _ = self._cache.look_up(states)
        rest = np.flatnonzero(verdict == 0)
        if len(rest) and isinstance(self._cpu, ContactSolver):
            falls = self._cpu.falls(states[rest], parents[rest])
            self.counters.cpu += int(falls.sum())
            verdict[rest[falls]] = Verdict.UNSTABLE
            self._cache.store(states[rest[falls]], verdict[rest[falls]], residual[rest[falls]])
        return verdict != Verdict.UNSTABLE

    def settle(self, states: States, residual: NDArray[np.float64]) -> Verdicts:
        """Decide states that a GPU left undecided.

        Under `contact` the CPU solver, whose iterations are the same, is only called if its iteration limit is higher.
        Under both criteria the exact solver comes last.

        Args:
            states: checked states, shape (batch, parts).
            residual: residuals found on the GPU, shape (batch,).

        Returns:
            Verdicts without certificates.
        """
        verdicts = Verdicts.blank(len(states))
        verdicts.residual[:] = residual
        rest = np.arange(len(states))
        steps = self.settings.gpu.contact_steps, self.settings.cpu.contact_steps
        if isinstance(self._cpu, ContactSolver) and steps[0] < steps[1]:
            verdicts = self._cpu.check(states, certificates=False)
            rest = np.flatnonzero(verdicts.undecided)
        if len(rest):
            verdicts.put(rest, self._decide_exactly(states[rest], verdicts[rest]))
        return verdicts.without_certificates()

    def _look_closer(self, states: States, verdicts: Verdicts) -> None:
        if self._second_order is not None:
            self._second_order.revise(states, verdicts)

    def _accept(self, states: States, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return whether the checker accepts each verdict; count the rejected ones."""
        accepted = verify_certificates(self.assembly, states, verdicts, self.settings.claim)
        self.counters.rejected += int((~accepted & ~verdicts.undecided).sum())
        return accepted

    def _make_cpu(self) -> CpuSolver | ContactSolver | None:
        """Return the CPU solver if the settings ask for it and it knows all contacts, and always under `contact`."""
        if self._contact:
            return ContactSolver(self.assembly, self.problem, self.settings)
        known = self.settings.solver in ("auto", "cpu") and not self.problem.strength.idle.any()
        return CpuSolver(self.problem, self.settings) if known else None

    def _decide_exactly(self, states: States, verdicts: Verdicts) -> Verdicts:
        """Return verdicts of the exact solver; under `contact` it only tells unstable from in equilibrium.

        Args:
            states: shape (batch, parts).
            verdicts: verdicts of the solver that left them undecided.
        """
        # Where equilibrium is proven and no rest position was found, the exact solver has nothing to add.
        rows = np.flatnonzero(~(self._contact & verdicts.undecided & (verdicts.residual <= self.settings.tolerance)))
        decided = verdicts[np.arange(len(verdicts))]
        if not len(rows):
            return decided
        exact = self.exact.check(states[rows])
        if self._contact:
            # Equilibrium does not imply stability here: states that the contact solver left undecided stay undecided.
            slides = exact.stable & (verdicts.slides[rows] | np.isposinf(verdicts.residual[rows]))
            exact.verdict[exact.stable & ~slides] = Verdict.UNDECIDED
            exact.verdict[slides] = Verdict.SLIDES
            exact.proof[:] = proof_of(exact.verdict, self.settings.criterion)
        elif exact.forces is not None:  # the next states start from them
            self._guesses.remember(states[rows[exact.stable]], exact.forces[exact.stable])
        decided.put(rows, exact)
        return decided

    @property
    def _guess_bytes(self) -> int:
        """Return the bytes of the guess for one state in float64."""
        return 8 * self._guess_shape[0] * self._guess_shape[1]

    def _choose(self, count: int) -> CpuSolver | ContactSolver | GpuSolver | None:
        """Choose the solver for a batch of this size; None for the exact solver."""
        if self._gpu is not None and (self.settings.solver == "gpu" or count >= _WORTH_A_GPU):
            return self._gpu
        return self._cpu

    def _solve(self, states: States, parents: States | None) -> Verdicts:
        solver = self._choose(len(states))
        if solver is None:
            return self.exact.check(states).without_certificates()
        verdicts = Verdicts.blank(len(states))
        # Look up the parents first: storing the results of their children may evict them.
        known = [None] * len(states) if parents is None else [self._guesses.of(parent) for parent in parents]
        size, guess = max(_BATCH // max(self._guess_bytes, 1), 16), None
        for first in range(0, len(states), size):
            rows = np.arange(first, min(first + size, len(states)))
            if parents is not None and not (solver is self._gpu and self._contact):
                guess = np.full((len(rows), *self._guess_shape), np.nan if self._contact else 0.0)
                for row, start in zip(range(len(rows)), known[first : first + size], strict=True):
                    if start is not None:
                        guess[row] = start
                        self.counters.warm += 1
            if solver is self._cpu and self._cpu is not None:
                near = None if parents is None else parents[rows]
                solved = self._cpu.check(states[rows], certificates=False, parents=near, guess=guess)
            else:
                solved = solver.check(states[rows], certificates=False, guess=guess)
            if guess is not None:
                self._guesses.remember(states[rows][solved.stable], guess[solved.stable])
            verdicts.put(rows, solved)
        rest = np.flatnonzero(verdicts.verdict == Verdict.UNDECIDED)
        if len(rest) and solver is self._gpu:
            verdicts.put(rest, self.settle(states[rest], verdicts.residual[rest]))
        elif len(rest) and (parents is None or self.problem.parts < LEFT_OPEN):
            verdicts.put(rest, self._decide_exactly(states[rest], verdicts[rest]))
        return verdicts

    def _put(self, states: States, verdicts: Verdicts) -> None:
        """Count checked verdicts and store them in the cache."""
        self.counters.asked += len(states)
        self._count(verdicts)
        self._cache.store(states, verdicts.verdict, verdicts.residual)

    def _count(self, verdicts: Verdicts) -> None:
        self.counters.cpu += int((verdicts.decided_by == Solver.CPU).sum())
        self.counters.gpu += int((verdicts.decided_by == Solver.GPU).sum())
        self.counters.exact += int(np.isin(verdicts.decided_by, (Solver.EXACT, Solver.GUROBI)).sum())
        self.counters.undecided += int(verdicts.undecided.sum())

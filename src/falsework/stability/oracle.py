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
from falsework.errors import InputError, StateError
from falsework.stability.cache import VerdictCache, unique_rows
from falsework.stability.certificate import chunks, verify_certificates
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.contact.varied_replay import EnsembleReplayer
from falsework.stability.counters import Counters
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.margins.margins import QUICK, MarginFinder
from falsework.stability.margins.prober import Prober
from falsework.stability.margins.state_margins import StateMargins
from falsework.stability.problem import Problem, build_problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.state_memory import Guesses
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.stability.exact_solver import ExactSolver


class StabilityOracle:
    """Stability oracle of one structure, with proofs.

    One object serves one structure under one set of settings. It caches verdicts, so reuse it instead of making a
    new one.
    """

    def __init__(self, assembly: AnyStructure, settings: StabilitySettings = StabilitySettings()) -> None:
        assembly = as_assembly(assembly)
        self.assembly, self.settings = assembly, settings
        self.problem = build_problem(
            assembly, cone=settings.friction_cone, gravity=settings.gravity, reserve=settings.reserve
        )
        self.counters = Counters()
        if contact := settings.criterion == "contact":
            self._criterion: CpuSolver = ContactSolver(assembly, self.problem, settings)
        elif assembly.joints is not None and assembly.joints.setting:
            raise InputError("joints that set need the criterion contact; equilibrium has no steps")
        else:
            self._criterion = CpuSolver(self.problem, settings)
        known = contact or (settings.solver in ("auto", "cpu") and not self.problem.strength.idle.any())
        self._cpu = self._criterion if known else None
        """Solver on the CPU; None where the exact solver is asked for, or the only one that knows all contacts."""
        self._gpu = gpu_solver(assembly, settings, self.problem)
        keep = self._criterion.holds_keep_stable
        self._cache = VerdictCache(holds_keep_stable=keep)
        self.guesses = Guesses(self._criterion.no_guess(1)[0], assembly.boundary, holds_keep_stable=keep)

    @cached_property
    def exact(self) -> ExactSolver:
        """Exact solver for states that the others leave undecided; most searches never need it."""
        from falsework.stability.exact_solver import ExactSolver

        return ExactSolver(self.assembly, self.settings, self.problem)

    @property
    def holds_keep_stable(self) -> bool:
        """Whether a stable state stays stable when a part is held: under `equilibrium`, not under `contact`."""
        return self._criterion.holds_keep_stable

    @cached_property
    def replayer(self) -> Replayer | None:
        """Replayer of state sequences of the structure; None under `equilibrium`, which has no history.

        With a reserve it is an `EnsembleReplayer`.
        """
        if not isinstance(self._criterion, ContactSolver):
            return None
        kind = EnsembleReplayer if self.settings.reserve > 1.0 else Replayer
        return kind(self.assembly, self.settings, solver=self._criterion)

    def verdicts(
        self, states: ArrayLike, *, near: ArrayLike | None = None, require_certificate: bool = False
    ) -> Verdicts:
        """Return verdicts on states, each based on a proof that was found in float64.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)`; 0 removed, 1 installed, 2 held.
            near: for each state a stable one that differs from it in few parts, such as its predecessor in a plan,
                or itself. What was found of that one is the first guess, and a mechanism is sought near the difference
                first. Same shape.
            require_certificate: return forces, velocity and, under `contact`, displacement, each accepted by the
                certificate checker, and whether a stable state tips. Else verdicts come from the cache if possible,
                which keeps no certificates, and only a state that is known to tip is not stable for that.

        Returns:
            Verdicts; a batch of one for one state.

        Raises:
            StateError: states of the wrong length or with other values, or not as many near ones.
        """
        batch = as_states(states, self.assembly.boundary)
        origins = None if near is None else as_states(near, self.assembly.boundary)
        if origins is not None and len(origins) != len(batch):
            raise StateError(f"{len(origins)} near states do not fit {len(batch)} states; give one for each")
        self.counters.asked += len(batch)
        if require_certificate:
            verdicts = self._certify(batch, origins)
        elif self.problem.strength.idle.any():  # which the kernels take to bear pressure: only certificates count
            verdicts = self._certify(batch, origins).without_certificates()
        else:
            verdicts = self._recall(batch, origins)
        verdicts.on_tolerance[:] = self.settings.claim.on_tolerance(verdicts)
        return replace(verdicts, assembly=self.assembly, states=batch) if require_certificate else verdicts

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
        return self._margins.margins(states, QUICK if kinds is None else kinds, deadline=deadline)

    @cached_property
    def prober(self) -> Prober:
        """Solver of single states under modified friction and additional loads, which count from the true friction."""
        if self.settings.reserve != 1.0:
            return StabilityOracle(self.assembly, replace(self.settings, reserve=1.0)).prober
        return Prober(self.assembly, self.settings, self._criterion)

    @cached_property
    def _margins(self) -> MarginFinder:
        return MarginFinder(self.prober)

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states a replay may find at rest: those without a proven mechanism near where they differ.

        Args:
            states: shape (batch, parts).
            parents: states at rest one move away, shape (batch, parts).
        """
        self.counters.asked += len(states)
        verdict, residual, _ = self._cache.look_up(states)
        rest = np.flatnonzero(verdict == 0)
        if len(rest):
            falls = self._criterion.falls(states[rest], parents[rest])
            self.counters.cpu += int(falls.sum())
            verdict[rest[falls]] = Verdict.UNSTABLE
            self._cache.store(states[rest[falls]], verdict[rest[falls]], residual[rest[falls]])
        return verdict != Verdict.UNSTABLE

    def keeps(self, states: ArrayLike) -> NDArray[np.bool_]:
        """Return whether states keep the margins that are demanded, none here. Shape (batch,)."""
        return np.ones(len(as_states(states, self.assembly.boundary)), dtype=bool)

    def _certify(self, states: States, near: States | None) -> Verdicts:
        """Return verdicts with certificates: from what is remembered of states or of near ones, else from rest.

        What is found of one state serves others of the batch that it is near to.
        """
        first, back = unique_rows(states)
        unique = states[first]
        verdicts = self.problem.undecided(len(unique), displaced=self._criterion.displaced)
        left, origins = np.arange(len(unique)), np.empty_like(unique)
        if near is not None:
            origins[back] = near
        starts_near = near is not None and self._choose(len(unique)) is self._cpu is not None
        while len(left):
            begun, found = left[:0], None
            if starts_near:
                begun, found = self._certify_from_memory(unique, origins, left)
            if found is not None:
                verdicts.put(begun, found)
                rest = begun[~found.stable]
            else:
                begun = rest = _roots(unique, origins, left) if starts_near else left
            if len(rest):
                verdicts.put(rest, self._certify_from_rest(unique[rest]))
                self._remember(unique[rest], verdicts[rest])
            left = np.setdiff1d(left, begun, assume_unique=True)
        self._count(verdicts)
        self._cache.store(unique, verdicts.verdict, verdicts.residual)
        self.counters.cached += len(states) - len(unique)
        return verdicts[back]

    def _certify_from_memory(
        self, states: States, near: States, rows: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], Verdicts | None]:
        """Return those of some rows of which, or of whose near states, something is remembered, and their verdicts."""
        own = {row: guess for row in rows if (guess := self.guesses.get(states[row])) is not None}
        others = [row for row in rows if row not in own]
        new = {row: guess for row in others if (guess := self.guesses.get(near[row])) is not None}
        known = own | new
        chosen = np.array(list(known), dtype=np.intp)
        if self._cpu is None or not known:
            return chosen, None
        origins = np.concatenate([states[list(own)], near[list(new)]])
        guess = np.array(list(known.values()), dtype=np.float64)
        found = self._cpu.check(states[chosen], parents=origins, guess=guess)
        found.verdict[~(found.stable & self._accept(states[chosen], found))] = Verdict.UNDECIDED
        self._criterion.refine_undecided(states[chosen], found)
        self.counters.warm += len(chosen)
        self._remember(states[list(new)], found[len(own) :])
        return chosen, found

    def _certify_from_rest(self, states: States) -> Verdicts:
        """Return verdicts with certificates on distinct states, of which nothing is known."""
        solver, cpu = self._choose(len(states)), self._cpu
        if solver is None:
            return self.exact.check(states)
        verdicts = solver.check(states, certificates=True)
        # A GPU may stop at residuals above the resolution; they are proofs where no solver finds better ones.
        accepted = self._accept(states, verdicts)
        rough = np.flatnonzero(accepted & verdicts.stable & (verdicts.residual > self.settings.resolution))
        kept = verdicts[rough]
        accepted[rough] = False
        rest = np.flatnonzero(~accepted)
        if len(rest) and solver is self._gpu and cpu is not None:
            again = cpu.check(states[rest], certificates=True)
            verdicts.put(rest, again)
            rest = rest[~self._accept(states[rest], again)]
        if len(rest):
            verdicts.put(rest, self._decide_exactly(states[rest], verdicts[rest]))
        lost = verdicts.undecided[rough]
        verdicts.put(rough[lost], kept[lost])
        self._criterion.refine_undecided(states, verdicts)
        return verdicts

    def _recall(self, states: States, near: States | None) -> Verdicts:
        """Return verdicts without certificates, from the cache if possible."""
        verdicts = Verdicts.all_undecided(len(states))
        verdict, residual, by_monotonicity = self._cache.look_up(states)
        verdicts.verdict[:], verdicts.residual[:] = verdict, residual
        verdicts.decided_by[:] = np.where(verdict != 0, Solver.RULE, Solver.NONE)
        self.counters.by_monotonicity += int(by_monotonicity.sum())
        self.counters.cached += int(((verdict != 0) & ~by_monotonicity).sum())
        if near is not None:
            self.guesses.pass_on(states[verdict == Verdict.STABLE], near[verdict == Verdict.STABLE])
        rest = np.flatnonzero(verdict == 0)
        if len(rest):
            first, back = unique_rows(states[rest])
            rows = rest[first]
            solved = self._solve(states[rows], None if near is None else near[rows])
            self._count(solved)
            self._cache.store(states[rows], solved.verdict, solved.residual)
            self.counters.cached += len(rest) - len(rows)
            verdicts.put(rest, solved[back])
        verdicts.proof[:] = proof_of(verdicts.verdict, self.settings.criterion)
        return verdicts

    def _solve(self, states: States, near: States | None) -> Verdicts:
        """Return verdicts without certificates on distinct states that are not in the cache."""
        solver = self._choose(len(states))
        if solver is None:
            return self.exact.check(states).without_certificates()
        verdicts = Verdicts.all_undecided(len(states))
        # Look up the near states first: storing what is found may evict them.
        known = [None] * len(states) if near is None else [self.guesses.get(origin) for origin in near]
        each = np.arange(len(states))  # a GPU divides them itself
        for rows in [each] if solver is self._gpu else chunks(each, self.problem.points, 16):
            origins = guess = None
            if near is not None and solver.starts_from_guesses:
                origins, guess = near[rows], self._criterion.no_guess(len(rows))
                for row, start in enumerate(known[rows[0] : rows[-1] + 1]):
                    if start is not None:
                        guess[row] = start
                        self.counters.warm += 1
            solved = solver.check(states[rows], certificates=False, parents=origins, guess=guess)
            if guess is not None:
                self.guesses.remember(states[rows][solved.stable], guess[solved.stable])
            verdicts.put(rows, solved)
        rest = np.flatnonzero(verdicts.undecided)
        if len(rest) and solver is self._gpu and self._cpu is not None:
            verdicts.put(rest, self._cpu.check(states[rest], certificates=False))
            rest = rest[verdicts.undecided[rest]]
        if len(rest):
            joined = states[rest] if near is None else self.problem.hold_apart(states[rest], near[rest])
            exact = self._decide_exactly(joined, verdicts[rest])
            self._remember(states[rest], exact, joined, [known[row] for row in rest])
            verdicts.put(rest, exact)
        return verdicts

    def _remember(
        self,
        states: States,
        verdicts: Verdicts,
        joined: States | None = None,
        origins: Sequence[NDArray[np.float64] | None] = (),
    ) -> None:
        """Remember the certificates of stable states, from which others start.

        Verdicts on `joined`, see `Problem.hold_apart`, are completed by those of the states near by, where known.
        """
        guess = self._criterion.guess_of(verdicts)
        if guess is None:
            return
        whole = verdicts.stable.copy()
        for row in np.flatnonzero(whole) if joined is not None else []:
            if (joined[row] == states[row]).all():
                continue
            start, whole[row] = origins[row], origins[row] is not None
            if start is not None and not self._criterion.displaced:
                kept = self.problem.active(states[row : row + 1])[0] & ~self.problem.active(joined[row : row + 1])[0]
                guess[row, kept] = start[kept]
        self.guesses.remember(states[whole], guess[whole])

    def _accept(self, states: States, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return whether the checker accepts each verdict; count the rejected ones."""
        accepted = verify_certificates(self.assembly, states, verdicts, self.settings.claim)
        self.counters.rejected += int((~accepted & ~verdicts.undecided).sum())
        return accepted

    def _decide_exactly(self, states: States, verdicts: Verdicts) -> Verdicts:
        """Return verdicts of the exact solver.

        Args:
            states: shape (batch, parts).
            verdicts: verdicts of the solver that left them undecided.
        """
        decided, rows = verdicts[np.arange(len(verdicts))], np.flatnonzero(self._criterion.is_left_to_exact(verdicts))
        if len(rows):
            exact = self.exact.check(states[rows])
            self._criterion.read_exact(exact, verdicts[rows])
            decided.put(rows, exact)
        return decided

    def _choose(self, count: int) -> CpuSolver | GpuSolver | None:
        """Choose the solver for a batch of this size; None for the exact solver."""
        if self._gpu is not None and (self.settings.solver == "gpu" or count >= self.settings.numerics.gpu_states):
            return self._gpu
        return self._cpu

    def _count(self, verdicts: Verdicts) -> None:
        self.counters.cpu += int((verdicts.decided_by == Solver.CPU).sum())
        self.counters.gpu += int((verdicts.decided_by == Solver.GPU).sum())
        self.counters.exact += int((verdicts.decided_by == Solver.EXACT).sum())
        self.counters.undecided += int(verdicts.undecided.sum())


def _roots(states: States, near: States, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the rows whose near state is none of the others; all if there are none."""
    asked = {states[row].tobytes(): row for row in rows}
    first = [row for row in rows if asked.get(near[row].tobytes(), row) == row]
    return np.array(first, dtype=np.intp) if first else rows


def gpu_solver(assembly: Assembly, settings: StabilitySettings, problem: Problem) -> GpuSolver | None:
    """Return the GPU solver if the settings ask for it; with `auto`, only where there is a GPU."""
    if settings.solver not in ("auto", "gpu"):
        return None
    try:
        return GpuSolver(assembly, problem, settings)
    except InputError:  # no torch, no bindings or no device
        if settings.solver == "gpu":
            raise
        return None

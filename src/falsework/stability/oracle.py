"""Stability oracle: batches, cache, warm starts, and the exact solver for undecided states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.state import States, as_states
from falsework.errors import StateError
from falsework.stability.cache import VerdictCache, root_rows, unique_rows
from falsework.stability.certificate import chunks, verify_certificates
from falsework.stability.cpu.solver import TASK, CpuSolver
from falsework.stability.criteria import CRITERIA
from falsework.stability.gpu.solver import GpuSolver, gpu_solver
from falsework.stability.margins.margins import QUICK, MarginFinder
from falsework.stability.margins.state_margins import StateMargins
from falsework.stability.problem import build_problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.state_memory import Guesses
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of
from falsework.utils.interruption import check_interruption, pieces

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.contact.replay import Replayer
    from falsework.stability.exact_solver import ExactSolver
    from falsework.stability.margins.prober import Prober


@dataclass
class Counters:
    """Numbers of queries to the oracle, by the solver that answered."""

    asked: int = 0
    """Number of requested states, repetitions included."""
    cached: int = 0
    """Number of states answered from the cache."""
    by_monotonicity: int = 0
    """Number of states answered by monotonicity: the proof of another state holds for them too."""
    cpu: int = 0
    """Number of states decided by the CPU solver."""
    gpu: int = 0
    """Number of states decided by the GPU solver."""
    exact: int = 0
    """Number of states decided by the exact solver."""
    undecided: int = 0
    """Number of states left undecided by all solvers."""
    rejected: int = 0
    """Number of proofs of the fast solver that the checker rejected; the exact solver then decided."""
    warm: int = 0
    """Number of states solved with a warm start from the forces or the displacement of a parent."""

    def to_dict(self) -> dict[str, int]:
        """Return plain numbers for reports."""
        return asdict(self)


class StabilityOracle:
    """Stability oracle of one structure, with proofs.

    One object serves one structure under one set of settings. It caches verdicts, so use it again.
    """

    def __init__(self, assembly: AnyStructure, settings: StabilitySettings = StabilitySettings()) -> None:
        assembly = as_assembly(assembly)
        self.assembly, self.settings, self._claim = assembly, settings, settings.claim
        self.problem = build_problem(
            assembly, cone=settings.friction_cone, gravity=settings.gravity, reserve=settings.reserve
        )
        self.premises: dict[str, Any] = self._claim.to_dict()
        """What verdicts depend on beside the structure, as plain JSON values."""
        self.counters = Counters()
        self._criterion = CRITERIA[settings.criterion](assembly, self.problem, settings)
        asked = settings.solver in ("auto", "cpu") and not self.problem.strength.idle.any()
        self._cpu = self._criterion if self._criterion.displaced or asked else None
        """Solver on the CPU; None where the exact solver is asked for, or the only one that knows all contacts."""
        self._gpu = gpu_solver(assembly, settings, self.problem)
        keep = self._criterion.holds_keep_stable
        self._cache = VerdictCache(holds_keep_stable=keep)
        self.guesses = Guesses(self._criterion.no_guess(1)[0], assembly.boundary, holds_keep_stable=keep)

    def use_gpu(self) -> None:
        """Have a GPU answer batches of verdicts from now on, whatever the settings.

        Raises:
            DependencyError: a package that its solver needs is not installed.
            InputError: no GPU.
        """
        if self._gpu is None:
            self._gpu = gpu_solver(self.assembly, replace(self.settings, solver="gpu"), self.problem)

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
        """Replayer of state sequences of the structure; None under `equilibrium`, which has no history."""
        return self._criterion.replayer()

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
        # Kernels take idle points to bear pressure, so that only certificates count.
        answer = self._certify if require_certificate or self.problem.strength.idle.any() else self._recall
        check_interruption()
        verdicts = answer(batch, origins)
        verdicts.on_tolerance[:] = self._claim.on_tolerance(verdicts)
        if require_certificate:
            return replace(verdicts, assembly=self.assembly, states=batch)
        return verdicts if verdicts.forces is None else verdicts.without_certificates()

    def margins(
        self,
        states: ArrayLike,
        kinds: Sequence[str] | None = None,
        *,
        deadline: float | None = None,
        histories: Sequence[History] = (),
    ) -> list[StateMargins]:
        """Return how far friction, tilt, loads and pushes are from the limit, with certificates on both sides of each.

        Args:
            states: one state `(parts,)` or a batch `(batch, parts)`.
            kinds: margins to compute; by default all but the polygon of tilts and the settlement of supports.
            deadline: seconds after which searches return what they have proven, see `StateMargins.unfinished`.
            histories: of the contacts of each state (`Replayer.replay`), without joints: margins as built.

        Raises:
            InputError: a margin that is not defined under the criterion, or a deadline of zero or less.
            StateError: states of the wrong length or with other values.
        """
        return self._margins.margins(states, QUICK if kinds is None else kinds, deadline=deadline, histories=histories)

    @cached_property
    def prober(self) -> Prober:
        """Solver of single states under modified friction and additional loads, which count from the true friction."""
        if self.settings.reserve != 1.0:
            return StabilityOracle(self.assembly, replace(self.settings, reserve=1.0)).prober
        return self._criterion.prober()

    @cached_property
    def _margins(self) -> MarginFinder:
        return MarginFinder(self.prober)

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states a replay may find at rest: those without a proven mechanism near where they differ.

        Args:
            states: shape (batch, parts).
            parents: states at rest one move away, shape (batch, parts).
        """
        check_interruption()
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
        left, origins = np.arange(len(unique)), None
        if near is not None and self._choose(len(unique)) is self._cpu is not None:
            origins = np.empty_like(unique)
            origins[back] = near
        while len(left):
            begun = rest = left
            if origins is not None:
                begun = self._certify_from_memory(unique, origins, left, verdicts)
                rest = begun[~verdicts.stable[begun]]
                if not len(begun):
                    begun = rest = root_rows(unique, origins, left)
            if len(rest):
                verdicts.put(rest, self._certify_from_rest(unique[rest]))
                self._remember(unique[rest], verdicts[rest])
            left = np.setdiff1d(left, begun, assume_unique=True)
        self._count(verdicts)
        self._cache.store(unique, verdicts.verdict, verdicts.residual)
        self.counters.cached += len(states) - len(unique)
        return verdicts[back]

    def _certify_from_memory(
        self, states: States, near: States, rows: NDArray[np.intp], verdicts: Verdicts
    ) -> NDArray[np.intp]:
        """Return those of some rows of which, or of whose near states, something is remembered; write their verdicts.

        Only those that are stable have a proof.
        """
        own = {row: guess for row in rows if (guess := self.guesses.get(states[row])) is not None}
        others = [row for row in rows if row not in own]
        new = {row: guess for row in others if (guess := self.guesses.get(near[row])) is not None}
        known = own | new
        chosen = np.array(list(known), dtype=np.intp)
        if self._cpu is not None and known:
            origins = np.concatenate([states[list(own)], near[list(new)]])
            guess = np.array(list(known.values()), dtype=np.float64)
            found = self._cpu.check(states[chosen], parents=origins, guess=guess)
            found.verdict[~(found.stable & self._accept(states[chosen], found))] = Verdict.UNDECIDED
            self._criterion.refine_undecided(states[chosen], found)
            self.counters.warm += len(chosen)
            self._remember(states[list(new)], found[len(own) :])
            verdicts.put(chosen, found)
        return chosen

    def _certify_from_rest(self, states: States) -> Verdicts:
        """Return verdicts with certificates on distinct states, of which nothing is known."""
        solver = self._choose(len(states))
        if solver is None:
            return self.exact.check(states)
        verdicts = solver.check(states, certificates=True)
        accepted = self._accept(states, verdicts)
        # A GPU may stop at residuals above the resolution; they are proofs where no solver finds better ones.
        rough = np.flatnonzero(accepted & verdicts.stable & (verdicts.residual > self.settings.resolution))
        kept = verdicts[rough]
        accepted[rough] = False
        self._ask_further(states, verdicts, solver, np.flatnonzero(~accepted), self._accept)
        lost = verdicts.undecided[rough]
        verdicts.put(rough[lost], kept[lost])
        self._criterion.refine_undecided(states, verdicts)
        return verdicts

    def _ask_further(
        self,
        states: States,
        verdicts: Verdicts,
        solver: CpuSolver | GpuSolver,
        rest: NDArray[np.intp],
        accept: Callable[[States, Verdicts], NDArray[np.bool_]],
        near: States | None = None,
        known: Sequence[NDArray[np.float64] | None] = (),
    ) -> None:
        """Ask what comes after a solver about the states that it leaves: the CPU after a GPU, then the exact solver.

        Args:
            states: shape (batch, parts).
            verdicts: in and out, of the solver.
            rest: rows of the states that it leaves.
            accept: whether verdicts count.
            near: states near to these. Where one is known to be stable, the exact solver decides on the parts that
                contacts join to the difference alone.
            known: what balances them, where that is known; one entry a state.
        """
        if not len(rest):
            return
        if solver is self._gpu and self._cpu is not None:
            again = self._cpu.check(states[rest], certificates=verdicts.forces is not None)
            verdicts.put(rest, again)
            rest = rest[~accept(states[rest], again)]
        rest = rest[self._criterion.is_left_to_exact(verdicts[rest])]
        if len(rest):
            joined, origins = states[rest], [None if near is None else known[row] for row in rest]
            stable = np.array([origin is not None for origin in origins])
            if near is not None and stable.any():
                joined[stable] = self.problem.hold_apart(joined[stable], near[rest[stable]])
            exact = self.exact.check(joined)
            self._criterion.read_exact(exact, verdicts[rest])
            self._remember(states[rest], exact, joined, origins)
            verdicts.put(rest, exact)

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
            solved = Verdicts.all_undecided(len(rows))
            for some in pieces(len(rows)):
                asked = rows[some]
                found = self._solve(states[asked], None if near is None else near[asked])
                self._count(found)
                self._cache.store(states[asked], found.verdict, found.residual)
                solved.put(some, found)
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
        for rows in [each] if solver is self._gpu else chunks(each, self.problem.points, TASK):
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
        self._ask_further(states, verdicts, solver, rest, lambda _, found: ~found.undecided, near, known)
        return verdicts

    def _remember(
        self,
        states: States,
        verdicts: Verdicts,
        joined: States | None = None,
        origins: Sequence[NDArray[np.float64] | None] = (),
    ) -> None:
        """Remember the certificates of stable states, from which others start.

        Verdicts on `joined`, see `Problem.hold_apart`, are completed by what balances the states near by.
        """
        guess = self._criterion.guess_of(verdicts)
        if guess is None:
            return
        if joined is not None:
            kept = self.problem.active(states) & ~self.problem.active(joined)
            for row, origin in enumerate(origins):
                if origin is not None:
                    guess[row, kept[row]] = origin[kept[row]]
        self.guesses.remember(states[verdicts.stable], guess[verdicts.stable])

    def _accept(self, states: States, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return whether the checker accepts each verdict; count the rejected ones."""
        accepted = verify_certificates(self.assembly, states, verdicts, self._claim)
        self.counters.rejected += int((~accepted & ~verdicts.undecided).sum())
        return accepted

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

"""Criterion `equilibrium` on the CPU: batches of states, one state per thread, no BLAS."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.layout import COMPILED_LAYOUT, build_structure
from falsework.stability.cpu.neighbourhood import REACH, local_instability_range
from falsework.stability.cpu.repair import repair_range
from falsework.stability.cpu.termination import UNDECIDED, Options
from falsework.stability.problem import Problem
from falsework.stability.settings import EQUILIBRIUM, StabilitySettings
from falsework.stability.strength import SMOOTH
from falsework.stability.verdict import Criterion, Solver, Verdicts, proof_of
from falsework.utils.cores import core_count

Array = NDArray[np.float64]

TASK = 16
"""States per task of a thread: few enough to balance the load, enough to hide the cost of a call."""


def kernel_options(settings: StabilitySettings) -> Options:
    """Return the settings in the form of the kernel."""
    numerics = settings.numerics
    return Options(
        rho=numerics.rho,
        relaxation=numerics.relaxation,
        iterations=numerics.iterations,
        check_every=numerics.check_every,
        interior_steps=numerics.interior_steps,
        tolerance=settings.tolerance,
        resolution=settings.claim.well_below,
        force_bound=settings.force_bound,
    )


class Workers:
    """Threads that share the rows of a batch; compiled code runs in them without the GIL."""

    def __init__(self, threads: int | None) -> None:
        """Start this many threads, by default one per core."""
        self._threads = threads or core_count()
        self._pool = ThreadPoolExecutor(self._threads) if self._threads > 1 else None

    def __getstate__(self) -> int:
        """Return the number of threads, which is all that a copy needs: threads cannot be copied."""
        return self._threads

    def __setstate__(self, threads: int) -> None:
        self.__init__(threads)

    def run(self, work: Callable[[slice], None], batch: int) -> None:
        """Call `work` on ranges of rows that cover a batch."""
        task = batch if self._pool is None else min(TASK, -(-batch // self._threads))
        rows = [slice(first, first + task) for first in range(0, batch, max(task, 1))]
        if self._pool is None or len(rows) < 2:
            for run in rows:
                work(run)
        else:
            list(self._pool.map(work, rows))


class StateQuery(NamedTuple):
    """States for the attempts of a solver."""

    states: States
    """Shape (batch, parts)."""
    origins: States
    """The state near to each, or the state itself."""
    start: Array | None
    """In and out: guesses, and what is found; None if neither is given or wanted."""
    known: NDArray[np.bool_]
    """Which guesses are known, shape (batch,)."""
    seeks: bool
    """Whether mechanisms are sought near the differences."""
    resolution: float
    """Residual at which states count as stable."""


class CpuSolver:
    """Solver of `equilibrium`, and what its proofs mean: forces in balance, which hold with further holds too.

    Base of the solver of the other criterion, `ContactSolver`. What differs between the criteria is in these two
    classes, and in what `criteria.py` makes of them.

    Batches of states of one structure are decided with compiled code. Attempts follow each other in the order of their
    work; each stops at the first proof. With a state near by: a mechanism near the difference (`neighbourhood.py`),
    then forces that change in a region that is extended to all that contacts join to it (`repair.py`). Then on these
    parts, and without a state near by on all, ADMM with one sparse factorisation per state, and an interior point
    method (`docs/decisions/cpu-solver.md`).
    What they leave undecided is up to the exact solver.
    """

    criterion: Criterion = "equilibrium"
    starts_from_guesses = True
    displaced = False
    """Whether displacements are part of the proof."""
    holds_keep_stable = True
    """Whether a stable state stays stable when a part is held."""

    def __init__(self, problem: Problem, settings: StabilitySettings = EQUILIBRIUM) -> None:
        self.problem = problem
        self.settings = settings
        self.structure = build_structure(problem)
        self._options = kernel_options(settings)
        strength = problem.strength
        rough = bool((strength.friction > SMOOTH).all())
        self.reach = REACH
        self._interior = rough and not (strength.pull.any() or strength.stick.any())
        self._workers = Workers(settings.numerics.threads)

    def no_guess(self, batch: int) -> Array:
        """Return guesses for states of which nothing is known, shape (batch, points, 3) or (batch, parts, 6)."""
        return np.zeros((batch, self.problem.points, 3))

    def is_known(self, guess: Array) -> NDArray[np.bool_]:
        """Return for which states guesses are known, shape (batch,)."""
        return np.asarray(guess.any(axis=(1, 2)))

    def guess_of(self, verdicts: Verdicts) -> Array | None:
        """Return what of the certificates of stable states starts solvers of states near by; None without any."""
        return verdicts.forces

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """Revise verdicts that have a proof, where more is asked of stable states than balance."""

    def is_left_to_exact(self, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return for which of some undecided states the exact solver may know more, shape (batch,)."""
        return np.ones(len(verdicts), dtype=bool)

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """Turn verdicts of the exact solver, of the equilibrium problem, into verdicts under the criterion."""

    def falls(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states have a mechanism near where they differ from a stable one, as the kernel proves.

        Args:
            states, parents: checked states, shape (batch, parts).
        """
        states, parents = (np.require(some, requirements=COMPILED_LAYOUT) for some in (states, parents))
        verdicts, nothing = Verdicts.all_undecided(len(states)), np.zeros((0, self.problem.parts, 6))

        def work(rows: slice) -> None:
            found = verdicts.verdict[rows], verdicts.residual[rows], verdicts.iterations[rows]
            for reach in (1, REACH):
                kernel = self.structure, states[rows], parents[rows], reach, self._options
                local_instability_range(*kernel, nothing, *found)

        self._workers.run(work, len(states))
        return verdicts.unstable

    def check(
        self,
        states: States,
        *,
        certificates: bool = True,
        parents: States | None = None,
        guess: Array | None = None,
    ) -> Verdicts:
        """Check a batch of states.

        Args:
            states: checked states, shape (batch, parts).
            certificates: return forces and velocity, and displacement where it is part of the proof; without parents,
                with residuals down to the resolution of the settings.
            parents: for each state a stable one that differs in few parts, shape (batch, parts); a mechanism is
                sought near the difference first, unless certificates are requested and there is a guess.
            guess: what to start from, as `no_guess` where not known; overwritten with what was found. With `parents`,
                what balances them, which is changed near the difference first.

        Returns:
            Verdicts; `UNDECIDED` where neither proof was found within the limits of the settings.
        """
        states = np.require(states, requirements=COMPILED_LAYOUT)
        origins = states if parents is None else np.require(parents, requirements=COMPILED_LAYOUT)
        verdicts = self.problem.undecided(len(states), certificates=certificates, displaced=self.displaced)
        kept, known = self.guess_of(verdicts), np.zeros(len(states), dtype=bool)
        if guess is not None and parents is not None:
            known = self.is_known(guess)
        # Proofs along a plan are requested for stable states.
        seeks = parents is not None and not (certificates and guess is not None)
        resolution = self.settings.resolution if certificates and parents is None else self._options.resolution
        start = kept if guess is None else guess
        found = self._attempt(StateQuery(states, origins, start, known, seeks, resolution), verdicts)
        if kept is not None and found is not kept:
            kept[:] = found
        verdicts.on_tolerance[:] = self.settings.claim.on_tolerance(verdicts)
        verdicts.proof[:] = proof_of(verdicts.verdict, self.criterion)
        verdicts.decided_by[:] = np.where(verdicts.undecided, Solver.NONE, Solver.CPU)
        return verdicts

    def _attempt(self, query: StateQuery, verdicts: Verdicts) -> Array:
        """Make the attempts, each on the states that those before leave undecided; return `query.start` or its like."""
        forces = self.no_guess(0) if query.start is None else query.start
        velocity = np.zeros((0, self.problem.parts, 6)) if verdicts.velocity is None else verdicts.velocity
        options, seeks = self._options._replace(resolution=query.resolution), query.seeks

        def work(rows: slice) -> None:
            tail = verdicts.verdict[rows], verdicts.residual[rows], verdicts.iterations[rows]
            near, known = (self.structure, query.states[rows], query.origins[rows]), query.known[rows]
            motion, force = velocity[rows], forces[rows]
            if seeks and not local_instability_range(*near, 1, options, motion, *tail):
                return
            beside = self.reach, self._interior, options, force
            if known.any() and not repair_range(*near, known, *beside, *tail):
                return
            if seeks and not local_instability_range(*near, REACH, options, motion, *tail):
                return
            chosen, left = query.states[rows], known & (tail[0] == UNDECIDED)
            if left.any():
                chosen = chosen.copy()
                chosen[left] = self.problem.hold_apart(chosen[left], query.origins[rows][left])
            solve_range(self.structure, chosen, options, force, motion, False, *tail)

        self._workers.run(work, len(query.states))
        return forces

"""CPU solver of the equilibrium problem: batches of states, one state per thread, no BLAS."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

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
from falsework.stability.verdict import Solver, Verdicts, proof_of
from falsework.utils.cores import core_count

_TASK = 16
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
        task = batch if self._pool is None else min(_TASK, -(-batch // self._threads))
        rows = [slice(first, first + task) for first in range(0, batch, max(task, 1))]
        if self._pool is None or len(rows) < 2:
            for run in rows:
                work(run)
        else:
            list(self._pool.map(work, rows))


class CpuSolver:
    """Solver of a criterion, and what its proofs mean: forces in balance, which hold with further holds too.

    It decides batches of states of one structure with compiled code. Attempts follow each other in the order of their
    work; each stops at the first proof. With a state near by: a mechanism near the difference (`neighbourhood.py`),
    then forces that change in a region that is extended to all that contacts join to it (`repair.py`). Then on these
    parts, and without a state near by on all, ADMM with one sparse factorisation per state, and an interior point
    method (`docs/decisions/cpu-solver.md`).
    What they leave undecided is up to the exact solver.
    """

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

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """Return guesses for states of which nothing is known, shape (batch, points, 3) or (batch, parts, 6)."""
        return np.zeros((batch, self.problem.points, 3))

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
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
        guess: NDArray[np.float64] | None = None,
    ) -> Verdicts:
        """Check a batch of states.

        Args:
            states: checked states, shape (batch, parts).
            certificates: return forces and velocity too; without parents, with residuals down to the resolution of
                the settings.
            parents: for each state a stable one that differs in few parts, shape (batch, parts); a mechanism is
                sought near the difference first, unless certificates are requested and there is a guess.
            guess: contact forces in N to start from, shape (batch, points, 3), zero where not known; overwritten with
                the forces that were found. With `parents`, those that balance them, which are repaired near the
                difference first.

        Returns:
            Verdicts; `UNDECIDED` where neither proof was found within the limits of the settings.
        """
        states = np.require(states, requirements=COMPILED_LAYOUT)
        origins = states if parents is None else np.require(parents, requirements=COMPILED_LAYOUT)
        batch, problem = len(states), self.problem
        verdicts = problem.undecided(batch, certificates=certificates)
        forces = guess if guess is not None else verdicts.forces
        if forces is None:
            forces = np.zeros((0, problem.points, 3))
        velocity = verdicts.velocity if verdicts.velocity is not None else np.zeros((0, problem.parts, 6))
        fine = certificates and parents is None
        options = self._options
        options = options._replace(resolution=self.settings.resolution) if fine else options
        known = np.zeros(batch, bool) if guess is None or parents is None else np.asarray(guess.any(axis=(1, 2)))
        # Proofs along a plan are requested for stable states.
        falls = parents is not None and not (certificates and guess is not None)

        def work(rows: slice) -> None:
            tail = verdicts.verdict[rows], verdicts.residual[rows], verdicts.iterations[rows]
            chosen, motion, force = states[rows], velocity[rows], forces[rows]
            if falls and not local_instability_range(self.structure, chosen, origins[rows], 1, options, motion, *tail):
                return
            if known[rows].any():
                beside = origins[rows], known[rows], self.reach, self._interior
                if not repair_range(self.structure, chosen, *beside, options, force, *tail):
                    return
            if falls and not local_instability_range(
                self.structure, chosen, origins[rows], REACH, options, motion, *tail
            ):
                return
            apart = known[rows] & (verdicts.verdict[rows] == UNDECIDED)
            if apart.any():
                chosen = chosen.copy()
                chosen[apart] = problem.hold_apart(chosen[apart], origins[rows][apart])
            solve_range(self.structure, chosen, options, force, motion, False, *tail)

        self._workers.run(work, batch)
        if verdicts.forces is not None and forces is not verdicts.forces:
            verdicts.forces[:] = forces
        verdicts.proof[:] = proof_of(verdicts.verdict)
        verdicts.decided_by[:] = np.where(verdicts.verdict != 0, Solver.CPU, Solver.NONE)
        return verdicts

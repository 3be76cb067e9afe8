"""CPU solver of the equilibrium problem: batches of states, one state per thread, no BLAS."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.layout import COMPILED_LAYOUT, build_structure
from falsework.stability.cpu.neighbourhood import RINGS, fall_range
from falsework.stability.cpu.repair import CORRIDORS, REPAIR_RINGS, repair_range
from falsework.stability.cpu.termination import UNDECIDED, Options
from falsework.stability.problem import Problem
from falsework.stability.settings import EQUILIBRIUM, StabilitySettings
from falsework.stability.verdict import Solver, Verdicts, proof_of
from falsework.utils.cores import core_count

_TASK = 16
"""States per task of a thread: few enough to balance the load, enough to hide the cost of a call."""
_LARGE = 200
"""Parts from which ADMM, where it begins with forces of a state near by, has these options ..."""
_FROM_FORCES = {"rho": 1e-4, "relaxation": 1.5, "iterations": 150, "interior_steps": 0, "scaled": True}
"""... so that interior point steps, each with a factorization, are mostly not needed. From there they often fail: they
follow forces that grow beyond their bound."""
_ALONG = {**_FROM_FORCES, "iterations": 100}
"""Options of repairs along the ways to supports, in structures of any size."""
_LARGER = 400
"""Parts from which those take the place of the widest repair around a change and of interior point steps in the others:
these regions are a small share then, and what they leave open is cheaper along the ways. A wider corridor is a small
share too, and what the whole leaves open is begun again along the ways before it is begun again as a whole."""
_CENTRED = 400
"""Parts from which forces are kept inside their cones, where all contacts have friction and none has cohesion, so that
they change near the difference only. In smaller structures that takes longer than ADMM on the whole."""
LEFT_OPEN = 1000
"""Parts from which states that local repairs leave undecided stay undecided within a search: ADMM on the whole and the
exact solver take seconds for one of them, and ADMM mostly decides nothing."""
_LEAST_FRICTION = 1e-3
"""Coefficient of friction below which cones are too narrow for that."""
_FROM_REST = {"iterations": 10, "interior_steps": 60}
"""Options of a second attempt, from zero forces: interior point steps from near the middle of the cones."""


def kernel_options(settings: StabilitySettings) -> Options:
    """Return the settings in the form of the kernel."""
    cpu = settings.cpu
    return Options(
        rho=cpu.rho,
        relaxation=cpu.relaxation,
        iterations=cpu.iterations,
        check_every=cpu.check_every,
        interior_steps=cpu.interior_steps,
        tolerance=settings.tolerance,
        resolution=settings.claim.well_below,
        force_bound=settings.force_bound,
        scaled=False,
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
    """Solver of batches of states of one structure with compiled code.

    ADMM on the forces with one sparse factorisation per state, then an interior point method for undecided states
    (`docs/decisions/0002`). Both stop at the first proof.
    """

    starts_from_guesses = True

    def __init__(self, problem: Problem, settings: StabilitySettings = EQUILIBRIUM) -> None:
        self.problem = problem
        self.settings = settings
        self.structure = build_structure(problem)
        self._options = kernel_options(settings)
        large = problem.parts >= _LARGE
        self._from_forces = self._options._replace(**_FROM_FORCES) if large else self._options
        self._along = self._options._replace(**_ALONG)
        self._around, self._rings, self._corridors = self._options, REPAIR_RINGS, CORRIDORS[:-1]
        self._larger = problem.parts >= _LARGER
        if self._larger:
            self._around, self._rings = self._options._replace(interior_steps=0), REPAIR_RINGS[:-1]
            self._corridors = CORRIDORS
        strength = problem.strength
        rough = bool((strength.friction > _LEAST_FRICTION).all())
        self._centred = problem.parts >= _CENTRED and rough and not (strength.pull.any() or strength.stick.any())
        self._from_rest = self._options._replace(**_FROM_REST) if large else self._options
        self._workers = Workers(settings.cpu.threads)

    def _options_for(self, resolution: float) -> tuple[Options, ...]:
        options = self._options, self._from_forces, self._along, self._around, self._from_rest
        return tuple(option._replace(resolution=resolution) for option in options)

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
        if parents is not None:
            parents = np.require(parents, requirements=COMPILED_LAYOUT)
        batch, problem = len(states), self.problem
        verdicts = Verdicts.blank(
            batch, points=problem.points if certificates else None, parts=problem.parts if certificates else None
        )
        forces = guess if guess is not None else verdicts.forces
        if forces is None:
            forces = np.zeros((0, problem.points, 3))
        velocity = verdicts.velocity if verdicts.velocity is not None else np.zeros((0, problem.parts, 6))
        steps = np.zeros(batch, np.int32)
        fine = certificates and parents is None
        plain, from_forces, along_ways, around, from_rest = self._options_for(
            self.settings.resolution if fine else self.settings.claim.well_below
        )
        known = np.zeros(batch, bool) if guess is None or parents is None else np.asarray(guess.any(axis=(1, 2)))

        def work(rows: slice) -> None:
            found = verdicts.verdict[rows], verdicts.residual[rows], verdicts.iterations[rows], steps[rows]
            chosen, motion, force, warm = states[rows], velocity[rows], forces[rows], guess is not None
            kernel, before = (self.structure, chosen), force
            centred = self._centred and warm and parents is not None
            left_open = centred and self.problem.parts >= LEFT_OPEN
            only_centred = left_open and bool(known[rows].all())
            if parents is not None:
                beside = parents[rows]
                # Proofs along a plan are requested for stable states.
                along = certificates and guess is not None
                if not along and not fall_range(*kernel, beside, RINGS, plain, motion, *found):
                    return
                before = force.copy() if self._larger and not only_centred else force  # repairs write to `force`
                near = beside, known[rows], self._rings, self._corridors, around, along_ways, warm, centred
                if known[rows].any() and not repair_range(*kernel, *near, force, *found):
                    return
            if only_centred:
                return
            if not left_open:  # whose forces would lie on the boundaries of cones
                solve_range(*kernel, from_forces if warm else plain, force, motion, warm, *found)
            left = found[0] == UNDECIDED
            # From no forces: first along the ways to supports, with the forces of the parent farther away.
            if warm and parents is not None and self._larger and left.any():
                near = parents[rows], known[rows], REPAIR_RINGS[:0], CORRIDORS[1:], around, from_rest
                repair_range(*kernel, *near, not warm, False, before, *found)
                repaired = left & (found[0] != UNDECIDED)
                force[repaired] = before[repaired]
                left &= ~repaired
            if warm and left.any():
                solve_range(*kernel, from_rest, force, motion, not warm, *found)

        self._workers.run(work, batch)
        if verdicts.forces is not None and forces is not verdicts.forces:
            verdicts.forces[:] = forces
        verdicts.iterations[:] += steps
        verdicts.proof[:] = proof_of(verdicts.verdict)
        verdicts.decided_by[:] = np.where(verdicts.verdict != 0, Solver.CPU, Solver.NONE)
        return verdicts

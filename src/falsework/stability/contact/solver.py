"""Criterion `contact` on the CPU: batches of states, one state per thread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact.kernel import rest_range
from falsework.stability.contact.layout import ContactOptions, build_contact_structure
from falsework.stability.cpu.solver import CpuSolver, StateQuery
from falsework.stability.problem import Problem
from falsework.stability.second_order.growing_motion import SecondOrder
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Verdict, Verdicts, proof_of

Array = NDArray[np.float64]


class ContactSolver(CpuSolver):
    """Solver of `contact`: displacements are the proof, and another hold may take one away.

    The parts near the difference of a state from its parent are first searched for a mechanism, with a proof
    (`neighbourhood.py`). Then a rest position is sought (`newton.py`), from that of the parent where it is known;
    if there is one the state is stable. If not, the solver of the equilibrium problem decides whether the
    state is unstable, with its proof. If it is not, iterations that had not ended continue; where parts move away, the
    state slides.
    """

    criterion, displaced, holds_keep_stable = "contact", True, False

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        super().__init__(problem, settings)
        self.contact_structure = build_contact_structure(assembly, problem, self.structure, settings)
        numerics = settings.numerics
        self.contact_options = ContactOptions(
            settings.claim.well_below,
            numerics.contact_steps,
            numerics.warm_steps,
            numerics.first_step,
            numerics.warm_first_step,
        )
        self.assembly = assembly
        self._pulls = bool(problem.strength.pull.any())
        self.second_order = SecondOrder(assembly, settings.claim)

    def no_guess(self, batch: int) -> Array:
        """Return unknown displacements, shape (batch, parts, 6)."""
        return np.full((batch, self.problem.parts, 6), np.nan)

    def is_known(self, guess: Array) -> NDArray[np.bool_]:
        """Return which displacements are known."""
        return np.asarray(np.isfinite(guess).all(axis=(1, 2)))

    def guess_of(self, verdicts: Verdicts) -> Array | None:
        """Return the displacements at rest."""
        return verdicts.displacement

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """Revise verdicts on rest positions that a small motion leaves: these states are not stable."""
        self.second_order.revise(states, verdicts)

    def is_left_to_exact(self, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return where no equilibrium is proven: where it is and no rest position was found, nothing can be added."""
        return ~(verdicts.undecided & (verdicts.residual <= self.settings.tolerance))

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """Turn equilibrium into sliding where parts move away; else it does not imply stability, and is undecided."""
        slides = exact.stable & (before.slides | np.isposinf(before.residual))
        exact.verdict[exact.stable & ~slides] = Verdict.UNDECIDED
        exact.verdict[slides] = Verdict.SLIDES
        exact.proof[:] = proof_of(exact.verdict, self.criterion)

    def _attempt(self, query: StateQuery, verdicts: Verdicts) -> Array:
        """Make the attempts; guesses are displacements of the parents, from which iterations start.

        Without a guess, the displacement of a state that slides is the one at which parts were seen to move away; NaN
        where there is neither that nor a rest position.
        """
        displacement = self.no_guess(len(query.states)) if query.start is None else query.start
        forces = np.zeros((0, self.problem.points, 3)) if verdicts.forces is None else verdicts.forces
        velocity = np.zeros((0, self.problem.parts, 6)) if verdicts.velocity is None else verdicts.velocity
        balance = self._options._replace(resolution=query.resolution)
        rest = self.contact_options._replace(tolerance=query.resolution)
        more = min(rest.warm_steps, rest.steps) if verdicts.forces is None else rest.steps

        def work(rows: slice) -> None:
            found = verdicts.verdict[rows], verdicts.residual[rows], verdicts.iterations[rows]
            arrays = displacement[rows], forces[rows], velocity[rows], query.known[rows]
            chosen = self.contact_structure, query.states[rows], query.origins[rows]
            rest_range(*chosen, balance, rest, more, query.seeks, self._pulls, *arrays, *found)

        self._workers.run(work, len(query.states))
        lost = ~verdicts.stable
        if displacement is verdicts.displacement:  # a sliding displacement must not become a guess
            lost &= ~verdicts.slides
        displacement[lost] = np.nan
        return displacement

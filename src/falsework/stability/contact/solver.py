"""CPU solver of the criterion `contact`: batches of states, one state per thread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact.kernel import rest_range
from falsework.stability.contact.layout import ContactOptions, build_contact_structure
from falsework.stability.cpu.layout import COMPILED_LAYOUT
from falsework.stability.cpu.panels import RIDGE
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.problem import Problem
from falsework.stability.second_order.growing_motion import SecondOrder
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of


class ContactSolver(CpuSolver):
    """Solver of the criterion `contact`: displacements are the proof, and another hold may take one away.

    The parts near the difference of a state from its parent are first searched for a mechanism, with a proof
    (`neighbourhood.py`). Then a rest position is sought (`newton.py`), from that of the parent where it is known;
    if there is one the state is stable. If not, the solver of the equilibrium problem decides whether the
    state is unstable, with its proof. If it is not, iterations that had not ended continue; where parts move away, the
    state slides.
    """

    displaced, holds_keep_stable = True, False

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        super().__init__(problem, settings)
        law = build_contact_structure(
            assembly, problem, self.structure, settings.gravity, settings.stiffness_ratio, settings.holds
        )
        if problem.strength.idle.any():
            soft = np.where(problem.strength.idle, RIDGE, 1.0)
            law = law._replace(normal=soft * law.normal, tangential=soft * law.tangential)
        self.contact_structure = law
        numerics = settings.numerics
        self.contact_options = ContactOptions(
            settings.claim.well_below,
            numerics.contact_steps,
            numerics.warm_steps,
            numerics.first_step,
            numerics.warm_first_step,
        )
        self._pulls = bool(problem.strength.pull.any())
        self._second_order = SecondOrder(assembly, settings.claim)

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """Return unknown displacements, shape (batch, parts, 6)."""
        return np.full((batch, self.problem.parts, 6), np.nan)

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
        """Return the displacements at rest."""
        return verdicts.displacement

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """Revise verdicts on rest positions that a small motion leaves: these states are not stable."""
        self._second_order.revise(states, verdicts)

    def is_left_to_exact(self, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return where no equilibrium is proven: where it is and no rest position was found, nothing can be added."""
        return ~(verdicts.undecided & (verdicts.residual <= self.settings.tolerance))

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """Turn equilibrium into sliding where parts move away; else it does not imply stability, and is undecided."""
        slides = exact.stable & (before.slides | np.isposinf(before.residual))
        exact.verdict[exact.stable & ~slides] = Verdict.UNDECIDED
        exact.verdict[slides] = Verdict.SLIDES
        exact.proof[:] = proof_of(exact.verdict, "contact")

    def check(
        self,
        states: States,
        *,
        certificates: bool = True,
        parents: States | None = None,
        guess: NDArray[np.float64] | None = None,
    ) -> Verdicts:
        """Check a batch of states, as `CpuSolver.check`.

        Guesses are displacements of the parents in m and rad, NaN where they are not known, shape (batch, parts, 6);
        iterations start from them. Without a guess, the displacement of a state that slides is the one at which parts
        were seen to move away; NaN where there is neither that nor a rest position.
        """
        states = np.require(states, requirements=COMPILED_LAYOUT)
        origins = states if parents is None else np.require(parents, requirements=COMPILED_LAYOUT)
        batch, problem = len(states), self.problem
        balance, rest = self._options, self.contact_options
        if certificates and parents is None:
            resolution = self.settings.resolution
            balance, rest = balance._replace(resolution=resolution), rest._replace(tolerance=resolution)
        verdicts = problem.undecided(batch, certificates=certificates, displaced=True)
        forces = verdicts.forces if verdicts.forces is not None else np.zeros((0, problem.points, 3))
        velocity = verdicts.velocity if verdicts.velocity is not None else np.zeros((0, problem.parts, 6))
        displacement = verdicts.displacement if guess is None else guess
        if displacement is None:
            displacement = np.zeros((batch, problem.parts, 6))
        warm = np.zeros(batch, dtype=bool)
        if guess is not None and parents is not None:
            warm = np.asarray(np.isfinite(guess).all(axis=(1, 2)))
        more = rest.steps if certificates else min(rest.warm_steps, rest.steps)
        seeks = parents is not None and not certificates  # proofs are mostly requested for stable states

        def work(rows: slice) -> None:
            found = verdicts.verdict[rows], verdicts.residual[rows], verdicts.iterations[rows]
            arrays = displacement[rows], forces[rows], velocity[rows], warm[rows]
            chosen = states[rows], origins[rows]
            rest_range(self.contact_structure, *chosen, balance, rest, more, seeks, self._pulls, *arrays, *found)

        self._workers.run(work, batch)
        lost = ~verdicts.stable
        if guess is None:  # a sliding displacement must not become a guess
            lost &= ~verdicts.slides
        displacement[lost] = np.nan
        if verdicts.displacement is not None and displacement is not verdicts.displacement:
            verdicts.displacement[:] = displacement
        verdicts.proof[:] = proof_of(verdicts.verdict, "contact")
        verdicts.decided_by[:] = np.where(verdicts.undecided, Solver.NONE, Solver.CPU)
        return verdicts

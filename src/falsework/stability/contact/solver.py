"""CPU solver of the criterion `contact`: batches of states, one state per thread."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact.kernel import ContactOptions, build_contact_structure, rest_range
from falsework.stability.contact.newton import FIRST_STEP, MOVES_AWAY, OPEN, RESTS, WARM_FIRST_STEP
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.layout import COMPILED_LAYOUT, build_structure
from falsework.stability.cpu.neighbourhood import RINGS, local_instability_range
from falsework.stability.cpu.panels import RIDGE
from falsework.stability.cpu.solver import Workers, kernel_options
from falsework.stability.cpu.termination import STABLE, UNDECIDED, UNSTABLE
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

WARM_STEPS = 64
"""Iterations from the displacement of the parent before a state is tested for equilibrium; if it is, they continue, by
as many where no certificate is requested: a search has other states to try. Before them come half as many of the parts
near the difference alone. Checked on recorded searches."""
_SLIDES = int(Verdict.SLIDES)


class ContactSolver:
    """Solver of batches of states of one structure under the criterion `contact`.

    The parts near the difference of a state from its parent are first searched for a mechanism, with a proof
    (`neighbourhood.py`). Then a rest position is sought (`newton.py`), from that of the parent where it is known;
    if there is one the state is stable. If not, the solver of the equilibrium problem decides whether the
    state is unstable, with its proof. If it is not, iterations that had not ended continue; where parts move away, the
    state slides.
    """

    starts_from_guesses = True

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        self.problem = problem
        self.settings = settings
        self.structure = build_structure(problem)
        law = build_contact_structure(assembly, problem, settings.gravity, settings.stiffness_ratio, settings.holds)
        if problem.strength.idle.any():
            soft = np.where(problem.strength.idle, RIDGE, 1.0)
            law = law._replace(normal=soft * law.normal, tangential=soft * law.tangential)
        self.contact_structure = law
        self._options = kernel_options(settings)
        self.contact_options = ContactOptions(
            settings.claim.well_below,
            settings.cpu.contact_steps,
            WARM_STEPS,
            WARM_STEPS // 2,
            FIRST_STEP,
            WARM_FIRST_STEP,
        )
        self._pulls = bool(problem.strength.pull.any())
        self._workers = Workers(settings.cpu.threads)

    def falls(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states have a mechanism near where they differ from a stable one, as the kernel proves.

        Args:
            states, parents: checked states, shape (batch, parts).
        """
        states, parents = (np.require(some, requirements=COMPILED_LAYOUT) for some in (states, parents))
        batch = len(states)
        verdict, residual = np.full(batch, UNDECIDED, np.int8), np.zeros(batch)
        iterations, steps = np.zeros(batch, np.int32), np.zeros(batch, np.int32)
        nothing = np.zeros((0, self.problem.parts, 6))

        def work(rows: slice) -> None:
            tail = verdict[rows], residual[rows], iterations[rows], steps[rows]
            local_instability_range(self.structure, states[rows], parents[rows], RINGS, self._options, nothing, *tail)

        self._workers.run(work, batch)
        return verdict == UNSTABLE

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
            certificates: return displacement, forces and velocity too; without parents, with residuals down to the
                resolution of the settings.
            parents: for each state a stable one that differs in few parts, shape (batch, parts); a mechanism is sought
                near the difference first.
            guess: displacements of the parents in m and rad, NaN where they are not known, shape (batch, parts, 6);
                overwritten with the displacements that were found. Iterations start from them where they are known.

        Returns:
            Verdicts; `UNDECIDED` where nothing was found within the limits of the settings. Without a guess, the
            displacement of a state that slides is the one at which parts were seen to move away; NaN where there is
            neither that nor a rest position.
        """
        states = np.require(states, requirements=COMPILED_LAYOUT)
        if parents is not None:
            parents = np.require(parents, requirements=COMPILED_LAYOUT)
        batch, problem = len(states), self.problem
        balance, rest = self._options, self.contact_options
        if certificates and parents is None:
            resolution = self.settings.resolution
            balance, rest = balance._replace(resolution=resolution), rest._replace(tolerance=resolution)
        verdicts = Verdicts.all_undecided(
            batch,
            points=problem.points if certificates else None,
            parts=problem.parts if certificates else None,
            displaced=certificates,
        )
        forces = verdicts.forces if verdicts.forces is not None else np.zeros((0, problem.points, 3))
        velocity = verdicts.velocity if verdicts.velocity is not None else np.zeros((0, problem.parts, 6))
        displacement = verdicts.displacement if guess is None else guess
        if displacement is None:
            displacement = np.zeros((batch, problem.parts, 6))
        warm = np.zeros(batch, dtype=bool)
        if guess is not None and parents is not None:
            warm = np.asarray(np.isfinite(guess).all(axis=(1, 2)))
        origins = states if parents is None else parents
        steps = np.zeros(batch, np.int32)
        found = np.full(batch, RESTS, np.int8)
        cold = False  # forces hold no guess

        def stay(rows: slice) -> bool:
            """Find the states that tensile joints keep in place, in one or two iterations; return whether all are."""
            start, verdict, residual = displacement[rows].copy(), verdicts.verdict[rows], verdicts.residual[rows]
            kernel = (
                self.structure,
                self.contact_structure,
                states[rows],
                states[rows],
                rest._replace(steps=0, warm_steps=0),
            )
            cold_start = np.zeros(len(start), bool)
            left = rest_range(*kernel, start, forces[rows], cold_start, verdict, residual, steps[rows], found[rows])
            displacement[rows] = np.where((verdict == STABLE)[:, None, None], start, displacement[rows])
            return left == 0

        def continue_from(rows: NDArray[np.intp]) -> None:
            """Continue iterations from where they ended; arrays that are indexed by `rows` are copies."""
            chosen, start, force = states[rows], displacement[rows], forces[rows] if len(forces) else forces
            verdict, residual = np.full(len(rows), UNDECIDED, verdicts.verdict.dtype), verdicts.residual[rows]
            taken, result = steps[rows], found[rows]
            options = rest._replace(warm_steps=rest.steps if certificates else min(WARM_STEPS, rest.steps))
            kernel = self.structure, self.contact_structure, chosen, chosen, options
            rest_range(*kernel, start, force, np.ones(len(rows), bool), verdict, residual, taken, result)
            displacement[rows], steps[rows], found[rows] = start, taken, result
            at_rest = rows[result == RESTS]
            verdicts.verdict[at_rest], verdicts.residual[at_rest] = STABLE, residual[result == RESTS]
            if len(forces):
                forces[at_rest] = force[result == RESTS]

        def work(rows: slice) -> None:
            verdict, residual, taken = verdicts.verdict[rows], verdicts.residual[rows], steps[rows]
            tail = verdict, residual, verdicts.iterations[rows], taken
            motion, force, chosen = velocity[rows], forces[rows], states[rows]
            if self._pulls and stay(rows):
                return
            # Proofs are mostly requested for stable states.
            if (
                parents is not None
                and not certificates
                and not local_instability_range(self.structure, chosen, parents[rows], RINGS, balance, motion, *tail)
            ):
                return
            kernel = self.structure, self.contact_structure, chosen, origins[rows], rest
            if rest_range(*kernel, displacement[rows], force, warm[rows], verdict, residual, taken, found[rows]):
                solve_range(self.structure, chosen, balance, force, motion, cold, *tail)
                again = np.flatnonzero(warm[rows] & (found[rows] == OPEN) & (verdict != UNSTABLE))
                if len(again):
                    continue_from(again + rows.start)

        self._workers.run(work, batch)
        verdict, moves = verdicts.verdict, found == MOVES_AWAY
        if not (found == RESTS).all():
            verdict[(found == OPEN) & (verdict != UNSTABLE)] = UNDECIDED
            verdict[moves & (verdict == STABLE)] = _SLIDES
            verdicts.residual[moves & (verdict == UNDECIDED)] = np.inf
        lost = verdict != STABLE
        if guess is None:  # a sliding displacement must not become a guess
            lost &= verdict != _SLIDES
        displacement[lost] = np.nan
        if verdicts.displacement is not None and displacement is not verdicts.displacement:
            verdicts.displacement[:] = displacement
        verdicts.iterations[:] += steps
        verdicts.proof[:] = proof_of(verdicts.verdict, "contact")
        verdicts.decided_by[:] = np.where(verdicts.verdict != Verdict.UNDECIDED, Solver.CPU, Solver.NONE)
        return verdicts

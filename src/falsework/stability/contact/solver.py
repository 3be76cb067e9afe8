"""CPU solver of the criterion `contact`: batches of states, one state per thread."""

from __future__ import annotations

import numba as nb
import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import INSTALLED, States
from falsework.stability.contact.kernel import ContactOptions, build_contact_structure, solve_contact_state
from falsework.stability.contact.newton import FIRST_STEP, MOVES_AWAY, RESTS, make_contact_scratch
from falsework.stability.cpu.kernel import solve_state
from falsework.stability.cpu.layout import COMPILED_LAYOUT, build_structure, make_scratch
from falsework.stability.cpu.neighbourhood import RINGS, fall_near
from falsework.stability.cpu.solver import Workers, kernel_options
from falsework.stability.cpu.termination import STABLE, UNDECIDED, UNSTABLE
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

_WARM_STEPS = 8
"""Iterations from the displacement of the parent before a state is loaded from rest instead."""
_SLIDES = int(Verdict.SLIDES)


class ContactSolver:
    """Solver of batches of states of one structure under the criterion `contact`.

    A state that differs from its parent is first searched for parts that fall near the difference, with a proof
    (`neighbourhood.py`). Then a displacement is looked for (`newton.py`); where there is one the state is stable. Where
    there is none, the solver of the equilibrium problem says whether the state is unstable, with its proof, or slides.
    """

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        self.problem = problem
        self.settings = settings
        self.structure = build_structure(problem)
        self.contact_structure = build_contact_structure(assembly, problem, settings.gravity, settings.stiffness_ratio)
        self._options = kernel_options(settings)
        self.contact_options = ContactOptions(settings.tolerance, settings.cpu.contact_steps, _WARM_STEPS, FIRST_STEP)
        self._workers = Workers(settings.cpu.threads)

    def check(
        self,
        states: States,
        *,
        certificates: bool = True,
        parents: States | None = None,
        guess: NDArray[np.float64] | None = None,
    ) -> Verdicts:
        """Judge a batch.

        Args:
            states: checked states, shape (batch, parts).
            certificates: return displacement, forces and velocity too.
            parents: for each state a stable one that differs in few parts, shape (batch, parts); what falls is looked
                for near the difference first.
            guess: displacements of the parents in m and rad, NaN where they are not known, shape (batch, parts, 6);
                overwritten with the displacements that were found. Iterations start from them where no part of a state
                is free that was not free in its parent; elsewhere a start from rest takes fewer.

        Returns:
            Verdicts; `UNDECIDED` where nothing was found within the limits of the settings. Without a guess, the
            displacement of a state that slides is the one at which parts were seen to move away; NaN where there is
            neither that nor rest.
        """
        states = np.require(states, requirements=COMPILED_LAYOUT)
        if parents is not None:
            parents = np.require(parents, requirements=COMPILED_LAYOUT)
        batch, problem = len(states), self.problem
        verdicts = Verdicts.blank(
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
            known = np.isfinite(guess).all(axis=(1, 2))
            warm = known & ~((states == INSTALLED) & (parents != INSTALLED)).any(axis=1)
        origins = states[:0] if parents is None else parents
        steps = np.zeros(batch, np.int32)

        def work(rows: slice) -> None:
            _judge_range(
                self.structure,
                self.contact_structure,
                states[rows],
                origins[rows],
                RINGS,
                self._options,
                self.contact_options,
                displacement[rows],
                forces[rows],
                velocity[rows],
                warm[rows],
                guess is None,
                verdicts.verdict[rows],
                verdicts.residual[rows],
                verdicts.iterations[rows],
                steps[rows],
            )

        self._workers.run(work, batch)
        if verdicts.displacement is not None and displacement is not verdicts.displacement:
            verdicts.displacement[:] = displacement
        verdicts.iterations[:] += steps
        verdicts.proof[:] = proof_of(verdicts.verdict, "contact")
        verdicts.decided_by[:] = np.where(verdicts.verdict != Verdict.UNDECIDED, Solver.CPU, Solver.NONE)
        return verdicts


@nb.njit(nogil=True, cache=True)
def _judge_range(
    structure,
    contact_structure,
    states,
    parents,
    rings,
    options,
    contact_options,
    displacement,
    forces,
    velocity,
    warm,
    keep_sliding,
    verdict,
    residual,
    iterations,
    steps,
):
    """Judge states one after another; arrays as in `ContactSolver.check`, certificates empty where not wanted.

    With `keep_sliding` the displacement of a state that slides is left as it is; it must not become a guess.
    """
    work, contact = make_scratch(structure), make_contact_scratch(structure)
    no_forces, no_velocity = np.zeros((0, 3)), np.zeros((0, 6))
    cold = len(no_forces) > 0  # not a literal, for which numba would compile the solver anew
    for i in range(len(states)):
        force = forces[i] if len(forces) else no_forces
        motion = velocity[i] if len(velocity) else no_velocity
        iterations[i], steps[i] = 0, 0
        if len(parents):
            v, r, k, s = fall_near(structure, states[i], parents[i], rings, options, work, no_forces, motion)
            iterations[i], steps[i] = k, s
            if v == UNSTABLE:
                verdict[i], residual[i] = v, r
                displacement[i] = np.nan
                continue
        found, left, taken = solve_contact_state(
            structure, contact_structure, states[i], contact_options, work, contact, displacement[i], force, warm[i]
        )
        steps[i] += taken
        if found == RESTS:
            verdict[i], residual[i] = STABLE, left
            continue
        v, r, k, s = solve_state(structure, states[i], options, work, force, motion, cold)
        iterations[i] += k
        steps[i] += s
        if found != MOVES_AWAY:
            v = UNSTABLE if v == UNSTABLE else UNDECIDED
        elif v == STABLE:
            v = _SLIDES
        elif v == UNDECIDED:
            r = np.inf
        if v != _SLIDES or not keep_sliding:
            displacement[i] = np.nan
        verdict[i], residual[i] = v, r

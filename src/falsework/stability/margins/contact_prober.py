"""Rest positions of single states of one structure under modified friction and additional loads."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.stability.certificate import residual_of_displacement, residual_of_forces
from falsework.stability.contact.kernel import rest_under
from falsework.stability.contact.layout import ContactOptions, StepSchedule
from falsework.stability.contact.newton import MOVES_AWAY, OPEN, RESTS
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.margins.conditions import Answer, Condition, some_idle
from falsework.stability.margins.prober import Prober
from falsework.stability.second_order.springs import springs_at, springs_of_displacement
from falsework.stability.stiffness import spring_stiffness
from falsework.stability.verdict import Proof, Solver, Verdict, Verdicts

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.stability.contact.history import History

Array = NDArray[np.float64]

_SCHEDULE = StepSchedule(growth=4.0, patience=0, late_growth=4.0, growth_after_rise=2.0, memory=1.0)
"""Rules by which time steps grow: where iterations alternate between two residuals, these mostly end that."""


class ContactProber(Prober):
    """Solver of single states under conditions, of the criterion `contact`."""

    convex = False

    def __init__(self, assembly: Assembly, solver: ContactSolver) -> None:
        """Share settings and layout of a solver of the structure."""
        super().__init__(assembly, solver)
        self._law, self.contact_options = solver.contact_structure, solver.contact_options
        # No state is loaded from rest in the search for a bound. Iterations at the outer end of a bracket are continued
        # by twice as many, until parts are seen to move away.
        quick = self.contact_options.steps // 4
        self._quick_options = self.contact_options._replace(warm_steps=quick, steps=0, schedule=_SCHEDULE)
        self.further_options = self._quick_options._replace(warm_steps=2 * quick)
        self._springs: Array | None = None

    def as_built(self, history: History) -> ContactProber:
        """Return a prober whose displacements count from a state as it was built, and whose contacts remember it."""
        prober = copy(self)
        prober._springs = history.springs
        return prober

    @property
    def scales(self) -> bool:
        """As of `Prober`; what contacts remember does not grow with the weights."""
        return super().scales and self._springs is None

    def ask(
        self,
        state: States,
        condition: Condition,
        near: Answer | None = None,
        *,
        moved: Array | None = None,
        coarse: bool = False,
    ) -> Answer:
        """Check the stability of a state under a condition, as `Prober.ask`."""
        self.check_time()
        known = near is not None and near.displacement is not None
        options = self._quick_options if coarse and known else self.contact_options
        (answer,) = self._ask_contact(state, [condition], [near if known else None], moved, options)
        # What the rules of verdicts leave undecided, the other ones often decide.
        return answer if answer.coarse else self.refine(state, answer)

    def ask_each(self, state: States, conditions: Sequence[Condition], near: Sequence[Answer]) -> list[Answer]:
        """Check a state under conditions, as `Prober.ask_each`, from nearby answers alone."""
        self.check_time()
        return self._ask_contact(state, conditions, near, None, self._quick_options)

    def forces(self, state: States, answer: Answer) -> Array:
        """Return the contact forces of a stable answer, N, shape (points, 3)."""
        assert answer.displacement is not None
        changed, claim = answer.condition.applied_to(self.assembly), self.settings.claim
        if self._springs is None:
            return springs_of_displacement(changed, state[None], answer.displacement[None], claim).forces[0]
        stiffness = spring_stiffness(changed, claim.gravity, claim.stiffness_ratio)
        before = self._springs * self.problem.force_scale[:, None]
        springs = before - stiffness * self.problem.geometry.relative(answer.displacement[None])[0]
        return springs_at(changed, state[None], springs[None], claim).forces[0]

    def certify(self, state: States, answer: Answer, near: Verdicts | None = None) -> Verdicts:
        """Return the verdict of an answer as `Prober.certify`; one that stands as built is proved by its forces."""
        if self._springs is None or not answer.stands:
            return super().certify(state, answer, near)
        verdicts = self.problem.undecided(1, displaced=True)
        assert verdicts.forces is not None
        assert verdicts.displacement is not None
        verdicts.decided_by[:] = Solver.CPU
        verdicts.forces[0], verdicts.displacement[0] = self.forces(state, answer), answer.displacement
        changed, claim = answer.condition.applied_to(self.assembly), self.settings.claim
        verdicts.residual[:] = residual_of_forces(changed, state[None], verdicts.forces, claim)
        if verdicts.residual[0] <= claim.tolerance:
            verdicts.verdict[:], verdicts.proof[:] = Verdict.STABLE, Proof.HISTORY
        return verdicts

    def _ask_contact(
        self,
        state: States,
        conditions: Sequence[Condition],
        near: Sequence[Answer | None],
        moved: Array | None,
        options: ContactOptions,
    ) -> list[Answer]:
        count = len(conditions)
        displacement = np.zeros((count, self.problem.parts, 6))
        for row, answer in enumerate(near):
            if answer is not None and answer.displacement is not None:
                displacement[row] = answer.displacement
        warm = near[0] is not None
        result = np.zeros(count, np.int8)
        law, structure = self._law, self._under(conditions[0].friction)
        tried = rest_under(
            law if structure is law.structure else law._replace(structure=structure),
            np.array(state),
            self.problem.gravity_wrench + np.array([condition.extra for condition in conditions]),
            self._offsets(moved),
            options,
            displacement,
            warm,
            result,
        )
        if some_idle(self.assembly, conditions[0].friction) and self._springs is None:
            for row in np.flatnonzero(result == RESTS).tolist():
                changed, claim = conditions[row].applied_to(self.assembly), self.settings.claim
                left = residual_of_displacement(changed, state[None], displacement[row : row + 1], claim)[0]
                # Of displaced supports the checker knows nothing.
                result[row] = RESTS if left <= claim.tolerance and moved is None else OPEN
        coarse = options.steps == 0
        return [
            Answer(
                condition,
                bool(result[row] == RESTS),
                moves_away=bool(result[row] == MOVES_AWAY),
                coarse=coarse,
                displacement=displacement[row] if result[row] == RESTS else None,
                reached=displacement[row] if result[row] == OPEN else None,
            )
            for row, condition in enumerate(conditions[:tried])
        ]

    def refine(self, state: States, answer: Answer) -> Answer:
        """Continue the iterations of an answer from where they ended undecided, if they did."""
        if answer.reached is None:
            return answer
        self.check_time()
        guess, options = replace(answer, displacement=answer.reached), self.further_options
        (found,) = self._ask_contact(state, [answer.condition], [guess], None, options)
        return replace(found, coarse=answer.coarse)

    def _offsets(self, moved: Array | None) -> Array:
        """Return the scaled spring forces at zero displacement, of history and displaced fixed parts, or none.

        Shape (points, 3) or (0, 3).
        """
        before = np.zeros((0, 3)) if self._springs is None else self._springs
        if moved is None:
            return before
        problem, law = self.problem, self._law
        relative = problem.geometry.relative(moved[None])[0]
        stiffness = np.stack([law.normal, law.tangential, law.tangential], axis=1)
        # Scaled springs act on relative displacements times `force_scale`, in units of `scale`.
        settled = -stiffness * relative * (problem.force_scale / law.scale)[:, None]
        return settled if self._springs is None else before + settled

"""Judge of plans: each is built by discrete elements on springs as stiff as the contacts of the criterion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isqrt

from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import as_states
from falsework.stability.holds import HoldSettings, Press
from falsework.stability.judges.discrete_elements import (
    POINTS,
    STIFF,
    Build,
    ContactForces,
    DiscreteElementSettings,
    added_wrenches,
    models_of,
    typical_size,
    typical_weight,
)
from falsework.stability.judges.judgement import Judgement
from falsework.stability.judges.relaxation import FALLS, OPEN
from falsework.stability.stiffness import normal_stiffness

_PATIENT = 100_000
"""Steps after which a state is left undecided."""


def matched_sink(assembly: Assembly) -> float:
    """Return the settlement of a typical part, in part sizes, on contact springs as stiff as those of the criterion."""
    stiffness = normal_stiffness(assembly)
    if not len(stiffness):
        return STIFF
    return float(typical_weight(assembly) / (POINTS * typical_size(assembly) * stiffness.mean()))


class BuildJudge:
    """Judge of plans, which builds each from where it differs from the one before."""

    def __init__(self, assembly: Assembly, holds: HoldSettings = HoldSettings()) -> None:
        """Lay out the structure.

        Args:
            assembly: the structure.
            holds: stiffness and mode of the robots.

        Raises:
            InputError: a structure with joints.
        """
        settings = DiscreteElementSettings(sinks=(matched_sink(assembly),), steps=_PATIENT)
        self._assembly = assembly
        size, (model,) = models_of(assembly, settings)
        self._build = Build(assembly, size, model, settings, holds)
        self._steps: list[tuple[bytes, tuple[Press, ...]]] = []
        self._answers: list[tuple[int, float, int]] = []
        self._kept: dict[int, ContactForces] = {}
        self._whole = True

    def judge(
        self, states: ArrayLike, presses: Sequence[Sequence[Press]], stop: Callable[[], bool] = lambda: False
    ) -> Judgement:
        """Build a plan under the true friction, up to the first state that collapses.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            presses: those of the step that leads to each state, one entry a state.
            stop: asked before every state; true leaves the others out.

        Raises:
            InputError, StateError: as `replay_by_discrete_elements`.
        """
        batch = as_states(states, self._assembly.boundary)
        added = added_wrenches(self._assembly, batch, presses)
        steps = [(state.tobytes(), tuple(press)) for state, press in zip(batch, presses, strict=True)]
        begin = self._backtrack(steps)
        every = isqrt(len(batch)) + 1  # as many are kept as are built again at most
        for row in range(begin, len(batch)):
            if (self._answers and self._answers[-1][0] == FALLS) or stop():
                break
            if row % every == 0:
                self._kept[row] = self._build.forces.copy()
            self._whole = False  # where the keyboard interrupts the step
            answer = self._build.step(batch[row], added[row], row)
            self._steps.append(steps[row])
            self._answers.append(answer)
            self._whole = True
        found = [answer[0] for answer in self._answers]
        undecided = tuple(row for row, answer in enumerate(found) if answer == OPEN)
        if found and found[-1] == FALLS:
            return Judgement(len(found) - 1, len(batch), len(found) - 1, int(self._answers[-1][2]), undecided)
        return Judgement(len(found), len(batch), undecided=undecided)

    def _backtrack(self, steps: list[tuple[bytes, tuple[Press, ...]]]) -> int:
        """Return the state from which to build, the last with known forces before the first that differs."""
        same = 0
        while same < min(len(steps), len(self._steps)) and steps[same] == self._steps[same]:
            same += 1
        if self._whole and same == len(self._steps) and self._answers:
            return same  # goes on where it was stopped
        begin = max((row for row in self._kept if row <= same), default=0)
        self._build.forces = self._kept[begin].copy() if begin in self._kept else self._build.nothing()
        self._kept = {row: forces for row, forces in self._kept.items() if row <= begin}
        del self._steps[begin:], self._answers[begin:]
        return begin

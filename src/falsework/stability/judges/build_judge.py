"""Judge of plans: each is built by discrete elements on springs as stiff as the contacts of the criterion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.state import as_states
from falsework.errors import InputError
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
from falsework.stability.judges.relaxation import FALLS, OPEN
from falsework.stability.stiffness import normal_stiffness

_PATIENT = 100_000
"""Steps after which a state is left undecided."""
_KEPT = 64
"""States of a plan whose forces are kept, to build another from there."""


def matched_sink(assembly: Assembly) -> float:
    """Return the settlement of a typical part, in part sizes, on contact springs as stiff as those of the criterion."""
    stiffness = normal_stiffness(assembly)
    if not len(stiffness):
        return STIFF
    return float(typical_weight(assembly) / (POINTS * typical_size(assembly) * stiffness.mean()))


@dataclass(frozen=True)
class Judgement:
    """How far a plan was built by discrete elements on springs as stiff as the contacts of the criterion."""

    built: int
    """States that came to rest or were left undecided, from the first on, in the order of assembly."""
    of: int
    """States of the plan."""
    falls_at: int | None = None
    """The next state if it collapses; None if it does not, or was not built before the time was up."""
    part: int = -1
    """The part that moved most there; -1 if nothing falls."""
    undecided: tuple[int, ...] = ()
    """States in which parts still moved at the step limit, without having collapsed."""

    @property
    def stands(self) -> bool:
        """Whether every state was built and none collapses."""
        return self.built == self.of

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {**vars(self), "undecided": list(self.undecided)}

    @classmethod
    def read(cls, data: Any, states: int, parts: int) -> Judgement:
        """Read what `to_dict` returned for a plan of so many states and parts.

        Raises:
            InputError: anything else.
        """
        if not isinstance(data, dict) or set(data) != set(cls.__dataclass_fields__):
            raise InputError(f"it must have {', '.join(cls.__dataclass_fields__)}, and nothing else")
        built, falls_at, undecided = data["built"], data["falls_at"], data["undecided"]
        rows = [built, data["of"], *(undecided if isinstance(undecided, list) else [None])]
        if not all(type(row) is int and 0 <= row <= states for row in rows) or data["of"] != states:
            raise InputError(f"built, of and undecided must be numbers of states; the plan has {states}")
        known = falls_at is None or (type(falls_at) is int and falls_at == built < states)
        if not known or any(row >= built for row in undecided):
            raise InputError(f"{built} states were built, which does not go with falls_at or undecided")
        if type(data["part"]) is not int or not -1 <= data["part"] < parts:
            raise InputError(f"part is {data['part']!r}; it must be a part number below {parts}, or -1")
        return cls(built, states, falls_at, data["part"], tuple(undecided))


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
        begin = self._go_back(steps)
        every = -(-len(batch) // _KEPT)
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

    def _go_back(self, steps: list[tuple[bytes, tuple[Press, ...]]]) -> int:
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

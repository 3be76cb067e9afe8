"""Difference between an old plan and a new one, as text and as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from falsework.assembly.state import REMOVED, States
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.search.problem.task import Direction
from falsework.utils.quantity import counted

_NAMED = 5
"""Parts that the text names one by one, at most."""


@dataclass(frozen=True)
class MovedPart:
    """Part whose position in the order has changed."""

    part: int
    name: str
    before: int
    """Place in the old plan among the parts that both plans place, from 1 on."""
    now: int
    """Place in the new plan."""

    @property
    def places(self) -> int:
        """How many places later; earlier if negative."""
        return self.now - self.before


@dataclass(frozen=True)
class Difference:
    """Changes between an old plan and a new one."""

    direction: Direction
    """In which both plans are compared."""
    same: bool
    """Whether the new plan is the rest of the old one, step by step."""
    common_steps: int
    """Steps that are the same in both, from where the new plan begins."""
    first_old: str
    """First step of the old plan that is different now, in words; empty if there is none."""
    first_new: str
    """First step of the new plan that is different, in words; empty if there is none."""
    old_steps: int
    """Steps of the old plan that were left to do where the new one begins."""
    new_steps: int
    begins_on_the_way: bool
    """Whether the new plan begins in a state that the old one passes through; if not, it is compared from its start."""
    moved: tuple[MovedPart, ...]
    """Parts that both plans place, at another place in their order: those that moved farthest first."""
    added: tuple[str, ...]
    """Parts that only the new plan places."""
    dropped: tuple[str, ...]
    """Parts that only the rest of the old plan places."""
    order_kept: float
    """Share of pairs of parts that come in the same order in both plans, between 0 and 1."""
    built: int = 0
    """Steps of the new plan that are done."""

    @property
    def steps_saved(self) -> int:
        """Number of steps that the new plan saves compared with the rest of the old one; negative if it has more."""
        return self.old_steps - self.new_steps

    @property
    def text(self) -> str:
        """Summary in one line."""
        if self.same:
            return f"the plan stays as it was; steps left: {self.new_steps - self.built}"
        pieces = []
        if not self.begins_on_the_way:
            pieces.append("the old plan does not pass through this state")
        elif self.common_steps:
            many = self.common_steps > 1
            pieces.append(f"the first {self.common_steps} steps stay as they were" if many else "the first step stays")
        if self.first_new or self.first_old:
            when = "then" if self.common_steps else "next"
            pieces.append(f"{when} {self.first_new or 'nothing'} instead of {self.first_old or 'nothing'}")
        for move in self.moved[:_NAMED]:
            far = counted(abs(move.places), "place")
            pieces.append(f"{move.name} comes {far} {'later' if move.places > 0 else 'earlier'}")
        if len(self.moved) > _NAMED:
            rest = len(self.moved) - _NAMED
            pieces.append(f"{rest} more {'part changes its place' if rest == 1 else 'parts change their places'}")
        if self.added:
            pieces.append(f"new: {', '.join(self.added)}")
        if self.dropped:
            pieces.append(f"no longer: {', '.join(self.dropped)}")
        if self.steps_saved:
            pieces.append(f"{counted(abs(self.steps_saved), 'step')} {'fewer' if self.steps_saved > 0 else 'more'}")
        return "; ".join(pieces)

    def to_dict(self) -> dict[str, Any]:
        """Return the difference as a JSON object."""
        return asdict(self) | {
            "direction": self.direction.value,
            "steps_saved": self.steps_saved,
            "moved": [asdict(move) | {"places": move.places} for move in self.moved],
            "added": list(self.added),
            "dropped": list(self.dropped),
            "order_kept": round(self.order_kept, 4),
            "text": self.text,
        }


def difference(old: Plan, new: Plan, direction: Direction = Direction.ASSEMBLY, built: int = 0) -> Difference:
    """Compare a new plan with the plan that it replaces.

    The old plan is read from the state on in which the new one begins, if it passes through that.

    Args:
        old: the plan so far.
        new: the plan from now on.
        direction: in which both are carried out.
        built: steps of the new plan that are done.

    Raises:
        PlanError: the plans are of different structures.
    """
    if old.identity != new.identity:
        raise PlanError(f"the plans are of different structures, {old.name} and {new.name}; compare plans of one")
    way = 1 if direction is Direction.ASSEMBLY else -1
    here = np.flatnonzero((old.states[::way] == new.states[::way][0]).all(axis=1))
    begin = int(here[0]) if len(here) else 0
    left, now = old.states[::way][begin + 1 :], new.states[::way][1:]
    shared = min(len(left), len(now))
    differs = np.flatnonzero((left[:shared] != now[:shared]).any(axis=1) | (not len(here)))
    common = int(differs[0]) if len(differs) else shared
    before, after = _placed(old.states[::way][begin:]), _placed(new.states[::way])
    both = [part for part in after if part in set(before)]
    place = {part: number for number, part in enumerate((part for part in before if part in set(after)), 1)}
    moves = [
        MovedPart(part, new.part_names[part], place[part], number)
        for number, part in enumerate(both, 1)
        if place[part] != number
    ]
    return Difference(
        direction=direction,
        same=len(here) > 0 and len(left) == len(now) == common,
        common_steps=common if len(here) else 0,
        first_old=old.in_order(direction)[begin + common].words if common < len(left) else "",
        first_new=new.in_order(direction)[common].words if common < len(now) else "",
        old_steps=len(left),
        new_steps=len(now),
        begins_on_the_way=len(here) > 0,
        moved=tuple(sorted(moves, key=lambda move: (-abs(move.places), move.now))),
        added=tuple(new.part_names[part] for part in after if part not in set(before)),
        dropped=tuple(new.part_names[part] for part in before if part not in set(after)),
        order_kept=_order_kept([place[part] for part in both]),
        built=built,
    )


def _placed(states: States) -> list[int]:
    """Return parts in the order in which they are inserted, or removed; of several at once, by number."""
    changes = np.argwhere((states[1:] != REMOVED) != (states[:-1] != REMOVED))
    return list(dict.fromkeys(changes[:, 1].tolist()))  # a prop is placed and taken away


def _order_kept(places: list[int]) -> float:
    count = len(places)
    if count < 2:
        return 1.0
    row = np.array(places)
    first, second = np.triu_indices(count, 1)
    return float((row[first] < row[second]).mean())

"""Disruptions on site, marked by clicks, and the replanning request that results from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.assembly.props import whole_state
from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, empty_state
from falsework.errors import InputError
from falsework.replanning.since import SiteSteps
from falsework.search.problem.task import Direction

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly


class ClickMode(StrEnum):
    """Effect of a click on a part."""

    LOOK = "look at it"
    MISSING = "mark as missing"
    THERE = "mark as already there"
    HOLD = "hold or release with a robot"
    PROP = "place a prop under it"
    FIXED = "mark as not to be touched"
    TARGET = "add to or remove from the target"


@dataclass(frozen=True)
class Disruption:
    """Deviations on site from the plan."""

    missing: frozenset[int] = frozenset()
    """Parts that have not been delivered."""
    there: frozenset[int] = frozenset()
    """Parts that have been placed already."""
    turned: frozenset[int] = frozenset()
    """Parts that are held although the plan has released them, or the other way round."""
    props: frozenset[int] = frozenset()
    """Parts under which props have been placed that the plan does not have."""
    fixed: frozenset[int] = frozenset()
    """Parts that are not to be touched."""
    target: frozenset[int] = frozenset()
    """Parts whose target differs from the default: in assembly they are left out, in disassembly they stay."""
    robots: int = 2

    def toggled(self, tool: ClickMode, part: int, assembly: Assembly, state: States) -> Disruption:
        """Return the same disruption with one mark set, or removed if it was set."""
        if tool is ClickMode.LOOK:
            return self
        name = assembly.names[part]
        if assembly.boundary[part]:
            raise InputError(f"{name} is boundary, which never changes; click another part")
        if assembly.immovable[part]:
            raise InputError(f"{name} is a prop, which the plan places and takes away; click another part")
        if tool in (ClickMode.HOLD, ClickMode.PROP) and self.applied_to(state, assembly)[part] == REMOVED:
            raise InputError(f"{name} is not there yet; click a part that is")
        if tool is ClickMode.PROP and state[[*prop_parts(assembly, part)]].any():
            raise InputError(f"a prop stands under {name} already; click another part")
        field = {
            ClickMode.MISSING: "missing",
            ClickMode.THERE: "there",
            ClickMode.HOLD: "turned",
            ClickMode.PROP: "props",
            ClickMode.FIXED: "fixed",
            ClickMode.TARGET: "target",
        }[tool]
        marked: frozenset[int] = getattr(self, field)
        changed = replace(self, **{field: marked ^ {part}})
        if tool is ClickMode.MISSING:  # a missing part is not already there, and vice versa
            return replace(changed, there=changed.there - changed.missing)
        if tool is ClickMode.THERE:
            return replace(changed, missing=changed.missing - changed.there)
        return changed

    @property
    def empty(self) -> bool:
        """Whether nothing is marked."""
        return not (self.changes_state or self.fixed or self.target)

    @property
    def changes_state(self) -> bool:
        """Whether the state on site differs from that of the plan."""
        return bool(self.missing or self.there or self.turned or self.props)

    def found(self, state: States) -> States:
        """Return the state with the presence of parts that the marks give, holds aside; shape (parts,)."""
        site = state.copy()
        site[list(self.missing)] = REMOVED
        for part in self.there:
            if site[part] == REMOVED:
                site[part] = INSTALLED
        return site

    def since(self, state: States) -> SiteSteps:
        """Return what has been done since a state of the plan, shape (parts,), was reached."""
        held = tuple(part for part in sorted(self.turned) if state[part] == INSTALLED)
        released = tuple(part for part in sorted(self.turned) if state[part] == HELD)
        return SiteSteps(tuple(sorted(self.props)), held, released)

    def applied_to(self, state: States, assembly: Assembly) -> States:
        """Return the state on site according to the marks, shape (parts,)."""
        site = self.found(state)
        for part in self.props:
            site[[*prop_parts(assembly, part)]] = HELD
        for part in self.turned:
            if site[part] != REMOVED:
                site[part] = INSTALLED if site[part] == HELD else HELD
        return site

    def question(self, assembly: Assembly, state: States, direction: Direction) -> dict[str, Any]:
        """Return arguments for `falsework.replanning.replanner.replan`."""
        missing = self.missing
        site = self.applied_to(state, assembly)
        if direction is Direction.ASSEMBLY:
            target = whole_state(assembly)
            target[list(self.target)] = REMOVED
            missing = frozenset(part for part in missing if target[part] != REMOVED)
        else:
            # Disassembly cannot wait for a delivery: a missing part is simply absent.
            missing = frozenset()
            target = empty_state(assembly.boundary)
            kept = [part for part in self.target if site[part] != REMOVED]
            target[kept] = site[kept]
        fixed = [part for part in sorted(self.fixed) if part not in self.missing]
        target[fixed] = site[fixed]
        return {
            "state": site,
            "target": target,
            "direction": direction,
            "robots": self.robots,
            "missing": tuple(sorted(missing)),
            "fixed": tuple(fixed),
        }

    def words(self, assembly: Assembly) -> str:
        """Describe the marks; empty if there are none."""
        texts = []
        for word, parts in (
            ("missing", self.missing),
            ("already there", self.there),
            ("held or released", self.turned),
            ("a prop under", self.props),
            ("not to be touched", self.fixed),
            ("target changed", self.target),
        ):
            if parts:
                texts.append(f"{word}: {', '.join(assembly.names[part] for part in sorted(parts))}")
        return "; ".join(texts)


def prop_parts(assembly: Assembly, part: int) -> Iterator[int]:
    """Yield the props that stand under a part where they are in place, which are parts too."""
    first = assembly.part_count - len(assembly.props)
    yield from (first + number for number, prop in enumerate(assembly.props) if prop.part == part)


def chance_of_parts(probabilities: np.ndarray) -> np.ndarray:
    """Return the probability of the action on each part, NaN where none is legal.

    Args:
        probabilities: of all actions, illegal ones zero, shape (2 parts,).

    Returns:
        Shape (parts,).
    """
    both = probabilities.reshape(2, -1).sum(axis=0).astype(float)
    return np.where(both > 0, both, np.nan)

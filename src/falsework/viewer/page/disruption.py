"""Disruptions on site, marked by clicks, and the replanning request that results from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, complete_state, empty_state
from falsework.errors import InputError
from falsework.replanning.plan_diff import difference
from falsework.search.problem.task import Direction
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.replanning.result import ReplanResult
    from falsework.search.plans.plan import Plan


class ClickMode(StrEnum):
    """Effect of a click on a part."""

    LOOK = "look at it"
    MISSING = "mark as missing"
    THERE = "mark as already there"
    HOLD = "hold or release with a robot"
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
    fixed: frozenset[int] = frozenset()
    """Parts that are not to be touched."""
    target: frozenset[int] = frozenset()
    """Parts whose target differs from the default: in assembly they are left out, in disassembly they stay."""
    robots: int = 2

    def toggled(self, tool: ClickMode, part: int, assembly: Assembly) -> Disruption:
        """Return the same disruption with one mark set, or removed if it was set.

        Raises:
            InputError: the part is boundary, which cannot be marked.
        """
        if tool is ClickMode.LOOK:
            return self
        if assembly.boundary[part]:
            raise InputError(f"{assembly.names[part]} is boundary, which never changes; click another part")
        field = {
            ClickMode.MISSING: "missing",
            ClickMode.THERE: "there",
            ClickMode.HOLD: "turned",
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
        return bool(self.missing or self.there or self.turned)

    def applied_to(self, state: States) -> States:
        """Return the state on site, with the parts that are there and held according to the marks; shape (parts,)."""
        site = state.copy()
        site[list(self.missing)] = REMOVED
        for part in self.there:
            if site[part] == REMOVED:
                site[part] = INSTALLED
        for part in self.turned:
            if site[part] != REMOVED:
                site[part] = INSTALLED if site[part] == HELD else HELD
        return site

    def question(self, assembly: Assembly, state: States, direction: Direction) -> dict[str, Any]:
        """Return arguments for `falsework.replanning.replanner.replan`.

        Args:
            assembly: the structure.
            state: state that the plan has reached, shape (parts,).
            direction: whether parts are being added or removed.
        """
        missing = self.missing
        if direction is Direction.ASSEMBLY:
            site = self.applied_to(state)
            target = complete_state(assembly.boundary)
            target[list(self.target)] = REMOVED
            missing = frozenset(part for part in missing if target[part] != REMOVED)
        else:
            # Disassembly cannot wait for a delivery: a missing part is simply absent.
            site, missing = self.applied_to(state), frozenset()
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
            ("not to be touched", self.fixed),
            ("target changed", self.target),
        ):
            if parts:
                texts.append(f"{word}: {', '.join(assembly.names[part] for part in sorted(parts))}")
        return "; ".join(texts)


@dataclass(frozen=True, eq=False)
class NewPlan:
    """Result of a replanning request."""

    found: bool
    words: str
    """Deciding stage, time taken, when late parts are needed, and differences from the old plan; or the reason for
    none."""
    seconds: float
    decided_by: str
    plan: Plan | None = None


def new_plan(answer: ReplanResult, seconds: float, old: Plan | None, before: int) -> NewPlan:
    """Describe the answer to a request.

    Args:
        answer: of the replanner.
        seconds: that it took.
        old: plan that was shown before.
        before: steps that are done and not in the new plan, with which its numbers go on.
    """
    decided = answer.decided_by.value
    if answer.value is None:
        kind = "there is no plan" if answer.outcome.value == "proved_impossible" else "no plan was found"
        return NewPlan(False, f"{kind} ({seconds:.2f} s, {decided}): {answer.reason}", seconds, decided)
    plan = answer.value
    texts = [f"{len(plan) - answer.built} steps in {seconds:.2f} s, decided by {decided}."]
    placed = int((plan.actions[: answer.built] >= len(plan.boundary)).sum())
    for need in plan.needs:
        name, others = plan.part_names[need.part], need.after_parts - placed
        after = f"after {counted(others, 'other part')}" if others else "before any other part"
        texts.append(f"{name} is needed at step {before + need.after_steps + 1}, {after}.")
    if old is None:
        texts.append("There was no plan before.")
    else:
        text = difference(old, plan, answer.direction).text
        texts.append(f"{text[:1].upper()}{text[1:]}.")
        if plan.source is None:
            plan = replace(plan, source=old.source)
    return NewPlan(True, " ".join(texts), seconds, decided, plan)


def chance_of_parts(probabilities: np.ndarray) -> np.ndarray:
    """Return the probability of the action on each part, NaN where none is legal.

    Args:
        probabilities: of all actions, illegal ones zero, shape (2 parts,).

    Returns:
        Shape (parts,).
    """
    both = probabilities.reshape(2, -1).sum(axis=0).astype(float)
    return np.where(both > 0, both, np.nan)

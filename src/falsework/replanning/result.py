"""Replanning result: proven plans or the reason for none, the deciding stage, and a time account."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from msgspec import to_builtins
from numpy.typing import NDArray

from falsework.replanning.request_replayer import Replayed
from falsework.search.plans.plan import Plan
from falsework.search.problem.result import Outcome, Result, SearchResult
from falsework.search.problem.task import Direction
from falsework.stability.verdict import Criterion
from falsework.utils.display.notebook import Displayed
from falsework.utils.quantity import counted


class Stage(StrEnum):
    """Stage that found the first plan, or proved that there is none."""

    NONE = "none"
    """No stage found an answer."""
    RULES = "rules"
    """The state is the target already, or one of the two is not stable."""
    PLAN = "rest of the plan"
    """The rest of the plan that is carried out."""
    GREEDY = "policy greedy"
    """The most probable actions of the policy."""
    SAMPLED = "policy sampled"
    """Actions drawn from the probabilities of the policy."""
    GUIDED = "guided search"
    """A beam search that the policy guides."""
    SEARCH = "search"
    """A beam search without a policy."""
    EXHAUSTIVE = "exhaustive"
    """A search through all reachable states."""


@dataclass(frozen=True, eq=False, repr=False)
class ReplanResult(Result[Plan], Displayed):
    """Result of one request."""

    plans: tuple[Plan, ...]
    """Proven plans between the state and the target, in the order of assembly; the first is the best."""
    outcome: Outcome
    """Found; proved impossible; or not found, which proves nothing."""
    decided_by: Stage
    direction: Direction
    """How they are carried out: assembly adds parts, disassembly removes them and undoes the last step first."""
    steps: int
    """Actions between the state and the target."""
    reached: int
    """Number of actions on the longest stable path found from the state; `steps` if there is a plan."""
    seconds: float
    spent: Mapping[str, float] = field(default_factory=dict)
    """Seconds by kind of work: policy, verdicts, proofs; the rest is search and bookkeeping."""
    verdicts: int = 0
    """States checked by the oracle."""
    deadline_passed: bool = False
    """Whether the deadline cut the work short: more time might give a plan, or a better one."""
    reason: str = ""
    """Why there is no plan, in words; empty if there is one."""
    moving: tuple[int, ...] = ()
    """Where there is no plan: parts that move in the states where the search stopped, the most frequent first."""
    distance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    """How much the plans differ, between 0 and 1, shape (plans, plans)."""
    confidences: tuple[NDArray[np.float32], ...] = ()
    """For each plan the probability under the policy of every action of disassembly in every state of the plan, shape
    (steps + 1, 2 parts), illegal actions exactly zero. Only if requested and there is a policy."""
    criterion: Criterion = "contact"
    """Stability criterion of the states of the plans."""
    replays: tuple[Replayed, ...] = ()
    """Result of the replay of each plan in the order of assembly; none under `equilibrium`, which has no contact
    history."""
    search: SearchResult | None = None
    """How the last search ended, if there was one."""
    built: int = 0
    """Steps that are done, with which the plans begin; those from now on have the numbers after it."""
    unreserved: str = ""

    @property
    def value(self) -> Plan | None:
        """The first plan."""
        return self.plans[0] if self.plans else None

    @property
    def open_replay(self) -> str:
        """What the deadline left open of the replays of the plans, in words; empty if all succeed."""
        found = []
        for number, replayed in enumerate(self.replays, 1):
            which = "this one" if number == 1 else f"plan {number}"
            of = f"the {counted(replayed.of, 'step')} of assembly{'' if number == 1 else f' of {which}'}"
            if replayed.stands is None:
                found.append(f"the deadline left time to replay {replayed.steps} of {of}")
            elif not replayed.stands:
                fails = f"the replay of {which} fails at step {replayed.steps + 1}"
                found.append(f"the deadline left no time for another plan; {fails}")
        return "; ".join(found)

    @property
    def bound(self) -> None:
        """None: plans are not optimised."""
        return

    @property
    def statistics(self) -> dict[str, Any]:
        """Work of the search: `seconds`, `verdicts`, and the seconds `spent` by kind of work."""
        return {"seconds": self.seconds, "verdicts": self.verdicts, "spent": dict(self.spent)}

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON object, without the plans themselves."""
        record: dict[str, Any] = {
            "outcome": self.outcome.value,
            "decided_by": self.decided_by.value,
            "direction": self.direction.value,
            "plans": len(self.plans),
            "built": self.built,
            "steps": self.steps,
            "reached": self.reached,
            "seconds": round(self.seconds, 6),
            "spent_seconds": {name: round(seconds, 6) for name, seconds in self.spent.items()},
            "verdicts": self.verdicts,
            "deadline_passed": self.deadline_passed,
            "criterion": self.criterion,
        }
        if self.replays:
            record["replay"] = self.replays[0].to_dict()
            if len(self.replays) > 1:
                record["replays"] = [replayed.to_dict() for replayed in self.replays]
        if self.plans:
            record["actions"] = [
                f"{step.action} {step.name}" for step in self.plans[0].in_order(self.direction)[self.built :]
            ]
            record["needs"] = to_builtins(self.plans[0].needs)
            if len(self.plans) > 1:
                record["distances"] = np.round(self.distance, 4).tolist()
        else:
            record |= {"reason": self.reason, "moving": list(self.moving)}
        return record

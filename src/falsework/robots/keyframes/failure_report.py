"""Failure log of a robot planning search: part, robot, bodies and pose of every failure, and a summary in text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from msgspec import to_builtins

from falsework.assembly.state import describe_step
from falsework.robots.model.shapes import Array
from falsework.search.problem.result import Route
from falsework.utils.quantity import listed

_DOING = {"insert": "inserting", "release": "releasing", "hold": "holding"}
_SHOWN = 8
"""Failures that an explanation lists."""


@dataclass(frozen=True)
class LoggedFailure:
    """One failure."""

    action: str
    """`hold`, `release` or `remove`."""
    part: int
    robot: int
    what: str
    pair: tuple[str, str] | None = None
    """Names of the bodies that came too near."""


@dataclass
class FailureLog:
    """Failure counts of a search, with one example configuration of each kind."""

    counts: Counter[LoggedFailure] = field(default_factory=Counter)
    examples: dict[LoggedFailure, Array] = field(default_factory=dict)
    recent: set[LoggedFailure] = field(default_factory=set)
    """Failures since the last reset."""

    def add(
        self,
        action: str,
        part: int,
        robot: int,
        what: str,
        pair: tuple[str, str] | None = None,
        at: Array | None = None,
    ) -> None:
        """Record a failure."""
        reason = LoggedFailure(action, int(part), int(robot), what, pair)
        self.counts[reason] += 1
        self.recent.add(reason)
        if at is not None:
            self.examples.setdefault(reason, np.asarray(at))


@dataclass(frozen=True)
class Explanation:
    """Explanation of a missing or partial robot plan."""

    outcome: str
    """`proved_impossible`, `not_found` or `interrupted`."""
    reached: int
    """Steps of the longest plan that was found."""
    steps: int
    """Steps of a complete plan."""
    unreachable: tuple[int, ...]
    """Parts that no robot can hold at all."""
    hopeless: tuple[int, str] | None
    """Part and kind of the action that failed most often where the search got farthest."""
    details: tuple[dict[str, Any], ...]
    """Most frequent failures there: action, part, robot, reason (`what`), pair, configuration, count."""
    text: str
    """Everything in one line."""

    def to_dict(self) -> dict[str, Any]:
        """Return the explanation as a JSON object."""
        hopeless = None if self.hopeless is None else {"part": self.hopeless[0], "action": self.hopeless[1]}
        return {**to_builtins(self), "hopeless": hopeless}


def describe_failure(what: str, route: Route, row: int, names: Sequence[str], plans: int = 0) -> str:
    """Return in words at which state, numbered in assembly order, the structure collapses in the replay of a plan."""
    place = "in the first state, which is loaded from rest"
    if row:
        before, after = route.states[::-1][row - 1 : row + 1]
        verb, name = describe_step(before, after, names).split(" ", 1)
        place = f"at step {row} of assembly, {_DOING[verb]} {name}"
    counted = f" ({plans} such plans)" if plans else ""
    return f"every state of a {what} is stable, but the structure collapses in the replay {place}{counted}"


def explain(
    outcome: str,
    reached: int,
    steps: int,
    reasons: FailureLog,
    tried: Mapping[tuple[str, int], int],
    robots: Sequence[str],
    names: Sequence[str],
    *,
    unreachable: Sequence[int] = (),
    limit: str = "",
    abstract: bool = False,
) -> Explanation:
    """Describe the failures of a search; `tried` has the actions that failed where it got farthest, with counts.

    `limit` is what ended the search; `abstract`: even a plan without motions is missing.
    """
    hopeless = max(tried, key=lambda key: (tried[key], -key[1])) if tried else None
    focus = {(kind, part) for kind, part in tried} | {("hold", part) for part in unreachable}
    details: list[dict[str, Any]] = []
    for reason, count in reasons.counts.most_common():
        # A hold may fail because the part could not leave later with that grasp.
        if (reason.action, reason.part) not in focus and ("hold", reason.part) not in focus:
            continue
        at = reasons.examples.get(reason)
        details.append(
            {
                "action": reason.action,
                "part": names[reason.part],
                "robot": robots[reason.robot],
                "what": reason.what,
                "pair": None if reason.pair is None else list(reason.pair),
                "configuration": None if at is None else [round(float(value), 5) for value in at],
                "count": count,
            }
        )
        if len(details) == _SHOWN:
            break
    words = {
        "proved_impossible": "no plan exists",
        "not_found": "no robot plan was found",
        "interrupted": "the search for a robot plan was stopped",
    }
    pieces = [words[outcome]]
    if abstract and outcome == "interrupted":
        pieces.append("not even an order of actions without motions was found by then")
    elif abstract:
        pieces.append("stability and exit directions alone allow no order of actions; falsework plan explains why")
    else:
        pieces.append(f"the search reached step {reached} of {steps}")
    if unreachable:
        pieces.append(f"no robot can hold {listed([names[part] for part in unreachable])}")
    if hopeless is not None:
        kind, part = hopeless
        pieces.append(f"most failures there: {kind} {names[part]}")
    for entry in details[:2]:
        pair = "" if entry["pair"] is None else f" ({entry['pair'][0]} and {entry['pair'][1]})"
        pieces.append(f"{entry['robot']}, {entry['action']} {entry['part']}: {entry['what']}{pair}")
    if limit:
        pieces.append(limit)
    worst = None if hopeless is None else (hopeless[1], hopeless[0])
    return Explanation(outcome, reached, steps, tuple(unreachable), worst, tuple(details), "; ".join(pieces))

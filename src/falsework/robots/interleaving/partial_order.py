"""Prefix of an order of steps, with the earliest times at which its motions can be executed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from falsework.robots.interleaving.work import ArmSweep, Leg, Unit, Work, bits
from falsework.robots.keyframes.keyframes import Edge, Node

_Value = TypeVar("_Value")

_MEAN = 0.2
"""Weight of the mean end of all robots beside that of the last: a robot that is done early can take over more steps."""


class UnitStep(NamedTuple):
    """Step of a unit with the variants of its motions."""

    unit: Unit
    place: int
    """Index of the step in its unit."""
    legs: tuple[Leg, ...]

    @property
    def action(self) -> int:
        """Action that it carries out; in a hand-over the part."""
        return self.unit.edges[self.place].action

    @property
    def hands_over(self) -> bool:
        """Whether it is half of a hand-over, which changes no state."""
        return self.unit.edges[self.place].hands_over

    @property
    def edge(self) -> Edge:
        """Edge of the keyframe graph that it executes, with the free motion that was chosen."""
        edge = self.unit.edges[self.place]
        if edge.put_down is not None:  # whose motions have no variants
            return edge
        free = next((leg.segment for leg in self.legs if leg.segment.kind == "free"), None)
        segments = tuple(segment if segment.kind == "line" else free for segment in edge.segments)
        return replace(edge, segments=tuple(s for s in segments if s is not None))


class Partial(NamedTuple):
    """Prefix of an order: the keyframe that it leads to, and the time at which it is reached."""

    steps: tuple[UnitStep, ...]
    node: Node
    key: bytes
    """State of the keyframe."""
    present: int
    """Parts in place there, as bits."""
    jobs: frozenset[int]
    """Jobs that were begun."""
    begun: tuple[tuple[Unit, int] | None, ...]
    """Unit that each robot has begun, with the index of its next step."""
    last: tuple[Unit | None, ...]
    """Last unit of each robot."""
    ahead: tuple[float, ...]
    """Seconds of motion that are left for each robot."""
    free: tuple[float, ...]
    """Time at which each robot is done so far, seconds."""
    event: float
    """Time at which the structure reaches the state, seconds."""
    past: tuple[tuple[tuple[ArmSweep, float, float], ...], ...]
    """Motions and rests of each robot after the time at which another robot is done, with begin and end, seconds."""
    rests: tuple[ArmSweep, ...]
    """Swept bodies of each robot at rest."""
    left: tuple[tuple[int, float], ...]
    """Parts that are removed after the time at which some robot is done, each with the time from which on nothing meets
    it, seconds."""

    def score(self, hold: float) -> float:
        """Return a lower bound on the makespan, apart from waits for other robots, and a share of the mean end.

        A robot that holds nothing can do a hold, of some duration, before the next change of the state.
        """
        return bound(self.free, self.ahead, self.event, [0.0 if entry else hold for entry in self.begun])

    @property
    def end(self) -> float:
        """Time at which the last robot is done so far."""
        return max(self.free)


def bound(free: Sequence[float], ahead: Sequence[float], event: float, before: Sequence[float]) -> float:
    """Return `Partial.score`; `before` are the seconds that each robot needs before it changes the state."""
    ends = []
    for done, left, first in zip(free, ahead, before, strict=True):
        if left:
            moment = done + first
            done = (moment if moment > event else event) + left - first
        ends.append(done)
    return max(ends) + _MEAN * sum(ends) / len(ends)


def expected(partial: Partial, robot: int, unit: Unit, place: int, hold: float, *, builds: bool) -> float:
    """Return the score after a step if nothing waits for other robots and replacements take as long."""
    edge, seconds = unit.edges[place], unit.seconds
    free, ahead = list(partial.free), list(partial.ahead)
    if edge.action >= len(partial.node.state):
        event = max(partial.event, free[robot])
        free[robot] = event + seconds[place]
        if builds and unit.legs[place]:
            event += unit.legs[place][0][0].seconds
    else:
        event = free[robot] = max(partial.event, free[robot] + seconds[place])
    if place == 0:
        ahead[unit.robot] -= unit.duration
        ahead[robot] += unit.duration
    ahead[robot] -= seconds[place]
    before = [0.0 if entry else hold for entry in partial.begun]
    before[robot] = 0.0 if place + 1 < len(unit.edges) else hold
    return bound(free, [left if left > 1e-9 else 0.0 for left in ahead], event, before)


def beginning(work: Work, root: Node, units: Sequence[Unit]) -> Partial:
    """Return the order without steps."""
    robots = len(root.configurations)
    ahead = tuple(sum(sum(unit.seconds) for unit in units if unit.robot == robot) for robot in range(robots))
    nothing, never = (None,) * robots, (0.0,) * robots
    return Partial(
        (),
        root,
        root.state.tobytes(),
        bits(root.present),
        frozenset(),
        nothing,
        nothing,
        ahead,
        never,
        0.0,
        ((),) * robots,
        tuple(work.rests(root)),
        (),
    )


def extended(work: Work, partial: Partial, step: UnitStep, owner: Unit, *, builds: bool = False) -> Partial:
    """Return an order with one more step, whose motions begin as early as all before it allow.

    A removal changes the state as its first motion begins; executed backwards, an insertion as that motion ends, and
    nothing else may change the state meanwhile; times then count from the end. `owner` is the unit with the same job
    whose duration is part of what is left.
    """
    unit, robot, edge = step.unit, step.unit.robot, step.unit.edges[step.place]
    parts = len(partial.node.state)
    removes = edge.action >= parts
    opens = not removes and partial.node.held[robot] == edge.action
    time, event, rest = partial.free[robot], partial.event, partial.rests[robot]
    mine = list(partial.past[robot])

    def until(moment: float) -> float:
        if moment > time:
            mine.append((rest, time, moment))
        return max(moment, time)

    at_start = opens or (removes and not step.legs)
    if at_start:
        time = event = until(event)
    for k, leg in enumerate(step.legs):
        begin = max(time, event) if k == 0 and removes else time
        known = leg.waits.get
        for other, past in enumerate(partial.past):
            if other != robot:
                for body, since, end in past:
                    if end > begin:
                        wait = known(body)
                        if wait is None:
                            wait = work.wait(leg, body)
                        begin = max(begin, end + wait[1] if builds else (end if body.rest else since) + wait[0])
        for part, moment in partial.left:
            if moment > begin:
                meets = work.meets(leg, 1 << part)
                if meets < np.inf:
                    begin = max(begin, moment - meets) if builds else moment
        time = until(begin)
        if k == 0 and removes:
            event = time + leg.seconds if builds else time
        mine.append((leg.body, time, time + leg.seconds))
        time, rest = time + leg.seconds, leg.rest
    if not removes and not opens:
        time = event = until(event)
    ahead = list(partial.ahead)
    if step.place == 0:
        ahead[owner.robot] -= owner.duration
        ahead[robot] += unit.duration
    ahead[robot] = max(ahead[robot] - unit.seconds[step.place], 0.0)
    if ahead[robot] < 1e-9:
        ahead[robot] = 0.0
    free = _with(partial.free, robot, time)
    past = []
    for k, entries in enumerate(partial.past):
        first = min(free[:k] + free[k + 1 :], default=time)
        past.append(tuple([entry for entry in (mine if k == robot else entries) if entry[2] > first]))
    left = (*partial.left, (edge.action - parts, event)) if removes else partial.left
    soonest = min(free)
    following = (unit, step.place + 1) if step.place + 1 < len(unit.edges) else None
    node, present = partial.node.after(edge.action, robot, edge.segments[-1].path[-1]), partial.present
    return Partial(
        (*partial.steps, step),
        node,
        node.state.tobytes(),
        present & ~(1 << edge.action - parts) if removes else present,
        partial.jobs | {unit.job},
        _with(partial.begun, robot, following),
        _with(partial.last, robot, unit),
        tuple(ahead),
        free,
        event,
        tuple(past),
        _with(partial.rests, robot, rest),
        tuple([entry for entry in left if entry[1] > soonest]),
    )


def _with(values: tuple[_Value, ...], place: int, value: _Value) -> tuple[_Value, ...]:
    return (*values[:place], value, *values[place + 1 :])

"""Beginnings of an order of steps, with the earliest times of their motions, and the steps that may come next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from falsework.assembly.state import HELD, States
from falsework.robots.interleaving.work import NO_WAIT, ArmSweep, Leg, Unit, Work, bits
from falsework.robots.keyframes.keyframes import Edge, Node, state_after
from falsework.robots.keyframes.trajectory_assembly import STANDSTILL
from falsework.stability.oracle import StabilityOracle

_Value = TypeVar("_Value")

_MEAN = 0.2
"""Weight of the mean end of all robots beside that of the last: a robot that is done early can take over more steps."""
_VARIANTS = 2
"""Motions on one way that are planned, each in another scene."""


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
        for other, past in enumerate(partial.past):
            if other != robot:
                for body, since, end in past:
                    if end > begin:
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


class NextSteps:
    """Next steps of the orders of one plan, each with what is known of it."""

    def __init__(
        self, work: Work, oracle: StabilityOracle, units: Sequence[Unit], legal: Callable[[States], Sequence[int]]
    ) -> None:
        """Know no steps but those of the plan; `legal` are actions that the rules allow in a state, releases aside."""
        self.work, self.graph, self.oracle, self.legal = work, work.graph, oracle, legal
        self.parts = self.graph.assembly.part_count
        self._replacements: dict[tuple[int, int], Unit | None] = {(unit.job, unit.robot): unit for unit in units}
        self._approaches: dict[tuple[Unit | None, Unit], list[Leg]] = {}
        self._refused: set[tuple[Unit, int, bytes]] = set()
        self._stable: dict[bytes, bool] = {}

    def add_approach(self, last: Unit | None, unit: Unit) -> None:
        """Note that the first motion of a unit begins where another one ended."""
        self._approaches[last, unit] = unit.legs[0][0]

    def know(self, state: States) -> None:
        """Note that a state is stable as the plan reaches it."""
        self._stable[state.tobytes()] = True

    def refuse(self, unit: Unit, place: int, state: bytes) -> None:
        """Exclude a step of a unit in a state."""
        self._refused.add((unit, place, state))

    def step(self, partial: Partial, robot: int, unit: Unit, place: int) -> UnitStep | None:
        """Return a step of a robot after an order; None where it is not possible or not stable."""
        node, edge = partial.node, unit.edges[place]
        after = node.state if edge.hands_over else state_after(node.state, edge.action)
        if self._stable.get(after.tobytes()) is False:
            return None
        if unit.robot != robot:
            other = None if node.handed is not None else self._replacement(partial, unit, robot)
            if other is None:
                return None
            unit = other
        legs = self.legs(partial, unit, place)
        if legs is None:
            return None
        # Holds rarely make a state unstable, so they are checked in better orders only.
        if unit.edges[place].action >= self.parts and not self.is_stable(after, node.state):
            return None
        return UnitStep(unit, place, legs)

    def is_stable(self, state: States, before: States) -> bool:
        """Return whether a state is stable, which follows another one."""
        key = state.tobytes()
        if key not in self._stable:
            self._stable[key] = bool(self.oracle.verdicts(state[None], near=before[None]).stable[0])
        return self._stable[key]

    def _replacement(self, partial: Partial, unit: Unit, robot: int) -> Unit | None:
        """Return the unit of another robot that does a job."""
        key = (unit.job, robot)
        if key not in self._replacements:
            if unit.part not in self.legal(partial.node.state):
                return None
            found = self.work.replacement(unit.job, partial.node, unit.part, robot, partial.rests)
            self._replacements[key] = found
            if found is not None and found.legs[0][0][0].segment.kind == "free":
                self._approaches[partial.last[robot], found] = found.legs[0][0]
        return self._replacements[key]

    def legs(self, partial: Partial, unit: Unit, place: int) -> tuple[Leg, ...] | None:
        """Return motions of a step that are free at the end of an order; None if there are none."""
        node, edge = partial.node, unit.edges[place]
        refused = (unit, place, partial.key) in self._refused
        if refused or not grippers_allow(node, edge) or not self._allowed(partial, edge):
            return None
        groups = list(unit.legs[place])
        if place == 0 and unit.approaches:
            goal = edge.segments[0].path[-1]
            lines = [variants for variants in groups if variants[0].segment.kind == "line"]
            groups = lines
            if np.abs(goal - node.configurations[unit.robot]).max() > STANDSTILL:
                groups = [self._approaches.setdefault((partial.last[unit.robot], unit), []), *lines]
        found = []
        for variants in groups:
            leg = next((leg for leg in variants if self._is_free(partial, unit, leg)), None)
            if leg is None:
                fixed = edge.put_down is not None or (variants and variants[0].segment.kind == "line")
                if len(variants) >= _VARIANTS or fixed:
                    return None
                leg = self.work.replan(node, unit, place, partial.rests)
                if leg is None:
                    self._refused.add((unit, place, partial.key))
                    return None
                variants.append(leg)
            found.append(leg)
        return tuple(found)

    def _allowed(self, partial: Partial, edge: Edge) -> bool:
        """Return whether the rules allow an action, and nothing blocks the line on which a part is withdrawn."""
        action, state = edge.action, partial.node.state
        if action >= self.parts:
            return action in self.legal(state) and self.graph.exits.allows(action - self.parts, state, edge.way)
        return state[action] == HELD or action in self.legal(state)

    def _is_free(self, partial: Partial, unit: Unit, leg: Leg) -> bool:
        """Return whether a motion keeps clear of other robots at rest and of parts that it was not planned around."""
        for robot, rest in enumerate(partial.rests):
            if robot != unit.robot and self.work.wait(leg, rest) != NO_WAIT:
                return False
        # A part is not withdrawn past one that had left before: free exits may be so narrow that it would jam.
        return self.work.meets(leg, partial.present & ~(1 << unit.part)) == np.inf


def grippers_allow(node: Node, edge: Edge) -> bool:
    """Return whether a step may follow a keyframe as far as the parts that the robots hold go.

    One that holds nothing holds a part, or takes over a part that another one holds, which then leaves it at once.
    """
    part, mine = edge.action % len(node.state), node.held[edge.robot]
    if node.handed is not None:
        return edge.hands_over and part == node.handed and node.holder(part) == edge.robot
    if mine is not None:
        return mine == part and not edge.hands_over
    return edge.action < len(node.state) and edge.hands_over == (part in node.held)

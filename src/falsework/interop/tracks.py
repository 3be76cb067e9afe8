"""Keyframe tracks of a plan: visibility, holder and position of each part over time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from falsework.assembly.state import REMOVED
from falsework.errors import PlanError
from falsework.geometry.clearance.moves import ExitPath, way_back
from falsework.search.plans.plan_check import check_identity
from falsework.search.plans.steps import NO_ROBOT, moved_parts
from falsework.stability.margins.state_margins import triple
from falsework.utils.quantity import check_step_seconds
from falsework.viewer.appearance import diagonal
from falsework.viewer.timeline import exit_directions

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan

Value = TypeVar("Value", bool, int)

REACH = 0.75
"""Length of an insertion or removal path, in diagonals of the structure."""
PAUSE = 0.1
"""Share of a step, at its end, in which nothing moves."""


@dataclass(frozen=True, eq=False)
class Track:
    """Keyframes of one part; a value holds from its key to the next."""

    shown: tuple[tuple[float, bool], ...]
    """Seconds and whether the part is to be seen from then on; the first key is at 0."""
    holder: tuple[tuple[float, int], ...]
    """Seconds and the robot that holds the part from then on, `NO_ROBOT` for none; the first key is at 0."""
    path: tuple[tuple[float, tuple[float, float, float]], ...]
    """Seconds and offset from the part's place, metres, to be joined by straight lines; empty if it never moves."""

    @property
    def at_first(self) -> bool:
        """Whether the part is to be seen at the beginning."""
        return self.shown[0][1]

    @property
    def appears(self) -> bool:
        """Whether there is a time when the part is not to be seen."""
        return not all(shown for _, shown in self.shown)

    @property
    def is_held(self) -> bool:
        """Whether a robot ever holds the part."""
        return any(robot != NO_ROBOT for _, robot in self.holder)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Keyframe tracks of all parts of a plan, one step after the other."""

    tracks: tuple[Track, ...]
    """One a part."""
    seconds: float
    """Length of the whole."""

    @cached_property
    def robots(self) -> int:
        """Number of robots that hold something at some time."""
        return 1 + max((robot for track in self.tracks for _, robot in track.holder), default=NO_ROBOT)


def tracks_of(plan: Plan, assembly: Assembly, step_seconds: float = 1.0) -> Tracks:
    """Put a plan on a time axis.

    A part that is removed leaves along the collision-free way of the plan, or a straight one if there is one, and then
    disappears; one that is inserted does the opposite.
    """
    check_identity(plan, assembly)
    check_step_seconds(step_seconds)
    parts = assembly.part_count
    present, robots = plan.states != REMOVED, plan.holders
    shown = [[(0.0, bool(present[0, part]))] for part in range(parts)]
    holder = [[(0.0, int(robots[0, part]))] for part in range(parts)]
    path: list[list[tuple[float, tuple[float, float, float]]]] = [[] for _ in range(parts)]
    reach, home = REACH * diagonal(assembly), (0.0, 0.0, 0.0)
    for step in range(len(plan)):
        moved, _ = moved_parts(*plan.states[step : step + 2])
        begin, end = step * step_seconds, (step + 1 - PAUSE) * step_seconds
        if present[step, moved[0]] == present[step + 1, moved[0]]:
            holder[moved[0]].append((begin, int(robots[step + 1, moved[0]])))
            continue
        leaves = bool(present[step, moved[0]])
        if plan.exit_paths and plan.exit_paths[step]:
            for part in moved:
                shown[part].append((begin, True))
                holder[part].append((begin, int(robots[step + 1, part])))
            for part, keys in _ways_in(plan.exit_paths[step], begin, end).items():
                path[part] += keys
            continue
        ways = exit_directions(assembly, plan.states[step if leaves else step + 1], moved)
        for part, way in zip(moved, reach * ways, strict=True):
            away = triple(way)
            if leaves:
                shown[part].append((end, False))
                holder[part].append((end, NO_ROBOT))
                path[part] += [(begin, home), (end, away)]
            else:
                shown[part].append((begin, True))
                holder[part].append((begin, int(robots[step + 1, part])))
                path[part] += [(begin, away), (end, home)]
    tracks = (Track(_clean(shown[part]), _clean(holder[part]), tuple(path[part])) for part in range(parts))
    return Tracks(tuple(tracks), len(plan) * step_seconds)


def _ways_in(way: ExitPath, begin: float, end: float) -> dict[int, list[tuple[float, tuple[float, float, float]]]]:
    """Return the keys of the parts that move as one comes in by the moves of its way out, undone, at one speed."""
    if any(move.turns for move in way):
        raise PlanError("a part turns on its way in, which these files cannot show; make a picture or a recording")
    moves = (*way, *way_back(way))
    done = np.concatenate([[0.0], np.cumsum([move.distance for move in moves])])
    keys = {}
    for part in {part for move in moves for part in move.parts}:
        shifts = [(part in move.parts) * move.distance * np.array(move.direction) for move in moves]
        stops = np.concatenate([np.zeros((1, 3)), np.cumsum(shifts, axis=0)])
        times = end - (end - begin) * done / done[-1]
        keys[part] = [(float(time), triple(stop)) for time, stop in zip(times[::-1], stops[::-1], strict=True)]
        if part in way[-1].parts:
            keys[part] = keys[part][len(moves) - len(way) :]
    return keys


def _clean(keys: list[tuple[float, Value]]) -> tuple[tuple[float, Value], ...]:
    """Return keys without those that change nothing; of two at one time the later one counts."""
    last = dict(keys)
    kept: list[tuple[float, Value]] = []
    for time, value in last.items():
        if not kept or kept[-1][1] != value:
            kept.append((time, value))
    return tuple(kept)

"""Keyframe tracks of a plan: visibility, holder and position of each part over time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED
from falsework.errors import InputError, PlanError
from falsework.geometry.paths.moves import ExitPath
from falsework.search.plans.plan_check import check_identity
from falsework.search.plans.steps import NO_ROBOT, moved_parts
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
        return next(shown for _, shown in self.shown)

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

    Raises:
        PlanError: the plan is for another structure, or a part turns on its way in.
        InputError: a step of no length.
    """
    check_identity(plan, assembly)
    if not (np.isfinite(step_seconds) and step_seconds > 0):
        raise InputError(f"a step of {step_seconds:g} seconds cannot be seen; give a number above zero")
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
            shown[moved[0]].append((begin, True))
            holder[moved[0]].append((begin, int(robots[step + 1, moved[0]])))
            path[moved[0]] += _way_in(plan.exit_paths[step], begin, end)
            continue
        ways = exit_directions(assembly, plan.states[step if leaves else step + 1], moved)
        for part, way in zip(moved, reach * ways, strict=True):
            away = _triple(way)
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


def _way_in(moves: ExitPath, begin: float, end: float) -> list[tuple[float, tuple[float, float, float]]]:
    """Return the keys of a part that comes in by the moves of its way out, undone, at one speed.

    Raises:
        PlanError: one of them turns the part.
    """
    if any(move.turns for move in moves):
        raise PlanError("a part turns on its way in, which these files cannot show; make a picture or a recording")
    stops, done = [np.zeros(3)], [0.0]
    for move in moves:
        stops.append(stops[-1] + move.distance * np.array(move.direction))
        done.append(done[-1] + move.distance)
    times = [end - (end - begin) * length / done[-1] for length in done]
    return [(time, _triple(stop)) for time, stop in zip(times[::-1], stops[::-1], strict=True)]


def _clean(keys: list[tuple[float, Value]]) -> tuple[tuple[float, Value], ...]:
    """Return keys without those that change nothing; of two at one time the later one counts."""
    last = dict(keys)
    kept: list[tuple[float, Value]] = []
    for time, value in last.items():
        if not kept or kept[-1][1] != value:
            kept.append((time, value))
    return tuple(kept)


def _triple(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z

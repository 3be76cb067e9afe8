"""Itineraries: the sequence of motions of every arm of a plan, divided into cells for conflict tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED
from falsework.robots.kernels.coordination import Swept, conflicts
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import Segment, nodes_of, segments_of
from falsework.robots.schedule.swept_bodies import SweptBodies
from falsework.utils.arrays import Array

_SAME = 1e-5
"""Joint values that differ by no more are equal, rad or m."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Motion or rest of one arm, with its time range in the plan and its swept bodies."""

    node: int | None
    """Node of a motion; None for a rest."""
    first: int
    """Index of its first cell in the sequence of the arm."""
    cells: int
    after: int
    """Event that it takes place after, -1 for the beginning."""
    before: int
    """Event that it takes place before."""
    ends: Array
    """Nominal seconds into the motion at which each cell ends, shape (cells,)."""
    swept: tuple[Swept, Swept]
    """Swept bodies in cells and in finer cells."""
    line: bool
    """Whether it keeps the margin of straight lines only."""
    frames: frozenset[int]
    """Keyframes around which a motion was planned, or in which the arm rests there."""


class Itineraries:
    """Itineraries of all arms of a plan."""

    def __init__(self, plan: RobotPlan, world: CollisionWorld) -> None:
        self.plan, self.world = plan, world
        self.nodes, self.events = nodes_of(plan)
        self.bodies = SweptBodies(world)
        self._known: dict[object, tuple[tuple[Swept, Swept], Array]] = {}
        self._conflicts: dict[tuple[int, int, float], NDArray[np.bool_]] = {}
        self._configurations = [
            np.array([frame.configurations[robot] for frame in plan.keyframes]) for robot in range(len(plan.robots))
        ]
        self.rows = [list(self._row(robot)) for robot in range(len(plan.robots))]

    def _row(self, robot: int) -> Iterator[Stretch]:
        """Yield rests and motions of one arm in turn, a rest first and last."""
        own = [k for k, event in enumerate(self.events) if self.nodes[event.node].robot == robot]
        first = 0
        for segment in segments_of(self.plan)[robot]:
            moves = segment.trajectory is not None
            # What happens when a motion ends belongs to the rest after it.
            done = [
                k
                for k in own
                if segment.begun is not None
                and self.events[k].node <= segment.begun - (moves and self.events[k].at_end)
            ]
            after = done[-1] if done else -1
            before = own[len(done)] if len(done) < len(own) else len(self.events)
            swept, ends = self._swept(segment)
            frames = segment.frames
            if not moves:
                far = np.abs(self._configurations[robot] - segment.rest).max(axis=1)
                frames |= set(np.flatnonzero(far <= _SAME).tolist())
            line = segment.trajectory is not None and segment.trajectory.kind == "line"
            node = segment.begun if moves else None
            yield Stretch(node, first, len(ends), after, before, ends, swept, line, frames)
            first += len(ends)

    def _swept(self, segment: Segment) -> tuple[tuple[Swept, Swept], Array]:
        """Return the swept bodies of a motion or rest in cells and in finer cells, and when each cell ends."""
        load = None if segment.load is None else segment.load.key
        key = segment.trajectory or (segment.robot, segment.rest.tobytes(), load)
        if key not in self._known:
            if segment.trajectory is not None:
                self._known[key] = self.bodies.moving(segment.robot, segment.trajectory, segment.load)
            else:
                found = self.bodies.resting(segment.robot, segment.rest, segment.load)
                self._known[key] = (found, found), np.zeros(1)
        return self._known[key]

    def of_robot(self, robot: int) -> list[int]:
        """Return the nodes of one arm in their order."""
        return [index for index, node in enumerate(self.nodes) if node.robot == robot]

    def present(self, node: int) -> NDArray[np.bool_]:
        """Return the parts that were in place when a motion was planned, shape (parts,)."""
        entry = self.nodes[node]
        state = self.plan.states[entry.step] != REMOVED
        action, parts = int(self.plan.actions[entry.step]), len(state)
        if action >= parts:
            state = state.copy()
            state[action - parts] = False
        return state

    def moved(self, event: int) -> int | None:
        """Return the part that leaves its place, or reaches it, at an event; None for a hold or a hand-over."""
        action, parts = int(self.plan.actions[event]), len(self.plan.plan.boundary)
        return action - parts if action >= parts else None

    def conflicts(self, one: Stretch, other: Stretch, margin: float) -> NDArray[np.bool_]:
        """Return which cells of two motions or rests are not proven to keep a distance, shape (cells, cells)."""
        key = (id(one.swept[0]), id(other.swept[0]), margin)  # these live as long as the caches that have them
        if key not in self._conflicts:
            self._conflicts[key] = conflicts(one.swept, other.swept, margin)
        return self._conflicts[key]

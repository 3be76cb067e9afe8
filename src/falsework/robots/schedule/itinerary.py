"""Itineraries: the sequence of motions of every arm of a plan, divided into cells for conflict tests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED
from falsework.robots.kernels.coordination import Swept, conflicts
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.plans.loads import Load, LoadKey, load_at_rest, load_of
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.timeline import nodes_of
from falsework.robots.schedule.swept_bodies import SweptBodies

Array = NDArray[np.float64]

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
        """Divide motions into cells and compute swept bodies.

        Args:
            plan: the robot plan.
            world: the cell and the parts.
        """
        self.plan, self.world = plan, world
        self.nodes, self.events = nodes_of(plan)
        self.bodies = SweptBodies(world)
        self._cells: dict[Trajectory, tuple[tuple[Swept, Swept], Array]] = {}
        self._resting: dict[tuple[int, bytes, LoadKey | None], Swept] = {}
        self._conflicts: dict[tuple[int, int, float], NDArray[np.bool_]] = {}
        self._configurations = [
            np.array([frame.configurations[robot] for frame in plan.keyframes]) for robot in range(len(plan.robots))
        ]
        self.rows = [list(self._row(robot)) for robot in range(len(plan.robots))]

    def _row(self, robot: int) -> Iterator[Stretch]:
        """Yield rests and motions of one arm in turn, a rest first and last."""
        starts = {event.node: k for k, event in enumerate(self.events) if not event.at_end}
        ends = {event.node: k for k, event in enumerate(self.events) if event.at_end}
        own = sorted(k for k, event in enumerate(self.events) if self.nodes[event.node].robot == robot)
        values, first = self.plan.keyframes[0].configurations[robot], 0
        after: int = -1
        last: int | None = None
        for index in (*self.of_robot(robot), None):
            ahead = next((k for k in own if k > after), len(self.events))
            yield self._rest(robot, values, first, after, ahead, last, index)
            first += 1
            if index is None:
                return
            if self.nodes[index].trajectory is None:  # rests before and after it are distinct
                after = starts[index]
                continue
            after = int(starts.get(index, after))
            ahead = next((k for k in own if k > after), len(self.events))
            stretch = self._motion(index, first, after, ahead)
            yield stretch
            first += stretch.cells
            after = int(ends.get(index, after))
            values, last = self._trajectory(index).positions[-1], index

    def of_robot(self, robot: int) -> list[int]:
        """Return the nodes of one arm in their order."""
        return [index for index, node in enumerate(self.nodes) if node.robot == robot]

    def _trajectory(self, index: int) -> Trajectory:
        node = self.nodes[index]
        assert node.trajectory is not None
        return self.plan.steps[node.step].trajectories[node.trajectory]

    def _rest(
        self, robot: int, values: Array, first: int, after: int, before: int, last: int | None, following: int | None
    ) -> Stretch:
        cell = np.asarray(values, dtype=np.float64)[None]
        step = None if last is None else self.nodes[last].step
        load = load_at_rest(self.plan, robot, self._place(last), self._place(following))
        frames = set(np.flatnonzero(np.abs(self._configurations[robot] - cell).max(axis=1) <= _SAME).tolist())
        if step is not None and following is not None and self.nodes[following].step == step:  # on the way
            frames.add(step)
        key = (robot, cell.tobytes(), None if load is None else load.key)
        if key not in self._resting:
            self._resting[key] = self.bodies.resting(robot, values, load)
        found = self._resting[key]
        return Stretch(None, first, 1, after, before, np.zeros(1), (found, found), False, frozenset(frames))

    def _place(self, index: int | None) -> tuple[int, int | None] | None:
        return None if index is None else (self.nodes[index].step, self.nodes[index].trajectory)

    def load(self, index: int) -> Load | None:
        """Return the load of a robot in a motion."""
        return load_of(self.plan, self.nodes[index].step, self.nodes[index].trajectory)

    def _motion(self, index: int, first: int, after: int, before: int) -> Stretch:
        node, trajectory = self.nodes[index], self._trajectory(index)
        if trajectory not in self._cells:
            self._cells[trajectory] = self.bodies.moving(node.robot, trajectory, self.load(index))
        swept, ends = self._cells[trajectory]
        line = trajectory.kind == "line"
        return Stretch(index, first, len(ends), after, before, ends, swept, line, frozenset({node.step}))

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

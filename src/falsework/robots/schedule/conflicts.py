"""Conflicts of a plan: segments of one arm that it must have left before another arm enters its own.

The sequence of motions of every arm is divided into cells. The motions of two arms span a plane, one axis for each;
conflicting cells form regions in it. In time the two arms trace a path through the plane and pass every connected
region on one side or the other: one of them goes first through all of it (O'Donnell and Lozano-Pérez 1989). Each side
is a list of precedences, valid for any delays.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from falsework.robots.kernels.coordination import Swept, conflicts
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import CollisionWorld
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.temporal_graph import Precedence
from falsework.robots.plans.timeline import Segment, nodes_of, segments_of
from falsework.robots.plans.trajectory import JOINS
from falsework.robots.schedule.swept_bodies import SweptBodies


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
    margin: float
    """Distance that it keeps, metres."""
    phase: tuple[int, ...]
    """For each arm, twice the motions that it and this one have made as one by then, and one more during such one."""
    frames: frozenset[int]
    """Keyframes around which a motion was planned, or in which the arm rests there."""


class Itineraries:
    """Itineraries of all arms of a plan."""

    def __init__(self, plan: RobotPlan, world: CollisionWorld) -> None:
        self.plan, self.world = plan, world
        self.nodes, self.events = nodes_of(plan)
        self.bodies = SweptBodies(world)
        self._configurations = [
            np.array([frame.configurations[robot] for frame in plan.keyframes]) for robot in range(len(plan.robots))
        ]
        self.rows = [list(self._row(robot)) for robot in range(len(plan.robots))]

    def _row(self, robot: int) -> Iterator[Stretch]:
        """Yield rests and motions of one arm in turn, a rest first and last."""
        own = [k for k, event in enumerate(self.events) if robot in self.nodes[event.node].robots]
        first, phase = 0, np.zeros(len(self.plan.robots), dtype=np.int64)
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
                frames |= set(np.flatnonzero(far <= JOINS).tolist())
            line = segment.trajectory is not None and segment.trajectory.kind == "line"
            margin = self.world.cell.margins.line if line else self.world.cell.margins.free
            node = segment.begun if moves else None
            others = [] if node is None else [other for other in self.nodes[node].robots if other != robot]
            phase[others] += 1
            yield Stretch(node, first, len(ends), after, before, ends, swept, margin, tuple(phase.tolist()), frames)
            phase[others] += 1
            first += len(ends)

    def _swept(self, segment: Segment) -> tuple[tuple[Swept, Swept], Array]:
        """Return the swept bodies of a motion or rest in cells and in finer cells, and when each cell ends."""
        if segment.trajectory is not None:
            return self.bodies.moving(segment.robot, segment.trajectory, segment.load)
        found = self.bodies.resting(segment.robot, segment.rest, segment.load)
        return (found, found), np.zeros(1)

    def moved(self, event: int, node: int, *, leave: bool) -> Iterator[Swept]:
        """Yield the bodies of parts that leave their places, or where they wait, at an event, or come there.

        Those do not count that a motion was planned with.
        """
        step = self.nodes[node].step
        here, there = self.plan.standing[event : event + 2]
        for part in np.flatnonzero((here & ~there if leave else there & ~here) & ~self.plan.resting(step)).tolist():
            yield self.bodies.standing(part)
        here, there = (self.plan.keyframes[k].waits for k in ((event, event + 1) if leave else (event + 1, event)))
        known = self.plan.waiting(step)
        for part, pose in here:
            if part not in dict(there) and not (part in known and (known[part] == pose).all()):
                yield self.bodies.standing(part, pose)


@dataclass(frozen=True)
class Choice:
    """Conflict of two arms: either the first or the second goes first."""

    orders: tuple[tuple[Precedence, ...] | None, tuple[Precedence, ...] | None]
    """Precedences if the first arm goes first, and if the second does; None where that is impossible."""
    planned: int
    """Option in the sequential plan."""


def fixed_precedences(rows: Itineraries) -> list[Precedence]:
    """Return the precedences of every schedule of a plan: of each arm, of the states, of parts in place."""
    found = []
    for robot in range(len(rows.rows)):
        own = [index for index, node in enumerate(rows.nodes) if robot in node.robots]
        found += [Precedence(a, rows.nodes[a].seconds, b, "arm") for a, b in pairwise(own)]
    for one, other in pairwise(rows.events):
        offset = rows.nodes[one.node].seconds if one.at_end else 0.0
        found.append(Precedence(one.node, offset, other.node, "state"))
    for robot in range(len(rows.rows)):
        found += _parts_in_the_way(rows, robot)
    return found


def _parts_in_the_way(rows: Itineraries, robot: int) -> list[Precedence]:
    """Return precedences that keep motions planned after a part had left, or before it came, from colliding with it."""
    found = []
    for stretch in rows.rows[robot]:
        if stretch.node is None:
            continue
        step = rows.nodes[stretch.node].step
        first, last = stretch.after + 1, min(stretch.before, len(rows.events))
        for event in (*range(first, step), *range(step + 1, last)):
            mover, left = rows.events[event].node, event < step
            for place in rows.moved(event, stretch.node, leave=left) if robot not in rows.nodes[mover].robots else ():
                hit = np.flatnonzero(conflicts(stretch.swept, (place, place), stretch.margin)[:, 0])
                if len(hit) and left:
                    found.append(Precedence(mover, 0.0, stretch.node, "part"))
                elif len(hit):
                    found.append(Precedence(stretch.node, float(stretch.ends[hit[-1]]), mover, "part"))
    return found


def choices(rows: Itineraries) -> list[Choice]:
    """Return the conflicts between all pairs of arms."""
    found = []
    for one in range(len(rows.rows)):
        for other in range(one + 1, len(rows.rows)):
            found += _of_pair(rows, one, other)
    return found


def _of_pair(rows: Itineraries, one: int, other: int) -> list[Choice]:
    table = _conflict_table(rows, one, other)
    labels = np.zeros(table.shape, dtype=np.int32)
    count = int(ndimage.label(table, np.ones((3, 3)), output=labels))  # type: ignore[arg-type]
    found = []
    for label, box in enumerate(ndimage.find_objects(labels, count), 1):
        cells = np.argwhere(labels[box] == label) + [box[0].start, box[1].start]
        orders = (_goes_first(rows, one, other, cells), _goes_first(rows, other, one, cells[:, ::-1]))
        i, j = cells[0].tolist()
        planned = int(_node_after(rows, one, i) > _node_after(rows, other, j))
        found.append(Choice(orders, planned))
    return found


def _conflict_table(rows: Itineraries, one: int, other: int) -> NDArray[np.bool_]:
    """Return which cells of two arms conflict, as far as they can be executed at the same time."""
    size = [rows.rows[robot][-1].first + 1 for robot in (one, other)]
    table = np.zeros(size, dtype=bool)
    for a in rows.rows[one]:
        for b in rows.rows[other]:
            if a.node is not None and a.node == b.node:  # one motion of both
                continue
            if a.phase[other] != b.phase[one] or a.after >= b.before or b.after >= a.before or _is_proven(a, b):
                continue
            margin = min(a.margin, b.margin)
            table[a.first : a.first + a.cells, b.first : b.first + b.cells] = conflicts(a.swept, b.swept, margin)
    return table


def _is_proven(one: Stretch, other: Stretch) -> bool:
    """Return whether the planner has proven two segments free of each other: one rests where the other was planned."""
    return (one.node is None or other.node is None) and not one.frames.isdisjoint(other.frames)


def _node_after(rows: Itineraries, robot: int, cell: int) -> int:
    """Return the node that a cell belongs to, or that follows the rest that it belongs to."""
    row = rows.rows[robot]
    k = bisect_right([stretch.first for stretch in row], cell) - 1
    node = row[k].node
    return _ends_rest(rows, robot, k) if node is None else node


def _ends_rest(rows: Itineraries, robot: int, place: int) -> int:
    """Return the node that ends a rest, a motion or a grip; the number of nodes for the last rest."""
    row = rows.rows[robot]
    if place + 1 == len(row):
        return len(rows.nodes)
    following = row[place + 1].node
    return rows.events[row[place].before].node if following is None else following


def _goes_first(rows: Itineraries, one: int, other: int, cells: NDArray[np.intp]) -> tuple[Precedence, ...] | None:
    """Return the precedences if one arm goes first through a region, cells of it and of the other; None if not."""
    leaving, entering = rows.rows[one], rows.rows[other]
    firsts = [stretch.first for stretch in leaving]
    furthest, found = -1, []
    for place, stretch in enumerate(entering):
        inside = (cells[:, 1] >= stretch.first) & (cells[:, 1] < stretch.first + stretch.cells)
        cell = int(cells[inside, 0].max(initial=-1))
        if cell <= furthest:
            continue
        furthest = cell
        k = bisect_right(firsts, cell) - 1
        before, offset = leaving[k].node, float(leaving[k].ends[cell - leaving[k].first])
        if before is None:
            before, offset = _ends_rest(rows, one, k), 0.0
            if before == len(rows.nodes):
                return None
        waits = stretch.node
        if waits is None:  # it must not come to rest there: the motion before must not begin
            earlier = [s.node for s in entering[:place] if s.node is not None]
            if not earlier:
                return None
            waits = earlier[-1]
        found.append(Precedence(before, offset, waits, "volume"))
    return tuple(found)

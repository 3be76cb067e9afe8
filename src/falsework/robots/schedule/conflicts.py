"""Conflicts of a plan: segments of one arm that it must have left before another arm enters its own.

The motions of two arms span a plane, one axis for each; conflicting cells form regions in it. In time the two
arms trace a path through the plane and pass every connected region on one side or the other: one of them goes first
through all of it (O'Donnell and Lozano-Pérez 1989). Each side is a list of precedences, valid for any delays.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from falsework.robots.kernels.coordination import conflicts
from falsework.robots.plans.temporal_graph import Precedence
from falsework.robots.schedule.itinerary import Itineraries, Stretch
from falsework.search.problem.task import Direction


@dataclass(frozen=True)
class Choice:
    """Conflict of two arms: either the first or the second goes first."""

    robots: tuple[int, int]
    orders: tuple[tuple[Precedence, ...] | None, tuple[Precedence, ...] | None]
    """Precedences if the first arm goes first, and if the second does; None where that is impossible."""
    planned: int
    """Option in the sequential plan."""


def fixed_precedences(rows: Itineraries) -> list[Precedence]:
    """Return the precedences of every schedule of a plan: of each arm, of the states, of parts in place."""
    found = []
    for robot in range(len(rows.rows)):
        found += [Precedence(a, rows.nodes[a].seconds, b, "arm") for a, b in pairwise(rows.of_robot(robot))]
    for one, other in pairwise(rows.events):
        offset = rows.nodes[one.node].seconds if one.at_end else 0.0
        found.append(Precedence(one.node, offset, other.node, "state"))
    for robot in range(len(rows.rows)):
        found += _parts_in_the_way(rows, robot)
    return found


def _parts_in_the_way(rows: Itineraries, robot: int) -> list[Precedence]:
    """Return precedences that keep motions planned after a part had left, or before it came, from colliding with it."""
    apart, found = rows.plan.direction is Direction.DISASSEMBLY, []
    for stretch in rows.rows[robot]:
        if stretch.node is None:
            continue
        step, present = rows.nodes[stretch.node].step, rows.present(stretch.node)
        first, last = stretch.after + 1, min(stretch.before, len(rows.events))
        others = range(first, step) if apart else range(step + 1, last)
        for event in others:
            part, mover = rows.moved(event), rows.events[event].node
            if part is None or present[part] or rows.nodes[mover].robot == robot:
                continue
            place = rows.bodies.standing(part)
            hit = np.flatnonzero(conflicts(stretch.swept, (place, place), _margin_of(rows, stretch))[:, 0])
            if len(hit) and apart:
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
        found.append(Choice((one, other), orders, planned))
    return found


def _conflict_table(rows: Itineraries, one: int, other: int) -> NDArray[np.bool_]:
    """Return which cells of two arms conflict, as far as they can be executed at the same time."""
    size = [rows.rows[robot][-1].first + 1 for robot in (one, other)]
    table = np.zeros(size, dtype=bool)
    for a in rows.rows[one]:
        for b in rows.rows[other]:
            if a.after >= b.before or b.after >= a.before or _is_proven(a, b):
                continue
            margin = min(_margin_of(rows, a), _margin_of(rows, b))
            table[a.first : a.first + a.cells, b.first : b.first + b.cells] = rows.conflicts(a, b, margin)
    return table


def _margin_of(rows: Itineraries, stretch: Stretch) -> float:
    """Return the distance that a motion or rest keeps, metres."""
    margins = rows.world.cell.margins
    return margins.line if stretch.line else margins.free


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

"""Space that the arms of a plan occupy over the time of its schedule, as fixed convex bodies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from falsework.robots.schedule.itinerary import Itineraries, Stretch

Array = NDArray[np.float64]

_STRIDE = 2
"""Cells of a motion that one body spans."""
_GROWTH = 0.006
"""Distance by which bodies are enlarged, metres: paths that keep clear of them are to pass a test by cells, each of
which is widened by what the arm moves in it."""


def occupied(rows: Itineraries, starts: Array, robot: int, begin: float, end: float) -> Iterator[tuple[float, Array]]:
    """Yield the bodies of one arm, and of what it carries, in a range of time.

    Args:
        rows: itineraries of the plan.
        starts: start time of each node, seconds, shape (nodes,).
        robot: the arm.
        begin, end: the range, seconds.

    Yields:
        The time at which the arm has left a body, and its vertices, shape (vertices, 3).
    """
    for span in spans(rows, starts, robot):
        if span.end <= begin or span.begin >= end:
            continue
        stretch = span.stretch
        ends = np.array([span.end]) if stretch.node is None else span.begin + stretch.ends
        low, high = int(np.searchsorted(ends, begin, side="right")), int(np.searchsorted(ends, end)) + 1
        cells = range(low, min(high, stretch.cells))
        if len(cells) == 1:
            yield from _hulls(stretch, cells[0], cells[0], float(ends[cells[0]]))
        for one in cells[:-1:_STRIDE]:
            other = min(one + _STRIDE, cells[-1])
            yield from _hulls(stretch, one, other, float(ends[other]))


@dataclass(frozen=True)
class Span:
    """Motion or rest of an arm in a schedule."""

    stretch: Stretch
    begin: float
    end: float
    """Infinite for the last rest."""
    ahead: int | None
    """The node itself, or the node that ends a rest; None for the last rest."""
    last: int | None
    """The node itself, or the motion before a rest; None for the first rest."""


def spans(rows: Itineraries, starts: Array, robot: int) -> Iterator[Span]:
    """Yield the motions and rests of an arm with their times in a schedule, in seconds."""
    free_at, last = 0.0, None
    row = rows.rows[robot]
    for k, stretch in enumerate(row):
        if stretch.node is not None:
            begin, last = float(starts[stretch.node]), stretch.node
            free_at = begin + rows.nodes[last].seconds
            yield Span(stretch, begin, free_at, last, last)
            continue
        # A rest ends with the next motion, or with the grip before the next rest.
        ahead = None
        if k + 1 < len(row):
            following = row[k + 1].node
            ahead = rows.events[stretch.before].node if following is None else following
        until = np.inf if ahead is None else float(starts[ahead])
        yield Span(stretch, free_at, until, ahead, last)
        free_at = until


def _hulls(stretch: Stretch, one: int, other: int, when: float) -> Iterator[tuple[float, Array]]:
    """Yield for each body vertices that span its places in two cells, moved outwards."""
    swept = stretch.swept[0]
    for first, last in pairwise(swept.start.tolist()):
        places = swept.vertices[[one, other] if other > one else [one], first:last].reshape(-1, 3)
        away = places - places.mean(axis=0)
        far = np.linalg.norm(away, axis=1, keepdims=True)
        yield when, places + _GROWTH * away / np.maximum(far, 1e-9)

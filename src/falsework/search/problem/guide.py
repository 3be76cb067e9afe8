"""Action heuristics of a search, and the rows behind free edges that one of them follows."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from falsework.assembly.state import HELD, REMOVED, Mask, States
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly


_ROW = 0.3
"""Shares of support that each row nearer to the edge counts as: below 1, so that a row that does not close waits for
what is behind it."""
_NEXT_TO_HELD = 0.15
"""Shares of support that a place beside a held part counts as."""
_LARGEST_SHARE = 0.3
"""Share of the parts at free edges at most; where more are at edges, the structure has no rows behind them."""

_SHORTEST_ARCH = 3
"""Parts at an edge at least; fewer need no order."""


class Guide(Protocol):
    """Action heuristic: higher scores are tried sooner. Any callable can be used, such as a trained policy."""

    def __call__(self, states: States, actions: Mask, direction: Direction, /) -> NDArray[np.floating]:
        """Score the actions of some states; a search adds up the scores along a path.

        Args:
            states: shape (batch, parts).
            actions: which are allowed, shape (batch, 2 parts); only their scores are read.
            direction: in disassembly the actions lead out of the states, in assembly they are undone.

        Returns:
            Shape (batch, 2 parts).
        """
        ...


class SupportGuide:
    """Heuristic that prefers parts with much support in assembly, and with little in disassembly.

    The score of a part is the share of its contact area that touches parts now present. Summed up over an assembly
    that favours compact structures, which are rarely the unstable ones.
    """

    def __init__(self, assembly: Assembly) -> None:
        """Read the contacts of an assembly."""
        parts, pairs = assembly.part_count, assembly.contacts.parts
        self._pairs, self._boundary = pairs, assembly.boundary
        own, other = np.concatenate([pairs, pairs[:, ::-1]]).T
        areas = np.tile(assembly.contacts.areas, 2)
        whole = np.bincount(own, areas, parts)
        share = csr_array((areas, (own, other)), shape=(parts, parts))
        share.sum_duplicates()
        share.data /= np.repeat(np.where(whole > 0, whole, 1.0), np.diff(share.indptr))
        self._share = share.astype(np.float32)
        """Share of the contact area of each part that touches each other one."""

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float32]:
        """See `Guide`."""
        support = (self._share @ (states != REMOVED).T.astype(np.float32)).T
        if direction is Direction.DISASSEMBLY:
            support = -support
        return np.concatenate([support, support], axis=1)

    def edges_first(self, task: Task) -> EdgeGuide | None:
        """Return a heuristic that closes free edges first; None where it is of no use for a task.

        Two robots suffice: where contact histories matter, one of them presses while the other lets go. Under
        `equilibrium` there are shells for which no other order was found. An edge that stands need not be closed.
        """
        if task.robots < 2 or (task.target[~task.boundary] != REMOVED).any():
            return None
        return None if self._rows is None else EdgeGuide(self, self._rows)

    def held_neighbours(self, task: Task) -> HeldNeighbourGuide | None:
        """Return a heuristic that prefers parts beside held ones; None where it is of no use for a task.

        It is meant for contact histories, and rows behind free edges have an order of their own.
        """
        if task.neighbours is None or task.holds_keep_stable or self._rows is not None:
            return None
        return HeldNeighbourGuide(self, task.neighbours)

    @cached_property
    def _rows(self) -> NDArray[np.intp] | None:
        """Row of each part, where there are rows behind free edges."""
        return edge_rows(self._pairs, self._boundary)


class HeldNeighbourGuide:
    """Heuristic that prefers parts beside those that robots hold, in assembly, on top of another heuristic.

    A robot is free again once the parts around the one that it holds are there. Where these are left for later, robots
    hold single parts for hundreds of steps while the others build elsewhere, until none is free.
    """

    def __init__(self, base: Guide, neighbours: Mask) -> None:
        """Prefer parts beside others.

        Args:
            neighbours: which movable parts are in contact, shape (parts, parts).
        """
        self._base, self._neighbours = base, neighbours

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.floating]:
        """See `Guide`."""
        scores = self._base(states, actions, direction)
        if direction is Direction.DISASSEMBLY:
            return scores
        preferred = np.zeros(actions.shape, dtype=np.float32)
        for row, state in enumerate(states):  # supports are held too, but beside nothing
            preferred[row, states.shape[1] :][self._neighbours[state == HELD].any(axis=0)] = _NEXT_TO_HELD
        return scores + preferred


class EdgeGuide:
    """Heuristic that prefers parts at free edges, then row by row those behind them, on top of another heuristic.

    A free edge is an arch without anything beside it on one side. It closes while nothing leans on it; between what was
    built before it does not.
    """

    def __init__(self, base: Guide, rows: NDArray[np.integer]) -> None:
        """Prefer parts by their rows.

        Args:
            rows: row of each part, 0 at the edge, shape (parts,).
        """
        self._base = base
        worth = (rows == 0) - _ROW * rows  # a place at an edge counts as full support
        self._worth = np.concatenate([worth, worth]).astype(np.float32)

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.floating]:
        """See `Guide`."""
        worth = -self._worth if direction is Direction.DISASSEMBLY else self._worth
        return self._base(states, actions, direction) + worth


class NoveltyGuide:
    """Heuristic that prefers actions unlike those of given plans, on top of another heuristic.

    The score of a part that is removed, or in assembly inserted, is the share of the parts now present that a given
    plan removes before it: each is a pair that leaves in another order here.
    """

    def __init__(self, base: Guide | None, routes: Sequence[Route], weight: float = 4.0) -> None:
        """Prefer actions unlike `routes`, with `weight` relative to the scores of `base`."""
        ranks = [route.removal_rank() for route in routes]
        self._base = base
        self._removed = np.array([rank >= 0 for rank in ranks])
        self._before = np.array([rank[:, None] < rank[None, :] for rank in ranks], dtype=np.float32)
        self._weight = weight / max(len(routes), 1)

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        """See `Guide`."""
        parts = states.shape[1]
        score = np.zeros(actions.shape)
        if self._base is not None:
            score += self._base(states, actions, direction)
        for removed, before in zip(self._removed, self._before, strict=True):
            present = ((states != REMOVED) & removed).astype(np.float32)
            score[:, parts:] += self._weight * (present @ before) / np.maximum(present.sum(axis=1), 1.0)[:, None]
        return score


class MemoizedGuide:
    """Memoized heuristic; all new queries of a call are evaluated together.

    A network takes hardly longer for many states than for one. The oldest entries are evicted first.
    """

    def __init__(self, base: Guide, limit: int = 20_000) -> None:
        """Begin empty.

        Args:
            limit: number of cached scores.
        """
        self.calls = 0
        """Number of evaluations of the base heuristic."""
        self._base, self._limit = base, limit
        self._answers: dict[bytes, NDArray[np.floating]] = {}

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.floating]:
        """See `Guide`."""
        questions = np.concatenate([states, np.packbits(actions, axis=1)], axis=1)
        keys = [direction.value.encode() + question.tobytes() for question in questions]
        new = {key: row for row, key in enumerate(keys) if key not in self._answers}
        if new:
            rows = list(new.values())
            self.calls += 1
            answers = self._base(states[rows], actions[rows], direction)
            self._answers.update(zip(new, np.array(answers), strict=True))
        found = np.array([self._answers[key] for key in keys]).reshape(actions.shape)
        while len(self._answers) > self._limit:
            del self._answers[next(iter(self._answers))]
        return found


def edge_rows(pairs: NDArray[np.integer], boundary: Mask) -> NDArray[np.intp] | None:
    """Return how many contacts each part is away from the nearest free edge between two supports.

    Around a part inside a shell one block thick the neighbours touch each other in a ring, so each touches two others
    of them. At a free edge the ring is open. An edge that does not reach from one support to another, such as that of
    the opening at the top of a dome, is no arch that could be closed first.

    Args:
        pairs: parts in contact, shape (contacts, 2).
        boundary: parts that are supports, shape (parts,).

    Returns:
        Shape (parts,), 0 at an edge; None where there is no such edge, or it is not one of a shell.
    """
    beside: list[set[int]] = [set() for _ in boundary]
    for one, other in pairs.tolist():
        beside[one].add(other)
        beside[other].add(one)
    inner = set(np.flatnonzero(~boundary).tolist())
    edge = {part for part in inner if any(len(beside[part] & beside[other]) < 2 for other in beside[part])}
    row = np.full(len(boundary), -1, dtype=np.intp)
    while edge:
        piece = _reached([edge.pop()], beside, edge)
        edge -= piece
        supports = {other for part in piece for other in beside[part] if boundary[other]}
        if len(supports) > 1 and len(piece) >= _SHORTEST_ARCH:
            row[list(piece)] = 0
    front = np.flatnonzero(row == 0).tolist()
    if not front or len(front) > _LARGEST_SHARE * len(inner):
        return None
    while front:
        number = int(row[front[0]]) + 1
        near = set().union(*(beside[part] for part in front))
        front = [part for part in near & inner if row[part] < 0]
        row[front] = number
    row[row < 0] = row.max()
    return row


def _reached(front: list[int], beside: list[set[int]], among: set[int]) -> set[int]:
    """Return the parts that are reached from some by contacts among others, the first ones included."""
    found = set(front)
    while front:
        fresh = (beside[front.pop()] & among) - found
        found |= fresh
        front += fresh
    return found

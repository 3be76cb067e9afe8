"""Unlimited tasks from random walks in a state graph, backwards from a target or forwards from a start, on one device.

A table of pairs holds few targets, and a network overfits them. A walk costs one look-up per step, so every batch can
have new pairs: the two ends of the walk, and the first action on the path from one to the other.

The direction of a walk matters. A beam keeps few of the states that it reaches. In the direction of disassembly a path
leads from all of them back to the complete structure, but from most of them none leads onward; in the direction of
assembly it is the reverse. A walk in the wrong direction ends after a few steps, and yields a trivial task.

A search also has far more states near the end where it begins than at the other one. Walks begin evenly at all
distances from the end, or most tasks would be of a few steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.problem.hashing import StateIndex
from falsework.search.problem.state_graph import StateGraph
from falsework.utils.tensors import put

_TRIES = 8
"""Number of times that walks without an allowed start are repeated."""


class GoalSampler(Protocol):
    """Sampler of tasks: states, their targets, and valid actions towards them."""

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Draw tasks.

        Args:
            generator: source of randomness, on the device of the results.

        Returns:
            States and targets, `uint8`, shape (count, parts), and valid actions, bool, shape (count, 2 parts).
        """
        ...


class RandomWalkGoals:
    """Sampler of states, targets and first actions of paths in one graph; a `GoalSampler`."""

    def __init__(self, graph: StateGraph, *, device: torch.device, held_out: States | None = None) -> None:
        """Put a graph on a device; it may come from searches in both directions.

        Args:
            device: where to draw.
            held_out: states that are neither start nor target, such as those kept for testing; ways may lead through
                them. Shape (count, parts).

        Raises:
            InputError: no way between any two states that are allowed.
        """
        count = len(graph)
        allowed = np.ones(count, dtype=bool)
        if held_out is not None and len(held_out):
            allowed = StateIndex(np.unique(held_out, axis=0)).find(graph.states) < 0
        levels = graph.edges_by_level()
        back = WalkReach.over(levels, graph.target, graph.source, allowed)
        on = WalkReach.over(levels[::-1], graph.source, graph.target, allowed)
        ends = np.flatnonzero(allowed & (back.meets | on.meets))
        if len(ends) == 0:
            raise InputError("no path connects two states of this graph; search with a greater width")
        # Neighbours before each state, and after those of all states the neighbours after each, in one list.
        order = np.argsort(graph.target, kind="stable")
        before = np.searchsorted(graph.target[order], np.arange(count + 1))
        after = np.searchsorted(graph.source, np.arange(count + 1))
        self._begin = put(np.concatenate([before, after + len(order)]), device)
        self._next = put(np.concatenate([graph.source[order], graph.target]), device)
        self._action = put(np.concatenate([graph.action[order], graph.action]), device)
        self._states, self._allowed = put(graph.states, device), put(allowed, device)
        done = graph.task.steps_done(graph.states[ends])
        self._ends = put(ends[np.argsort(done, kind="stable")], device)
        self._at_distance = put(np.unique(done, return_counts=True)[1], device)
        usual = np.where(back.meets, back.mean, 0.0), np.where(on.meets, on.mean, 0.0)
        self._onwards = put(usual[1] > usual[0], device)
        self._longest = put(np.stack([back.longest, on.longest]), device)
        self._deepest = int(self._longest.max())

    @property
    def ends(self) -> int:
        """Number of states that a path can begin or end with."""
        return len(self._ends)

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Draw pairs of a random state and the end of a walk from it, with the first action between them.

        The state is drawn evenly by the number of steps that led to it. The walk goes backwards or forwards, whichever
        is longer on average from there.

        Args:
            generator: source of randomness, on the device of the graph.

        Returns:
            States and targets, `uint8`, shape (count, parts), and one valid action each, bool, shape (count, 2 parts).

        Raises:
            InputError: no walk reaches a state that is allowed.
        """
        found: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
        missing = count
        for _ in range(_TRIES):
            start, end, action = self._walk(missing, generator)
            good = (action >= 0).nonzero()[:, 0]
            found.append((start[good], end[good], action[good]))
            missing -= len(good)
            if missing == 0:
                break
        start, end, action = (torch.cat(column) for column in zip(*found, strict=True))
        if missing and len(start) == 0:
            raise InputError("no path between two permitted states was found; search with a greater width")
        if missing:
            rows = torch.arange(count, device=start.device) % len(start)
            start, end, action = start[rows], end[rows], action[rows]
        valid = torch.zeros((count, 2 * self._states.shape[1]), dtype=torch.bool, device=start.device)
        return self._states[start], self._states[end], valid.scatter_(1, action[:, None], True)

    def _walk(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return rows of starts and targets, and first actions, -1 where no state is allowed; shape (count,)."""
        device = self._states.device
        shares = torch.rand((2, count), generator=generator, device=device, dtype=torch.float64)
        size = self._at_distance
        distance = torch.randint(len(size), (count,), generator=generator, device=device)
        begin = self._ends[(size.cumsum(0) - size)[distance] + (shares[0] * size[distance]).long()]
        onwards = self._onwards[begin]
        length = 1 + (shares[1] * self._longest[onwards.long(), begin]).long()
        shift = onwards * (len(self._states) + 1)
        here, end, action, first = begin, begin, torch.full_like(begin, -1), torch.full_like(begin, -1)
        for step in range(1, self._deepest + 1):
            here_begins = self._begin[here + shift]
            degree = self._begin[here + shift + 1] - here_begins
            share = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
            going = (step <= length) & (degree > 0)
            edge = torch.where(going, here_begins + (share * degree).long(), 0)
            here = torch.where(going, self._next[edge].long(), here)
            if step == 1:
                first = self._action[edge].long()
            taken = going & self._allowed[here]
            end = torch.where(taken, here, end)
            action = torch.where(taken, torch.where(onwards, first, self._action[edge].long()), action)
        return torch.where(onwards, begin, end), torch.where(onwards, end, begin), action


@dataclass(frozen=True, eq=False)
class WalkReach:
    """Lengths of walks along edges of one direction from each state of a graph; all of shape (states,)."""

    meets: NDArray[np.bool_]
    """Whether some walk reaches a state that is allowed."""
    mean: NDArray[np.float64]
    """Mean number of steps of a walk that takes every edge with the same probability until it can go no further."""
    longest: NDArray[np.int64]
    """Steps at most."""

    @classmethod
    def over(
        cls, levels: list[slice], near: NDArray[np.int32], far: NDArray[np.int32], allowed: NDArray[np.bool_]
    ) -> WalkReach:
        """Follow edges from `near` to `far`, given as slices farthest first."""
        degree = np.bincount(near, minlength=len(allowed))
        meets = np.zeros(len(allowed), dtype=bool)
        mean, longest = np.zeros(len(allowed)), np.zeros(len(allowed), dtype=np.int64)
        for edges in levels:
            here, there = near[edges], far[edges]
            meets[here[meets[there] | allowed[there]]] = True
            mean += np.bincount(here, (1.0 + mean[there]) / degree[here], minlength=len(allowed))
            np.maximum.at(longest, here, 1 + longest[there])
        return cls(meets, mean, longest)

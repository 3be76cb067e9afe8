"""Tasks without end: random walks back from random targets inside a state graph, on one device.

A table of pairs holds few targets, and a network learns those by heart. A walk costs a look-up a step, so every batch
can have pairs of its own: where the walk ends is the start, and the last edge that it took is an action that leads to
the target.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.graph import StateGraph
from falsework.search.hashing import StateIndex
from falsework.search.tensors import put

_TRIES = 8
"""Times that walks without an allowed start are walked again."""


class TaskSource(Protocol):
    """Draws tasks: states, their targets, and actions that are valid on the way."""

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """So many tasks.

        Args:
            count: how many.
            generator: source of randomness, on the device of the results.

        Returns:
            States and targets, `uint8`, shape (count, parts), and valid actions, bool, shape (count, 2 parts).
        """
        ...


class Ways:
    """Draws states, targets and first actions of ways inside one graph; a `TaskSource`."""

    def __init__(self, graph: StateGraph, *, device: torch.device, forbidden: States | None = None) -> None:
        """Put a graph, usually one that was searched in the direction of disassembly, on a device.

        Args:
            graph: states and valid actions.
            device: where to draw.
            forbidden: states that are neither start nor target, such as those kept for testing; ways may lead through
                them. Shape (count, parts).

        Raises:
            InputError: no way between any two states that are allowed.
        """
        states, count = graph.states, len(graph)
        allowed = np.ones(count, dtype=bool)
        if forbidden is not None and len(forbidden):
            allowed = StateIndex(np.unique(forbidden, axis=0)).find(states) < 0
        order = np.argsort(graph.target, kind="stable")
        begin = np.searchsorted(graph.target[order], np.arange(count + 1))
        # A state can be a target if one before it is allowed.
        led = np.zeros(count, dtype=bool)
        for edges in graph.edges_by_level():
            source = graph.source[edges]
            led[graph.target[edges][allowed[source] | led[source]]] = True
        ends = np.flatnonzero(allowed & led)
        if len(ends) == 0:
            raise InputError("no way leads between two states of this graph; search with a greater width")
        self._states, self._allowed, self._ends = put(states, device), put(allowed, device), put(ends, device)
        self._begin, self._level = put(begin, device), put(graph.level - graph.level.min(), device)
        self._before, self._action = put(graph.source[order], device), put(graph.action[order], device)
        self._deepest = int(graph.level[ends].max() - graph.level.min())

    @property
    def targets(self) -> int:
        """Number of states that can be targets."""
        return len(self._ends)

    def draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Targets drawn evenly, each with the end of a walk back of random length, and the action that begins the way.

        Args:
            count: how many.
            generator: source of randomness, on the device of the graph.

        Returns:
            States and targets, `uint8`, shape (count, parts), and one valid action each, bool, shape (count, 2 parts).

        Raises:
            InputError: no walk meets a start that is allowed.
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
            raise InputError("no way back from a target meets a state to start at; search with a greater width")
        if missing:
            rows = torch.arange(count, device=start.device) % len(start)
            start, end, action = start[rows], end[rows], action[rows]
        valid = torch.zeros((count, 2 * self._states.shape[1]), dtype=torch.bool, device=start.device)
        return self._states[start], self._states[end], valid.scatter_(1, action[:, None], True)

    def _walk(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Rows of starts and targets, and first actions, -1 where no state on the way is allowed. Shape (count,)."""
        device = self._states.device
        end = self._ends[torch.randint(len(self._ends), (count,), generator=generator, device=device)]
        share = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
        length = 1 + (share * self._level[end]).long()
        here, start, action = end, end, torch.full_like(end, -1)
        for step in range(1, self._deepest + 1):
            degree = self._begin[here + 1] - self._begin[here]
            share = torch.rand(count, generator=generator, device=device, dtype=torch.float64)
            on = (step <= length) & (degree > 0)
            edge = torch.where(on, self._begin[here] + (share * degree).long(), 0)
            here = torch.where(on, self._before[edge].long(), here)
            taken = on & self._allowed[here]
            start = torch.where(taken, here, start)
            action = torch.where(taken, self._action[edge].long(), action)
        return start, end, action

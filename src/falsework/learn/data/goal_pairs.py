"""Pairs of start and target (paper, section 5.3).

Any state on a stable path can serve as the target of that path, since the actions that led to it keep its parts. So a
state graph searched in disassembly order contains a task for every pair of states that a path connects.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.errors import InputError
from falsework.geometry.arrays import Rows
from falsework.learn.env.verdict_cache import VerdictTable
from falsework.search.device.oracle import TensorOracle
from falsework.search.device.rules import TensorRules
from falsework.search.problem.hashing import StateIndex
from falsework.search.problem.state_graph import StateGraph
from falsework.utils.tensors import put

_WORD = 64
"""Targets whose bits share a machine word."""
_TARGETS = 1024
"""Targets processed together."""


@dataclass(frozen=True, eq=False)
class Pairs(Rows):
    """States with targets."""

    states: States
    """Shape (count, parts)."""
    targets: States
    """Shape (count, parts)."""

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, rows: slice | Mask | NDArray[np.intp]) -> Pairs:
        """Return some of the pairs."""
        return self.take(rows)

    def tensors(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """Return states and targets on a device."""
        return put(self.states, device), put(self.targets, device)


class PairSource:
    """Sampler of pairs of states of one graph that a path in the graph connects."""

    def __init__(self, graph: StateGraph, *, held_out: States | None = None) -> None:
        """Prepare a graph, usually one that was searched in the direction of disassembly.

        Args:
            held_out: states that are neither start nor target of any pair, such as those kept for testing; ways may
                lead through them. Shape (count, parts).

        Raises:
            InputError: no way between any two states that are allowed.
        """
        self.graph = graph
        states = graph.states
        self._allowed = np.ones(len(states), dtype=bool)
        if held_out is not None and len(held_out):
            self._allowed = StateIndex(np.unique(held_out, axis=0)).find(states) < 0
        self._levels = [edges for edges in graph.edges_by_level() if edges.stop > edges.start]
        has_way = np.zeros(len(states), dtype=bool)
        has_way[graph.target] = True
        self._ends = np.flatnonzero(self._allowed & has_way)
        if len(self._ends) == 0:
            raise InputError("no path connects two states of this graph; search with a greater width")

    @property
    def ends(self) -> NDArray[np.intp]:
        """States that can be targets, as rows of the graph."""
        return self._ends

    def draw(self, rng: np.random.Generator, count: int | None = None) -> Pairs:
        """Draw one pair for every state that can be a target and has an allowed start, in random order.

        Args:
            rng: source of randomness, of the order and of the start of each target.
            count: pairs, at most; all if not given.
        """
        ends = rng.permutation(self._ends)
        pieces: list[Pairs] = []
        for begin in range(0, len(ends), _TARGETS):
            if count is None or sum(map(len, pieces)) < count:
                pieces.append(self._pairs(ends[begin : begin + _TARGETS], rng))
        return Pairs.join(pieces)[: len(ends) if count is None else count]

    def _pairs(self, ends: NDArray[np.intp], rng: np.random.Generator) -> Pairs:
        leads = self.leads_to(ends)
        chosen = []
        block = np.empty((0, 0), dtype=bool)
        for column, end in enumerate(ends):
            if column % _WORD == 0:
                bits = leads[:, column // _WORD, None].view(np.uint8)
                block = np.ascontiguousarray(np.unpackbits(bits, axis=1, bitorder="little").T).astype(bool)
            starts = block[column % _WORD] & self._allowed
            starts[end] = False
            rows = np.flatnonzero(starts)
            if len(rows):
                chosen.append((rng.choice(rows), end))
        found = np.array(chosen, dtype=np.intp).reshape(-1, 2)
        return Pairs(self.graph.states[found[:, 0]], self.graph.states[found[:, 1]])

    def leads_to(self, ends: NDArray[np.intp]) -> NDArray[np.uint64]:
        """Return the ends that each state leads to: bit `k` of a row is set if a path leads to `ends[k]`.

        Returns:
            Shape (states, words).
        """
        words = -(-len(ends) // _WORD)
        leads = np.zeros((len(self.graph), words), dtype=np.uint64)
        place = np.arange(len(ends))
        bits = np.uint64(1) << (place % _WORD).astype(np.uint64)
        np.bitwise_or.at(leads, (ends, place // _WORD), bits)
        for edges in reversed(self._levels):
            source, begin = np.unique(self.graph.source[edges], return_index=True)
            leads[source] |= np.bitwise_or.reduceat(leads[self.graph.target[edges]], begin, axis=0)
        return leads


def unsolved_at_random(
    pairs: Pairs, rules: TensorRules, oracle: TensorOracle, known: VerdictTable, tries: int, seed: int = 0
) -> Mask:
    """Return which pairs uniformly random legal actions do not solve.

    Args:
        pairs: states and targets.
        rules: of disassembly, on the device where verdicts are computed.
        known: verdicts that earlier calls learned; this one adds its own.
        tries: rollouts of each pair; one, and the others together if it fails.

    Returns:
        Shape (pairs,).
    """
    generator = torch.Generator(rules.device).manual_seed(seed)
    starts, targets = pairs.tensors(rules.device)
    left = torch.arange(len(pairs), device=rules.device)
    # Most pairs are solved early or never, and a GPU takes as long for many rollouts as for one.
    for repeated in (1, tries - 1):
        rows = left.repeat(repeated)
        solved = _solved_at_random(starts[rows], targets[rows], rules, oracle, known, generator)
        left = left[~solved.view(repeated, len(left)).any(dim=0)]
    unsolved = np.zeros(len(pairs), dtype=bool)
    unsolved[left.cpu().numpy()] = True
    return unsolved


def _solved_at_random(
    starts: torch.Tensor,
    targets: torch.Tensor,
    rules: TensorRules,
    oracle: TensorOracle,
    known: VerdictTable,
    generator: torch.Generator,
) -> torch.Tensor:
    """Return which rollouts of uniformly random legal actions reach their targets by stable states, shape (batch,)."""
    states, rows = starts.clone(), torch.arange(len(starts), device=starts.device)
    solved = torch.zeros(len(starts), dtype=torch.bool, device=starts.device)
    while len(rows):
        mask = rules.moves(states[rows], targets[rows])
        possible = mask.any(dim=1)
        rows, mask = rows[possible], mask[possible]
        if len(rows) == 0:
            break
        actions = torch.multinomial(mask.float(), 1, generator=generator)[:, 0]
        before = states[rows]
        after = rules.follow(before, actions)

        def ask(asked: torch.Tensor, which: torch.Tensor, before: torch.Tensor = before) -> torch.Tensor:
            return oracle(asked, before[which])

        stable = known.stable(after, rules.needs_verdict(actions), ask)
        states[rows] = after
        there = rules.reached(after, targets[rows])
        solved[rows[stable & there]] = True
        rows = rows[stable & ~there]
    return solved

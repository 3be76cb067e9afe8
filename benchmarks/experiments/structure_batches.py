"""Labelled states of many structures on one device, drawn in batches of several structures of about the same size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from experiments.labelled_states import LabelledStructure, legal_actions
from torch import Tensor

from falsework.errors import InputError
from falsework.learn.networks.contact_graph import PAIR_FEATURES, PART_FEATURES, ContactGraph
from falsework.learn.networks.local_attention import GraphTensors, conditions
from falsework.stability.verdict import Criterion
from falsework.utils.tensors import put

_SIZES = (12, 20, 32, 48, 72, 108, 160, 256, 1 << 30)
"""Largest numbers of parts of structures that are filled up to the same size."""


@dataclass(frozen=True, kw_only=True)
class BatchSettings:
    """Size of the batches of a training."""

    tokens: int = 65536
    """Parts of all states of a batch."""
    mix: int = 16
    """Structures of a batch, at most; one may come twice."""

    def check(self, *names: str) -> None:
        """Raise unless the size and some other numbers are at least 1."""
        for name in ("tokens", "mix", *names):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; give at least 1")


@dataclass(frozen=True, eq=False)
class StructureBatch:
    """Several structures, and as many states of each."""

    graph: GraphTensors
    states: Tensor
    """`uint8`, shape (structures, states, parts); 0 where a part only fills up."""
    legal: Tensor
    """Bool, shape (structures, states, 2 parts)."""
    valid: Tensor
    """Legal actions to imitate, all of them where no labels are known, bool, shape (structures, states, 2 parts)."""

    @property
    def numbers(self) -> Tensor:
        """Class of every part, as of `Policy.numbers` without goals."""
        return torch.where(self.graph.fixed[:, None], 3, self.states.int())


class StructureBatches:
    """Sampler of batches; each structure is drawn as often as any other, whatever its size and number of states."""

    def __init__(self, structures: Sequence[LabelledStructure], device: torch.device | str) -> None:
        """Put structures on a device.

        Raises:
            InputError: none of them has a state.
        """
        groups: list[list[LabelledStructure]] = [[] for _ in _SIZES]
        for one in structures:
            if len(one.states):
                groups[int(np.searchsorted(_SIZES, one.graph.part_count))].append(one)
        self._groups = [_Group(group, torch.device(device)) for group in groups if group]
        if not self._groups:
            raise InputError("no structure has states to learn from; generate some first")
        self._places = {
            one.name: (number, row)
            for number, group in enumerate(group for group in groups if group)
            for row, one in enumerate(group)
        }
        self._share = np.array([group.count for group in self._groups], dtype=float)
        self.structures, self.states = int(self._share.sum()), sum(group.total for group in self._groups)

    @property
    def groups(self) -> int:
        """Number of groups of structures that are filled up to the same size."""
        return len(self._groups)

    def parts(self, group: int) -> int:
        """Return the parts that the structures of a group are filled up to."""
        return self._groups[group].parts

    def place(self, name: str) -> tuple[int, int]:
        """Return the group of a structure, and its row there."""
        return self._places[name]

    def of(self, group: int, rows: list[int], states: Tensor) -> StructureBatch:
        """Return states, filled up, shape (structures, states, parts), of some structures of a group."""
        return self._groups[group].of(torch.tensor(rows, device=states.device), states)

    def draw(self, tokens: int, mix: int, draw: np.random.Generator, generator: torch.Generator) -> StructureBatch:
        """Draw a batch.

        Args:
            tokens: parts of all its states, about.
            mix: structures, at most.
            draw: source of the group.
            generator: source of the rest, on the device.
        """
        group = self._groups[int(draw.choice(len(self._groups), p=self._share / self._share.sum()))]
        mix = min(mix, group.count)
        return group.draw(mix, max(1, tokens // (mix * group.parts)), generator)


def filled(
    tasks: Sequence[tuple[ContactGraph, int, Criterion]], parts: int, slots: int, device: torch.device
) -> GraphTensors:
    """Return the graphs of structures with their robots and criteria, filled up to some parts and neighbours."""
    shape = len(tasks), parts
    part = np.zeros((*shape, PART_FEATURES), dtype=np.float32)
    neighbour, taken = np.zeros((*shape, slots), dtype=np.int64), np.zeros((*shape, slots), dtype=bool)
    pair = np.zeros((*shape, slots, PAIR_FEATURES), dtype=np.float32)
    lever = np.zeros((*shape, slots, 2), dtype=np.float32)
    real, fixed = np.zeros(shape, dtype=bool), np.ones(shape, dtype=bool)
    for row, (graph, _, _) in enumerate(tasks):
        place = row, slice(graph.part_count), slice(graph.taken.shape[1])
        neighbour[place], taken[place], pair[place] = graph.neighbour, graph.taken, graph.pair
        lever[place], part[place[:2]] = graph.lever, graph.part
        real[place[:2]], fixed[place[:2]] = True, graph.boundary
    whole = np.stack([graph.whole for graph, _, _ in tasks])
    asked = torch.stack([conditions(robots, criterion == "equilibrium") for _, robots, criterion in tasks])
    robots = torch.tensor([float(robots) for _, robots, _ in tasks])
    arrays = [put(one, device) for one in (part, neighbour, taken, pair, lever, whole, fixed, real)]
    return GraphTensors(*[*arrays, asked.to(device), robots.to(device)])


class _Group:
    """Structures filled up to one size."""

    def __init__(self, structures: Sequence[LabelledStructure], device: torch.device) -> None:
        self.count = len(structures)
        self.parts = max(one.graph.part_count for one in structures)
        slots = max(one.graph.taken.shape[1] for one in structures)
        tasks = [(one.graph, one.robots, one.criterion) for one in structures]
        self._graph = filled(tasks, self.parts, slots, device)
        counts = np.array([len(one.states) for one in structures])
        self.total = int(counts.sum())
        states = np.zeros((self.total, self.parts), dtype=np.uint8)
        valid = np.zeros((self.total, 2, self.parts), dtype=bool)
        begin = np.cumsum(counts) - counts
        for first, one in zip(begin.tolist(), structures, strict=True):
            rows, parts = slice(first, first + len(one.states)), one.graph.part_count
            states[rows, :parts] = one.states
            valid[rows, :, :parts] = one.valid.reshape(len(one.valid), 2, parts)
        self._states, self._valid = put(states, device), put(valid.reshape(self.total, -1), device)
        self._begin, self._counts = put(begin, device), put(counts, device)

    def draw(self, mix: int, states: int, generator: torch.Generator) -> StructureBatch:
        device = self._begin.device
        chosen = torch.randperm(self.count, generator=generator, device=device)[:mix]
        share = torch.rand((mix, states), generator=generator, device=device, dtype=torch.float64)
        rows = self._begin[chosen, None] + (share * self._counts[chosen, None]).long()
        batch = self.of(chosen, self._states[rows])
        return replace(batch, valid=self._valid[rows] & batch.legal)

    def of(self, rows: Tensor, states: Tensor) -> StructureBatch:
        graph = self._graph.take(rows)
        legal = legal_actions(states, graph.fixed[:, None], graph.robots[:, None, None])
        return StructureBatch(graph, states, legal, legal)

"""Many narrow beam searches in parallel, which take many different paths through a structure.

The final states of a beam descend from the few that passed its bottleneck, however wide it is, so many beams give more
diverse paths than one wide beam. In parallel they share batches of verdicts and kernel launches, so that another beam
costs little beyond its verdicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.geometry.arrays import Rows
from falsework.search.device.oracle import TensorOracle
from falsework.search.device.rules import TensorRules
from falsework.search.problem.task import Direction, Task
from falsework.stability.verdict import Verdict
from falsework.utils.tensors import import_torch, mix, place_in_group

if TYPE_CHECKING:
    import torch

_SPARE = 4
"""Candidates looked at for each state that is kept, since some are unstable."""
_OWNER_BITS = 20
"""Of a key that orders candidates by search and then at random."""


@dataclass(frozen=True, eq=False)
class _Level(Rows):
    """States of several searches the same number of steps away from their origins, those of one search together."""

    states: torch.Tensor
    """`uint8`, shape (count, parts)."""
    owner: torch.Tensor
    """Search that each belongs to, ascending, shape (count,)."""
    value: torch.Tensor
    """Number that the order of successors depends on, such as a hash or a score, shape (count,)."""


def parallel_beam_search(
    task: Task,
    oracle: TensorOracle,
    count: int,
    width: int,
    *,
    direction: Direction = Direction.DISASSEMBLY,
    seed: int = 0,
    device: torch.device | str = "cpu",
    numbers: int = 1 << 23,
) -> tuple[States, NDArray[np.bool_]]:
    """Run beam searches that choose at random among the stable states of each level.

    Args:
        oracle: verdicts on tensors; a state that slides, or stays undecided, is not kept.
        count: searches.
        width: states that each keeps a level.
        seed: of the choices; each search makes its own.
        device: where to search; the states are the same on each, as far as the verdicts are.
        numbers: parts of all states of a level that are in memory at once; the searches run in groups. There are fewer
            candidates than that, which take some 150 bytes each while they are sorted.

    Returns:
        Stable states, those of one search after those of another, shape (count, parts), and whether each search reached
        its goal, shape (searches,).

    Raises:
        DependencyError: torch is not installed.
        InputError: fewer than one search, or a width below one.
    """
    if count < 1 or width < 1:
        raise InputError("searches and their width are counts; give at least 1")
    torch = import_torch()
    beams = _Beams(task, oracle, width, direction, seed, torch.device(device))
    together = max(min(numbers // (width * task.part_count), 1 << _OWNER_BITS), 1)
    pieces: list[States] = []
    found = np.zeros(count, dtype=bool)
    for first in range(0, count, together):
        levels = beams.run(torch.arange(first, min(first + together, count), device=beams.device))
        if len(levels) == task.steps + 1:
            found[levels[-1].owner.cpu().numpy()] = True
        states = torch.cat([level.states for level in levels])
        owner = torch.cat([level.owner for level in levels])
        pieces.append(states[torch.argsort(owner, stable=True)].cpu().numpy())
    return np.concatenate(pieces), found


class _Beams:
    def __init__(
        self, task: Task, oracle: TensorOracle, width: int, direction: Direction, seed: int, device: torch.device
    ) -> None:
        task = task.judged_by(oracle)
        self.device = device
        self._width, self._seed, self._steps = width, seed, task.steps
        self._rules = TensorRules(task, device, direction)
        self._judge = oracle
        self._dead = not task.contains(task.origin(direction)[None])[0]

    def run(self, owners: torch.Tensor) -> list[_Level]:
        """Run some searches and return all levels, up to the deepest."""
        origin = self._rules.origin().expand(len(owners), -1).contiguous()
        levels = [_Level(origin, owners, self._rules.hashes(origin))]
        while len(levels) <= self._steps and not self._dead:
            level = levels[-1]
            level = self._next_level(level, *self._candidates(level, len(levels)))
            level = level.take((~self._rules.dead_ends(level.states)).nonzero()[:, 0])
            if len(level.states) == 0:
                break
            levels.append(level)
        return levels

    def _next_level(self, level: _Level, parent: torch.Tensor, action: torch.Tensor, value: torch.Tensor) -> _Level:
        """Return the first candidates of each search that are stable; more are checked than are kept."""
        looked = place_in_group(level.owner[parent]) < _SPARE * self._width
        parent, action, value = parent[looked], action[looked], value[looked]
        before = level.states[parent]
        after = self._rules.follow(before, action)
        rows = self._stable(after, before, action).nonzero()[:, 0]
        rows = rows[place_in_group(level.owner[parent[rows]]) < self._width]
        return _Level(after[rows], level.owner[parent[rows]], value[rows])

    def _candidates(self, level: _Level, number: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the successors of the states of a level, those of each search in random order."""
        torch = import_torch()
        parent, action, hashes = self._rules.children(level.states, level.value, self._rules.moves(level.states))
        asks = self._rules.needs_verdict(action)
        # Equal states get equal words. The lowest bit puts that one of them first that needs no verdict. Two others
        # of one search agree in these 42 bits once in a million levels; then one of the candidates is left out.
        owner = level.owner[parent]
        words = mix(hashes ^ mix(owner, self._seed), 2 * number)  # different in each search
        local = owner - level.owner[0]
        key = (local << (63 - _OWNER_BITS)) | ((words & ((1 << (62 - _OWNER_BITS)) - 1)) << 1) | asks.long()
        key, order = torch.sort(key, stable=True)
        first = torch.ones_like(key, dtype=torch.bool)
        first[1:] = (key[1:] >> 1) != (key[:-1] >> 1)
        order = order[first]
        return parent[order], action[order], hashes[order]

    def _stable(self, states: torch.Tensor, parents: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        asks = self._rules.needs_verdict(actions)
        stable, rows = ~asks, asks.nonzero()[:, 0]
        if len(rows):
            stable[rows] = self._judge(states[rows], parents[rows]) == Verdict.STABLE
        return stable

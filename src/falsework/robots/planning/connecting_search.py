"""Joining search: a short, narrow search forwards from a stable state until it reaches a state known to be solvable."""

from __future__ import annotations

from collections.abc import Set

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, States
from falsework.robots.keyframes.joint_holds import HoldingOracle
from falsework.search.problem.guide import Guide
from falsework.search.problem.task import Direction, Task
from falsework.stability.cache import unique_rows
from falsework.stability.oracle import StabilityOracle

_LEVELS = 8
"""Lookahead of the search, in steps."""
_WIDTH = 6
"""Beam width of the search."""
_VERDICTS = 48
"""Verdict budget of the search: states that do not join soon rarely do."""


class ConnectingSearch:
    """Searches for paths to solvable states, with an account of what they cost."""

    def __init__(self, oracle: StabilityOracle | HoldingOracle, guide: Guide) -> None:
        self._oracle, self._guide = oracle, guide
        self.spent = 0
        """Number of verdicts spent."""
        self._left = 0

    def path(self, task: Task, start: States, solvable: Set[bytes], forbidden: Set[bytes]) -> States | None:
        """Return the stable states from one to the last before a solvable one; None without a path."""
        refused = set(forbidden)
        while (path := self._unverified_path(task, start, solvable, refused)) is not None:
            # Holds rarely fail, and most searches reach nothing: holds are checked only on a path that was found.
            holds = path[1:][(path[1:] != REMOVED).sum(axis=1) == (path[:-1] != REMOVED).sum(axis=1)]
            if not self._oracle.holds_keep_stable and len(holds):
                fallen = holds[~self._oracle.verdicts(holds).stable]
                refused |= {state.tobytes() for state in fallen}
                if len(fallen):
                    continue
            return path
        return None

    def _unverified_path(self, task: Task, start: States, solvable: Set[bytes], refused: Set[bytes]) -> States | None:
        """Return states from a stable one to the last before a solvable one; none is refused, holds are not checked."""
        self._left = _VERDICTS
        paths: States = start[None, None]
        judged: States = start[None]  # on each path, the last state that has a verdict
        for _ in range(_LEVELS):
            states = paths[:, -1]
            rows, actions = np.nonzero(task.moves(states, Direction.DISASSEMBLY))
            if not len(rows):
                return None
            after = task.follow(states[rows], actions, Direction.DISASSEMBLY)
            first = np.sort(unique_rows(after)[0])
            rows, actions, after = rows[first], actions[first], after[first]
            hit = next((k for k, state in enumerate(after) if state.tobytes() in solvable), None)
            if hit is not None:  # solvable states are stable, so the step to one needs no verdict
                return paths[rows[hit]]
            kept = self._stable_few(task, states[rows], judged[rows], after, actions, refused)
            if not len(kept):
                return None
            removed = actions[kept] >= task.part_count
            judged = np.where(removed[:, None], after[kept], judged[rows[kept]])
            paths = np.concatenate([paths[rows[kept]], after[kept][:, None]], axis=1)
        return None

    def _stable_few(
        self, task: Task, before: States, judged: States, after: States, actions: NDArray[np.intp], refused: Set[bytes]
    ) -> NDArray[np.intp]:
        """Return the most promising successors: few held, then the guide's score; after removals only stable ones."""
        removal = actions >= task.part_count
        mask = np.zeros((len(before), 2 * task.part_count), dtype=bool)
        mask[np.arange(len(before)), actions] = True
        score = np.asarray(self._guide(before, mask, Direction.DISASSEMBLY))[np.arange(len(before)), actions]
        held = ((after == HELD) & ~task.boundary).sum(axis=1)
        order = np.lexsort((-score, held))
        order = order[[after[k].tobytes() not in refused for k in order]]
        # Successors beyond the limits on holds and verdicts are dropped.
        number = np.where(removal[order], removal[order].cumsum(), (~removal[order]).cumsum())
        order = order[number <= np.where(removal[order], self._left, 2 * _WIDTH)]
        kept: list[NDArray[np.intp]] = []
        room = 3 * _WIDTH
        while room and len(order):
            batch, order = order[:room], order[room:]
            asked = batch[removal[batch]]
            self._left -= len(asked)
            self.spent += len(asked)
            good = ~removal[batch]
            if len(asked):
                good[~good] = self._oracle.verdicts(after[asked], near=judged[asked]).stable
            kept.append(batch[good])
            room -= int(good.sum())
        return np.concatenate([np.empty(0, np.intp), *kept])

"""Memory of failed moves: what it goes by, and that a search with it proves as much as one without."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework import Direction, Outcome, Task
from falsework.search import BeamSearch, BeamSettings
from falsework.search.beam.failed_moves import FailedMoves

CHAIN = [(k, k + 1) for k in range(1, 7)]


def memory(parts: int = 8) -> FailedMoves:
    task = Task.from_rules(np.arange(parts) == 0, 2, contacts=CHAIN)
    assert task.neighbours is not None
    return FailedMoves(task.neighbours)


def test_only_the_parts_around_matter() -> None:
    state = np.array([2, 1, 1, 1, 0, 0, 0, 2], dtype=np.uint8)
    far, near, itself, other = (state.copy() for _ in range(4))
    far[6], near[2], itself[3], other[4] = 1, 2, 2, 1
    key, same, *different = memory().keys(np.stack([state, far, near, itself, other]), np.full(5, 3))
    assert key == same
    assert key not in different
    assert memory().keys(state[None], np.array([2]))[0] != key  # another part


def test_the_last_verdict_counts() -> None:
    known = memory()
    keys = known.keys(np.array([[2, 1, 1, 0, 0, 0, 0, 0], [2, 1, 2, 0, 0, 0, 0, 0]], dtype=np.uint8), np.array([1, 1]))
    assert known.failed(keys).tolist() == [False, False]
    known.learn(keys, np.array([False, True]))
    assert known.failed(keys).tolist() == [True, False]
    known.learn(keys[:1], np.array([True]))
    assert known.failed(keys).tolist() == [False, False]


@pytest.mark.parametrize("direction", Direction)
def test_impossible_stays_proven(rules: Any, direction: Direction) -> None:
    """An arch of six with one robot: moves that failed before are tried last, but they are tried."""
    oracle = rules.arch(6)
    plain = Task.from_rules(rules.ground(6), 1)
    learning = Task.from_rules(rules.ground(6), 1, contacts=[(k, k + 1) for k in range(1, 5)])
    settings = BeamSettings(width=64, direction=direction, lookahead=64, diversity="none")
    for task in (plain, learning):
        assert BeamSearch(task, oracle, settings).run().outcome is Outcome.PROVED_IMPOSSIBLE
    assert BeamSearch(replace(learning, robots=6), oracle, settings).run().found

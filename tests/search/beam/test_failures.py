"""Memory of failed moves: what it goes by, and that a search with it proves as much as one without."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework.search import BeamSearch, BeamSettings, Direction, Outcome, Task
from falsework.search.beam.failures import FailureMemory

CHAIN = [(k, k + 1) for k in range(1, 7)]


def memory(parts: int = 8) -> FailureMemory:
    task = Task.create(np.arange(parts) == 0, 2, contacts=CHAIN)
    assert task.neighbours is not None
    return FailureMemory(task.neighbours)


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


def test_hopeless_where_nothing_held_can_be_let_go_of() -> None:
    known = memory()
    level = np.array([[2, 0, 0, 0, 0, 0, 0, 0], [2, 0, 0, 0, 2, 0, 0, 0], [2, 0, 2, 0, 0, 0, 0, 0]], dtype=np.uint8)
    held = (level == 2) & (np.arange(8) != 0)
    insert_1 = level, held, np.arange(3), np.ones(3, dtype=np.int64), np.full(3, 2, dtype=np.uint8), 1
    assert not known.hopeless(*insert_1).any()
    alone = np.array([[2, 1, 0, 0, 0, 0, 0, 0]], dtype=np.uint8)
    known.learn(known.keys(alone, np.array([1])), np.array([False]))
    # The second holds a part that was not tried yet, the third one that may keep the first.
    assert known.hopeless(*insert_1).tolist() == [True, False, False]


def test_hopeless_as_if_states_were_written_down() -> None:
    random, known, fixed = np.random.default_rng(0), memory(), np.arange(8) == 0
    level = random.integers(0, 3, size=(40, 8), dtype=np.uint8)
    level[:, 0] = 2
    held = (level == 2) & ~fixed
    parent, part = random.integers(40, size=300), random.integers(1, 8, size=300)
    value = random.integers(1, 3, size=300).astype(np.uint8)
    after = level[parent]
    after[np.arange(300), part] = value
    row, let_go = np.nonzero((after == 2) & ~fixed)
    loosened = after[row]
    loosened[np.arange(len(row)), let_go] = 1
    keys = known.keys(loosened, let_go)
    known.learn(keys, random.random(len(keys)) < 0.3)
    expected = np.ones(300, dtype=bool)
    expected[row[~known.failed(keys)]] = False
    assert 0 < expected.sum() < 300
    assert known.hopeless(level, held, parent, part, value, 1).tolist() == expected.tolist()


@pytest.mark.parametrize("direction", Direction)
def test_impossible_stays_proven(rules: Any, direction: Direction) -> None:
    """An arch of six with one robot: moves that failed before are tried last, but they are tried."""
    oracle = rules.arch(6)
    plain = Task.create(rules.ground(6), 1)
    learning = Task.create(rules.ground(6), 1, contacts=[(k, k + 1) for k in range(1, 5)])
    settings = BeamSettings(width=64, direction=direction, lookahead=64, diversity="none")
    for task in (plain, learning):
        assert BeamSearch(task, oracle, settings).run().outcome is Outcome.PROVED_IMPOSSIBLE
    assert BeamSearch(replace(learning, robots=6), oracle, settings).run().found

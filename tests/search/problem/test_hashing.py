"""Hashes follow moves, and equal hashes never merge different states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from falsework.search.problem.hashing import StateHash, StateIndex, merge


@given(st.integers(0, 2**32), st.integers(1, 30))
def test_hash_of_a_child_is_the_hash_of_its_state(seed: int, parts: int) -> None:
    rng = np.random.default_rng(seed)
    states = rng.integers(0, 3, size=(50, parts)).astype(np.uint8)
    part = rng.integers(0, parts, size=50)
    new = rng.integers(0, 3, size=50)
    state_hash = StateHash.for_parts(parts)
    after = states.copy()
    after[np.arange(50), part] = new
    old = states[np.arange(50), part]
    assert np.array_equal(state_hash.after(state_hash(states), part, old, new), state_hash(after))


def test_different_states_have_different_hashes(rules: Any) -> None:
    states = rules.all_states(9)
    assert len(np.unique(StateHash.for_parts(9)(states))) == len(states) == 3**8


@settings(deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([1, 2, 2**64 - 1]))
def test_merging_is_exact_even_if_all_hashes_collide(seed: int, mask: int) -> None:
    """Words cut down to one bit, or to none that matter, collide all the time."""
    rng = np.random.default_rng(seed)
    states = rng.integers(0, 3, size=(80, 4)).astype(np.uint8)
    state_hash = StateHash(StateHash.for_parts(4).words & np.uint64(mask))
    first, position = merge(state_hash(states), lambda rows: states[rows])
    expected = {tuple(state) for state in states.tolist()}
    assert {tuple(state) for state in states[first].tolist()} == expected
    assert len(first) == len(expected)
    assert np.array_equal(states[first][position], states)
    assert (np.diff(first) > 0).all()
    for distinct, row in enumerate(first):
        assert row == np.flatnonzero(position == distinct)[0]


@settings(deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([0, 1, 2**64 - 1]))
def test_index_finds_what_is_there_and_nothing_else(seed: int, mask: int) -> None:
    rng = np.random.default_rng(seed)
    states = np.unique(rng.integers(0, 3, size=(40, 4)).astype(np.uint8), axis=0)
    state_hash = StateHash(StateHash.for_parts(4).words & np.uint64(mask))
    index = StateIndex(states, state_hash)
    assert np.array_equal(index.find(states), np.arange(len(states)))
    asked = rng.integers(0, 3, size=(60, 4)).astype(np.uint8)
    known = {tuple(state): row for row, state in enumerate(states.tolist())}
    assert index.find(asked).tolist() == [known.get(tuple(state), -1) for state in asked.tolist()]


@pytest.mark.parametrize("count", [0, 1])
def test_small_collections(count: int) -> None:
    states = np.ones((count, 3), dtype=np.uint8)
    index = StateIndex(states)
    assert index.find(np.ones((2, 3), dtype=np.uint8)).tolist() == [count - 1] * 2
    assert len(index.find(np.empty((0, 3), dtype=np.uint8))) == 0

"""Arrays of states that share what does not change."""

from __future__ import annotations

import numpy as np
import pytest

from falsework.stability.state_arrays import StateArrays


@pytest.fixture
def dense() -> np.ndarray:
    """Arrays of 60 states, each with one of 1,000 rows other than in the state before."""
    random = np.random.default_rng(0)
    arrays = np.empty((60, 1000, 3))
    arrays[0] = random.standard_normal((1000, 3))
    for state in range(1, 60):
        arrays[state] = arrays[state - 1]
        arrays[state, random.integers(1000)] = random.standard_normal(3)
    return arrays


@pytest.mark.parametrize("order", ["ascending", "descending", "random"])
def test_arrays_are_kept_bit_by_bit_in_any_order(dense: np.ndarray, order: str) -> None:
    dense[7, 3] = -0.0, np.nan, np.inf
    dense[8, 3] = 0.0, np.nan, -np.inf
    rows = np.arange(60)
    rows = {"ascending": rows, "descending": rows[::-1], "random": np.random.default_rng(1).permutation(60)}[order]
    arrays = StateArrays(*dense.shape)
    arrays[rows[:40]] = dense[rows[:40]]
    arrays[rows[40:]] = dense[rows[40:]]
    assert np.asarray(arrays).tobytes() == dense.tobytes()
    assert arrays[7].tobytes() == dense[7].tobytes()
    assert arrays[-1].tobytes() == dense[-1].tobytes()
    assert arrays[[3, 5]].tobytes() == dense[[3, 5]].tobytes()
    assert np.asarray(arrays[::-1].copy()).tobytes() == dense[::-1].tobytes()
    assert np.asarray(arrays[10:20]).tobytes() == dense[10:20].tobytes()
    assert arrays.shape == dense.shape
    assert len(arrays[10:20]) == 10


def test_only_changes_take_memory(dense: np.ndarray) -> None:
    arrays = StateArrays(*dense.shape)
    arrays[np.arange(60)] = dense
    assert arrays.nbytes < 0.1 * dense.nbytes


def test_states_that_follow_each_other_need_only_their_changes(dense: np.ndarray) -> None:
    """Stored as changes of the state before, or as a whole, arrays are the same and take the same memory."""
    dense[7, 3] = -0.0, np.nan, np.inf
    whole, arrays, before = StateArrays(*dense.shape), StateArrays(*dense.shape), np.zeros(dense.shape[1:])
    whole[np.arange(60)] = dense
    for state, array in enumerate(dense):
        rows = np.flatnonzero((array.view(np.uint64) != before.view(np.uint64)).any(axis=1))
        arrays.follow(state, rows, array[rows])
        before = array
    assert np.asarray(arrays).tobytes() == dense.tobytes()
    assert arrays.nbytes == whole.nbytes


def test_what_is_stored_again_replaces_what_was_there(dense: np.ndarray) -> None:
    arrays = StateArrays(*dense.shape)
    arrays[np.arange(60)] = dense
    before = arrays.copy()
    arrays[np.array([5])] = dense[50:51]
    assert arrays[5].tobytes() == dense[50].tobytes()
    assert arrays[6].tobytes() == dense[6].tobytes()
    assert before[5].tobytes() == dense[5].tobytes()


def test_states_that_were_not_stored_are_zero() -> None:
    arrays = StateArrays(3, 5, 2)
    arrays[np.array([1])] = np.ones((1, 5, 2))
    np.testing.assert_array_equal(np.asarray(arrays), np.stack([np.zeros((5, 2)), np.ones((5, 2)), np.zeros((5, 2))]))

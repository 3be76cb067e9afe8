"""Memory of arrays by state: what it keeps is what was stored, in little more memory than what differs."""

from __future__ import annotations

import numpy as np

from falsework.stability.state_memory import StateMemory


def test_it_returns_what_was_stored_last_under_a_key() -> None:
    rng, memory, stored = np.random.default_rng(0), StateMemory(100, 3, 1 << 40), dict[bytes, np.ndarray]()
    array = rng.normal(size=(100, 3))
    for step in range(300):
        key = bytes([int(rng.integers(40))])
        if rng.random() < 0.3 and key in stored:
            array = stored[key].copy()
            memory.get(key)
        array[rng.integers(100)] = rng.normal(size=3) * (step % 3 > 0)
        memory[key] = stored[key] = array.copy()
    assert len(memory) == len(stored)
    for key, expected in stored.items():
        np.testing.assert_array_equal(memory.get(key), expected)
    assert memory.get(b"unknown") is None


def test_it_takes_memory_for_what_differs_and_gives_it_back() -> None:
    rng, whole = np.random.default_rng(0), 8 * 3200 * 3
    memory, array = StateMemory(3200, 3, 4 * whole), rng.normal(size=(3200, 3))
    for k in range(50):
        array[rng.integers(3200)] += 1.0
        memory[bytes([k])] = array
    assert len(memory) == 50
    assert memory.nbytes < 2 * whole
    for k in range(200):
        memory[bytes([k])] = rng.normal(size=(3200, 3))
    assert memory.nbytes <= 4 * whole
    assert bytes([199]) in memory
    assert bytes([100]) not in memory
    assert memory.values.nbytes < 8 * whole


def test_one_array_is_kept_whatever_the_limit() -> None:
    memory = StateMemory(100, 3, 1)
    for k in range(3):
        memory[bytes([k])] = np.full((100, 3), float(k + 1))
    assert len(memory) == 1
    np.testing.assert_array_equal(memory.get(bytes([2])), np.full((100, 3), 3.0))

"""The cache returns stored verdicts and those that follow from the two monotonicity rules, and no others."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from falsework import Verdict
from falsework.stability.cache import VerdictCache

STABLE, UNSTABLE, UNDECIDED = (int(verdict) for verdict in (Verdict.STABLE, Verdict.UNSTABLE, Verdict.UNDECIDED))


def store(cache: VerdictCache, state: ArrayLike, verdict: int, residual: float = 0.5) -> None:
    cache.store(np.atleast_2d(np.array(state, np.uint8)), np.array([verdict], np.int8), np.array([residual]))


def look_up(cache: VerdictCache, state: ArrayLike) -> tuple[int, float, bool]:
    verdict, residual, by_monotonicity = cache.look_up(np.atleast_2d(np.array(state, np.uint8)))
    return int(verdict[0]), float(residual[0]), bool(by_monotonicity[0])


def test_it_remembers() -> None:
    cache = VerdictCache()
    store(cache, [1, 1, 0, 2], STABLE, 0.25)
    store(cache, [1, 0, 1, 2], UNSTABLE, 3.0)
    assert look_up(cache, [1, 1, 0, 2]) == (STABLE, 0.25, False)
    assert look_up(cache, [1, 0, 1, 2]) == (UNSTABLE, 3.0, False)
    assert len(cache) == 2


def test_it_knows_nothing_of_other_parts() -> None:
    """Rules hold on the same parts: adding or removing one can change everything."""
    cache = VerdictCache()
    store(cache, [1, 1, 0, 2], STABLE)
    verdict, residual, by_monotonicity = look_up(cache, [1, 1, 1, 2])
    assert (verdict, by_monotonicity) == (UNDECIDED, False)
    assert np.isnan(residual)
    assert look_up(cache, [0, 1, 0, 2])[0] == UNDECIDED
    assert look_up(cache, [0, 2, 0, 2])[0] == UNDECIDED


def test_holding_more_keeps_a_state_stable() -> None:
    cache = VerdictCache()
    store(cache, [1, 2, 1, 2], STABLE, 0.25)
    assert look_up(cache, [1, 2, 2, 2]) == (STABLE, 0.25, True)
    assert look_up(cache, [2, 2, 2, 2]) == (STABLE, 0.25, True)
    assert look_up(cache, [1, 1, 1, 2])[0] == UNDECIDED
    assert look_up(cache, [2, 1, 2, 2])[0] == UNDECIDED


def test_holding_less_keeps_a_state_unstable() -> None:
    cache = VerdictCache()
    store(cache, [1, 2, 2, 2], UNSTABLE, 3.0)
    assert look_up(cache, [1, 1, 2, 2]) == (UNSTABLE, 3.0, True)
    assert look_up(cache, [1, 1, 1, 2]) == (UNSTABLE, 3.0, True)
    assert look_up(cache, [2, 2, 2, 2])[0] == UNDECIDED
    assert look_up(cache, [2, 1, 1, 2])[0] == UNDECIDED


def test_it_forgets_what_is_undecided() -> None:
    cache = VerdictCache()
    store(cache, [1, 1, 1, 2], UNDECIDED)
    assert len(cache) == 0
    assert look_up(cache, [1, 1, 1, 2])[0] == UNDECIDED


def test_a_full_cache_starts_again() -> None:
    cache = VerdictCache(limit=2)
    for state in ([1, 0], [0, 1], [1, 1]):
        store(cache, state, STABLE)
        assert len(cache) <= 2
    assert look_up(cache, [1, 1])[0] == STABLE
    assert look_up(cache, [1, 0])[0] == UNDECIDED


def test_storing_twice_counts_once() -> None:
    cache = VerdictCache()
    store(cache, [1, 0], STABLE)
    store(cache, [1, 0], STABLE)
    assert len(cache) == 1


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    support=st.sets(st.integers(0, 11), min_size=1),
    asked=st.lists(st.lists(st.sampled_from([0, 1, 2]), min_size=12, max_size=12), min_size=1, max_size=60),
)
def test_rules_never_contradict_a_monotone_world(support: set[int], asked: list[list[int]]) -> None:
    """Let a state stand if it holds any present part of a set: monotone on the same parts, so the cache must agree."""
    cache = VerdictCache()
    for values in asked:
        state = np.array(values, np.uint8)
        truth = STABLE if any(state[part] == 2 for part in support) else UNSTABLE
        known, _, _ = look_up(cache, state)
        assert known in (UNDECIDED, truth)
        store(cache, state, truth)
        assert look_up(cache, state)[0] == truth

"""Depth-first search against plain recursion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from baselines.depth_first import DepthFirstSearch, DepthFirstSettings

from falsework import Assembly, Direction, Outcome, StabilityOracle, Task
from falsework.search import SearchProgress

BOTH = pytest.mark.parametrize("direction", list(Direction))


@BOTH
@pytest.mark.parametrize("seed", range(30))
def test_finds_a_plan_if_there_is_one(rules: Any, direction: Direction, seed: int) -> None:
    oracle, clearance = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), 1 + seed % 2, clearance=clearance if seed % 3 == 0 else None)
    enumeration = rules.enumeration(task, oracle)
    result = DepthFirstSearch(task, oracle, DepthFirstSettings(direction, seed=seed)).run()
    if enumeration.count():
        assert result.outcome is Outcome.FOUND
        assert tuple(map(tuple, result.routes[0].states.tolist())) in set(enumeration.routes())
    else:
        assert result.outcome is Outcome.PROVED_IMPOSSIBLE
        assert not result.routes


def test_enters_no_state_twice(rules: Any) -> None:
    """With one robot and no plan it enters exactly the states that can be reached."""
    oracle = rules.arch(7)
    task = Task.from_rules(rules.ground(7), 2, fixed=[3])
    reachable = len(rules.enumeration(task, oracle).reachable())
    result = DepthFirstSearch(task, oracle).run()
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.counters.states == reachable


def test_frees_robots_first(rules: Any) -> None:
    """Free blocks: hold, remove, hold, remove, without one step back."""
    task = Task.from_rules(rules.ground(8), 3)
    search = DepthFirstSearch(task, rules.blocks(8))
    result = search.run()
    assert result.counters.states == task.steps + 1
    held = (result.routes[0].states[:, 1:] == 2).sum(axis=1)
    assert held.tolist() == [0, 1] * 7 + [0]


def test_gives_up_honestly(rules: Any) -> None:
    task = Task.from_rules(rules.ground(12), 1)
    result = DepthFirstSearch(task, rules.arch(12), DepthFirstSettings(state_limit=5)).run()
    assert result.outcome is Outcome.NOT_FOUND
    assert "gave up after 5 states" in result.limit


@BOTH
def test_interruptions_change_nothing(rules: Any, direction: Direction) -> None:
    oracle, _ = rules.random(11, 9)
    task = Task.from_rules(rules.ground(9), 2)
    settings = DepthFirstSettings(direction, seed=1)
    expected = DepthFirstSearch(task, oracle, settings).run()
    search = DepthFirstSearch(task, oracle, settings)
    interruptions = 0
    while True:
        calls = iter(range(3))
        result = search.run(stop=lambda calls=calls: next(calls, None) is None)
        if not result.interrupted:
            break
        interruptions += 1
    assert interruptions > 3
    assert result.outcome is expected.outcome
    assert result.counters == expected.counters
    assert np.array_equal(result.deepest, expected.deepest)
    if expected.routes:
        assert np.array_equal(result.routes[0].states, expected.routes[0].states)


def test_an_interruption_loses_no_move(rules: Any) -> None:
    """Interrupted at every single verdict in turn, it still tries everything."""
    oracle = rules.arch(6)
    task = Task.from_rules(rules.ground(6), 2, fixed=[2])

    class Impatient:
        """Raises on every other call."""

        calls = 0

        def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
            self.calls += 1
            if self.calls % 2 == 0:
                raise KeyboardInterrupt
            return oracle.verdicts(states)

    search = DepthFirstSearch(task, Impatient())
    while True:
        result = search.run()
        if not result.interrupted:
            break
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.counters.states == len(rules.enumeration(task, oracle).reachable())


def test_a_guide_decides(rules: Any) -> None:
    task = Task.from_rules(rules.ground(5), 1)

    def guide(states: Any, actions: Any, direction: Direction) -> Any:
        return np.tile([0.0, 2.0, 4.0, 1.0, 3.0], 2)[None]

    result = DepthFirstSearch(task, rules.blocks(5), guide=guide).run()
    assert (result.routes[0].actions[1::2] - 5).tolist() == [2, 4, 1, 3]


def test_reports_progress(rules: Any) -> None:
    seen: list[SearchProgress] = []
    task = Task.from_rules(rules.ground(4), 1)
    DepthFirstSearch(task, rules.blocks(4)).run(progress=seen.append)
    assert [event.level for event in seen] == list(range(1, 7))
    assert {event.levels for event in seen} == {6}


def test_on_real_states(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    task = Task.from_rules(small_arch.boundary, 2)
    for direction in Direction:
        result = DepthFirstSearch(task, arch_oracle, DepthFirstSettings(direction)).run()
        assert result.found
        assert arch_oracle.exact.check(result.routes[0].states).stable.all()


def test_sliding_states_are_no_proof_of_impossibility(rules: Any) -> None:
    oracle = rules.pressing(0, 3)
    oracle.supports = rules.blocks(3).supports
    oracle.pressed = [frozenset(), frozenset({2}), frozenset({1})]
    result = DepthFirstSearch(Task.from_rules(rules.ground(3), 1), oracle).run()
    assert result.outcome is Outcome.NOT_FOUND
    assert result.sliding == 2
    assert result.counters.states == 1

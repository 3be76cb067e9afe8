"""Plans are found only where a replay stands: a replayer made of rules that fells chosen states."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework.search import Direction, Outcome, Planner, PlannerSettings, Task
from falsework.stability.contact.replay import History, Replay


class RuleReplayer:
    """A structure falls in the states that are named, however they are reached."""

    problem = SimpleNamespace(parts=1, points=1)

    def __init__(self, falls: set[tuple[int, ...]]) -> None:
        self.falls = falls
        self.replayed = 0

    def replay(self, states: NDArray[np.uint8], history: History | None = None) -> Replay:
        self.replayed += 1
        stands = np.array([-1 if tuple(state.tolist()) in self.falls else 1 for state in states], np.int8)
        bad = np.flatnonzero(stands < 0)
        reached = int(bad[0]) if len(bad) else len(states)
        stands[reached + 1 :] = 0
        none = History(np.zeros((1, 6)), np.zeros((1, 3)), np.zeros(1, bool), np.zeros(1, np.int32))
        zeros = np.zeros(len(states))
        return Replay(stands, zeros, zeros.astype(np.int32) - 1, zeros, 1.0, (none,) * reached)

    def step(self, history: History, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[bool, History]:
        return tuple(after.tolist()) not in self.falls, history


def tower(rules: Any, falls: set[tuple[int, ...]]) -> tuple[Task, Any]:
    """Four parts on the ground, each of which stands whatever else is there; two robots."""
    oracle, _ = rules.random(3, 5)
    oracle.supports = [[frozenset()] for _ in range(5)]
    oracle.replayer = RuleReplayer(falls)
    return Task.create(rules.ground(5), 2), oracle


@pytest.mark.parametrize("direction", list(Direction))
def test_a_route_avoids_what_falls(rules: Any, direction: Direction) -> None:
    task, oracle = tower(rules, set())
    settings = PlannerSettings(directions=(direction,))
    first = Planner(task, oracle, settings).run().routes[0]
    middle = tuple(first.states[len(first.states) // 2].tolist())
    task, oracle = tower(rules, {middle})
    planner = Planner(task, oracle, settings)
    result = planner.run()
    assert result.found
    assert middle not in set(map(tuple, result.routes[0].states.tolist()))
    assert oracle.replayer.replay(result.routes[0].states[::-1]).good


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("falls", ["complete", "second"])
def test_a_search_ends_where_every_replay_falls(rules: Any, direction: Direction, falls: str) -> None:
    """No plan survives: none is delivered, nothing is claimed to be proven, and the best one is kept to be shown."""
    task, oracle = tower(rules, set())
    complete = tuple(task.start.tolist())
    bars = {complete}
    if falls == "second":
        bars = {tuple(2 if part == k else value for part, value in enumerate(complete)) for k in range(5)}
    task, oracle = tower(rules, bars)
    planner = Planner(task, oracle, PlannerSettings(directions=(direction,), width=4))
    result = planner.run()
    assert result.outcome is Outcome.NOT_FOUND
    assert result.routes == ()
    if direction is Direction.DISASSEMBLY:
        assert planner.fallen is not None
        route, step = planner.fallen
        assert tuple(route.states[::-1][step].tolist()) in bars


def test_without_a_replayer_nothing_is_replayed(rules: Any) -> None:
    task, oracle = tower(rules, set())
    oracle.replayer = None
    assert Planner(task, oracle).run().found

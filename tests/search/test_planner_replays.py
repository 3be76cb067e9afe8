"""Plans are found only where a replay stands: a replayer made of rules that fells chosen states."""

from __future__ import annotations

from collections.abc import Set
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework.assembly.state import States
from falsework.search import Direction, Outcome, Planner, PlannerSettings, Task
from falsework.stability import StabilitySettings
from falsework.stability.contact.newton import FIRST_STEP
from falsework.stability.contact.replay import History, Replay, ReplaySettings
from falsework.stability.contact.varied_replay import RobustReplayer
from falsework.utils.cores import core_count


class RuleReplayer:
    """A structure falls in the states that are named, however they are reached."""

    problem: Any = SimpleNamespace(parts=1, points=1)
    settings = StabilitySettings()

    def __init__(self, falls: Set[tuple[int, ...]], varied: Set[tuple[int, ...]] = frozenset()) -> None:
        self.falls = falls
        self.varied = varied
        """States in which the structure falls with a thicker medium alone."""
        self.replayed = 0

    def vary(self, settings: StabilitySettings, replay: ReplaySettings) -> RuleReplayer:
        return RuleReplayer(self.falls | self.varied if replay.first_step < FIRST_STEP else self.falls)

    def replay(self, states: Any, history: History | None = None) -> Replay:
        self.replayed += 1
        stands = np.array([-1 if tuple(state.tolist()) in self.falls else 1 for state in states], np.int8)
        bad = np.flatnonzero(stands < 0)
        reached = int(bad[0]) if len(bad) else len(states)
        stands[reached + 1 :] = 0
        none = History(np.zeros((1, 6)), np.zeros((1, 3)), np.zeros(1, bool), np.zeros(1, np.int32))
        zeros = np.zeros(len(states))
        return Replay(stands, zeros, zeros.astype(np.int32) - 1, zeros, 1.0, (none,) * reached)

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
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


@pytest.mark.parametrize("direction", list(Direction))
def test_a_robust_route_avoids_what_falls_under_a_variation(rules: Any, direction: Direction) -> None:
    task, oracle = tower(rules, set())
    first = Planner(task, oracle, PlannerSettings(directions=(direction,))).run().routes[0]
    middle = tuple(first.states[len(first.states) // 2].tolist())
    for robust in (False, True):
        oracle.replayer = RuleReplayer(set(), {middle})
        planner = Planner(task, oracle, PlannerSettings(directions=(direction,), robust=robust))
        route = planner.run().routes[0]
        assert (middle in set(map(tuple, route.states.tolist()))) != robust
        assert RobustReplayer(oracle.replayer).replay(route.states[::-1]).good == robust


def test_the_variation_that_failed_comes_first(rules: Any) -> None:
    task, oracle = tower(rules, set())
    states = Planner(task, oracle).run().routes[0].states[::-1]
    replayer = RobustReplayer(RuleReplayer(set(), {tuple(states[3].tolist())}))
    cases: list[Any] = list(replayer._cases)
    assert replayer.replay(states).falls_at == 3
    assert replayer._cases[0] is cases[4]
    assert sorted(map(id, replayer._cases)) == sorted(map(id, cases))
    before = [case.replayed for case in cases]
    assert replayer.replay(states).falls_at == 3
    assert sum(case.replayed for case in cases) - sum(before) <= core_count()


def test_a_replay_that_goes_on_is_not_varied(rules: Any) -> None:
    """A history belongs to one setting."""
    task, oracle = tower(rules, set())
    states = Planner(task, oracle).run().routes[0].states[::-1]
    replayer = RobustReplayer(RuleReplayer(set(), {tuple(states[3].tolist())}))
    history = replayer.replay(states[:2]).histories[-1]
    assert replayer.replay(states[1:], history).good

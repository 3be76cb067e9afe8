"""Plans with holding again against an enumeration by plain tuples, and in files and checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from falsework import Direction, Outcome, PlannerSettings, Task
from falsework.search import ExhaustiveSearch, Oracle
from falsework.search.beam.state_search import StateSearch
from falsework.search.planner import Planner
from falsework.search.problem.regrasp_moves import RegraspMoves

State = tuple[int, ...]


def level_guide(states: Any, actions: Any, direction: Any) -> Any:
    """No preference."""
    return np.zeros(actions.shape)


def following(task: Task, oracle: Any, state: State) -> Iterator[State]:
    """States one move of disassembly away: hold, let go, remove."""
    held = sum(value == 2 and not fixed for value, fixed in zip(state, task.boundary, strict=True))
    for part, value in enumerate(state):
        if task.boundary[part] or part in task.fixed:
            continue
        new = []
        if value == 1 and held < task.robots:
            new.append(2)
        if value == 2:
            new.append(1)
            free = task.clearance is None or task.clearance.free(state, part)  # type: ignore[attr-defined]
            if task.target[part] == 0 and free:
                new.append(0)
        for choice in new:
            after = (*state[:part], choice, *state[part + 1 :])
            if oracle.stands(after):
                yield after


def all_reachable(task: Task, oracle: Any) -> set[State]:
    start = tuple(task.start.tolist())
    found, todo = {start}, [start]
    while todo:
        for after in following(task, oracle, todo.pop()):
            if after not in found:
                found.add(after)
                todo.append(after)
    return found


@pytest.mark.parametrize("seed", range(24))
@pytest.mark.parametrize("robots", [1, 2, 3])
def test_agrees_with_plain_recursion(rules: Any, seed: int, robots: int) -> None:
    """What is reached, whether there is a plan, and that its steps are legal; half of the time parts also slide."""
    oracle, clearance = rules.random(seed, 6)
    if seed % 4 > 1:
        oracle = rules.pressing(seed, 6)
    task = Task.from_rules(rules.ground(6), robots, clearance=clearance if seed % 2 else None, allow_regrasp=True)
    search = StateSearch(task, oracle)
    result = search.run()
    reachable = all_reachable(task, oracle)
    possible = tuple(task.target.tolist()) in reachable
    start_stands = oracle.stands(tuple(task.start.tolist()))
    assert result.found == (possible and start_stands)
    if not result.found and start_stands and not search.judge.sliding:
        assert result.outcome is Outcome.PROVED_IMPOSSIBLE
        assert {tuple(np.frombuffer(key, np.uint8).tolist()) for key in search.parent} == reachable
    planner = Planner(task, oracle, PlannerSettings(width=4), guide=level_guide)
    found = planner.run()
    assert found.found == result.found
    if found.found:
        assert_legal(task, oracle, found.routes[0])


def assert_legal(task: Task, oracle: Any, route: Any) -> None:
    states = [tuple(state) for state in route.states.tolist()]
    assert states[0] == tuple(task.start.tolist())
    assert states[-1] == tuple(task.target.tolist())
    for before, after in pairwise(states):
        assert after in set(following(task, oracle, before))
    moves = RegraspMoves(task)
    legal = moves.legal(route.states[:-1], Direction.DISASSEMBLY)
    assert legal[np.arange(len(route.actions)), route.actions].all()
    assert np.array_equal(moves.follow(route.states[:-1], route.actions), route.states[1:])
    back = moves.legal(route.states[1:], Direction.ASSEMBLY)
    assert back[np.arange(len(route.actions)), route.actions].all()


@pytest.mark.parametrize("seed", range(20))
def test_agrees_with_the_exhaustive_search(rules: Any, seed: int) -> None:
    """A plan in which each part is held once is one with holding again; with one robot that is all there is."""
    oracle, _ = rules.random(seed, 6)
    for robots in (1, 2):
        once = ExhaustiveSearch(Task.from_rules(rules.ground(6), robots), oracle).run()
        again = StateSearch(Task.from_rules(rules.ground(6), robots, allow_regrasp=True), oracle).run()
        assert again.found or not once.result.found
        if robots == 1:
            assert again.found == once.result.found


@pytest.mark.parametrize("direction", list(Direction))
def test_searches_from_both_ends_decide(rules: Any, direction: Direction) -> None:
    """From either end a search finds a plan where the enumeration has one, and else proves that there is none."""
    found = 0
    for seed in range(40):
        oracle, clearance = rules.random(seed, 7)
        task = Task.from_rules(rules.ground(7), 2, clearance=clearance, allow_regrasp=True)
        result = StateSearch(task, oracle, direction, guide=level_guide).run()
        possible = tuple(task.target.tolist()) in all_reachable(task, oracle)
        assert result.outcome is (Outcome.FOUND if possible else Outcome.PROVED_IMPOSSIBLE)
        if result.found:
            found += 1
            assert_legal(task, oracle, result.routes[0])
    assert found > 5


@pytest.mark.parametrize("direction", list(Direction))
def test_an_interrupted_search_can_be_run_on(rules: Any, direction: Direction) -> None:
    """Where a verdict is interrupted, the search is as before it, and comes to the same route."""
    for seed in range(6):
        oracle = SeesawOracle.random(rules, seed, 7)
        task = Task.from_rules(rules.ground(7), 2, allow_regrasp=True)
        whole = StateSearch(task, oracle, direction, guide=level_guide).run()
        search = StateSearch(task, InterruptedOracle(oracle), direction, guide=level_guide)
        while (result := search.run()).interrupted:
            pass
        assert result.found == whole.found
        if whole.found:
            assert np.array_equal(result.routes[0].states, whole.routes[0].states)


@dataclass
class SeesawOracle(Oracle):
    """Seesaws: while just one of two parts is there, the beam below them must be held; a beam goes after its load.

    Here, unlike where each part has supports of its own, a hold that was needed may not be needed any more.
    """

    rules: Any
    seesaws: list[tuple[int, int, int]]
    """Part on one end, part on the other, and the beam."""
    after: list[tuple[int, int]]
    """Pairs of parts of which the first must stay as long as the second is there."""
    holds_keep_stable: bool = False

    def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
        return self.rules.verdicts(np.array([self.stands(tuple(state.tolist())) for state in states], dtype=bool))

    def stands(self, state: State) -> bool:
        level = all((not state[one]) == (not state[other]) or state[beam] == 2 for one, other, beam in self.seesaws)
        return level and all(state[first] or not state[second] for first, second in self.after)

    @classmethod
    def random(cls, rules: Any, seed: int, parts: int) -> SeesawOracle:
        rng = np.random.default_rng(seed)
        seesaws = [tuple((1 + rng.permutation(parts - 1)[:3]).tolist()) for _ in range(2)]
        carried = [(beam, end) for *ends, beam in seesaws for end in ends]
        others = [tuple((1 + rng.permutation(parts - 1)[:2]).tolist()) for _ in range(2)]
        return cls(rules, seesaws, carried + others)


@dataclass
class InterruptedOracle(Oracle):
    """Every third question about a single state is interrupted from the keyboard."""

    oracle: SeesawOracle
    asked: int = 0

    def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
        self.asked += len(states) == 1
        if len(states) == 1 and self.asked % 3 == 0:
            raise KeyboardInterrupt
        return self.oracle.verdicts(states)


@pytest.mark.parametrize("seed", [1, 118, 240, 248, 499, 525, 555])
def test_holding_again_saves_a_robot(rules: Any, seed: int) -> None:
    """On these seesaws two robots have to let go of a beam that stands again; holding it for good needs a third."""
    oracle = SeesawOracle.random(rules, seed, 8)
    task = Task.from_rules(rules.ground(8), 2, allow_regrasp=True)
    assert (
        ExhaustiveSearch(replace(task, allow_regrasp=False), oracle).run().result.outcome is Outcome.PROVED_IMPOSSIBLE
    )
    result = Planner(task, oracle, guide=level_guide).run()
    assert_legal(task, oracle, result.routes[0])
    states = result.routes[0].states
    assert ((states[:-1] == 2) & (states[1:] == 1)).any()


@pytest.mark.parametrize("seed", range(0, 40, 2))
def test_seesaws_that_do_not_come_apart(rules: Any, seed: int) -> None:
    """A plan is found where the enumeration has one, and is refuted where it has none."""
    oracle = SeesawOracle.random(rules, seed, 7)
    task = Task.from_rules(rules.ground(7), 2, allow_regrasp=True)
    result = Planner(task, oracle, PlannerSettings(width=4), guide=level_guide).run()
    possible = tuple(task.target.tolist()) in all_reachable(task, oracle)
    assert result.outcome is (Outcome.FOUND if possible else Outcome.PROVED_IMPOSSIBLE)


@pytest.mark.parametrize("allow_regrasp", [False, True])
def test_states_that_were_ruled_out_prove_nothing(rules: Any, allow_regrasp: bool) -> None:
    """A replay excludes states that stand by themselves, so that no plan without them is no proof."""
    search = StateSearch(Task.from_rules(rules.ground(4), 1, allow_regrasp=allow_regrasp), rules.blocks(4))
    found = 0
    while (result := search.run()).found:
        found += 1
        assert not {state.tobytes() for state in result.routes[0].states} & search.judge.forbidden
        search.forbid(result.routes[0].states[1:-1])
    assert found
    assert result.outcome is Outcome.NOT_FOUND
    assert "states slide" in result.limit
    assert not search.examined_all

"""The rules between start and target, against the same rules written down once more."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework import Direction, Task
from falsework.errors import InputError, StateError

STAGE = {1: 0, 2: 1, 0: 2}


def random_task(rules: Any, seed: int, parts: int = 6) -> Task:
    rng = np.random.default_rng(seed)
    while True:
        start, target = rng.integers(0, 3, size=(2, parts)).astype(np.uint8)
        start[0] = target[0] = 2
        robots = int(rng.integers(1, 4))
        ordered = all(STAGE[a] <= STAGE[b] for a, b in zip(start.tolist(), target.tolist(), strict=True))
        if ordered and max((start[1:] == 2).sum(), (target[1:] == 2).sum()) <= robots:
            return Task.from_rules(rules.ground(parts), robots, start=start, target=target)


@pytest.mark.parametrize("seed", range(30))
def test_moves_lead_to_neighbours_and_back(rules: Any, seed: int) -> None:
    """What disassembly may do between two states of the task, assembly may undo, and the other way round.

    Both directions cut off moves after which their own goal is out of reach, so they agree on states that lie on a
    way from start to target if all states are stable.
    """
    task = random_task(rules, seed)
    on_the_way = {state for route in rules.enumeration(task, rules.blocks(6)).routes() for state in route}
    states = np.array(sorted(on_the_way), dtype=np.uint8).reshape(-1, 6)
    forward = {
        (tuple(states[row]), int(action), tuple(after))
        for row, action in np.argwhere(task.moves(states, Direction.DISASSEMBLY))
        for after in task.follow(states[row : row + 1], np.array([action]), Direction.DISASSEMBLY).tolist()
    }
    backward = {
        (tuple(before), int(action), tuple(states[row]))
        for row, action in np.argwhere(task.moves(states, Direction.ASSEMBLY))
        for before in task.follow(states[row : row + 1], np.array([action]), Direction.ASSEMBLY).tolist()
    }
    assert forward == backward
    assert all(before in on_the_way and after in on_the_way for before, _, after in forward)
    assert task.contains(states).all()


@pytest.mark.parametrize("seed", range(30))
def test_all_plans_have_the_same_length(rules: Any, seed: int) -> None:
    task = random_task(rules, seed)
    for route in rules.enumeration(task, rules.blocks(6)).routes():
        assert len(route) == task.steps + 1
        assert task.steps_done(np.array(route, dtype=np.uint8)).tolist() == list(range(task.steps + 1))


@pytest.mark.parametrize("seed", range(20))
def test_postponed_parts_are_late_in_both_directions(rules: Any, seed: int) -> None:
    """Moves that respect `postponed`, followed from either end, give exactly the plans that keep to it."""
    oracle, _ = rules.random(seed, 5)
    task = Task.from_rules(rules.ground(5), 2, missing=[1, 3]).postpone([3, 5])
    plain = Task.from_rules(rules.ground(5), 2)

    def late(route: tuple[tuple[int, ...], ...]) -> bool:
        assembly = route[::-1]
        steps = sorted(next(k for k, state in enumerate(assembly) if state[part]) - 1 for part in (1, 3))
        return steps[0] >= 3 and steps[1] >= 5

    expected = {route for route in rules.enumeration(plain, oracle).routes() if late(route)}
    assert walk(task, oracle, Direction.DISASSEMBLY) == expected
    assert {route[::-1] for route in walk(task, oracle, Direction.ASSEMBLY)} == expected


def walk(task: Task, oracle: Any, direction: Direction) -> set[tuple[tuple[int, ...], ...]]:
    """All ways from one end to the other by `Task.moves`."""
    goal = tuple(task.goal(direction).tolist())

    def extend(state: tuple[int, ...]) -> list[tuple[tuple[int, ...], ...]]:
        if state == goal:
            return [(state,)]
        array = np.array([state], dtype=np.uint8)
        found = []
        for action in np.flatnonzero(task.moves(array, direction)[0]):
            after = tuple(task.follow(array, np.array([action]), direction)[0].tolist())
            if oracle.stands(after):
                found += [(state, *rest) for rest in extend(after)]
        return found

    origin = tuple(task.origin(direction).tolist())
    return set(extend(origin)) if oracle.stands(origin) else set()


def test_which_moves_need_a_verdict(rules: Any) -> None:
    """Where holds keep stable states stable, removals do, and releases when putting together; else all moves."""
    hold, remove = np.array([1, 2]), np.array([5, 6])
    asked = Task.from_rules(rules.ground(4), 2)
    task = asked.judged_by(rules.blocks(4))
    for direction in Direction:
        assert asked.needs_verdict(np.concatenate([hold, remove]), direction).all()
    assert not task.needs_verdict(hold, Direction.DISASSEMBLY).any()
    assert task.needs_verdict(remove, Direction.DISASSEMBLY).all()
    assert task.needs_verdict(hold, Direction.ASSEMBLY).all()
    assert not task.needs_verdict(remove, Direction.ASSEMBLY).any()


@pytest.mark.parametrize("seed", range(20))
def test_dead_ends_of_clearance_are_dead(rules: Any, seed: int) -> None:
    """No assembly of any kind leads from a dead end to the complete structure."""
    _, clearance = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), 2, clearance=clearance)
    states = rules.all_states(6)
    states = states[task.contains(states)]
    dead = states[task.dead_ends(states, Direction.ASSEMBLY)]
    alive = {state for route in rules.enumeration(task, rules.blocks(6)).routes() for state in route}
    assert not alive & {tuple(state) for state in dead.tolist()}
    assert not task.dead_ends(states, Direction.DISASSEMBLY).any()


def test_fixed_parts_stay_as_they_are(rules: Any) -> None:
    task = Task.from_rules(rules.ground(4), 2, fixed=[2])
    assert task.target.tolist() == [2, 0, 1, 0]
    held = Task.from_rules(rules.ground(4), 2, start=[2, 1, 2, 1], fixed=[2])
    assert held.target.tolist() == [2, 0, 2, 0]
    assert not task.moves(np.array([[2, 1, 1, 1]], dtype=np.uint8), Direction.DISASSEMBLY)[0, [2, 6]].any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"robots": 0}, "0 robots cannot hold anything"),
        ({"fixed": [4]}, "fixed part 4 does not exist; parts are numbered 0 to 3"),
        ({"missing": [-1]}, "missing part -1 does not exist"),
        ({"missing": [0]}, "missing part 0 is boundary"),
        ({"missing": [1, 1]}, "missing part 1 is listed twice"),
        ({"fixed": [1], "target": [2, 0, 0, 0]}, "part 1 is fixed but differs"),
        ({"missing": [1], "target": [2, 1, 0, 0]}, "part 1 is missing but already in place where assembly starts"),
        ({"missing": [1], "start": [2, 0, 1, 1]}, "part 1 is missing but not in the start"),
        ({"start": [2, 0, 1, 1], "target": [2, 1, 0, 0]}, "disassembly never puts a part back"),
        ({"start": [2, 2, 1, 1], "target": [2, 1, 0, 0]}, "a held part is never released"),
        ({"start": [2, 2, 2, 2]}, "the start state has 3 parts held; 2 robots can hold 2"),
        ({"target": [2, 2, 2, 2]}, "the target state has 3 parts held"),
        ({"start": [2, 1, 1]}, "a state of 3 values"),
        ({"start": [1, 1, 1, 1]}, "boundary part 0"),
        ({"start": [[2, 1, 1, 1], [2, 1, 1, 1]]}, "the start must be one state, not 2"),
    ],
)
def test_bad_tasks_get_one_line(rules: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        Task.from_rules(rules.ground(4), arguments.pop("robots", 2), **arguments)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_states_are_checked_as_states(rules: Any) -> None:
    with pytest.raises(StateError, match="use 0"):
        Task.from_rules(rules.ground(3), start=[2, 7, 1])

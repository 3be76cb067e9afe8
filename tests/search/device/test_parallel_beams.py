"""Many beams side by side: each is a beam search of its own, whatever runs beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework import Direction, StabilityOracle, StateGraph, Task, load_structure
from falsework.errors import InputError
from falsework.search.device.oracle import HostOracle, TensorOracle

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")

from falsework.learn.data.parallel_beams import parallel_beam_search  # noqa: E402

BOTH = pytest.mark.parametrize("direction", list(Direction))
BOTTLE = load_structure("bottle")
STABLE = StabilityOracle(BOTTLE)


def bottle_searches(count: int, width: int, **options: Any) -> tuple[np.ndarray, np.ndarray]:
    return parallel_beam_search(Task.from_rules(BOTTLE.boundary, 2), HostOracle(STABLE), count, width, **options)


def graph_of(states: np.ndarray) -> StateGraph:
    return StateGraph.from_states(Task.from_rules(BOTTLE.boundary, 2), states)


@BOTH
def test_every_state_stands_and_was_come_to(direction: Direction) -> None:
    states, found = bottle_searches(6, 4, direction=direction)
    assert (STABLE.verdicts(states).verdict == 1).all()
    graph = graph_of(states)
    connected = graph.reachable if direction is Direction.DISASSEMBLY else graph.solvable
    assert connected.all()
    assert found.any()
    assert graph.count_routes() > 0


@BOTH
def test_a_search_keeps_its_width_and_no_state_twice(direction: Direction) -> None:
    states, _ = bottle_searches(1, 5, direction=direction)
    steps = Task.from_rules(BOTTLE.boundary, 2).steps_done(states)
    assert np.bincount(steps).max() == 5
    assert len(np.unique(states, axis=0)) == len(states)


def test_nothing_is_left_out_where_there_is_room_for_all() -> None:
    """A wide search of a small structure finds every stable state that can be come to, as an enumeration does."""
    stack = load_structure("stack:blocks=4")
    task, oracle = Task.from_rules(stack.boundary, 2), StabilityOracle(stack)
    reached = {tuple(task.start)}
    fresh = [task.start]
    while fresh:
        moves = task.moves(np.array(fresh), Direction.DISASSEMBLY)
        rows, actions = np.nonzero(moves)
        after = task.follow(np.array(fresh)[rows], actions, Direction.DISASSEMBLY)
        stands = oracle.verdicts(after).verdict == 1
        fresh = [state for state in np.unique(after[stands], axis=0) if tuple(state) not in reached]
        reached |= {tuple(state) for state in fresh}
    states, _ = parallel_beam_search(task, HostOracle(oracle), 1, 1000)
    assert {tuple(state) for state in states.tolist()} == {tuple(map(int, state)) for state in reached}


def test_searches_do_not_depend_on_what_runs_beside_them() -> None:
    together = bottle_searches(5, 4)
    apart = bottle_searches(5, 4, numbers=2 * 4 * BOTTLE.part_count)
    assert all(np.array_equal(one, other) for one, other in zip(together, apart, strict=True))


def test_searches_differ_and_a_seed_repeats_them() -> None:
    one, again, other = (bottle_searches(8, 2, seed=seed)[0] for seed in (0, 0, 1))
    assert np.array_equal(one, again)
    assert not np.array_equal(np.unique(one, axis=0), np.unique(other, axis=0))
    middle = one[(one != 0).sum(axis=1) == BOTTLE.part_count // 2]
    assert len(np.unique(middle, axis=0)) > 2 * 4  # more than any one of them keeps there


def test_searches_that_die_hand_back_how_far_they_came() -> None:
    """With one robot no part of an arch can go."""
    arch = load_structure("arch")
    states, found = parallel_beam_search(Task.from_rules(arch.boundary, 1), HostOracle(StabilityOracle(arch)), 3, 4)
    assert not found.any()
    assert len(states)


def test_parts_leave_only_where_there_is_a_way_out() -> None:
    task = Task.from_rules(BOTTLE.boundary, 2, clearance=BOTTLE.clearance)
    for direction in Direction:
        states, found = parallel_beam_search(task, HostOracle(STABLE), 4, 8, direction=direction)
        assert found.any()
        graph = StateGraph.from_states(task, states)
        assert (graph.reachable if direction is Direction.DISASSEMBLY else graph.solvable).all()


def test_states_left_open_are_not_kept() -> None:
    class Unsure(TensorOracle):
        def __call__(self, states: Any, parents: Any) -> Any:
            return torch.zeros(len(states), dtype=torch.int8)

    task = Task.from_rules(BOTTLE.boundary, 2)
    states, found = parallel_beam_search(task, Unsure(), 2, 4)
    assert not found.any()
    assert ((states != 0).sum(axis=1) == BOTTLE.part_count).all()


@pytest.mark.parametrize("wrong", [{"count": 0}, {"width": 0}])
def test_counts_are_positive(wrong: dict[str, int]) -> None:
    asked = {"count": 2, "width": 2} | wrong
    with pytest.raises(InputError, match="give at least 1"):
        bottle_searches(asked["count"], asked["width"])


@pytest.mark.parametrize("seed", range(4))
def test_nothing_that_slides_is_kept(rules: Any, seed: int) -> None:
    """Where every move needs a verdict, a search with room for all finds what an enumeration does."""
    oracle = rules.pressing(seed, 6)
    task = Task.from_rules(rules.ground(6), 2)
    states, found = parallel_beam_search(task, HostOracle(oracle), 2, 3**5)
    reached = rules.enumeration(task, oracle).reachable()
    assert {tuple(state) for state in states.tolist()} == reached
    assert found.all() == (rules.enumeration(task, oracle).count() > 0)

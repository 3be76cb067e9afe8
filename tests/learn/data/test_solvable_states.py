"""The set of solvable states against plain Python sets and the state graph."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import StateGraph, load_structure  # noqa: E402
from falsework.learn.data.dataset import DataSettings, build_dataset, training_task  # noqa: E402
from falsework.learn.data.solvable_states import SolvableStates  # noqa: E402
from falsework.search import TensorRules  # noqa: E402


def rules_of(data: Any) -> TensorRules:
    return TensorRules(data.task)


@pytest.fixture(scope="module")
def data() -> Any:
    assembly = load_structure("arch:blocks=7")
    return build_dataset(assembly, training_task(assembly, 2), DataSettings(4, 8, (16,)), device="cpu")


def stored(solved: SolvableStates, states: Any) -> Any:
    """Return which states are in a set."""
    known = {bytes(row) for row in solved.states.numpy()}
    return torch.tensor([bytes(row) in known for row in np.asarray(states)])


def keys(states: Any) -> set[bytes]:
    return {bytes(row) for row in np.asarray(states)}


def test_it_is_a_set(data: Any) -> None:
    rows = np.random.default_rng(0).choice(data.train, 500)
    solved = SolvableStates(rules_of(data))
    assert len(solved) == 0
    assert not stored(solved, torch.from_numpy(rows)).any()
    for piece in np.array_split(rows, 5):
        before = len(solved)
        assert solved.add(torch.from_numpy(piece)) == len(solved) - before
    assert keys(solved.states) == keys(rows)
    assert len(solved) == len(keys(rows))
    assert stored(solved, torch.from_numpy(rows)).all()
    assert not stored(solved, torch.from_numpy(data.test)).any()
    assert solved.add(torch.from_numpy(rows)) == 0


def test_valid_actions_are_those_of_the_state_graph(data: Any) -> None:
    """The graph finds successors by writing them down and comparing whole states."""
    states = np.concatenate([data.train, data.test, data.validation, data.more])
    graph = StateGraph.from_states(data.task, states)
    solved = SolvableStates(rules_of(data), torch.from_numpy(states))
    valid = solved.valid_actions(torch.from_numpy(graph.states)).numpy()
    assert np.array_equal(valid, graph.valid_actions())
    assert valid.any(axis=1).sum() == len(states) - 1  # every state but the last leads on


def test_test_states_are_never_stored(data: Any) -> None:
    """Nor started from, whenever they are held_out; but a way through one of them that was found is a way."""
    everything = torch.from_numpy(np.concatenate([data.train, data.test, data.more]))
    test = torch.from_numpy(data.test)
    early, late = SolvableStates(rules_of(data)), SolvableStates(rules_of(data), everything)
    early.hold_out(test)
    early.add(everything)
    late.hold_out(test)
    for solved in (early, late):
        assert keys(solved.states) == keys(data.train) | keys(data.more)
        assert not stored(solved, test).any()
        assert solved.is_held_out(test).all()
        assert solved.held_out == len(data.test)
        assert solved.add(test) == 0
        assert solved.valid_actions(everything).equal(
            SolvableStates(rules_of(data), everything).valid_actions(everything)
        )
    unaware = SolvableStates(rules_of(data))
    unaware.hold_out(test)
    unaware.add(torch.from_numpy(data.train))
    graph = StateGraph.from_states(data.task, data.train)
    # What nobody found is not used: without the test states the valid actions are those among the training states.
    assert np.array_equal(unaware.valid_actions(torch.from_numpy(graph.states)).numpy(), graph.valid_actions())


def test_test_states_that_rollouts_meet_are_counted_once(data: Any) -> None:
    solved = SolvableStates(rules_of(data), torch.from_numpy(data.train))
    solved.record_visits(torch.from_numpy(data.test))
    assert solved.visited == 0  # nothing is held out yet
    solved.hold_out(torch.from_numpy(data.test))
    solved.record_visits(torch.from_numpy(data.train))
    assert solved.visited == 0
    for _ in range(2):
        solved.record_visits(torch.from_numpy(np.concatenate([data.test[:5], data.train, data.test[:5]])))
        assert solved.visited == 5
    assert solved.held_out_visit_rate == 5 / len(data.test)


def test_saved_and_loaded_it_is_the_same(data: Any) -> None:
    solved = SolvableStates(rules_of(data))
    solved.hold_out(torch.from_numpy(data.test))
    solved.add(torch.from_numpy(np.concatenate([data.train, data.test])))
    solved.record_visits(torch.from_numpy(data.test[:3]))
    again = SolvableStates(rules_of(data))
    again.load(solved.tensors())
    assert again.states.equal(solved.states)
    assert again.visited == 3
    probe = torch.from_numpy(np.concatenate([data.train, data.more]))
    assert again.valid_actions(probe).equal(solved.valid_actions(probe))
    assert again.add(torch.from_numpy(data.more)) == solved.add(torch.from_numpy(data.more)) > 0


def test_processes_tell_each_other_which_test_states_are_solvable(data: Any) -> None:
    """Without telling what they are: two sets that learned different halves know the same afterwards."""
    everything = torch.from_numpy(np.concatenate([data.train, data.test, data.more]))
    one, two = SolvableStates(rules_of(data)), SolvableStates(rules_of(data))
    for solved in (one, two):
        solved.hold_out(torch.from_numpy(data.test))
        solved.add(torch.from_numpy(np.concatenate([data.train, data.more])))
    one.add(everything[::2])
    two.add(everything[1::2])
    words = torch.cat([one.held_out_hashes(), two.held_out_hashes()])
    assert len(words) == len(data.test)
    for solved in (one, two):
        solved.learn_held_out_hashes(words)
        solved.learn_held_out_hashes(words)
    whole = SolvableStates(rules_of(data), everything)
    for solved in (one, two):
        assert solved.valid_actions(everything).equal(whole.valid_actions(everything))
        assert not stored(solved, torch.from_numpy(data.test)).any()


def test_sorted_states_do_not_depend_on_who_came_first(data: Any) -> None:
    one, two = SolvableStates(rules_of(data)), SolvableStates(rules_of(data))
    one.add(torch.from_numpy(data.train))
    two.add(torch.from_numpy(data.train[::-1].copy()))
    assert not one.states.equal(two.states)
    one.sort()
    two.sort()
    assert one.states.equal(two.states)

"""Data of goal-conditioned policies: what is learned from and what is tested on have no state in common."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, Direction, StabilityOracle, Task, load_structure  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import Environment, roll_out  # noqa: E402
from falsework.learn.data.dataset import training_task  # noqa: E402
from falsework.learn.data.goal_dataset import GoalDataSettings, SearchStates, build_goal_dataset  # noqa: E402
from falsework.learn.data.parallel_beams import parallel_beam_search  # noqa: E402
from falsework.search.device.oracle import tensor_oracle  # noqa: E402
from falsework.search.problem.hashing import StateIndex  # noqa: E402


def test_data_set_of_table_four_keeps_its_sets_apart(bottle: Assembly) -> None:
    settings = GoalDataSettings(train_width=4, random_tries=2, test_width=12, widths=(20,), test_pairs=100)
    data = build_goal_dataset(bottle, training_task(bottle), settings, device="cpu")
    assert 0 < len(data.train) <= 100
    assert 0 < len(data.test) <= 100
    seen = StateIndex(data.graph.states)
    for states in (data.test.states, data.test.targets):
        assert (seen.find(states) < 0).all()
    for states in (data.train.states, data.train.targets):
        assert (seen.find(states) >= 0).all()
    kept = StateIndex(data.held_out)
    assert (kept.find(data.train.states) < 0).all()
    assert len(data.wide) > len(data.graph)
    assert (data.wide.index.find(data.graph.states) >= 0).all()
    again = build_goal_dataset(bottle, training_task(bottle), settings, device="cpu")
    assert np.array_equal(again.test.targets, data.test.targets)
    alone = build_goal_dataset(bottle, training_task(bottle), replace(settings, widths=()), device="cpu")
    assert alone.wide is alone.graph
    assert np.array_equal(alone.test.states, data.test.states)


def test_searches_are_read_back(bottle: Assembly, tmp_path: Path) -> None:
    """The same data set comes of them; files that are something else are refused."""
    task = training_task(bottle)
    settings = GoalDataSettings(train_width=4, random_tries=2, test_width=12, widths=(8, 8), test_pairs=20)
    oracle = tensor_oracle(StabilityOracle(bottle), torch.device("cpu"))
    seen: list[str] = []
    searched = SearchStates.find(task, settings, oracle, device=torch.device("cpu"), report=seen.append)
    assert seen[-1] == "searches 3 to 4 of 4, width 8"
    searched.save(tmp_path / "searched.npz", task)
    again = SearchStates.load(tmp_path / "searched.npz", task)
    one, two, three = (
        build_goal_dataset(bottle, task, settings, device="cpu", searched=known) for known in (searched, again, None)
    )
    for other in (two, three):
        assert np.array_equal(one.test.targets, other.test.targets)
        assert np.array_equal(one.train.states, other.train.states)
        assert np.array_equal(one.wide.states, other.wide.states)
    tetris = load_structure("stack:blocks=12")
    with pytest.raises(InputError, match="states of another structure"):
        SearchStates.load(tmp_path / "searched.npz", training_task(tetris))
    with pytest.raises(InputError, match="stable under the criterion contact; remove it"):
        SearchStates.load(tmp_path / "searched.npz", replace(task, holds_keep_stable=True))
    replace(searched, more=searched.more[:, 1:]).save(tmp_path / "searched.npz", task)
    with pytest.raises(InputError, match="is damaged"):
        SearchStates.load(tmp_path / "searched.npz", task)


def test_bad_input_is_one_clear_line() -> None:
    tiny = load_structure("stack:blocks=2")
    with pytest.raises(InputError, match="finds no pair of states of stack:blocks=2 that one of width 64 has not seen"):
        build_goal_dataset(tiny, training_task(tiny, 1), device="cpu")
    with pytest.raises(InputError, match="a search of width 0 finds nothing"):
        GoalDataSettings(train_width=0)
    with pytest.raises(InputError, match="test_pairs is a count"):
        GoalDataSettings(test_pairs=0)
    with pytest.raises(InputError, match="random_tries is a count; give at least 1"):
        GoalDataSettings(random_tries=0)
    with pytest.raises(InputError, match="a seed is not negative"):
        GoalDataSettings(seed=-1)


def test_after_a_search_that_died_out_one_begins_at_the_empty_structure(
    bottle: Assembly, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What lies behind the point where searches die is learned so; what is tested on stays as it is."""
    down, up = Direction.DISASSEMBLY, Direction.ASSEMBLY
    directions = []
    through = iter([0, 4, 1, 0])

    def search(task: Task, oracle: Any, count: int, width: int, *, direction: Direction, **options: Any) -> Any:
        directions.append((direction, count, width))
        states, _ = parallel_beam_search(task, oracle, count, width, direction=direction, **options)
        return states, np.arange(count) < next(through)

    monkeypatch.setattr("falsework.learn.data.dataset.parallel_beam_search", search)
    task, device = training_task(bottle), torch.device("cpu")
    settings = GoalDataSettings(train_width=4, random_tries=2, test_width=12, widths=(2,) * 12 + (3,), test_pairs=20)
    SearchStates.find(task, settings, tensor_oracle(StabilityOracle(bottle), device), device=device)
    assert directions == [(down, 4, 2), (up, 4, 2), (down, 4, 2), (down, 1, 3)]


def test_no_search_begins_once_there_are_enough(bottle: Assembly) -> None:
    """What is learned from and tested on is always searched; of three further searches two are left out here."""
    task, device = training_task(bottle), torch.device("cpu")
    settings = GoalDataSettings(train_width=4, random_tries=2, test_width=12, widths=(8, 10, 12), test_pairs=20)
    oracle = tensor_oracle(StabilityOracle(bottle), device)
    answers = iter([False, True])
    found = SearchStates.find(task, settings, oracle, device=device, should_stop=lambda: next(answers))
    fewer = SearchStates.find(task, replace(settings, widths=(8,)), oracle, device=device)
    none = SearchStates.find(task, settings, oracle, device=device, should_stop=lambda: True)
    assert np.array_equal(found.more, fewer.more)
    assert np.array_equal(found.test, fewer.test)
    assert len(none.more) == 0
    alone = build_goal_dataset(bottle, task, settings, device="cpu", searched=none)
    assert alone.wide is alone.graph
    assert np.array_equal(alone.test.states, build_goal_dataset(bottle, task, settings, device="cpu").test.states)


def test_random_legal_actions_solve_few_pairs_of_a_real_structure(shared_assembly: Any) -> None:
    """Less than one in ten in the test and the validation set, with other draws than those that chose the pairs."""
    assembly = load_structure(str(shared_assembly("bottle-12")))
    data = build_goal_dataset(assembly, training_task(assembly), GoalDataSettings(test_pairs=100), device="cpu")
    environment = Environment(assembly, 2, device="cpu")

    def uniform(states, targets=None, /):
        return torch.zeros(len(states), 2 * assembly.part_count), torch.zeros(len(states))

    assert 50 < len(data.test) <= 100
    for pairs in (data.test, data.validation):
        states, targets = pairs.tensors(torch.device("cpu"))
        several = (states.repeat(8, 1), targets.repeat(8, 1))
        ended = roll_out(environment, uniform, *several, greedy=False, generator=environment.generator(5))
        assert ended.success.float().mean() < 0.1
    either = {tuple(row) for row in np.concatenate([data.test.states, data.test.targets], axis=1).tolist()}
    both = {tuple(row) for row in np.concatenate([data.validation.states, data.validation.targets], axis=1).tolist()}
    assert both
    assert not either & both

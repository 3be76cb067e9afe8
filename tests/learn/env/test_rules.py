"""TensorRules on tensors say what `Task` says, row by row, whatever the targets are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from numpy.typing import NDArray  # noqa: E402

from falsework import Assembly, Direction, Task, load_structure  # noqa: E402
from falsework.assembly import HELD, INSTALLED, REMOVED  # noqa: E402
from falsework.assembly.store import load_assembly  # noqa: E402
from falsework.errors import InputError, StateError  # noqa: E402
from falsework.search import TensorRules  # noqa: E402
from falsework.search.problem.hashing import StateHash  # noqa: E402

STAGE = np.array([2, 0, 1])
VALUES = np.array([INSTALLED, HELD, REMOVED], dtype=np.uint8)

States = NDArray[np.uint8]


def random_tasks(boundary: NDArray[np.bool_], robots: int, count: int, seed: int, fixed: list[int]) -> list[Task]:
    """Tasks between random starts and targets in which no part goes backwards and robots suffice."""
    rng = np.random.default_rng(seed)
    tasks: list[Task] = []
    while len(tasks) < count:
        late = 2 * rng.integers(0, 2, len(boundary))
        early = late * rng.integers(0, 2, len(boundary))
        for stage, least, most in ((late, early, 2), (early, 0, late)):
            some = rng.permutation(len(boundary))[: rng.integers(0, robots + 1)]
            stage[some] = np.clip(1, np.broadcast_to(least, late.shape)[some], np.broadcast_to(most, late.shape)[some])
        early[fixed] = late[fixed]
        start, target = (np.where(boundary, HELD, VALUES[stage]).astype(np.uint8) for stage in (early, late))
        if max(int(((s == HELD) & ~boundary).sum()) for s in (start, target)) > robots:
            continue
        tasks.append(Task.from_rules(boundary, robots, start=start, target=target, fixed=fixed))
    return tasks


def walk(task: Task, rng: np.random.Generator) -> list[States]:
    """States of a random walk that the rules allow, stability aside."""
    states = [task.start]
    while True:
        actions = np.flatnonzero(task.moves(states[-1][None], Direction.DISASSEMBLY)[0])
        if len(actions) == 0:
            return states
        states.append(task.follow(states[-1][None], rng.choice(actions, 1), Direction.DISASSEMBLY)[0])


def check_against_task(assembly: Assembly, robots: int, *, clear: bool, fixed: list[int], tasks: int) -> None:
    clearance = assembly.clearance if clear else None
    rules = TensorRules(Task.from_rules(assembly.boundary, robots, clearance=clearance, fixed=fixed))
    rng = np.random.default_rng(robots)
    states, targets, masks = [], [], []
    for plain in random_tasks(assembly.boundary, robots, tasks, 7 + robots, fixed):
        task = Task.from_rules(
            assembly.boundary, robots, start=plain.start, target=plain.target, fixed=fixed, clearance=clearance
        )
        passed = np.array(walk(task, rng))
        states.append(passed)
        targets.append(np.broadcast_to(task.target, passed.shape))
        masks.append(task.moves(passed, Direction.DISASSEMBLY))
        left = rules.steps_left(torch.tensor(passed), torch.tensor(targets[-1].copy()))
        assert left.tolist() == (task.steps - task.steps_done(passed)).tolist()
    states, targets, masks = (np.concatenate(rows) for rows in (states, targets, masks))
    assert np.array_equal(rules.moves(torch.tensor(states), torch.tensor(targets)).numpy(), masks)
    reached = rules.reached(torch.tensor(states), torch.tensor(targets)).numpy()
    assert np.array_equal(reached, (states == targets).all(axis=1))
    assert reached.any()
    assert rules.contains(torch.tensor(states), torch.tensor(targets)).all()


@pytest.mark.parametrize("robots", [1, 2, 3])
@pytest.mark.parametrize("clear", [False, True])
def test_masks_agree_with_task_row_by_row(robots: int, clear: bool) -> None:
    check_against_task(load_structure("bottle"), robots, clear=clear, fixed=[], tasks=120)


def test_masks_agree_with_fixed_parts() -> None:
    check_against_task(load_structure("arch:blocks=7"), 2, clear=False, fixed=[2, 5], tasks=120)


@pytest.mark.parametrize("name", ["bottle-12", "tetris-17", "vault-62"])
def test_masks_agree_on_real_structures(name: str, shared_assembly) -> None:
    check_against_task(load_assembly(shared_assembly(name)), 2, clear=False, fixed=[], tasks=60)


def test_without_target_everything_goes_but_what_is_fixed() -> None:
    assembly = load_structure("arch:blocks=7")
    fixed = [1, 4]
    rules = TensorRules(Task.from_rules(assembly.boundary, 2, fixed=fixed))
    rng = np.random.default_rng(1)
    for plain in random_tasks(assembly.boundary, 2, 60, 3, fixed):
        task = Task.from_rules(assembly.boundary, 2, start=plain.start, fixed=fixed)
        states = np.array(walk(task, rng))
        assert np.array_equal(rules.moves(torch.tensor(states)).numpy(), task.moves(states, Direction.DISASSEMBLY))
        assert rules.reached(torch.tensor(states)).tolist() == (states == task.target).all(axis=1).tolist()
        assert np.array_equal(rules.goals(torch.tensor(states)).numpy(), np.broadcast_to(task.target, states.shape))


def test_actions_and_hashes_are_those_of_arrays() -> None:
    assembly = load_structure("bottle")
    task = Task.from_rules(assembly.boundary, 2)
    rules = TensorRules(task)
    states = np.array(walk(task, np.random.default_rng(0)))
    row, action = np.nonzero(task.moves(states, Direction.DISASSEMBLY))
    after = rules.follow(torch.tensor(states[row]), torch.tensor(action.astype(np.int16)))
    assert np.array_equal(after.numpy(), task.follow(states[row], action, Direction.DISASSEMBLY))
    for harmless in (False, True):
        same = replace(task, holds_keep_stable=harmless)
        needed = TensorRules(same).needs_verdict(torch.tensor(action)).numpy()
        assert np.array_equal(needed, same.needs_verdict(action, Direction.DISASSEMBLY))
        assert needed.all() == (not harmless)
    words = StateHash.for_parts(assembly.part_count)(states).view(np.int64)
    assert np.array_equal(rules.hashes(torch.tensor(states)).numpy(), words)
    assert rules.complete(2).tolist() == [task.start.tolist()] * 2


def test_contains_sees_what_task_refuses() -> None:
    boundary = np.array([True, False, False, False])
    rules = TensorRules(Task.from_rules(boundary, 1, fixed=[3]))
    start = torch.tensor([[2, 1, 1, 1]], dtype=torch.uint8)
    for target, message in (([2, 2, 2, 1], "held"), ([2, 0, 0, 0], "fixed")):
        assert not rules.contains(start, torch.tensor([target], dtype=torch.uint8))
        with pytest.raises(StateError, match=message):
            Task.from_rules(boundary, 1, start=start[0].numpy(), target=target, fixed=[3])
    backwards = torch.tensor([[2, 0, 1, 1]], dtype=torch.uint8)
    assert not rules.contains(backwards, start)


def test_bad_input_is_one_clear_line() -> None:
    boundary = np.array([True, False, False])
    task = Task.from_rules(boundary, 1)
    with pytest.raises(InputError, match="unknown device"):
        TensorRules(task, "toaster")
    rules = TensorRules(task)
    with pytest.raises(StateError, match="state 1 has 2 parts held; 1 robot can hold 1"):
        rules.put([[2, 1, 1], [2, 2, 2]])
    with pytest.raises(StateError, match="boundary part 0"):
        rules.put([1, 1, 1])
    assert rules.put(torch.tensor([2, 0, 1])).tolist() == [[2, 0, 1]]


def test_removed_parts_are_never_touched() -> None:
    rules = TensorRules(Task.from_rules(np.array([True, False]), 1))
    assert not rules.moves(torch.tensor([[2, REMOVED]], dtype=torch.uint8)).any()

"""Pairs of start and goal that are extended beyond both ends."""

from __future__ import annotations

import pytest
import torch

from falsework import StabilityOracle, load_structure
from falsework.learn.algorithms.extension import Extension
from falsework.learn.data.dataset import search_states, training_task
from falsework.learn.data.random_walks import RandomWalkGoals
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.search.device.oracle import HostOracle
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction, Task

BOTTLE = load_structure("bottle:pieces=6,width=5,height=8,seed=2")


@pytest.fixture(scope="module")
def environment() -> Environment:
    return Environment(BOTTLE, 2, oracle=StabilityOracle(BOTTLE), device="cpu")


def test_a_path_connects_the_new_ends_and_none_is_held_out(environment: Environment) -> None:
    oracle = HostOracle(environment.oracle)
    task = training_task(BOTTLE).judged_by(oracle)
    found, _ = search_states(task, oracle, 4, 0)
    generator = environment.generator(0)
    tasks = RandomWalkGoals(StateGraph.from_states(task, found), device=torch.device("cpu"))
    starts, targets, _ = tasks.draw(64, generator)
    plain = Extension(environment, SolvableStates(environment.rules))
    ends = torch.cat(plain.extended(starts, targets, environment.generator(1)))
    solved = SolvableStates(environment.rules)
    solved.hold_out(ends[(ends != torch.cat([starts, targets])).any(dim=1)][:5])
    first, last = Extension(environment, solved).extended(starts, targets, environment.generator(1))
    moved = (first != starts).any(dim=1) & (last != targets).any(dim=1)
    assert moved.sum() > 16
    old = (solved.is_held_out(starts), solved.is_held_out(targets))
    assert not (solved.is_held_out(first) & ~old[0]).any()
    assert not (solved.is_held_out(last) & ~old[1]).any()
    for start, target in zip(first[moved][:16].numpy(), last[moved][:16].numpy(), strict=True):
        between = Task.from_rules(BOTTLE.boundary, 2, start=start, target=target).judged_by(oracle)
        assert search_states(between, oracle, 1 << 10, 0, direction=Direction.DISASSEMBLY)[1]


def test_pairs_without_a_move_stay(environment: Environment) -> None:
    solved = SolvableStates(environment.rules)
    complete = environment.rules.complete()
    empty = environment.rules.goals(complete)
    first, last = Extension(environment, solved).extended(complete, empty, environment.generator(0))
    assert torch.equal(first, complete)
    assert torch.equal(last, empty)

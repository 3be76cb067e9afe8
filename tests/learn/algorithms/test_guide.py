"""A policy as the guide of searches: probabilities are probabilities, from either end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from falsework import Direction, StabilityOracle, find_plans, load_structure, make_task
from falsework.assembly.state import action_mask
from falsework.errors import InputError
from falsework.learn import PolicySettings, make_policy
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.session_oracle import SessionOracle
from falsework.search import BeamSearch, BeamSettings
from falsework.search.problem.deadline import Deadline, DeadlineExceeded

ARCH = load_structure("arch:blocks=5")
TASK = make_task(ARCH)


@pytest.fixture(scope="module", params=[False, True], ids=["one state", "two states"])
def guide(request: pytest.FixtureRequest) -> PolicyGuide:
    policy = make_policy(ARCH, PolicySettings(kind="mlp", goal_conditioned=request.param), seed=1)
    with torch.no_grad():  # the heads begin almost even, which would make the tests idle
        policy.action_head.weight.mul_(200)  # type: ignore[operator, union-attr]
    return PolicyGuide(policy, task=TASK)


@pytest.fixture(scope="module")
def oracle() -> StabilityOracle:
    return StabilityOracle(ARCH)


def test_probabilities(guide: PolicyGuide) -> None:
    states = find_plans(ARCH, forces=False).plans[0].route.states
    legal = action_mask(states, ARCH.boundary, 2)
    logs = guide.log_probabilities(states, legal)
    assert np.isneginf(logs[~legal]).all()
    assert np.isneginf(logs[-1]).all()  # nothing is legal in the empty structure
    np.testing.assert_allclose(np.exp(logs[:-1]).sum(axis=1), 1, atol=1e-6)
    again = guide.log_probabilities(np.repeat(states, 2, axis=0), np.repeat(legal, 2, axis=0))
    np.testing.assert_array_equal(again[::2], again[1::2])  # equal questions are asked once


def test_both_ends_agree(guide: PolicyGuide) -> None:
    """Summed up along a way, the scores are those of a rollout that takes it, whichever end one begins at."""
    route = find_plans(ARCH, forces=False).plans[0].route
    total = {Direction.DISASSEMBLY: 0.0, Direction.ASSEMBLY: 0.0}
    for step, action in enumerate(route.actions):
        for direction, state in (
            (Direction.DISASSEMBLY, route.states[step]),
            (Direction.ASSEMBLY, route.states[step + 1]),
        ):
            mask = TASK.moves(state[None], direction)
            assert mask[0, action]
            total[direction] += guide(state[None], mask, direction)[0, action]
    assert total[Direction.DISASSEMBLY] == pytest.approx(total[Direction.ASSEMBLY], abs=1e-4)
    assert total[Direction.DISASSEMBLY] < -1


@pytest.mark.parametrize("direction", list(Direction))
def test_guides_a_beam(guide: PolicyGuide, oracle: StabilityOracle, direction: Direction) -> None:
    """The score of the best way that a beam found is what the policy gives this way."""
    beam = BeamSearch(TASK, oracle, BeamSettings(64, direction, "none"), guide=guide)
    assert beam.run().found
    route = beam.route()
    legal = TASK.moves(route.states, Direction.DISASSEMBLY)
    logs = guide.log_probabilities(route.states, legal)[np.arange(len(route.actions)), route.actions]
    assert beam.levels[-1].score[0] == pytest.approx(np.maximum(logs, -30).sum(), abs=1e-4)


def test_from_the_target_it_needs_a_task(guide: PolicyGuide) -> None:
    alone = PolicyGuide(guide.policy)
    states = TASK.target[None]
    with pytest.raises(InputError, match="only with the task"):
        alone(states, TASK.moves(states, Direction.ASSEMBLY), Direction.ASSEMBLY)


def test_speed_is_known(guide: PolicyGuide) -> None:
    fresh = PolicyGuide(guide.policy)
    assert fresh.seconds_for(4) == 0.0
    fresh.warm_up(TASK.start, 16)
    assert 0 < fresh.seconds_for(1) < 60
    assert fresh.seconds_for(64) >= fresh.seconds_for(16) > 0


def test_clock_stops_a_search(oracle: StabilityOracle) -> None:
    """When the time is up in the middle of a level, the search stands where it was before the level."""
    vault = load_structure("vault")
    clock = Deadline(0.15)
    timed = SessionOracle(StabilityOracle(vault), clock)
    task = make_task(vault)
    beam = BeamSearch(task, timed, BeamSettings(256, Direction.ASSEMBLY))
    result = beam.run()
    assert result.interrupted
    assert clock.passed
    levels = len(beam.levels)
    assert levels > 0
    with pytest.raises(DeadlineExceeded):
        timed.verdicts(task.start[None])
    assert len(beam.levels) == levels
    assert clock.spent["verdicts"] > 0


def test_clock_without_a_deadline(oracle: StabilityOracle) -> None:
    clock = Deadline()
    timed = SessionOracle(oracle, clock)
    plan = find_plans(ARCH, forces=False).plans[0]
    verdicts: Any = timed.verdicts(plan.states)
    assert verdicts.stable.all()
    assert timed.asked == len(plan.states)
    assert not clock.passed
    assert clock.left == np.inf

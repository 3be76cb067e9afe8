"""Searches guided by a policy, and the stages of `solve_all`, against all states of a small arch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from falsework import StateGraph, Task, load_structure, make_task
from falsework.assembly import HELD, REMOVED
from falsework.errors import InputError
from falsework.learn import Environment, PolicySettings, make_policy, roll_out
from falsework.learn.algorithms.policy_beam import policy_beam_search
from falsework.learn.algorithms.policy_search import solve_all
from falsework.replanning.result import Stage
from falsework.search import ExhaustiveSearch
from falsework.search.plans.plan_check import validate_plan

ARCH = load_structure("arch:blocks=5")


@pytest.fixture(scope="module")
def environment() -> Environment:
    return Environment(ARCH, 2, device="cpu")


@pytest.fixture(scope="module")
def graph(environment: Environment) -> StateGraph:
    """All states that the complete arch leads to, and whether each is solvable."""
    return ExhaustiveSearch(make_task(ARCH), environment.oracle).run().graph  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def solvable(graph: StateGraph, environment: Environment) -> torch.Tensor:
    return environment.rules.put(graph.states[graph.solvable])


@pytest.fixture(scope="module")
def policy() -> Any:
    """Never trained, so that it fails often."""
    return make_policy(ARCH, PolicySettings(kind="mlp"), seed=3)


def rows(states: torch.Tensor) -> set[bytes]:
    return {state.tobytes() for state in states.numpy()}


def test_searches_agree_with_all_states(environment: Environment, graph: StateGraph, policy: Any) -> None:
    """Wide enough, a search finds a way from exactly the states from which there is one; all on it are solvable."""
    states = environment.rules.put(graph.states)
    result = policy_beam_search(environment, policy, states, width=64)
    np.testing.assert_array_equal(result.found.numpy(), graph.solvable)
    assert rows(result.states) <= rows(states[torch.from_numpy(graph.solvable)])
    for number in range(0, len(states), 7):
        own = result.states[result.owner == number]
        if graph.solvable[number]:
            assert graph.states[number].tobytes() in rows(own)
            assert make_task(ARCH).target.tobytes() in rows(own)
        else:
            assert len(own) == 0


def test_searches_reach_targets(environment: Environment, graph: StateGraph, policy: Any) -> None:
    """Every start with a target of its own; the truth is a search through all states between the two."""
    pairs = [(a, b) for a in range(0, len(graph), 9) for b in range(0, len(graph), 11)]
    starts, targets, truth = [], [], []
    for a, b in pairs:
        try:
            task = Task.from_rules(ARCH.boundary, 2, start=graph.states[a], target=graph.states[b])
        except InputError:
            continue
        starts.append(graph.states[a])
        targets.append(graph.states[b])
        truth.append(ExhaustiveSearch(task, environment.oracle).run().result.found)
    assert any(truth)
    assert not all(truth)
    put = environment.rules.put
    found = policy_beam_search(environment, policy, put(np.array(starts)), put(np.array(targets)), width=64).found
    assert found.tolist() == truth
    solved = solve_all(environment, policy, put(np.array(starts)), put(np.array(targets)))
    assert (solved.decided_by != Stage.NONE).tolist() == truth


def test_searches_find_what_rollouts_do_not(environment: Environment, solvable: torch.Tensor) -> None:
    """A policy that always errs succeeds nowhere, yet a search that it guides finds the ways."""

    class Wrong(torch.nn.Module):
        def forward(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> Any:
            logits = torch.zeros(len(states), 2 * ARCH.part_count)
            logits[:, ARCH.part_count] = 40.0  # takes the block at the foot out as soon as it is held ...
            logits[:, 0] = 40.0  # ... which it soon is
            return logits, torch.zeros(len(states))

    complete = environment.rules.complete()
    assert not roll_out(environment, Wrong(), complete).success.any()
    found = policy_beam_search(environment, Wrong(), complete, width=16)
    assert found.found.all()
    assert rows(complete) <= rows(found.states) <= rows(solvable)
    (decider,) = solve_all(environment, Wrong(), complete, samples=0).decided_by
    assert decider == Stage.GUIDED


def test_everything_is_solved(environment: Environment, graph: StateGraph, solvable: torch.Tensor, policy: Any) -> None:
    """Every solvable state gets a plan from somebody, and no other state does."""
    solved = solve_all(environment, policy, solvable)
    assert solved.share == 1.0
    record = solved.to_dict()
    assert record["share"] == 1.0
    assert sum(record["decided_by"].values()) == record["states"] == len(solvable)
    hopeless = environment.rules.put(graph.states[~graph.solvable])
    if len(hopeless):
        assert solve_all(environment, policy, hopeless).share == 0.0
    alone = solve_all(environment, policy, solvable, samples=0, widths=(), plain_limit=len(solvable))
    assert alone.share == 1.0
    assert alone.to_dict()["decided_by"]["search"] > 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_on_a_gpu(graph: StateGraph) -> None:
    """The same truths where everything is on a GPU."""
    from falsework import Replanner

    environment = Environment(ARCH, 2, device="cuda")
    policy = make_policy(ARCH, PolicySettings(kind="transformer"), "cuda", seed=3)
    states = environment.rules.put(graph.states)
    good = torch.from_numpy(graph.solvable).to(states.device)
    np.testing.assert_array_equal(
        policy_beam_search(environment, policy, states, width=64).found.cpu().numpy(), graph.solvable
    )
    assert solve_all(environment, policy, states[good]).share == 1.0
    answer = Replanner(ARCH, policy).replan(environment.rules.complete()[0].cpu().numpy(), confidences=True)
    assert answer.value is not None
    assert validate_plan(answer.value, ARCH).good


def test_the_graph_has_traps(graph: StateGraph) -> None:
    """The tests above would be idle on a structure in which everything is solvable."""
    assert not graph.solvable.all()
    assert (graph.states[:, ARCH.boundary] == HELD).all()
    assert (graph.states == REMOVED).any()

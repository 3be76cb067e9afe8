"""Evaluation of policies: share of states from which the most probable actions succeed, every state proven stable."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import PolicyFunction, roll_out
from falsework.replanning.result import Stage
from falsework.search.problem.task import Direction
from falsework.utils.collectives import gather_rows, summed
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import put

Sets = Mapping[str, tuple[States, States | None]]
"""States, and targets if there are any, by the name of the set, such as `train` and `test`."""
Report = Callable[[int, int, str], None]
"""Progress callback `(done, total, message)`."""


@dataclass(frozen=True)
class Success:
    """Greedy success on a set of states."""

    states: int
    """Number of states tried."""
    succeeded: int
    """Number of starts from which the end was reached, every state on the path proven stable."""

    @property
    def share(self) -> float:
        """Between 0 and 1; 1 without states, since none failed."""
        return self.succeeded / self.states if self.states else 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the number of states and the share of success."""
        return {"states": self.states, "success": round(self.share, 6)}


def sample(states: NDArray[Any], count: int) -> NDArray[Any]:
    """Return a fixed sample of at most `count` rows, in the given order; all if it is 0."""
    if count <= 0 or len(states) <= count:
        return states
    return states[np.sort(np.random.default_rng(0).permutation(len(states))[:count])]


def greedy_success(
    environment: Environment,
    policy: PolicyFunction,
    states: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    shards: ProcessGroup = ProcessGroup(),
) -> tuple[Success, torch.Tensor]:
    """Follow the most probable action from every state.

    Args:
        environment: rules and verdicts.
        states: stable, shape (count, parts).
        targets: shape (count, parts), or None.
        shards: processes that share the states.

    Returns:
        Numbers over all processes, and which states succeeded, in every process, bool, shape (count,).
    """
    mine = shards.block(len(states))
    goals = None if targets is None else targets[mine]
    ended = roll_out(environment, policy, states[mine], goals, greedy=True, keep="ends").success
    success = gather_rows(ended.to(torch.uint8), shards).bool()
    return Success(len(states), int(success.sum())), success


def throughput(environment: Environment, seconds: float, shards: ProcessGroup = ProcessGroup()) -> dict[str, Any]:
    """Return the steps of the environment per second over all processes, and the share of the time by kind of work."""
    counters = environment.counters.to_dict()
    steps, asked = summed([float(counters["steps"]), float(counters["states_asked"])], shards, environment.device)
    shares = {name: round(float(value), 4) for name, value in counters.items() if name.startswith("share_")}
    return {
        "steps": int(steps),
        "steps_per_second": round(steps / max(seconds, 1e-9), 1),
        "asked": int(asked),
        **shares,
    }


def measure_success(
    environment: Environment,
    policy: PolicyFunction,
    sets: Sets,
    *,
    most: int = 0,
    search: bool = False,
    seed: int = 0,
    shards: ProcessGroup = ProcessGroup(),
    report: Report | None = None,
) -> dict[str, Any]:
    """Measure greedy success on sets of states and, with search, the share of states with a proven plan.

    Args:
        environment: rules and verdicts.
        policy: policy to evaluate; with search, a module as a `Replanner` takes it.
        sets: states, and targets if there are any, of shape (count, parts).
        most: states of each set, a fixed sample; 0: all.
        search: replan where the most probable actions fail, so that every state gets a proven plan if one is found.
        shards: processes that share the greedy rollouts.
        report: called with progress messages.

    Returns:
        For each set `states` and `success`; with search for `test` also `search`: the `share` of states with a proven
        plan, counts by deciding stage, seconds and verdicts.
    """
    results: dict[str, Any] = {}
    for number, (name, (states, targets)) in enumerate(sets.items()):
        if report is not None:
            report(number, len(sets), f"{len(states)} {name} states")
        rows = sample(np.arange(len(states)), most)
        chosen = put(states[rows], environment.device)
        goals = None if targets is None else put(targets[rows], environment.device)
        success, each = greedy_success(environment, policy, chosen, goals, shards=shards)
        results[name] = success.to_dict()
        if search and name == "test":
            if report is not None:
                report(number, len(sets), f"search from {name} states")
            failed = rows[~each.cpu().numpy()]
            found = _replanned(environment, policy, states[failed], None if targets is None else targets[failed], seed)
            found["decided_by"] = {Stage.GREEDY.value: success.succeeded} | found["decided_by"]
            results[name]["search"] = {"share": (success.succeeded + found.pop("found")) / max(len(rows), 1), **found}
    return results


def _replanned(
    environment: Environment, policy: PolicyFunction, states: States, targets: States | None, seed: int
) -> dict[str, Any]:
    """Replan from states where the most probable actions fail: number of plans found, stages, seconds and verdicts."""
    from falsework.replanning.replanner import Replanner, Request

    begun, task = time.perf_counter(), environment.rules.task
    requests = [
        Request(
            state,
            target=None if targets is None else targets[row],
            direction=Direction.DISASSEMBLY,
            robots=task.robots,
            removable_only_if_clear=task.clearance is not None,
            seed=seed,
        )
        for row, state in enumerate(states)
    ]
    oracle: Any = environment.oracle
    answers = Replanner(environment.assembly, policy, oracle).replan_many(requests) if requests else []
    return {
        "found": sum(answer.found for answer in answers),
        "decided_by": dict(Counter(answer.decided_by.value for answer in answers)),
        "seconds": time.perf_counter() - begun,
        "verdicts": sum(answer.verdicts for answer in answers),
    }

"""Methods that come with the benchmark: the planner of falsework, depth-first search, and policies.

Each takes a question and its structure, and returns an answer; the judge treats it as that of anybody else.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.judge import settings_of
from bench.questions import Question, Task
from benchmarks.baselines.depth_first import DepthFirstSearch, DepthFirstSettings
from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States, complete_state
from falsework.errors import InputError
from falsework.replanning.replanner import replan
from falsework.search.find import FIRST_SHARE, PLANS, find_plans, make_task
from falsework.search.min_robots import min_robots
from falsework.search.plans.plan import Plan
from falsework.search.problem.task import Direction
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion

if TYPE_CHECKING:
    from falsework.learn.env.environment import Environment

STATE_LIMIT = 100_000
"""States after which depth-first search gives up, as in the paper."""
_TRIED = 4
"""Numbers of robots that it tries, from one on, where the fewest are asked for."""


@dataclass(frozen=True)
class Found:
    """What a method found for a question."""

    steps: list[list[Any]] | None
    reason: str = ""
    robots: int = 0
    reserve: float = 1.0


@dataclass(frozen=True)
class Method:
    """A method, and the tasks that it is for."""

    tasks: tuple[Task, ...]
    answer: Callable[[Question, Assembly, float], Found]
    """Called with a question, its structure and a limit in seconds."""


def line_of(question: Question, assembly: Assembly, found: Found, seconds: float) -> dict[str, Any]:
    """Return the line of a submission for what a method found."""
    line: dict[str, Any] = {
        "question": question.name,
        "structure": question.structure.digest or assembly.identity,
        "steps": found.steps,
    }
    if found.steps is None:
        line["reason"] = found.reason or "none was found"
    elif question.task == "fewest":
        line["robots"] = found.robots
    if found.steps is not None and found.reserve > 1.0:
        line["reserve"] = found.reserve
    return {**line, "seconds": round(seconds, 4)}


def timed(method: Method, question: Question, assembly: Assembly, limit: float) -> tuple[Found, float]:
    """Return what a method finds, and the seconds of processor time that it took."""
    begun = time.process_time()
    try:
        found = method.answer(question, assembly, limit)
    except InputError as error:  # such as a state that leaves no legal action
        found = Found(None, str(error))
    return found, time.process_time() - begun


def steps_of(plan: Plan) -> list[list[Any]]:
    """Return the steps of a plan as an answer has them, in the order of assembly."""
    return [
        [step.action.value, step.part]
        + ([[[press.part, list(press.wrench)] for press in step.presses]] if step.presses else [])
        for step in plan.steps
    ]


def falsework(question: Question, assembly: Assembly, limit: float) -> Found:
    """Answer with the planner of the package at its defaults: with a reserve if it can, else without.

    The limit is of processor time for `plan`, else of time.
    """
    settings = settings_of(question, PLANS.reserve if question.criterion == "contact" else 1.0)
    if question.task == "plan":
        return _planned(question, assembly, settings, limit)
    if question.task == "fewest":
        needed = min_robots(assembly, stability=settings, deadline=limit, forces=False, progress=_silent)
        return _of_plan(needed.plan, needed.impossible or "; ".join(needed.reasons))
    answer = replan(
        assembly,
        question.begin(assembly.boundary),
        direction=Direction.ASSEMBLY,
        robots=question.robots,
        stability=settings,
        deadline=limit,
    )
    stands = answer.found and all(replayed.stands is not False for replayed in answer.replays)
    return _of_plan(answer.plans[0] if stands else None, answer.reason)


def _planned(question: Question, assembly: Assembly, settings: StabilitySettings, limit: float) -> Found:
    """Search for a plan, half of the time for one with the reserve."""
    begun, reason = time.process_time(), ""
    for reserve in sorted({settings.reserve, 1.0}, reverse=True):
        until = begun + limit * (FIRST_SHARE if reserve > 1.0 else 1.0)
        planning = find_plans(
            assembly,
            robots=question.robots,
            oracle=StabilityOracle(assembly, replace(settings, reserve=reserve)),
            stop=lambda until=until: time.process_time() > until,
            forces=False,
            progress=_silent,
        )
        if planning.found:
            return _of_plan(planning.plans[0], "")
        result = planning.result
        reason = "; ".join(result.notes) or result.limit or result.outcome.value
    return Found(None, reason)


def depth_first(question: Question, assembly: Assembly, limit: float) -> Found:
    """Answer by depth-first search as the paper has it: from the complete structure, actions in random order.

    Verdicts are those of the package, each on its state alone, so that under `contact` the judge may refute the plan.
    For `fewest` each number of robots, from one to four, has the same share of the time.
    """
    start, target = complete_state(assembly.boundary), question.begin(assembly.boundary)
    numbers = [question.robots] if question.robots else list(range(1, min(assembly.part_count, _TRIED) + 1))
    reason = ""
    for robots in numbers:
        task = make_task(assembly, robots, start=start, target=target)
        oracle = StabilityOracle(assembly, settings_of(question))
        settings = DepthFirstSettings(Direction.DISASSEMBLY, state_limit=STATE_LIMIT)
        search = DepthFirstSearch(task, oracle, settings, guide=_no_preference)
        until = time.process_time() + limit / len(numbers)
        result = search.run(stop=lambda until=until: time.process_time() > until)
        if result.found:
            return Found(_steps_between(result.routes[0].states[::-1]), robots=robots)
        reason = f"{result.outcome.value} after {result.counters.states} states"
    return Found(None, reason)


def _no_preference(states: States, actions: Mask, _: Direction) -> NDArray[np.float64]:
    """Score all actions alike, so that their order is random."""
    return np.zeros(actions.shape)


def _silent(_: object) -> None:
    """Show no progress."""


def _of_plan(plan: Plan | None, reason: str) -> Found:
    if plan is None:
        return Found(None, reason)
    return Found(steps_of(plan), robots=plan.robots, reserve=plan.claim.reserve)


def _steps_between(states: States) -> list[list[Any]]:
    """Return the steps through some states in the order of assembly."""
    found: list[list[Any]] = []
    for before, after in pairwise(states):
        part = int(np.flatnonzero(before != after)[0])
        found.append(["release" if after[part] == 1 else "insert", part])
    return found


def policy_of(folder: Path) -> Method:
    """Return the method that follows the most probable actions of a policy that `falsework train` wrote."""
    from falsework.learn.training.checkpoint import load_run

    run = load_run(folder)

    def follow(question: Question, assembly: Assembly, _: float) -> Found:
        if assembly.identity != run.assembly.identity:
            raise InputError(f"{folder} has a policy for {run.assembly.name}, not for {question.structure.name}")
        return _roll_out(question, assembly, run.policy, greedy=True)

    return Method(("policy",), follow)


def uniform(question: Question, assembly: Assembly, _: float) -> Found:
    """Answer with legal actions drawn with equal probabilities: what every policy has to be compared with."""
    from benchmarks.baselines.uniform import UniformPolicy

    return _roll_out(question, assembly, UniformPolicy(), greedy=False)


def _roll_out(question: Question, assembly: Assembly, policy: Any, *, greedy: bool) -> Found:
    """Answer with one rollout.

    Verdicts end the rollout as they do in training, but a policy does not see them.
    """
    import torch

    from falsework.learn.env.rollout import roll_out

    environment = _environment(assembly, question.robots, question.criterion)
    start = torch.from_numpy(question.begin(assembly.boundary)[None].copy())
    generator = torch.Generator().manual_seed(int(question.number or 0))
    ended = roll_out(environment, policy, start, greedy=greedy, generator=generator)
    if not bool(ended.success[0]):
        return Found(None, f"the rollout fails after {int(ended.length[0])} steps")
    taken, parts = ended.actions[: int(ended.length[0]), 0].tolist(), assembly.part_count
    return Found([["remove" if action >= parts else "hold", action % parts] for action in taken])


@cache
def _environment(assembly: Assembly, robots: int, criterion: Criterion) -> Environment:
    """Return the environment of the rollouts from all states of a row."""
    from falsework.learn.env.environment import Environment

    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))
    return Environment(assembly, robots, oracle=oracle, device="cpu")


_PLANNING: tuple[Task, ...] = ("plan", "fewest", "replan")
METHODS: Mapping[str, Method] = {
    "falsework": Method(_PLANNING, falsework),
    "depth-first": Method(_PLANNING, depth_first),
    "uniform": Method(("policy",), uniform),
}
"""Methods without settings of their own."""

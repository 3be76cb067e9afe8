"""Time replanning from complete and intermediate states, with and without a policy: one JSON object per line.

    python benchmarks/replan.py complete --runs my-run --structures vault-62
    python benchmarks/replan.py midway --runs my-run --count 100
    python benchmarks/replan.py deadline --structures dome-37 --deadlines 0.05 0.1 0.2 0.4
    python benchmarks/replan.py batch --runs my-run --clients 16

`complete`: a plan from the complete state to the empty one, once for each seed, each time with an empty cache.
`midway`: the same from intermediate solvable states, which a search of width 64 finds; one oracle for all, as in a
service. `deadline`: lateness of answers, and the share with a plan. `batch`: requests processed one by one and
together. `seconds` are lists of quantiles (least, median, 95 %, largest) and count from the
request to the certified plan; `load_seconds`, for loading kernels, structure and network, is apart.
`decided_by` counts the deciding stages. A structure is replanned without a policy, a run with its own.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from record import report, write_to
from states import find

from falsework import Assembly, Replanner, StabilityOracle, StabilitySettings, Task, load_structure
from falsework.assembly import States, complete_state
from falsework.replanning.replanner import ReplanResult, Request
from falsework.search import BeamSearch, BeamSettings
from falsework.search.plans.plan_check import validate_plan


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["complete", "midway", "deadline", "batch"]]
    """Benchmark."""
    structures: tuple[str, ...] = ()
    """Names of real structures, built-in names or paths: replanned without a policy."""
    runs: tuple[str, ...] = ()
    """Folders written by `falsework train`: replanned with their policies."""
    robots: int = 0
    """Parts held at once; 0 for 2, or for the number that a run was trained with."""
    count: int = 50
    """Number of intermediate states."""
    width: int = 64
    """Width of the search that finds these states."""
    seeds: int = 10
    """Repetitions from the complete state."""
    deadlines: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4, 0.8)
    """Deadlines, s."""
    clients: int = 16
    """Number of simultaneous requests."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the policies."""
    solver: Literal["auto", "cpu", "gpu"] = "cpu"
    """Stability solver."""
    threads: int = 1
    """Threads of the network on the CPU."""
    out: Path | None = None
    """File to which the records are appended."""


@dataclass(frozen=True)
class Case:
    """Structure or run to replan."""

    assembly: Assembly
    policy: Any
    name: str
    robots: int
    clear: bool

    def replanner(self, options: Options) -> tuple[Replanner, float]:
        """Return a replanner with an empty oracle, and the seconds to make it."""
        begun = time.perf_counter()
        oracle = StabilityOracle(self.assembly, StabilitySettings(solver=options.solver))
        replanner = Replanner(self.assembly, self.policy, oracle)
        return replanner, time.perf_counter() - begun

    def request(self, state: States, **more: Any) -> Request:
        """Return a request to dismantle the present parts."""
        return Request(state, robots=self.robots, removable_only_if_clear=self.clear, **more)


def cases(options: Options) -> Iterator[Case]:
    """Yield structures without a policy, then runs."""
    for name in options.structures or (() if options.runs else ("dome-37", "vault-62")):
        yield Case(load_structure(find(name)), None, name, options.robots or 2, False)
    if options.runs:
        import torch

        from falsework.learn import load_run

        torch.set_num_threads(options.threads)
        for folder in options.runs:
            run = load_run(folder, options.device)
            settings = run.settings
            robots = options.robots or settings.robots
            yield Case(run.assembly, run.policy, run.assembly.name, robots, settings.removable_only_if_clear)


def quantiles(seconds: Sequence[float]) -> list[float]:
    """Return least, median, 95 % quantile and largest."""
    return [round(float(value), 4) for value in np.quantile(seconds, [0, 0.5, 0.95, 1])]


def summary(answers: Sequence[ReplanResult]) -> dict[str, Any]:
    """Return times, outcomes and deciding stages of some answers."""
    spent: Counter[str] = Counter()
    for answer in answers:
        spent.update(answer.spent)
    return {
        "asked": len(answers),
        "seconds": quantiles([answer.seconds for answer in answers]),
        "found": sum(answer.found for answer in answers),
        "decided_by": dict(Counter(answer.decided_by.value for answer in answers)),
        "spent": {name: round(seconds / len(answers), 4) for name, seconds in spent.items()},
        "verdicts": int(np.median([answer.verdicts for answer in answers])),
    }


def show(what: str, case: Case, options: Options, **values: Any) -> None:
    """Print one record."""
    about = {"structure": Path(case.name).name, "policy": case.policy is not None, "robots": case.robots}
    report(f"replan {what}", **about, solver=options.solver, **values, device=options.device)


def complete(options: Options) -> None:
    """Replan from the complete state, with empty caches."""
    for case in cases(options):
        answers, load = [], []
        for seed in range(options.seeds):
            replanner, seconds = case.replanner(options)
            load.append(seconds)
            request = case.request(complete_state(case.assembly.boundary), seed=seed)
            answers += replanner.replan_many([request])
        proven = all(validate_plan(plan, case.assembly).good for plan in answers[0].plans)
        values = {"load_seconds": quantiles(load), "exact_solver_agrees": proven}
        show(
            "complete",
            case,
            options,
            seeds=tuple(range(options.seeds)),
            **summary(answers),
            **values,
        )


def middle(case: Case, options: Options) -> States:
    """Return solvable states of all sizes."""
    oracle = StabilityOracle(case.assembly)
    task = Task.from_rules(
        case.assembly.boundary, case.robots, clearance=case.assembly.clearance if case.clear else None
    )
    beam = BeamSearch(task, oracle, BeamSettings(options.width))
    beam.run()
    states = beam.states()
    states = states[(states != task.start).any(axis=1) & (states != task.target).any(axis=1)]
    return states[np.random.default_rng(0).permutation(len(states))[: options.count]]


def midway(options: Options) -> None:
    """Replan from intermediate states."""
    for case in cases(options):
        replanner, load = case.replanner(options)
        requests = [case.request(state, seed=n) for n, state in enumerate(middle(case, options))]
        answers = [replanner.replan_many([request])[0] for request in requests]
        show("midway", case, options, seeds=(0,), **summary(answers), load_seconds=round(load, 3))


def deadline(options: Options) -> None:
    """Measure the lateness of answers."""
    for case in cases(options):
        states = middle(case, options)
        for seconds in options.deadlines:
            replanner, _ = case.replanner(options)
            answers, taken = [], []
            for seed, state in enumerate(states):
                begun = time.perf_counter()
                answers += replanner.replan_many([case.request(state, seed=seed, deadline=seconds)])
                taken.append(time.perf_counter() - begun)
            late = quantiles(np.maximum(np.array(taken) - seconds, 0).tolist())
            show(
                "deadline",
                case,
                options,
                seeds=(0,),
                deadline=seconds,
                late=late,
                **summary(answers),
            )


def batch(options: Options) -> None:
    """Process requests one by one, and together."""
    for case in cases(options):
        states = middle(case, options)
        for together in (1, options.clients):
            replanner, _ = case.replanner(options)
            answers: list[ReplanResult] = []
            begun = time.perf_counter()
            for first in range(0, len(states), together):
                piece = states[first : first + together]
                answers += replanner.replan_many([case.request(state, seed=n) for n, state in enumerate(piece)])
            rate = len(answers) / (time.perf_counter() - begun)
            values = {"together": together, "answers_per_second": round(rate, 2)}
            show("batch", case, options, seeds=(0,), **values, **summary(answers))


def main() -> None:
    """Run the benchmark of the command line."""
    options = tyro.cli(Options, description=__doc__)
    write_to(options.out)
    {"complete": complete, "midway": midway, "deadline": deadline, "batch": batch}[options.what](options)


if __name__ == "__main__":
    main()

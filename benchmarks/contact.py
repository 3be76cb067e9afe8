"""Time the criterion `contact`, its replays and plans under it: one JSON object per line.

    python benchmarks/contact.py verdicts
    python benchmarks/contact.py steps --structures vault:parts=500 vault:parts=1000
    python benchmarks/contact.py replay
    python benchmarks/contact.py plan --seeds 5
    python benchmarks/contact.py criteria
    python benchmarks/contact.py all --out benchmarks/results/contact.jsonl

`verdicts`: both criteria on the same states in one process, taken from a search under `contact` in its order,
with parents; `ratio` is the median over the repetitions of contact's time over equilibrium's. `cold_ms` is one
state without a parent from Python, the median over the states of a plan. `steps`: the highest parts are held and
removed in turn; each state once from the displacement of the one before, once from rest. `replay`: a whole plan, four
increments each.
`plan`: from the assembly to the proven and replayed plan, the median over seeds; `seconds_before_replay` leaves out the
proofs and the last replay. `criteria`: the states of a plan found under `equilibrium`, judged under `contact` from
rest; `changed` are verdicts with other ratios of stiffness, `iterations` those of stable states. Compilation is not
counted. Structures of the paper are read from FALSEWORK_DATA, else from the folder `shared` beside the repository.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from record import report, spread, write_to
from states import Recorder, find

from falsework import (
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    Verdict,
    find_plans,
    load_structure,
    make_task,
)
from falsework.assembly import HELD, REMOVED, complete_state
from falsework.search import SupportGuide
from falsework.search.find import PLANS
from falsework.search.planner import Planner
from falsework.stability.settings import EQUILIBRIUM

STRUCTURES = ("vault", "vault-62", "dome-72", "dog-35", "dome-37", "bottle-12", "dome")


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["verdicts", "steps", "replay", "plan", "criteria", "all"]]
    """Benchmark."""
    structures: tuple[str, ...] = STRUCTURES
    """Built-in names, paths, or names of structures of the paper."""
    robots: int = 2
    """Parts held at once."""
    seeds: int = 5
    """Searches of `plan`."""
    steps: int = 8
    """Parts that `steps` holds and removes."""
    repeat: int = 5
    """Repetitions of `verdicts` and `replay`."""
    out: Path | None = None
    """File to which the records are appended."""


def verdicts(name: str, options: Options) -> Iterator[dict[str, Any]]:
    """Time both criteria on the states that a search checks."""
    assembly = load_structure(find(name))
    recorder = Recorder(StabilityOracle(assembly))
    planning = Planner(make_task(assembly, options.robots), recorder, guide=SupportGuide(assembly)).run()
    questions = recorder.states, recorder.parents
    times: dict[str, list[float]] = {"contact": [], "equilibrium": []}
    counts: dict[str, Any] = {}
    for _ in range(options.repeat):
        for criterion, settings in (("contact", StabilitySettings()), ("equilibrium", EQUILIBRIUM)):
            oracle = StabilityOracle(assembly, settings)
            begun = time.perf_counter()
            found = [oracle.verdicts(states, near=parents) for states, parents in zip(*questions, strict=True)]
            times[criterion].append(time.perf_counter() - begun)
            counts[criterion] = int(sum(batch.stable.sum() for batch in found))
    asked = sum(map(len, recorder.states))
    ratios = [a / b for a, b in zip(times["contact"], times["equilibrium"], strict=True)]
    cold = []
    states = planning.routes[0].states
    for state in states:
        oracle = StabilityOracle(assembly)
        begun = time.perf_counter()
        oracle.verdicts(state[None])
        cold.append((time.perf_counter() - begun) * 1e3)
    yield {
        "asked": asked,
        "repeat": options.repeat,
        "seeds": (0,),
        "stable": counts,
        "ms_each": {key: spread([t / asked * 1e3 for t in value]) for key, value in times.items()},
        "ratio": spread(ratios),
        "cold_ms": spread(cold),
    }


def steps(name: str, options: Options) -> Iterator[dict[str, Any]]:
    """Time a verdict from the displacement of the previous state, and from rest."""
    assembly = load_structure(find(name))
    complete = complete_state(assembly.boundary)
    loose = np.flatnonzero(~assembly.boundary)
    highest = loose[np.argsort(-assembly.mass.center[loose, 2])][: options.steps]
    times: dict[str, list[float]] = {"beside": [], "from rest": []}
    agree = 0
    for _ in range(options.repeat):
        oracle = StabilityOracle(assembly)
        oracle.verdicts(complete[None], near=complete[None])
        state = complete
        for part in highest:
            for value in (HELD, REMOVED):
                child = state.copy()
                child[part] = value
                found = []
                for way, judge in (("beside", oracle), ("from rest", StabilityOracle(assembly))):
                    begun = time.process_time()
                    found.append(judge.verdicts(child[None], near=state[None]).verdict[0])
                    times[way].append((time.process_time() - begun) * 1e3)
                agree += int(found[0] == found[1])
                if found[0] != Verdict.STABLE:
                    break
                state = child
    yield {
        "parts": assembly.part_count,
        "states": len(times["beside"]),
        "repeat": options.repeat,
        "seeds": (0,),
        "agree": agree,
        "ms_each": {way: spread(each) for way, each in times.items()},
        "seconds": {way: round(sum(each) / 1e3, 2) for way, each in times.items()},
    }


def replay(name: str, options: Options) -> Iterator[dict[str, Any]]:
    """Time a replay of a complete plan."""
    assembly = load_structure(find(name))
    oracle = StabilityOracle(assembly)
    plan = find_plans(assembly, make_task(assembly, options.robots), oracle=oracle).plans[0]
    assert oracle.replayer is not None
    seconds = []
    for _ in range(options.repeat):
        begun = time.perf_counter()
        result = oracle.replayer.replay(plan.states)
        seconds.append(time.perf_counter() - begun)
    moved = round(result.largest * 1e3, 4)
    yield {
        "states": len(plan.states),
        "repeat": options.repeat,
        "seeds": (0,),
        "stands": result.good,
        "moved_mm": moved,
        "seconds": spread(seconds),
    }


def plan(name: str, options: Options) -> Iterator[dict[str, Any]]:
    """Time a certified plan with a successful replay."""
    assembly = load_structure(find(name))
    whole, search, states, fail, asked = [], [], 0, 0, []
    for seed in range(options.seeds):
        oracle = StabilityOracle(assembly, PLANS)
        begun = time.perf_counter()
        task = make_task(assembly, options.robots)
        planning = find_plans(
            assembly, task, oracle=oracle, settings=PlannerSettings(width=1024, seed=seed), forces=False
        )
        whole.append(time.perf_counter() - begun)
        search.append(planning.result.seconds)
        asked.append(oracle.counters.asked)
        for found in planning.plans:
            assert oracle.replayer is not None
            states += len(found.states)
            fail += int((oracle.replayer.replay(found.states, presses=found.presses_before).stands != 1).sum())
    yield {
        "seeds": tuple(range(options.seeds)),
        "robots": options.robots,
        "reserve": PLANS.reserve,
        "seconds": spread(whole),
        "seconds_before_replay": spread(search),
        "verdicts": spread([float(count) for count in asked]),
        "states": states,
        "states_that_fail_the_replay": fail,
    }


def criteria(name: str, options: Options) -> Iterator[dict[str, Any]]:
    """Judge the states of a plan found under `equilibrium` by `contact`, from rest."""
    assembly = load_structure(find(name))
    states = find_plans(assembly, robots=options.robots, stability=EQUILIBRIUM, forces=False).plans[0].states
    found = StabilityOracle(assembly).verdicts(states)
    changed = {}
    for kind, ratio in (("ratio_04", 0.4), ("ratio_1", 1.0)):
        other = StabilityOracle(assembly, StabilitySettings(stiffness_ratio=ratio)).verdicts(states)
        changed[kind] = int((other.verdict != found.verdict).sum())
    yield {
        "robots": options.robots,
        "states": len(states),
        "stable": int(found.stable.sum()),
        "slides": int((found.verdict == Verdict.SLIDES).sum()),
        "iterations": spread([float(count) for count in found.iterations[found.stable]]),
        "changed": changed,
        "seeds": (0,),
    }


def main(options: Options) -> None:
    """Run the benchmarks on each structure."""
    chosen = {"verdicts": verdicts, "steps": steps, "replay": replay, "plan": plan, "criteria": criteria}
    names = list(chosen) if options.what == "all" else [options.what]
    find_plans(load_structure("arch:blocks=5"))
    write_to(options.out)
    for what in names:
        for name in options.structures:
            for row in chosen[what](name, options):
                report(f"contact {what}", structure=name, **row)


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Cost against the number of parts on the built-in vault: one JSON object per size, then one with the fits.

    python benchmarks/scaling.py
    python benchmarks/scaling.py --parts 62 250 1000 4000 10000 --out benchmarks/results/scaling.jsonl
    python benchmarks/scaling.py --plans --parts 62 125 250 500 1000 --limit 300 --out benchmarks/results/scaling.jsonl

For every size, processor time in seconds: for the contacts, for the problem (wrench maps, order of elimination), for
one verdict of the complete structure with its certificate accepted by the checker, under both criteria, and under
`contact` for one of the states in which the highest parts are held and removed in turn while it stands, from the
displacement of the state before (`next_s`, median). Besides, iterations from rest, and the peak memory of the process.
Each size runs in a process of its own, so that memory is that size's alone. `exponent` is the slope of a straight line
through the logarithms: 1 is linear in the number of parts.

`--plans` measures plans instead, by criterion, robots and seed, in processor time of all cores: the structure
with its contacts, the search (under `contact` with its replays), and the proofs of all states, forces kept in the plan.
`search_s` ends with the last level; a search that uses more than `--limit` seconds ends without a plan, and does not
count in the fit.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from record import report, write_to

from falsework import PlannerSettings, StabilityOracle, StabilitySettings, find_plans, load_structure
from falsework.assembly import HELD, REMOVED, complete_state
from falsework.geometry import find_contacts
from falsework.search import SearchProgress
from falsework.search.find import PLANS
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.verdict import Criterion

MEASURED = ("contacts_s", "problem_s", "equilibrium_s", "contact_s", "next_s", "memory_gib")
PLAN_MEASURED = ("contacts_s", "search_s", "proofs_s", "plan_s", "memory_gib")
_HIGHEST = 4
"""Parts that are held and removed."""


@dataclass(frozen=True)
class Options:
    """Sizes and numbers of runs."""

    parts: tuple[int, ...] = (62, 125, 250, 500, 1000, 2000, 4000)
    """Numbers of parts of the vault."""
    repeats: int = 3
    """Number of runs of each; the median counts."""
    out: Path | None = None
    """File to which the records are appended; the picture in the documentation is drawn from the last of them."""
    plans: bool = False
    """Measure plans instead of verdicts."""
    criteria: tuple[Criterion, ...] = ("contact", "equilibrium")
    """Criteria of the plans."""
    robots: tuple[int, ...] = (2,)
    """Numbers of robots of the plans."""
    seeds: int = 1
    """Seeds of the searches for a plan, from 0 on."""
    limit: float = 300.0
    """Seconds of processor time for a search."""
    alone: bool = False
    """Measure the first size in this process and print its object only; of a plan, that of the last seed."""


def measure(parts: int, repeats: int) -> dict[str, float | int | str]:
    """Return median times of one size."""
    times: dict[str, list[float]] = {name: [] for name in MEASURED[:-1]}
    begun = time.process_time()

    def clock(name: str) -> None:
        nonlocal begun
        times[name].append(time.process_time() - begun)
        begun = time.process_time()

    assembly = load_structure(f"vault:parts={parts}")
    small = load_structure("vault:parts=62")
    for settings in (EQUILIBRIUM, StabilitySettings()):  # compiles
        StabilityOracle(small, settings).verdicts(complete_state(small.boundary), require_certificate=True)
    state = complete_state(assembly.boundary)
    loose = np.flatnonzero(~assembly.boundary)
    highest = loose[np.argsort(-assembly.mass.center[loose, 2])][:_HIGHEST]
    iterations = 0
    for _ in range(repeats):
        begun = time.process_time()
        find_contacts(assembly.meshes)
        clock("contacts_s")
        oracle = StabilityOracle(assembly, EQUILIBRIUM)
        clock("problem_s")
        for name, asked in (("equilibrium_s", oracle), ("contact_s", StabilityOracle(assembly))):
            begun = time.process_time()
            verdict = asked.verdicts(state, require_certificate=True)
            clock(name)
            if not verdict.stable[0]:
                raise SystemExit(f"vault:parts={parts} is not proven stable")
        iterations = int(verdict.iterations[0])
        oracle, before = StabilityOracle(assembly), state
        oracle.verdicts(state[None], near=state[None])
        for change in ((part, value) for part in highest for value in (HELD, REMOVED)):
            after = before.copy()
            after[change[0]] = change[1]
            begun = time.process_time()
            stands = oracle.verdicts(after[None], near=before[None]).stable[0]
            if not stands:
                break
            clock("next_s")
            before = after
    return {
        "parts": assembly.part_count,
        "contact_points": len(assembly.contacts.points),
        **{name: round(float(np.median(seconds)), 5) for name, seconds in times.items()},
        "iterations": iterations,
        "memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
    }


def measure_plan(parts: int, criterion: Criterion, robots: int, seed: int, limit: float) -> dict[str, Any]:
    """Return the times of one plan, or of a search that found none."""
    settings = PLANS if criterion == "contact" else EQUILIBRIUM
    small = load_structure("vault:parts=62")
    find_plans(small, oracle=StabilityOracle(small, settings))  # compiles
    begun = time.process_time()
    assembly = load_structure(f"vault:parts={parts}")
    loaded = searched = time.process_time()

    def reached(_: SearchProgress) -> None:
        nonlocal searched
        searched = time.process_time()

    planning = find_plans(
        assembly,
        robots=robots,
        oracle=StabilityOracle(assembly, settings),
        settings=PlannerSettings(seed=seed),
        progress=reached,
        stop=lambda: time.process_time() - loaded > limit,
    )
    return {
        "parts": assembly.part_count,
        "criterion": criterion,
        "reserve": settings.reserve,
        "robots": robots,
        "found": planning.accepted,
        "reached": planning.result.reached,
        "steps": planning.result.steps,
        "verdicts": planning.result.counters.asked,
        "contacts_s": round(loaded - begun, 3),
        "search_s": round(searched - loaded, 3),
        "proofs_s": round(time.process_time() - searched, 3),
        "plan_s": round(time.process_time() - begun, 3),
        "memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
    }


def apart(*arguments: object) -> dict[str, Any]:
    """Return what this script measures with some arguments in a process of its own."""
    command = [sys.executable, __file__, "--alone", *map(str, arguments)]
    line = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip().splitlines()[-1]
    return json.loads(line)


def exponents(results: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, float]:
    """Return the slopes of the logarithms of measured values over those of the parts."""
    sizes = np.log([result["parts"] for result in results])
    return {name: round(float(np.polyfit(sizes, np.log([r[name] for r in results]), 1)[0]), 2) for name in names}


def report_plans(options: Options) -> None:
    """Measure plans of all sizes under each criterion, with each number of robots."""
    for criterion, robots in product(options.criteria, options.robots):
        found = []
        for parts in options.parts:
            for seed in range(options.seeds):
                wanted = "--parts", parts, "--criteria", criterion, "--robots", robots
                result = apart("--plans", *wanted, "--seeds", seed + 1, "--limit", options.limit)
                report("scaling plan", **result, limit=options.limit, seeds=[seed], time="processor")
                found += [result] if result["found"] else []
        sizes = sorted({result["parts"] for result in found})
        if len(sizes) > 2:
            exponent = exponents(found, PLAN_MEASURED)
            seeds = range(options.seeds)
            report("scaling plan fit", parts=sizes, criterion=criterion, exponent=exponent, seeds=seeds, robots=robots)


def main(options: Options) -> None:
    """Run the benchmark."""
    if options.alone and options.plans:
        found = measure_plan(options.parts[0], options.criteria[0], options.robots[0], options.seeds - 1, options.limit)
        print(json.dumps(found), flush=True)
        return
    if options.alone:
        print(json.dumps(measure(options.parts[0], options.repeats)), flush=True)
        return
    write_to(options.out)
    if options.plans:
        report_plans(options)
        return
    results = []
    for parts in options.parts:
        results.append(apart("--parts", parts, "--repeats", options.repeats))
        report("scaling", **results[-1], repeats=options.repeats, time="processor")
    if len(results) > 1:
        report("scaling fit", parts=options.parts, exponent=exponents(results, MEASURED), time="processor")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Compare planning with that of another commit, seed by seed in one run: one JSON object per structure.

    git worktree add ../before COMMIT
    python benchmarks/search_compare.py --before ../before --structures vault crossvault-184 --seeds 5

Each plan is searched for in a process of its own, once with this source tree and once with the other, in turn.
`cpu_seconds` and `seconds` are those of the search with its proofs, without loading and compilation; a search that
uses more than `--limit` seconds of CPU time ends without a plan and counts with what it used. `verdict_ratio` and
`cpu_ratio` are medians here over medians there.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from record import report, spread, write_to

_HERE = Path(__file__).resolve().parents[1]
_MEASURED = ("verdicts", "cpu_seconds", "seconds", "memory_gib")


@dataclass(frozen=True)
class Options:
    """Structures, commits and seeds to compare."""

    structures: tuple[str, ...] = ("vault",)
    """Built-in names, paths, or names of real structures."""
    before: Path | None = None
    """Worktree of the commit to compare with."""
    robots: int = 2
    """Parts held at once."""
    criterion: Literal["contact", "equilibrium"] = "contact"
    """Stability criterion of the plans."""
    reserve: float = 1.1
    """Number by which friction is divided, under `contact`; commits before it was there plan without."""
    seeds: int = 5
    """Number of seeds, from 0 on."""
    processes: int = 1
    """Searches at the same time, each confined to its share of the cores (Linux)."""
    limit: float = 60.0
    """Seconds of CPU time for each search."""
    plans: Path | None = None
    """Folder to which the plans of this tree are written."""
    child: int | None = None
    """Search with this seed in this process, and print the figures."""
    out: Path | None = None
    """File to which the records are appended."""


def search(options: Options, seed: int) -> dict[str, Any]:
    """Search for one plan in this process."""
    from falsework import PlannerSettings, StabilityOracle, StabilitySettings, find_plans, load_structure
    from falsework.search.plans.plan_file import save_plan

    stability = StabilitySettings(criterion=options.criterion)
    if "reserve" in StabilitySettings.__dataclass_fields__ and options.criterion == "contact":  # not in old commits
        stability = StabilitySettings(criterion=options.criterion, reserve=options.reserve)
    small, assembly = load_structure("arch:blocks=5"), load_structure(options.structures[0])
    find_plans(small, oracle=StabilityOracle(small, stability))  # have everything compiled
    cpu, wall = time.process_time(), time.perf_counter()
    planning = find_plans(
        assembly,
        robots=options.robots,
        oracle=StabilityOracle(assembly, stability),
        settings=PlannerSettings(seed=seed),
        stop=lambda: time.process_time() - cpu > options.limit,
    )
    figures = {
        "parts": assembly.part_count,
        "found": planning.found and len(planning.plans) == 1 and planning.accepted,
        "reached": planning.result.reached,
        "steps": planning.result.steps,
        "verdicts": planning.result.counters.asked,
        "cpu_seconds": time.process_time() - cpu,
        "seconds": time.perf_counter() - wall,
        "memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "presses": sum(map(bool, getattr(planning.plans[0], "presses", ()))) if planning.plans else 0,
    }
    if options.plans is not None and planning.found:
        save_plan(planning.plans[0], options.plans / f"{assembly.name}-{seed}.json")
    return figures


def run(options: Options, tree: Path, structure: str, seed: int) -> dict[str, Any]:
    """Search for one plan in a process that imports falsework from a source tree."""
    command = [sys.executable, "-W", "ignore", __file__, "--child", str(seed), "--structures", structure]
    if options.processes > 1:
        cores = sorted(os.sched_getaffinity(0))
        share = len(cores) // options.processes
        own = cores[seed % options.processes * share :][:share]
        command = ["taskset", "--cpu-list", ",".join(map(str, own)), *command]
    command += ["--robots", str(options.robots), "--limit", str(options.limit), "--criterion", options.criterion]
    command += ["--reserve", str(options.reserve)]
    if options.plans is not None and tree == _HERE:
        command += ["--plans", str(options.plans)]
    environment = {**os.environ, "PYTHONPATH": str(tree.resolve() / "src")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return medians with ranges, and the number of searches that found a plan."""
    figures: dict[str, Any] = {name: spread([run[name] for run in runs]) for name in _MEASURED}
    figures["presses"] = spread([float(run["presses"]) for run in runs])
    return {"found": sum(run["found"] for run in runs), "reached": spread([run["reached"] for run in runs]), **figures}


def compare(options: Options) -> None:
    """Compare both trees in turn on all structures and seeds."""
    from states import find

    trees = {"now": _HERE} if options.before is None else {"now": _HERE, "before": options.before}
    for name in options.structures:
        runs: dict[str, list[dict[str, Any]]] = {tree: [] for tree in trees}

        def in_turn(seed: int, name: str = name) -> list[dict[str, Any]]:
            return [run(options, path, find(name), seed) for path in trees.values()]

        with ThreadPoolExecutor(options.processes) as pool:
            for found in pool.map(in_turn, range(options.seeds)):
                for tree, figures_of_seed in zip(trees, found, strict=True):
                    runs[tree].append(figures_of_seed)
        now = summary(runs["now"])
        figures: dict[str, Any] = {}
        if options.before is not None:
            before = summary(runs["before"])
            git = ["git", "-C", str(options.before), "rev-parse", "--short=7", "HEAD"]
            figures = {
                "before": before,
                "before_commit": subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip(),
                "verdict_ratio": now["verdicts"]["median"] / before["verdicts"]["median"],
                "cpu_ratio": now["cpu_seconds"]["median"] / before["cpu_seconds"]["median"],
            }
        report(
            "search_compare plans",
            structure=name,
            seeds=range(options.seeds),
            parts=runs["now"][0]["parts"],
            steps=runs["now"][0]["steps"],
            robots=options.robots,
            criterion=options.criterion,
            reserve=options.reserve if options.criterion == "contact" else 1.0,
            limit=options.limit,
            processes=options.processes,
            **now,
            **figures,
        )


if __name__ == "__main__":
    chosen = tyro.cli(Options, description=__doc__)
    if chosen.child is not None:
        print(json.dumps(search(chosen, chosen.child)))
    else:
        write_to(chosen.out)
        compare(chosen)

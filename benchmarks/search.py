"""Time searches, and compare the sizes of state graphs with the paper's: one JSON object per line.

    python benchmarks/search.py plan
    python benchmarks/search.py graph --structures bottle-12 --widths 64 128
    python benchmarks/search.py plan --structures vault:parts=1000 --robots 2
    python benchmarks/search.py alternatives --count 5
    python benchmarks/search.py methods
    python benchmarks/search.py bound --structures dome-90 crossvault-184

`plan`: `seconds` runs from the meshes on disk to the plan with its proofs, `search_seconds` is the search alone;
compilation is not counted. `graph`: `states` and `unseen` stand beside the paper's Table 3, whose second
number counts the states of the wider search that the narrower one did not find. `alternatives`: distances between
plans. `methods`: the planner, the paper's beam from both ends, and depth-first search on the same structures.
`bound`: robots that cores prove to be needed, in processor time.
Without `--structures`: the real structures where they are found (FALSEWORK_DATA, else the folder `shared` beside the
repository).
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from baselines.depth_first import DepthFirstSearch, DepthFirstSettings
from record import report, write_to
from states import REAL, find, real_structures

from falsework import (
    Direction,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    StateGraph,
    find_plans,
    load_structure,
    make_task,
)
from falsework.search import BeamSearch, BeamSettings, SearchProgress
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.hold_bound import HoldBound
from falsework.stability.settings import EQUILIBRIUM

TABLE_3 = {"bottle-12": (1077, 1159), "dome-37": (4540, 8430), "vault-62": (4781, 10229)}
"""The paper's states: found by a search of width 64; found by one of width 128 and not by the first."""


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["plan", "graph", "alternatives", "methods", "bound"]]
    """Benchmark."""
    structures: tuple[str, ...] = ()
    """Built-in names, paths, or names of real structures; empty for all of the benchmark."""
    robots: int = 2
    """Parts held at once."""
    widths: tuple[int, int] = (64, 128)
    """Widths of the graphs."""
    count: int = 5
    """Number of alternative plans."""
    seed: int = 0
    """Seed of the searches."""
    criterion: Literal["contact", "equilibrium"] = "contact"
    """Criterion of `plan` and `methods`; graphs are compared with the paper's and so are under `equilibrium`."""
    quiet: bool = False
    """Suppress the progress of long searches on standard error."""
    out: Path | None = None
    """File to which the records are appended."""


def structures(options: Options, names: tuple[str, ...]) -> list[str]:
    """Return the structures of the command line, else those of `names` that this machine has."""
    return [find(name) for name in options.structures or real_structures(names)]


def warm_up() -> None:
    """Compile all kernels."""
    find_plans(load_structure("arch:blocks=5"), settings=PlannerSettings(alternatives=2))


def progress(options: Options) -> Any:
    """Return a progress callback that writes to standard error."""
    last = time.perf_counter()

    def show(event: SearchProgress) -> None:
        nonlocal last
        if not options.quiet and time.perf_counter() - last > 10:
            last = time.perf_counter()
            where = f"{event.direction.value} level {event.level} of {event.levels}, width {event.width}"
            os.write(2, f"{event.seconds:7.0f} s  {where}, {event.asked} verdicts\n".encode())

    return show


def plan(options: Options) -> None:
    """Time plans from the meshes on."""
    for structure in structures(options, REAL):
        begin = time.perf_counter()
        assembly = load_structure(structure)
        task = make_task(assembly, options.robots)
        settings = PlannerSettings(seed=options.seed)
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=options.criterion))
        planning = find_plans(assembly, task, oracle=oracle, settings=settings, progress=progress(options))
        seconds = time.perf_counter() - begin
        result = planning.result
        report(
            "search plan",
            structure=Path(structure).name,
            seeds=(options.seed,),
            parts=assembly.part_count,
            robots=options.robots,
            outcome=result.outcome.value,
            steps=result.steps,
            reached=result.reached,
            verdicts=result.counters.asked,
            search_seconds=round(result.seconds, 3),
            seconds=round(seconds, 3),
            criterion=options.criterion,
            replay_stands=planning.found and planning.plans[0].replay is not None and planning.plans[0].replay.stands,
            proofs_accepted=planning.found and validate_plan(planning.plans[0], assembly, oracle.settings).good,
        )


def graph(options: Options) -> None:
    """Compare state graphs of two widths from the empty structure."""
    for structure in structures(options, tuple(TABLE_3)):
        assembly = load_structure(structure)
        task, found = make_task(assembly, options.robots), []
        for width in options.widths:
            begin = time.perf_counter()
            # A new oracle each time: no verdicts are cached from the other width.
            search = BeamSearch(
                task, StabilityOracle(assembly, EQUILIBRIUM), BeamSettings(width=width, seed=options.seed)
            )
            result = search.run(progress=progress(options))
            found.append(StateGraph.from_states(task, search.states(), name=assembly.name))
            name, paper = Path(structure).name, None
            compared = len(found[-1]) if len(found) == 1 else int(found[1].unseen(found[0].states).sum())
            if options.widths == (64, 128) and options.robots == 2 and name in TABLE_3:
                paper = TABLE_3[name][len(found) - 1]
            report(
                "search graph",
                structure=Path(structure).name,
                seeds=(options.seed,),
                width=width,
                robots=options.robots,
                found=result.found,
                states=len(found[-1]),
                unseen=None if len(found) == 1 else compared,
                actions=len(found[-1].source),
                paper=paper,
                difference=None if paper is None else round(compared / paper - 1, 4),
                verdicts=result.counters.asked,
                seconds=round(time.perf_counter() - begin, 3),
            )


def alternatives(options: Options) -> None:
    """Measure distances between alternative plans."""
    for structure in structures(options, ("bottle-12", "vault-62")):
        assembly = load_structure(structure)
        task = make_task(assembly, options.robots)
        begin = time.perf_counter()
        settings = PlannerSettings(alternatives=options.count, seed=options.seed)
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=options.criterion))
        planning = find_plans(assembly, task, oracle=oracle, settings=settings, progress=progress(options))
        seconds, chosen = time.perf_counter() - begin, planning.alternatives
        others = ~np.eye(len(chosen.routes), dtype=bool)
        report(
            "search alternatives",
            structure=Path(structure).name,
            seeds=(options.seed,),
            wanted=options.count,
            found=len(chosen.routes),
            least_distance=round(chosen.least_distance, 4),
            mean_order_distance=round(float(chosen.order_distance[others].mean()), 4) if others.any() else None,
            mean_state_distance=round(float(chosen.state_distance[others].mean()), 4) if others.any() else None,
            verdicts=planning.result.counters.asked,
            seconds=round(seconds, 3),
        )


def methods(options: Options) -> None:
    """Compare the planner with the paper's beam and depth-first search."""
    for structure in structures(options, REAL):
        assembly = load_structure(structure)
        task = make_task(assembly, options.robots)
        runs: dict[str, Any] = {
            "planner": lambda oracle, assembly=assembly, task=task: find_plans(assembly, task, oracle=oracle).result
        }
        for direction in Direction:
            beam = BeamSettings(width=options.widths[0], direction=direction, seed=options.seed)
            runs[f"beam {beam.width} {direction.value}"] = lambda oracle, task=task, beam=beam: BeamSearch(
                task, oracle, beam
            ).run()
            deep = DepthFirstSettings(direction, seed=options.seed, state_limit=20_000)
            runs[f"depth-first {direction.value}"] = lambda oracle, task=task, deep=deep: DepthFirstSearch(
                task, oracle, deep
            ).run(stop=deadline(60))
        for name, run in runs.items():
            result = run(StabilityOracle(assembly, StabilitySettings(criterion=options.criterion)))
            report(
                "search methods",
                structure=Path(structure).name,
                seeds=(options.seed,),
                method=name,
                outcome=result.outcome.value,
                reached=result.reached,
                steps=result.steps,
                verdicts=result.counters.asked,
                seconds=round(result.seconds, 3),
            )


def bound(options: Options) -> None:
    """Numbers of robots that cores refute, from one on."""
    for structure in structures(options, REAL):
        assembly = load_structure(structure)
        begin = time.process_time()
        test = HoldBound(assembly, make_task(assembly, options.robots), StabilitySettings(), Deadline())
        least, core = 1, ()
        while found := test.core(least):
            least, core = least + 1, found
        report(
            "search bound",
            structure=Path(structure).name,
            parts=assembly.part_count,
            least=least,
            core=len(core),
            verdicts=test.asked,
            cpu_seconds=round(time.process_time() - begin, 3),
        )


def deadline(seconds: float) -> Any:
    """Return a function that is true once the time is over."""
    end = time.perf_counter() + seconds
    return lambda: time.perf_counter() > end


if __name__ == "__main__":
    chosen = tyro.cli(Options, description=__doc__)
    warm_up()
    write_to(chosen.out)
    {"plan": plan, "graph": graph, "alternatives": alternatives, "methods": methods, "bound": bound}[chosen.what](
        chosen
    )

"""Continue the assembly of plans that are interrupted at random times: one JSON object per line.

    python benchmarks/continued.py dome-37 --seeds 5 --interruptions 4
    python benchmarks/continued.py bottle-12 --seeds 5 --interruptions 4

Each seed is planned for robots that move at the same time and interrupted at random times of its schedule, where the
motions that have begun are finished. From the state, the joint values, and the parts held and carried there, the rest
of the assembly is planned again, with another seed: `sequential` and `together` by `plan_robots`, both
from structure and cell in memory, and `command` by `falsework robots plan --direction assembly --sequential`, all
processes included. All times are CPU seconds. `holding` and `carrying` count the interruptions at which a robot holds a
part in place, or carries one. Every plan is checked by Pinocchio and Coal unless `--no-check` is given. The structures
are read from FALSEWORK_DATA, else from the folder `shared` beside the repository.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from record import report, spread, write_to
from robots import STRUCTURES, structure
from states import find

from falsework import Assembly, Task, load_cell, plan_robots
from falsework.robots import Cell, HybridSettings, RobotPlan, interruption
from falsework.robots.cells.warm_up import compile_kernels
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.plans.robot_plan_file import load_robot_plan, save_robot_plan
from falsework.robots.plans.timeline import Interruption

_OTHER_SEED = 1000
"""Added to the seed for the rest of a plan."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["dome-37", "bottle-12"]]
    seeds: int = 5
    first_seed: int = 0
    interruptions: int = 4
    """Interruptions of each plan."""
    deadline: float = 60.0
    no_check: bool = False
    out: Path | None = None
    """File to which the record is appended."""


def _command(name: str, plan: RobotPlan, now: Interruption, seed: int, folder: Path) -> tuple[RobotPlan | None, float]:
    """Return the plan that the command line makes, and its CPU time."""
    arms = [robot.name for robot in plan.robots]
    joints = {arm: values.tolist() for arm, values in zip(arms, now.configurations, strict=True)}
    (folder / "now.json").write_text(json.dumps(joints))
    save_robot_plan(plan, folder / "plan.json")
    out = folder / "rest.json"
    out.unlink(missing_ok=True)
    command = [sys.executable, "-m", "falsework", "robots", "plan", str(find(STRUCTURES[name])), "--cell", name]
    command += [
        "--state",
        "".join(map(str, now.state)),
        "--joints",
        str(folder / "now.json"),
    ]
    held = ",".join(f"{arm}={part}" for arm, part in zip(arms, now.held, strict=True) if part is not None)
    command += ["--holding", held] if held else []
    command += ["--grips", str(folder / "plan.json"), "--sequential", "--seed", str(seed), "--out", str(out)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=False, capture_output=True, env=os.environ)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return load_robot_plan(out) if out.is_file() else None, spent


def _good(plan: RobotPlan | None, assembly: Assembly, cell: Cell, now: Interruption) -> bool:
    """Return whether a plan begins where another one was interrupted, ends complete, and passes the check."""
    if plan is None:
        return False
    first = interruption(plan, -1.0)
    same = np.array_equal(first.state, now.state) and first.held == now.held
    near = np.abs(np.array(first.configurations) - np.array(now.configurations)).max() < 1e-9
    return bool(same and near and plan.states[-1].all() and check_robot_plan(plan, assembly, cell).good)


def main(arguments: Arguments) -> None:
    """Run the benchmark."""
    name = arguments.what
    assembly, cell = structure(STRUCTURES[name]), load_cell(name)
    compile_kernels()
    seeds = tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds))
    cpu: dict[str, list[float]] = {"sequential": [], "together": [], "command": []}
    tried = found = good = holding = carrying = 0
    for seed in seeds:
        settings = HybridSettings(seed=seed)
        plan = plan_robots(assembly, cell, settings=settings, deadline=arguments.deadline, concurrent=True).value
        if plan is None:
            continue
        for share in np.random.default_rng(seed).random(arguments.interruptions):
            now = interruption(plan, share * plan.makespan)
            task = Task.from_rules(assembly.boundary, cell.robot_count, target=now.state, identity=assembly.identity)
            if task.steps == 0:
                continue
            holding += any(part is not None and now.state[part] for part in now.held)
            carrying += any(grip is not None for grip in now.gripped)
            given: dict[str, Any] = {"configurations": now.configurations, "held": now.held, "gripped": now.gripped}
            settings = HybridSettings(seed=seed + _OTHER_SEED)
            rest: list[RobotPlan | None] = []
            begun = time.process_time()
            one = plan_robots(assembly, cell, task=task, settings=settings, deadline=arguments.deadline, **given).value
            cpu["sequential"].append(time.process_time() - begun)
            rest.append(one)
            begun = time.process_time()
            both = plan_robots(
                assembly, cell, task=task, settings=settings, deadline=arguments.deadline, concurrent=True, **given
            ).value
            cpu["together"].append(time.process_time() - begun)
            rest.append(both)
            with tempfile.TemporaryDirectory() as folder:
                made, spent = _command(name, plan, now, settings.seed, Path(folder))
            cpu["command"].append(spent)
            rest.append(made)
            tried += 1
            found += all(entry is not None for entry in rest)
            good += not arguments.no_check and all(_good(entry, assembly, cell, now) for entry in rest)
    report(
        "robots continued",
        cell=name,
        robots=cell.robot_count,
        runs=tried,
        found=found,
        holding=holding,
        carrying=carrying,
        checked_good=None if arguments.no_check else good,
        **{f"{kind}_cpu_seconds": spread(values) for kind, values in cpu.items()},
        within_two_seconds=sum(value <= 2.0 for value in cpu["command"]),
        seeds=seeds,
    )


if __name__ == "__main__":
    given = tyro.cli(Arguments)
    write_to(given.out)
    main(given)

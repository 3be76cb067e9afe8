"""Time plans with motions for complete structures, and check them by independent libraries: one JSON object per line.

    python benchmarks/robots.py dome-37 --seeds 10
    python benchmarks/robots.py vault-62-a --seeds 5
    python benchmarks/robots.py vault-62-b --seeds 5
    python benchmarks/robots.py bottle-12 --seeds 5
    python benchmarks/robots.py dome-72
    python benchmarks/robots.py dome-37 --midway --seeds 5
    python benchmarks/robots.py random --cells 20
    python benchmarks/robots.py dome-37 --policy RUN
    python benchmarks/robots.py dome-37 --together --seeds 10
    python benchmarks/robots.py dome-37 --delays --seeds 1
    python benchmarks/robots.py vault-62-b --support --seeds 4
    python benchmarks/robots.py all

The first five plan a published structure in the built-in cell of that name: `seconds` is from structure and cell in
memory to a proven plan with timed motions, compilation not counted. The last line of each has median and worst.
`--together`: each seed is planned twice, one robot at a time and with robots that move at the same time;
`makespan_share` is the makespan of the second over the first plan, `extra_seconds` its additional planning time,
`extra_cpu_seconds` that of all its processes, and the check proves the schedule free of collisions under any delays,
and `delayed` random runs of it are simulated.
`--plans` writes the plans, so that `falsework robots check` can check them elsewhere.
`--delays`: each seed is planned with robots that move at the same time, and its schedule checked under any delays, in
the order of disassembly and reversed: `overlaps` pairs of motions and rests of two arms that can coincide, `early`
pairs of a motion and a part that stands only because of a delay, `ranges` and `distances` of the proofs. `delayed`
random runs are simulated. `removed` waits for another arm are left out, one at a time; without `unsafe` of them the
proof fails.
`--support`: each seed is planned twice, without and with parts that are released and held again.
`--midway`: each seed is planned, then planned again from three of its keyframes at which a part is held, as after a
disruption: `fresh` from structure and cell alone, `kept` with the keyframe graph and the verdicts of the first plan.
`random`: dome-37 in cells with random bases of two arms from which every part can be held; success and, for each
failure, the explanation. `--policy`: a run of `falsework train` for that structure as guide. `--no-check` leaves the
check by Pinocchio and Coal out. The structures are read from FALSEWORK_DATA, else from the folder `shared` beside the
repository.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from record import report, spread, write_to
from states import find

from falsework import Assembly, Direction, StabilityOracle, Task, load_cell, load_structure, plan_robots
from falsework.errors import FalseworkError
from falsework.robots import Cell, CellRobot, HybridSettings, KeyframeGraph, RobotPlan, check_cell, simulate
from falsework.robots.cells.warm_up import compile_kernels
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.checks.delays import check_delays
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import inverse_pose, pose
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.robot_plan_file import save_robot_plan
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.search import Guide

STRUCTURES = {
    "dome-37": "dome-37",
    "vault-62-a": "vault-62",
    "vault-62-b": "vault-62",
    "bottle-12": "bottle-12",
    "dome-72": "dome-72",
}
PAPER_SECONDS = {"dome-37": 300, "vault-62-a": 5760, "vault-62-b": 5760}
"""The paper's times for a plan of the robots."""


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Benchmark and its settings."""

    what: Annotated[
        tyro.conf.Positional[Literal["dome-37", "vault-62-a", "vault-62-b", "bottle-12", "dome-72", "random", "all"]],
        tyro.conf.arg(metavar="WHAT"),
    ]
    seeds: int = 10
    first_seed: int = 0
    deadline: float = 180.0
    cells: int = 20
    policy: Path | None = None
    no_check: bool = False
    together: bool = False
    support: bool = False
    midway: bool = False
    delayed: int = 1000
    plans: Path | None = None
    """Folder to which the plans of `--together` are written, to check them where Pinocchio is installed."""
    delays: bool = False
    removed_waits: int = 5
    out: Path | None = None
    """File to which the records are appended."""


def structure(name: str) -> Assembly:
    """Return one of the published structures, with its clearance table."""
    assembly = load_structure(find(name))
    assembly.clearance  # noqa: B018 - depends on the structure alone
    return assembly


def once(
    assembly: Assembly,
    cell: Cell,
    seed: int,
    deadline: float,
    *,
    check: bool,
    guide: Guide | None = None,
    support: bool = False,
) -> tuple[HybridResult, dict]:
    """Plan once from structure and cell alone, with a guide if given, and with parts held again if `support`."""
    task = Task.from_rules(assembly.boundary, cell.robot_count, identity=assembly.identity, allow_regrasp=support)
    begun, work = time.perf_counter(), time.process_time()
    result = plan_robots(assembly, cell, task=task, guide=guide, settings=HybridSettings(seed=seed), deadline=deadline)
    seconds, work = time.perf_counter() - begun, time.process_time() - work
    statistics = {key: value for key, value in result.statistics.items() if key not in ("failure", "seconds", "seed")}
    fields: dict[str, Any] = {"found": result.found, "seconds": round(seconds, 3), "cpu_seconds": round(work, 3)}
    fields |= statistics
    if result.value is not None:
        fields["motion_seconds"] = round(result.value.seconds, 1)
        if support:
            handed = sum(step.hands_over is not None for step in result.value.steps) // 2
            opened = [result.value.grip(step) for step in range(len(result.value))].count("open")
            fields |= {"released": opened - handed, "handed_over": handed}
    if result.explanation is not None:
        fields["why"] = result.explanation.text
    plan = result.value or result.partial
    if check and plan is not None:
        checked = check_robot_plan(plan, assembly, cell)
        fields |= {"check": checked.good, "samples": checked.samples, "check_seconds": round(checked.seconds, 1)}
        fields["problems"] = [str(problem) for problem in checked.problems[:3]]
    return result, fields


def policy_guide(run: Path, assembly: Assembly, cell: Cell) -> Guide:
    """Return a trained policy, on one thread, which is faster for single states."""
    import torch

    from falsework.learn import load_run
    from falsework.learn.data.dataset import training_task
    from falsework.replanning.policy_guide import PolicyGuide

    torch.set_num_threads(1)
    task = training_task(assembly, cell.robot_count, removable_only_if_clear=True)
    return PolicyGuide(load_run(run, assembly=assembly).policy, task=task)


def building(name: str, arguments: Arguments) -> None:
    """Plan with several seeds in one built-in cell, then report median and worst."""
    assembly, cell = structure(STRUCTURES[name]), load_cell(name)
    guide = None if arguments.policy is None else policy_guide(arguments.policy, assembly, cell)
    seconds, cpu, attempts, found, good = [], [], [], 0, 0
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        result, fields = once(assembly, cell, seed, arguments.deadline, check=not arguments.no_check, guide=guide)
        report("robots plan", cell=name, robots=cell.robot_count, guided=guide is not None, **fields, seeds=(seed,))
        seconds.append(fields["seconds"])
        cpu.append(fields["cpu_seconds"])
        attempts.append(fields["attempts"])
        found += result.found
        good += bool(fields.get("check"))
    report(
        "robots",
        cell=name,
        robots=cell.robot_count,
        guided=guide is not None,
        runs=len(seconds),
        found=found,
        checked_good=None if arguments.no_check else good,
        seconds=spread(seconds),
        cpu_seconds=spread(cpu),
        attempts=spread(attempts),
        **({"paper_seconds": PAPER_SECONDS[name]} if name in PAPER_SECONDS else {}),
        seeds=tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds)),
    )


def regrasping(name: str, arguments: Arguments) -> None:
    """Plan with several seeds in one built-in cell, without and with parts held again, then report both."""
    assembly, cell = structure(STRUCTURES[name]), load_cell(name)
    seeds = tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds))
    figures: dict[str, list[float]] = {}
    found, released, good = [0, 0], 0, 0
    for seed in seeds:
        for support in (False, True):
            result, fields = once(
                assembly, cell, seed, arguments.deadline, check=support and not arguments.no_check, support=support
            )
            report("robots support seed", cell=name, robots=cell.robot_count, support=support, **fields, seeds=(seed,))
            found[support] += result.found
            released += fields.get("released", 0)
            good += bool(result.found and fields.get("check"))
            for what in ("attempts", "dead_ends", "cpu_seconds"):
                figures.setdefault(f"{what}_with" if support else what, []).append(fields[what])
    report(
        "robots support",
        cell=name,
        robots=cell.robot_count,
        runs=len(seeds),
        found=found[False],
        found_with=found[True],
        released=released,
        checked_good=None if arguments.no_check else good,
        **{what: spread(values) for what, values in figures.items()},
        seeds=seeds,
    )


def cpu_seconds() -> float:
    """Return the processor time of this process, and of those that it has waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def together(name: str, arguments: Arguments) -> None:
    """Plan with several seeds in one built-in cell, one robot at a time and together, then report median ratios."""
    assembly, cell = structure(STRUCTURES[name]), load_cell(name)
    shares, bounds, extra, extra_cpu, good = [], [], [], [], 0
    seeds = tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds))
    for seed in seeds:
        alone = HybridSettings(seed=seed)
        begun, work = time.perf_counter(), cpu_seconds()
        before = plan_robots(assembly, cell, settings=alone, deadline=arguments.deadline).value
        middle, used = time.perf_counter(), cpu_seconds()
        plan = plan_robots(assembly, cell, settings=alone, deadline=arguments.deadline, concurrent=True).value
        seconds, cpu = time.perf_counter() - middle, cpu_seconds() - used
        if before is None or plan is None or plan.schedule is None:
            both = {"found_sequential": before is not None, "cpu_seconds": round(cpu_seconds() - work, 1)}
            report("robots together seed", cell=name, found=False, **both, seeds=(seed,))
            continue
        fields = _checked(plan, assembly, cell, arguments)
        good += bool(fields["check"])
        if arguments.plans is not None:
            arguments.plans.mkdir(parents=True, exist_ok=True)
            save_robot_plan(plan, arguments.plans / f"{name}-{seed}.json")
        shares.append(plan.makespan / before.seconds)
        bounds.append(plan.schedule.lower_bound / plan.makespan)
        extra.append(seconds - (middle - begun))
        extra_cpu.append(cpu - (used - work))
        report(
            "robots together seed",
            cell=name,
            robots=cell.robot_count,
            found=True,
            makespan=round(plan.makespan, 2),
            sequential=round(plan.seconds, 2),
            today=round(before.seconds, 2),
            lower_bound=round(plan.schedule.lower_bound, 2),
            makespan_share=round(shares[-1], 3),
            extra_seconds=round(extra[-1], 1),
            extra_cpu_seconds=round(extra_cpu[-1], 1),
            search=plan.statistics["search"],
            **fields,
            seeds=(seed,),
        )
    if len(shares) < 2:
        return
    report(
        "robots together",
        cell=name,
        robots=cell.robot_count,
        runs=len(seeds),
        found=len(shares),
        checked_good=None if arguments.no_check else good,
        makespan_share=spread(shares),
        bound_share=spread(bounds),
        extra_seconds=spread(extra),
        extra_cpu_seconds=spread(extra_cpu),
        seeds=seeds,
    )


def midway(name: str, arguments: Arguments) -> None:
    """Replan from keyframes of plans at which a part is held, then report medians."""
    assembly, cell = structure(STRUCTURES[name]), load_cell(name)
    seeds = tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds))
    seconds: dict[str, list[float]] = {"fresh": [], "kept": []}
    cpu: dict[str, list[float]] = {"fresh": [], "kept": []}
    tried = found = good = 0
    for seed in seeds:
        settings = HybridSettings(Direction.DISASSEMBLY, seed=seed)
        graph, oracle = KeyframeGraph(assembly, cell, seed=seed), StabilityOracle(assembly)
        first = plan_robots(
            assembly, cell, settings=settings, deadline=arguments.deadline, graph=graph, oracle=oracle
        ).value
        if first is None:
            continue
        busy = [k for k, frame in enumerate(first.keyframes) if any(part is not None for part in frame.held)]
        for row in np.quantile(busy, (0.25, 0.5, 0.75), method="nearest").astype(int).tolist():
            frame, task = (
                first.keyframes[row],
                Task.from_rules(
                    assembly.boundary, cell.robot_count, start=first.states[row], identity=assembly.identity
                ),
            )
            for kind in ("fresh", "kept"):
                again: dict[str, Any] = {"graph": graph, "oracle": oracle} if kind == "kept" else {}
                begun, work = time.perf_counter(), time.process_time()
                plan = plan_robots(
                    assembly,
                    cell,
                    task=task,
                    configurations=frame.configurations,
                    held=frame.held,
                    settings=settings,
                    deadline=arguments.deadline,
                    **again,
                ).value
                seconds[kind].append(time.perf_counter() - begun)
                cpu[kind].append(time.process_time() - work)
                tried += 1
                found += plan is not None
                good += plan is not None and not arguments.no_check and check_robot_plan(plan, assembly, cell).good
    report(
        "robots midway",
        cell=name,
        robots=cell.robot_count,
        runs=tried,
        found=found,
        checked_good=None if arguments.no_check else good,
        **{f"{kind}_seconds": spread(seconds[kind]) for kind in seconds},
        **{f"{kind}_cpu_seconds": spread(cpu[kind]) for kind in cpu},
        seeds=seeds,
    )


def _checked(plan: RobotPlan, assembly: Assembly, cell: Cell, arguments: Arguments) -> dict[str, Any]:
    """Check a schedule, nominal and under any delays, and simulate delayed runs of it."""
    runs = simulate(plan, runs=arguments.delayed)
    if arguments.no_check:
        return {"check": None, "delayed": arguments.delayed, "out_of_order": runs.out_of_order}
    report = check_robot_plan(plan, assembly, cell)
    return {
        "check": report.good and runs.good,
        "delayed": arguments.delayed,
        "out_of_order": runs.out_of_order,
        "outside": runs.outside,
        "problems": [str(problem) for problem in report.problems[:3]],
    }


def delays(name: str, arguments: Arguments) -> None:
    """Plan with several seeds in one built-in cell, and check the schedules under any delays."""
    assembly, cell = structure(STRUCTURES[name]), load_cell(name)
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
        settings = HybridSettings(seed=seed)
        plan = plan_robots(assembly, cell, settings=settings, deadline=arguments.deadline, concurrent=True).value
        if plan is None or plan.schedule is None:
            report("robots delays", cell=name, robots=cell.robot_count, found=False, seeds=(seed,))
            continue
        for schedule in (plan, plan.reverse()):
            fields = _under_delays(schedule, assembly, cell, arguments)
            report(
                "robots delays",
                cell=name,
                robots=cell.robot_count,
                direction=schedule.direction.value,
                found=True,
                makespan=round(schedule.makespan, 2),
                motions=len(plan.schedule.nodes),
                **fields,
                seeds=(seed,),
            )


def _under_delays(plan: RobotPlan, assembly: Assembly, cell: Cell, arguments: Arguments) -> dict[str, Any]:
    """Check a schedule under any delays, in some random runs, and without some of its waits."""
    graph = plan.schedule
    assert graph is not None
    judge = PinocchioCollisionChecker(cell, place_parts(assembly, cell.placement), 0.001)
    work = time.process_time()
    proof = check_delays(plan, judge)
    cpu = time.process_time() - work
    runs = simulate(plan, runs=arguments.delayed)
    waits = [edge for edge in graph.edges if edge.why in ("part", "volume")]
    chosen = np.random.default_rng(0).permutation(len(waits))[: arguments.removed_waits].tolist()
    unsafe = 0
    for k in chosen:
        kept = tuple(edge for edge in graph.edges if edge is not waits[k])
        careless = TemporalPlanGraph(graph.nodes, kept, graph.robots, 0.0)
        unsafe += bool(check_delays(replace(plan, schedule=careless), judge, most=1).problems)
    return {
        "problems": len(proof.problems),
        "overlaps": proof.overlaps,
        "early": proof.early,
        "ranges": proof.ranges,
        "distances": proof.distances,
        "proof_cpu_seconds": round(cpu, 2),
        "delayed": arguments.delayed,
        "out_of_order": runs.out_of_order,
        "outside": runs.outside,
        "delayed_makespan": spread(runs.makespans.tolist()),
        "removed": len(chosen),
        "unsafe": unsafe,
    }


def random_cells(assembly: Assembly, count: int, seed: int) -> Iterator[tuple[int, Cell]]:
    """Cells like that of dome-37 whose arms stand elsewhere; every part can be held by one of them, none is blocked."""
    made, rng, drawn = 0, np.random.default_rng(seed), 0
    plain = load_cell("dome-37")
    while made < count:
        drawn += 1
        turn = rng.uniform(-np.pi, np.pi)
        robots = []
        for robot, offset in zip(plain.robots, (np.pi, rng.uniform(-0.7, 0.7)), strict=True):
            angle, far = turn + offset, rng.uniform(1.1, 1.45)
            base = pose((far * np.cos(angle), far * np.sin(angle), 0.0), angle + np.pi + rng.uniform(-0.4, 0.4))
            robots.append(_moved(robot, base))
        cell = replace(plain, name=f"random {made}", robots=tuple(robots))
        graph = KeyframeGraph(assembly, cell)
        try:
            check_cell(cell, graph.parts)
        except FalseworkError:
            continue
        free = np.flatnonzero(~assembly.boundary).tolist()
        if all(graph.reachable(part) for part in free):
            yield drawn, cell
            made += 1


def _moved(robot: CellRobot, base: np.ndarray) -> CellRobot:
    """Return a robot with a new base, and drop-off poses that move with it."""
    return replace(robot, base=base, places=base @ inverse_pose(robot.base) @ robot.places)


def random_layouts(arguments: Arguments) -> None:
    """Measure success over random cells in which every part can be reached."""
    assembly = structure("dome-37")
    seconds, found, good = [], 0, 0
    for number, (drawn, cell) in enumerate(random_cells(assembly, arguments.cells, arguments.first_seed)):
        result, fields = once(assembly, cell, 0, arguments.deadline, check=not arguments.no_check)
        report("robots plan", cell=f"random {number}", drawn=drawn, **fields, seeds=(0,))
        seconds.append(fields["seconds"])
        found += result.found
        good += bool(result.found and fields.get("check"))
    report(
        "robots",
        cell="random",
        robots=2,
        guided=False,
        runs=arguments.cells,
        found=found,
        checked_good=None if arguments.no_check else good,
        seconds=spread(seconds),
        seeds=(arguments.first_seed,),
    )


def main() -> None:
    """Compile, then run."""
    arguments = tyro.cli(Arguments, description=__doc__)
    write_to(arguments.out)
    compile_kernels()
    StabilityOracle(load_structure("stack:blocks=2"))
    names = [*STRUCTURES, "random"] if arguments.what == "all" else [arguments.what]
    for name in names:
        if arguments.support:
            regrasping(name, arguments)
        elif arguments.delays:
            delays(name, arguments)
        elif arguments.together:
            together(name, arguments)
        elif arguments.midway:
            midway(name, arguments)
        elif name == "random":
            random_layouts(arguments)
        else:
            building(name, arguments)


if __name__ == "__main__":
    main()

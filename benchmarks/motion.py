"""Collision checks and plans beside Pinocchio, Coal and OMPL, in one run: one JSON object per line.

    python benchmarks/motion.py --structure dome-37
    python benchmarks/motion.py --structure dome-37 --pairs 100000 --configurations 100000

One arm of the cell moves, the other is at home, all parts are in place. Configurations are random within the
limits; `free` of them have no contact. Times are CPU times of one core. `missed` counts what Coal calls a
collision and ours does not, over random pairs of pieces and over random configurations of the cell; it must be 0. Plans
join random free configurations; with `carried` one part is in the gripper and out of the structure. Our paths are
proven free between their points; OMPL samples its edges every `step` rad, through a checker in Python.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from motion_reference import Reference, convex
from record import report, write_to
from states import find

from falsework import load_cell, load_structure
from falsework.robots.cells.warm_up import compile_kernels
from falsework.robots.grasping.grasp import grasps
from falsework.robots.kernels.collision import distance_between
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import hull
from falsework.robots.motion.collision_world import CollisionQuery, CollisionWorld, Contact, Scene
from falsework.robots.motion.path_planner import plan_free
from falsework.robots.motion.timing import time_path

Array = np.ndarray


@dataclass(frozen=True)
class Options:
    """Structure, cell and sample sizes."""

    structure: str
    """Name of a real or built-in structure in the cell, or a path."""
    cell: str = "dome-37"
    """Built-in cell or TOML file."""
    checks: int = 200_000
    """Configurations that falsework checks."""
    configurations: int = 5_000
    """Configurations that Coal checks too."""
    pairs: int = 5_000
    """Random pairs of convex pieces for the comparison of distances."""
    plans: int = 200
    """Number of free plans."""
    their_plans: int = 30
    """Number of these that OMPL plans too."""
    step: float = 0.02
    """Resolution of OMPL's edges, rad."""
    seed: int = 0
    """Seed of all random draws."""
    out: Path | None = None
    """File to which the records are appended."""


def main(options: Options) -> None:
    """Print one record per measurement."""
    began = time.perf_counter()
    compile_kernels()
    first = time.perf_counter() - began
    write_to(options.out)
    report("motion first-use", seconds=round(first, 2))
    cell = load_cell(options.cell)
    assembly = load_structure(find(options.structure))
    parts = place_parts(assembly, cell.placement)
    world = CollisionWorld(cell, parts)
    scene = Scene.at_home(cell, parts)
    random = np.random.default_rng(options.seed)
    for record in (
        *distances(random, options.pairs),
        *checks(world.view(scene, 0, margin=0.0), random, options),
        *plans(world.view(scene, 0), random, options, "free"),
        *carried(world, scene, assembly, random, options),
    ):
        what = f"motion {record.pop('what')}"
        report(what, cell=options.cell, structure=assembly.name, **record, seeds=(options.seed,))


def distances(random: np.random.Generator, count: int) -> Iterator[dict[str, Any]]:
    """Compare random pairs of convex pieces: distant, close and overlapping."""
    import coal

    still, missed, worst, touching = coal.Transform3s(), 0, 0.0, 0
    ours = theirs = 0.0
    distance_between(piece(random), piece(random))
    for _ in range(count):
        a, b = piece(random), piece(random)
        one, other = convex(a), convex(b)
        began = time.process_time()
        found = distance_between(a, b)
        ours += time.process_time() - began
        began = time.process_time()
        true = coal.distance(one, still, other, still, coal.DistanceRequest(), coal.DistanceResult())
        theirs += time.process_time() - began
        touching += true <= 0
        missed += true <= 0 < found
        worst = max(worst, found - max(true, 0.0))
    yield {
        "what": "pairs",
        "pairs": count,
        "touching": touching,
        "missed": missed,
        "largest_excess_mm": round(1000 * worst, 7),
        "ours_us": round(1e6 * ours / count, 2),
        "coal_us": round(1e6 * theirs / count, 2),
    }


def checks(view: CollisionQuery, random: np.random.Generator, options: Options) -> Iterator[dict[str, Any]]:
    """Check random configurations of one arm."""
    model = view.model
    values = random.uniform(model.lower, model.upper, (options.checks, model.joints))
    view.collides(values[:100])
    began = time.process_time()
    hits = view.collides(values)
    seconds = time.process_time() - began
    free = values[~hits]
    view.collides(free[:100])
    began = time.process_time()
    view.collides(free)
    free_seconds = time.process_time() - began
    reference = Reference(view)
    some = values[: options.configurations]
    began = time.process_time()
    theirs = np.array([reference.collides(row) for row in some])
    their_seconds = time.process_time() - began
    yield {
        "what": "checks",
        "shapes": len(view.body_names) + len(view.obstacle_names),
        "pairs": reference.pairs,
        "free": round(float((~hits).mean()), 3),
        "ours_per_second": round(options.checks / seconds),
        "ours_free_per_second": round(len(free) / free_seconds),
        "coal_per_second": round(len(some) / their_seconds),
        "compared": len(some),
        "missed": int((theirs & ~hits[: len(some)]).sum()),
        "too_careful": int((~theirs & hits[: len(some)]).sum()),
    }


def plans(view: CollisionQuery, random: np.random.Generator, options: Options, what: str) -> Iterator[dict[str, Any]]:
    """Plan between random free configurations."""
    model = view.model
    low, high = np.maximum(model.lower, -np.pi), np.minimum(model.upper, np.pi)
    values = random.uniform(low, high, (8 * options.plans, model.joints))
    free = values[~view.collides(values)][: 2 * options.plans].reshape(-1, 2, model.joints)
    plan_free(view, free[0, 0], free[0, 1])
    ours, straight, found, timed = [], 0, 0, []
    for seed, (start, goal) in enumerate(free):
        began = time.process_time()
        motion = plan_free(view, start, goal, seed=seed)
        ours.append(time.process_time() - began)
        found += bool(motion)
        straight += motion.path is not None and len(motion.path) == 2
        if motion.path is not None and len(timed) < 30:
            began = time.process_time()
            time_path(model, motion.path)
            timed.append(time.process_time() - began)
    reference = Reference(view)
    reference.keep(view.margin)
    theirs, solved = [], 0
    for start, goal in free[: options.their_plans]:
        began = time.process_time()
        solved += reference.plan(start, goal, low, high, options.step, 5.0) is not None
        theirs.append(time.process_time() - began)
    yield {
        "what": f"plan {what}",
        "plans": len(free),
        "found": found,
        "straight": straight,
        **spread("ours", ours),
        "timing_ms_median": round(1000 * float(np.median(timed)), 2) if timed else None,
        "ompl_plans": len(theirs),
        "ompl_found": solved,
        **(spread("ompl", theirs) if theirs else {}),
    }


def carried(
    world: CollisionWorld, scene: Scene, assembly: Any, random: np.random.Generator, options: Options
) -> Iterator[dict[str, Any]]:
    """Plan with a part in the gripper, the first that can be held in the complete structure."""
    robot, parts = world.cell.robots[0], world.parts
    for part in np.flatnonzero(~parts.boundary).tolist():
        for grasp in grasps(assembly, parts, part, scene.present, robot)[:8]:
            solutions = inverse(robot, grasp.tool)[0]
            view = world.view(scene, 0, contact=Contact(gripper=frozenset({part})), margin=world.cell.margins.line)
            good = solutions[~view.collides(solutions)] if len(solutions) else solutions
            if len(good):
                held = scene.with_attached(0, part, tool_pose(robot, good[0]))
                yield from plans(world.view(held, 0), random, options, "carried")
                return


def piece(random: np.random.Generator) -> Array:
    """Return a convex piece: a lump, a plate or a rod, near the origin."""
    points = random.normal(size=(random.integers(4, 40), 3)) * 10 ** random.uniform(-2, 0, 3)
    return np.array(hull(points + random.normal(size=3) * random.uniform(0, 1.5)))


def spread(name: str, seconds: list[float]) -> dict[str, float]:
    """Return median and tail in milliseconds."""
    median, tail = np.percentile(np.array(seconds) * 1000, [50, 95])
    return {f"{name}_ms_median": round(float(median), 3), f"{name}_ms_95": round(float(tail), 3)}


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

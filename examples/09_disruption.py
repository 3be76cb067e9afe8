"""A disruption from start to end: two arms build a bottle, its three lowest parts are late, they build it another way.

The paper's physical experiment. Takes bottle-12 where the published structures are found (in the folder that the
environment variable FALSEWORK_DATA names, else `shared` beside the repository), else the built-in bottle.

Run: python examples/09_disruption.py
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

import falsework as fw
from falsework import Assembly, StabilityOracle, check, load_cell, load_structure, make_task, plan_robots
from falsework.replanning import difference
from falsework.robots import Cell, KeyframeGraph, Placement, RobotPlan, export_plan


def bottle_and_cell() -> tuple[Assembly, Cell]:
    """A bottle of eleven parts at a fifth of its size, between two GoFa arms."""
    cell = load_cell("bottle-12")
    data = Path(os.environ.get("FALSEWORK_DATA", Path(__file__).resolve().parents[2] / "shared"))
    published = data / "assemblies" / "bottle-12"
    if published.is_dir():
        return load_structure(str(published)), cell
    return load_structure("bottle"), replace(cell, placement=Placement(scale=0.2, density=400.0))


def report(name: str, plan: RobotPlan, bottle: Assembly, cell: Cell) -> None:
    """Print the order, and check every motion by other libraries."""
    checked = check(bottle, plan, cell)
    order = " ".join(bottle.names[part] for part in plan.plan.inserted_parts)
    print(f"{name}: {plan.seconds:.0f} s of motion, found in {plan.statistics['seconds']:.1f} s; parts in: {order}")
    print(f"  checked in {checked.samples} configurations: {'good' if checked.good else 'not good'}")
    assert checked.good


def main() -> None:
    """Plan, lose three parts, plan again, compare, export."""
    bottle, cell = bottle_and_cell()
    oracle, graph = StabilityOracle(bottle), KeyframeGraph(bottle, cell)

    first = plan_robots(bottle, cell, oracle=oracle, graph=graph)
    building = first.unwrap()
    report("as planned", building, bottle, cell)

    free = np.flatnonzero(~bottle.boundary)
    late = free[np.argsort(bottle.mass.center[free, 2], kind="stable")[:3]].tolist()
    print(f"late: {', '.join(bottle.names[part] for part in late)}")
    task = make_task(bottle, cell.robot_count, missing=late)
    second = plan_robots(bottle, cell, task=task, oracle=oracle, graph=graph)
    other = second.unwrap()
    report("without them for as long as possible", other, bottle, cell)
    for need in other.plan.needs:
        print(f"  {bottle.names[need.part]} is needed after {need.after_parts} other parts are placed")

    changed = difference(building.plan, other.plan)
    print(f"{changed.common_steps} of {len(building)} steps are the same; {len(changed.moved)} parts move in the order")
    again = second.statistics["free_motions_used_again"]
    print(f"{again} free motions were known from the first plan")

    fw.save(other, "robot_plan.json")
    files = export_plan(other, "motions", "ros2-json", cell=cell)
    print(f"robot_plan.json, and {len(files)} files for ROS 2 in motions")


if __name__ == "__main__":
    main()

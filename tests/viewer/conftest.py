"""A small arch with a plan, for all tests of what people look at."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Direction, Plan, find_plans, load_structure, make_task
from falsework.robots import (
    Cell,
    CellRobot,
    Gripper,
    Keyframe,
    Placement,
    Precedence,
    RobotPlan,
    RobotStep,
    Trajectory,
    nodes_of,
)
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.shapes import block, pose
from falsework.robots.plans.robot_plan import records_of
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.viewer import Timeline

CHROMIUM_FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--hide-scrollbars"]
# Without a graphics card the processor draws all but the scene sooner by itself than as one.
CHROMIUM_FLAGS += ["--disable-gpu-rasterization", "--disable-gpu-compositing", "--webgl-antialiasing-mode=none"]


def chromium() -> str:
    """Path of a Chromium that is installed, or skip."""
    named = os.environ.get("FALSEWORK_CHROMIUM")
    found = named or shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not found or not Path(found).exists():
        pytest.skip("no Chromium here: install it (Debian: apt install chromium) or name it in FALSEWORK_CHROMIUM")
    return found


@cache
def planned(spec: str, robots: int = 2, *, ground: bool = False) -> tuple[Assembly, Plan]:
    """A built-in structure and a plan of it."""
    assembly = load_structure(spec, ground=ground)
    return assembly, find_plans(assembly, make_task(assembly, robots)).plans[0]


@pytest.fixture(scope="session")
def arch() -> tuple[Assembly, Plan]:
    """An arch of five voussoirs and a plan with two robots."""
    return planned("arch:blocks=5")


@pytest.fixture
def timeline(arch: tuple[Assembly, Plan]) -> Timeline:
    """The plan of the arch."""
    assembly, plan = arch
    return Timeline.from_plan(plan, assembly)


def trajectory(start: np.ndarray, end: np.ndarray, part: int | None = None) -> Trajectory:
    still = np.zeros_like(start)
    return Trajectory("free", np.array([0.0, 2.0]), np.stack([start, end]), np.stack([still, still]), part)


@pytest.fixture
def cell() -> Cell:
    """Two arms on either side of a structure that is built at a quarter of its size, turned and moved."""
    tool = np.eye(4)
    tool[2, 3] = 0.1
    gripper = Gripper("cup", "suction", (block((-0.02, -0.02, 0.0), (0.02, 0.02, 0.1)),), tool, 5.0)
    model = builtin_robot("ur10e")
    robots = tuple(
        CellRobot(f"arm {k}", model, pose((0.9 * side, 0, 0), 0.3 * side), gripper, model.home, np.eye(4)[None])
        for k, side in enumerate((-1, 1))
    )
    return Cell("test", robots, placement=Placement((0.1, 0.2, 0.3), 0.7, 0.25))


@pytest.fixture
def robot_plan(arch: tuple[Assembly, Plan], cell: Cell) -> RobotPlan:
    """Motions of a disassembly that join, with no claim to avoid anything."""
    _, plan = arch
    rng = np.random.default_rng(0)
    who, route = plan.holders[::-1], plan.route
    home = [robot.home for robot in cell.robots]
    frames, steps = [], []
    now = list(home)
    for state in range(len(plan) + 1):
        held = tuple(next((int(part) for part in np.flatnonzero(who[state] == robot)), None) for robot in range(2))
        frames.append(Keyframe(tuple(now), held))
        if state == len(plan):
            break
        action = int(route.actions[state])
        part, removes = action % len(plan.boundary), action >= len(plan.boundary)
        robot = int(who[state if removes else state + 1, part])
        middle, end = (home[robot] + rng.normal(scale=0.3, size=len(home[robot])) for _ in range(2))
        parts = (part, None) if removes else (None, None)
        motions = (trajectory(now[robot], middle, parts[0]), trajectory(middle, end, parts[1]))
        steps.append(RobotStep(robot, motions))
        now[robot] = end
    made = RobotPlan(plan, tuple(frames), tuple(steps), records_of(cell), cell.name, cell_identity(cell))
    return replace(made, direction=Direction.DISASSEMBLY)


@pytest.fixture
def scheduled(robot_plan: RobotPlan) -> RobotPlan:
    """The same motions, each as soon as its arm is free and the structure has come to the state before."""
    nodes, events = nodes_of(robot_plan)
    edges = [
        Precedence(before, nodes[before].seconds, after, "arm")
        for robot in range(2)
        for before, after in pairwise(k for k, node in enumerate(nodes) if node.robot == robot)
    ]
    edges += [Precedence(before.node, 0.0, after.node, "state") for before, after in pairwise(events)]
    return replace(robot_plan, schedule=TemporalPlanGraph(nodes, tuple(edges), 2, 0.0))


@pytest.fixture(scope="session")
def policy(arch: tuple[Assembly, Plan]) -> Any:
    """An untrained policy for the arch, the same every time."""
    pytest.importorskip("torch", reason="policies need torch; pip install 'falsework[learn]'")
    from falsework.learn import PolicySettings, make_policy

    return make_policy(arch[0], PolicySettings(), "cpu", seed=0)


def down(assembly: Assembly, part: int) -> tuple[np.ndarray, np.ndarray]:
    """A ray from above through the middle of a part."""
    return assembly.mass.center[part] + [0.0, 0.0, 10.0], np.array([0.0, 0.0, -1.0])

"""Arms, cells and an independent collision library for the tests of robots."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework.robots import Cell, CellRobot, Gripper, Obstacle
from falsework.robots.cells.validate import no_parts
from falsework.robots.cells.warm_up import compile_kernels
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.robots.model.shapes import block, cylinder, pose
from falsework.robots.motion.collision_world import CollisionQuery, CollisionWorld, Contact, Scene


@pytest.fixture(scope="session", autouse=True)
def compiled() -> None:
    """Compiling is nobody's test time."""
    compile_kernels()


@pytest.fixture(scope="session")
def robot_file() -> Callable[[str], Path]:
    """Look up the URDF of a real arm by folder name; skips the test where the data is not there."""
    named = os.environ.get("FALSEWORK_DATA")
    folder = (Path(named) if named else Path(__file__).resolve().parents[3] / "shared") / "robots"

    def find(name: str) -> Path:
        path = folder / name / f"{name}.urdf"
        if not path.is_file():
            pytest.skip(f"no robot {name} in {folder}: set FALSEWORK_DATA to the folder that holds robots/")
        return path

    return find


@pytest.fixture(scope="session")
def cup() -> Gripper:
    """A suction gripper 18 cm long."""
    pieces = (cylinder(0.045, 0.0, 0.1), cylinder(0.02, 0.1, 0.178))
    return Gripper("cup", "suction", pieces, np.array(pose((0, 0, 0.18))), payload=10.0, mass=1.0, cup=0.02)


@pytest.fixture(scope="session")
def make_view(cup: Gripper) -> Callable[..., CollisionQuery]:
    """One built-in arm at the origin among obstacles."""

    def make(
        *pieces: np.ndarray, robot: str = "irb2600-12/1.65", margin: float = 0.005, floor: float | None = None
    ) -> CollisionQuery:
        model = builtin_robot(robot)
        entry = CellRobot("arm", model, np.eye(4), cup, model.home, np.zeros((0, 4, 4)))
        obstacles = tuple(Obstacle(f"block {k}", (piece,)) for k, piece in enumerate(pieces))
        cell = Cell("test", (entry,), obstacles, floor=floor)
        parts = no_parts()
        return CollisionWorld(cell, parts).view(Scene.at_home(cell, parts), 0, contact=Contact(), margin=margin)

    return make


@pytest.fixture(scope="session")
def coal_distance() -> Callable[[np.ndarray, np.ndarray], float]:
    """Distance of two convex pieces by Coal, which shares no code with ours; negative where they overlap."""
    coal: Any = pytest.importorskip("coal")

    def convex(points: np.ndarray) -> Any:
        vertices = coal.StdVec_Vec3s()
        for point in points:
            vertices.append(np.asarray(point, float))
        return coal.Convex.convexHull(vertices, True, None)

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        result = coal.DistanceResult()
        still = coal.Transform3s()
        return coal.distance(convex(a), still, convex(b), still, coal.DistanceRequest(), result)

    return distance


@pytest.fixture(scope="session")
def wall() -> np.ndarray:
    """A sheet 2 mm thick in front of the robot, with room above."""
    return block((0.9, -1.0, 0.0), (0.902, 1.0, 1.2))

"""Calls of all kernels of motion planning on a small cell, so that they are compiled before time is measured."""

from __future__ import annotations

import numpy as np

from falsework.robots.cells.validate import no_parts
from falsework.robots.kernels import coordination, rrt_connect, speed_profile
from falsework.robots.kernels.collision import distance_between
from falsework.robots.kinematics.forward import link_poses
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.robots.model.cell import Cell, CellRobot, Gripper
from falsework.robots.model.shapes import block
from falsework.robots.motion.collision_world import CollisionWorld, Scene
from falsework.robots.motion.path_planner import follow_line
from falsework.robots.motion.timing import time_path


def compile_kernels() -> None:
    """Load or compile the kernels of collision checks, motion planning, timing and kinematics."""
    model = builtin_robot("irb2600-12/1.65")
    fingers = block((-0.01, -0.01, 0), (0.01, 0.01, 0.02))
    gripper = Gripper("none", "suction", (fingers,), np.eye(4), 1.0)
    cell = Cell("compile", (CellRobot("arm", model, np.eye(4), gripper, model.home, np.zeros((0, 4, 4))),))
    parts = no_parts()
    view = CollisionWorld(cell, parts).view(Scene.at_home(cell, parts), 0)
    distance_between(fingers, fingers)
    link_poses(model, model.home)
    follow_line(view, model.home, (0.0, 0.0, 1.0), 0.01)
    trees = np.stack([model.home, model.home + 0.01])[:, None].repeat(3, axis=1)
    rrt_connect.grow(
        *(trees, np.full((2, 3), -1, np.int64), np.array([1, 1, 0]), model.home, model.home, 1.0, 0, view.resolution),
        *(np.zeros(1, np.uint64), view.arrays, np.zeros(2, np.int64)),
    )
    rrt_connect.shorten(trees[0].copy(), 3, 0, view.resolution, np.zeros(1, np.uint64), view.arrays)
    timed = time_path(model, np.stack([model.home, model.home + 0.01]))
    kept = np.empty(len(timed.times), np.int64)
    speed_profile.thin(timed.times, timed.positions, timed.velocities, model.acceleration * 1.0, 0.0, kept)
    swept = coordination.sweep(model.home[None], np.zeros((1, model.joints)), view.arrays.chain, view.arrays.bodies)
    coordination.conflicts((swept, swept), (swept, swept), 0.0)

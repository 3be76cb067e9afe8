"""Warm-up of the numba cache of the motion kernels, with a progress message."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from falsework.robots.kernels import coordination, numeric_ik, rrt_connect, speed_profile
from falsework.robots.kinematics import forward

MESSAGE = "compiling the motion code; this happens once and takes up to 15 seconds"


def is_compiled() -> bool:
    """Return whether numba has cached code of all entry points that matches their sources."""
    functions: tuple[Any, ...] = (
        rrt_connect._run,
        forward.place_many,
        numeric_ik.reach_poses,
        coordination._place,
        coordination._conflicts,
        coordination._first_clear,
        speed_profile.fastest,
        speed_profile.evaluate,
        speed_profile.thin,
    )
    for function in functions:
        if function.signatures:
            continue
        cache = Path(str(function.stats.cache_path))
        source = Path(function.py_func.__code__.co_filename)
        name = function.py_func.__name__
        found = list(cache.glob(f"{source.stem}.{name}-*.nbi"))
        if not any(entry.stat().st_mtime >= source.stat().st_mtime for entry in found):
            return False
    return True


def compile_kernels(report: Callable[[str], None] | None = None) -> float:
    """Ensure that collision checks, planning and kinematics are compiled.

    Args:
        report: called with one line if anything has to be compiled.

    Returns:
        Duration in seconds.
    """
    began = time.perf_counter()
    if report is not None and not is_compiled():
        report(MESSAGE)
    from falsework.robots.cells.validate import no_parts
    from falsework.robots.model.builtin_robots import builtin_robot
    from falsework.robots.model.cell import Cell, CellRobot, Gripper
    from falsework.robots.model.shapes import block
    from falsework.robots.motion.collision_world import CollisionWorld, Scene
    from falsework.robots.motion.path_planner import follow_line
    from falsework.robots.motion.timing import time_path

    model = builtin_robot("irb2600-12/1.65")
    gripper = Gripper("none", "suction", (block((-0.01, -0.01, 0), (0.01, 0.01, 0.02)),), np.eye(4), 1.0)
    cell = Cell("compile", (CellRobot("arm", model, np.eye(4), gripper, model.home, np.zeros((0, 4, 4))),))
    parts = no_parts()
    view = CollisionWorld(cell, parts).view(Scene.at_home(cell, parts), 0)
    follow_line(view, model.home, (0.0, 0.0, 1.0), 0.01)
    timed = time_path(model, np.stack([model.home, model.home + 0.01]))
    kept = np.empty(len(timed.times), np.int64)
    speed_profile.thin(timed.times, timed.positions, timed.velocities, model.acceleration * 1.0, 0.0, kept)
    swept = coordination.sweep(model.home[None], np.zeros((1, model.joints)), view.chain, view.bodies)
    coordination.conflicts((swept, swept), (swept, swept), 0.0)
    coordination.first_clear(swept, swept, 0.0)
    return time.perf_counter() - began

"""Plan view of a cell, coloured by reachability."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from falsework.errors import DependencyError, InputError
from falsework.robots.grasping.reachability import Reachability, ReachTable
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import move


def check_picture(path: Path) -> None:
    """Raise DependencyError or InputError, before any work, unless a picture can be written."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise DependencyError("--picture needs matplotlib: pip install 'falsework[picture]'") from error
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"--picture {path}: give a file that ends in .png, .svg or .pdf")
    if not path.resolve().parent.is_dir():
        raise InputError(f"--picture {path}: there is no folder {path.parent}; make it first")


def draw_reach(cell: Cell, parts: PartShapes, table: ReachTable, path: Path) -> None:
    """Draw parts from above, coloured by the number of robots that reach them, and the circle of each robot's reach."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    counts = dict(zip(table.parts.tolist(), (table.levels == Reachability.REACHED).sum(axis=1).tolist(), strict=True))
    robots = cell.robot_count
    shades = [(0.93 - 0.55 * k / robots, 0.93 - 0.25 * k / robots, 0.90) for k in range(1, robots + 1)]
    colours = [(0.80, 0.24, 0.20), *shades]
    order = np.argsort([float(mesh.vertices[:, 2].max()) for mesh in parts.meshes], kind="stable")
    for part in order.tolist():
        colour: Any = colours[counts[part]] if part in counts else (0.85, 0.85, 0.85)
        for piece in parts.pieces[part]:
            flat = piece[:, :2]
            axes.fill(*flat[ConvexHull(flat).vertices].T, facecolor=colour, edgecolor=(0.35, 0.35, 0.4), linewidth=0.4)
    for obstacle in cell.obstacles:
        for piece in obstacle.pieces:
            axes.fill(*piece[ConvexHull(piece[:, :2]).vertices, :2].T, facecolor="none", edgecolor="0.3", hatch="///")
    for robot in cell.robots:
        for piece in robot.model.pieces[0]:
            flat = move(robot.base, piece)[:, :2]
            axes.fill(*flat[ConvexHull(flat).vertices].T, facecolor=(0.25, 0.27, 0.32), zorder=3)
        x, y = robot.base[:2, 3]
        turn = np.linspace(0, 2 * np.pi, 120)
        distance = robot.model.reach
        axes.plot(x + distance * np.cos(turn), y + distance * np.sin(turn), color="0.6", linewidth=0.8, linestyle="--")
        axes.annotate(robot.name, (x, y), (0, -30), textcoords="offset points", ha="center", va="top", fontsize=8)
        if len(robot.places):
            axes.scatter(robot.places[:, 0, 3], robot.places[:, 1, 3], marker="+", color="0.3", s=30)
    for count, colour in enumerate(colours):
        if count in counts.values():
            label = "out of reach" if count == 0 else f"reached by {count} of {robots}"
            axes.fill([], [], facecolor=colour, edgecolor="0.4", label=label)
    axes.fill([], [], facecolor=(0.85, 0.85, 0.85), edgecolor="0.4", label="boundary")
    axes.legend(loc="upper right", fontsize=8)
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_title(f"{cell.name}, from above")
    figure.savefig(path)

"""Reachability of parts by the robots of a cell, its picture from above, and proposals of better robot bases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.geometry.arrays import apply
from falsework.robots.cells.validate import overlap, shrunk
from falsework.robots.grasping.grasp import grasps
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import Array, pose
from falsework.robots.motion.collision_world import CollisionWorld, Scene, grasp_contact
from falsework.utils.display.fonts import fitting_fonts
from falsework.utils.lazy import importing

GRASPS_PER_PART = 24
"""Grasps of a part that are tried."""
_FEW = 4
"""Grasps of a part, of different faces and rotations, that are tried from each of many bases."""
BASE_ANGLES, BASE_DISTANCES = 24, (0.55, 0.65, 0.75, 0.85)
"""Candidate base positions around the structure: directions, and distances as shares of the arm's reach."""
BASE_SPACING = 0.7
"""Least distance between two bases, as a share of the arm's reach."""
PLACEMENT_SWEEPS = 2
"""Rounds in which each base is moved in turn with the others fixed."""


class Reachability(IntEnum):
    """Reachability of a part by a robot, from out of reach to a collision-free grasp."""

    TOO_HEAVY = 0
    NO_GRASP = 1
    OUT_OF_REACH = 2
    IN_THE_WAY = 3
    REACHED = 4

    @property
    def words(self) -> str:
        """Description for tables."""
        return ("too heavy", "no grasp", "out of reach", "in collision", "yes")[self.value]


@dataclass(frozen=True, eq=False)
class ReachTable:
    """Reachability of every part that is not boundary by every robot."""

    parts: NDArray[np.int64]
    """Part indices, shape (parts,)."""
    robots: tuple[str, ...]
    levels: NDArray[np.int8]
    """`Reachability` of each robot for each part, shape (parts, robots)."""
    pairs: dict[tuple[int, int], tuple[str, str]]
    """Names of the colliding bodies by (part id, robot)."""

    @property
    def unreached(self) -> list[int]:
        """Parts that no robot can hold."""
        return self.parts[(self.levels != Reachability.REACHED).all(axis=1)].tolist()


@dataclass(frozen=True, eq=False)
class BaseProposal:
    """Bases from which robots reach more parts."""

    cell: Cell
    """The same cell with other bases."""
    before: int
    """Pairs of robot and part within reach with the present bases."""
    after: int
    pairs: int
    """Number of all pairs."""


def reach_table(
    assembly: Assembly, cell: Cell, parts: PartShapes, report: Callable[[int, int], None] = lambda done, total: None
) -> ReachTable:
    """Test whether each robot can hold each part, alone with the boundary and with the other robots at home.

    Args:
        parts: the structure in the cell, as `place_parts` returns it.
        report: callback `(done, total)` with numbers of parts.
    """
    world = CollisionWorld(cell, parts)
    ids = np.flatnonzero(~parts.boundary)
    levels = np.zeros((len(ids), cell.robot_count), np.int8)
    pairs: dict[tuple[int, int], tuple[str, str]] = {}
    for row, part in enumerate(ids.tolist()):
        alone = _alone(parts, part)
        scene = Scene(cell.homes, alone, (None,) * cell.robot_count)
        for robot, entry in enumerate(cell.robots):
            if parts.mass[part] > entry.payload:
                continue
            found = grasps(assembly, parts, part, alone, entry, limit=GRASPS_PER_PART)
            levels[row, robot] = Reachability.NO_GRASP
            if not found:
                continue
            solutions = np.concatenate(inverse(entry, np.array([grasp.tool for grasp in found])))
            levels[row, robot] = Reachability.OUT_OF_REACH
            if not len(solutions):
                continue
            view = world.view(scene, robot, contact=grasp_contact(part), margin=cell.margins.line)
            hits = view.hits(solutions)
            levels[row, robot] = Reachability.REACHED if (hits < 0).any() else Reachability.IN_THE_WAY
            if (hits >= 0).all():
                pairs[part, robot] = view.pair(int(hits[0]))
        report(row + 1, len(ids))
    return ReachTable(ids, tuple(robot.name for robot in cell.robots), levels, pairs)


def propose_bases(
    assembly: Assembly, cell: Cell, parts: PartShapes, report: Callable[[int, int], None] = lambda done, total: None
) -> BaseProposal:
    """Search for bases with more parts within reach, by kinematics alone.

    One robot after the other is tried on rings around the structure, facing its centre, with the others fixed. Bases
    that are not upright, such as on a wall or a ceiling, stay where they are.
    Check the result with `reach_table`, which includes collisions.

    Args:
        cell: its robots, whose bases the search begins from.
        parts: shapes of the parts in the cell.
        report: called with the number of bases tried and of all.
    """
    ids = np.flatnonzero(~parts.boundary).tolist()
    held = [
        [grasps(assembly, parts, part, _alone(parts, part), robot, limit=_FEW) for part in ids] for robot in cell.robots
    ]
    middle = parts.center[ids].mean(axis=0)
    stands = [p for o in cell.obstacles for p in o.pieces] + [p for pieces in parts.pieces for p in pieces]
    bases = [robot.base for robot in cell.robots]

    def count(robot: int, base: Array) -> NDArray[np.bool_]:
        entry = replace(cell.robots[robot], base=base)
        tools = [grasp.tool for of_part in held[robot] for grasp in of_part]
        if not tools:
            return np.zeros(len(ids), bool)
        solved = [len(solutions) > 0 for solutions in inverse(entry, np.array(tools))]
        owner = np.repeat(np.arange(len(ids)), [len(of_part) for of_part in held[robot]])
        return np.bincount(owner[solved], minlength=len(ids)) > 0

    reached = [count(robot, base) for robot, base in enumerate(bases)]
    before = int(sum(row.sum() for row in reached))
    upright = [k for k, robot in enumerate(cell.robots) if robot.is_upright]
    total = PLACEMENT_SWEEPS * len(upright) * BASE_ANGLES * len(BASE_DISTANCES)
    done = 0
    for _ in range(PLACEMENT_SWEEPS):
        for robot in upright:
            entry, others = cell.robots[robot], [base for k, base in enumerate(bases) if k != robot]
            best = _score(reached)
            for share in BASE_DISTANCES:
                for turn in range(BASE_ANGLES):
                    done += 1
                    report(done, total)
                    # On a ring around the centre, facing it, at its present height.
                    distance, angle = share * entry.model.reach, 2 * np.pi * turn / BASE_ANGLES
                    x, y = middle[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
                    base = pose((x, y, entry.base[2, 3]), angle + np.pi)
                    if _stands_free(cell, robot, base, others, stands):
                        rows = [*reached[:robot], count(robot, base), *reached[robot + 1 :]]
                        if _score(rows) > best:
                            best, reached, bases[robot] = _score(rows), rows, base
    robots = tuple(
        replace(robot, base=base, places=base @ np.linalg.inv(robot.base) @ robot.places)
        for robot, base in zip(cell.robots, bases, strict=True)
    )
    after = int(sum(row.sum() for row in reached))
    return BaseProposal(replace(cell, robots=robots), before, after, len(ids) * cell.robot_count)


def _alone(parts: PartShapes, part: int) -> NDArray[np.bool_]:
    """Return which parts are present where one is alone with the boundary, shape (parts,)."""
    alone = parts.boundary.copy()
    alone[part] = True
    return alone


def _score(reached: list[NDArray[np.bool_]]) -> tuple[int, int]:
    """Return the number of parts within reach of any robot, then the number of pairs."""
    return int(np.any(reached, axis=0).sum()), int(np.sum(reached))


def _stands_free(cell: Cell, robot: int, base: Array, others: list[Array], stands: list[Array]) -> bool:
    """Return whether a base is clear of parts and obstacles, and far enough from other bases for two arms to work."""
    apart = BASE_SPACING * cell.robots[robot].model.reach
    if any(np.linalg.norm(other[:2, 3] - base[:2, 3]) < apart for other in others):
        return False
    own = shrunk(tuple(apply(base, piece) for piece in cell.robots[robot].model.pieces[0]))
    return not any(overlap(a, b) for a in own for b in stands)


def check_picture(path: Path) -> None:
    """Raise DependencyError or InputError, before any work, unless a picture can be written."""
    with importing("--picture needs matplotlib: pip install 'falsework[picture]'"):
        import matplotlib  # noqa: F401
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
            flat = apply(robot.base, piece)[:, :2]
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
    with fitting_fonts(figure):
        figure.savefig(path)

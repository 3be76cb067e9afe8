"""Appearance of a cell at any configurations of its arms: bodies with colours, near pairs, and reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.geometry.arrays import apply, box_around
from falsework.robots.cells.cell_file import builtin_cells, load_faulty_cell
from falsework.robots.cells.urdf_meshes import hull_mesh
from falsework.robots.cells.validate import check_cell, no_parts
from falsework.robots.cells.visuals import arm_frames
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes, place_parts
from falsework.robots.motion.collision_world import CollisionWorld, Scene
from falsework.robots.motion.near_pairs import NearPair, near_pairs_of
from falsework.viewer.arms import Link, links_of
from falsework.viewer.palette import BOUNDARY, INSTALLED, MISSING, SELECTED, unit_rgb
from falsework.viewer.pictures.render import ColoredSolid

Array = NDArray[np.float64]

COLLIDES, NEAR, OBSTACLE = MISSING, SELECTED, "#8f9aa6"
"""Colours of bodies that touch, of those that are too near, and of obstacles."""
_REACH_SAMPLES = 2000
"""Random configurations from which the reach of an arm is taken."""


@dataclass(frozen=True, eq=False)
class FixedBody:
    """Body of a cell that does not move."""

    name: str
    """As in `NearPair`."""
    vertices: Array
    faces: NDArray[np.integer]
    color: str


@dataclass(frozen=True, eq=False)
class Reach:
    """Ball that the tool of an arm does not leave."""

    center: Array
    """On the axis of the first joint, metres, shape (3,)."""
    radius: float


@dataclass(frozen=True, eq=False)
class CellModel:
    """Cell, as far as it can be read, with what is wrong with it."""

    name: str
    """Cell as it was named."""
    cell: Cell | None
    """None: nothing of it can be read."""
    faults: tuple[str, ...] = ()
    """What is wrong with it, each in one line."""
    assembly: Assembly | None = None
    """Structure in it."""
    parts: PartShapes = field(default_factory=no_parts)
    """Parts of the structure in it."""

    @cached_property
    def links(self) -> list[Link]:
        """Pieces of all robots."""
        robots = () if self.cell is None else self.cell.robots
        return [link for number, robot in enumerate(robots) for link in links_of(number, robot)]

    @cached_property
    def bodies(self) -> list[FixedBody]:
        """Obstacles and parts."""
        found = []
        for obstacle in () if self.cell is None else self.cell.obstacles:
            for piece in obstacle.pieces:
                mesh = hull_mesh(np.asarray(piece))
                found.append(FixedBody(obstacle.name, mesh.vertices, mesh.faces, OBSTACLE))
        for name, mesh, fixed in zip(self.parts.names, self.parts.meshes, self.parts.boundary, strict=True):
            found.append(FixedBody(f"part {name}", mesh.vertices, mesh.faces, BOUNDARY if fixed else INSTALLED))
        return found

    @cached_property
    def reaches(self) -> list[Reach]:
        """Reach of the tool of each arm."""
        found, rng = [], np.random.default_rng(0)
        for robot in () if self.cell is None else self.cell.robots:
            model = robot.model
            axis = robot.base @ model.origins[0]
            second = axis @ model.origins[1] if model.joints > 1 else axis
            along = axis[:3, :3] @ model.axes[0]
            center = axis[:3, 3] + along * ((second[:3, 3] - axis[:3, 3]) @ along)
            tools = tool_pose(robot, rng.uniform(model.lower, model.upper, (_REACH_SAMPLES, model.joints)))
            found.append(Reach(center, float(np.linalg.norm(tools[:, :3, 3] - center, axis=1).max())))
        return found

    @cached_property
    def box(self) -> Array:
        """Bounds of everything with the arms at home, shape (2, 3)."""
        points = [body.vertices for body in self.bodies]
        if self.cell is not None:
            points += [apply(at, link.vertices) for link, at in self._placed(self.cell.homes)]
            points += [robot.places[:, :3, 3] for robot in self.cell.robots if len(robot.places)]
        return box_around(np.concatenate(points)) if points else np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])

    def frames(self, configurations: Sequence[Array]) -> list[Array]:
        """Return for each robot the poses of its links and its flange, shape (joints + 2, 4, 4)."""
        assert self.cell is not None
        return [arm_frames(robot, values) for robot, values in zip(self.cell.robots, configurations, strict=True)]

    def pairs(self, configurations: Sequence[Array]) -> list[NearPair]:
        """Return the bodies that are too near each other, the deepest overlap first."""
        assert self.cell is not None
        scene = Scene.at_home(self.cell, self.parts)
        for robot, values in enumerate(configurations):
            scene = scene.with_configuration(robot, values)
        return near_pairs_of(self._world, scene)

    def link_name(self, link: Link) -> str:
        """Return the name of a piece of a robot, as in `NearPair`."""
        assert self.cell is not None
        robot = self.cell.robots[link.robot]
        gripper = link.frame > robot.model.joints
        return f"{robot.name} {'gripper' if gripper else robot.model.link_names[link.frame]}"

    def solids(self, configurations: Sequence[Array], pairs: Sequence[NearPair]) -> list[ColoredSolid]:
        """Return everything as meshes, near pairs in their colours."""
        marks = marks_of(pairs)
        found = [
            ColoredSolid(body.vertices, body.faces, unit_rgb(marks.get(body.name, body.color))) for body in self.bodies
        ]
        for link, at in self._placed(configurations):
            mark = marks.get(self.link_name(link))
            color = link.color if mark is None else unit_rgb(mark)
            found.append(ColoredSolid(apply(at, link.vertices), link.faces, color))
        return found

    def _placed(self, configurations: Sequence[Array]) -> list[tuple[Link, Array]]:
        frames = self.frames(configurations)
        return [(link, frames[link.robot][link.frame]) for link in self.links]

    @cached_property
    def _world(self) -> CollisionWorld:
        assert self.cell is not None
        return CollisionWorld(self.cell, self.parts)


def marks_of(pairs: Sequence[NearPair]) -> dict[str, str]:
    """Return the colours of bodies that are too near another one, by name."""
    near = {name: NEAR for pair in pairs for name in (pair.first, pair.second)}
    return near | {name: COLLIDES for pair in pairs if pair.collides for name in (pair.first, pair.second)}


def is_cell(subject: object) -> bool:
    """Return whether a subject of a page or picture is a cell: a value, a TOML file, or the name of a built-in one."""
    if isinstance(subject, Cell):
        return True
    if not isinstance(subject, (str, Path)):
        return False
    path = Path(subject)
    return path.suffix.lower() == ".toml" or (not path.exists() and str(subject) in builtin_cells())


def build_cell_model(subject: Cell | str | Path, structure: AnyStructure | None = None, **options: object) -> CellModel:
    """Return a cell as it is, with its faults; they do not raise.

    Args:
        structure: structure in it; without it only the cell is shown.
    """
    faults: list[str] = []
    if isinstance(subject, Cell):
        cell: Cell | None = subject
        name = subject.name
        faults += _faults(subject, no_parts())
    else:
        name = str(subject)
        if Path(name).suffix.lower() == ".toml" and not Path(name).is_file():
            raise InputError(f"there is no cell file {name}; `falsework cell new` writes one")
        cell, faults = load_faulty_cell(name)
    if structure is None or cell is None:
        return CellModel(name, cell, tuple(faults))
    assembly = as_assembly(structure, **options)  # type: ignore[arg-type]
    parts = place_parts(assembly, cell.placement)
    if not faults:
        faults += _faults(cell, parts)
    return CellModel(name, cell, tuple(faults), assembly, parts)


def _faults(cell: Cell, parts: PartShapes) -> list[str]:
    try:
        check_cell(cell, parts)
    except InputError as error:
        return [str(error)]
    return []

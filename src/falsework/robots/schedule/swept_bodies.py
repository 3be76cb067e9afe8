"""Swept bodies of the arms of a cell, in motions and at rest, with what they carry, and of parts in place."""

from __future__ import annotations

import numpy as np

from falsework.robots.kernels.coordination import SPLIT, Swept, still, sweep
from falsework.robots.model.shapes import Array, move_pieces
from falsework.robots.motion.collision_world import Attached, CollisionWorld
from falsework.robots.plans.loads import Load
from falsework.robots.plans.trajectory import Trajectory

CELL = 0.05
"""Longest duration of a cell, seconds."""


class SweptBodies:
    """Swept bodies in one collision world, with the kinematics and bodies that they need."""

    def __init__(self, world: CollisionWorld) -> None:
        self.world = world

    def moving(self, robot: int, trajectory: Trajectory, load: Load | None) -> tuple[tuple[Swept, Swept], Array]:
        """Return the bodies of a motion in cells and in finer cells, and the seconds at which each cell ends."""
        count = max(int(np.ceil(trajectory.seconds / CELL)), 1)
        coarse = self._swept(robot, *reach_of(trajectory, count), load)
        fine = self._swept(robot, *reach_of(trajectory, SPLIT * count), load)
        return (coarse, fine), trajectory.seconds * np.arange(1, count + 1) / count

    def resting(self, robot: int, values: Array, load: Load | None) -> Swept:
        """Return the bodies of an arm at rest, a cell for each configuration, (joints,) or (cells, joints)."""
        cells = np.atleast_2d(np.asarray(values, dtype=np.float64))
        return self._swept(robot, cells, np.zeros_like(cells), load)

    def along(self, robot: int, path: Array, load: Load | None, pieces: int) -> tuple[Swept, Swept]:
        """Return the bodies along a path, shape (points, joints), each edge in some pieces, and in finer ones."""
        coarse, fine = (self._swept(robot, *_pieces_of(path, count), load) for count in (pieces, SPLIT * pieces))
        return coarse, fine

    def standing(self, part: int, pose: Array | None = None) -> Swept:
        """Return the body of a part in place, or displaced by a pose, shape (4, 4)."""
        pieces = self.world.parts.pieces[part]
        return still(pieces if pose is None else move_pieces(pose, pieces))

    def _swept(self, robot: int, values: Array, spread: Array, load: Load | None) -> Swept:
        held = None
        if load is not None and load.grip is not None:
            held = Attached(load.part, load.in_tool(self.world.cell.robots[robot]))
        made = sweep(values, spread, self.world.chains[robot], self.world.bodies(robot, held)[0])
        if load is None or not load.lies:
            return made
        return _beside(made, still(move_pieces(load.pose, self.world.parts.pieces[load.part])))


def _beside(moving: Swept, lying: Swept) -> Swept:
    """Return moving bodies together with fixed ones."""
    cells = len(moving.low)
    return Swept(
        np.concatenate([moving.start, moving.start[-1] + lying.start[1:]]),
        np.concatenate([moving.vertices, np.repeat(lying.vertices, cells, axis=0)], axis=1),
        np.concatenate([moving.center, np.repeat(lying.center, cells, axis=0)], axis=1),
        np.concatenate([moving.radius, lying.radius]),
        np.concatenate([moving.swept, np.repeat(lying.swept, cells, axis=0)], axis=1),
        np.minimum(moving.low, lying.low),
        np.maximum(moving.high, lying.high),
    )


def _pieces_of(path: Array, count: int) -> tuple[Array, Array]:
    """Return joint values in the middle of pieces of the edges of a path, and the largest deviations from them."""
    steps = np.diff(path, axis=0)[:, None]
    middle = path[:-1, None] + steps * ((np.arange(count) + 0.5) / count)[:, None]
    spread = np.repeat(np.abs(steps) / (2 * count), count, axis=1)
    return middle.reshape(-1, path.shape[1]), spread.reshape(-1, path.shape[1])


def reach_of(trajectory: Trajectory, cells: int) -> tuple[Array, Array]:
    """Return joint values in the middle of each cell of a trajectory, and the largest deviations from them.

    The bound is exact: a cubic lies within the control points of its Bézier form. Both shapes are (cells, joints).
    """
    seconds = trajectory.seconds
    bounds = seconds * np.arange(cells + 1) / cells
    middle = trajectory.sample((bounds[:-1] + bounds[1:]) / 2)
    cuts = np.union1d(bounds, trajectory.times)
    cuts = cuts[np.concatenate([[True], np.diff(cuts) > 1e-12])]
    positions, rates = trajectory.sample(cuts), trajectory.rates(cuts)
    third = np.diff(cuts)[:, None] / 3
    control = np.stack(
        [positions[:-1], positions[:-1] + third * rates[:-1], positions[1:] - third * rates[1:], positions[1:]]
    )
    owner = np.clip(np.searchsorted(bounds, (cuts[:-1] + cuts[1:]) / 2, side="right") - 1, 0, cells - 1)
    far = np.abs(control - middle[owner]).max(axis=0)
    spread = np.zeros_like(middle)
    np.maximum.at(spread, owner, far)
    return middle, spread

"""Validation of a cell before any planning: bases, home configurations, tools and payloads."""

from __future__ import annotations

import numpy as np

from falsework.errors import CellError
from falsework.robots.cells.home import home_faults, proposal_text
from falsework.robots.kernels.collision import distance_between
from falsework.robots.model.cell import Cell, CellRobot
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import Pieces, move
from falsework.robots.motion.near_pairs import millimetres, separation
from falsework.utils.arrays import Array

BASE_DEPTH = 0.002
"""Largest penetration of a base into the surface below it, metres."""


def check_cell(cell: Cell, parts: PartShapes | None = None) -> None:
    """Validate a cell: bases and home configurations without collision, payloads sufficient for the parts.

    Args:
        cell: the cell.
        parts: the structure in it; without it only the cell itself is checked.

    Raises:
        CellError: a base inside an obstacle, another base or a part; a home below the floor or in collision; a tool
            that collides with its own arm; a part that is too heavy for every robot.
    """
    check_bases(cell, parts)
    _check_homes(cell, parts)
    if parts is not None:
        _check_payload(cell, parts)


def check_bases(cell: Cell, parts: PartShapes | None = None) -> None:
    """Raise CellError unless bases stand clear of obstacles, parts, other bases and the floor.

    A base whose own frame is upright on the floor stands on it, whatever its shapes do below that frame.
    """
    stands = [(f"obstacle {obstacle.name}", obstacle.pieces) for obstacle in cell.obstacles]
    if parts is not None:
        stands += [(f"part {name}", pieces) for name, pieces in zip(parts.names, parts.pieces, strict=True)]
    bases = [shrunk(tuple(move(robot.base, p) for p in robot.model.pieces[0])) for robot in cell.robots]
    for index, (robot, base) in enumerate(zip(cell.robots, bases, strict=True)):
        others = [(f"the base of {cell.robots[k].name}", bases[k]) for k in range(index)]
        for name, pieces in (*stands, *others):
            depth = max((-separation(a, b) for a in base for b in pieces if overlap(a, b)), default=None)
            if depth is not None:
                raise CellError(
                    f"{cell.name}: the base of robot {robot.name} is inside {name} by "
                    f"{millimetres(depth + BASE_DEPTH)}; move one of them"
                )
        lowest = min((float(piece[:, 2].min()) for piece in base), default=np.inf) - BASE_DEPTH
        if cell.floor is not None and cell.floor - lowest > BASE_DEPTH and not _stands_on(robot, cell.floor):
            depth = cell.floor - lowest
            raise CellError(
                f"{cell.name}: the base of robot {robot.name} is {millimetres(depth)} below the floor; raise it to "
                f"z = {round(robot.base[2, 3] + depth, 4) + 0.0:g}, or set floor to {round(lowest, 4):g}"
            )


def _stands_on(robot: CellRobot, floor: float) -> bool:
    """Return whether the frame of a base is upright on the floor, which is how descriptions have it."""
    return bool(abs(robot.base[2, 3] - floor) <= BASE_DEPTH and robot.base[2, 2] > 1 - 1e-6)


def _check_homes(cell: Cell, parts: PartShapes | None) -> None:
    shown = parts or no_parts()
    for index, robot in enumerate(cell.robots):
        pairs = home_faults(cell, shown, index)
        if not pairs:
            continue
        own = [pair for pair in pairs if pair.second.startswith(f"{robot.name} ")]
        worst, proposal = (own or pairs)[0], proposal_text(cell, shown, index)
        if own:
            tool = "gripper" in worst.first + worst.second
            what = "its tool collides with its own arm" if tool else "it collides with itself"
            cure = proposal or "change home or the gripper's shapes"
            raise CellError(f"{cell.name}: robot {robot.name} at home: {what} ({worst.words}); {cure}")
        cure = proposal or "change home or move the base"
        raise CellError(f"{cell.name}: robot {robot.name} at home is too near: {worst.words}; {cure}")


def _check_payload(cell: Cell, parts: PartShapes) -> None:
    most = max(robot.payload for robot in cell.robots)
    heavy = ~parts.boundary & (parts.mass > most)
    if heavy.any():
        part = int(np.argmax(np.where(heavy, parts.mass, 0)))
        strongest = max(cell.robots, key=lambda robot: robot.payload)
        raise CellError(
            f"{cell.name}: part {parts.names[part]} weighs {parts.mass[part]:.3g} kg and the payload of "
            f"{strongest.name} is {strongest.payload:.3g} kg; "
            "use a stronger arm or gripper, or set density or scale of [structure]"
        )


def no_parts() -> PartShapes:
    """Return a structure without parts."""
    return PartShapes((), np.zeros(0, bool), (), (), np.zeros(0), np.zeros((0, 3)), np.eye(3))


def overlap(a: Array, b: Array) -> bool:
    """Return whether two convex pieces intersect: whether no plane separates them."""
    apart = (a.min(axis=0) > b.max(axis=0)).any() or (b.min(axis=0) > a.max(axis=0)).any()
    return not apart and distance_between(np.ascontiguousarray(a), np.ascontiguousarray(b)) <= 0.0


def shrunk(pieces: Pieces) -> Pieces:
    """Shrink pieces towards their centre by `BASE_DEPTH` along every axis, so that a base may rest on another body."""
    found = []
    for piece in pieces:
        low, high = piece.min(axis=0), piece.max(axis=0)
        middle = (low + high) / 2
        share = np.maximum(0.0, 1 - 2 * BASE_DEPTH / np.maximum(high - low, 1e-9))
        found.append((piece - middle) * share + middle)
    return tuple(found)

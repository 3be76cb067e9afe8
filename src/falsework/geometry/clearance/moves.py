"""Moves of rigid parts: straight lines, turns about an axis, and both at once, which is a screw."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import apply

MOST_MOVES = 100
"""Moves of a way out at most."""

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Poses = Mapping[int, Array]
"""Displacement of parts from their places as matrices of shape (4, 4); parts that are not there are in place."""


@dataclass(frozen=True)
class PathMove:
    """Motion of some parts as one body, at a constant velocity along an axis and about it."""

    parts: tuple[int, ...]
    direction: Vector
    """Unit vector: of the line, or the axis."""
    distance: float
    """Along it, metres."""
    angle: float = 0.0
    """About it by the right-hand rule, rad."""
    point: Vector = (0.0, 0.0, 0.0)
    """On the axis, metres; no matter for a straight line."""

    @classmethod
    def straight(cls, parts: tuple[int, ...], direction: Array, distance: float = np.inf) -> PathMove:
        """Return a move along a unit vector, shape (3,), by a distance in metres; by default as far as needed."""
        x, y, z = (direction + 0.0).tolist()
        return cls(parts, (x, y, z), float(distance))

    @property
    def turns(self) -> bool:
        """Whether the parts turn."""
        return self.angle != 0.0

    def until(self, share: float) -> PathMove:
        """Return the first share of the move."""
        return replace(self, distance=float(share * self.distance), angle=float(share * self.angle))

    def displacement(self, share: float = 1.0) -> Array:
        """Return the matrix of the displacement after a share of the move, shape (4, 4)."""
        axis, point = np.array(self.direction), np.array(self.point)
        matrix = np.eye(4)
        if self.turns:
            x, y, z = axis
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            angle = share * self.angle
            matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
        matrix[:3, 3] = point - matrix[:3, :3] @ point + share * self.distance * axis
        return matrix

    def length(self, points: Array) -> float:
        """Return how far the farthest of some points, shape (..., 3), goes along its arc, metres."""
        return float(np.hypot(self.distance, self._radius(points) * self.angle))

    def _radius(self, points: Array) -> float:
        return float(np.linalg.norm(np.cross(points - np.array(self.point), self.direction), axis=-1).max())

    def steps(self, points: Array, sagitta: float) -> int:
        """Count equal steps between which points stay within a distance of the lines that join where they are.

        On an arc of angle `h` and radius `r` a point is never farther than `r h^2 / 8` from where it would be on
        the chord at the same time, since linear interpolation errs by at most an eighth of the second derivative; along
        the axis it does not err. So too for all points between these.

        Args:
            points: of a part where the move begins, shape (points, 3), metres.
            sagitta: that distance, metres.
        """
        if not self.turns:
            return 1
        return max(1, int(np.ceil(abs(self.angle) * np.sqrt(self._radius(points) / (8.0 * sagitta)))))


ExitPath = tuple[PathMove, ...]
"""Moves in which a part leaves, from where all parts are in place."""


def way_back(way: ExitPath) -> ExitPath:
    """Return the moves in which others than the parts of the last move go back as they came, the last one first."""
    found = []
    for move in reversed(way):
        others = tuple(one for one in move.parts if one not in way[-1].parts)
        x, y, z = move.direction
        if others:
            found.append(replace(move, parts=others, direction=(-x, -y, -z)))
    return tuple(found)


def on_the_way(way: ExitPath, points: Callable[[int], Array], most: float) -> list[tuple[float, PathMove]]:
    """Return the moves of a way with the lengths to be shown, metres, and those in which others go back.

    Args:
        way: in which the parts of the last move leave.
        points: returns those of a part in place, shape (points, 3), metres.
        most: length of the last move that is shown at most, metres.
    """
    found, poses = [], dict[int, Array]()
    for number, move in enumerate((*way, *way_back(way))):
        length = max(move.length(apply(poses.get(one, np.eye(4)), points(one))) for one in move.parts)
        poses = after((move,), poses)
        share = min(1.0, most / length) if number + 1 == len(way) else 1.0
        found.append((share * length, move.until(share)))
    return found


def part_way(shown: Sequence[tuple[float, PathMove]], share: float) -> dict[int, Array]:
    """Return the poses of the parts that move, after a share of the length of a way, as `on_the_way` returns it."""
    done, left = list[PathMove](), share * sum(length for length, _ in shown)
    for length, move in shown:
        done.append(move.until(min(1.0, left / length)) if length > 0 else move)
        left -= length
        if left <= 0:
            break
    return after(done)


def after(moves: Sequence[PathMove], poses: Poses = MappingProxyType({})) -> dict[int, Array]:
    """Return where moves, one after the other, bring the parts that they move, and others that are not in place."""
    poses = dict(poses)
    for move in moves:
        matrix = move.displacement()
        for part in move.parts:
            poses[part] = matrix @ poses.get(part, np.eye(4))
    return poses

"""Axes about which a part can turn, or screw, past the parts near it.

Surfaces on which a part slides say how it can move: a pin turns about the axis of its hole, a bolt screws along its
thread, a lid turns about the edge on which it rests (Gelfand and Guibas, Shape Segmentation Using Local Slippage
Analysis, 2004). Here the part may also move away from surfaces, and near surfaces count that it does not touch, since
what turns mostly has clearance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import Rows
from falsework.geometry.mesh.collision import Body
from falsework.geometry.mesh.mesh import triangle_normals
from falsework.utils.interruption import check_interruption

Array = NDArray[np.float64]

_INTO = 10.0
"""Weight of motion into a surface, beside motion away from it. Facets of a round surface do both in equal shares."""
_SAME = 1e-6
"""Numbers of axes that differ by no more, as shares of the extent, are equal."""
_ROUNDS = 60
"""Rounds of least squares in which a motion is found."""
_SAMPLES = 400
"""Faces of the part, and of the others, that are looked at: the largest near ones."""


@dataclass(frozen=True, eq=False)
class Axis:
    """Axis with a pitch."""

    direction: Array
    """Unit vector, shape (3,)."""
    point: Array
    """On the axis, shape (3,), metres."""
    pitch: float
    """Distance along it in a turn of one radian about it, metres."""


@dataclass(frozen=True, eq=False)
class _Surface(Rows):
    """Samples of near surfaces, from the side of the part."""

    points: Array
    """Shape (samples, 3), metres."""
    normals: Array
    """Out of the part, shape (samples, 3)."""
    areas: Array
    """Shape (samples,), square metres."""
    gaps: Array
    """To the other surface, shape (samples,), metres."""


def axes_of(part: Array, others: Sequence[Array], tolerance: float, thickness: float) -> list[Axis]:
    """Return axes about which a part can begin to turn, both ways, as far as near surfaces tell.

    Surfaces are near within the tolerance at first, then within twice that, and so on up to the thickness of the part.

    Args:
        part: corners of its triangles where it is, shape (faces, 3, 3), metres.
        others: those of the other parts.
        tolerance: gap up to which parts touch, metres.
        thickness: of the part, metres.
    """
    surface = _near_surface(part, others, thickness, tolerance)
    found: list[Axis] = []
    extent, seen, gap = float(np.linalg.norm(np.ptp(part.reshape(-1, 3), axis=0))), 0, tolerance
    while gap <= thickness:
        near = surface.take(surface.gaps <= gap)
        if len(near.points) > seen:
            seen = len(near.points)
            for axis in _slides(near, extent):
                if abs(axis.pitch) * 2 * np.pi < tolerance:
                    axis = Axis(axis.direction, axis.point, 0.0)
                if not any(_same(axis, known, extent) for known in found):
                    found.append(axis)
        gap *= 2
    return found


def _near_surface(part: Array, others: Sequence[Array], most: float, tolerance: float) -> _Surface:
    """Return the faces of a part and of others that are near to each other, each at the middle of its shortest edge.

    There the normal of a face of a round or twisted surface is that of the surface, since the edge is a short chord.
    Faces that look away from the other side are left out.
    """
    rest = np.concatenate(list(others))
    low, high = part.min(axis=(0, 1)) - most, part.max(axis=(0, 1)) + most
    rest = rest[((rest.min(axis=1) <= high) & (rest.max(axis=1) >= low)).all(axis=1)]
    samples = [_Surface(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))]
    for own, other, sign in ((part, rest, 1.0), (rest, part, -1.0)):
        normals = triangle_normals(own)
        double = np.linalg.norm(normals, axis=1)
        kept = np.argsort(-double, kind="stable")[:_SAMPLES]
        kept = kept[double[kept] > 0]
        if not len(kept) or not len(other):
            continue
        edges = np.linalg.norm(own[kept] - np.roll(own[kept], -1, axis=1), axis=2)
        first = edges.argmin(axis=1)[:, None, None]
        ends = [np.take_along_axis(own[kept], (first + k) % 3, axis=1)[:, 0] for k in (0, 1)]
        middles = 0.5 * (ends[0] + ends[1])
        body = Body(other.reshape(-1, 3), np.arange(3 * len(other)).reshape(-1, 3))
        outwards = normals[kept] / double[kept, None]
        gaps = body.distances(middles)
        near = np.flatnonzero(gaps <= most)
        before, behind = (body.distances(middles[near] + side * tolerance * outwards[near]) for side in (1.0, -1.0))
        near = near[before <= behind + 0.5 * tolerance]
        samples.append(_Surface(middles[near], sign * outwards[near], double[kept][near] / 2, gaps[near]))
    return _Surface.join(samples)


def _slides(surface: _Surface, extent: float) -> list[Axis]:
    """Return the axes of the motions that go least into surfaces, and then least away from them.

    One motion for each direction of shifting and turning that has a part of it at speed one.
    """
    middle = np.average(surface.points, axis=0, weights=surface.areas)
    arms = (surface.points - middle) / extent
    rows = np.concatenate([surface.normals, np.cross(arms, surface.normals)], axis=1)
    weights = surface.areas / surface.areas.sum()
    axes = []
    for component in range(6):
        for sign in (1.0, -1.0):
            check_interruption()
            motion = _least_motion(rows, weights, component, sign)
            spin, shift = motion[3:] / extent, motion[:3]
            size = float(np.linalg.norm(spin))
            if size * extent < 1e-3 * np.linalg.norm(motion):
                continue
            direction = spin / size
            direction = np.where(np.abs(direction) < _SAME, 0.0, direction)
            direction /= np.linalg.norm(direction)
            point = middle + np.cross(spin, shift) / size**2
            axes.append(Axis(direction, point, float(direction @ shift) / size))
    return axes


def _least_motion(rows: Array, weights: Array, component: int, sign: float) -> Array:
    """Return the motion with one component of +-1 that goes least into surfaces and away from them, shape (6,).

    The sum of speeds, those into surfaces counted `_INTO` times, by least squares whose weights are divided by the
    speeds of the solution before.
    """
    others = [k for k in range(6) if k != component]
    motion, change = np.zeros(6), np.inf
    motion[component] = sign
    smoothing = 1.0
    for _ in range(_ROUNDS):
        speed = rows @ motion
        scale = weights * np.where(speed > 0, _INTO, 1.0) / np.maximum(np.abs(speed), smoothing)
        root = np.sqrt(scale)[:, None]
        new = motion.copy()
        new[others] = np.linalg.lstsq(root * rows[:, others], -sign * root[:, 0] * rows[:, component], rcond=None)[0]
        change, motion = float(np.abs(new - motion).max()), new
        if change < 0.1 * smoothing:
            smoothing *= 0.1
            if smoothing < 0.1 * _SAME:
                break
    return motion


def _same(one: Axis, other: Axis, extent: float) -> bool:
    """Return whether two axes have the same line, sense and pitch."""
    apart = np.cross(one.point - other.point, one.direction)
    near = 1e-3 * extent
    return bool(
        one.direction @ other.direction > 1 - _SAME
        and np.linalg.norm(apart) < near
        and abs(one.pitch - other.pitch) < 1e-3 * near
    )

"""Appearance of a timeline position: colour, opacity and displacement of every part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED, States
from falsework.geometry.arrays import box_around
from falsework.search.plans.steps import NO_ROBOT
from falsework.viewer.palette import BOUNDARY, INSTALLED, ramp_in_steps, rgb, robot_color
from falsework.viewer.section import Axis, Plane
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]

FADE = 2.0
"""Steps that a part takes to leave the picture."""
TRAVEL = 0.45
"""Distance travelled meanwhile, in diagonals of the structure."""


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of all parts."""

    state: States
    """State shown, shape (parts,)."""
    color: NDArray[np.uint8]
    """Red, green, blue, shape (parts, 3)."""
    opacity: Array
    """0 for invisible parts, shape (parts,)."""
    shift: Array
    """Displacement of each part from its place, metres, shape (parts, 3); of a part that turns, that of the origin."""
    turn: Array
    """Rotation of each part from its place, about the origin, shape (parts, 3, 3)."""
    holder: NDArray[np.int64]
    """Robot that holds each part, `NO_ROBOT` where none does, shape (parts,)."""

    @property
    def solid(self) -> NDArray[np.bool_]:
        """Parts fully visible and in place, shape (parts,)."""
        return (self.opacity >= 1) & ~self.shift.any(axis=1) & (self.turn == np.eye(3)).all(axis=(1, 2))

    def moved(self, part: int, points: Array) -> Array:
        """Return points of a part, shape (..., 3), where it is seen, metres."""
        return points @ self.turn[part].T + self.shift[part]

    @property
    def ghosts(self) -> NDArray[np.int64]:
        """Parts in transit."""
        return np.flatnonzero((self.opacity > 0) & ~self.solid)


def appearance_at(
    timeline: Timeline,
    position: float,
    *,
    state: States | None = None,
    action_probabilities: Array | None = None,
    marks: Mapping[int, str] | None = None,
    travelling: bool = True,
) -> Appearance:
    """Return the appearance of all parts at a timeline position.

    Args:
        position: place in the timeline; between whole numbers parts are in transit.
        state: state shown instead of the one at this step, such as one with parts missing; shape (parts,).
        action_probabilities: probability of the action that concerns each part, NaN where none does; coloured on a
            scale, shape (parts,).
    """
    assembly = timeline.assembly
    row = timeline.row(position)
    shown = timeline.states[row] if state is None else state
    holder = np.where(shown == 2, timeline.holders[row], NO_ROBOT)
    color = np.broadcast_to(np.array(rgb(INSTALLED), dtype=np.uint8), (assembly.part_count, 3)).copy()
    for part in np.flatnonzero(holder != NO_ROBOT):
        color[part] = rgb(robot_color(int(holder[part])))
    color[assembly.immovable] = rgb(BOUNDARY)
    opacity = (shown != REMOVED).astype(float)
    shift, turn = np.zeros((assembly.part_count, 3)), np.tile(np.eye(3), (assembly.part_count, 1, 1))
    if travelling:
        # A part comes during the two steps before its place is reached.
        gone = timeline.insertion - position
        leaving = (timeline.insertion > 0) & (gone > 0) & (gone < FADE)
        if state is not None:
            leaving &= timeline.states[row] == state
        far = TRAVEL * diagonal(assembly) if leaving.any() else 0.0
        for part in np.flatnonzero(leaving):
            share = float(gone[part]) / FADE
            opacity[part] = 1 - share
            for one, pose in timeline.displacements(int(part), share, far).items():
                turn[one], shift[one] = pose[:3, :3], pose[:3, 3]
            last = int(timeline.holders[timeline.insertion[part], part])
            if last != NO_ROBOT:
                color[part] = rgb(robot_color(last))
    if action_probabilities is not None:
        asked = np.isfinite(action_probabilities)
        color[asked] = ramp_in_steps(action_probabilities[asked])
    for part, mark in (marks or {}).items():
        color[part] = rgb(mark)
    return Appearance(shown, color, opacity, shift, turn, holder)


@dataclass(frozen=True)
class SceneView:
    """Changes of the appearance that let one see into a structure."""

    explode: float = 0.0
    """Distance of parts from their places, as a share of that from the middle of the floor."""
    axis: Axis | None = None
    """Axis across which the structure is cut; None for no section."""
    keep: float = 1.0
    """Share of the length of the structure along the axis that stays. What is cut away is on the side of the first
    view, from where the cut is seen: that with high x and z, but low y."""

    def plane(self, assembly: Assembly) -> Plane | None:
        """Return the plane of the section, metres."""
        if self.axis is None:
            return None
        low, high = bounds_of(assembly)[:, "xyz".index(self.axis)].tolist()
        length = self.keep * (high - low)
        return Plane(self.axis, high - length, True) if self.axis == "y" else Plane(self.axis, low + length)

    def gone(self, assembly: Assembly) -> NDArray[np.bool_]:
        """Return the parts that are cut away as a whole, shape (parts,)."""
        plane = self.plane(assembly)
        if plane is None:
            return np.zeros(assembly.part_count, dtype=bool)
        heights = plane.heights(np.array([mesh.bounds for mesh in assembly.meshes]))
        return np.max(heights, axis=1) <= 0

    def of(self, look: Appearance, assembly: Assembly) -> Appearance:
        """Return the appearance with parts moved apart, and without those that are cut away as a whole."""
        opacity, shift = np.where(self.gone(assembly), 0.0, look.opacity), look.shift
        if self.explode:
            low, high = bounds_of(assembly)
            shift = shift + self.explode * (assembly.mass.center - np.array([*(low + high)[:2] / 2, low[2]]))
        return replace(look, opacity=opacity, shift=shift)


def bounds_of(assembly: Assembly, parts: Sequence[int] | slice = slice(None)) -> Array:
    """Return the lowest and highest coordinates of all parts, or of some, shape (2, 3), metres."""
    return box_around(np.array([mesh.bounds for mesh in assembly.meshes])[parts].reshape(-1, 3))


def diagonal(assembly: Assembly) -> float:
    """Return the length of the diagonal of the box around all parts, metres."""
    return float(np.linalg.norm(np.ptp(bounds_of(assembly), axis=0)))


def pick(
    assembly: Assembly, appearance: Appearance, origin: Array, direction: Array, plane: Plane | None = None
) -> int | None:
    """Return the part that a ray hits first, or None.

    Args:
        appearance: where the parts are; invisible parts are not hit.
        origin: origin of the ray, metres, shape (3,).
        direction: direction of the ray, any length, shape (3,).
        plane: section of the parts, in their places; what is cut away is not hit.
    """
    seen = np.flatnonzero(appearance.opacity > 0)
    if len(seen) == 0:
        return None
    origin, direction = np.asarray(origin, dtype=float), np.asarray(direction, dtype=float)
    triangles = np.concatenate([appearance.moved(part, assembly.meshes[part].triangles) for part in seen.tolist()])
    owner = np.repeat(seen, [len(assembly.meshes[part].faces) for part in seen])
    edge, other = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(direction, other)
    volume = (edge * across).sum(axis=1)
    hit = np.abs(volume) > 1e-14
    scale = np.divide(1.0, volume, out=np.zeros_like(volume), where=hit)
    offset = origin - triangles[:, 0]
    u = (offset * across).sum(axis=1) * scale
    turned = np.cross(offset, edge)
    v = (turned @ direction) * scale
    distance = (other * turned).sum(axis=1) * scale
    hit &= (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if plane is not None:
        points = origin + distance[:, None] * direction - appearance.shift[owner]
        hit &= plane.heights(points) >= 0
    if not hit.any():
        return None
    return int(owner[np.argmin(np.where(hit, distance, np.inf))])

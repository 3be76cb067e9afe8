"""Arrows for presses and for certificates: forces in a stable state, motion of an unstable one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import INSTALLED, REMOVED, States
from falsework.geometry.arrays import segment_sum
from falsework.stability.holds import Press
from falsework.utils.quantity import format_quantity
from falsework.viewer.appearance import bounds_of, diagonal
from falsework.viewer.palette import FORCE, FRICTION, GRAVITY, INK, MOTION, PRESS, SLIDING, unit_rgb
from falsework.viewer.pictures.render import ColoredSolid

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.viewer.timeline import Timeline

Array = NDArray[np.float64]

LONGEST = 0.14
"""Length of the largest arrow, in diagonals of the structure."""
SHORTEST = 0.02
"""Arrows below this share of the largest are left out."""
MOTION_SHARE = 0.06
"""Displacement of the fastest point where motion is shown, in diagonals of the structure."""
SIDES = 8
"""Of the shaft of an arrow."""
PRESSES = "presses"
"""Kind of the arrows that belong to a step, not to the proof of a state."""
KINDS = {
    "contact forces": FORCE,
    "friction": FRICTION,
    "gravity": GRAVITY,
    "motion": MOTION,
    "sliding": SLIDING,
    PRESSES: PRESS,
}
"""Quantities that arrows show, and their colours."""
_BREADTH = {"gravity": 1.5, PRESSES: 2.0}
"""Thickness beside that of other arrows: weights often lie on the line of a contact force, and are seen around it."""


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows of one kind."""

    ends: Array
    """Tail and tip, shape (arrows, 2, 3), metres."""
    color: str
    breadth: float = 1.0
    """Thickness beside that of other arrows."""
    inside: bool = True
    """Whether they lie inside parts, which are then drawn pale."""
    scale: float = 0.0
    """Length of an arrow of 1 N, metres; 0 for motions."""

    def __len__(self) -> int:
        return len(self.ends)

    @property
    def longest(self) -> float:
        """Force of the longest arrow, N; 0 for motions."""
        if not self.scale or not len(self):
            return 0.0
        return float(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1).max()) / self.scale

    def words(self, kind: str) -> str:
        """Return the words of a legend for arrows of a kind, such as `friction, up to 3 kN`."""
        return f"{kind}, up to {format_quantity(self.longest, 'force')}" if self.longest else kind

    def solids(self, thickness: float) -> list[ColoredSolid]:
        """Return the arrows as meshes.

        Args:
            thickness: diameter of a shaft, metres.
        """
        return [
            ColoredSolid(*arrow_mesh(tail, tip, thickness * self.breadth), unit_rgb(self.color))
            for tail, tip in self.ends
        ]


def arrows_of_forces(
    assembly: Assembly, state: States, forces: Array, presses: Sequence[Press] = (), *, gravity: float = 9.81
) -> dict[str, Arrows]:
    """Return the contact forces, friction, gravity and presses in one state, all on one scale.

    The force of each contact is drawn as it acts on the part of the two that is free to move (on the second if both
    are), split into normal force and friction, at the centre of pressure; where part of it is tension, at the mean of
    the points by the size of their normal forces.

    Args:
        forces: `(n, t1, t2)` in N, shape (points, 3).
        presses: of the step that leads to the state; drawn as `arrows_of_step` does.
        gravity: m/s2.
    """
    contacts = assembly.contacts
    a, b = contacts.parts.T
    acts = (state[a] != REMOVED) & (state[b] != REMOVED) & ((state[a] == INSTALLED) | (state[b] == INSTALLED))
    owner = contacts.contact_of_point
    size = np.abs(forces[:, 0])
    weight = np.bincount(owner, size, len(contacts))
    acts &= weight > 0
    center = np.stack([np.bincount(owner, size * contacts.points[:, k], len(contacts)) for k in range(3)], axis=1)
    center /= np.maximum(weight, 1e-300)[:, None]
    sign = np.where(state[b] == INSTALLED, 1.0, -1.0)[:, None]
    pushes = sign * segment_sum(forces[:, :1] * contacts.point_frames[:, 0], owner, len(contacts))
    tangent = np.einsum("pi,pij->pj", forces[:, 1:], contacts.point_frames[:, 1:])
    rubs = sign * segment_sum(tangent, owner, len(contacts))
    free = state == INSTALLED
    weights = assembly.applied_wrench(gravity)[free, :3]
    pressed = np.array([press.wrench[:3] for press in presses]).reshape(-1, 3)
    shown = (pushes[acts], rubs[acts], weights, pressed)
    largest = max(float(np.linalg.norm(vectors, axis=1).max(initial=0.0)) for vectors in shown)
    scale = LONGEST * diagonal(assembly) / max(largest, 1e-300)
    return {
        "contact forces": _arrows(center[acts], pushes[acts], "contact forces", assembly, scale),
        "friction": _arrows(center[acts], rubs[acts], "friction", assembly, scale),
        "gravity": _arrows(assembly.mass.center[free], weights, "gravity", assembly, scale),
        **_press_arrows(assembly, presses, scale),
    }


def arrows_of_step(timeline: Timeline, place: int) -> dict[str, Arrows]:
    """Return the presses of the step that leads to a place, without the forces of its proof.

    The tip is at the centre of mass of the part that the robot holds; empty if no robot presses.
    """
    presses = timeline.presses_at(place)
    largest = max((press.force for press in presses), default=0.0)
    return _press_arrows(timeline.assembly, presses, LONGEST * diagonal(timeline.assembly) / max(largest, 1e-300))


def arrows_of_motion(assembly: Assembly, state: States, velocity: Array, kind: str = "motion") -> Arrows:
    """Return arrows of the motion of the free parts in an unstable state, up to scale.

    Args:
        velocity: `(linear, angular)` about the centres of mass, shape (parts, 6).
        kind: `motion` of an unstable state, `sliding` of one that slides.
    """
    free = state == INSTALLED
    vectors = velocity[free, :3]
    largest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    scale = LONGEST * diagonal(assembly) / max(largest, 1e-300)
    return replace(_arrows(assembly.mass.center[free], vectors, kind, assembly, scale), scale=0.0)


def scale_arrow(assembly: Assembly, arrows: Iterable[Arrows]) -> tuple[Arrows, float] | None:
    """Return an arrow of a round force beside the structure, and the force in N; None where no arrow is a force."""
    forces = [some for some in arrows if some.longest > 0]
    if not forces:
        return None
    largest = max(some.longest for some in forces)
    unit = 10.0 ** np.floor(np.log10(largest))
    force = float(unit * max(share for share in (1.0, 2.0, 5.0) if share * unit <= largest * (1 + 1e-9)))
    low = bounds_of(assembly)[0]
    tail = np.array([low[0], low[1] - 0.08 * diagonal(assembly), low[2]])
    ends = np.array([[tail, tail + [force * forces[0].scale, 0.0, 0.0]]])
    return Arrows(ends, INK, 1.0, inside=False, scale=forces[0].scale), force


def moved_parts(assembly: Assembly, state: States, velocity: Array) -> dict[int, Array]:
    """Return vertices of the free parts that move, a little further along their motion.

    Args:
        velocity: `(linear, angular)` about the centres of mass, shape (parts, 6).

    Returns:
        By part, shape (vertices, 3), metres.
    """
    center = assembly.mass.center
    ways = {}
    for part in np.flatnonzero(state == INSTALLED):
        arm = assembly.meshes[part].vertices - center[part]
        ways[int(part)] = velocity[part, :3] + np.cross(velocity[part, 3:], arm)
    fastest = max((float(np.linalg.norm(way, axis=1).max()) for way in ways.values()), default=0.0)
    if not fastest > 0:
        return {}
    scale = MOTION_SHARE * diagonal(assembly) / fastest
    return {
        part: assembly.meshes[part].vertices + scale * way
        for part, way in ways.items()
        if float(np.linalg.norm(way, axis=1).max()) > SHORTEST * fastest
    }


def arrow_mesh(tail: Array, tip: Array, thickness: float) -> tuple[Array, NDArray[np.int64]]:
    """Return a closed arrow: shaft and head. Vertices of shape (count, 3), faces of shape (count, 3)."""
    tail, tip = np.asarray(tail, dtype=float), np.asarray(tip, dtype=float)
    along = tip - tail
    length = float(np.linalg.norm(along))
    along = along / length if length > 0 else np.array([0.0, 0.0, 1.0])
    side = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.7 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(along, side)
    angle = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    neck = tip - along * min(2.6 * thickness, 0.6 * length)
    shaft, head = ring * thickness / 2, ring * thickness * 1.15
    vertices = np.concatenate([[tail], tail + shaft, neck + shaft, neck + head, [tip]])
    here, there = np.arange(SIDES), (np.arange(SIDES) + 1) % SIDES
    first, second, third, last = 1, 1 + SIDES, 1 + 2 * SIDES, 1 + 3 * SIDES
    faces = [np.stack([np.zeros_like(here), first + there, first + here], axis=1)]
    for low, high in ((first, second), (second, third)):
        faces.append(np.stack([low + here, low + there, high + there], axis=1))
        faces.append(np.stack([low + here, high + there, high + here], axis=1))
    faces.append(np.stack([third + here, third + there, np.full_like(here, last)], axis=1))
    return vertices, np.concatenate(faces)


def _press_arrows(assembly: Assembly, presses: Sequence[Press], scale: float) -> dict[str, Arrows]:
    if not presses:
        return {}
    vectors = np.array([press.wrench[:3] for press in presses])
    tips = assembly.mass.center[[press.part for press in presses]]
    return {PRESSES: replace(_arrows(tips - scale * vectors, vectors, PRESSES, assembly, scale), inside=False)}


def _arrows(tails: Array, vectors: Array, kind: str, assembly: Assembly, scale: float) -> Arrows:
    vectors = scale * vectors
    long = np.linalg.norm(vectors, axis=1) > SHORTEST * LONGEST * diagonal(assembly)
    ends = np.stack([tails[long], tails[long] + vectors[long]], axis=1)
    return Arrows(ends, KINDS[kind], _BREADTH.get(kind, 1.0), scale=scale)

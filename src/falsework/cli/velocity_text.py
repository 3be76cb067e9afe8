"""Text about the motion of parts in an unstable structure."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.stability.margins.state_margins import triple
from falsework.stability.stiffness import reach_of

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.stability.verdict import Verdicts

MOVES = 0.02
"""A part counts as moving if some point of it moves at this share of the fastest point of all parts."""
TURNS = 0.2
"""Share of the part's motion, at its outermost point, below which rotation or translation is omitted."""
LEANS = 0.38
"""Components of a direction below this, the sine of about 22 degrees, are omitted."""
STEEP = 0.9
"""Vertical component of a direction from which on a part falls or lifts instead of sliding."""


@dataclass(frozen=True)
class PartMotion:
    """Motion of one part; lengths are relative, since a mechanism has a direction but no magnitude."""

    part: int
    speed: float
    """Speed of the part's fastest point; 1 for the fastest of all parts."""
    translation: tuple[float, float, float]
    """Velocity of the centre of mass, on the scale of `speed`."""
    rotation: tuple[float, float, float]
    """Angular velocity times the distance from the centre of mass to the outermost point, on the scale of `speed`."""

    @property
    def words(self) -> str:
        """Such as `slides down and towards +x, turning about +y`."""
        shift, turn = np.array(self.translation), np.array(self.rotation)
        shifts, turns = np.linalg.norm(shift), np.linalg.norm(turn)
        total = max(shifts, turns, 1e-300)
        texts = []
        if shifts > TURNS * total:
            texts.append(_travel(shift / shifts))
        if turns > TURNS * total:
            texts.append(f"{'turning' if texts else 'turns'} about {_axis(turn / turns)}")
        return ", ".join(texts)

    def to_dict(self, assembly: Assembly) -> dict[str, Any]:
        """Return the motion as a JSON object."""
        return {"name": assembly.names[self.part], **asdict(self), "words": self.words}


def motions(assembly: Assembly, velocity: NDArray[np.float64]) -> list[PartMotion]:
    """Return the parts that a velocity moves, the fastest first.

    Args:
        velocity: linear velocity of the centre of mass and angular velocity of each part, shape (parts, 6).
    """
    shift, turn = velocity[:, :3], velocity[:, 3:] * reach_of(assembly)[:, None]
    speed = np.linalg.norm(shift, axis=1) + np.linalg.norm(turn, axis=1)
    top = float(speed.max(initial=0.0))
    if not top > 0:
        return []
    order = [part for part in np.argsort(-speed, kind="stable") if speed[part] > MOVES * top]
    return [
        PartMotion(int(part), float(speed[part] / top), triple(shift[part] / top), triple(turn[part] / top))
        for part in order
    ]


def motions_at(assembly: Assembly, verdicts: Verdicts, row: int) -> list[PartMotion]:
    """Return the parts that a verdict on a state proves to move, the fastest first; none if it is stable."""
    from falsework.stability.motion import motion_of

    velocity = motion_of(assembly, verdicts, row)
    return [] if velocity is None else motions(assembly, velocity)


def describe(assembly: Assembly, moving: list[PartMotion], limit: int = 6) -> str:
    """Return one line for the parts that move, such as `part 3 falls; part 4 turns about +y; and 2 more`."""
    texts = [f"{subject(assembly, motion.part)} {motion.words}" for motion in moving[:limit]]
    if len(moving) > limit:
        texts.append(f"and {len(moving) - limit} more")
    return "; ".join(texts)


def subject(assembly: Assembly, part: int) -> str:
    """Return a part at the beginning of a clause, such as `part 3` or `voussoir-3`."""
    name = part_name(assembly, part)
    return f"part {name}" if name[0].isdecimal() else name


def part_name(assembly: Assembly, part: int) -> str:
    """Number of a part, with its name unless that says no more, such as `3`, `voussoir-3` or `7 (keystone)`."""
    name = assembly.names[part]
    if name == str(part) or name.endswith((f"-{part}", f"_{part}")):
        return name
    return f"{part} ({name})"


def _travel(direction: NDArray[np.float64]) -> str:
    if abs(direction[2]) > STEEP:
        return "falls" if direction[2] < 0 else "lifts"
    sides = [f"{_sign(direction[axis])}{'xy'[axis]}" for axis in (0, 1) if abs(direction[axis]) > LEANS]
    words = [f"towards {' and '.join(sides)}"] if sides else []
    if abs(direction[2]) > LEANS:
        words.insert(0, "down" if direction[2] < 0 else "up")
    return f"slides {' and '.join(words)}"


def _axis(axis: NDArray[np.float64]) -> str:
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > 0.92:
        return f"{_sign(axis[largest])}{'xyz'[largest]}"
    return "the axis ({:+.2f}, {:+.2f}, {:+.2f})".format(*axis)


def _sign(value: float) -> str:
    return "+" if value > 0 else "-"

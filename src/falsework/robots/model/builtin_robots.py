"""Built-in arms: published joints and limits, with links as simple convex pieces.

Each link is one bevelled block, with sizes taken from the outer dimensions of public collision models and rounded. It
covers the convex hull of such a model to a few millimetres and exceeds it by up to 11 cm at corners. Cables and
fittings are not included: add obstacles or a wider margin for a real cell.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import block, hull, pose

Array = NDArray[np.float64]


def builtin_robot(name: str) -> RobotModel:
    """Return an arm by name.

    Raises:
        InputError: no such arm; the message lists the available ones.
    """
    if name not in BUILTIN:
        raise InputError(
            f"no built-in robot {name!r}; there are {', '.join(sorted(BUILTIN))}, or give the path of a URDF"
        )
    return BUILTIN[name]()


def irb2600_12_165() -> RobotModel:
    """Return the ABB IRB 2600-12/1.65: 12 kg, 1.65 m, spherical wrist."""
    return _arm(
        "irb2600-12/1.65",
        origins=_parallel((0, 0, 0.445), (0.15, 0, 0), (0, 0, 0.7), (0, 0, 0.115), (0.795, 0, 0), (0.085, 0, 0)),
        axes="zyyxyx",
        lower=(-180, -95, -180, -400, -120, -400),
        upper=(180, 155, 75, 400, 120, 400),
        velocity=(175, 175, 175, 360, 360, 500),
        pieces=(
            block(
                (-0.4, -0.26, 0.0),
                (0.275, 0.26, 0.23),
                x=(0.0, 0.0, 0.135, 0.135),
                y=(0.0, 0.0, 0.15, 0.0),
                z=(0.115, 0.205, 0.205, 0.115),
            ),
            block(
                (-0.215, -0.15, -0.295),
                (0.28, 0.28, 0.165),
                x=(0.0, 0.17, 0.1, 0.0),
                y=(0.0, 0.085, 0.11, 0.0),
                z=(0.105, 0.0, 0.0, 0.235),
            ),
            block(
                (-0.1, -0.24, -0.1),
                (0.1, -0.085, 0.77),
                x=(0.06, 0.065, 0.065, 0.06),
                z=(0.035, 0.035, 0.04, 0.04),
            ),
            block(
                (-0.14, -0.15, -0.115),
                (0.305, 0.19, 0.24),
                x=(0.0, 0.0, 0.1, 0.08),
                y=(0.08, 0.15, 0.0, 0.0),
                z=(0.07, 0.09, 0.12, 0.0),
            ),
            _fork(0.285, 0.795, 0.077, (-0.09, 0.08)),
            block((-0.06, -0.02, -0.06), (0.06, 0.02, 0.06), y=(0.035, 0.035, 0.035, 0.035)),
            block((-0.035, -0.035, -0.035), (0.0, 0.035, 0.035), x=(0.025, 0.025, 0.025, 0.025)),
        ),
        ignored=((4, 6),),
        flange=_ALONG_X,
        home=(0, -0.8, 0.6, 0, 1.2, 0),
        payload=12.0,
    )


def crb15000_5_095() -> RobotModel:
    """Return the ABB GoFa CRB 15000-5/0.95: 5 kg, 0.95 m, offset wrist."""
    return _arm(
        "crb15000-5/0.95",
        origins=_parallel((0, 0, 0.265), (0, 0, 0), (0, 0, 0.444), (0, 0, 0.11), (0.47, 0, 0), (0.101, 0, 0.08)),
        axes="zyyxyx",
        lower=(-180, -180, -225, -180, -180, -180),
        upper=(180, 180, 85, 180, 180, 180),
        velocity=(125, 125, 140, 200, 200, 200),
        pieces=(
            block((-0.125, -0.085, 0.0), (0.09, 0.085, 0.19), y=(0.0, 0.0, 0.0, 0.06), z=(0.035, 0.0, 0.0, 0.05)),
            block((-0.065, -0.085, -0.08), (0.065, 0.115, 0.065), y=(0.0, 0.0, 0.04, 0.04)),
            block((-0.065, -0.175, -0.065), (0.065, -0.085, 0.51), y=(0.035, 0.035, 0.035, 0.035)),
            block(
                (-0.065, -0.085, -0.065),
                (0.1, 0.115, 0.165),
                x=(0.0, 0.0, 0.095, 0.065),
                y=(0.035, 0.07, 0.0, 0.11),
                z=(0.0, 0.035, 0.045, 0.0),
            ),
            block((0.095, -0.055, -0.055), (0.52, 0.12, 0.055), x=(0.035, 0.0, 0.0, 0.035), z=(0.0, 0.125, 0.0, 0.065)),
            block(
                (-0.13, -0.095, -0.055),
                (0.07, 0.075, 0.135),
                x=(0.0, 0.0, 0.055, 0.075),
                y=(0.095, 0.045, 0.0, 0.0),
                z=(0.055, 0.0, 0.0, 0.0),
            ),
            block((-0.035, -0.055, -0.055), (0.0, 0.055, 0.055), x=(0.035, 0.035, 0.035, 0.035)),
        ),
        ignored=((4, 6),),
        flange=_ALONG_X,
        home=(0, -0.6, 0.4, 0, 1.3, 0),
        payload=5.0,
    )


def ur10e() -> RobotModel:
    """Return the Universal Robots UR10e: 12.5 kg, 1.3 m, offset wrist with three parallel axes."""
    quarter = np.pi / 2
    return _arm(
        "ur10e",
        origins=np.stack(
            [
                pose((0, 0, 0.1807), np.pi),
                _rolled((0, 0, 0), quarter),
                pose((-0.6127, 0, 0)),
                pose((-0.57155, 0, 0.17415)),
                _rolled((0, -0.11985, 0), quarter),
                _rolled((0, 0.11655, 0), -quarter),
            ]
        ),
        axes="zzzzzz",
        lower=(-360, -360, -180, -360, -360, -360),
        upper=(360, 360, 180, 360, 360, 360),
        velocity=(120, 120, 180, 180, 180, 180),
        pieces=(
            block((-0.1, -0.1, 0.0), (0.1, 0.1, 0.1), z=(0.06, 0.06, 0.06, 0.06)),
            block((-0.08, -0.095, -0.085), (0.08, 0.08, 0.095), z=(0.0, 0.0, 0.05, 0.05)),
            block((-0.675, -0.08, 0.095), (0.08, 0.08, 0.27), z=(0.055, 0.0, 0.0, 0.055)),
            block((-0.62, -0.06, -0.02), (0.06, 0.06, 0.11), x=(0.025, 0.025, 0.0, 0.0), y=(0.0, 0.075, 0.0, 0.0)),
            block((-0.05, -0.07, -0.07), (0.05, 0.06, 0.05), x=(0.025, 0.0, 0.0, 0.0), y=(0.0, 0.0, 0.03, 0.03)),
            block((-0.05, -0.06, -0.055), (0.05, 0.07, 0.05), y=(0.0, 0.0, 0.03, 0.03)),
            block((-0.045, -0.055, -0.05), (0.045, 0.045, 0.0), z=(0.035, 0.035, 0.02, 0.02)),
        ),
        ignored=((0, 2),),  # the upper arm swings beside the base and cannot collide with it
        flange=np.eye(4),
        home=(0, -1.6, 1.8, -1.8, -1.57, 0),
        payload=12.5,
    )


_ALONG_X = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
"""Flange frame whose z axis, outwards, is the x axis of the last link."""


def _parallel(*offsets: tuple[float, float, float]) -> Array:
    """Return frames that are all parallel to the base frame at zero, as in ABB's drawings, each with an offset."""
    return np.stack([pose(offset) for offset in offsets])


def _fork(back: float, axis: float, radius: float, sides: tuple[float, float]) -> Array:
    """Return a link along x with a rounded end about a joint axis along y."""
    angle = np.radians(np.arange(-75, 90, 30))
    reach = radius / np.cos(np.radians(15))
    outline = np.stack([axis + reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    outline = np.concatenate([[(back, -radius), (axis, -radius)], outline, [(axis, radius), (back, radius)]])
    return hull([(x, y, z) for y in sides for x, z in outline])


def _rolled(offset: tuple[float, float, float], angle: float) -> Array:
    """Return a frame offset from the last and rotated about x."""
    made = np.array(pose(offset))
    made[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return made


def _arm(
    name: str,
    *,
    origins: Array,
    axes: str,
    lower: tuple[float, ...],
    upper: tuple[float, ...],
    velocity: tuple[float, ...],
    pieces: tuple[Array, ...],
    ignored: tuple[tuple[int, int], ...],
    flange: Array,
    home: tuple[float, ...],
    payload: float,
) -> RobotModel:
    """Return an arm with one piece per link; limits in degrees and degrees per second, as in data sheets."""
    joints = len(origins)
    pairs = {(link, link + 1) for link in range(joints)} | set(ignored)
    speed = np.radians(velocity)
    return RobotModel(
        name=name,
        joint_names=tuple(f"joint_{j + 1}" for j in range(joints)),
        link_names=("base_link", *(f"link_{j + 1}" for j in range(joints))),
        origins=origins,
        axes=np.array([np.eye(3)["xyz".index(axis)] for axis in axes]),
        prismatic=np.zeros(joints, bool),
        lower=np.radians(lower),
        upper=np.radians(upper),
        velocity=speed,
        acceleration=speed / ACCELERATION_TIME,
        pieces=tuple((piece,) for piece in pieces),
        ignored=frozenset(pairs),
        flange=flange,
        home=np.asarray(home, float),
        payload=payload,
    )


BUILTIN: dict[str, Callable[[], RobotModel]] = {
    "irb2600-12/1.65": irb2600_12_165,
    "crb15000-5/0.95": crb15000_5_095,
    "ur10e": ur10e,
}
"""Built-in arms by their name in cell files."""

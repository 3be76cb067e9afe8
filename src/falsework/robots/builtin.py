"""Arms described here, so that examples need no files: dimensions as published, links as simple convex pieces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from falsework.errors import InputError
from falsework.robots.model import ACCELERATION_TIME, RobotModel
from falsework.robots.shapes import Pieces, block


def builtin_robot(name: str) -> RobotModel:
    """An arm by name.

    Raises:
        InputError: no such arm; the message lists those there are.
    """
    if name not in BUILTIN:
        raise InputError(
            f"no built-in robot {name!r}; there are {', '.join(sorted(BUILTIN))}, or give the path of a URDF"
        )
    return BUILTIN[name]()


def irb2600_12_165() -> RobotModel:
    """ABB IRB 2600-12/1.65: 12 kg, 1.65 m, spherical wrist."""
    degrees = np.radians
    return _arm(
        "irb2600-12/1.65",
        offsets=((0, 0, 0.445), (0.15, 0, 0), (0, 0, 0.7), (0, 0, 0.115), (0.795, 0, 0), (0.085, 0, 0)),
        axes="zyyxyx",
        lower=degrees((-180, -95, -180, -400, -120, -400)),
        upper=degrees((180, 155, 75, 400, 120, 400)),
        velocity=degrees((175, 175, 175, 360, 360, 500)),
        pieces=(
            (block((-0.405, -0.26, 0.0), (0.275, 0.26, 0.235), "z", (0.12, 0.2, 0.2, 0.12)),),
            (block((-0.215, -0.155, -0.295), (0.28, 0.285, 0.165), "z", (0.11, 0.025, 0.09, 0.24)),),
            (block((-0.105, -0.24, -0.1), (0.105, -0.085, 0.775), "z", (0.04, 0.04, 0.045, 0.045)),),
            (block((-0.14, -0.155, -0.115), (0.31, 0.195, 0.24), "y", (0.08, 0.155, 0.07, 0.035)),),
            (block((0.285, -0.09, -0.08), (0.875, 0.08, 0.08), "x", (0.045, 0.02, 0.02, 0.045)),),
            (block((-0.06, -0.025, -0.06), (0.06, 0.025, 0.06), "y", (0.035, 0.035, 0.035, 0.035)),),
            (block((-0.035, -0.035, -0.035), (0.0, 0.035, 0.035), "x", (0.025, 0.025, 0.025, 0.025)),),
        ),
        ignored=((3, 5), (4, 6)),
        home=(0, -0.8, 0.6, 0, 1.2, 0),
        payload=12.0,
    )


def _arm(
    name: str,
    *,
    offsets: tuple[tuple[float, float, float], ...],
    axes: str,
    lower: np.ndarray,
    upper: np.ndarray,
    velocity: np.ndarray,
    pieces: tuple[Pieces, ...],
    ignored: tuple[tuple[int, int], ...],
    home: tuple[float, ...],
    payload: float,
) -> RobotModel:
    """An arm whose link frames are all parallel to that of the base at zero, as ABB draws them; flange along x."""
    joints = len(offsets)
    origins = np.tile(np.eye(4), (joints, 1, 1))
    origins[:, :3, 3] = offsets
    flange = np.eye(4)
    flange[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z outwards, along x of the last link
    pairs = {(link, link + 1) for link in range(joints)} | set(ignored)
    return RobotModel(
        name=name,
        joint_names=tuple(f"joint_{j + 1}" for j in range(joints)),
        link_names=("base_link", *(f"link_{j + 1}" for j in range(joints))),
        origins=origins,
        axes=np.array([np.eye(3)["xyz".index(axis)] for axis in axes]),
        prismatic=np.zeros(joints, bool),
        lower=np.asarray(lower, float),
        upper=np.asarray(upper, float),
        velocity=np.asarray(velocity, float),
        acceleration=np.asarray(velocity, float) / ACCELERATION_TIME,
        pieces=pieces,
        ignored=frozenset(pairs),
        flange=flange,
        home=np.asarray(home, float),
        payload=payload,
    )


BUILTIN: dict[str, Callable[[], RobotModel]] = {"irb2600-12/1.65": irb2600_12_165}
"""Arms by the name that a cell file calls them."""

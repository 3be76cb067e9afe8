"""Built-in arms: published joints and limits in `arms.toml`, with links as simple convex pieces.

Each link is one bevelled block, with sizes taken from the outer dimensions of public collision models and rounded. It
covers the convex hull of such a model to a few millimetres and exceeds it by up to 11 cm at corners. Cables and
fittings are not included: add obstacles or a wider margin for a real cell.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from falsework.errors import InputError
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import Array, block, hull, pose

BUILTIN: dict[str, dict[str, Any]] = tomllib.loads(
    files("falsework.robots.model").joinpath("arms.toml").read_text(encoding="utf-8")
)
"""Descriptions of built-in arms by their name in cell files."""
_FLANGES = {"x": np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]), "z": np.eye(4)}
"""Flange frames whose z axis, outwards, is an axis of the last link."""


@cache
def builtin_robot(name: str) -> RobotModel:
    """Return an arm by name; the InputError for another name lists the available ones."""
    if name not in BUILTIN:
        raise InputError(
            f"no built-in robot {name!r}; there are {', '.join(sorted(BUILTIN))}, or give the path of a URDF"
        )
    arm = BUILTIN[name]
    joints, speed = len(arm["joints"]), np.radians(arm["velocity"])
    level = [0] * joints
    frames = zip(arm["offsets"], arm.get("yaws", level), arm.get("rolls", level), strict=True)
    return RobotModel(
        name=name,
        joint_names=tuple(arm["joints"]),
        link_names=("base_link", *(f"link_{j + 1}" for j in range(joints))),
        origins=np.stack([_frame(*given) for given in frames]),
        axes=np.array([np.eye(3)["xyz".index(axis)] for axis in arm["axes"]]),
        prismatic=np.zeros(joints, bool),
        lower=np.radians(arm["lower"]),
        upper=np.radians(arm["upper"]),
        velocity=speed,
        acceleration=speed / ACCELERATION_TIME,
        pieces=tuple((_fork(**link["fork"]) if "fork" in link else block(**link),) for link in arm["links"]),
        ignored=frozenset({(link, link + 1) for link in range(joints)} | {(a, b) for a, b in arm["ignored"]}),
        flange=_FLANGES[arm["flange"]],
        home=np.asarray(arm["home"], float),
        payload=arm["payload"],
    )


def _frame(offset: list[float], yaw: int, roll: int) -> Array:
    made, angle = np.array(pose(offset, yaw * (np.pi / 2))), roll * (np.pi / 2)
    if roll:
        made[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return made


def _fork(back: float, axis: float, radius: float, sides: list[float]) -> Array:
    """Return a link along x with a rounded end about a joint axis along y."""
    angle = np.radians(np.arange(-75, 90, 30))
    reach = radius / np.cos(np.radians(15))
    outline = np.stack([axis + reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    outline = np.concatenate([[(back, -radius), (axis, -radius)], outline, [(axis, radius), (back, radius)]])
    return hull([(x, y, z) for y in sides for x, z in outline])

"""MoveIt's `joint_limits.yaml`: limits of position, velocity and acceleration beside those of a URDF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import CellError, DependencyError
from falsework.utils.arrays import Array

_KINDS = ("position", "velocity", "acceleration")
_UNUSED = ("jerk", "deceleration", "effort")
_TAGS = {"!degrees": math.pi / 180, "!radians": 1.0}
"""Units that ROS packages write before an angle."""


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Limits of the joints of an arm; NaN where the file has none. All have the shape (joints,)."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    notes: tuple[str, ...]
    """What of the file is not used."""


def read_joint_limits(file: Path, joints: Sequence[str]) -> JointLimits:
    """Read the limits of some joints from a YAML file with `joint_limits` by joint, as MoveIt has it.

    Raises:
        CellError: the file cannot be read, or a limit is no number above zero; the message names file and joint.
        DependencyError: PyYAML is missing.
    """
    content = _parse(file)
    table = content.get("joint_limits") if isinstance(content, dict) else None
    if not isinstance(table, dict):
        raise CellError(f"{file} has no joint_limits; give MoveIt's joint_limits.yaml")
    found = {key: np.full(len(joints), np.nan) for key in ("lower", "upper", "velocity", "acceleration")}
    unused: dict[str, None] = {}
    strangers = []
    for name, entry in table.items():
        # Packages of makers leave the ending of the names out: `shoulder_pan` is `shoulder_pan_joint`.
        known = next((joint for joint in joints if joint in (name, f"{name}_joint")), None)
        if known is None:
            strangers.append(str(name))
            continue
        if not isinstance(entry, dict):
            raise CellError(f"{file}: joint {name} is {entry!r}; give a table of limits")
        row = list(joints).index(known)
        for kind in _KINDS:
            if entry.get(f"has_{kind}_limits") is not True:
                continue
            if kind == "position":
                low, high = (_number(file, name, entry, f"{end}_position") for end in ("min", "max"))
                if not low < high:
                    raise CellError(
                        f"{file}: joint {name} has min_position {low:g} and max_position {high:g}; it needs a range"
                    )
                found["lower"][row], found["upper"][row] = low, high
            else:
                found[kind][row] = _number(file, name, entry, f"max_{kind}", above_zero=True)
        unused |= dict.fromkeys(f"{kind} limits" for kind in _UNUSED if entry.get(f"has_{kind}_limits") is True)
    unused |= dict.fromkeys(str(key) for key in content if key != "joint_limits")
    notes = [f"{file}: there are no joints {', '.join(strangers)}"] if strangers else []
    if unused:
        notes.append(f"{file}: entries that are not used: {', '.join(unused)}; speed of the cell scales velocities")
    return JointLimits(**found, notes=tuple(notes))


def _number(file: Path, joint: object, entry: dict[Any, Any], key: str, *, above_zero: bool = False) -> float:
    value = entry.get(key)
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    if not good or (above_zero and not value > 0):
        raise CellError(f"{file}: joint {joint} has {key} {value!r}; give a number{' above zero' * above_zero}")
    return float(value)


def _parse(file: Path) -> Any:
    try:
        import yaml
    except ImportError as error:
        raise DependencyError("reading joint_limits.yaml needs PyYAML: pip install 'falsework[robots]'") from error

    class Loader(yaml.SafeLoader):
        """Loader of plain values that knows units of angles."""

    for tag, factor in _TAGS.items():
        Loader.add_constructor(tag, lambda loader, node, factor=factor: factor * float(loader.construct_scalar(node)))
    try:
        return yaml.load(file.read_text(encoding="utf-8"), Loader)
    except (yaml.YAMLError, OSError, ValueError) as error:
        text = " ".join(str(getattr(error, "strerror", None) or error).split())
        raise CellError(f"joint limits {file} cannot be read: {text}") from error

"""MoveIt's files beside a URDF: SRDF with pairs of links and named configurations, and `joint_limits.yaml`."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import CellError
from falsework.robots.model.shapes import Array
from falsework.utils.files.input_file import read_text
from falsework.utils.lazy import importing

Element = ElementTree.Element
_KINDS = ("position", "velocity", "acceleration")
_UNUSED = ("jerk", "deceleration", "effort")
_TAGS = {"!degrees": math.pi / 180, "!radians": 1.0}
"""Units that ROS packages write before an angle."""


def read_srdf(srdf: Path) -> Element:
    """Return the root element of an SRDF; CellError if the file cannot be read."""
    try:
        return ElementTree.parse(srdf).getroot()
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise CellError(f"{srdf} cannot be read: {' '.join(str(error).split())}") from error


def group_states(srdf: Path, root: Element, joints: Sequence[str]) -> tuple[dict[str, Array], list[str]]:
    """Return the named configurations that give every joint of an arm a value, and notes on the others.

    States of several groups that have the same name, such as `home` of the arm and of the hand, are one.
    """
    values: dict[str, dict[str, float]] = {}
    for state in root.iter("group_state"):
        for joint in state.findall("joint"):
            name, text = joint.get("name", ""), joint.get("value", "")
            if name not in joints:
                continue
            try:
                number = float(text)
            except ValueError:
                number = math.nan
            if not math.isfinite(number):
                raise CellError(
                    f"{srdf}: state {state.get('name')} has the value {text!r} for joint {name}; give one number"
                )
            values.setdefault(state.get("name", ""), {})[name] = number
    found, notes = {}, []
    for name, given in values.items():
        if len(given) == len(joints):
            found[name] = np.array([given[joint] for joint in joints])
        else:
            lacking = ", ".join(joint for joint in joints if joint not in given)
            notes.append(f"{srdf}: state {name} has no value for {lacking}, so it is not used")
    return found, notes


def excluded_pairs(
    srdf: Path, root: Element, carried: Mapping[int, list[str]], links: Iterable[str]
) -> tuple[set[tuple[int, int]], list[str]]:
    """Return pairs of moving links that an SRDF excludes from collision checking, and what of it is not used.

    `carried` has the links with shapes that move with each moving link as one body. Two bodies are excluded only if
    every shape of one is excluded against every shape of the other.
    """
    known = set(links)
    named, enabled = (
        {frozenset((entry.get("link1", ""), entry.get("link2", ""))) for entry in root.iter(tag)}
        for tag in ("disable_collisions", "enable_collisions")
    )
    unknown, pairs = sorted(frozenset().union(*named) - known), named - enabled
    found, partly = set(), []
    for a, mine in carried.items():
        for b, theirs in carried.items():
            if not a < b or not mine or not theirs:
                continue
            excluded = [frozenset((one, other)) in pairs for one in mine for other in theirs]
            if all(excluded):
                found.add((a, b))
            elif any(excluded) and b > a + 1:  # neighbours are not checked against each other anyway
                partly.append(f"{mine[0]} and {theirs[0]}")
    notes = [f"{srdf}: there are no links {', '.join(unknown)}"] if unknown else []
    if partly:
        notes.append(
            f"{srdf} excludes some links only of bodies that move as one; they stay checked: {', '.join(partly)}"
        )
    return found, notes


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
    """Read the limits of some joints from a YAML file with `joint_limits` by joint, as MoveIt has it."""
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
    with importing("reading joint_limits.yaml needs PyYAML: pip install 'falsework[robots]'"):
        import yaml

    class Loader(yaml.SafeLoader):
        """Loader of plain values that knows units of angles."""

    for tag, factor in _TAGS.items():
        Loader.add_constructor(tag, lambda loader, node, factor=factor: factor * float(loader.construct_scalar(node)))
    try:
        return yaml.load(read_text(file), Loader)
    except (yaml.YAMLError, OSError, ValueError) as error:
        text = " ".join(str(getattr(error, "strerror", None) or error).split())
        raise CellError(f"joint limits {file} cannot be read: {text}") from error

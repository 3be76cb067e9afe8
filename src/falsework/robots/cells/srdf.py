"""SRDF files: pairs of links that are never checked, and named configurations."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from falsework.errors import CellError
from falsework.utils.arrays import Array

Element = ElementTree.Element


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
    named = [(entry.get("link1", ""), entry.get("link2", "")) for entry in root.iter("disable_collisions")]
    unknown = sorted({link for pair in named for link in pair} - known)
    pairs = {frozenset(pair) for pair in named} - enabled_pairs(root)
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


def enabled_pairs(root: Element) -> set[frozenset[str]]:
    """Return the pairs of links that an SRDF lets be checked, whatever else it says of them."""
    return {frozenset((entry.get("link1", ""), entry.get("link2", ""))) for entry in root.iter("enable_collisions")}

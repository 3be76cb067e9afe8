"""Review of a URDF file as plain XML: what cannot be an arm is refused, what is not used is named.

Libraries that read URDF files skip what they do not know, such as other shapes, and let later links of a name replace
earlier ones.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from falsework.errors import CellError

Element = ElementTree.Element

SHAPES = ("box", "cylinder", "sphere", "mesh")
_USED = {"parent", "child", "origin", "axis", "limit", "mimic", "safety_controller", "visual", "collision"}
"""Entries of links and joints that are used, or refused where they cannot be."""
_LOOKS = {"material"}
"""Entries that only concern how an arm looks."""
_ONCE = ("parent", "child", "origin", "axis", "limit", "mimic", "safety_controller", "geometry")
"""Entries of a joint or a shape of which there may be one: libraries take the first or the last."""
_NUMBERS = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3, "radius": 1, "length": 1}
"""Attributes of places and shapes, and how many numbers they have."""


class CellWarning(UserWarning):
    """Warning that something in a cell or a robot description is not used, or used in another way than written."""


def read_xml(file: Path) -> Element:
    """Return the root element of a URDF file.

    Raises:
        CellError: the file cannot be read, has macros, names that are not unique or not known, links that are below
            each other, a link with two parents, entries that occur twice, or shapes and numbers that are none; the
            message names them.
    """
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise CellError(f"{file} is not a readable URDF: {' '.join(str(error).split())}") from error
    for entry in root.iter():
        values = (entry.tag, *entry.attrib.values())
        if any("xacro" in value or "${" in value or "$(" in value for value in map(str, values)):
            raise CellError(
                f"{file} has macros ({_plain(entry.tag)}); expand them first: xacro {file.name} > plain.urdf"
            )
    if root.tag != "robot":
        raise CellError(f"{file} is not a readable URDF: its root is <{root.tag}>, not <robot>")
    links, joints = ([_name(file, entry, root.tag) for entry in root.findall(kind)] for kind in ("link", "joint"))
    for kind, names in (("links", links), ("joints", joints)):
        double = [name for name, count in Counter(names).items() if count > 1]
        if double:
            raise CellError(f"{file}: two {kind} are called {double[0]!r}; give each its own name")
    above: dict[str, str] = {}
    for joint, name in zip(root.findall("joint"), joints, strict=True):
        for which in ("parent", "child"):
            end = joint.find(which)
            link = None if end is None else end.get("link")
            if link not in links:
                raise CellError(f"{file}: the {which} of joint {name} is {link!r}, which is no link")
            if which == "child" and link in above:
                raise CellError(f"{file}: link {link} is the child of joints {above[link]} and {name}; keep one")
            if which == "child" and link is not None:
                above[link] = name
    _check_tree(file, root)
    for link, name in zip(root.findall("link"), links, strict=True):
        for collision in (*link.findall("collision"), *link.findall("visual")):
            kinds = [kind.tag for geometry in collision.findall("geometry") for kind in geometry]
            if len(kinds) != 1 or kinds[0] not in SHAPES:
                what = " and ".join(kinds) or "nothing"
                raise CellError(f"{file}: a shape of link {name} is {what}; give one of {', '.join(SHAPES)}")
            _check_entries(file, collision, f"a shape of link {name}")
    for joint, name in zip(root.findall("joint"), joints, strict=True):
        _check_entries(file, joint, f"joint {name}")
    return root


def _check_tree(file: Path, root: Element) -> None:
    """Refuse links that are below each other, around which a search for the base would go for ever."""
    above = {_end(joint, "child"): _end(joint, "parent") for joint in root.findall("joint")}
    for link in above:
        passed = [link]
        while passed[-1] in above:
            passed.append(above[passed[-1]])
            if passed[-1] in passed[:-1]:
                loop = passed[passed.index(passed[-1]) + 1 :]
                raise CellError(f"{file}: links are below each other: {', '.join(loop)}; an arm is a tree of links")


def _end(joint: Element, which: str) -> str:
    end = joint.find(which)
    return "" if end is None else end.get("link", "")


def _check_entries(file: Path, holder: Element, what: str) -> None:
    """Refuse entries of a joint or a shape that occur twice, and numbers that are none or too few."""
    for tag in _ONCE:
        if len(holder.findall(tag)) > 1:
            raise CellError(f"{file}: {what} has two entries <{tag}>; keep one")
    for entry in holder.iter():
        for name, count in _NUMBERS.items():
            text = entry.get(name)
            if text is None or entry.tag not in (*SHAPES, "origin", "axis"):
                continue
            try:
                values = [float(word) for word in text.split()]
            except ValueError:
                values = []
            size = name in ("size", "radius", "length")
            if len(values) != count or not all(math.isfinite(x) and (x > 0 or not size) for x in values):
                kind = f"{'three numbers' if count == 3 else 'a number'}{' above zero' if size else ''}"
                raise CellError(f"{file}: {what} has {name}={text!r} in <{entry.tag}>; give {kind}")


def unused_text(root: Element) -> str:
    """Return which entries of a URDF are not used, such as `inertial (7)`; empty if all are."""
    counts: Counter[str] = Counter()
    for entry in root:
        if entry.tag in ("link", "joint"):
            counts.update(_plain(part.tag) for part in entry if part.tag not in _USED | _LOOKS)
            counts["effort"] += sum("effort" in limit.attrib for limit in entry.findall("limit"))
        elif entry.tag not in _LOOKS:
            counts[_plain(entry.tag)] += 1
    return ", ".join(f"{tag} ({count})" for tag, count in sorted(counts.items()) if count)


def coupling_fault(joints: Iterable[Any], chain: Iterable[Any], moved: Iterable[str]) -> str:
    """Return which joint follows another one with an effect on the arm; empty if there is none.

    A plan gives every joint of the chain its own values, and takes joints beside it as fixed.

    Args:
        joints: all joints, as yourdfpy reads them.
        chain: those from the base to the tip.
        moved: names of joints beside the chain that carry shapes.
    """
    names, carrying = {joint.name for joint in chain}, set(moved)
    leader_of = {joint.name: joint.mimic.joint for joint in joints if joint.mimic is not None}
    for joint in joints:
        if joint.mimic is None:
            continue
        if joint.name in names:
            return (
                f"joint {joint.name} follows joint {joint.mimic.joint} (mimic); plans move every joint on its own: "
                "choose a base_link and tip_link between which no joint follows another, or another arm"
            )
        if joint.name not in carrying:
            continue
        leads = [joint.mimic.joint]
        while leads[-1] in leader_of and leader_of[leads[-1]] not in leads:
            leads.append(leader_of[leads[-1]])
        moving = next((lead for lead in leads if lead in names), None)
        if moving is not None:
            return (
                f"joint {joint.name} beside the arm follows joint {moving} of the arm (mimic), so that its "
                f"links would be elsewhere: remove them and cover their motion by shapes of link {joint.parent}"
            )
        if joint.mimic.offset:
            return (
                f"joint {joint.name} beside the arm follows joint {leads[0]} (mimic) with an offset of "
                f"{joint.mimic.offset:g}, but joints beside the arm are taken at zero: fix it where it is"
            )
    return ""


def soft_range(joint: Any) -> tuple[float, float]:
    """Return the range that the safety controller of a joint allows, rad or m; infinite without one."""
    control = joint.safety_controller
    # The format has 0 for limits that are not given.
    low = 0.0 if control is None else float(control.soft_lower_limit or 0.0)
    high = 0.0 if control is None else float(control.soft_upper_limit or 0.0)
    return (low, high) if low or high else (-math.inf, math.inf)


def excluded_pairs(
    srdf: Path, carried: Mapping[int, list[str]], links: Iterable[str]
) -> tuple[set[tuple[int, int]], list[str]]:
    """Return pairs of moving links that an SRDF excludes from collision checking, and what of it is not used.

    Links that move together are one body of the arm. Two bodies are excluded only if every shape of one is excluded
    against every shape of the other.

    Args:
        srdf: the file.
        carried: for each moving link, the links with shapes that move with it.
        links: names of all links of the URDF.

    Raises:
        CellError: the file cannot be read.
    """
    try:
        root = ElementTree.parse(srdf).getroot()
    except (ElementTree.ParseError, OSError, ValueError) as error:
        raise CellError(f"{srdf} cannot be read: {' '.join(str(error).split())}") from error
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


def _name(file: Path, entry: Element, root: str) -> str:
    name = entry.get("name")
    if not name:
        raise CellError(f"{file}: a {entry.tag} of its {root} has no name")
    return name


def _plain(tag: str) -> str:
    """Return a tag without the address of its namespace."""
    return str(tag).rpartition("}")[2]

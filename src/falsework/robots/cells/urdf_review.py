"""Review of a URDF file as plain XML: what cannot be an arm is refused, what is not used is named.

Libraries that read URDF files skip what they do not know, such as other shapes, and let later links of a name replace
earlier ones.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import CellError
from falsework.utils.files.xml_text import read_xml_text

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
    """Return the root element of a URDF file; the CellError for one that describes no arm names what is wrong."""
    try:
        root = ElementTree.fromstring(read_xml_text(file))
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
    above: dict[str, tuple[str, str]] = {}
    for joint, name in zip(root.findall("joint"), joints, strict=True):
        parent, child = (_end(file, joint, which, links) for which in ("parent", "child"))
        if child in above:
            raise CellError(f"{file}: link {child} is the child of joints {above[child][0]} and {name}; keep one")
        above[child] = name, parent
    try:  # around links that are below each other a search for the base would go for ever
        TopologicalSorter({child: [parent] for child, (_, parent) in above.items()}).prepare()
    except CycleError as error:
        loop = ", ".join(error.args[1][1:])
        raise CellError(f"{file}: links are below each other: {loop}; an arm is a tree of links") from None
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


def _end(file: Path, joint: Element, which: str, links: Sequence[str]) -> str:
    end = joint.find(which)
    link = None if end is None else end.get("link")
    if link is None or link not in links:
        raise CellError(f"{file}: the {which} of joint {joint.get('name')} is {link!r}, which is no link")
    return link


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


def accelerations(file: Path, root: Element, joints: Sequence[str]) -> NDArray[np.float64]:
    """Return the acceleration limits that `<limit>` of joints has, as Drake writes them; NaN where it has none.

    rad/s2 or m/s2, shape (joints,). CellError for one that is no number above zero.
    """
    found = dict.fromkeys(joints, math.nan)
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        for limit in joint.findall("limit"):
            for key, text in limit.attrib.items():
                if _plain(key) != "acceleration" or name not in found:
                    continue
                try:
                    found[name] = float(text)
                except ValueError:
                    found[name] = -1.0
                if not 0 < found[name] < math.inf:
                    raise CellError(f"{file}: joint {name} has acceleration {text!r}; give a number above zero")
    return np.array([found[joint] for joint in joints])


def coupling_fault(joints: Iterable[Any], chain: Iterable[Any], moved: Iterable[str]) -> str:
    """Return which joint follows another one with an effect on the arm; empty if there is none.

    A plan gives every joint of the chain its own values, and takes joints beside it as fixed; those that are `moved`
    carry shapes.
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


def _name(file: Path, entry: Element, root: str) -> str:
    name = entry.get("name")
    if not name:
        raise CellError(f"{file}: a {entry.tag} of its {root} has no name")
    return name


def _plain(tag: str) -> str:
    """Return a tag without the address of its namespace."""
    return str(tag).rpartition("}")[2]

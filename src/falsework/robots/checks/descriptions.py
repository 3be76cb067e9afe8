"""Check of arms against their URDF files, as Pinocchio reads them: joints, limits, frames, shapes and pairs."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from falsework.robots.checks.pinocchio_checker import convex_shape, import_pinocchio
from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array
from falsework.utils.files.xml_text import read_xml_text
from falsework.utils.quantity import format_number

_SAMPLES = 8
"""Random configurations in which the frames of both readings are compared."""
_TOUCH_SAMPLES, _TOUCH_SHARE = 200, 0.85
"""Random configurations in which links are compared that are not checked against each other, and in what share of them
they must touch: less than the reader of cells asks for, since the configurations are others."""
_SAME = 1e-6
"""Largest difference of poses and limits, m, rad, rad/s."""


def description_fault(model: RobotModel) -> str:
    """Return how an arm differs from the URDF file that it was read from; empty if it does not, or is built in.

    The file is read again by Pinocchio, which shares no code with the reader of cells.
    """
    if model.source == "built-in":
        return ""
    file = Path(model.source)
    if not file.is_file():
        return f"its description {file} is gone; nothing proves that the cell has this arm"
    pinocchio, _ = import_pinocchio()
    try:
        root = ElementTree.fromstring(read_xml_text(file))
        for limit in root.iter("limit"):  # which is not used, and without which Pinocchio reads nothing
            limit.attrib.setdefault("effort", "0")
        read = pinocchio.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"), True)
    except Exception as error:  # of its parser, of no common class
        return f"its description {file} cannot be read by Pinocchio: {' '.join(str(error).split())}"
    return (
        _joint_fault(model, read, file)
        or _frame_fault(pinocchio, model, read, file)
        or _shape_fault(model, root, file)
        or _pair_fault(model, root, file)
    )


def _joint_fault(model: RobotModel, read: Any, file: Path) -> str:
    names = list(read.names)
    for number, name in enumerate(model.joint_names):
        if name not in names:
            return f"{file.name} has no moving joint {name}"
        joint = read.joints[names.index(name)]
        if "Mimic" in joint.shortname():
            return f"{file.name}: joint {name} follows another joint and is planned as one of its own"
        if joint.nv != 1:
            return f"{file.name}: joint {name} has {joint.nv} degrees of freedom, it is planned with one"
        if joint.nq == 1:
            low, high = (float(limits[joint.idx_q]) for limits in (read.lowerPositionLimit, read.upperPositionLimit))
            if model.lower[number] < low - _SAME or model.upper[number] > high + _SAME:
                return (
                    f"{file.name}: joint {name} has the range {format_number(low, 4)} to "
                    f"{format_number(high, 4)}, it is planned with more"
                )
        fastest = float(read.upperVelocityLimit[joint.idx_v])
        if model.velocity[number] > fastest + _SAME:
            return (
                f"{file.name}: joint {name} is limited to {format_number(fastest, 4)} rad/s or m/s, it is "
                f"planned with more"
            )
    return ""


def _frame_fault(pinocchio: Any, model: RobotModel, read: Any, file: Path) -> str:
    """Return which link is elsewhere in the other reading when the same joints have the same values."""
    data, rng = read.createData(), np.random.default_rng(0)
    frames = {frame.name: index for index, frame in enumerate(read.frames) if "BODY" in str(frame.type)}
    for name in model.link_names:
        if name not in frames:
            return f"{file.name} has no link {name}"
    last = frames[model.link_names[-1]]
    for _ in range(_SAMPLES):
        values, pose = rng.uniform(model.lower, model.upper), pinocchio.neutral(read)
        for name, value in zip(model.joint_names, values, strict=True):
            joint = read.joints[read.getJointId(name)]
            pose[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
        pinocchio.framesForwardKinematics(read, data, pose)
        base = data.oMf[frames[model.link_names[0]]].homogeneous
        at = base
        for number, name in enumerate(model.link_names[1:]):
            at = at @ model.origins[number] @ _moved(model.axes[number], values[number], bool(model.prismatic[number]))
            if np.abs(at - data.oMf[frames[name]].homogeneous).max() > _SAME:
                return f"{file.name}: link {name} is elsewhere than it is planned with"
        flange, wrist = at @ model.flange, read.frames[last].parentJoint
        ends = [index for index in frames.values() if read.frames[index].parentJoint == wrist]
        if min(np.abs(data.oMf[index].homogeneous - flange).max() for index in ends) > _SAME:
            return f"{file.name} has no link where the gripper is mounted"
    return ""


def _shape_fault(model: RobotModel, root: ElementTree.Element, file: Path) -> str:
    """Return whether an arm has fewer shapes than the links of the file that it carries."""
    for number, (name, links) in enumerate(zip(model.link_names, _carried(model, root), strict=True)):
        wanted = sum(len(link.findall("collision")) or len(link.findall("visual")) for link in links)
        has = len(model.pieces[number]) if model.meshes is None else len(model.meshes[number])
        if has < wanted:
            return f"{file.name}: link {name} has {wanted} shapes, it is checked with {has}"
    return ""


def _pair_fault(model: RobotModel, root: ElementTree.Element, file: Path) -> str:
    """Return which links are not checked against each other, although no SRDF says so, and they can keep apart."""
    srdf, carried = Path(model.srdf or file.with_suffix(".srdf")), _carried(model, root)
    apart = sorted((a, b) for a, b in model.ignored if b > a + 1 and carried[a] and carried[b])
    excluded = set()
    if srdf.is_file():
        named = ElementTree.parse(srdf).getroot()
        pairs, again = (
            {frozenset((entry.get("link1"), entry.get("link2"))) for entry in named.iter(tag)}
            for tag in ("disable_collisions", "enable_collisions")
        )
        pairs -= again
        excluded = {
            (a, b)
            for a, b in apart
            if all(frozenset((i.get("name"), j.get("name"))) in pairs for i in carried[a] for j in carried[b])
        }
    elif apart:
        excluded = _touching(model, apart)
    for a, b in apart:
        if (a, b) not in excluded:
            return f"{file.name}: links {model.link_names[a]} and {model.link_names[b]} are not checked for collisions"
    return ""


def _touching(model: RobotModel, pairs: list[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs of links that touch in nearly all of some random configurations, by Coal."""
    _, coal = import_pinocchio()
    hulls = [[convex_shape(piece) for piece in link] for link in model.pieces]
    rng, hits = np.random.default_rng(1), dict.fromkeys(pairs, 0)
    for _ in range(_TOUCH_SAMPLES):
        poses = [np.eye(4)]
        for number, value in enumerate(rng.uniform(model.lower, model.upper)):
            moved = _moved(model.axes[number], value, bool(model.prismatic[number]))
            poses.append(poses[-1] @ model.origins[number] @ moved)
        at = [coal.Transform3s(pose[:3, :3], pose[:3, 3]) for pose in poses]
        for a, b in pairs:
            hits[a, b] += any(
                coal.collide(one, at[a], other, at[b], coal.CollisionRequest(), coal.CollisionResult())
                for one in hulls[a]
                for other in hulls[b]
            )
    return {pair for pair, count in hits.items() if count >= _TOUCH_SHARE * _TOUCH_SAMPLES}


def _carried(model: RobotModel, root: ElementTree.Element) -> list[list[ElementTree.Element]]:
    """Return for each moving link the links with shapes that move with it."""
    above = {j.find("child").get("link"): j.find("parent").get("link") for j in root.findall("joint")}  # type: ignore[union-attr]
    moved = {name: number for number, name in enumerate(model.link_names)}
    found: list[list[ElementTree.Element]] = [[] for _ in moved]
    for link in root.findall("link"):
        name: str | None = link.get("name")
        while name is not None and name not in moved:
            name = above.get(name)
        if name is not None and (link.find("collision") is not None or link.find("visual") is not None):
            found[moved[name]].append(link)
    return found


def _moved(axis: Array, value: float, slides: bool) -> Array:
    """Return the motion of a joint, shape (4, 4)."""
    made = np.eye(4)
    if slides:
        made[:3, 3] = value * axis
        return made
    made[:3, :3] = Rotation.from_rotvec(value * axis).as_matrix()
    return made

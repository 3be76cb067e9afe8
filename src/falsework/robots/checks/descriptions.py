"""Check of arms against their URDF files, as Pinocchio reads them: joints, couplings, limits, frames and shapes."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.robots.checks.libraries import import_pinocchio
from falsework.robots.model.robot_model import RobotModel

Array = NDArray[np.float64]

_SAMPLES = 8
"""Random configurations in which the frames of both readings are compared."""
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
        root = ElementTree.parse(file).getroot()
        for limit in root.iter("limit"):  # which is not used, and without which Pinocchio reads nothing
            limit.attrib.setdefault("effort", "0")
        read = pinocchio.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"), True)
    except Exception as error:  # of its parser, of no common class
        return f"its description {file} cannot be read by Pinocchio: {' '.join(str(error).split())}"
    return _joint_fault(model, read, file) or _frame_fault(pinocchio, model, read, file) or _shape_fault(model, file)


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
                return f"{file.name}: joint {name} has the range {low:.4g} to {high:.4g}, it is planned with more"
        fastest = float(read.upperVelocityLimit[joint.idx_v])
        if model.velocity[number] > fastest + _SAME:
            return f"{file.name}: joint {name} is limited to {fastest:.4g} rad/s or m/s, it is planned with more"
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


def _shape_fault(model: RobotModel, file: Path) -> str:
    """Return whether an arm has fewer shapes than the links of the file that it carries."""
    root = ElementTree.parse(file).getroot()
    above = {j.find("child").get("link"): j.find("parent").get("link") for j in root.findall("joint")}  # type: ignore[union-attr]
    moved = {name: number for number, name in enumerate(model.link_names)}
    wanted = [0] * len(model.link_names)
    for link in root.findall("link"):
        name: str | None = link.get("name")
        while name is not None and name not in moved:
            name = above.get(name)
        if name is not None:
            wanted[moved[name]] += len(link.findall("collision")) or len(link.findall("visual"))
    for number, name in enumerate(model.link_names):
        has = len(model.pieces[number]) if model.meshes is None else len(model.meshes[number])
        if has < wanted[number]:
            return f"{file.name}: link {name} has {wanted[number]} shapes, it is checked with {has}"
    return ""


def _moved(axis: Array, value: float, slides: bool) -> Array:
    """Return the motion of a joint, shape (4, 4)."""
    made = np.eye(4)
    if slides:
        made[:3, 3] = value * axis
        return made
    cross = np.cross(np.eye(3), axis)
    made[:3, :3] = np.eye(3) + np.sin(value) * cross + (1 - np.cos(value)) * (cross @ cross)
    return made

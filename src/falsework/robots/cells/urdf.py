"""URDF reader: the joint chain from base to tip, with the convex hulls of the collision shapes.

What a file states and is not used, or used in another way than written, is a `CellWarning` that names it.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Container, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import CellError
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.cells.moveit_files import JointLimits, excluded_pairs, group_states, read_joint_limits, read_srdf
from falsework.robots.cells.urdf_meshes import collision_shapes
from falsework.robots.cells.urdf_review import (
    CellWarning,
    accelerations,
    coupling_fault,
    read_xml,
    soft_range,
    unused_text,
)
from falsework.robots.kernels.collision import Rules, check_many, make_query
from falsework.robots.kernels.kernel_arrays import make_bodies, make_chain, make_obstacles, self_pairs
from falsework.robots.model.cell import CellRobot, Gripper
from falsework.robots.model.robot_model import ACCELERATION_TIME, RobotModel
from falsework.robots.model.shapes import Array, outer_hull
from falsework.utils.files.damage import blamed_on
from falsework.utils.files.xml_text import read_xml_text
from falsework.utils.lazy import importing

COLLISION_SAMPLES = 1000
"""Random configurations in which pairs of links are tested where no SRDF lists the pairs to ignore."""
LIMITS_FILE = "joint_limits.yaml"
"""File beside a description that is read with it."""
HOME_STATE = "home"
"""Name of the state of an SRDF that is the home configuration."""
_TIPS = ("tool0", "flange")
"""Usual names of the link that a gripper is mounted on, in this order."""
ALWAYS_SHARE = 0.95
"""Pairs that touch in this share of them are ignored: their hulls overlap at their common joint."""


def load_urdf(
    path: str | Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    srdf: str | Path | None = None,
    joint_limits: str | Path | None = None,
) -> RobotModel:
    """Read an arm. Ignored pairs of links come from an SRDF, else from random configurations.

    Acceleration limits come from MoveIt's `joint_limits.yaml`, or the attribute `acceleration` of Drake in the URDF;
    other joints are taken to reach full speed in `ACCELERATION_TIME`.

    Args:
        path: URDF file; mesh paths are relative to it.
        base: name of the base link; by default the root of the file.
        tip: name of the link that a gripper is mounted on; by default `tool0` or `flange`, else the end of the
            longest chain, or where its fingers begin.
        srdf: SRDF with ignored pairs and named configurations, of which `home` is the home configuration; by default
            the file of the same name beside the URDF, if there is one.
        joint_limits: limits that narrow those of the URDF; by default `joint_limits.yaml` beside it, if there is one.

    Warns:
        CellWarning: entries that are not used, shapes and pairs of links that are replaced or left out.

    Raises:
        CellError: the file cannot be read, or does not describe an arm that plans can move; the message names file and
            joint or link.
        DependencyError: yourdfpy is missing.
    """
    file = Path(path)
    if not file.is_file():
        raise CellError(f"no robot description {file}; give a URDF file or a built-in robot")
    for given, what in ((srdf, "SRDF"), (joint_limits, "joint limits")):
        if given is not None and not Path(given).is_file():
            raise CellError(f"{file}: no {what} {given}; give a file, or leave it out")
    states = file.with_suffix(".srdf") if srdf is None else Path(srdf)
    limits = file.parent / LIMITS_FILE if joint_limits is None else Path(joint_limits)
    with blamed_on(file, "mend the description"):
        return _load(file, base, tip, states, limits)


def _load(file: Path, base: str | None, tip: str | None, srdf: Path, limits_file: Path) -> RobotModel:
    """Read an arm, as `load_urdf` does; the SRDF and the limits need not exist."""
    document, robot = read_xml(file), parse_urdf(file)
    links = {link.name: link for link in robot.links}
    below = {joint.child: joint for joint in robot.joints}
    for name, which in ((base, "base"), (tip, "tip")):
        if name is not None and name not in links:
            raise CellError(f"{file}: no link {name!r} for the {which}; there are {', '.join(links)}")
    roots = [name for name in links if name not in below]
    if base is None and len(roots) != 1:
        raise CellError(f"{file}: {', '.join(roots) or 'no link'} may be the base; name base_link")
    root = base or roots[0]
    end = tip or _tip(links, below, root)
    chain = _chain(below, root, end)
    if not chain and end != root:
        raise CellError(f"{file}: {end} is not connected to {root}; name base and tip of one arm")
    moving = [joint for joint in chain if joint.type != "fixed"]
    if not 1 <= len(moving) <= 12:
        raise CellError(f"{file}: {len(moving)} joints between {root} and {end}; name base and tip of one arm")
    origins, pose = [], np.eye(4)
    frame_of = {root: (0, np.eye(4))}
    for joint in chain:
        pose = pose @ _origin(joint)
        if joint.type != "fixed":
            origins.append(pose)
            pose = np.eye(4)
        frame_of[joint.child] = (len(origins), pose)
    shapes: list[list[TriangleMesh]] = [[] for _ in range(len(moving) + 1)]
    carried: dict[int, list[str]] = {number: [] for number in range(len(moving) + 1)}
    beside: dict[str, Any] = {}
    left_out = []
    for name, link in links.items():
        at, shown = carrier_of(name, below, frame_of), list(collision_shapes(file, link))
        if not shown:
            continue
        if at is None:
            left_out.append(name)
            continue
        carried[at[0]].append(name)
        shapes[at[0]] += [replace(shape, vertices=apply(at[1], shape.vertices)) for shape in shown]
        beside |= {joint.name: joint for joint in _above(name, below, frame_of)[0] if joint.type != "fixed"}
    if fault := coupling_fault(robot.joints, chain, beside):
        raise CellError(f"{file}: {fault}")
    joints, notes = tuple(joint.name for joint in moving), []
    limits = np.array([_limits(file, joint) for joint in moving])
    stated = accelerations(file, document, joints)
    if limits_file.is_file():
        limits, stated, notes = _narrowed(limits_file, joints, limits, stated)
    names = (root, *(joint.child for joint in moving))
    middle = np.clip(np.zeros(len(moving)), limits[:, 0], limits[:, 1])
    model = RobotModel(
        name=str(robot.name),
        joint_names=joints,
        link_names=names,
        origins=np.array(origins),
        axes=np.array([_axis(file, joint) for joint in moving]),
        prismatic=np.array([joint.type == "prismatic" for joint in moving]),
        lower=limits[:, 0],
        upper=limits[:, 1],
        velocity=limits[:, 2],
        acceleration=np.where(np.isnan(stated), limits[:, 2] / ACCELERATION_TIME, stated),
        pieces=tuple(tuple(outer_hull(shape.vertices) for shape in of_link) for of_link in shapes),
        ignored=frozenset((link, link + 1) for link in range(len(moving))),
        flange=pose,
        home=middle,
        meshes=tuple(map(tuple, shapes)),
        source=str(file),
        assumed=tuple(joint for joint, limit in zip(joints, stated, strict=True) if np.isnan(limit)),
    )
    ignored = set(model.ignored)
    if srdf.is_file():
        content = read_srdf(srdf)
        pairs, partly = excluded_pairs(srdf, content, carried, links)
        states, incomplete = group_states(srdf, content, joints)
        notes += [*partly, *incomplete]
        model = replace(model, srdf=str(srdf), group_states=tuple(states.items()))
        if HOME_STATE in states:
            if (outside := model.first_outside(states[HOME_STATE], 0.0)) is not None:
                raise CellError(
                    f"{srdf}: state home has joint {joints[outside]} outside its limits; correct one of them"
                )
            model = replace(model, home=states[HOME_STATE])
    else:
        pairs = always_touching(model) - ignored if any(shapes) else set()
        said = ", ".join(f"{names[a]} and {names[b]}" for a, b in sorted(pairs))
        if pairs:
            notes.append(
                f"{file}: links that touch in nearly all configurations are not checked against each other: {said}"
            )
    ignored |= pairs
    stood_in = [name for of_link in carried.values() for name in of_link if not links[name].collisions]
    for what, named in (
        ("links without collision shapes are taken to be their visual shapes", stood_in),
        (
            "nothing is checked against links that have no shapes",
            [name for number, name in enumerate(names) if not shapes[number]],
        ),
        (f"links that are not below {root} are left out", left_out),
        ("joints that are not between base and tip are taken as fixed at zero", list(beside)),
        (
            "continuous joints are planned within 360 degrees to both sides",
            [joint.name for joint in moving if joint.type == "continuous"],
        ),
        (
            "limits are beyond two full turns, although the format has radians",
            [joint.name for joint in moving if joint.type == "revolute" and _turns_far(joint)],
        ),
        ("the gripper is mounted on the end of the longest chain before fingers", [] if tip or end in _TIPS else [end]),
        ("entries that are not used", [text] if (text := unused_text(document)) else []),
    ):
        if named:
            notes.append(f"{file}: {what}: {', '.join(named)}")
    for note in notes:
        warnings.warn(note, CellWarning, stacklevel=3)
    return replace(model, ignored=frozenset(ignored))


def always_touching(model: RobotModel) -> set[tuple[int, int]]:
    """Return pairs of links that touch in nearly all random configurations, so that checking them is meaningless."""
    configurations = np.random.default_rng(0).uniform(model.lower, model.upper, (COLLISION_SAMPLES, model.joints))
    bare = Gripper("none", "suction", (), np.eye(4), 0.0)
    robot = CellRobot("arm", model, np.eye(4), bare, model.home, np.zeros((0, 4, 4)))
    bodies, _, links = make_bodies(robot)
    obstacles, _ = make_obstacles([])
    chain = make_chain(model, np.eye(4))
    pairs = self_pairs(model, links).tolist()
    found = set()
    hits = np.empty(COLLISION_SAMPLES, np.int64)
    for a, b in sorted({(links[i], links[j]) for i, j in pairs}):
        tried = np.array([(i, j) for i, j in pairs if (links[i], links[j]) == (a, b)], np.int64)
        rules = Rules(np.zeros((len(links), 0), bool), tried, -1e9, np.zeros(len(links), bool), 0.0)
        check_many(configurations, make_query(chain, bodies, obstacles, rules), hits)
        if (hits >= 0).mean() >= ALWAYS_SHARE:
            found.add((a, b))
    return found


def parse_urdf(file: Path) -> Any:
    """Return the robot of a URDF as yourdfpy reads it, without meshes; CellError if it does not."""
    with importing("reading URDF files needs yourdfpy: pip install 'falsework[robots]'"):
        import yourdfpy
    try:
        return yourdfpy.URDF.load(
            io.BytesIO(read_xml_text(file)),
            build_scene_graph=False,
            load_meshes=False,
            build_collision_scene_graph=False,
        ).robot
    except Exception as error:  # the reader passes on any error of its XML parser
        text = " ".join(str(error).split()) or type(error).__name__
        raise CellError(f"{file} is not a readable URDF: {text}") from error


def _tip(links: dict[str, Any], below: dict[str, Any], root: str) -> str:
    """Return the link for the gripper: a usual name, else the end of the chain with most joints, before its fingers.

    Fingers begin where two or more links move against each other with fewer joints than there are before them.
    """
    for name in _TIPS:
        if name in links:
            return name

    def moving(joints: Iterable[Any]) -> int:
        return sum(joint.type != "fixed" for joint in joints)

    chains = {name: _chain(below, root, name) for name in links}
    end = max(links, key=lambda name: (moving(chains[name]), len(chains[name])))
    for number, joint in enumerate(chains[end]):
        before = chains[end][:number]
        beyond = [chain[number:] for chain in chains.values() if chain[:number] == before]
        fingers = {chain[0].name for chain in beyond if moving(chain)}
        if len(fingers) > 1 and moving(before) > max(map(moving, beyond)):
            return str(joint.parent)
    return end


def _chain(below: dict[str, Any], root: str, name: str) -> list[Any]:
    """Return the joints from the root to a link; none for a link that is elsewhere."""
    joints, top = _above(name, below, (root,))
    return joints[::-1] if top == root else []


def _above(name: str, below: dict[str, Any], ends: Container[str]) -> tuple[list[Any], str]:
    """Return the joints from a link up to the first of some links, or to where its tree ends, and that link."""
    found = []
    while name not in ends and name in below:
        found.append(below[name])
        name = below[name].parent
    return found, name


def carrier_of(name: str, below: dict[str, Any], frame_of: dict[str, tuple[int, Array]]) -> tuple[int, Array] | None:
    """Return the frame that carries a link and the pose of the link in it; joints off the chain stay at zero."""
    joints, top = _above(name, below, frame_of)
    if top not in frame_of:
        return None
    pose, (frame, at) = np.eye(4), frame_of[top]
    for joint in joints:
        pose = _origin(joint) @ pose
    return frame, at @ pose


def _origin(joint: Any) -> Array:
    return np.eye(4) if joint.origin is None else np.asarray(joint.origin, float)


def _axis(file: Path, joint: Any) -> Array:
    axis = np.array([1.0, 0, 0] if joint.axis is None else joint.axis, float)
    length = np.linalg.norm(axis)
    if not length > 0:
        raise CellError(f"{file}: joint {joint.name} has axis {axis.tolist()}; it must not be zero")
    return axis / length


def _limits(file: Path, joint: Any) -> tuple[float, float, float]:
    limit = joint.limit
    if joint.type not in ("revolute", "continuous", "prismatic"):
        raise CellError(f"{file}: joint {joint.name} is {joint.type}; only revolute and prismatic joints are supported")
    if limit is None or limit.velocity is None or not 0 < limit.velocity < np.inf:
        raise CellError(f"{file}: joint {joint.name} has no velocity limit; add velocity to its <limit>")
    if joint.type == "continuous":
        return -2 * np.pi, 2 * np.pi, float(limit.velocity)
    low, high = (-np.inf if end is None else float(end) for end in (limit.lower, limit.upper))
    if not low < high or not np.isfinite((low, high)).all():
        raise CellError(f"{file}: joint {joint.name} has no range; give lower and upper in its <limit>")
    soft_low, soft_high = soft_range(joint)
    low, high = max(low, soft_low), min(high, soft_high)
    if not low < high:
        raise CellError(f"{file}: the soft limits of joint {joint.name} leave it no range; correct them or its limits")
    return low, high, float(limit.velocity)


def _narrowed(
    file: Path, joints: tuple[str, ...], limits: Array, acceleration: Array
) -> tuple[Array, Array, list[str]]:
    """Return limits as (lower, upper, velocity) and accelerations that also keep those of a file, and its notes."""
    more: JointLimits = read_joint_limits(file, joints)
    lower, upper = np.fmax(limits[:, 0], more.lower), np.fmin(limits[:, 1], more.upper)
    if not (lower < upper).all():
        joint = joints[int(np.argmin(upper - lower))]
        raise CellError(f"{file}: joint {joint} has no range within the limits of the URDF; correct one of them")
    narrowed = np.stack([lower, upper, np.fmin(limits[:, 2], more.velocity)], axis=1)
    return narrowed, np.fmin(acceleration, more.acceleration), list(more.notes)


def _turns_far(joint: Any) -> bool:
    return max(abs(joint.limit.lower), abs(joint.limit.upper)) > 4 * np.pi

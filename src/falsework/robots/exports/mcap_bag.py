"""MCAP bags of robot plans: ROS 2 messages at the times of the schedule, readable without falsework.

Topics, for each robot: `/NAME/joint_trajectory` (`trajectory_msgs/JointTrajectory`) and `/NAME/robot_trajectory`
(`moveit_msgs/RobotTrajectory`), a message at the start of each motion; and `/planning_scene`
(`moveit_msgs/PlanningScene`), a difference whenever a gripper picks up or puts down a part, as the planning
scene monitor of MoveIt reads it. NAME has underscores for characters that no topic may have. The first scene, at the
start, has the parts in place with their meshes, and a part that is picked up has its mesh in the frame of the flange;
without the structure parts have only their names, and the reader's scene must have their shapes. A part put down in
disassembly leaves the scene, unless its robot grips it again. With the structure, viewers have topics of their own,
those of `bag_view`. Messages are CDR, with their definitions in the bag.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from falsework.assembly.state import REMOVED
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.exports.bag_view import IDENTITY, WORLD, PlacedParts, write_view
from falsework.robots.exports.controller import program_names
from falsework.robots.exports.ros2 import NANO, all_joint_names, duration, joint_trajectory
from falsework.robots.model.shapes import inverse_pose
from falsework.robots.plans.loads import Load, load_of, loads_at, moved_aside
from falsework.robots.plans.robot_forces import TimedPress
from falsework.robots.plans.robot_plan import RobotPlan, RobotStep
from falsework.robots.plans.temporal_graph import MotionNode
from falsework.robots.plans.timeline import schedule_of
from falsework.search.problem.task import Direction
from falsework.utils.files.output_file import write_whole
from falsework.utils.lazy import importing

_ADD, _REMOVE = 0, 1
_MOST_NAME = 200
"""Most characters of the name of a robot in a topic; topics have 255 at most."""


@cache
def _message_types() -> Any:
    """Return the messages of ROS 2 and MoveIt; code for each is compiled when it is first written."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    definitions = files("falsework.robots.exports").joinpath("moveit.msg").read_text(encoding="utf-8")
    for entry in definitions.split("MSG: ")[1:]:
        name, text = entry.split("\n", 1)
        store.register(get_types_from_msg(text, name))
    return store


class _Bag:
    """MCAP bag in memory."""

    def __init__(self) -> None:
        with importing("an MCAP bag needs mcap and rosbags: pip install 'falsework[schedule]'"):
            from mcap.writer import Writer

            self.store = _message_types()
        self.data = io.BytesIO()
        self.writer = Writer(self.data)
        self.writer.start(profile="ros2", library="falsework")
        self.schemas: dict[str, int] = {}
        self.channels: dict[str, int] = {}
        self.count = 0
        """Messages written."""

    def write(self, topic: str, kind: str, message: dict[str, Any], seconds: float) -> None:
        """Add a message of plain values at a time of the plan; fields that it lacks are zero or empty."""
        if kind not in self.schemas:
            text, _ = self.store.generate_msgdef(kind, ros_version=2)
            self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self.channels:
            self.channels[topic] = self.writer.register_channel(topic, "cdr", self.schemas[kind])
        stamp, data = round(seconds * NANO), bytes(self.store.serialize_cdr(self._made(kind, message), kind))
        self.writer.add_message(self.channels[topic], log_time=stamp, publish_time=stamp, data=data)
        self.count += 1

    def _made(self, kind: str, values: dict[str, Any]) -> Any:
        fields = self.store.fielddefs[kind][1]
        return self.store.types[kind](**{name: self._value(kind, values.get(name)) for name, kind in fields})

    def _value(self, kind: tuple[Any, Any], value: Any) -> Any:
        """Return plain values as a field of a message; None is zero or empty."""
        form, about = kind[0].name, kind[1]
        if form == "NAME":
            return self._made(about, value or {})
        if form == "BASE":
            zeros = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}
            return zeros.get(about[0], 0) if value is None else value
        entry, count = about
        if entry[0].name == "BASE" and entry[1][0] != "string":
            return np.zeros(count, entry[1][0]) if value is None else np.asarray(value, entry[1][0])
        return [self._value(entry, one) for one in value or [None] * count]

    def finish(self) -> bytes:
        """Return the bytes of the file."""
        self.writer.finish()
        return self.data.getvalue()


def write_bag(
    plan: RobotPlan, path: Path, placed: PlacedParts | None = None, presses: Sequence[TimedPress] = ()
) -> int:
    """Write the motions of a robot plan as an MCAP bag, and return the number of messages.

    Presses, at the times of the schedule, are set points of the wrench at the flange of an arm, zero from their end on.
    """
    bag, graph, topics = _Bag(), schedule_of(plan), program_names(plan, _MOST_NAME)
    nodes, starts = graph.nodes, graph.starts()

    def scene(now: float, **fields: Any) -> None:
        bag.write("/planning_scene", "moveit_msgs/msg/PlanningScene", _scene(now, **fields), now)

    def play(node: MotionNode, step: RobotStep, robot: int, now: float) -> None:
        assert node.trajectory is not None
        topic = topics[robot]
        carried = [plan.keyframes[node.step].load(robot), *(leg.part for leg in step.of(robot))]
        carried.append(plan.keyframes[node.step + 1].load(robot))
        part = carried[node.trajectory + 1]
        if part is not None and carried[node.trajectory] is None:
            load = load_of(plan, node.step, node.trajectory, robot)
            scene(now, attached=_attached(plan, robot, part, now, load, placed))
        message = joint_trajectory(plan, robot, step.of(robot)[node.trajectory], "{robot}_")
        message["header"] = _header(plan.robots[robot].name, now)
        whole = {"joint_trajectory": message, "multi_dof_joint_trajectory": {"header": message["header"]}}
        bag.write(f"/{topic}/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", message, now)
        bag.write(f"/{topic}/robot_trajectory", "moveit_msgs/msg/RobotTrajectory", whole, now)
        if part is not None and carried[node.trajectory + 2] is None:
            end, last = now + node.seconds, node.trajectory + 1 == len(step.trajectories)
            # MoveIt leaves a detached part where it is, before it reads the world of the difference.
            gone = (step.transit and not moved_aside(plan, node.step)) or (
                last and plan.direction is Direction.DISASSEMBLY
            )
            things = [_part(plan, part, _REMOVE, _flange(plan, robot), end)] if gone else []
            scene(end, attached=_attached(plan, robot, part, end, None, None), things=things)

    if placed is not None:
        write_view(plan, placed, bag.write)
        present = np.flatnonzero(plan.states[0] != REMOVED).tolist()
        names = all_joint_names(plan)
        things = [_part(plan, part, _ADD, WORLD, 0.0, placed.shapes.meshes[part]) for part in present]
        scene(0.0, joints={"name": names, "position": np.concatenate(plan.keyframes[0].configurations)}, things=things)
    for robot, load in loads_at(plan, 0).items():
        scene(0.0, attached=_attached(plan, robot, load.part, 0.0, load, placed))
    for index in np.argsort(starts, kind="stable").tolist():
        node, now, step = nodes[index], float(starts[index]), plan.steps[nodes[index].step]
        for robot in node.robots if node.trajectory is not None else ():
            play(node, step, robot, now)
        grip = plan.grip(node.step) if node.trajectory is None and step.transit else None
        if grip and (load := loads_at(plan, node.step + (grip == "close")).get(node.robot)):
            given = (load, placed) if grip == "close" else (None, None)  # a part that waits is taken or let go of
            scene(now, attached=_attached(plan, node.robot, load.part, now, *given))
    for press in presses:
        record = plan.robots[press.robot]
        name, wrench = record.name, press.wrench_in(press.tool @ inverse_pose(record.tool))
        for moment, values in ((press.start, wrench), (press.end, np.zeros(6))):
            force, torque = (dict(zip("xyz", part, strict=True)) for part in values.reshape(2, 3).tolist())
            message = {"header": _header(f"{name}_tool0", moment), "wrench": {"force": force, "torque": torque}}
            bag.write(f"/{topics[press.robot]}/wrench_setpoint", "geometry_msgs/msg/WrenchStamped", message, moment)
    data = bag.finish()
    write_whole(path, lambda file: file.write(data))
    return bag.count


def _header(frame: str, now: float) -> dict[str, Any]:
    return {"stamp": duration(now), "frame_id": frame}


def _flange(plan: RobotPlan, robot: int) -> str:
    return f"{plan.robots[robot].name}_tool0"


def _attached(
    plan: RobotPlan, robot: int, part: int, now: float, load: Load | None, placed: PlacedParts | None
) -> list[dict[str, Any]]:
    """Return what a gripper picks up, with its shape in the frame of the flange, or, without a load, puts down."""
    flange, mesh = _flange(plan, robot), None
    if placed is not None and load is not None:
        shape, there = placed.shapes.meshes[part], load.in_flange(placed.cell.robots[robot])
        mesh = TriangleMesh(shape.name, apply(there, shape.vertices), shape.faces)
    thing = _part(plan, part, _REMOVE if load is None else _ADD, flange, now, mesh)
    posture = {"header": _header(flange, now)}
    return [{"link_name": flange, "object": thing, "touch_links": [flange], "detach_posture": posture}]


def _scene(
    now: float,
    *,
    joints: dict[str, Any] | None = None,
    attached: Sequence[dict[str, Any]] = (),
    things: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """Return a difference of the planning scene."""
    nowhere = _header("", now)
    state = {
        "joint_state": {"header": nowhere, **(joints or {})},
        "multi_dof_joint_state": {"header": nowhere},
        "attached_collision_objects": attached,
        "is_diff": True,
    }
    octomap = {"header": nowhere, "origin": IDENTITY, "octomap": {"header": nowhere}}
    return {"robot_state": state, "world": {"collision_objects": things, "octomap": octomap}, "is_diff": True}


def _part(
    plan: RobotPlan, part: int, operation: int, frame: str, now: float, mesh: TriangleMesh | None = None
) -> dict[str, Any]:
    """Return a part as a collision object; without a mesh the shape of the scene applies."""
    name, shape = plan.plan.part_names[part], {}
    if mesh is not None:
        corners = [dict(zip("xyz", corner, strict=True)) for corner in mesh.vertices.tolist()]
        surface = {"triangles": [{"vertex_indices": row} for row in mesh.faces], "vertices": corners}
        shape = {"meshes": [surface], "mesh_poses": [IDENTITY]}
    about = {"header": _header(frame, now), "pose": IDENTITY, "id": name, "type": {"key": name}}
    return {**about, **shape, "operation": operation}

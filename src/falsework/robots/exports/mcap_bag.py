"""MCAP bags of robot plans: ROS 2 messages at the times of the schedule, readable without falsework.

Topics, for each robot: `/NAME/joint_trajectory` (`trajectory_msgs/JointTrajectory`) and `/NAME/robot_trajectory`
(`moveit_msgs/RobotTrajectory`), a message at the start of each motion; and `/planning_scene`
(`moveit_msgs/PlanningScene`), a difference whenever a gripper picks up or puts down a part, as the planning
scene monitor of MoveIt reads it. The first one, at the start, has the parts in place with their meshes, and a part that
is picked up has its mesh in the frame of the flange; without the structure parts have only their names, and the
reader's scene must have their shapes. A part put down in disassembly leaves the scene, unless its robot grips it again.
Messages are CDR, with their definitions in the bag.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED
from falsework.errors import DependencyError
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.kinematics.forward import flange_pose
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import inverse_pose, move
from falsework.robots.plans.loads import Load, load_of, loads_at
from falsework.robots.plans.presses import TimedPress, flange_of
from falsework.robots.plans.robot_plan import RobotPlan, Trajectory
from falsework.robots.plans.timeline import schedule_of
from falsework.search.problem.task import Direction
from falsework.utils.files.output_file import write_whole

Array = NDArray[np.float64]

_NANO = 1_000_000_000
"""Nanoseconds a second."""
_ADD, _REMOVE = 0, 1
_WORLD = "world"
"""Frame of the parts in place."""
_DEFINITIONS = {
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db\n",
    "moveit_msgs/msg/RobotTrajectory": (
        "trajectory_msgs/JointTrajectory joint_trajectory\n"
        "trajectory_msgs/MultiDOFJointTrajectory multi_dof_joint_trajectory\n"
    ),
    "moveit_msgs/msg/CollisionObject": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\nstring id\nobject_recognition_msgs/ObjectType type\n"
        "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses\n"
        "shape_msgs/Mesh[] meshes\ngeometry_msgs/Pose[] mesh_poses\n"
        "shape_msgs/Plane[] planes\ngeometry_msgs/Pose[] plane_poses\n"
        "string[] subframe_names\ngeometry_msgs/Pose[] subframe_poses\n"
        "byte ADD=0\nbyte REMOVE=1\nbyte APPEND=2\nbyte MOVE=3\nbyte operation\n"
    ),
    "moveit_msgs/msg/AttachedCollisionObject": (
        "string link_name\nmoveit_msgs/CollisionObject object\nstring[] touch_links\n"
        "trajectory_msgs/JointTrajectory detach_posture\nfloat64 weight\n"
    ),
    "moveit_msgs/msg/RobotState": (
        "sensor_msgs/JointState joint_state\nsensor_msgs/MultiDOFJointState multi_dof_joint_state\n"
        "moveit_msgs/AttachedCollisionObject[] attached_collision_objects\nbool is_diff\n"
    ),
    "moveit_msgs/msg/AllowedCollisionEntry": "bool[] enabled\n",
    "moveit_msgs/msg/AllowedCollisionMatrix": (
        "string[] entry_names\nmoveit_msgs/AllowedCollisionEntry[] entry_values\n"
        "string[] default_entry_names\nbool[] default_entry_values\n"
    ),
    "moveit_msgs/msg/LinkPadding": "string link_name\nfloat64 padding\n",
    "moveit_msgs/msg/LinkScale": "string link_name\nfloat64 scale\n",
    "moveit_msgs/msg/ObjectColor": "string id\nstd_msgs/ColorRGBA color\n",
    "octomap_msgs/msg/Octomap": ("std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n"),
    "octomap_msgs/msg/OctomapWithPose": (
        "std_msgs/Header header\ngeometry_msgs/Pose origin\noctomap_msgs/Octomap octomap\n"
    ),
    "moveit_msgs/msg/PlanningSceneWorld": (
        "moveit_msgs/CollisionObject[] collision_objects\noctomap_msgs/OctomapWithPose octomap\n"
    ),
    "moveit_msgs/msg/PlanningScene": (
        "string name\nmoveit_msgs/RobotState robot_state\nstring robot_model_name\n"
        "geometry_msgs/TransformStamped[] fixed_frame_transforms\n"
        "moveit_msgs/AllowedCollisionMatrix allowed_collision_matrix\n"
        "moveit_msgs/LinkPadding[] link_padding\nmoveit_msgs/LinkScale[] link_scale\n"
        "moveit_msgs/ObjectColor[] object_colors\nmoveit_msgs/PlanningSceneWorld world\nbool is_diff\n"
    ),
}


class _Bag:
    """MCAP bag in memory."""

    def __init__(self) -> None:
        try:
            from mcap.writer import Writer
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise DependencyError("an MCAP bag needs mcap and rosbags: pip install 'falsework[schedule]'") from None
        self.store = get_typestore(Stores.ROS2_HUMBLE)
        for name, text in _DEFINITIONS.items():
            self.store.register(get_types_from_msg(text, name))
        self.data = io.BytesIO()
        self.writer = Writer(self.data)
        self.writer.start(profile="ros2", library="falsework")
        self.schemas: dict[str, int] = {}
        self.channels: dict[str, int] = {}

    def make(self, kind: str, /, **fields: Any) -> Any:
        """Return a message."""
        return self.store.types[kind](**fields)

    def write(self, topic: str, message: Any, seconds: float) -> None:
        """Add a message at a time of the plan."""
        kind = message.__msgtype__
        if kind not in self.schemas:
            text, _ = self.store.generate_msgdef(kind, ros_version=2)
            self.schemas[kind] = self.writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self.channels:
            self.channels[topic] = self.writer.register_channel(topic, "cdr", self.schemas[kind])
        stamp, data = round(seconds * _NANO), bytes(self.store.serialize_cdr(message, kind))
        self.writer.add_message(self.channels[topic], log_time=stamp, publish_time=stamp, data=data)

    def header(self, frame: str, seconds: float) -> Any:
        """Return a `std_msgs/Header`."""
        whole = round(seconds * _NANO)
        stamp = self.make("builtin_interfaces/msg/Time", sec=whole // _NANO, nanosec=whole % _NANO)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def finish(self) -> bytes:
        """Return the bytes of the file."""
        self.writer.finish()
        return self.data.getvalue()


@dataclass(frozen=True, eq=False)
class PlacedParts:
    """Parts of a structure in a cell, for a scene that needs no other source of shapes."""

    shapes: PartShapes
    cell: Cell


def write_bag(
    plan: RobotPlan, path: Path, placed: PlacedParts | None = None, presses: Sequence[TimedPress] = ()
) -> int:
    """Write the motions of a robot plan as an MCAP bag, and return the number of messages.

    Args:
        plan: robot plan; without a schedule its motions are sequential.
        path: file to write.
        placed: the parts with their shapes; without them the planning scene has only their names.
        presses: of the plan, at the times of its schedule: set points of the wrench at the flange of an arm, zero from
            the end of a press on.

    Raises:
        DependencyError: mcap or rosbags is missing.
        InputError: the file cannot be written.
    """
    bag, count = _Bag(), 0
    graph = schedule_of(plan)
    nodes, starts = graph.nodes, graph.starts()
    if placed is not None:
        bag.write("/planning_scene", _first_scene(bag, plan, placed), 0.0)
        count += 1
    for robot, load in loads_at(plan, 0).items():
        bag.write("/planning_scene", _difference(bag, plan, robot, load.part, 0.0, load, placed=placed), 0.0)
        count += 1
    for index in np.argsort(starts, kind="stable").tolist():
        node, now = nodes[index], float(starts[index])
        step, name, robot = plan.steps[node.step], plan.robots[node.robot].name, node.robot
        if node.trajectory is None:
            continue
        carried = [plan.keyframes[node.step].load(robot), *(leg.part for leg in step.trajectories)]
        carried.append(plan.keyframes[node.step + 1].load(robot))
        part = carried[node.trajectory + 1]
        if part is not None and carried[node.trajectory] is None:
            load = load_of(plan, node.step, node.trajectory)
            bag.write("/planning_scene", _difference(bag, plan, robot, part, now, load, placed=placed), now)
            count += 1
        message = _trajectory(bag, plan, node.robot, step.trajectories[node.trajectory], now)
        whole = bag.make(
            "moveit_msgs/msg/RobotTrajectory",
            joint_trajectory=message,
            multi_dof_joint_trajectory=bag.make(
                "trajectory_msgs/msg/MultiDOFJointTrajectory", header=bag.header(name, now), joint_names=[], points=[]
            ),
        )
        bag.write(f"/{name}/joint_trajectory", message, now)
        bag.write(f"/{name}/robot_trajectory", whole, now)
        count += 2
        if part is not None and carried[node.trajectory + 2] is None:
            end, last = now + node.seconds, node.trajectory + 1 == len(step.trajectories)
            gone = step.transit or (last and plan.direction is Direction.DISASSEMBLY)
            bag.write("/planning_scene", _difference(bag, plan, robot, part, end, None, gone=gone), end)
            count += 1
    for press in presses:
        name, wrench = plan.robots[press.robot].name, press.wrench_in(flange_of(press, plan))
        for moment, values in ((press.start, wrench), (press.end, np.zeros(6))):
            bag.write(f"/{name}/wrench_setpoint", _wrench(bag, f"{name}_tool0", moment, values), moment)
            count += 1
    data = bag.finish()
    write_whole(path, lambda file: file.write(data))
    return count


def _wrench(bag: _Bag, frame: str, now: float, values: Array) -> Any:
    """Return a wrench in a frame, about its origin, N and Nm, shape (6,)."""
    force, torque = (
        bag.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", part, strict=True)))
        for part in values.reshape(2, 3).tolist()
    )
    wrench = bag.make("geometry_msgs/msg/Wrench", force=force, torque=torque)
    return bag.make("geometry_msgs/msg/WrenchStamped", header=bag.header(frame, now), wrench=wrench)


def _trajectory(bag: _Bag, plan: RobotPlan, robot: int, trajectory: Trajectory, now: float) -> Any:
    record = plan.robots[robot]
    points = []
    for moment, positions, velocities in zip(
        trajectory.times.tolist(), trajectory.positions, trajectory.velocities, strict=True
    ):
        whole = round(moment * _NANO)
        points.append(
            bag.make(
                "trajectory_msgs/msg/JointTrajectoryPoint",
                positions=np.array(positions, dtype=np.float64),
                velocities=np.array(velocities, dtype=np.float64),
                accelerations=np.zeros(0),
                effort=np.zeros(0),
                time_from_start=bag.make("builtin_interfaces/msg/Duration", sec=whole // _NANO, nanosec=whole % _NANO),
            )
        )
    names = [f"{record.name}_{joint}" for joint in record.joint_names]
    return bag.make(
        "trajectory_msgs/msg/JointTrajectory", header=bag.header(record.name, now), joint_names=names, points=points
    )


def _first_scene(bag: _Bag, plan: RobotPlan, placed: PlacedParts) -> Any:
    """Return the planning scene at the start: the parts in place, and where the arms are."""
    frame, meshes = plan.keyframes[0], placed.shapes.meshes
    present = np.flatnonzero(plan.states[0] != REMOVED).tolist()
    names = [f"{robot.name}_{joint}" for robot in plan.robots for joint in robot.joint_names]
    things = [_part(bag, plan, part, _ADD, _WORLD, 0.0, meshes[part]) for part in present]
    return _scene(bag, 0.0, joints=(names, np.concatenate(frame.configurations)), things=things)


def _difference(
    bag: _Bag,
    plan: RobotPlan,
    robot: int,
    part: int,
    now: float,
    load: Load | None,
    *,
    placed: PlacedParts | None = None,
    gone: bool = False,
) -> Any:
    """Return the difference of the planning scene when a gripper picks up or puts down a part, which may then leave.

    Args:
        bag: the bag.
        plan: the robot plan.
        robot: index of the robot.
        part: the part.
        now: time, seconds.
        load: what the gripper picks up; None: it puts the part down.
        placed: the parts with their shapes.
        gone: whether the part leaves the scene.
    """
    flange, operation = f"{plan.robots[robot].name}_tool0", _REMOVE if load is None else _ADD
    mesh = None
    if placed is not None and load is not None:
        assert load.grip is not None
        entry, shape = placed.cell.robots[robot], placed.shapes.meshes[part]
        there = inverse_pose(flange_pose(entry.model, load.grip, entry.base)) @ load.pose
        mesh = TriangleMesh(shape.name, move(there, shape.vertices), shape.faces)
    attached = bag.make(
        "moveit_msgs/msg/AttachedCollisionObject",
        link_name=flange,
        object=_part(bag, plan, part, operation, flange, now, mesh),
        touch_links=[flange],
        detach_posture=bag.make(
            "trajectory_msgs/msg/JointTrajectory", header=bag.header(flange, now), joint_names=[], points=[]
        ),
        weight=0.0,
    )
    # MoveIt leaves a detached part where it is, before it reads the world of the difference.
    things = [_part(bag, plan, part, _REMOVE, flange, now)] if gone else []
    return _scene(bag, now, attached=[attached], things=things)


def _scene(
    bag: _Bag,
    now: float,
    *,
    joints: tuple[list[str], Array] = ([], np.zeros(0)),
    attached: Sequence[Any] = (),
    things: Sequence[Any] = (),
) -> Any:
    """Return a difference of the planning scene."""
    nowhere = bag.header("", now)
    return bag.make(
        "moveit_msgs/msg/PlanningScene",
        name="",
        robot_state=bag.make(
            "moveit_msgs/msg/RobotState",
            joint_state=bag.make(
                "sensor_msgs/msg/JointState",
                header=nowhere,
                name=joints[0],
                position=joints[1],
                velocity=np.zeros(0),
                effort=np.zeros(0),
            ),
            multi_dof_joint_state=bag.make(
                "sensor_msgs/msg/MultiDOFJointState", header=nowhere, joint_names=[], transforms=[], twist=[], wrench=[]
            ),
            attached_collision_objects=list(attached),
            is_diff=True,
        ),
        robot_model_name="",
        fixed_frame_transforms=[],
        allowed_collision_matrix=bag.make(
            "moveit_msgs/msg/AllowedCollisionMatrix",
            entry_names=[],
            entry_values=[],
            default_entry_names=[],
            default_entry_values=np.zeros(0, dtype=bool),
        ),
        link_padding=[],
        link_scale=[],
        object_colors=[],
        world=bag.make(
            "moveit_msgs/msg/PlanningSceneWorld",
            collision_objects=list(things),
            octomap=bag.make(
                "octomap_msgs/msg/OctomapWithPose",
                header=nowhere,
                origin=_identity(bag),
                octomap=bag.make(
                    "octomap_msgs/msg/Octomap",
                    header=nowhere,
                    binary=False,
                    id="",
                    resolution=0.0,
                    data=np.zeros(0, dtype=np.int8),
                ),
            ),
        ),
        is_diff=True,
    )


def _part(
    bag: _Bag, plan: RobotPlan, part: int, operation: int, frame: str, now: float, mesh: TriangleMesh | None = None
) -> Any:
    """Return a part as a collision object; without a mesh the shape of the scene applies."""
    name = plan.plan.part_names[part]
    lists = ("primitives", "primitive_poses", "planes", "plane_poses")
    shape = [] if mesh is None else [_mesh(bag, mesh)]
    return bag.make(
        "moveit_msgs/msg/CollisionObject",
        header=bag.header(frame, now),
        pose=_identity(bag),
        id=name,
        type=bag.make("object_recognition_msgs/msg/ObjectType", key=name, db=""),
        meshes=shape,
        mesh_poses=[_identity(bag) for _ in shape],
        **{entry: [] for entry in lists},
        subframe_names=[],
        subframe_poses=[],
        operation=operation,
    )


def _mesh(bag: _Bag, mesh: TriangleMesh) -> Any:
    """Return a surface as a `shape_msgs/Mesh`."""
    triangles = np.asarray(mesh.faces, dtype=np.uint32)
    return bag.make(
        "shape_msgs/msg/Mesh",
        triangles=[bag.make("shape_msgs/msg/MeshTriangle", vertex_indices=row) for row in triangles],
        vertices=[bag.make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()],
    )


def _identity(bag: _Bag) -> Any:
    """Return the identity pose."""
    return bag.make(
        "geometry_msgs/msg/Pose",
        position=bag.make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0),
        orientation=bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )

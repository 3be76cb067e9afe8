"""Carry out a plan of two arms by ROS 2: goals of `FollowJointTrajectory` for controllers with mock hardware.

`export_plan(..., "ros2-goals")` gives each arm its goals, and whom to wait for before each. `Conductor` sends them, one
thread an arm. Where ROS 2 with ros2_control is installed, this starts a controller manager with mock hardware and two
joint trajectory controllers; elsewhere it says so, and a stand-in takes the place of the controllers.

Run: python examples/13_ros2_control.py
Needs: pip install 'falsework[robots,schedule]'; ROS 2 with ros2_control, ros2_controllers and robot_state_publisher
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from falsework import load_cell, load_structure, plan_robots
from falsework.robots import Cell, export_plan

CELL = """
format = "falsework.cell/1"
name = "two arms"

[structure]
density = 200

[grippers.cup]
kind = "suction"
payload = 10.0
mass = 1.0
cup = 0.02
tool = { position = [0.0, 0.0, 0.18] }
shapes = [{ cylinder = { radius = 0.02, low = 0.0, high = 0.178 } }]

[[robots]]
name = "left"
model = "ur10e"
gripper = "cup"
base = { position = [-0.8, 0.0, 0.0], yaw = 0.0 }
places = [{ position = [0.1, -0.7, 0.4] }]

[[robots]]
name = "right"
model = "ur10e"
gripper = "cup"
base = { position = [0.8, 0.0, 0.0], yaw = 180.0 }
places = [{ position = [0.1, -0.7, 0.4] }]
"""
PREFIX = "{robot}_"  # one controller manager has the joints of both arms
PATIENCE = 60.0  # seconds that starting the controllers may take
Send = Callable[[str, dict[str, Any]], None]


class Conductor:
    """Sends the goals of each arm in its order, as soon as the arms that it waits for have come far enough."""

    def __init__(self, content: dict[str, Any], send: Send) -> None:
        """`content`: of `goals.json`; `send(robot, goal)` returns when the goal is reached."""
        self.arms = {arm["robot"]: arm["sequence"] for arm in content["arms"]}
        self.send = send
        self.counts = dict.fromkeys(self.arms, content["count_from"])
        self.changed = threading.Condition()
        self.done: list[tuple[str, str]] = []  # robot and step, in the order in which steps begin
        self.failure: Exception | None = None

    def run(self) -> None:
        """Carry everything out."""
        threads = [threading.Thread(target=self.arm, args=(name,), daemon=True) for name in self.arms]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if self.failure is not None:
            raise self.failure

    def arm(self, name: str) -> None:
        """The sequence of one arm; if one fails, all stop after their present motion."""
        try:
            for entry in self.arms[name]:
                self.entry(name, entry)
        except Exception as error:  # reported by `run`
            with self.changed:
                self.failure = self.failure or error
                self.changed.notify_all()

    def entry(self, name: str, entry: dict[str, Any]) -> None:
        """One entry: a goal, a wait, a count, or an action of the gripper."""
        with self.changed:
            if "wait_for" in entry:
                other, count = entry["wait_for"], entry["count"]
                self.changed.wait_for(lambda: self.failure is not None or self.counts[other] >= count)
            if self.failure is not None:
                raise RuntimeError(f"{name} stops: another arm has failed")
            if "count" in entry and "wait_for" not in entry:
                self.counts[name] = entry["count"]
                self.changed.notify_all()
            if "do" in entry:
                self.done.append((name, entry["do"]))
        if "goal" in entry:
            self.send(name, entry["goal"])
        # "gripper" and "press" entries are for the driver of the gripper, which mock hardware does not have.


def origin(pose: np.ndarray) -> str:
    """Return a pose, shape (4, 4), as URDF has it."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
    return f'<origin xyz="{" ".join(map(str, pose[:3, 3]))}" rpy="{" ".join(map(str, turn))}"/>'


def description(cell: Cell, starts: dict[str, list[float]]) -> str:
    """Return a URDF of all arms without shapes, with mock hardware that begins at given joint values."""
    lines = ['<robot name="cell"><link name="world"/>']
    mock = ['<ros2_control name="mock" type="system"><hardware>']
    mock.append("<plugin>mock_components/GenericSystem</plugin></hardware>")
    for robot in cell.robots:
        model, own = robot.model, PREFIX.replace("{robot}", robot.name)
        lines.append(f'<link name="{own}base"/><joint name="{own}fixed" type="fixed"><parent link="world"/>')
        lines.append(f'<child link="{own}base"/>{origin(robot.base)}</joint>')
        parent = f"{own}base"
        for k, joint in enumerate(model.joint_names):
            link = f"{own}link_{k + 1}"
            along = " ".join(map(str, model.axes[k]))
            lines.append(f'<link name="{link}"/><joint name="{own}{joint}" type="revolute"><parent link="{parent}"/>')
            lines.append(f'<child link="{link}"/>{origin(model.origins[k])}<axis xyz="{along}"/>')
            lines.append(f'<limit lower="{model.lower[k]}" upper="{model.upper[k]}" velocity="{model.velocity[k]}"')
            lines.append(' effort="1000"/></joint>')
            mock.append(f'<joint name="{own}{joint}"><command_interface name="position"/>')
            mock.append(f'<state_interface name="position"><param name="initial_value">{starts[robot.name][k]}</param>')
            mock.append('</state_interface><state_interface name="velocity"><param name="initial_value">0.0</param>')
            mock.append("</state_interface></joint>")
            parent = link
    return "".join([*lines, *mock, "</ros2_control></robot>"])


def parameters(content: dict[str, Any], urdf: str) -> dict[str, Any]:
    """Return the parameters of all nodes; JSON is YAML."""
    controllers = {f"{arm['robot']}_controller": arm["joint_names"] for arm in content["arms"]}
    types = {name: {"type": "joint_trajectory_controller/JointTrajectoryController"} for name in controllers}
    types["joint_state_broadcaster"] = {"type": "joint_state_broadcaster/JointStateBroadcaster"}
    nodes = {"controller_manager": {"update_rate": 100, "robot_description": urdf, **types}}
    nodes["robot_state_publisher"] = {"robot_description": urdf}
    interfaces = {"command_interfaces": ["position"], "state_interfaces": ["position", "velocity"]}
    nodes |= {name: {"joints": joints, **interfaces} for name, joints in controllers.items()}
    return {name: {"ros__parameters": values} for name, values in nodes.items()}


@contextmanager
def mock_controllers(content: dict[str, Any], cell: Cell, folder: Path) -> Iterator[None]:
    """Start the controllers of all arms, and stop them afterwards."""
    starts = {arm["robot"]: arm["start"] for arm in content["arms"]}
    file = folder / "parameters.yaml"
    file.write_text(json.dumps(parameters(content, description(cell, starts))))
    names = ["joint_state_broadcaster", *(f"{arm['robot']}_controller" for arm in content["arms"])]
    # The description is a parameter in Humble; later managers read it from the topic of the publisher.
    given = ["--ros-args", "--params-file", str(file), "--remap", "~/robot_description:=/robot_description"]
    started = [
        subprocess.Popen(["ros2", "run", *node, *given], start_new_session=True)
        for node in (("robot_state_publisher", "robot_state_publisher"), ("controller_manager", "ros2_control_node"))
    ]
    try:
        # From Jazzy on controllers get their parameters from the spawner, before from the controller manager.
        spawner = ["ros2", "run", "controller_manager", "spawner", *names, "--param-file", str(file)]
        subprocess.run(spawner, check=True, timeout=PATIENCE)
        yield
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGINT)  # `ros2 run` alone would leave its node behind
            process.wait(timeout=10)


@contextmanager
def ros2_actions(content: dict[str, Any]) -> Iterator[Send]:
    """Connect to the action servers of all controllers, and yield a function that sends a goal and waits for it."""
    import rclpy
    from control_msgs.action import FollowJointTrajectory
    from rclpy.action import ActionClient
    from rclpy.executors import SingleThreadedExecutor
    from rosidl_runtime_py.set_message import set_message_fields

    rclpy.init()
    node = rclpy.create_node("falsework_conductor")
    clients = {
        arm["robot"]: ActionClient(node, FollowJointTrajectory, f"/{arm['robot']}_controller/follow_joint_trajectory")
        for arm in content["arms"]
    }
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin, daemon=True)
    spinning.start()

    def wait(future: Any) -> Any:
        ready = threading.Event()
        future.add_done_callback(lambda _: ready.set())
        ready.wait()
        return future.result()

    def send(robot: str, values: dict[str, Any]) -> None:
        goal = FollowJointTrajectory.Goal()
        set_message_fields(goal, values)
        handle = wait(clients[robot].send_goal_async(goal))
        if not handle.accepted:
            raise RuntimeError(f"the controller of {robot} has refused a goal")
        result = wait(handle.get_result_async()).result
        if result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            raise RuntimeError(f"{robot}: {result.error_string or result.error_code}")

    try:
        for robot, client in clients.items():
            if not client.wait_for_server(timeout_sec=PATIENCE):
                raise RuntimeError(f"there is no action server of {robot}")
        yield send
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown()


def why_not() -> str:
    """Return why ROS 2 cannot be used here; empty if it can."""
    if shutil.which("ros2") is None:
        return "there is no command ros2"
    try:
        import control_msgs  # noqa: F401
        import rclpy  # noqa: F401
    except ImportError as error:
        return str(error)
    found = subprocess.run(["ros2", "pkg", "prefix", "controller_manager"], capture_output=True, check=False)
    return "" if found.returncode == 0 else "the package controller_manager is not installed"


def stand_in(robot: str, goal: dict[str, Any]) -> None:
    """Take the time of a goal, a hundred times as fast."""
    end = goal["trajectory"]["points"][-1]["time_from_start"]
    time.sleep((end["sec"] + end["nanosec"] * 1e-9) / 100)


def main() -> None:
    """Plan, export, and carry out."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "cell.toml").write_text(CELL)
        cell = load_cell(folder / "cell.toml")
        structure = load_structure("stack:blocks=2,length=0.2,height=0.15,depth=0.2")
        plan = plan_robots(structure, cell, concurrent=True).unwrap()
        (file,) = export_plan(plan, folder, "ros2-goals", joint_prefix=PREFIX, cell=cell)
        content = json.loads(file.read_text())
        reason = why_not()
        if reason:
            print(f"ROS 2 is skipped, since {reason}; a stand-in carries the plan out")
            conductor = Conductor(content, stand_in)
            conductor.run()
        else:
            with mock_controllers(content, cell, folder), ros2_actions(content) as send:
                conductor = Conductor(content, send)
                conductor.run()
        for robot, step in conductor.done:
            print(f"{robot}: {step}")


if __name__ == "__main__":
    main()

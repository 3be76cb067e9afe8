"""Robot plan files: versioned JSON with a published schema, read strictly."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from falsework.errors import PlanError
from falsework.robots.plans.loads import put_down_fault, transit_fault
from falsework.robots.plans.robot_plan import Keyframe, RobotPlan, RobotStep, Trajectory
from falsework.robots.plans.robot_record import RobotRecord
from falsework.robots.plans.temporal_graph import MotionNode, Precedence, Reason, TemporalPlanGraph
from falsework.robots.plans.timeline import nodes_of
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.search.problem.task import Direction
from falsework.utils.json_file import Reader, write_json

Array = NDArray[np.float64]

FORMAT = "falsework.robot-plan/3"
SECOND_FORMAT = "falsework.robot-plan/2"
"""Format whose direction is that of the plan in it; read, no longer written."""
FIRST_FORMAT = "falsework.robot-plan/1"
"""Format without a schedule; read, no longer written."""

DIGITS = 12
"""Decimals of joint values, velocities and times: fewer would show as acceleration where knots are 0.1 ms apart."""
JOINS = 1e-5
"""Joint values that differ by no more are equal, rad or m."""

_KEYS = {"format", "direction", "cell", "plan", "keyframes", "steps", "schedule", "statistics"}
_REASONS = get_args(Reason)
_TIMES = 1e-3
"""Times of a schedule that differ by no more are equal, seconds."""


def robot_plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of robot plan files; `plan` in it follows `falsework.search.plan_schema`."""
    text = resources.files("falsework.robots.plans").joinpath("robot_plan.schema.json").read_text(encoding="utf-8")
    return json.loads(text)


def save_robot_plan(plan: RobotPlan, path: Path | str) -> None:
    """Write a robot plan as JSON, format `falsework.robot-plan/3`, atomically.

    Raises:
        InputError: the file cannot be written.
    """
    write_json(path, robot_plan_to_dict(plan), spread=("keyframes", "steps"))


def robot_plan_to_dict(plan: RobotPlan) -> dict[str, Any]:
    """Return the robot plan as plain JSON values; see `robot_plan.schema.json`."""
    return {
        "format": FORMAT,
        "direction": plan.direction.value,
        "cell": {
            "name": plan.cell_name,
            "identity": plan.cell_identity,
            **({} if plan.cell_source is None else {"source": plan.cell_source}),
            "robots": [
                {
                    "name": robot.name,
                    "model": robot.model,
                    "joints": list(robot.joint_names),
                    "base": rounded(robot.base),
                    "gripper": robot.gripper,
                    "tool": rounded(robot.tool),
                }
                for robot in plan.robots
            ],
        },
        "plan": plan_to_dict(plan.plan, proofs=plan.plan.proof_arrays() is not None),
        "keyframes": [
            {
                "configurations": [rounded(values) for values in keyframe.configurations],
                "held": list(keyframe.held),
                **({"carried": list(keyframe.carried)} if keyframe.carried else {}),
            }
            for keyframe in plan.keyframes
        ],
        "steps": [
            {
                "do": plan.does(index),
                "robot": step.robot,
                **({} if step.hands_over is None else {"hands_over": step.hands_over}),
                **({} if step.put_down is None else {"put_down": rounded(step.put_down)}),
                **({"transit": True} if step.transit else {}),
                **({} if step.gripped is None else {"gripped": rounded(step.gripped)}),
                "trajectories": [
                    {
                        "kind": trajectory.kind,
                        "part": trajectory.part,
                        "touches": trajectory.touches,
                        "times": rounded(trajectory.times),
                        "positions": rounded(trajectory.positions),
                        "velocities": rounded(trajectory.velocities),
                    }
                    for trajectory in step.trajectories
                ],
            }
            for index, step in enumerate(plan.steps)
        ],
        "schedule": None if plan.schedule is None else _schedule_to_dict(plan.schedule),
        "statistics": plan.statistics,
    }


def _schedule_to_dict(graph: TemporalPlanGraph) -> dict[str, Any]:
    return {
        "makespan": round(graph.makespan, DIGITS),
        "sequential": round(graph.sequential, DIGITS),
        "lower_bound": round(graph.lower_bound, DIGITS),
        "motions": [
            {
                "robot": node.robot,
                "step": node.step,
                "trajectory": node.trajectory,
                "start": round(start, DIGITS),
                "seconds": round(node.seconds, DIGITS),
            }
            for node, start in zip(graph.nodes, graph.starts().tolist(), strict=True)
        ],
        "precedences": [
            {"before": edge.before, "offset": round(edge.offset, DIGITS), "after": edge.after, "why": edge.why}
            for edge in graph.edges
        ],
    }


def load_robot_plan(path: Path | str) -> RobotPlan:
    """Read a robot plan and validate it: format, lengths, and continuity of motions and keyframes.

    Collisions and limits are not checked; see `check_robot_plan`.

    Raises:
        PlanError: no such file, damaged, of another version, or with discontinuous motions.
    """
    return robot_plan_from_dict(_Reader.load(path), str(Path(path)))


def robot_plan_from_dict(data: Any, source: str = "the robot plan") -> RobotPlan:
    """Read a robot plan from plain JSON values; `source` is its name in messages.

    Raises:
        PlanError: as `load_robot_plan`.
    """
    return _Reader(source).plan(data)


def rounded(values: Array) -> Any:
    """Return values as nested lists, with as many decimals as files have."""
    return (np.round(np.asarray(values, dtype=np.float64), DIGITS) + 0.0).tolist()


class _Reader(Reader):
    """Reader that validates everything that does not need the cell and the structure."""

    kind, form, command = "robot plan", FORMAT, "falsework robots plan"

    def plan(self, data: Any) -> RobotPlan:
        if isinstance(data, dict) and data.get("format") == FIRST_FORMAT:
            data = {**data, "format": SECOND_FORMAT, "schedule": None}
        if isinstance(data, dict) and data.get("format") == SECOND_FORMAT:
            known = data["plan"].get("direction") if isinstance(data.get("plan"), dict) else None
            data = {**data, "format": FORMAT, "direction": known}
        self._header(data, _KEYS)
        if data["direction"] not in ("assembly", "disassembly"):
            self._fail(f"direction is {data['direction']!r}", "it must be assembly or disassembly")
        cell = data["cell"]
        self._keys(cell, {"name", "identity", "robots"}, "cell", frozenset({"source"}))
        robots = tuple(self._robot(entry, f"robot {k}") for k, entry in enumerate(self._list(cell["robots"], "robots")))
        abstract = plan_from_dict(data["plan"], f"the plan in {self._source}")
        if abstract.props:
            self._fail("its plan has props, which robot plans do not support")
        joints = [len(robot.joint_names) for robot in robots]
        keyframes = tuple(
            self._keyframe(entry, f"keyframe {k}", joints, len(abstract.boundary))
            for k, entry in enumerate(self._list(data["keyframes"], "keyframes"))
        )
        steps = tuple(
            self._step(entry, f"step {k + 1}", joints, len(abstract.boundary))
            for k, entry in enumerate(self._list(data["steps"], "steps"))
        )
        if not isinstance(data["statistics"], dict):
            self._fail("statistics is not an object")
        made = RobotPlan(
            plan=abstract,
            keyframes=keyframes,
            steps=steps,
            robots=robots,
            cell_name=self._text(cell["name"], "cell.name"),
            cell_identity=self._text(cell["identity"], "cell.identity"),
            cell_source=None if "source" not in cell else self._text(cell["source"], "cell.source"),
            statistics=data["statistics"],
            direction=Direction(data["direction"]),
        )
        self._joins(made)
        return made if data["schedule"] is None else replace(made, schedule=self._schedule(data["schedule"], made))

    def _schedule(self, data: Any, plan: RobotPlan) -> TemporalPlanGraph:
        self._keys(data, {"makespan", "sequential", "lower_bound", "motions", "precedences"}, "schedule")
        found, expected = self._list(data["motions"], "schedule: motions"), nodes_of(plan)[0]
        if len(found) != len(expected):
            self._fail(f"its schedule has {len(found)} motions, its steps have {len(expected)}")
        starts = []
        for k, (entry, node) in enumerate(zip(found, expected, strict=True)):
            place = f"schedule: motion {k}"
            self._keys(entry, {"robot", "step", "trajectory", "start", "seconds"}, place)
            if (entry["robot"], entry["step"], entry["trajectory"]) != (node.robot, node.step, node.trajectory):
                self._fail(f"{place} does not match its step", "the motions must be in the order of the steps")
            starts.append(self._seconds(entry["start"], f"{place}: start"))
            if abs(self._seconds(entry["seconds"], f"{place}: seconds") - node.seconds) > JOINS:
                self._fail(f"{place} has another duration than its trajectory")
        edges = [
            self._precedence(entry, f"schedule: precedence {k}", expected)
            for k, entry in enumerate(self._list(data["precedences"], "schedule: precedences"))
        ]
        bound = self._seconds(data["lower_bound"], "schedule: lower_bound")
        try:
            graph = TemporalPlanGraph(expected, tuple(edges), len(plan.robots), bound)
        except PlanError as error:
            self._fail(f"its schedule is invalid: {str(error).removesuffix('; plan again')}", "schedule it again")
        if starts and np.abs(graph.starts() - starts).max() > _TIMES:
            self._fail("the times of its schedule do not follow from its precedences", "schedule it again")
        for key, derived in (("makespan", graph.makespan), ("sequential", graph.sequential)):
            told = self._seconds(data[key], f"schedule: {key}")
            if abs(told - derived) > _TIMES:
                self._fail(f"schedule: {key} is {told:g}, its motions take {derived:g} s", "schedule it again")
        if bound > graph.makespan + _TIMES:
            self._fail(f"schedule: lower_bound is {bound:g}, above its makespan of {graph.makespan:g} s")
        return graph

    def _precedence(self, data: Any, place: str, nodes: tuple[MotionNode, ...]) -> Precedence:
        self._keys(data, {"before", "offset", "after", "why"}, place)
        for end in ("before", "after"):
            if type(data[end]) is not int or not 0 <= data[end] < len(nodes):
                self._fail(f"{place}: {end} is {data[end]!r}", f"it must be a motion from 0 to {len(nodes) - 1}")
        if data["why"] not in _REASONS:
            self._fail(f"{place}: why is {data['why']!r}", f"it must be one of {', '.join(_REASONS)}")
        return Precedence(data["before"], self._seconds(data["offset"], f"{place}: offset"), data["after"], data["why"])

    def _seconds(self, value: Any, place: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < float("inf"):
            self._fail(f"{place} is {value!r}", "it must be seconds, finite and not negative")
        return float(value)

    def _robot(self, data: Any, place: str) -> RobotRecord:
        self._keys(data, {"name", "model", "joints", "base", "gripper", "tool"}, place)
        names = tuple(self._text(name, f"{place}: a joint") for name in self._list(data["joints"], f"{place}: joints"))
        return RobotRecord(
            self._text(data["name"], f"{place}: name"),
            self._text(data["model"], f"{place}: model"),
            names,
            self._array(data["base"], (4, 4), f"{place}: base"),
            self._text(data["gripper"], f"{place}: gripper"),
            self._array(data["tool"], (4, 4), f"{place}: tool"),
        )

    def _keyframe(self, data: Any, place: str, joints: list[int], parts: int) -> Keyframe:
        self._keys(data, {"configurations", "held"}, place, frozenset({"carried"}))
        values, held, carried = data["configurations"], data["held"], data.get("carried", [None] * len(joints))
        if any(not isinstance(entry, list) or len(entry) != len(joints) for entry in (values, held, carried)):
            self._fail(f"{place} does not have {len(joints)} robots")
        return Keyframe(
            tuple(
                self._array(entry, (count,), f"{place}: robot {k}")
                for k, (entry, count) in enumerate(zip(values, joints, strict=True))
            ),
            tuple(self._part(part, parts, f"{place}: held") for part in held),
            tuple(self._part(part, parts, f"{place}: carried") for part in carried if "carried" in data),
        )

    def _step(self, data: Any, place: str, joints: list[int], parts: int) -> RobotStep:
        others = frozenset({"hands_over", "put_down", "transit", "gripped"})
        self._keys(data, {"do", "robot", "trajectories"}, place, others)
        robot = data["robot"]
        if type(robot) is not int or not 0 <= robot < len(joints):
            self._fail(f"{place}: robot is {robot!r}", f"it must be a number from 0 to {len(joints) - 1}")
        found = self._list(data["trajectories"], f"{place}: trajectories")
        handed = self._part(data["hands_over"], parts, f"{place}: hands_over") if "hands_over" in data else None
        pose = self._array(data["put_down"], (4, 4), f"{place}: put_down") if "put_down" in data else None
        grip = self._array(data["gripped"], (joints[robot],), f"{place}: gripped") if "gripped" in data else None
        transit = data.get("transit", False)
        if not isinstance(transit, bool):
            self._fail(f"{place}: transit is {transit!r}", "it must be true or false")
        moves = tuple(self._trajectory(entry, place, joints[robot], parts) for entry in found)
        return RobotStep(robot, moves, handed, pose, transit, grip)

    def _trajectory(self, data: Any, place: str, joints: int, parts: int) -> Trajectory:
        self._keys(data, {"kind", "part", "touches", "times", "positions", "velocities"}, place)
        if data["kind"] not in ("free", "line"):
            self._fail(f"{place}: kind is {data['kind']!r}", "it must be free or line")
        times = self._array(data["times"], None, f"{place}: times")
        if len(times) < 2 or times[0] != 0 or (np.diff(times) <= 0).any():
            self._fail(f"{place}: times do not ascend from 0")
        shape = (len(times), joints)
        return Trajectory(
            data["kind"],
            times,
            self._array(data["positions"], shape, f"{place}: positions"),
            self._array(data["velocities"], shape, f"{place}: velocities"),
            self._part(data["part"], parts, f"{place}: part"),
            self._part(data["touches"], parts, f"{place}: touches"),
        )

    def _joins(self, plan: RobotPlan) -> None:
        """Check hand-overs, parts put down, and that trajectories lead from a keyframe to the next without jumps."""
        for index, (before, after) in enumerate(pairwise(plan.keyframes)):
            step, place = plan.steps[index], f"step {index + 1} ({plan.does(index)})"
            if fault := plan.fault(index) or put_down_fault(plan, index) or transit_fault(plan, index):
                self._fail(f"{place}: {fault}")
            values = before.configurations[step.robot]
            for trajectory in step.trajectories:
                if np.abs(trajectory.positions[0] - values).max() > JOINS:
                    self._fail(f"{place}: a motion does not begin where the previous one ended")
                values = trajectory.positions[-1]
            for robot, (old, new) in enumerate(zip(before.configurations, after.configurations, strict=True)):
                if np.abs((values if robot == step.robot else old) - new).max() > JOINS:
                    self._fail(f"{place}: robot {robot} does not reach keyframe {index + 1}")

    def _array(self, value: Any, shape: tuple[int, ...] | None, place: str) -> Array:
        if not _is_numeric(value):
            self._fail(f"{place} does not hold numbers", "texts and booleans are none; plan again")
        try:
            found = np.array(value, dtype=np.float64)
        except (ValueError, OverflowError):
            self._fail(f"{place} does not hold numbers of one shape that fit into 64 bits")
        if shape is None and found.ndim != 1:
            self._fail(f"{place} is not a list of numbers")
        if shape is not None and found.shape != shape:
            self._fail(f"{place} has shape {found.shape}", f"expected {shape}")
        if not np.isfinite(found).all():
            self._fail(f"{place} holds a number that is not finite")
        return found

    def _part(self, value: Any, parts: int, place: str) -> int | None:
        if value is not None and (type(value) is not int or not 0 <= value < parts):
            self._fail(f"{place} is {value!r}", f"it must be null or a part from 0 to {parts - 1}")
        return value

    def _text(self, value: Any, place: str) -> str:
        if not isinstance(value, str):
            self._fail(f"{place} is {value!r}", "it must be a text")
        return value


def _is_numeric(value: Any, depth: int = 2) -> bool:
    """Return whether a value is a list of numbers, nested at most this deep: NumPy converts texts and booleans too."""
    if not isinstance(value, list):
        return False
    return all(type(entry) in (int, float) or (depth > 1 and _is_numeric(entry, depth - 1)) for entry in value)

"""Robot plan files: versioned JSON with a published schema, read strictly."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from msgspec import convert, to_builtins

from falsework.errors import PlanError
from falsework.robots.model.shapes import Array
from falsework.robots.plans.loads import step_fault
from falsework.robots.plans.robot_plan import Keyframe, Partner, RobotPlan, RobotRecord, RobotStep
from falsework.robots.plans.robot_plan_model import (
    FORMAT,
    KeyframeEntry,
    RecordedRobotEntry,
    RobotPlanFile,
    RobotStepEntry,
    ScheduleEntry,
    TrajectoryEntry,
)
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import nodes_of
from falsework.robots.plans.trajectory import JOINS, Trajectory
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.search.problem.task import Direction
from falsework.utils.json_file import check_format, read_json, write_json
from falsework.utils.models import read_model

SECOND_FORMAT = "falsework.robot-plan/2"
"""Format whose direction is that of the plan in it; read, no longer written."""

DIGITS = 12
"""Decimals of joint values, velocities and times: fewer would show as acceleration where knots are 0.1 ms apart."""
_TIMES = 1e-3
"""Times of a schedule that differ by no more are equal, seconds."""


def save_robot_plan(plan: RobotPlan, path: Path | str) -> None:
    """Write a robot plan as JSON, format `falsework.robot-plan/3`, atomically."""
    write_json(path, robot_plan_to_dict(plan), spread=("keyframes", "steps"))


def robot_plan_to_dict(plan: RobotPlan) -> dict[str, Any]:
    """Return the robot plan as plain JSON values; see `robot_plan_schema`."""

    def plain(value: Any) -> dict[str, Any]:
        return to_builtins(value, enc_hook=rounded)

    robots = [plain(robot) for robot in plan.robots]
    cell = {
        "name": plan.cell_name,
        "identity": plan.cell_identity,
        "source": plan.cell_source,
        "robots": [{"joints": robot.pop("joint_names"), **robot} for robot in robots],
    }
    file = {
        "format": FORMAT,
        "direction": plan.direction.value,
        "cell": cell,
        "plan": plan_to_dict(plan.plan, proofs=plan.plan.proof_arrays() is not None),
        "keyframes": [
            {**plain(frame), "carried": frame.carried or None, "waits": _waits(frame)} for frame in plan.keyframes
        ],
        "steps": [{**plain(step), "do": plan.does(index)} for index, step in enumerate(plan.steps)],
        "schedule": None if plan.schedule is None else _schedule_to_dict(plan.schedule),
        "statistics": plan.statistics,
        "before": plan.before,
        "after": plan.after,
    }
    return to_builtins(convert(file, RobotPlanFile))


def _waits(frame: Keyframe) -> list[dict[str, Any]]:
    return [{"part": part, "pose": rounded(pose)} for part, pose in frame.waits]


def _schedule_to_dict(graph: TemporalPlanGraph) -> dict[str, Any]:
    starts = graph.starts().tolist()
    return {
        **{key: getattr(graph, key) for key in ("makespan", "sequential", "lower_bound")},
        "motions": [{**to_builtins(node), "start": start} for node, start in zip(graph.nodes, starts, strict=True)],
        "precedences": graph.edges,
    }


def load_robot_plan(path: Path | str) -> RobotPlan:
    """Read a robot plan and validate it: format, lengths, and continuity of motions and keyframes.

    Collisions and limits are not checked; see `check_robot_plan`.
    """
    return robot_plan_from_dict(read_json(path, "robot plan file", "plan again"), str(Path(path)))


def robot_plan_from_dict(data: Any, source: str = "the robot plan") -> RobotPlan:
    """Read a robot plan from plain JSON values as `load_robot_plan`; `source` is its name in messages."""
    return _Reader(data, source).plan()


def rounded(values: Array) -> Any:
    """Return values as nested lists, with as many decimals as files have."""
    return (np.round(np.asarray(values, dtype=np.float64), DIGITS) + 0.0).tolist()


class _Reader:
    """Checks of robot plans beyond their model that do not need the cell and the structure."""

    def __init__(self, data: Any, source: str) -> None:
        self._source, self._about = source, f"{source} is not a valid robot plan: "
        if isinstance(data, dict) and data.get("format") == SECOND_FORMAT:
            known = data["plan"].get("direction") if isinstance(data.get("plan"), dict) else None
            data = {**data, "format": FORMAT, "direction": known}
        check_format(data, FORMAT, self._about, "falsework robots plan")
        self._file = read_model(
            RobotPlanFile,
            data,
            self._about,
            PlanError,
            remedy="; it may be damaged or from another version; plan again",
        )
        self._joints = [len(robot.joints) for robot in self._file.cell.robots]

    def plan(self) -> RobotPlan:
        file, cell = self._file, self._file.cell
        abstract = plan_from_dict(file.plan, f"the plan in {self._source}")
        if abstract.props:
            self._fail("its plan has props, which robot plans do not support")
        parts = len(abstract.boundary)
        made = RobotPlan(
            plan=abstract,
            keyframes=tuple(self._keyframe(entry, f"keyframes[{k}]", parts) for k, entry in enumerate(file.keyframes)),
            steps=tuple(self._step(entry, f"steps[{k}]", parts) for k, entry in enumerate(file.steps)),
            robots=tuple(self._robot(entry, f"cell.robots[{k}]") for k, entry in enumerate(cell.robots)),
            cell_name=cell.name,
            cell_identity=cell.identity,
            cell_source=cell.source,
            statistics=file.statistics,
            direction=Direction(file.direction),
            before=self._robots("before"),
            after=self._robots("after"),
        )
        self._joins(made)
        return made if file.schedule is None else replace(made, schedule=self._schedule(file.schedule, made))

    def _schedule(self, data: ScheduleEntry, plan: RobotPlan) -> TemporalPlanGraph:
        expected = nodes_of(plan)[0]
        if len(data.motions) != len(expected):
            self._fail(f"its schedule has {len(data.motions)} motions, its steps have {len(expected)}")
        for k, (entry, node) in enumerate(zip(data.motions, expected, strict=True)):
            place = f"schedule.motions[{k}]"
            told = entry.robot, tuple(entry.others), entry.step, entry.trajectory
            if told != (node.robot, node.others, node.step, node.trajectory):
                self._fail(f"{place} does not match its step", "the motions must be in the order of the steps")
            if abs(entry.seconds - node.seconds) > JOINS:
                self._fail(f"{place} has another duration than its trajectory")
        for k, edge in enumerate(data.precedences):
            if max(edge.before, edge.after) >= len(expected):
                remedy = f"motions are numbered from 0 to {len(expected) - 1}"
                self._fail(f"schedule.precedences[{k}] is between motions {edge.before} and {edge.after}", remedy)
        try:
            graph = TemporalPlanGraph(expected, tuple(data.precedences), len(plan.robots), data.lower_bound)
        except PlanError as error:
            self._fail(f"its schedule is invalid: {str(error).removesuffix('; plan again')}", "schedule it again")
        starts = [entry.start for entry in data.motions]
        if starts and np.abs(graph.starts() - starts).max() > _TIMES:
            self._fail("the times of its schedule do not follow from its precedences", "schedule it again")
        for key, derived in (("makespan", graph.makespan), ("sequential", graph.sequential)):
            told = getattr(data, key)
            if abs(told - derived) > _TIMES:
                self._fail(f"schedule.{key} is {told:g}, its motions take {derived:g} s", "schedule it again")
        if data.lower_bound > graph.makespan + _TIMES:
            self._fail(f"schedule.lower_bound is {data.lower_bound:g}, above its makespan of {graph.makespan:g} s")
        return graph

    def _robots(self, key: str) -> tuple[int, ...]:
        robots = tuple(getattr(self._file, key))
        if any(robot >= len(self._joints) for robot in robots):
            self._fail(f"{key} has a robot beyond {len(self._joints) - 1}")
        return robots

    def _robot(self, data: RecordedRobotEntry, place: str) -> RobotRecord:
        base, tool = (self._array(getattr(data, key), (4, 4), f"{place}.{key}") for key in ("base", "tool"))
        return RobotRecord(data.name, data.model, tuple(data.joints), base, data.gripper, tool)

    def _keyframe(self, data: KeyframeEntry, place: str, parts: int) -> Keyframe:
        values, held, carried = data.configurations, data.held, data.carried
        if any(entry is not None and len(entry) != len(self._joints) for entry in (values, held, carried)):
            self._fail(f"{place} does not have {len(self._joints)} robots")
        for part in (*held, *(carried or ()), *(entry.part for entry in data.waits)):
            self._part(part, parts, place)
        arrays = (
            self._array(entry, (count,), f"{place}.configurations[{k}]")
            for k, (entry, count) in enumerate(zip(values, self._joints, strict=True))
        )
        waits = [
            (one.part, self._array(one.pose, (4, 4), f"{place}.waits[{k}].pose")) for k, one in enumerate(data.waits)
        ]
        if len({part for part, _ in waits}) < len(waits):
            self._fail(f"{place} has a part that waits in two places")
        return Keyframe(tuple(arrays), tuple(held), tuple(carried or ()), tuple(waits))

    def _step(self, data: RobotStepEntry, place: str, parts: int) -> RobotStep:
        for robot in (data.robot, *(partner.robot for partner in data.partners)):
            if robot >= len(self._joints):
                self._fail(f"{place}.robot is {robot}", f"it must be a number from 0 to {len(self._joints) - 1}")
        self._part(data.hands_over, parts, f"{place}.hands_over")
        joints = self._joints[data.robot]
        pose, grip = (
            None if value is None else self._array(value, shape, f"{place}.{key}")
            for key, value, shape in (("put_down", data.put_down, (4, 4)), ("gripped", data.gripped, (joints,)))
        )
        moves, *others = (
            tuple(
                self._trajectory(leg, f"{where}.trajectories[{k}]", self._joints[entry.robot], parts)
                for k, leg in enumerate(entry.trajectories)
            )
            for entry, where in (
                (data, place),
                *((one, f"{place}.partners[{k}]") for k, one in enumerate(data.partners)),
            )
        )
        partners = tuple(Partner(one.robot, legs) for one, legs in zip(data.partners, others, strict=True))
        return RobotStep(data.robot, moves, data.hands_over, pose, data.transit, grip, partners)

    def _trajectory(self, data: TrajectoryEntry, place: str, joints: int, parts: int) -> Trajectory:
        times = np.array(data.times)
        if times[0] != 0 or (np.diff(times) <= 0).any():
            self._fail(f"{place}.times do not ascend from 0")
        for key in ("part", "touches"):
            self._part(getattr(data, key), parts, f"{place}.{key}")
        positions, velocities = (
            self._array(getattr(data, key), (len(times), joints), f"{place}.{key}")
            for key in ("positions", "velocities")
        )
        return Trajectory(data.kind, times, positions, velocities, data.part, data.touches)

    def _joins(self, plan: RobotPlan) -> None:
        """Check hand-overs, parts put down, and that trajectories lead from a keyframe to the next without jumps."""
        for index, (before, after) in enumerate(pairwise(plan.keyframes)):
            step, place = plan.steps[index], f"step {index + 1} ({plan.does(index)})"
            if fault := step_fault(plan, index):
                self._fail(f"{place}: {fault}")
            ends = [*before.configurations]
            for robot in step.robots:
                for trajectory in step.of(robot):
                    if np.abs(trajectory.positions[0] - ends[robot]).max() > JOINS:
                        self._fail(f"{place}: a motion does not begin where the previous one ended")
                    ends[robot] = trajectory.positions[-1]
            for robot, (end, new) in enumerate(zip(ends, after.configurations, strict=True)):
                if np.abs(end - new).max() > JOINS:
                    self._fail(f"{place}: robot {robot} does not reach keyframe {index + 1}")

    def _array(self, value: Any, shape: tuple[int, ...], place: str) -> Array:
        try:
            found = np.array(value, dtype=np.float64)
        except ValueError:
            self._fail(f"{place} does not hold rows of one length")
        if found.shape != shape:
            self._fail(f"{place} has shape {found.shape}", f"expected {shape}")
        return found

    def _part(self, part: int | None, parts: int, place: str) -> None:
        if part is not None and part >= parts:
            self._fail(f"{place} is {part}", f"it must be null or a part from 0 to {parts - 1}")

    def _fail(self, what: str, remedy: str = "the file is damaged; plan again") -> NoReturn:
        raise PlanError(f"{self._about}{what}; {remedy}")

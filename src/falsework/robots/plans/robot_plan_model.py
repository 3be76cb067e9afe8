"""Model of robot plan files, from which reading, writing, messages and the JSON Schema derive."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta

from falsework.robots.plans.temporal_graph import Precedence
from falsework.utils.models import FileModel, model_schema

FORMAT = "falsework.robot-plan/3"

Index = Annotated[int, Meta(ge=0)]
Part = Annotated[int, Meta(ge=0)] | None
Seconds = Annotated[float, Meta(ge=0)]
Numbers = list[float]
Pose = Annotated[list[list[float]], Meta(min_length=4, max_length=4)]


class RecordedRobotEntry(FileModel, frozen=True):
    """Robot of the cell."""

    name: str
    model: str
    joints: list[str]
    base: Pose
    """Pose of the base in the world."""
    gripper: str
    tool: Pose
    """Tool frame in the frame of the flange."""


class CellEntry(FileModel, frozen=True):
    """Cell of a robot plan."""

    name: str
    identity: str
    """Digest of everything in the cell that motions depend on."""
    robots: Annotated[list[RecordedRobotEntry], Meta(min_length=1)]
    source: str | None = None
    """Name of a built-in cell, or path of a cell file relative to this file."""


class WaitingEntry(FileModel, frozen=True):
    """Part that waits half way out, in no gripper."""

    part: Index
    pose: Pose
    """Displacement from its place in the structure."""


class KeyframeEntry(FileModel, frozen=True):
    """Joint values of all robots between two steps."""

    configurations: list[Numbers]
    """Joint values of every robot."""
    held: list[Part]
    """Installed part that each robot holds."""
    carried: list[Part] | None = None
    """Part that each robot has in its gripper, away from its place; absent: none has one."""
    waits: list[WaitingEntry] = []
    """Parts of the structure that wait half way out while others move; absent: none does."""


class TrajectoryEntry(FileModel, frozen=True):
    """Knots; between two of them, each joint follows the cubic with their positions and velocities."""

    kind: Literal["free", "line"]
    """free: through the open; line: the tool moves straight to or from the place of a part, or on a move of its way."""
    part: Part
    """Part in the gripper."""
    touches: Part
    """Part at its place, or put down, that the gripper may touch."""
    times: Annotated[Numbers, Meta(min_length=2)]
    """Seconds, ascending from 0."""
    positions: list[Numbers]
    velocities: list[Numbers]


class PartnerEntry(FileModel, frozen=True):
    """Motions of another robot that moves its own part at the same instant."""

    robot: Index
    trajectories: list[TrajectoryEntry]
    """At the times of those of the step."""


class RobotStepEntry(FileModel, frozen=True):
    """Motions of one robot for one action of the plan, for half of a hand-over, or for a transit."""

    do: str
    """The action in words."""
    robot: Index
    trajectories: list[TrajectoryEntry]
    hands_over: Part = None
    """Part of a hand-over, which has no action of the plan: two robots hold it between its two steps."""
    put_down: Pose | None = None
    """Displacement, from its place in the structure, with which the part of a removal or an insertion lies on the floor
    while its robot grips it in another way: the motions without `part` in the middle. Absent where it stays in the
    gripper."""
    transit: bool = False
    """Whether robots only go to other places: where an assembly is continued, with parts that come at the same instant,
    with parts that make way for others, or to take such a part, or let go of it, where it waits."""
    gripped: Numbers | None = None
    """Joint values with which the robot would hold the part of a transit at its place in the structure; absent: it
    carries none, or has held it there."""
    partners: list[PartnerEntry] = []
    """Other robots that move their own parts at the same instant."""


class MotionEntry(FileModel, frozen=True):
    """Trajectory of a step, or moment at which a gripper closes or opens, at its time."""

    robot: Index
    step: Index
    trajectory: Index | None
    """Its number in the step; null: a gripper closes or opens."""
    start: Seconds
    seconds: Seconds
    others: list[Index] = []
    """Robots that move at the same instant, as one motion."""


class ScheduleEntry(FileModel, frozen=True):
    """What may take place at the same time."""

    makespan: Annotated[float, Meta(ge=0)]
    """End of the last motion without delays."""
    sequential: Annotated[float, Meta(ge=0)]
    """The same motions one after the other."""
    lower_bound: Annotated[float, Meta(ge=0)]
    """No order of these motions takes less."""
    motions: list[MotionEntry]
    """In the order of the steps."""
    precedences: list[Precedence]


class RobotPlanFile(FileModel, frozen=True):
    """Robot plan file."""

    format: Literal["falsework.robot-plan/3"]
    direction: Literal["assembly", "disassembly"]
    """Order in which the motions are executed; keyframes and steps are in that order."""
    cell: CellEntry
    plan: Annotated[dict[str, Any], Meta(extra_json_schema={"required": ["format", "steps"]})]
    """Abstract plan with proofs, in the order of assembly, format falsework.plan/4."""
    keyframes: list[KeyframeEntry]
    """One before each step, and one after the last."""
    steps: list[RobotStepEntry]
    """One for every action of the plan, and two for each hand-over: a robot takes a held part over, then the other
    leaves it. Transits have no action."""
    schedule: ScheduleEntry | None
    """What may take place at the same time; null: one motion after the other."""
    statistics: dict[str, Any]
    before: list[Index] = []
    """Robots of the first steps of the plan, in the order of assembly, that have no motions, since they were done
    before: the plan goes on from another one."""
    after: list[Index] = []
    """The same of its last steps, which were undone before, in disassembly."""


def robot_plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of robot plan files; `plan` in it follows that of plan files."""
    about = (
        "A plan with the motions that carry it out, in the order in which they are executed, and with a schedule where "
        "robots move at the same time. Units are SI: metres, radians, seconds."
    )
    return model_schema(RobotPlanFile, "robot-plan-3", "falsework robot plan, version 3", about)

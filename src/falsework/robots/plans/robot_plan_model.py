"""Model of robot plan files, from which reading, writing, messages and the JSON Schema derive."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import Meta

from falsework.robots.plans.temporal_graph import Reason
from falsework.utils.models import Model, model_schema

FORMAT = "falsework.robot-plan/3"

Index = Annotated[int, Meta(ge=0)]
Part = Annotated[int, Meta(ge=0)] | None
Seconds = Annotated[float, Meta(ge=0)]
Numbers = list[float]
Pose = Annotated[list[list[float]], Meta(min_length=4, max_length=4)]


class RobotEntry(Model):
    """Robot of the cell."""

    name: str
    model: str
    joints: list[str]
    base: Annotated[Pose, Meta(description="Pose of the base in the world.")]
    gripper: str
    tool: Annotated[Pose, Meta(description="Tool frame in the frame of the flange.")]


class CellEntry(Model):
    """Cell of a robot plan."""

    name: str
    identity: Annotated[str, Meta(description="Digest of everything in the cell that motions depend on.")]
    robots: Annotated[list[RobotEntry], Meta(min_length=1)]
    source: Annotated[
        str | None, Meta(description="Name of a built-in cell, or path of a cell file relative to this file.")
    ] = None


class KeyframeEntry(Model):
    """Joint values of all robots between two steps."""

    configurations: Annotated[list[Numbers], Meta(description="Joint values of every robot.")]
    held: Annotated[list[Part], Meta(description="Installed part that each robot holds.")]
    carried: Annotated[
        list[Part] | None,
        Meta(description="Part that each robot has in its gripper, away from its place; absent: none has one."),
    ] = None


class TrajectoryEntry(Model):
    """Knots; between two of them, each joint follows the cubic with their positions and velocities."""

    kind: Annotated[
        Literal["free", "line"],
        Meta(description="free: through the open; line: the tool moves straight to or from the place of a part."),
    ]
    part: Annotated[Part, Meta(description="Part in the gripper.")]
    touches: Annotated[Part, Meta(description="Part at its place, or put down, that the gripper may touch.")]
    times: Annotated[Numbers, Meta(description="Seconds, ascending from 0.", min_length=2)]
    positions: list[Numbers]
    velocities: list[Numbers]


class StepEntry(Model):
    """Motions of one robot for one action of the plan, for half of a hand-over, or for a transit."""

    do: Annotated[str, Meta(description="The action in words.")]
    robot: Index
    trajectories: list[TrajectoryEntry]
    hands_over: Annotated[
        Part,
        Meta(
            description="Part of a hand-over, which has no action of the plan: two robots hold it between its two "
            "steps."
        ),
    ] = None
    put_down: Annotated[
        Pose | None,
        Meta(
            description="Displacement, from its place in the structure, with which the part of a removal or an "
            "insertion lies on the floor while its robot grips it in another way: the motions without `part` in the "
            "middle. Absent where it stays in the gripper."
        ),
    ] = None
    transit: Annotated[
        bool,
        Meta(
            description="Whether the robot only goes to another place: from where it is when an assembly is continued."
        ),
    ] = False
    gripped: Annotated[
        Numbers | None,
        Meta(
            description="Joint values with which the robot would hold the part of a transit at its place in the "
            "structure; absent: it carries none."
        ),
    ] = None


class MotionEntry(Model):
    """Trajectory of a step, or moment at which a gripper closes or opens, at its time."""

    robot: Index
    step: Index
    trajectory: Annotated[Index | None, Meta(description="Its number in the step; null: a gripper closes or opens.")]
    start: Seconds
    seconds: Seconds


class PrecedenceEntry(Model):
    """Motion `after` begins only when motion `before` has come to `offset` seconds of its nominal time."""

    before: Index
    offset: Seconds
    after: Index
    why: Reason


class ScheduleEntry(Model):
    """What may take place at the same time."""

    makespan: Annotated[float, Meta(ge=0, description="End of the last motion without delays.")]
    sequential: Annotated[float, Meta(ge=0, description="The same motions one after the other.")]
    lower_bound: Annotated[float, Meta(ge=0, description="No order of these motions takes less.")]
    motions: Annotated[list[MotionEntry], Meta(description="In the order of the steps.")]
    precedences: list[PrecedenceEntry]


class RobotPlanFile(Model):
    """Robot plan file."""

    format: Literal["falsework.robot-plan/3"]
    direction: Annotated[
        Literal["assembly", "disassembly"],
        Meta(description="Order in which the motions are executed; keyframes and steps are in that order."),
    ]
    cell: CellEntry
    plan: Annotated[
        dict[str, Any],
        Meta(
            description="Abstract plan with proofs, in the order of assembly, format falsework.plan/4.",
            extra_json_schema={"required": ["format", "steps"]},
        ),
    ]
    keyframes: Annotated[list[KeyframeEntry], Meta(description="One before each step, and one after the last.")]
    steps: Annotated[
        list[StepEntry],
        Meta(
            description="One for every action of the plan, and two for each hand-over: a robot takes a held part over, "
            "then the other leaves it. Transits have no action."
        ),
    ]
    schedule: Annotated[
        ScheduleEntry | None,
        Meta(description="What may take place at the same time; null: one motion after the other."),
    ]
    statistics: dict[str, Any]


def robot_plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of robot plan files; `plan` in it follows `falsework.search.plan_schema`."""
    about = (
        "A plan with the motions that carry it out, in the order in which they are executed, and with a schedule where "
        "robots move at the same time. Units are SI: metres, radians, seconds."
    )
    return model_schema(RobotPlanFile, "robot-plan-3", "falsework robot plan, version 3", about)

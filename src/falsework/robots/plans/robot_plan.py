"""Robot plan: an abstract plan with the trajectories that execute it, and a schedule if robots move together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, States
from falsework.errors import PlanError
from falsework.robots.model.cell import Cell, cell_identity
from falsework.robots.model.shapes import Array
from falsework.robots.plans.trajectory import Trajectory
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_source import made_for
from falsework.search.problem.task import Direction
from falsework.utils.display.notebook import Displayed
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.robots.plans.temporal_graph import TemporalPlanGraph

_SAME_POSE = 1e-9
"""Entries of poses that differ by no more are equal."""


@dataclass(frozen=True, eq=False)
class RobotRecord:
    """Robot of a plan, described without its cell file."""

    name: str
    model: str
    joint_names: tuple[str, ...]
    base: Array
    """Pose of the base in the world, shape (4, 4)."""
    gripper: str
    tool: Array
    """Tool frame in the frame of the flange, shape (4, 4)."""


def records_of(cell: Cell) -> tuple[RobotRecord, ...]:
    """Return the records of the robots of a cell for a plan."""
    return tuple(
        RobotRecord(
            robot.name,
            robot.model.name,
            tuple(robot.model.joint_names),
            np.array(robot.base),
            robot.gripper.name,
            np.array(robot.gripper.tool),
        )
        for robot in cell.robots
    )


def record_fault(records: Sequence[RobotRecord], cell: Cell) -> str:
    """Return how the robots that a plan records differ from those of a cell, in its order; empty if they do not."""
    wanted = records_of(cell)
    if len(records) != len(wanted):
        return f"has {len(records)} robots, the cell {cell.name} has {len(wanted)}"
    for number, (mine, robot) in enumerate(zip(records, wanted, strict=True)):
        for entry in fields(RobotRecord):
            here, there = getattr(mine, entry.name), getattr(robot, entry.name)
            if isinstance(there, np.ndarray):
                if here.shape != there.shape or not np.abs(here - there).max() <= _SAME_POSE:
                    return f"has another {entry.name} pose for robot {robot.name} than the cell {cell.name}"
            elif here != there:
                what = entry.name.replace("_", " ")
                return f"says {here!r} as the {what} of robot {number}, not {there!r} as the cell {cell.name}"
    return ""


@dataclass(frozen=True, eq=False)
class Partner:
    """Another robot of a step in which several parts move at the same instant, each carried by its own robot."""

    robot: int
    trajectories: tuple[Trajectory, ...]
    """Each at the same times as that of the step."""


@dataclass(frozen=True, eq=False)
class RobotStep:
    """Action of the plan, or half of a hand-over, executed by one robot, or by several in which each moves its part.

    A hand-over is two steps, between which two robots hold a part: one takes it over, then the other leaves it.
    """

    robot: int
    trajectories: tuple[Trajectory, ...]
    """Trajectories in time order."""
    hands_over: int | None = None
    """Held part that the robot takes over from another one, or leaves to it; the state of the structure stays."""
    put_down: Array | None = None
    """Where the part of a removal, or an insertion, lies on the floor while the robot grips it in another way: its
    displacement from its place in the structure, shape (4, 4). None: it stays in the gripper."""
    transit: bool = False
    """Whether robots only go to other places, without an action: empty, with removed parts, or with held ones that make
    way for others for a time."""
    gripped: Array | None = None
    """Configuration in which the robot would hold the part of a transit at its place in the structure, shape (joints,);
    None: it carries no part, or has held it there."""
    partners: tuple[Partner, ...] = ()
    """Robots that move their own parts at the same instant; what each carries on alone is in transits."""

    @property
    def robots(self) -> tuple[int, ...]:
        """Robots that move."""
        return (self.robot, *(partner.robot for partner in self.partners))

    def of(self, robot: int) -> tuple[Trajectory, ...]:
        """Return the trajectories of one of its robots."""
        found = {partner.robot: partner.trajectories for partner in self.partners}
        return self.trajectories if robot == self.robot else found[robot]

    @property
    def seconds(self) -> float:
        """Duration of the robot's motions."""
        return sum(trajectory.seconds for trajectory in self.trajectories)

    def reverse(self) -> RobotStep:
        """Return the step in the other order."""
        partners = tuple(Partner(one.robot, _reversed(one.trajectories)) for one in self.partners)
        return replace(self, trajectories=_reversed(self.trajectories), partners=partners)


def _reversed(trajectories: Sequence[Trajectory]) -> tuple[Trajectory, ...]:
    return tuple(trajectory.reverse() for trajectory in reversed(trajectories))


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Configurations of all robots between two steps, and the parts that they hold (paper, section 6).

    Between the two steps of a hand-over two robots hold the same part.
    """

    configurations: tuple[Array, ...]
    """Joint values of every robot."""
    held: tuple[int | None, ...]
    """The installed part that each robot holds."""
    carried: tuple[int | None, ...] = ()
    """The part that each robot has in its gripper, away from its place, for a time or for good; empty: none has one."""

    waits: tuple[tuple[int, Array], ...] = ()
    """Parts of the structure that wait half way out, in no gripper, with displacements from their places, (4, 4)."""

    def load(self, robot: int) -> int | None:
        """Return the part that a robot carries."""
        return self.carried[robot] if self.carried else None


@dataclass(frozen=True, eq=False)
class RobotPlan(Displayed):
    """Abstract plan, the keyframe of each of its states, and the motions between them."""

    plan: Plan
    """States, actions, proofs, in the order of assembly."""
    keyframes: tuple[Keyframe, ...]
    """One keyframe before each step, and one after the last."""
    steps: tuple[RobotStep, ...]
    """One step for every action of the plan, two for each hand-over, and one for each transit."""
    robots: tuple[RobotRecord, ...]
    cell_name: str
    cell_identity: str
    """Digest of the cell, see `cell_identity`."""
    cell_source: str | None = None
    """Name of the built-in cell, or path of the cell file relative to the file of the plan."""
    statistics: dict[str, Any] = field(default_factory=dict)
    """Statistics of the search: seconds, seed, counts."""
    schedule: TemporalPlanGraph | None = None
    """Schedule of simultaneous motions; None: one after the other."""
    direction: Direction = Direction.ASSEMBLY
    """Order in which the motions are executed, and keyframes and steps are listed."""
    before: tuple[int, ...] = ()
    """Robots of the first steps of the plan, in the order of assembly, that have no motions: they were done before, by
    the plan that this one goes on from."""
    after: tuple[int, ...] = ()
    """The same of its last steps: they were undone before, in disassembly."""

    def __post_init__(self) -> None:
        actions = sum(acts(step) for step in self.steps)
        if len(self.keyframes) != len(self.steps) + 1 or actions != len(self.plan) - len(self.before) - len(self.after):
            raise PlanError(
                f"{len(self.keyframes)} keyframes and {len(self.steps)} steps, {len(self.steps) - actions} of them "
                f"hand-overs or transits, do not match a plan of {len(self.plan)} actions; plan again"
            )

    def __len__(self) -> int:
        return len(self.steps)

    def __repr__(self) -> str:
        by = ", ".join(robot.name for robot in self.robots)
        what = f"{self.direction.value} in {counted(self.executed, 'step')} by {by}, {self.makespan:.1f} s"
        return f"<RobotPlan of {self.plan.name} in {self.cell_name}: {what}>"

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """Index of the state of the plan at each keyframe, shape (keyframes,)."""
        return self.done if self.direction is Direction.ASSEMBLY else len(self.plan) - self.done

    @cached_property
    def done(self) -> NDArray[np.int64]:
        """Number of actions executed before each keyframe, shape (keyframes,)."""
        return np.cumsum([len(self.done_by), *(acts(step) for step in self.steps)])

    @property
    def executed(self) -> int:
        """Number of steps of the plan that it executes; `len` counts changes of grip and transits too."""
        return int(self.done[-1] - self.done[0])

    @property
    def done_by(self) -> tuple[int, ...]:
        """Robots of the actions that were executed before the first keyframe, in their order."""
        return self.before if self.direction is Direction.ASSEMBLY else self.after[::-1]

    def number(self, step: int) -> int:
        """Return the number of the plan's step that a step executes; if it has none, of the last one that has."""
        return int(self.rows[step : step + 2].max())

    @cached_property
    def states(self) -> States:
        """State at each keyframe, shape (keyframes, parts)."""
        return self.plan.states[self.rows]

    @cached_property
    def actions(self) -> NDArray[np.int64]:
        """Action of each step as in `Plan.actions`; half a hand-over has its part, like a hold, and a transit -1.

        Shape (steps,).
        """
        found = np.array([-1 if step.hands_over is None else step.hands_over for step in self.steps], dtype=np.int64)
        own = self.plan.actions[len(self.before) : len(self.plan) - len(self.after)]
        found[np.diff(self.done) > 0] = own if self.direction is Direction.ASSEMBLY else own[::-1]
        return found

    @property
    def seconds(self) -> float:
        """Total duration of the motions, one after the other."""
        return sum(step.seconds for step in self.steps)

    @property
    def makespan(self) -> float:
        """Duration of the schedule, or of sequential motions without a schedule."""
        return self.seconds if self.schedule is None else self.schedule.makespan

    def part_of(self, step: int, robot: int) -> int | None:
        """Return the part that a robot of a step removes or inserts; None if the step does neither."""
        part = int(self.actions[step]) - len(self.plan.boundary)
        if part < 0 or robot == self.steps[step].robot:
            return part if part >= 0 else None
        return self.in_hand(step + (self.direction is Direction.ASSEMBLY))[robot]

    @cached_property
    def standing(self) -> NDArray[np.bool_]:
        """Which parts are in place at each keyframe, shape (keyframes, parts); none that is carried, or waits."""
        found = self.states != REMOVED
        for row, frame in enumerate(self.keyframes):
            found[row, [part for part in frame.carried if part is not None]] = False
            found[row, [part for part, _ in frame.waits]] = False
        return found

    def resting(self, step: int) -> NDArray[np.bool_]:
        """Return the parts that are in place while the arms of a step move, shape (parts,)."""
        before, after = self.standing[step : step + 2]
        return before & after if self.grip(step) is None else before | after

    def waiting(self, step: int) -> dict[int, Array]:
        """Return the parts that wait while the arms of a step move, with their displacements, shape (4, 4)."""
        before, after = (dict(self.keyframes[k].waits) for k in (step, step + 1))
        if self.grip(step) is not None:
            return before | after
        return {part: pose for part, pose in before.items() if part in after}

    def aside(self, keyframe: int) -> dict[int, int]:
        """Return the parts of the structure that robots carry away from their places for a time, by robot."""
        loads = enumerate(self.keyframes[keyframe].carried)
        return {robot: part for robot, part in loads if part is not None and self.states[keyframe, part] != REMOVED}

    def in_hand(self, keyframe: int) -> tuple[int | None, ...]:
        """Return the part of the structure that each robot holds, in place or aside."""
        aside = self.aside(keyframe)
        return tuple(aside.get(robot, part) for robot, part in enumerate(self.keyframes[keyframe].held))

    def grip_of(self, robot: int, part: int) -> Array | None:
        """Return the configuration in which a robot holds a part last before it leaves; None if it never does."""
        frames = self.keyframes if self.direction is Direction.ASSEMBLY else self.keyframes[::-1]
        return next((frame.configurations[robot] for frame in frames if frame.held[robot] == part), None)

    def grip(self, step: int) -> Literal["close", "open"] | None:
        """Return what the gripper of a step does at a part in place, or one that waits; None if it does nothing."""
        action = int(self.actions[step])
        if action < 0:
            robot = self.steps[step].robot
            takes, leaves = (self.in_hand(k)[robot] is None for k in (step, step + 1))
            return None if takes == leaves else "close" if takes else "open"
        if action >= len(self.plan.boundary):
            return None
        if self.steps[step].hands_over is not None:
            return "close" if self.keyframes[step + 1].held[self.steps[step].robot] == action else "open"
        return "close" if self.states[step + 1][action] == HELD else "open"

    def does(self, step: int) -> str:
        """Describe what a step does, such as `remove keystone` or `take keystone over from left`."""
        entry = self.steps[step]
        if entry.transit:
            legs = [leg for robot in entry.robots for leg in entry.of(robot)]
            carried = list(dict.fromkeys(leg.part for leg in legs if leg.part is not None))
            for k, does in ((step, "let go of"), (step + 1, "take")):
                if self.grip(step) and (part := self.in_hand(k)[entry.robot]) is not None:
                    return f"{does} {self.plan.part_names[part]}"
            if not carried:
                return "go to another place"
            names = " and ".join(self.plan.part_names[part] for part in carried)
            home = step + 1
            while home < len(self) and self.steps[home].transit and self.grip(home) == "open":
                home += 1
            where = "back" if self.standing[home, carried].all() else "aside"
            return f"move {names} {where}" if (self.states[step, carried] != REMOVED).all() else f"carry {names}"
        parts, held = self.plan.part_names, self.keyframes[step].held
        if entry.hands_over is None:  # newtons are left out: those of the plan are not those in the cell
            done = self.plan.in_order(self.direction)[int(self.done[step])]
            by = {part: robot.name for part, robot in zip(held, self.robots, strict=True)}
            presses = [f"{by.get(one.part, 'no robot')} presses {parts[one.part]}" for one in done.presses]
            what = "; ".join([f"{done.action} {done.name}", *presses])
            return what if entry.put_down is None else f"{what}, put down and gripped again on the way"
        name, others = parts[entry.hands_over], [k for k, one in enumerate(held) if one == entry.hands_over]
        other = " and ".join(self.robots[k].name for k in others if k != entry.robot) or "no robot"
        return f"take {name} over from {other}" if self.grip(step) == "close" else f"leave {name} to {other}"

    def describe(self, step: int) -> str:
        """Describe a step, such as `left: remove keystone (3.1 s)`."""
        names = " and ".join(self.robots[robot].name for robot in self.steps[step].robots)
        return f"{names}: {self.does(step)} ({self.steps[step].seconds:.1f} s)"

    def moves(self) -> Iterator[tuple[int, int, Trajectory]]:
        """Yield all trajectories in time order: step, robot, trajectory."""
        for index, step in enumerate(self.steps):
            for robot in step.robots:
                for trajectory in step.of(robot):
                    yield index, robot, trajectory

    def reverse(self) -> RobotPlan:
        """Return the motions in the other order: assembly from disassembly, or back."""
        steps = tuple(step.reverse() for step in reversed(self.steps))
        schedule = None if self.schedule is None else self.schedule.reverse()
        other = Direction.DISASSEMBLY if self.direction is Direction.ASSEMBLY else Direction.ASSEMBLY
        return replace(self, keyframes=self.keyframes[::-1], steps=steps, schedule=schedule, direction=other)

    def check_identity(self, assembly: Assembly, cell: Cell) -> None:
        """Raise PlanError unless the plan is for this structure in this cell, and names their parts and robots."""
        if assembly.identity != self.plan.identity:
            other = f"the robot plan is for another {self.plan.name} than this {assembly.name}"
            raise PlanError(f"{other}; {made_for(self.plan)}")
        names = tuple(assembly.names)
        if tuple(self.plan.part_names) != names:
            part = next(k for k, pair in enumerate(zip(self.plan.part_names, names, strict=True)) if pair[0] != pair[1])
            raise PlanError(
                f"the robot plan calls part {part} {self.plan.part_names[part]!r}, the structure calls it "
                f"{names[part]!r}; plan again"
            )
        if not np.array_equal(self.plan.boundary, assembly.boundary):
            part = assembly.names[int(np.argmax(self.plan.boundary != assembly.boundary))]
            raise PlanError(f"part {part} is boundary in either the robot plan or the structure only; plan again")
        self.check_cell(cell)

    def cell_place(self, file: Path | str) -> str:
        """Return the cell that a plan in a file names, for `load_cell`: a file as seen from it, or a built-in cell.

        PlanError if it names none.
        """
        if self.cell_source is None:
            raise PlanError(f"{file} does not say where its cell is; name it (--cell, or cell= in Python)")
        beside = Path(file).resolve().parent / self.cell_source
        return str(beside) if beside.is_file() else self.cell_source

    def check_cell(self, cell: Cell) -> None:
        """Raise PlanError unless the plan is for this cell, and the robots that it records are those of the cell."""
        if cell_identity(cell) != self.cell_identity:
            raise PlanError(
                f"the robot plan is for another cell {self.cell_name} than this {cell.name}: something in it differs; "
                "give the cell that it was made for, or plan again"
            )
        if fault := record_fault(self.robots, cell):
            raise PlanError(f"the robot plan {fault}; plan again")


def acts(step: RobotStep) -> bool:
    """Return whether a step has an action of the plan: it is neither half of a hand-over nor a transit."""
    return step.hands_over is None and not step.transit

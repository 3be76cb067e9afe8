"""Every fact that executed programs rest on: a forgery of each is refused with the message that the page gives."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly
from falsework.errors import CellError, PlanError
from falsework.geometry.clearance.moves import PathMove
from falsework.robots import Cell, Obstacle, Placement, RobotPlan, Trajectory
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.keyframes.keyframes import PathSegment
from falsework.robots.keyframes.trajectory_assembly import timed_legs
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.shapes import block
from falsework.robots.plans.robot_plan import Keyframe, Partner, RobotStep, records_of
from falsework.robots.plans.robot_plan_file import robot_plan_from_dict, robot_plan_to_dict
from falsework.search.plans.plan_check import validate_plan
from falsework.stability.holds import Press
from tests.robots.plans.conftest import make_cell
from tests.robots.plans.test_waiting import pit, planned

PAGE = Path(__file__).resolve().parents[3] / "docs" / "robot-plan-checks.md"
ROWS = re.findall(r"^\| ([^|]+?) \|[^|]*\|[^|]*\| `([^`]+)` \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)

UP = PathMove((1,), (0.0, 0.0, 1.0), 0.1)
HOLD, REMOVE = 0, 1
"""Steps of the plan: arm 1 holds the upper cube with a free motion and a line, and removes it with a line and a free
motion."""


@dataclass(frozen=True)
class Case:
    """A plan with its structure and cell, before something is forged."""

    plan: RobotPlan
    assembly: Assembly
    cell: Cell

    def moved(self, step: int, order: int, **changes: Any) -> Case:
        """Change one trajectory."""
        legs = list(self.plan.steps[step].trajectories)
        legs[order] = replace(legs[order], **changes)
        return self.stepped(step, trajectories=tuple(legs))

    def stepped(self, step: int, **changes: Any) -> Case:
        """Change one step."""
        steps = list(self.plan.steps)
        steps[step] = replace(steps[step], **changes)
        return replace(self, plan=replace(self.plan, steps=tuple(steps), schedule=None))

    def framed(self, index: int, robot: int, values: np.ndarray) -> Case:
        """Change the configuration of one robot at one keyframe."""
        frames = list(self.plan.keyframes)
        configurations = list(frames[index].configurations)
        configurations[robot] = values
        frames[index] = replace(frames[index], configurations=tuple(configurations))
        return replace(self, plan=replace(self.plan, keyframes=tuple(frames), schedule=None))

    def recorded(self, **changes: Any) -> Case:
        """Change what the plan says about its first robot."""
        robots = (replace(self.plan.robots[0], **changes), *self.plan.robots[1:])
        return replace(self, plan=replace(self.plan, robots=robots))

    def armed(self, **changes: Any) -> Case:
        """Change the grippers of the cell, and what the plan says about them."""
        robots = tuple(replace(robot, gripper=replace(robot.gripper, **changes)) for robot in self.cell.robots)
        return self.in_cell(robots=robots)

    def in_cell(self, **changes: Any) -> Case:
        """Change the cell, and make the plan say that it is for this cell."""
        cell = replace(self.cell, **changes)
        plan = replace(self.plan, cell_identity=cell_identity(cell), robots=records_of(cell))
        return replace(self, plan=plan, cell=cell)

    def tool(self, step: int, order: int, row: int) -> np.ndarray:
        """Return the tool pose at a knot of a trajectory."""
        robot = self.plan.steps[step].robot
        return tool_pose(self.cell.robots[robot], self.plan.steps[step].trajectories[order].positions[row])

    def reach(self, tool: np.ndarray, near: np.ndarray, robot: int = 0) -> np.ndarray:
        """Return the configuration nearest to another one that brings the tool to a pose."""
        found = inverse(self.cell.robots[robot], tool[None])[0]
        return found[np.argmin(np.abs(found - near).max(axis=1))]

    def path(self, start: np.ndarray, *shifts: np.ndarray, **more: Any) -> Trajectory:
        """Return a timed motion of arm 1 on which its tool is moved to shifted poses without turning."""
        at, points = tool_pose(self.cell.robots[0], start), [start]
        for begin, end in zip((np.zeros(3), *shifts[:-1]), shifts, strict=True):
            for share in np.linspace(0, 1, 21)[1:]:
                goal = at.copy()
                goal[:3, 3] += begin + share * (np.asarray(end) - begin)
                points.append(self.reach(goal, points[-1]))
        made = timed_legs([self.cell.robots[0].model], [PathSegment("line", np.array(points))], self.cell.speed)[0]
        assert made is not None
        return replace(made, **more)


def shifted(pose: np.ndarray, *, by: float = 0.0, turn: float = 0.0, along: int = 2) -> np.ndarray:
    """Return a tool pose moved along one of its axes, and turned about its own x, in degrees."""
    made = pose.copy()
    made[:3, 3] += by * pose[:3, along]
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    made[:3, :3] = pose[:3, :3] @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return made


def gripped_at(case: Case, **moved: Any) -> Case:
    """Let arm 1 hold the upper cube with its tool elsewhere."""
    grip = case.plan.keyframes[HOLD + 1].configurations[0]
    return case.framed(HOLD + 1, 0, case.reach(shifted(case.tool(HOLD, 1, -1), **moved), grip))


def at_face(case: Case, *, beside: float = 0.0, depth: float = 0.0) -> Case:
    """Let arm 1 hold the upper cube with its tool at the middle of the gripped face, or beside it, along the cube."""
    grip = case.plan.keyframes[HOLD + 1].configurations[0]
    way = np.round(case.tool(HOLD, 1, -1)[:3, 2])
    across = np.roll(way, 1)
    low, high = case.assembly.meshes[1].bounds
    tool = np.eye(4)
    tool[:3, :3] = np.stack([across, np.cross(way, across), way], axis=1)
    tool[:3, 3] = (low + high) / 2 + (depth - (high - low)[0] / 2) * way + beside * across
    return case.framed(HOLD + 1, 0, case.reach(tool, grip))


def longer_line(case: Case, length: float) -> Case:
    """Replace the approach by a longer line from farther away."""
    grip = case.plan.keyframes[HOLD + 1].configurations[0]
    out = case.path(
        grip, -length * case.tool(HOLD, 1, -1)[:3, 2], touches=case.plan.steps[HOLD].trajectories[1].touches
    )
    return case.stepped(HOLD, trajectories=(case.plan.steps[HOLD].trajectories[0], out.reverse()))


def rammed(case: Case) -> Case:
    """Let the gripper go on for 5 cm into the part, and come back."""
    line = case.plan.steps[HOLD].trajectories[1]
    deep = case.path(line.positions[-1], 0.05 * case.tool(HOLD, 1, -1)[:3, 2], np.zeros(3), touches=line.touches)
    return case.stepped(HOLD, trajectories=(*case.plan.steps[HOLD].trajectories, deep))


def vanished(case: Case) -> Case:
    """Remove a part without any motion."""
    grip = case.plan.keyframes[REMOVE].configurations[0]
    made = case.stepped(REMOVE, trajectories=())
    for index in range(REMOVE + 1, len(case.plan) + 1):
        made = made.framed(index, 0, grip)
    return made


def dropped(case: Case) -> Case:
    """Let go of the part where its line ends."""
    line = case.plan.steps[REMOVE].trajectories[0]
    return case.stepped(REMOVE, trajectories=(line,)).framed(REMOVE + 1, 0, line.positions[-1])


def reversed_case(case: Case) -> Case:
    return replace(case, plan=case.plan.reverse())


def bent(case: Case) -> Case:
    """Call the free motion to a part a line."""
    return case.moved(HOLD, 0, kind="line")


def faster(case: Case, factor: float) -> Case:
    leg = case.plan.steps[HOLD].trajectories[0]
    return case.moved(HOLD, 0, times=leg.times / factor, velocities=leg.velocities * factor)


def beyond(case: Case) -> Case:
    positions = case.plan.steps[HOLD].trajectories[0].positions.copy()
    positions[len(positions) // 2, 1] = 3.0
    return case.moved(HOLD, 0, positions=positions)


def rolling(case: Case) -> Case:
    velocities = case.plan.steps[HOLD].trajectories[0].velocities.copy()
    velocities[-1] = 0.1
    return case.moved(HOLD, 0, velocities=velocities)


def unstable(case: Case) -> Case:
    """Say that the lower cube is removed while the upper one is on it."""
    parts = len(case.plan.plan.boundary)
    actions = case.plan.actions.copy()
    actions[[1, 3]] = actions[[3, 1]]
    assert set(actions[[1, 3]]) == {parts, parts + 1}
    return replace(case, plan=replace(case.plan, plan=replace(case.plan.plan, actions=actions[::-1])))


def arrived_elsewhere(case: Case) -> Case:
    """Let an inserted part stop 3 cm above its place."""
    case = reversed_case(case)
    step = len(case.plan) - 1 - REMOVE
    last = case.plan.steps[step].trajectories[-1]
    end = last.positions.copy()
    end[-1] = last.positions[len(last.positions) // 2]
    return case.moved(step, len(case.plan.steps[step].trajectories) - 1, positions=end)


def long_way_out(case: Case) -> Case:
    """Lift the part for 0.6 m, shrunk where it may touch its neighbours."""
    grip = case.plan.keyframes[REMOVE].configurations[0]
    line = case.path(grip, np.array([0, 0, 0.6]), part=case.plan.steps[REMOVE].trajectories[0].part)
    return case.stepped(REMOVE, trajectories=(line, *case.plan.steps[REMOVE].trajectories[1:]))


def line_far_away(case: Case) -> Case:
    """Call the motion to the place of the cell a line, after another free motion."""
    line, free = case.plan.steps[REMOVE].trajectories
    still = replace(
        free,
        times=np.array([0.0, 1.0]),
        positions=np.repeat(free.positions[:1], 2, axis=0),
        velocities=np.zeros((2, free.positions.shape[1])),
    )
    return case.stepped(REMOVE, trajectories=(line, still, replace(free, kind="line")))


def touched_early(case: Case) -> Case:
    """Let the gripper touch its part on a line before the approach."""
    free, line = case.plan.steps[HOLD].trajectories
    return case.stepped(HOLD, trajectories=(free, line, line.reverse(), line))


def in_jaws(case: Case) -> Case:
    """Give the cell jaws that claim to open to half of a cube, with fingers 2 mm beside it."""
    fingers = tuple(block((x, -0.01, 0.12), (x + 0.02, 0.01, 0.2)) for x in (-0.122, 0.102))
    made = case.armed(kind="jaw", cup=0.0, opening=0.1, depth=0.05, pieces=fingers)
    return at_face(made, depth=0.05)


def taken(case: Case) -> Case:
    frames = list(case.plan.keyframes)
    frames[HOLD + 1] = replace(frames[HOLD + 1], held=(None, None))
    return replace(case, plan=replace(case.plan, keyframes=tuple(frames)))


def pressing(case: Case, step: int, *, held: bool = False) -> Case:
    """Let a robot press the cube beside the column with 1 kN in a step; keyframes may say that arm 2 holds it."""
    presses: list[tuple[Press, ...]] = [()] * len(case.plan.plan)
    presses[case.plan.number(step) - 1] = (Press(2, (1000.0, 0.0, 0.0, 0.0, 0.0, 0.0)),)
    frames = list(case.plan.keyframes)
    for index in (step, step + 1) if held else ():
        frames[index] = replace(frames[index], held=(frames[index].held[0], 2))
    plan = replace(case.plan.plan, presses=tuple(presses))
    return replace(case, plan=replace(case.plan, plan=plan, keyframes=tuple(frames)))


def evened(case: Case) -> Case:
    """Let the cell give parts of two materials one density."""
    assembly = case.assembly.replace(density=np.arange(100.0, 100.0 + case.assembly.part_count))
    even = case.in_cell(placement=Placement(density=100.0))
    plan = replace(even.plan, plan=replace(even.plan.plan, identity=assembly.identity))
    return replace(even, plan=plan, assembly=assembly)


def wrong_numbers(case: Case) -> str:
    data = robot_plan_to_dict(case.plan)
    data["steps"][HOLD]["trajectories"][0]["positions"][0][0] = "0.1"
    with pytest.raises(PlanError) as caught:
        robot_plan_from_dict(data)
    return str(caught.value)


def wrong_times(case: Case) -> str:
    from falsework.robots import schedule_plan

    pytest.importorskip("ortools")
    data = robot_plan_to_dict(schedule_plan(case.plan, case.assembly, case.cell))
    data["schedule"]["motions"][-1]["start"] += 1.0
    with pytest.raises(PlanError) as caught:
        robot_plan_from_dict(data)
    return str(caught.value)


def wrong_order(case: Case) -> Case:
    from falsework.robots import schedule_plan

    pytest.importorskip("ortools")
    plan = schedule_plan(case.plan, case.assembly, case.cell)
    assert plan.schedule is not None
    edges = tuple(edge for edge in plan.schedule.edges if edge.why == "arm")
    return replace(case, plan=replace(plan, schedule=replace(plan.schedule, edges=edges)))


def wrong_urdf(case: Case) -> str:
    """Turn the second joint of a description after it was read."""
    import tempfile

    from falsework.robots.checks.descriptions import description_fault
    from tests.robots.cells.arm_description import arm_model, urdf_text

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        model = arm_model(file)
        assert description_fault(model) == ""
        file.write_text(urdf_text().replace('<origin xyz="0 0 0.4"/>', '<origin xyz="0 0 0.5"/>'))
        return description_fault(model)


def stable_report(case: Case) -> str:
    return validate_plan(unstable(case).plan.plan, case.assembly).reason


def blocked(case: Case) -> Case:
    first = case.plan.steps[HOLD].trajectories[0]
    middle = first.sample(np.array([first.seconds / 2]))[0]
    tip = tool_pose(case.cell.robots[0], middle)[:3, 3]
    return case.in_cell(obstacles=(Obstacle("pillar", (block(tip - 0.03, tip + 0.03),)),))


def lifted(case: Case) -> Case:
    """Call the line on which a part leaves one on which it is moved aside, although no part needs that."""
    plan, step = case.plan, case.plan.steps[REMOVE]
    (line, *legs), frame = step.trajectories, plan.keyframes[REMOVE]
    values, held = list(frame.configurations), list(frame.held)
    carried: list[int | None] = [None] * len(held)
    values[step.robot], held[step.robot], carried[step.robot] = line.positions[-1], None, line.part
    aside = Keyframe(tuple(values), tuple(held), tuple(carried))
    steps = (RobotStep(step.robot, (line,), transit=True), replace(step, trajectories=tuple(legs)))
    forged = replace(
        plan,
        steps=(*plan.steps[:REMOVE], *steps, *plan.steps[REMOVE + 1 :]),
        keyframes=(*plan.keyframes[: REMOVE + 1], aside, *plan.keyframes[REMOVE + 1 :]),
        schedule=None,
    )
    return replace(case, plan=forged)


def waits(case: Case) -> Case:
    """Let a part that nothing moves wait at a keyframe."""
    frame = replace(case.plan.keyframes[REMOVE + 1], waits=((0, np.eye(4)),))
    frames = (*case.plan.keyframes[: REMOVE + 1], frame, *case.plan.keyframes[REMOVE + 2 :])
    abstract = replace(case.plan.plan, waiting=True)
    return replace(case, plan=replace(case.plan, plan=abstract, keyframes=frames, schedule=None))


def lidded(**rules: Any) -> Case:
    """A good plan in which one arm lays a lid aside that waits there, but for rules of its abstract plan."""
    cell = make_cell(bases=1, payload=20.0)
    plan = planned(pit(), cell, 0)
    return Case(replace(plan, plan=replace(plan.plan, **rules)), pit(), cell)


def waits_elsewhere(_: Case) -> Case:
    case, far = lidded(), np.eye(4)
    far[0, 3] = 0.05
    frames = [replace(one, waits=tuple((part, far @ pose) for part, pose in one.waits)) for one in case.plan.keyframes]
    return replace(case, plan=replace(case.plan, keyframes=tuple(frames)))


FORGED: dict[str, Callable[[Case], Case | str]] = {
    "a part that has no straight way out follows the moves of its way, which is swept": lambda case: replace(
        case,
        plan=replace(case.plan, plan=replace(case.plan.plan, exit_paths=((UP,) * 4,) * len(case.plan.plan))),
    ),
    "held parts are moved aside, and back, on the moves of a way alone": lifted,
    "parts wait, and are taken, only on the moves of a way": waits,
    "in each move of a way on which parts wait robots hold what its states have held": (lambda _: lidded(robots=2)),
    "a part begins to wait, or goes on, only where a gripper lets go of it or takes it": waits,
    "a part waits where its robot has it, and its gripper is at it": waits_elsewhere,
    "robots move at the same instant only where each has a part that leaves or comes, and by one clock": (
        lambda case: case.stepped(HOLD, partners=(Partner(1, case.plan.steps[HOLD].trajectories),))
    ),
    "the structure has the planned geometry, density and friction": lambda case: replace(
        case, assembly=case.assembly.replace(friction=0.7)
    ),
    "parts have the names of the structure": lambda case: replace(
        case,
        plan=replace(case.plan, plan=replace(case.plan.plan, part_names=tuple(case.plan.plan.part_names[::-1]))),
    ),
    "boundary parts are those of the structure": lambda case: replace(
        case, plan=replace(case.plan, plan=replace(case.plan.plan, boundary=~case.plan.plan.boundary))
    ),
    "the cell is the planned one": lambda case: replace(case, cell=replace(case.cell, speed=0.9)),
    "robots have the names of the cell, in its order": lambda case: replace(
        case, plan=replace(case.plan, robots=case.plan.robots[::-1])
    ),
    "robots are the models of the cell": lambda case: case.recorded(model="ur10e"),
    "joints have the names of the cell, in its order": lambda case: case.recorded(
        joint_names=case.plan.robots[0].joint_names[::-1]
    ),
    "bases stand where the cell has them": lambda case: case.recorded(base=np.eye(4)),
    "grippers are those of the cell": lambda case: case.recorded(gripper="welder"),
    "scale and density of the cell change all weights, and nothing else, by one factor": evened,
    "tool frames are those of the cell": lambda case: case.recorded(tool=np.eye(4)),
    "an arm is the one that its URDF file describes": wrong_urdf,
    "arms begin where the plan says": lambda case: case.framed(0, 1, np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0])),
    "bases stand free of parts, obstacles, each other and the floor": lambda case: case.in_cell(
        obstacles=(Obstacle("wall", (block((-1.3, -0.2, 0.0), (-1.0, 0.2, 0.3)),)),)
    ),
    "numbers are numbers": wrong_numbers,
    "joints stay within their ranges": beyond,
    "joints keep their speed limits": lambda case: faster(case, 3.0),
    "joints keep their acceleration limits": lambda case: faster(case, 3.0),
    "a motion ends in bounded time": lambda case: faster(case, 1e-6),
    "motions start and end at rest": rolling,
    "a motion begins where the one before has ended": lambda case: case.stepped(
        HOLD, trajectories=case.plan.steps[HOLD].trajectories[1:]
    ),
    "a line is straight, and the tool does not turn on it": bent,
    "a line on which a gripper may touch a part is short": lambda case: longer_line(case, 0.3),
    "a gripper touches only the part of its action, on a line": lambda case: case.moved(HOLD, 0, touches=0),
    "such a line ends or begins at the grip": touched_early,
    "nothing collides with parts, obstacles, other arms or itself": blocked,
    "a gripper reaches no deeper into the part that it touches than its lip yields": rammed,
    "the parts that robots hold are those that the state has held": taken,
    "a gripper is at the part that it holds": lambda case: gripped_at(case, by=-0.02),
    "the cup is flat on the face": lambda case: gripped_at(case, turn=20.0, by=-0.002),
    "the whole cup is on the face": lambda case: at_face(case, beside=0.092),
    "the cup is not deep in the part": lambda case: gripped_at(case, by=0.004),
    "a part between jaws is no wider than they open": in_jaws,
    "a held part takes no more force or moment than the gripper bears": lambda case: case.armed(force=1.0),
    "a robot presses only a part that it holds": lambda case: pressing(case, HOLD),
    "a robot presses only while another lets go of its part": lambda case: pressing(case, REMOVE),
    "a press takes no more force or moment than the gripper bears": lambda case: pressing(
        case.armed(force=900.0), HOLD, held=True
    ),
    "a carried part is within the payload of arm and gripper": lambda case: case.armed(payload=0.5),
    "a motion carries the part of its action": lambda case: case.moved(REMOVE, 1, part=None),
    "a removed part leaves its place": vanished,
    "a removed part is let go of at a place of the cell": dropped,
    "an inserted part comes from a place of the cell": lambda case: reversed_case(dropped(case)),
    "an inserted part arrives at its place": arrived_elsewhere,
    "a part may touch its neighbours only on the lines from or to its place": line_far_away,
    "the way on these lines is short": long_way_out,
    "a held part changes only by the action": taken,
    "every step keeps the rules, and every state is stable": stable_report,
    "times follow from the precedences": wrong_times,
    "states keep their order, whatever the delays": wrong_order,
}


@pytest.fixture(scope="module")
def case(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> Case:
    """A good plan: of the upper cube, the lower one, and the one beside them."""
    made = Case(robot_plan, column, cell)
    assert check_robot_plan(robot_plan, column, cell).good
    assert [step.robot for step in robot_plan.steps[:2]] == [0, 0]
    return made


def test_the_page_has_every_forgery() -> None:
    """And the other way round; no fact twice."""
    assert sorted(fact for fact, _ in ROWS) == sorted(FORGED)


@pytest.mark.parametrize(("fact", "message"), ROWS)
def test_a_forged_fact_is_refused(case: Case, fact: str, message: str) -> None:
    forged = FORGED[fact](case)
    if isinstance(forged, str):
        said = forged
    else:
        try:
            report = check_robot_plan(forged.plan, forged.assembly, forged.cell)
            assert not report.good
            said = "; ".join(map(str, report.problems))
        except (PlanError, CellError) as error:
            said = str(error)
    assert message in said, said
    assert "\n" not in said


@pytest.mark.parametrize("entry", ["positions", "velocities", "times"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_numbers_that_are_none_are_reported(case: Case, entry: str, value: float) -> None:
    """Of plans made in Python; readers refuse files with such numbers."""
    wrong = getattr(case.plan.steps[HOLD].trajectories[0], entry).copy()
    wrong[len(wrong) // 2] = value
    forged = case.moved(HOLD, 0, **{entry: wrong})
    assert not check_robot_plan(forged.plan, forged.assembly, forged.cell).good

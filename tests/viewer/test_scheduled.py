"""Robot plans with a schedule on the page and in films: arms, structure and chart at any time."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="charts need matplotlib; pip install 'falsework[picture]'")

from falsework import Assembly, Direction, Plan
from falsework.errors import InputError
from falsework.robots import Cell, RobotPlan, nodes_of
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.plans.timeline import activities_at, bars_of
from falsework.viewer import Camera, Timeline
from falsework.viewer.arms import Arms
from falsework.viewer.clock import Clock
from falsework.viewer.page.page_text import where_text
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import INK, rgb, robot_color
from falsework.viewer.pictures.gantt import strip_of
from falsework.viewer.pictures.video import frame_times, frames_of


def opened(plan: RobotPlan, cell: Cell, assembly: Assembly, direction: Direction) -> ViewerState:
    arms = Arms(plan, cell, direction)
    return ViewerState(Timeline.from_plan(plan.plan, assembly, direction, arms.holders()), plan=plan.plan, arms=arms)


def clock_of(model: ViewerState) -> Clock:
    assert model.clock is not None
    return model.clock


def arms_of(model: ViewerState) -> Arms:
    assert model.arms is not None
    return model.arms


@pytest.mark.parametrize("direction", list(Direction))
def test_events_show_states_and_keyframes(
    scheduled: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan], direction: Direction
) -> None:
    model = opened(scheduled, cell, arch[0], direction)
    clock, plan = clock_of(model), arms_of(model).plan

    def place_of(done: int) -> int:
        """Return the place in the plan after so many actions have been executed."""
        return done if direction is Direction.ASSEMBLY else len(plan) - done

    for step, (seconds, event) in enumerate(zip(clock.events, nodes_of(plan)[1], strict=True)):
        model.go_to_reading(seconds)
        reached = int((clock.events <= seconds).sum())
        np.testing.assert_array_equal(model.state, plan.plan.states[place_of(reached)])
        # A part leaves as its arm sets off from a keyframe; it is at its place, or held, as its arm comes to one.
        grips = int(plan.actions[step]) < len(plan.plan.boundary)
        after = event.at_end or (grips and direction is Direction.DISASSEMBLY)
        robot = plan.steps[step].robot
        doing = next(arm for arm in activities_at(plan, clock.starts, seconds) if arm.robot == robot)
        expected = plan.keyframes[step + after].configurations[robot]
        np.testing.assert_allclose(doing.at(np.array([seconds]))[0], expected, atol=1e-9)
        before = seconds - 1e-6
        model.go_to_reading(before)
        np.testing.assert_array_equal(model.state, plan.plan.states[place_of(int((clock.events <= before).sum()))])


def test_two_arms_move_at_the_same_time(scheduled: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]) -> None:
    model = opened(scheduled, cell, arch[0], Direction.DISASSEMBLY)
    arms, clock = arms_of(model), clock_of(model)
    both = [
        seconds
        for seconds in np.arange(0.25, clock.makespan, 0.5)
        if all(arm.trajectory is not None for arm in activities_at(arms.plan, clock.starts, seconds))
    ]
    assert both
    owner = np.array([link.robot for link in arms.links])
    for seconds in both:
        model.go_to_reading(seconds)
        shown = model.arm_poses()
        assert shown is not None
        for robot in range(2):
            for place in (model.step, max(model.step - 1, 0)):
                still = arms.at(place).poses
                assert np.abs((shown.poses - still)[owner == robot]).max() > 1e-3
        assert f"{seconds:.1f} s of {clock.makespan:.1f} s" in where_text(model, ask=False)


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("direction", list(Direction))
def test_carried_parts_go_with_their_grippers(
    scheduled: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan], direction: Direction, timed: bool
) -> None:
    """With a schedule, and one motion after the other."""
    scheduled = scheduled if timed else replace(scheduled, schedule=None)
    model = opened(scheduled, cell, arch[0], direction)
    arms, clock = arms_of(model), clock_of(model)
    in_tool: dict[int, list[np.ndarray]] = {}
    for seconds in np.arange(0.0, clock.makespan, 0.2):
        model.go_to_reading(seconds)
        doing = list(activities_at(arms.plan, clock.starts, seconds))
        moving = {arm.trajectory.part for arm in doing if arm.trajectory is not None} - {None}
        poses, appearance = model.arm_poses(), model.appearance()
        assert poses is not None
        assert moving <= {carried.part for carried in poses.carried}
        for carried in poses.carried:
            assert appearance.opacity[carried.part] == 0
            point = carried.pose[:3, :3] @ arch[0].mass.center[carried.part] + carried.pose[:3, 3]
            world = cell.placement.pose[:3, :3] @ (point * cell.placement.scale) + cell.placement.pose[:3, 3]
            values = doing[carried.robot].at(np.array([seconds]))[0]
            tool = tool_pose(cell.robots[carried.robot], values)
            in_tool.setdefault(carried.part, []).append(np.linalg.inv(tool) @ [*world, 1.0])
    assert len(in_tool) == int((scheduled.plan.actions >= len(scheduled.plan.boundary)).sum())
    for found in in_tool.values():
        np.testing.assert_allclose(found, np.broadcast_to(found[0], (len(found), 4)), atol=1e-9)


def test_positions_and_seconds(scheduled: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]) -> None:
    model = opened(scheduled, cell, arch[0], Direction.DISASSEMBLY)
    clock = clock_of(model)
    positions = [clock.position(seconds) for seconds in np.linspace(0, clock.makespan, 500)]
    assert (np.diff(positions) <= 0).all()
    assert (positions[0], positions[-1]) == (len(scheduled), 0.0)
    for seconds in (0.3, 0.6 * clock.makespan):
        assert clock.seconds(clock.position(seconds)) == pytest.approx(seconds)
    model.go_to_reading(0.6 * clock.makespan)
    shown = model.state
    model.turn(Direction.ASSEMBLY)
    np.testing.assert_array_equal(model.state, shown)
    assert clock_of(model).position(model.seconds) >= model.position
    model.go_to_reading(1e9)
    assert model.reading == model.last_reading == arms_of(model).plan.makespan


def test_films_last_as_long_as_the_schedule(scheduled: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]) -> None:
    assert frame_times(2.3, 2.0, 1.0) == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.3])
    assert len(frame_times(60.0, 10.0, 1.0)) == 601
    assert len(frame_times(60.0, 10.0, 4.0)) == 151
    for speed in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="above zero"):
            frame_times(1.0, 10.0, speed)
    model = opened(scheduled, cell, arch[0], Direction.DISASSEMBLY)
    options = {"seconds": 1.0, "rate": 1.0, "camera": Camera(width=160, height=100, samples=1)}
    pictures = list(frames_of(model.timeline, arms=model.arms, speed=8.0, **options))
    assert len(pictures) == int(np.ceil(scheduled.makespan / 8)) + 1
    strip = strip_of(scheduled, 160)
    for picture, seconds in zip(pictures, frame_times(scheduled.makespan, 1.0, 8.0), strict=True):
        np.testing.assert_array_equal(picture[-len(strip.pixels) :], strip.marked(seconds))
    sequential = replace(scheduled, schedule=None)
    slow = frames_of(model.timeline, arms=Arms(sequential, cell, Direction.DISASSEMBLY), speed=8.0, **options)
    assert len(list(slow)) == int(np.ceil(sequential.makespan / 8)) + 1 > len(pictures)


def test_the_marker_is_where_the_bars_are(scheduled: RobotPlan) -> None:
    strip = strip_of(scheduled, 400)
    left, top, width, height = strip.box
    assert strip.mark(0.0) == left
    assert strip.mark(scheduled.makespan) == pytest.approx(left + width)
    rows, columns = strip.pixels.shape[:2]
    assert (rows % 2, columns) == (0, 400)
    for bar in bars_of(scheduled):
        row = round((top + height * (bar.robot + 0.5) / len(scheduled.robots)) * rows)
        middle = (bar.begin + bar.end) / 2
        if bar.does != "holds":
            assert tuple(strip.pixels[row, int(strip.mark(middle) * columns)]) == rgb(robot_color(bar.robot))
        marked = strip.marked(middle)
        (changed,) = np.nonzero((marked != strip.pixels).any(axis=2)[row])
        assert np.abs(changed + 0.5 - strip.mark(middle) * columns).max() <= 1.5
        assert tuple(marked[row, changed[0]]) == rgb(INK)


def test_a_page_has_seconds_and_a_chart_as_long_as_there_are_arms(
    scheduled: RobotPlan, cell: Cell, arch: tuple[Assembly, Plan]
) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    from falsework.viewer.page.page import Page

    model = opened(scheduled, cell, arch[0], Direction.DISASSEMBLY)
    page = Page(model, port=8250)
    try:
        slider, chart, marker = page.play.slider, page.play.gantt, page.play.marker
        assert slider.label == "Seconds"
        assert scheduled.makespan <= slider.max < scheduled.makespan + 0.1
        first = marker.content
        slider.value = 5.0
        assert model.seconds == 5.0
        assert "<svg" in chart.content
        assert chart.content.count("/go?seconds=") == len(bars_of(scheduled))
        assert marker.content != first
        page.play.speed.value = 8.0
        page.play.toggle()
        end = time.monotonic() + 60
        while page.play.playing.is_set():
            assert time.monotonic() < end, "the plan is not played to its end"
            time.sleep(0.05)
        assert model.seconds == scheduled.makespan
        assert slider.value == slider.max
        assert page.play.where.content.startswith(f"{scheduled.makespan:.1f} s of {scheduled.makespan:.1f} s")
        model.arms = Arms(replace(scheduled, schedule=None), cell, Direction.DISASSEMBLY)
        page.plan_changed("other arms")
        assert model.last_reading == pytest.approx(scheduled.seconds)
        assert chart.content.count("/go?seconds=") > 0
        model.arms = None
        page.plan_changed("no arms")
        assert (slider.label, slider.max, chart.content) == ("Step", len(scheduled), "")
    finally:
        page.close()

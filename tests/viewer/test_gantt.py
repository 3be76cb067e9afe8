"""Gantt charts of robot plans."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from falsework import Direction
from falsework.cli.command import ViewableOptions
from falsework.cli.main import main
from falsework.errors import InputError
from falsework.robots import Cell, Keyframe, Precedence, RobotPlan, RobotStep, Trajectory, nodes_of
from falsework.robots.plans.robot_plan import RobotRecord
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import bars_of
from falsework.search.plans.plan_file import plan_from_dict
from falsework.viewer.pictures.gantt import draw_gantt
from falsework.viewer.pictures.joint_plot import draw_joints, joint_values

pytest.importorskip("matplotlib", reason="charts need matplotlib; pip install 'falsework[picture]'")


def motion(seconds: float, part: int | None = None) -> Trajectory:
    still = np.zeros((2, 1))
    return Trajectory("free", np.array([0.0, seconds]), still, still, part)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> RobotPlan:
    """Two blocks on each other that two arms take away."""
    file = tmp_path_factory.mktemp("plan") / "plan.json"
    assert main(["plan", "stack:blocks=2", "--robots", "1", "--out", str(file)]) == 0
    abstract = plan_from_dict(json.loads(file.read_text()))
    parts, robot, held, frames, steps = len(abstract.boundary), 0, [None, None], [], []
    values = (np.zeros(1), np.zeros(1))
    frames.append(Keyframe(values, tuple(held)))
    for action in abstract.route.actions.tolist():
        part = action % parts
        removes = action >= parts
        held[robot] = None if removes else part
        steps.append(RobotStep(robot, (motion(2.0, part if removes else None),)))
        frames.append(Keyframe(values, tuple(held)))
        robot = (robot + removes) % 2
    record = RobotRecord("arm", "model", ("joint",), np.eye(4), "cup", np.eye(4))
    made = RobotPlan(abstract, tuple(frames), tuple(steps), (record, record), "cell", "0")
    return replace(made, direction=Direction.DISASSEMBLY)


def test_bars_of_a_plan_one_by_one(plan: RobotPlan) -> None:
    bars = bars_of(plan)
    assert [bar.does for bar in bars if bar.robot == 0][:2] == ["moves", "carries"]
    assert max(bar.end for bar in bars) == pytest.approx(plan.seconds)


def test_an_arm_that_holds_is_shown_holding(plan: RobotPlan) -> None:
    nodes, _ = nodes_of(plan)
    first = [k for k, node in enumerate(nodes) if node.robot == 0]
    arms = [Precedence(a, nodes[a].seconds, b, "arm") for a, b in pairwise(first)]
    other = next(k for k, node in enumerate(nodes) if node.robot == 1)
    late = Precedence(other, nodes[other].seconds, first[-1], "volume")
    graph = TemporalPlanGraph(nodes, (*arms, late), 2, 0.0)
    scheduled = replace(plan, schedule=graph)
    assert scheduled.makespan < plan.seconds
    assert len(bars_of(scheduled)) >= len(nodes) // 2


@pytest.mark.parametrize("name", ["chart.png", "chart.svg"])
def test_charts_are_drawn(plan: RobotPlan, tmp_path: Path, name: str) -> None:
    assert draw_gantt(plan, tmp_path / name) == len(bars_of(plan))
    assert (tmp_path / name).stat().st_size > 1000


def test_a_chart_is_drawn_from_the_command_line_as_asked(
    plan: RobotPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shown = SimpleNamespace(arms=SimpleNamespace(plan=plan))
    monkeypatch.setattr(ViewableOptions, "open", lambda self: shown)
    assert main(["picture", "plan.json", "--gantt", "--out", "chart.svg"]) == 0
    assert (tmp_path / "chart.svg").read_text().startswith("<?xml")
    assert capsys.readouterr().out.splitlines()[-1].startswith("chart.svg: 2 arms over")
    for given, message in (
        (("--out", "chart.mp4"), "a video such as chart.mp4 has no --gantt"),
        (
            ("--step", "1", "--forces"),
            "a Gantt chart has no --step and --forces; leave them out, or draw something else",
        ),
        (("--width=-5",), "-5"),
    ):
        assert main(["picture", "plan.json", "--gantt", *given]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


def test_joints_over_time(scheduled: RobotPlan, cell: Cell, tmp_path: Path) -> None:
    """Positions join, are those of the keyframes at both ends, and change as the velocities say."""
    fastest = draw_joints(scheduled, cell, tmp_path / "joints.png")
    assert (tmp_path / "joints.png").stat().st_size > 1000
    peaks = [motion.peaks()[0] / cell.robots[robot].model.velocity for _, robot, motion in scheduled.moves()]
    assert fastest == pytest.approx(np.max(peaks), rel=0.01)
    for robot in range(2):
        times, positions, rates = joint_values(scheduled, robot)
        assert (np.diff(times) >= 0).all()
        assert (times[0], times[-1]) == (0.0, pytest.approx(scheduled.makespan))
        ends = [frame.configurations[robot] for frame in (scheduled.keyframes[0], scheduled.keyframes[-1])]
        np.testing.assert_allclose(positions[[0, -1]], ends)
        steps = np.diff(times)[:, None] * (rates[1:] + rates[:-1]) / 2
        np.testing.assert_allclose(np.diff(positions, axis=0), steps, atol=1e-3)


def test_charts_that_cannot_be_drawn(plan: RobotPlan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="neither PNG nor SVG"):
        draw_gantt(plan, tmp_path / "chart.txt")
    for chart, name in (("--gantt", "a Gantt chart"), ("--joints", "a plot of joints")):
        assert main(["picture", "stack:blocks=2", chart, "--out", str(tmp_path / "none.png")]) == 2
        assert f"has no arms to draw {name} of" in capsys.readouterr().err
    assert main(["picture", "stack:blocks=2", "--gantt", "--joints"]) == 2
    assert "a Gantt chart has no --joints" in capsys.readouterr().err

"""Robot plans: contents, round trip through files, and messages for damaged files."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from falsework import Direction
from falsework.errors import InputError, PlanError
from falsework.robots import RobotPlan, Trajectory
from falsework.robots.model.cell import cell_identity
from falsework.robots.plans.robot_plan_file import (
    load_robot_plan,
    robot_plan_to_dict,
    save_robot_plan,
)
from falsework.robots.plans.robot_plan_model import robot_plan_schema
from falsework.search.plans.plan_model import plan_schema


def ramp(rows: list[tuple[float, float, float]]) -> Trajectory:
    """One joint: time, position, velocity."""
    times, positions, velocities = np.array(rows).T
    return Trajectory("free", times, positions[:, None], velocities[:, None])


def test_cubics_pass_through_the_knots_with_their_velocities() -> None:
    made = ramp([(0.0, 0.0, 0.0), (1.0, 2.0, 1.5), (3.0, 1.0, 0.0)])
    np.testing.assert_allclose(made.sample(made.times), made.positions, atol=1e-14)
    small = 1e-6
    slope = (made.sample(made.times[1:2] + small) - made.sample(made.times[1:2] - small)) / (2 * small)
    np.testing.assert_allclose(slope, [[1.5]], rtol=1e-5)


def test_peaks_are_those_of_a_fine_sampling() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1.0, 5))])
        made = Trajectory("free", times, rng.normal(size=(6, 3)), rng.normal(size=(6, 3)))
        speed, acceleration = made.peaks()
        fine = np.linspace(0.0, times[-1], 20001)
        step = fine[1]
        values = made.sample(fine)
        np.testing.assert_allclose(speed, np.abs(np.diff(values, axis=0) / step).max(axis=0), rtol=2e-3)
        found = np.abs(np.diff(values, 2, axis=0) / step**2).max(axis=0)
        assert (found <= acceleration * (1 + 1e-3)).all()
        assert (found >= acceleration * 0.97).all()


def test_rest_to_rest_in_closed_form() -> None:
    """From rest to rest in time T over a distance d, a cubic peaks at 1.5 d / T and 6 d / T^2."""
    speed, acceleration = ramp([(0.0, 0.0, 0.0), (2.0, 3.0, 0.0)]).peaks()
    assert speed[0] == pytest.approx(1.5 * 3 / 2)
    assert acceleration[0] == pytest.approx(6 * 3 / 4)


def test_dense_samples_never_jump() -> None:
    rng = np.random.default_rng(1)
    times = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 1.0, 5))])
    made = Trajectory("free", times, rng.normal(size=(6, 3)), rng.normal(size=(6, 3)))
    moments, samples = made.dense(0.01)
    assert np.abs(np.diff(samples, axis=0)).max() <= 0.01
    assert set(np.round(times, 9)) <= set(np.round(moments, 9))


def test_reversed_twice_is_the_same(robot_plan: RobotPlan) -> None:
    there = robot_plan.reverse()
    assert there.direction is Direction.ASSEMBLY
    assert there.seconds == pytest.approx(robot_plan.seconds)
    back = there.reverse()
    for one, other in zip(robot_plan.moves(), back.moves(), strict=True):
        np.testing.assert_allclose(one[2].positions, other[2].positions)
        np.testing.assert_allclose(one[2].times, other[2].times, atol=1e-9)
        np.testing.assert_allclose(one[2].velocities, other[2].velocities)
    moments = np.linspace(0, 1, 7)
    first, last = robot_plan.steps[0].trajectories[0], there.steps[-1].trajectories[-1]
    np.testing.assert_allclose(
        first.sample(first.seconds * moments), last.sample(last.seconds * moments[::-1]), atol=1e-9
    )


def test_motions_join_and_carry_what_the_actions_say(robot_plan: RobotPlan) -> None:
    parts = len(robot_plan.plan.boundary)
    for index, (before, after) in enumerate(pairwise(robot_plan.keyframes)):
        step, action = robot_plan.steps[index], int(robot_plan.actions[index])
        values = before.configurations[step.robot]
        for trajectory in step.trajectories:
            np.testing.assert_allclose(trajectory.positions[0], values, atol=1e-9)
            assert trajectory.part == (action - parts if action >= parts else None)
            values = trajectory.positions[-1]
        np.testing.assert_allclose(values, after.configurations[step.robot], atol=1e-9)
        assert after.held[step.robot] == (None if action >= parts else action)


def test_there_and_back_on_disk(robot_plan: RobotPlan, tmp_path: Path) -> None:
    path = tmp_path / "robot_plan.json"
    save_robot_plan(robot_plan, path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["robot_plan.json"]
    found = load_robot_plan(path)
    assert found.cell_identity == robot_plan.cell_identity
    assert found.plan.identity == robot_plan.plan.identity
    np.testing.assert_array_equal(found.plan.actions, robot_plan.plan.actions)
    for one, other in zip(robot_plan.moves(), found.moves(), strict=True):
        assert one[:2] == other[:2]
        np.testing.assert_allclose(one[2].positions, other[2].positions, atol=1e-7)
        np.testing.assert_allclose(one[2].velocities, other[2].velocities, atol=1e-7)
    again = tmp_path / "again.json"
    save_robot_plan(found, again)
    assert load_robot_plan(again).seconds == found.seconds


def test_files_keep_accelerations_between_close_knots(robot_plan: RobotPlan, tmp_path: Path) -> None:
    """Decimals that are cut off count by the square of the time between two knots, which may be 0.1 ms."""

    def with_close_knots(trajectory: Trajectory) -> Trajectory:
        times = np.unique(np.concatenate([trajectory.times, trajectory.times[:-1] + 9e-5, trajectory.times[1:] - 9e-5]))
        return replace(trajectory, times=times, positions=trajectory.sample(times), velocities=trajectory.rates(times))

    steps = (replace(step, trajectories=tuple(map(with_close_knots, step.trajectories))) for step in robot_plan.steps)
    close = replace(robot_plan, steps=tuple(steps))
    save_robot_plan(close, tmp_path / "plan.json")
    for was, now in zip(close.steps, load_robot_plan(tmp_path / "plan.json").steps, strict=True):
        for before, after in zip(was.trajectories, now.trajectories, strict=True):
            assert after.peaks()[1].max() <= 1.001 * before.peaks()[1].max()


def test_files_follow_the_schema(robot_plan: RobotPlan) -> None:
    data = robot_plan_to_dict(robot_plan)
    schema = robot_plan_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(data)
    jsonschema.Draft202012Validator(plan_schema()).validate(data["plan"])
    data["steps"][0]["trajectories"][0]["kind"] = "jump"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(schema).validate(data)


def test_cell_identity_depends_on_what_motions_depend_on(cell_of: Callable) -> None:
    cell = cell_of()
    assert cell_identity(cell) == cell_identity(cell_of())
    assert cell_identity(replace(cell, name="another name")) != cell_identity(cell)
    assert cell_identity(cell_of(2, 1.2)) != cell_identity(cell)
    assert cell_identity(replace(cell, floor=None)) != cell_identity(cell)
    elsewhere = replace(cell.robots[0], model=replace(cell.robots[0].model, source="other.urdf"))
    assert cell_identity(replace(cell, robots=(elsewhere, cell.robots[1]))) == cell_identity(cell)


def _cut(data: dict[str, Any], *path: Any) -> None:
    for key in path[:-1]:
        data = data[key]
    del data[path[-1]]


def _put(data: dict[str, Any], value: Any, *path: Any) -> None:
    for key in path[:-1]:
        data = data[key]
    data[path[-1]] = value


DAMAGE: list[tuple[Callable[[dict[str, Any]], None], str]] = [
    (lambda data: _put(data, "falsework.robot-plan/9", "format"), "reads 'falsework.robot-plan/3' only"),
    (lambda data: _cut(data, "cell", "identity"), "cell.identity is missing; it may be damaged"),
    (lambda data: _put(data, 1, "extra"), "extra is not known; known are after, before, cell, direction,"),
    (lambda data: _cut(data, "keyframes", 0), "do not match a plan of"),
    (lambda data: _put(data, 5, "steps", 0, "robot"), "robot is 5"),
    (lambda data: _put(data, "jump", "steps", 0, "trajectories", 0, "kind"), "kind is 'jump'"),
    (lambda data: _put(data, 99, "steps", 0, "trajectories", 0, "part"), "part is 99"),
    (lambda data: _put(data, [0.0, 0.0], "steps", 0, "trajectories", 0, "times"), "times do not ascend from 0"),
    (lambda data: _put(data, [[0.0]], "steps", 0, "trajectories", 0, "positions"), "positions has shape (1, 1)"),
    (lambda data: _put(data, [0.0] * 6, "keyframes", 1, "configurations", 0), "step"),
    (lambda data: _put(data, {}, "plan"), "the plan in"),
    (
        lambda data: _put(data, [0.0, [1.0, 2.0]], "steps", 0, "trajectories", 0, "times"),
        "steps[0].trajectories[0].times[1] is [1.0, 2.0]; give a number",
    ),
    (lambda data: _put(data, 10**400, "steps", 0, "trajectories", 0, "times", -1), "does not fit into 64 bits"),
]
NUMBERS = (
    ("keyframes", 0, "configurations", 0, 0),
    ("cell", "robots", 0, "base", 0, 0),
    ("cell", "robots", 0, "tool", 0, 0),
    ("steps", 0, "trajectories", 0, "times", 0),
    ("steps", 0, "trajectories", 0, "positions", 0, 0),
    ("steps", 0, "trajectories", 0, "velocities", 0, 0),
)
DAMAGE += [
    (lambda data, place=place, value=value: _put(data, value, *place), f"[0] is {value!r}; give a number")
    for place in NUMBERS
    for value in ("0.0", True, None, [[0.0]], {})
]


@pytest.mark.parametrize(("damage", "message"), DAMAGE)
def test_damaged_files(robot_plan: RobotPlan, tmp_path: Path, damage: Callable, message: str) -> None:
    data = json.loads(json.dumps(robot_plan_to_dict(robot_plan)))
    damage(data)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(data))
    with pytest.raises(PlanError) as caught:
        load_robot_plan(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_none(robot_plan: RobotPlan, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="there is no robot plan file"):
        load_robot_plan(tmp_path / "none.json")
    (tmp_path / "half.json").write_text('{"format": ')
    with pytest.raises(PlanError, match="not valid JSON"):
        load_robot_plan(tmp_path / "half.json")
    (tmp_path / "list.json").write_text("[]")
    with pytest.raises(PlanError, match='has no "format"'):
        load_robot_plan(tmp_path / "list.json")
    with pytest.raises(InputError, match="cannot write"):
        save_robot_plan(robot_plan, tmp_path / "nowhere" / "plan.json")

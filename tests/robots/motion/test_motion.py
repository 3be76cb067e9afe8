"""Motions: proofs hold between the samples, lines are straight, failures give a reason."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from falsework.errors import InputError
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import block
from falsework.robots.motion.collision_world import CollisionQuery
from falsework.robots.motion.path_planner import follow_line, plan_free
from falsework.robots.motion.timing import time_path

LEFT, RIGHT = np.array([0.9, 0.5, 0.0, 0, 0.5, 0]), np.array([-0.9, 0.5, 0.0, 0, 0.5, 0])


def dense(path: np.ndarray, step: float = 0.001) -> np.ndarray:
    """Configurations along a path, closer than the planner ever looks."""
    found = []
    for a, b in pairwise(path):
        found.append(a + np.linspace(0, 1, int(np.abs(b - a).max() / step) + 2)[:, None] * (b - a))
    return np.concatenate(found)


def path_is_free(view: CollisionQuery, path: np.ndarray) -> bool:
    """Prove that all straight edges of a path, shape (points, joints), keep the margin of the view."""
    if view.collides(path[[0, -1]]).any():
        return False
    return view.is_free(path)


def test_the_straight_edge_is_taken_where_it_is_free(make_view: Callable[..., CollisionQuery]) -> None:
    """Two points, no trees."""
    motion = plan_free(make_view(), LEFT, RIGHT)
    assert motion.reason == "found"
    np.testing.assert_array_equal(motion.path, [LEFT, RIGHT])


def test_nothing_slips_between_samples(make_view: Callable[..., CollisionQuery], wall: np.ndarray) -> None:
    """A sheet of 2 mm stops the straight edge; the way around keeps the margin at every point, however close."""
    view = make_view(wall)
    assert not view.collides([LEFT, RIGHT]).any()
    assert not path_is_free(view, np.stack([LEFT, RIGHT]))
    for seed in range(4):
        motion = plan_free(view, LEFT, RIGHT, seed=seed)
        assert motion.path is not None
        assert len(motion.path) > 2
        assert not view.collides(dense(motion.path)).any()
        assert path_is_free(view, motion.path)


def test_a_proof_is_as_good_as_looking_closely(make_view: Callable[..., CollisionQuery]) -> None:
    """For random edges among random blocks: an edge that is proven free is free at every close sample."""
    random = np.random.default_rng(5)
    blocks = [block(c, c + random.uniform(0.05, 0.3, 3)) for c in random.uniform(-1.2, 1.0, (12, 3)) + [0, 0, 0.8]]
    view = make_view(*blocks)
    starts = random.uniform(-1.5, 1.5, (150, 6))
    proven = seen = 0
    for start in starts:
        edge = np.stack([start, start + random.normal(size=6) * 0.4])
        close = not view.collides(dense(edge)).any()
        seen += close
        if path_is_free(view, edge):
            proven += 1
            assert close
    assert 20 < proven <= seen
    assert proven > 0.8 * seen


def test_the_same_seed_gives_the_same_path(make_view: Callable[..., CollisionQuery], wall: np.ndarray) -> None:
    """Whatever was asked of the view before."""
    view = make_view(wall)
    first = plan_free(view, LEFT, RIGHT, seed=3)
    view.collides(np.random.default_rng(0).uniform(-1, 1, (200, 6)))
    second = plan_free(view, LEFT, RIGHT, seed=3)
    np.testing.assert_array_equal(first.path, second.path)
    other = plan_free(view, LEFT, RIGHT, seed=4)
    assert first.path is not None
    assert other.path is not None
    assert not np.array_equal(first.path, other.path)


def test_failures_say_why(make_view: Callable[..., CollisionQuery], wall: np.ndarray) -> None:
    """Start or goal blocked or out of limits, with the pair; no connection; out of time."""
    view = make_view(wall, block((-3, -3, 2.5), (3, 3, 2.6)))
    inside = np.array([0, 0.6, 0.0, 0, 0.5, 0])
    blocked = plan_free(view, inside, LEFT)
    assert blocked.reason == "start in collision"
    assert blocked.pair is not None
    assert blocked.pair[1] == "block 0"
    assert plan_free(view, LEFT, inside).reason == "goal in collision"
    assert plan_free(view, LEFT, LEFT + [9, 0, 0, 0, 0, 0]).reason == "goal outside limits"
    caged = make_view(wall, block((-3, -0.45, 0), (3, -0.44, 3)), block((-3, -3, 1.9), (3, 3, 1.91)))
    assert not caged.collides([LEFT, RIGHT])[0]
    assert plan_free(caged, LEFT, np.array([2.5, 0.5, 0, 0, 0.5, 0]), nodes=60).path is not None


@pytest.mark.parametrize("robot", ["irb2600-12/1.65", "crb15000-5/0.95", "ur10e"])
def test_a_line_is_straight_and_does_not_turn(make_view: Callable[..., CollisionQuery], robot: str) -> None:
    """Between its points too, to 0.2 mm, at the length asked for and without a jump."""
    view = make_view(robot=robot)
    start = view.model.home
    entry = view.world.cell.robots[0]
    motion = follow_line(view, start, (-0.3, 0.1, 1.0), 0.1)
    assert motion.path is not None, motion.reason
    way = np.array([-0.3, 0.1, 1.0]) / np.linalg.norm([-0.3, 0.1, 1.0])
    poses = tool_pose(entry, dense(motion.path))
    home = tool_pose(entry, start)
    shift = poses[:, :3, 3] - home[:3, 3]
    assert np.linalg.norm(shift - np.outer(shift @ way, way), axis=1).max() < 2e-4
    np.testing.assert_allclose(shift[-1], 0.1 * way, atol=1e-6)
    np.testing.assert_allclose(
        tool_pose(entry, motion.path)[:, :3, :3], np.tile(home[:3, :3], (len(motion.path), 1, 1)), atol=1e-6
    )
    assert np.abs(np.diff(motion.path, axis=0)).max() < 0.2


def test_lines_that_cannot_be_followed_say_why(make_view: Callable[..., CollisionQuery]) -> None:
    """Something in the way, with what and how far; the end of the reach; no direction."""
    view = make_view()
    start = view.model.home
    at = tool_pose(view.world.cell.robots[0], start)[:3, 3]
    plate = make_view(block(at + [-0.1, -0.1, -0.1], at + [0.1, 0.1, -0.08]))
    stopped = follow_line(plate, start, (0, 0, -1), 0.2)
    assert stopped.reason == "collision on the line"
    assert stopped.pair == ("arm gripper", "block 0")
    assert stopped.at is not None
    assert 0.04 < at[2] - tool_pose(plate.world.cell.robots[0], stopped.at)[2, 3] < 0.08
    assert follow_line(view, start, (1, 0, 0), 3.0).reason in ("no solution on the line", "joint limit on the line")
    with pytest.raises(InputError, match="three numbers that are not all zero"):
        follow_line(view, start, (0, 0, 0), 0.1)
    with pytest.raises(InputError, match="give a distance above zero"):
        follow_line(view, start, (0, 0, 1), 0.0)


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_timing_keeps_limits_path_and_spacing(
    make_view: Callable[..., CollisionQuery], wall: np.ndarray, speed: float
) -> None:
    """Velocity and acceleration within the limits, samples closer than 0.01 rad, no point of the arm off the path."""
    view = make_view(wall)
    model = view.model
    line = follow_line(view, model.home, (-0.2, 0, 1), 0.15).path
    for path in (plan_free(view, LEFT, RIGHT, seed=1).path, line, np.stack([LEFT, LEFT + 1e-3])):
        assert path is not None
        timed = time_path(model, path, speed)
        assert (np.abs(timed.velocities) <= model.velocity * speed * (1 + 1e-9)).all()
        assert (np.abs(timed.accelerations) <= model.acceleration * speed**2 * (1 + 1e-9)).all()
        assert np.abs(np.diff(timed.positions, axis=0)).max() < 0.01
        assert not timed.velocities[[0, -1]].any()
        np.testing.assert_allclose(timed.positions[[0, -1]], path[[0, -1]], atol=1e-6)
        # Velocities are those of the positions, and every sample is next to the path.
        slope = np.diff(timed.positions, axis=0) / np.diff(timed.times)[:, None]
        middle = (timed.velocities[1:] + timed.velocities[:-1]) / 2
        assert np.abs(slope - middle).max() < 0.05 * np.abs(middle).max() + 1e-6
        fine = dense(path, 2e-4)
        off = [np.abs(fine - row).sum(axis=1).min() for row in timed.positions[::7]]
        assert max(off) * (model.reach + 0.5) < 0.0005 + 2e-3


def test_timing_is_nearly_as_fast_as_the_slowest_joint_allows(make_view: Callable[..., CollisionQuery]) -> None:
    """One joint, one edge: the known time of a trapezoid of speed."""
    model = make_view().model
    path = np.stack([LEFT, LEFT + [-1.8, 0, 0, 0, 0, 0]])
    speed, push = model.velocity[0], model.acceleration[0]
    ideal = 1.8 / speed + speed / push
    assert ideal <= time_path(model, path).duration < 1.01 * ideal


@pytest.mark.parametrize("size", [0.003, 0.03, 0.3])
def test_no_robot_is_faster_by_stopping_at_corners(make_view: Callable[..., CollisionQuery], size: float) -> None:
    """For random paths; one that turns back on itself has to stop there."""
    model = make_view().model
    for seed in range(5):
        steps = np.random.default_rng(seed).normal(size=(6, 6)) * size
        path = np.clip(model.home + np.cumsum(steps, axis=0), model.lower, model.upper)
        stops = sum(time_path(model, edge).duration for edge in pairwise(path))
        assert time_path(model, path).duration < stops
        there = time_path(model, path[:2]).duration
        assert 1.9 * there < time_path(model, path[[0, 1, 0]]).duration < 2.01 * there


def test_timing_refuses_what_is_no_path(make_view: Callable[..., CollisionQuery]) -> None:
    """Shapes, limits, numbers, speed."""
    model = make_view().model
    with pytest.raises(InputError, match=r"path has shape \(2, 5\)"):
        time_path(model, np.zeros((2, 5)))
    with pytest.raises(InputError, match=r"point 1 of the path: joint_1 is 4"):
        time_path(model, np.array([LEFT, [4, 0, 0, 0, 0, 0]]))
    with pytest.raises(InputError, match="not finite"):
        time_path(model, [LEFT, np.full(6, np.nan)])
    with pytest.raises(InputError, match="speed is 2"):
        time_path(model, [LEFT, RIGHT], 2.0)
    assert time_path(model, [LEFT, LEFT]).duration == 0.0

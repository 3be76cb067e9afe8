"""Collision: distances against Coal, checks against distances of every pair."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from falsework.errors import InputError
from falsework.geometry.arrays import apply
from falsework.robots import Cell, CellRobot, Gripper, Obstacle
from falsework.robots.kernels.collision import distance_between
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.robots.model.part_shapes import PartShapes
from falsework.robots.model.shapes import block, hull, pose
from falsework.robots.motion.collision_world import LIFT, PUT_DOWN, CollisionQuery, CollisionWorld, Contact, Scene


def random_piece(random: np.random.Generator) -> np.ndarray:
    """A convex piece of 4 to 30 points, sometimes flat as a plate or thin as a rod."""
    points = random.normal(size=(random.integers(4, 30), 3)) * 10 ** random.uniform(-2, 0, 3)
    return np.array(hull(points + random.normal(size=3) * random.uniform(0, 1.5)))


def test_distance_of_boxes_is_known() -> None:
    """Boxes apart along one axis, an edge and a corner; boxes that touch and overlap."""
    box = np.array(block((0, 0, 0), (1, 1, 1)))
    for shift, expected in (((2, 0, 0), 1.0), ((2, 2, 0), 2**0.5), ((2, 2, 2), 3**0.5), ((0.5, 0, 0), 0.0)):
        assert distance_between(box, box + np.array(shift, float)) == pytest.approx(expected, abs=1e-9)
    assert distance_between(box, box + np.array([1.0, 0, 0])) == pytest.approx(0.0, abs=1e-9)


def test_distance_agrees_with_coal(coal_distance: Callable[[np.ndarray, np.ndarray], float]) -> None:
    """Never farther than the true distance, and as good as equal to it."""
    random = np.random.default_rng(1)
    apart = 0
    for _ in range(1500):
        a, b = random_piece(random), random_piece(random)
        ours, theirs = distance_between(a, b), max(coal_distance(a, b), 0.0)
        assert ours <= theirs + 1e-6
        assert ours == pytest.approx(theirs, abs=2e-5)
        apart += theirs > 0
    assert 300 < apart < 1400


def test_a_check_says_what_all_pairs_say(
    make_view: Callable[..., CollisionQuery], coal_distance: Callable[[np.ndarray, np.ndarray], float]
) -> None:
    """An arm at random values collides exactly if some pair that counts is nearer than its margin."""
    random = np.random.default_rng(2)
    blocks = [block(c, c + random.uniform(0.1, 0.4, 3)) for c in random.uniform(-1.2, 1.0, (8, 3)) + [0, 0, 0.6]]
    view = make_view(*blocks, margin=0.01)
    values = random.uniform(view.model.lower, view.model.upper, (60, 6))
    said = view.collides(values)
    for row, collides in zip(values, said, strict=True):
        scene = view.scene.with_configuration(0, row)
        pieces = [piece for _, _, piece in view.world.robot_pieces(0, scene)]
        base = len(view.model.pieces[0])
        gaps = [coal_distance(piece, stand) - 0.01 for piece in pieces for stand in blocks]
        everything = [*view.model.pieces[0], *pieces]
        gaps += [coal_distance(everything[a], everything[b]) for a, b in view.arrays.rules.self_pairs]
        assert base == 1
        if abs(min(gaps)) > 1e-6:
            assert collides == (min(gaps) <= 0)
    assert 5 < said.sum() < 55


def test_a_hit_names_the_pair(make_view: Callable[..., CollisionQuery]) -> None:
    """People are told which bodies are too near; where nothing is, there is nothing to tell."""
    view = make_view(block((0.6, -0.5, 0.3), (0.7, 0.5, 1.5)))
    pair = view.explain(np.array([0, 0.3, 0, 0, 0, 0]))
    assert pair is not None
    assert pair[1] == "block 0"
    assert view.explain(view.model.home + np.array([np.pi / 2, 0, 0, 0, 0, 0])) is None


def test_the_floor_is_kept_clear(make_view: Callable[..., CollisionQuery]) -> None:
    """A tool at floor level hits the floor, and does not where there is none."""
    down = np.array([0, 1.4, 0.3, 0, 0, 0])
    assert make_view(floor=0.0).explain(down) in {("arm gripper", "floor"), ("arm link_4", "floor")}
    assert make_view(floor=None).explain(down) is None


def test_wrong_shapes_are_named(make_view: Callable[..., CollisionQuery]) -> None:
    """Both the shape that came and the one expected."""
    view = make_view()
    with pytest.raises(InputError, match=r"shape \(1, 5\).*6 joints"):
        view.collides(np.zeros(5))
    with pytest.raises(InputError, match="no robot 3; the cell has 1"):
        view.world.view(view.scene, 3)


@pytest.fixture
def two_arms(cup: Gripper) -> tuple[CollisionWorld, PartShapes]:
    """Two arms that face each other with a small block between them."""
    model = builtin_robot("irb2600-12/1.65")
    robots = tuple(
        CellRobot(name, model, pose((x, 0, 0), turn), cup, model.home, np.zeros((0, 4, 4)))
        for name, x, turn in (("left", -1.2, 0.0), ("right", 1.2, np.pi))
    )
    cell = Cell("two", robots)
    piece = block((-0.1, -0.1, 0.4), (0.1, 0.1, 0.6))
    other = block((0.15, -0.1, 0.4), (0.35, 0.1, 0.6))
    parts = PartShapes(
        ("one", "two"),
        np.zeros(2, bool),
        (),
        ((piece,), (other,)),
        np.ones(2),
        np.array([[0, 0, 0.5], [0.25, 0, 0.5]]),
        np.eye(3),
    )
    return CollisionWorld(cell, parts), parts


def test_robots_hit_each_other(two_arms: tuple[CollisionWorld, PartShapes]) -> None:
    """An arm that stands where the other wants to go is an obstacle; at home it is none."""
    world, parts = two_arms
    ahead = np.array([0, 0.4, -0.2, 0, 0, 0])
    scene = Scene.at_home(world.cell, parts).with_removed(0, 1)
    assert not world.view(scene, 0).collides(ahead)[0]
    met = world.view(scene.with_configuration(1, ahead), 0).explain(ahead)
    assert met is not None
    assert met[0].startswith("left")
    assert met[1].startswith("right")


def test_contact_rules_allow_what_they_name(two_arms: tuple[CollisionWorld, PartShapes]) -> None:
    """A gripper on a part collides without a rule; a part in the gripper touches only neighbours that are named."""
    from falsework.robots.kinematics.inverse import inverse

    world, parts = two_arms
    tool = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.6005], [0, 0, 0, 1]])
    values = inverse(world.cell.robots[0], tool)[0]
    scene = Scene.at_home(world.cell, parts)
    assert world.view(scene, 0).collides(values).all()
    open_grips = values[~world.view(scene, 0, contact=Contact(gripper=frozenset({0})), margin=0.001).collides(values)]
    assert len(open_grips)
    grip = open_grips[0]
    carried = scene.with_configuration(0, grip).with_attached(0, 0, tool_pose(world.cell.robots[0], grip))
    assert not carried.present[0]
    beside = inverse(world.cell.robots[0], pose((0.05, 0, 0)) @ tool)[0]
    assert world.view(carried, 0, margin=0.001).explain(grip) is None
    allowed = world.view(carried, 0, contact=Contact(carried=frozenset({1})), margin=0.001)
    free = beside[~allowed.collides(beside)]
    assert len(free)
    strict = world.view(carried, 0, margin=0.001)
    assert {strict.explain(values) for values in free} == {("part one", "part two")}


def test_a_part_leaves_the_obstacle_under_it_and_no_other(
    two_arms: tuple[CollisionWorld, PartShapes],
) -> None:
    """A plate below the part may touch it on its way; a post beside the way, which it does not touch yet, may not."""
    from falsework.robots.kinematics.inverse import inverse

    bare, parts = two_arms
    low, high = parts.pieces[0][0].min(axis=0), parts.pieces[0][0].max(axis=0)
    plate = Obstacle("plate", (block((low[0], low[1], low[2] - 0.01), (high[0], high[1], low[2])),))
    post = Obstacle("post", (block((low[0] - 0.09, low[1], low[2]), (low[0] - 0.06, high[1], high[2])),))
    world = CollisionWorld(replace(bare.cell, obstacles=(plate, post)), parts)
    tool = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, high[2] + 0.0005], [0, 0, 0, 1]])
    start = inverse(world.cell.robots[0], tool)[0]
    scene = Scene.at_home(world.cell, parts).with_removed(1)
    start = start[~world.view(scene, 0, contact=Contact(gripper=frozenset({0})), margin=0.001).collides(start)][0]
    carried = scene.with_attached(0, 0, tool_pose(world.cell.robots[0], start))
    line = world.view(carried, 0, contact=LIFT, margin=0.001)
    assert not line.collides(start)[0]
    assert world.view(carried, 0, contact=PUT_DOWN, margin=0.001).explain(start) == ("part one", "plate")
    assert world.view(carried, 0, margin=0.001).explain(start) == ("part one", "plate")
    beyond = inverse(world.cell.robots[0], pose((-0.075, 0, 0)) @ tool)[0]
    assert {line.explain(values) for values in beyond} == {("part one", "post")}


def test_a_part_in_the_gripper_goes_where_the_tool_goes(two_arms: tuple[CollisionWorld, PartShapes]) -> None:
    """Its vertices keep their place in the tool frame."""
    world, parts = two_arms
    robot = world.cell.robots[0]
    start, end = np.array([0.1, 0.2, 0.1, 0.3, 0.5, 0.2]), np.array([-0.6, 0.1, -0.3, 1.0, 0.4, 2.0])
    scene = Scene.at_home(world.cell, parts).with_configuration(0, start)
    scene = scene.with_attached(0, 0, tool_pose(robot, start)).with_configuration(0, end)
    moved = next(piece for name, _, piece in world.robot_pieces(0, scene) if name == "part one")
    motion = tool_pose(robot, end) @ np.linalg.inv(tool_pose(robot, start))
    np.testing.assert_allclose(moved, apply(motion, parts.pieces[0][0]), atol=1e-12)

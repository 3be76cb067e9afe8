"""Homes of arms: what is wrong with one, with distances and names, and proposals that are free."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falsework.errors import CellError
from falsework.robots import Cell, check_cell, propose_home
from falsework.robots.cells.cell_file import parse_cell
from falsework.robots.cells.validate import home_faults, home_text, missing_homes, no_parts
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.shapes import block
from falsework.robots.motion.collision_world import CollisionWorld, Scene
from falsework.robots.motion.near_pairs import near_pairs, separation
from tests.robots.cells.cell_texts import ONE_ARM

pytestmark = pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")


def cell_of(text: str) -> Cell:
    return parse_cell(text, "cell.toml", Path())


def test_separation_is_distance_or_depth(coal_distance) -> None:
    """Of boxes along an axis by hand, of turned ones as Coal has it."""
    box = np.array(block((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)))
    for shift, wanted in ((1.3, 0.3), (0.8, -0.2), (0.4, -0.6)):
        assert separation(box, box + [shift, 0.0, 0.0]) == pytest.approx(wanted, abs=1e-9)
    rng = np.random.default_rng(1)
    for _ in range(20):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        other = box @ turn.T + rng.uniform(-1.3, 1.3, 3)
        assert separation(box, other) == pytest.approx(coal_distance(box, other), abs=1e-4)


@pytest.mark.parametrize(
    ("home", "proposed"),
    [("[0, -40, 30, 0, 60, 0]", False), ("[0, 150, 70, 0, 0, 0]", True), ("[0, 95, 0, 0, 0, 0]", True)],
)
def test_a_home_that_collides_is_reported_with_one_that_does_not(home: str, proposed: bool) -> None:
    """The message names the bodies, how deep they overlap, and joint values that can be pasted."""
    cell = cell_of(ONE_ARM.replace("[0, -40, 30, 0, 60, 0]", home))
    assert bool(home_faults(cell, no_parts(), 0)) is proposed
    if not proposed:
        check_cell(cell)
        return
    with pytest.raises(
        CellError, match=r"mm (into each other|apart instead of 4 mm)\); home = |floor.*; home = "
    ) as caught:
        check_cell(cell)
    pasted = str(caught.value).partition("; home = ")[2].removesuffix(" is free")
    check_cell(cell_of(ONE_ARM.replace("[0, -40, 30, 0, 60, 0]", pasted)))


def test_near_pairs_agree_with_the_collision_query(make_view) -> None:
    """Whatever the configuration: a pair is reported exactly where the query finds a collision."""
    view = make_view(np.array(block((0.6, -0.4, 0.0), (0.8, 0.4, 0.9))), floor=0.0)
    rng = np.random.default_rng(3)
    model = view.model
    both = set()
    for values in rng.uniform(model.lower, model.upper, (60, model.joints)):
        pairs = near_pairs(view, values)
        assert bool(pairs) is bool(view.collides(values)[0])
        both.add(bool(pairs))
        if pairs:
            assert pairs == sorted(pairs, key=lambda pair: pair.distance - pair.wanted)
    assert both == {True, False}


def test_a_proposal_is_free_near_a_home_and_in_front_without_one(robot_file) -> None:
    """Of an arm whose zero is in collision or stretched, the tool ends up pointing down before it."""
    pytest.importorskip("yourdfpy")
    for name in ("franka_fer", "ur5e"):
        text = ONE_ARM.replace('"irb2600-12/1.65"', f'"{robot_file(name)}"').replace(
            "home = [0, -40, 30, 0, 60, 0]\n", ""
        )
        cell = cell_of(text.replace("yaw = 90", "yaw = 0"))
        found = propose_home(cell, no_parts(), 0)
        assert found is not None
        robot = replace(cell.robots[0], home=found)
        assert robot.model.within_limits(found)
        assert not home_faults(replace(cell, robots=(robot,)), no_parts(), 0)
        tool = tool_pose(robot, found)
        assert tool[2, 2] < -0.98
        assert tool[0, 3] > 0.15
        (line,) = missing_homes(cell, no_parts())
        assert line.startswith("robot arm has no home, so its joints are at zero; home = [")
        assert home_text(robot.model, found) in line
        again = propose_home(cell, no_parts(), 0)
        assert again is not None
        np.testing.assert_array_equal(found, again)
    near = cell_of(ONE_ARM.replace("[0, -40, 30, 0, 60, 0]", "[0, 95, 0, 0, 0, 0]"))
    assert missing_homes(near, no_parts()) == []
    close = propose_home(near, no_parts(), 0)
    assert close is not None
    assert np.abs(close - near.robots[0].home).max() < np.pi


def test_an_arm_that_is_walled_in_has_no_proposal() -> None:
    walls = "\n".join(
        f'[[obstacles]]\nname = "wall {k}"\nbox = {{ low = {low}, high = {high} }}'
        for k, (low, high) in enumerate(
            [
                ([0.28, -3, 0], [3, 3, 3]),
                ([-3, -3, 0], [-0.41, 3, 3]),
                ([-3, 0.27, 0], [3, 3, 3]),
                ([-3, -3, 0], [3, -0.27, 3]),
            ]
        )
    )
    cell = cell_of(ONE_ARM.partition("[[obstacles]]")[0].replace("yaw = 90", "yaw = 0") + walls)
    with pytest.raises(
        CellError, match=r"robot arm at home is too near: .* and wall \d, .*; change home or move the base$"
    ):
        check_cell(cell)


def test_home_is_written_in_degrees() -> None:
    cell = cell_of(ONE_ARM)
    assert home_text(cell.robots[0].model, cell.robots[0].home) == "[0, -40, 30, 0, 60, 0]"


@pytest.mark.parametrize(
    ("height", "message"),
    [
        ("0.0", ""),
        ("-0.001", ""),
        ("-0.058", r"is 58 mm below the floor; raise it to z = 0, or set floor to -0\.058"),
    ],
)
def test_a_base_below_the_floor(height: str, message: str) -> None:
    """The message says by how much, and where to."""
    cell = cell_of(ONE_ARM.replace("base = { position = [0.0, 0.0, 0.0]", f"base = {{ position = [0.0, 0.0, {height}]"))
    if not message:
        check_cell(cell)
        return
    with pytest.raises(CellError, match=message):
        check_cell(cell)


def test_a_base_that_stands_on_the_floor_may_reach_below_it() -> None:
    """Its description has bolts below the plane on which it is mounted; lying on its side it does not stand there."""
    cell = cell_of(ONE_ARM)
    model = cell.robots[0].model
    bolts = np.array(block((-0.05, -0.05, -0.04), (0.05, 0.05, 0.1)))
    deep = replace(model, pieces=((*model.pieces[0], bolts), *model.pieces[1:]))
    robot = replace(cell.robots[0], model=deep)
    check_cell(replace(cell, robots=(robot,)))
    higher = robot.base.copy()
    higher[2, 3] = 0.01
    with pytest.raises(CellError, match=r"is 30 mm below the floor; raise it to z = 0\.04"):
        check_cell(replace(cell, robots=(replace(robot, base=higher),)))


def test_pairs_of_two_arms_count_once(make_view) -> None:
    second = ONE_ARM[ONE_ARM.index("[[robots]]") : ONE_ARM.index("[[obstacles]]")].replace('"arm"', '"other"')
    cell = cell_of(ONE_ARM + second.replace("[0.0, 0.0, 0.0], yaw = 90", "[0.5, 0.0, 0.0], yaw = 90"))
    from falsework.robots.motion.near_pairs import near_pairs_of

    pairs = near_pairs_of(CollisionWorld(cell, no_parts()), Scene.at_home(cell, no_parts()))
    names = [frozenset((pair.first, pair.second)) for pair in pairs]
    assert len(names) == len(set(names)) > 0

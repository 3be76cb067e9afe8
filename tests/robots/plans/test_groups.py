"""Robot plans in which one arm carries a group of parts that only leave together."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falsework import Assembly, Outcome, check, load_structure, make_task, plan_robots
from falsework.assembly import complete_state, prop_places, with_props
from falsework.assembly.groups import groups_of, join_parts
from falsework.assembly.library import shelf as built_in_shelf
from falsework.errors import AssemblyError, StateError
from falsework.robots import Cell
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.plans.loose_plan import loose_plan
from falsework.robots.plans.robot_plan_file import load_robot_plan, save_robot_plan
from falsework.search.margins.demands import Demands, MarginOracle
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.stability.holds import HoldMode, Press
from tests.robots.plans.conftest import boxes, make_cell


@pytest.fixture(scope="module")
def shelf() -> Assembly:
    return built_in_shelf(shelves=0).replace(density=600.0)


@pytest.fixture(scope="module")
def strong() -> Cell:
    return make_cell(payload=20.0)


@pytest.fixture(scope="module")
def opened(shelf: Assembly, strong: Cell) -> HybridResult:
    return plan_robots(shelf, strong, task=make_task(shelf, 2, parts_at_once=2), concurrent=True)


def test_two_arms_build_the_shelf_that_is_locked_one_part_at_a_time(
    shelf: Assembly, strong: Cell, opened: HybridResult
) -> None:
    """Motions are checked with the boards as one part, the states with both boards loose."""
    alone = plan_robots(shelf, strong, task=make_task(shelf, 2, removable_only_if_clear=True))
    assert alone.outcome is Outcome.PROVED_IMPOSSIBLE
    assert opened.structure is not None
    assert opened.value is not None
    groups = groups_of(opened.structure)
    assert groups is not None
    assert [sorted(names) for names in groups.names] == [["top-2", "top-3"]]
    report = check(opened.structure, opened.value, strong)
    assert report.good
    assert report.states is not None
    assert report.states.about is not None
    assert report.states.about.parts_at_once == 2
    loose = loose_plan(opened.value.plan, groups)
    assert validate_plan(loose, shelf).good
    (step,) = [step for step in loose if len(step.parts) > 1]
    assert step.robots
    assert (step.state[[2, 3]] > 0).all()


def test_a_gripper_holds_the_part_that_carries_the_others(shelf: Assembly, strong: Cell, opened: HybridResult) -> None:
    """Faces of the other board are no place for it, in grasps and in the check."""
    assert opened.structure is not None
    assert opened.value is not None
    groups = groups_of(opened.structure)
    assert groups is not None
    ((held, other),) = groups.names
    turned = join_parts(shelf, [(other, held)])
    plan = replace(opened.value.plan, identity=turned.identity, part_names=tuple(turned.names))
    assert not check(turned, replace(opened.value, plan=plan), strong).good


@pytest.mark.parametrize("mode", [HoldMode.FORCE, HoldMode.HYBRID])
def test_a_press_on_a_group_is_the_same_wrench_on_the_part_that_carries_it(
    opened: HybridResult, shelf: Assembly, mode: HoldMode
) -> None:
    """Where robots control the pose across a force, moments follow from that."""
    assert opened.structure is not None
    assert opened.value is not None
    groups, joined, plan = groups_of(opened.structure), opened.structure, opened.value.plan
    assert groups is not None
    carrier = shelf.names.index(groups.names[0][0])
    place = int(groups.joined[carrier])
    wrench = (3.0, 4.0, 5.0, *((0.1, 0.2, 0.3) if mode is HoldMode.FORCE else (0.0, 0.0, 0.0)))
    claim = replace(plan.claim, holds=replace(plan.claim.holds, mode=mode))
    pressed = replace(plan, claim=claim, presses=((Press(place, wrench),), *((),) * (len(plan) - 1)))
    (press,) = loose_plan(pressed, groups).presses[0]
    assert (press.part, press.wrench[:3]) == (carrier, wrench[:3])
    moments = (
        np.array(one[3:]) + np.cross(center, one[:3])
        for one, center in ((wrench, joined.mass.center[place]), (press.wrench, shelf.mass.center[carrier]))
    )
    if mode is HoldMode.FORCE:
        np.testing.assert_allclose(*moments, atol=1e-12)
    else:
        assert press.wrench == wrench


def test_files_say_which_parts_are_one(opened: HybridResult, shelf: Assembly, tmp_path: Path) -> None:
    assert opened.structure is not None
    assert opened.value is not None
    groups, file = groups_of(opened.structure), tmp_path / "robot_plan.json"
    assert groups is not None
    source = {"built_in": "shelf:shelves=0", "density": 600.0, "groups": groups.names}
    save_robot_plan(replace(opened.value, plan=replace(opened.value.plan, source=source)), file)
    assert json.loads(file.read_text())["plan"]["structure"]["source"]["groups"] == groups.names
    again = load_robot_plan(file)
    assert structure_of_plan(again.plan, file).identity == opened.structure.identity != shelf.identity


def test_a_group_that_falls_apart_in_the_air_is_no_plan(strong: Cell) -> None:
    """Two cubes that only touch are one part for the arm; the check with loose parts sees that they are not."""
    joined = join_parts(boxes((-0.1, -0.1, 0.0), (-0.1, -0.1, 0.2)), [(1, 0)])
    found = plan_robots(joined, strong).value
    assert found is not None
    assert validate_plan(found.plan, joined).good
    report = check(joined, found, strong)
    assert report.states is not None
    assert not report.good
    assert "do not leave together" in report.states.reason


def test_groups_keep_margins_and_what_is_changed_after_they_were_joined(shelf: Assembly) -> None:
    """Loads of a margin are of the joined parts; friction and props outlast another change."""
    joined = join_parts(shelf, [("top-3", "top-2")])
    state = complete_state(joined.boundary)[None]
    for demands, kept in ((Demands(tilt=0.02), True), (Demands(horizontal=0.02), True), (Demands(tilt=1.0), False)):
        assert MarginOracle(joined, demands=demands).keeps(state).tolist() == [kept]
    assert joined.at_friction(0.4).replace(name="other").friction == 0.4
    propped = with_props(joined, prop_places(joined))
    assert propped.props
    assert propped.replace(density=700.0).props == propped.props


def test_states_of_parts_and_groups(shelf: Assembly) -> None:
    joined = join_parts(shelf, [("top-3", "top-2")])
    groups = groups_of(joined)
    assert groups is not None
    assert joined.names == ("upright-0", "upright-1", "top-3 with top-2", "ground-4")
    np.testing.assert_allclose(joined.mass.mass[2], shelf.mass.mass[[2, 3]].sum())
    np.testing.assert_array_equal(groups.loosen(np.array([1, 0, 2, 2], np.uint8)), [1, 0, 1, 2, 2])
    np.testing.assert_array_equal(groups.join(np.array([1, 0, 1, 2, 2], np.uint8)), [1, 0, 2, 2])
    for state in ([1, 1, 0, 2, 2], [1, 1, 2, 1, 2]):
        with pytest.raises(StateError, match="part top-2 is of a group that one robot carries"):
            groups.join(np.array(state, np.uint8))
    assert joined.replace(density=1000.0).mass.mass[2] == pytest.approx(
        shelf.replace(density=1000.0).mass.mass[[2, 3]].sum()
    )
    assert load_structure("shelf:shelves=0", density=600.0, groups=[["top-3", "top-2"]]).identity == joined.identity


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([("top-2", "top-9")], "a group has part 'top-9', which does not exist"),
        ([("top-2", "top-3"), ("top-3", "upright-0")], "part top-3 is in two groups"),
        ([("top-2", "ground-4")], "part ground-4 is fixed, so no robot carries it"),
    ],
)
def test_groups_that_cannot_be(shelf: Assembly, groups: list[tuple[str, ...]], message: str) -> None:
    with pytest.raises(AssemblyError, match=message):
        join_parts(shelf, groups)


def test_what_is_not_joined(shelf: Assembly) -> None:
    light = shelf.replace(density=np.array([1.0, 1.0, 1.0, 2.0, 1.0]))
    with pytest.raises(AssemblyError, match="top-2, top-3 have different densities"):
        join_parts(light, [(2, 3)])

"""Effects of clicks and state of the page, without a browser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from falsework import Direction, StabilitySettings, find_plans, load_structure, replan
from falsework.assembly import HELD, INSTALLED, REMOVED, empty_state
from falsework.errors import InputError, StateError
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.steps import NO_ROBOT
from falsework.stability import HoldSettings
from falsework.stability.holds import HoldMode
from falsework.utils.quantity import format_quantity
from falsework.viewer import Timeline
from falsework.viewer.appearance import SceneView, bounds_of
from falsework.viewer.page.disruption import ClickMode, Disruption, chance_of_parts
from falsework.viewer.page.new_plan import new_plan
from falsework.viewer.page.page_text import facts_of, labels_of
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import FIXED, SELECTED, ramp_in_steps, rgb
from falsework.viewer.section import Plane
from tests.viewer.conftest import planned

ABOVE, DOWN = np.array([0.0, 0.0, 10.0]), np.array([0.0, 0.0, -1.0])


@pytest.fixture
def model(arch, timeline) -> ViewerState:
    return ViewerState(timeline, plan=arch[1])


def over(model: ViewerState, part: int) -> np.ndarray:
    return model.assembly.mass.center[part] + ABOVE


def test_going_beyond_the_end_is_the_end(model: ViewerState) -> None:
    model.go_to(1e9)
    assert model.position == len(model.timeline)
    model.go_to(-3)
    assert model.position == 0


def test_turning_keeps_the_state(model: ViewerState) -> None:
    model.go_to(3)
    before = model.state.copy()
    model.turn(Direction.DISASSEMBLY)
    np.testing.assert_array_equal(model.state, before)
    assert model.position == 3
    model.turn(Direction.DISASSEMBLY)  # nothing to do
    assert model.position == 3


def test_playing_goes_in_the_order_shown(model: ViewerState) -> None:
    count = len(model.timeline)
    assert (model.position, model.at_end) == (0, False)
    model.advance(1.5)
    assert (model.position, model.step) == (1.5, 2)
    model.turn(Direction.DISASSEMBLY)
    model.go_to(model.timeline.begin)
    assert (model.position, model.at_end) == (count, False)
    model.advance(1.5)
    assert (model.position, model.step) == (count - 1.5, count - 2)
    model.advance(1e9)
    assert (model.position, model.at_end) == (0, True)


def test_a_click_selects_and_a_click_beside_forgets(model: ViewerState) -> None:
    model.go_to(len(model.timeline))
    top = int(np.argmax(model.assembly.mass.center[:, 2]))
    assert model.click(over(model, top), DOWN) == top
    assert model.selected == top
    assert tuple(model.appearance().color[top]) == rgb(SELECTED)
    assert labels_of(model, model.appearance())[top] == model.assembly.names[top]
    facts = dict(facts_of(model, top))
    assert facts["mass"] == format_quantity(float(model.assembly.mass.mass[top]), "mass")
    assert facts["held by"].startswith("R")
    assert facts["now"] == "installed"
    assert model.click(np.array([99.0, 0, 9]), DOWN) is None
    assert model.selected is None


def test_about_a_boundary_part(model: ViewerState) -> None:
    part = int(np.argmax(model.assembly.boundary))
    facts = dict(facts_of(model, part))
    assert facts["now"] == "boundary"
    assert facts["held by"] == "no robot"


@pytest.mark.parametrize(
    ("tool", "field"), [(ClickMode.MISSING, "missing"), (ClickMode.FIXED, "fixed"), (ClickMode.TARGET, "target")]
)
def test_a_tool_marks_and_unmarks(model: ViewerState, tool: ClickMode, field: str) -> None:
    """Absent parts too: they are shown palely while a tool is chosen."""
    model.tool = tool
    assert set(model.pale) == set(np.flatnonzero(model.state == REMOVED).tolist())
    top = int(np.argmax(model.assembly.mass.center[:, 2]))
    model.click(over(model, top), DOWN)
    assert getattr(model.disruption, field) == {top}
    assert model.assembly.names[top] in model.disruption.words(model.assembly)
    assert top in labels_of(model, model.appearance())
    model.click(over(model, top), DOWN)
    assert model.disruption.empty


def test_what_is_there_already_was_absent_before(model: ViewerState) -> None:
    model.tool = ClickMode.THERE
    model.click_part(1)
    assert model.site[1] == INSTALLED
    assert model.appearance().opacity[1] == 1.0
    model.tool = ClickMode.MISSING
    model.click_part(1)  # it cannot be both
    assert model.disruption == Disruption(missing=frozenset({1}), robots=2)
    assert model.site[1] == REMOVED


def test_fixed_parts_are_dark(model: ViewerState) -> None:
    model.go_to(len(model.timeline))
    model.tool = ClickMode.FIXED
    model.click_part(2)
    model.selected = None
    assert tuple(model.appearance().color[2]) == rgb(FIXED)


def test_boundary_cannot_be_marked(model: ViewerState) -> None:
    model.tool = ClickMode.MISSING
    with pytest.raises(InputError, match="boundary"):
        model.click_part(int(np.argmax(model.assembly.boundary)))
    assert model.disruption.empty


def test_marks_ask_for_a_proof_of_their_own(model: ViewerState) -> None:
    """Every state of a plan stands; without the part that carries the rest it does not."""
    model.go_to(len(model.timeline))
    assert model.proof().stable
    model.tool = ClickMode.MISSING
    model.click_part(2)
    assert not model.proof().stable
    model.clear_marks()
    assert model.proof().stable


def test_the_question_in_assembly() -> None:
    from falsework import load_structure

    arch = load_structure("arch:blocks=5")
    state = np.array([1, 1, 0, 0, 0, 2, 2], dtype=np.uint8)
    marks = Disruption(missing=frozenset({2}), there=frozenset({4}), fixed=frozenset({0}), robots=3)
    question = marks.question(arch, state, Direction.ASSEMBLY)
    assert question["state"].tolist() == [1, 1, 0, 0, 1, 2, 2]
    assert question["target"].tolist() == [1, 1, 1, 1, 1, 2, 2]
    assert question["missing"] == (2,)
    assert question["fixed"] == (0,)
    assert question["robots"] == 3
    left_out = Disruption(target=frozenset({3}), missing=frozenset({3})).question(arch, state, Direction.ASSEMBLY)
    assert left_out["target"].tolist() == [1, 1, 1, 0, 1, 2, 2]
    assert left_out["missing"] == ()  # what is left out is not waited for


def test_the_question_in_disassembly() -> None:
    from falsework import load_structure

    arch = load_structure("arch:blocks=5")
    state = np.array([1, 2, 1, 0, 1, 2, 2], dtype=np.uint8)
    marks = Disruption(missing=frozenset({4}), target=frozenset({0, 1, 3}), fixed=frozenset({2}))
    question = marks.question(arch, state, Direction.DISASSEMBLY)
    assert question["state"].tolist() == [1, 2, 1, 0, 0, 2, 2]
    assert question["target"].tolist() == [1, 2, 1, 0, 0, 2, 2]
    assert question["missing"] == ()


def test_replanning_around_a_missing_part_and_back(model: ViewerState) -> None:
    old = model.timeline
    model.go_to(4)
    done = [str(step) for step in old.steps[:4]]
    here = model.state.copy()

    absent = [part for part in range(5) if here[part] == REMOVED]
    model.tool = ClickMode.MISSING
    model.click_part(absent[0])
    site = model.site.copy()
    model.set_robots(3)
    answer = model.replan()
    assert answer.plan is not None, answer.words
    assert "decided by" in answer.words
    assert answer.plan.missing == (absent[0],)
    assert answer.plan.robots == 3
    assert validate_plan(answer.plan, model.assembly).good
    np.testing.assert_array_equal(model.state, site)
    assert model.position == 4
    # What is built stays, and its numbers go on.
    assert [str(step) for step in model.timeline.steps[:4]] == done
    assert [step.number for step in model.timeline.steps] == list(range(1, len(model.timeline) + 1))
    np.testing.assert_array_equal(model.timeline.states[:4], old.states[:4])
    np.testing.assert_array_equal(model.timeline.states, answer.plan.states)  # what is saved has them too
    (need,) = answer.plan.needs
    name = model.assembly.names[absent[0]]
    others = sum(step.action == "insert" for step in answer.plan.steps[4 : need.after_steps])
    assert f"{name} is needed at step {need.after_steps + 1}, after {others} other part" in answer.words
    assert model.timeline.steps[need.after_steps].words == f"insert {name}"
    assert model.disruption == Disruption(robots=3)
    assert model.can_go_back
    model.go_back()
    assert model.timeline is old
    assert model.position == 4
    assert not model.can_go_back


@pytest.mark.parametrize("found", [True, False])
def test_proofs_of_a_new_plan_are_those_of_its_own_states(model: ViewerState, found: bool) -> None:
    """With another state on site than planned, the steps that are done belong to no plan that can be proved."""
    model.go_to(2)
    if found:
        model.tool = ClickMode.THERE
        for part in np.flatnonzero(model.state == REMOVED).tolist():
            model.click_part(part)
            if model.proof().stable:
                break
            model.click_part(part)
    count = len(model.timeline)
    assert model.replan().plan is not None
    assert (len(model.timeline) < count) == found  # what is there already need not be placed
    assert model.built == (2 if found else 0)
    for place in range(len(model.timeline) + 1):
        model.go_to(place)
        proof = model.proof()
        assert proof.stable
        assert ("as built" in proof.words) == (place >= model.built), place


def test_a_robot_holds_a_part_by_a_click(model: ViewerState) -> None:
    place = next(p for p in range(len(model.timeline) + 1) if (model.timeline.states[p] == INSTALLED).any())
    model.go_to(place)
    part = int(np.argmax(model.state == INSTALLED))
    model.tool = ClickMode.HOLD
    with pytest.raises(InputError, match="is not there yet; click a part that is"):
        model.click_part(int(np.argmax(model.state == REMOVED)))
    model.click_part(part)
    assert model.site[part] == HELD
    assert "held or released" in model.disruption.words(model.assembly)
    old = model.timeline.steps
    assert model.replan().plan is not None
    steps = model.timeline.steps
    assert [step.words for step in steps[:place]] == [step.words for step in old[:place]]
    assert steps[place].words == f"hold {model.assembly.names[part]}"  # the next step, which is done
    assert model.position == place + 1
    assert model.plan is not None
    assert validate_plan(model.plan, model.assembly).good
    model.click_part(part)
    assert model.site[part] == INSTALLED


def test_a_prop_is_placed_by_a_click() -> None:
    assembly, plan = planned("arch:blocks=7", ground=True)
    model = ViewerState(Timeline.from_plan(plan, assembly), plan=plan)
    place = next(p for p in range(len(plan)) if (plan.holders[p] != NO_ROBOT).sum() == 2)
    model.go_to(place)
    model.tool = ClickMode.PROP
    low = int(np.argmin(np.where(model.state == INSTALLED, assembly.mass.center[:, 2], np.inf)))
    with pytest.raises(InputError, match="has no place for a prop"):
        model.click_part(low)
    assert model.disruption.empty
    part = int(np.argmax(model.state == HELD))
    assert model.click(over(model, part), DOWN) == part
    assert model.site[-1] == HELD  # the prop is drawn, and carries in the verdict on the state
    assert "a prop under" in model.disruption.words(model.assembly)
    model.turn(Direction.DISASSEMBLY)
    model.turn(Direction.ASSEMBLY)
    assert model.proof().stable
    model.click_part(part)
    assert model.assembly is assembly
    model.click_part(part)
    old = model.timeline.steps
    assert model.replan().plan is not None
    words = [step.words for step in model.timeline.steps]
    assert words[:place] == [step.words for step in old[:place]]
    assert words[place] == f"insert prop-{assembly.names[part]}"
    assert f"remove prop-{assembly.names[part]}" in words
    assert model.plan is not None
    assert validate_plan(model.plan, model.assembly).good
    with pytest.raises(InputError, match="a prop stands under"):
        model.click_part(part)
    with pytest.raises(InputError, match="is a prop"):
        model.click_part(model.assembly.part_count - 1)
    model.go_back()
    assert len(model.plan) == len(plan)
    assert model.disruption.props == {part}
    model.clear_marks()
    assert model.assembly.identity == assembly.identity


def test_parts_move_apart_and_are_cut_away(model: ViewerState) -> None:
    model.go_to(len(model.timeline))
    top = int(np.argmax(model.assembly.mass.center[:, 2]))
    low, high = bounds_of(model.assembly)
    model.view = SceneView(explode=0.5)
    look = model.appearance()
    apart = model.assembly.mass.center - [*(low + high)[:2] / 2, low[2]]
    np.testing.assert_allclose(look.shift, 0.5 * apart)
    assert model.click(over(model, top) + look.shift[top], DOWN) == top  # where it is seen
    model.view = SceneView(axis="z", keep=0.5)
    level = low[2] + 0.5 * (high - low)[2]
    gone = np.array([mesh.bounds[0, 2] >= level for mesh in model.assembly.meshes])
    assert gone.any()
    np.testing.assert_array_equal(model.appearance().opacity == 0, gone)
    assert model.click(over(model, top), DOWN) != top


def test_what_is_cut_away_of_a_part_is_not_clicked(model: ViewerState) -> None:
    """Of the first part a bit stays; what was in front of the cut does not take the click."""
    model.go_to(len(model.timeline))
    bounds = model.assembly.meshes[0].bounds
    ahead = np.array([*bounds.mean(axis=0)[:2] * [1, 0] + [0, bounds[0, 1] - 1.0], bounds[:, 2].mean()])
    assert model.click(ahead, np.array([0.0, 1.0, 0.0])) == 0
    low, high = bounds_of(model.assembly)[:, 1]
    model.view = SceneView(axis="y", keep=0.5)
    assert model.view.plane(model.assembly) == Plane("y", high - 0.5 * (high - low), True)
    from_the_far_side = np.array([ahead[0], high + 1.0, ahead[2]])
    assert model.click(from_the_far_side, np.array([0.0, -1.0, 0.0])) == 0
    above_the_part_cut_away = np.array([ahead[0], bounds[0, 1] + 0.1 * np.ptp(bounds[:, 1]), bounds[1, 2] + 1.0])
    assert model.click(above_the_part_cut_away, DOWN) != 0


def test_a_question_without_an_answer_says_why(model: ViewerState) -> None:
    """One robot cannot close an arch: the state before the keystone needs two."""
    model.set_robots(1)
    answer = model.replan()
    assert answer.plan is None
    assert answer.plan is None
    assert "there is no plan" in answer.words
    assert not model.can_go_back


def test_a_senseless_question_is_refused(model: ViewerState) -> None:
    position = next(
        p for p in range(len(model.timeline) + 1) if (model.timeline.states[model.timeline.row(p)] == HELD).sum() == 4
    )
    model.go_to(position)
    model.set_robots(1)
    with pytest.raises(StateError, match="held"):
        model.replan()


@pytest.mark.parametrize("direction", Direction)
def test_a_new_plan_keeps_to_what_the_old_one_kept_to(direction: Direction) -> None:
    """Gravity, reserve and tolerance, robots and the ways of parts, also from a state that is not of the plan."""
    holds = HoldSettings(1e7, 8000.0, mode=HoldMode.LOCKED)
    stability = StabilitySettings(gravity=9.0, reserve=1.2, tolerance=5e-5, holds=holds)
    assembly = load_structure("arch:blocks=5")
    old = find_plans(assembly, stability=stability, removable_only_if_clear=True).unwrap()
    model = ViewerState(Timeline.from_plan(old, assembly, direction), plan=old)
    model.go_to(model.timeline.begin)
    if direction is Direction.ASSEMBLY:
        model.disruption = Disruption(there=frozenset({0}))  # an end, which stands by itself
    new = model.replan().plan
    assert new is not None
    assert new.claim == old.claim
    assert new.removable_only_if_clear


def test_a_new_plan_says_in_what_it_promises_less(arch) -> None:
    assembly, old = arch
    answer = replan(
        old, step=2, structure=assembly, stability=replace(StabilitySettings.from_claim(old.claim), reserve=1)
    )
    words = new_plan(answer, assembly, 0.1, old, 0).words
    assert "It keeps a reserve of 1, not 1.1 as before." in words
    assert "It was not tried under changes of settings, as the one before was." in words
    cut = replace(answer, replays=(replace(answer.replays[0], stands=None, steps=3),))
    assert "The deadline left time to replay 3 of the " in new_plan(cut, assembly, 0.1, old, 0).words


def test_a_structure_without_a_plan_gets_one(arch) -> None:
    assembly, plan = arch
    still = Timeline.from_state(assembly, plan.states[0])
    model = ViewerState(still)
    answer = model.replan()
    assert answer.plan is not None
    assert "no plan before" in answer.words
    assert len(model.timeline) == len(plan)
    whole = ViewerState(Timeline.from_state(assembly, plan.states[-1]))  # as it is shown without a plan
    assert whole.replan().plan is not None
    np.testing.assert_array_equal(whole.timeline.states[[0, -1]], plan.states[[0, -1]])


@pytest.mark.parametrize(("friction", "reserve"), [(0.4, 1.1), (0.3, 1.0)])
def test_a_first_plan_keeps_the_reserve_of_the_command_or_says_why_not(friction: float, reserve: float) -> None:
    """The arch of five slides with a friction of 0.27, which is 0.3 divided by 1.1."""
    assembly = load_structure("arch:blocks=5", friction=friction)
    answer = ViewerState(Timeline.from_state(assembly, empty_state(assembly.boundary))).replan()
    assert answer.plan is not None
    assert answer.plan.claim.reserve == reserve
    why = "No plan was found that keeps the reserve: the target is not stable with friction divided by 1.1."
    assert (why in answer.words) == (reserve == 1.0)


def test_probabilities_are_those_of_the_policy(arch, policy) -> None:
    assembly, plan = arch
    model = ViewerState(Timeline.from_plan(plan, assembly, Direction.DISASSEMBLY), plan=plan, policy=policy)
    action_probabilities = model.action_probabilities()
    assert np.isfinite(action_probabilities).sum() == (model.state == INSTALLED).sum()
    assert np.nansum(action_probabilities) == pytest.approx(1.0)
    appearance = model.appearance()
    part = int(np.nanargmax(action_probabilities))
    assert tuple(appearance.color[part]) == tuple(ramp_in_steps(action_probabilities[part]))
    assert dict(facts_of(model, part))["policy"].startswith("hold it with")
    visited = model.visited(4)
    assert (visited[:, assembly.boundary] == HELD).all()
    assert (visited == plan.states[-1]).all(axis=1).any()
    from falsework import StabilityOracle

    assert StabilityOracle(assembly).verdicts(visited).stable.all()


def test_chances_of_parts() -> None:
    action_probabilities = chance_of_parts(np.array([0.2, 0.0, 0.0, 0.0, 0.8, 0.0]))
    np.testing.assert_allclose(action_probabilities, [0.2, 0.8, np.nan])

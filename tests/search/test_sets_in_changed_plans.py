"""Steps of several parts where plans are changed: alternatives, late parts, props, fewest robots, replanning."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from falsework import Assembly, Outcome, Plan, PlannerSettings, find_plans, make_task, min_robots, replan
from falsework.assembly.library import shelf as built_in_shelf
from falsework.assembly.props import prop_places, with_props
from falsework.replanning import difference
from falsework.replanning.since import SiteSteps
from falsework.search.beam.state_search import StateSearch
from falsework.search.plans.alternatives import order_distance
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.result import Route
from falsework.search.together.moves import graph_with_sets
from falsework.viewer import Timeline
from tests.search.test_together import Enumeration, EveryStateStands, assembly_of, drawn, three_bars


@pytest.fixture(scope="module")
def shelf() -> Assembly:
    return built_in_shelf(shelves=0)


@pytest.fixture(scope="module")
def plan(shelf: Assembly) -> Plan:
    return find_plans(shelf, robots=2, parts_at_once=2).plans[0]


def several(plan: Plan) -> int:
    """Number of the step that inserts several parts."""
    (number,) = [step.number for step in plan if len(step.parts) > 1]
    return number


@pytest.mark.parametrize(("seed", "count", "robots", "largest"), [(11, 3, 1, 2), (38, 4, 2, 2), (59, 4, 2, 3)])
def test_a_graph_has_as_many_routes_as_an_enumeration(seed: int, count: int, robots: int, largest: int) -> None:
    pieces = drawn(seed, count, (3, 3, 3))
    task = make_task(assembly_of(pieces), robots, parts_at_once=largest)
    every = np.stack(np.meshgrid(*[[0, 1, 2]] * count, [2], indexing="ij"), axis=-1).reshape(-1, count + 1)
    graph = graph_with_sets(task, EveryStateStands(), every.astype(np.uint8))
    assert graph.count_routes() == Enumeration(pieces, robots, largest).plans() > 0
    rng = np.random.default_rng(0)
    routes = [graph.sample_route(rng) for _ in range(20)]
    for one in routes:
        assert one is not None
        assert (one.states[-1] == task.target).all()
        np.testing.assert_array_equal(one.actions, Route.from_states(one.states).actions)


def test_parts_that_leave_at_once_are_in_no_order() -> None:
    """A pair counts as another order where one route has it in one step."""
    together = Route.from_states(np.array([[2, 2, 2], [0, 0, 2], [0, 0, 0]], np.uint8))
    apart = Route.from_states(np.array([[2, 2, 2], [0, 2, 2], [0, 0, 2], [0, 0, 0]], np.uint8))
    assert together.removal_rank().tolist() == [0, 0, 2]
    assert order_distance(together, apart) == pytest.approx(1 / 3)
    assert order_distance(together, together) == 0


def test_alternatives_differ_and_all_are_good(shelf: Assembly) -> None:
    found = find_plans(shelf, robots=2, parts_at_once=2, settings=PlannerSettings(alternatives=3))
    assert len(found.plans) == 3
    assert len({plan.states.tobytes() for plan in found.plans}) == 3
    assert all(validate_plan(plan, shelf).good and several(plan) for plan in found.plans)
    assert found.alternatives.least_distance > 0


def test_a_late_part_comes_as_late_as_its_set_can(shelf: Assembly) -> None:
    """Both boards come last, and in the order of steps nothing is left before them."""
    (plan,) = find_plans(shelf, robots=2, parts_at_once=2, missing=["top-3"]).plans
    (need,) = plan.needs
    assert (need.part, need.after_parts) == (3, 2)
    before = plan.states[need.after_steps]
    assert (before[:4] == [1, 1, 0, 0]).all()
    assert validate_plan(plan, shelf).good


def test_fewest_robots(shelf: Assembly) -> None:
    answer = min_robots(shelf, parts_at_once=2)
    assert (answer.value, answer.bound, answer.proven) == (1, 1, True)
    bars, frame = three_bars()
    none = min_robots(assembly_of(bars, frame), parts_at_once=2)
    assert none.value is None


def test_replanning_goes_on_before_and_after_a_step_of_several_parts(shelf: Assembly, plan: Plan) -> None:
    """The rules of the plan hold for what follows, and done steps stay."""
    for step in (0, several(plan) - 1, several(plan), len(plan)):
        answer = replan(plan, step=step, structure=shelf)
        assert answer.value is not None
        assert answer.value.parts_at_once == 2
        np.testing.assert_array_equal(answer.value.states[: step + 1], plan.states[: step + 1])
        assert validate_plan(answer.value, shelf).good
        changes = difference(plan, answer.value, built=step)
        assert changes.same == (answer.value.states.tobytes() == plan.states.tobytes())
        assert not changes.added
        assert not changes.dropped


def test_without_the_rule_nothing_is_found_from_a_bare_state(shelf: Assembly) -> None:
    rules = {"target": "complete", "robots": 2}
    state = {"standing": ["upright-0", "upright-1"]}
    alone = replan(shelf, state, removable_only_if_clear=True, **rules)
    assert alone.outcome is Outcome.PROVED_IMPOSSIBLE
    both = replan(shelf, state, parts_at_once=2, **rules)
    assert both.value is not None
    assert both.value.parts_at_once == 2


def test_what_happened_on_site_before_a_step_of_several_parts(shelf: Assembly, plan: Plan) -> None:
    """Robots let go of an upright that the plan holds, and take it again."""
    row = several(plan) - 1
    answer = replan(plan, step=row, structure=shelf, since=SiteSteps(held=["upright-0"]))
    assert answer.value is not None
    assert validate_plan(answer.value, shelf).good
    assert answer.value.parts_at_once == 2


def test_props_and_repeated_holds_with_several_parts(shelf: Assembly) -> None:
    """Every state is examined where the search ends; no set leaves while a prop stands under one of its parts."""
    propped = with_props(shelf, prop_places(shelf))
    assert propped.props
    found = find_plans(propped, robots=1, parts_at_once=2, allow_regrasp=True, props=1)
    assert found.value is not None
    assert found.value.parts_at_once == 2
    task = make_task(propped, 1, parts_at_once=2, allow_regrasp=True, props=1)
    search = StateSearch(task, EveryStateStands())
    assert search.run().found
    bare = shelf.part_count
    for before, after in pairwise(search.route().states):
        gone = np.flatnonzero((before[:bare] > 0) & (after[:bare] == 0))
        if len(gone) > 1:
            standing = {prop.part for prop, there in zip(propped.props, before[bare:], strict=True) if there}
            assert not standing & set(gone.tolist())
    bars, frame = three_bars()
    locked = make_task(assembly_of(bars, frame), 2, parts_at_once=2, allow_regrasp=True)
    assert StateSearch(locked, EveryStateStands()).run().outcome is Outcome.PROVED_IMPOSSIBLE


def test_a_timeline_goes_on_with_sets(shelf: Assembly, plan: Plan) -> None:
    answer = replan(plan, step=1, structure=shelf)
    assert answer.value is not None
    shown = Timeline.from_plan(plan, shelf).going_on(0, replace(answer.value, source=None))
    assert len(shown.states) == len(answer.value.states)

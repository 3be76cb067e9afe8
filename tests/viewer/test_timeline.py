"""A plan as something to look at."""

from __future__ import annotations

import numpy as np
import pytest

from falsework import Direction, load_structure
from falsework.assembly import HELD, REMOVED
from falsework.errors import PlanError
from falsework.search.plans.steps import NO_ROBOT, holders
from falsework.viewer import Timeline
from falsework.viewer.appearance import FADE, appearance_at, pick
from falsework.viewer.palette import BOUNDARY, ramp, rgb, robot_color
from falsework.viewer.timeline import exit_direction_of, interesting


def test_a_robot_keeps_its_part() -> None:
    boundary = np.array([True, False, False, False])
    states = np.array(
        [[2, 1, 1, 1], [2, 2, 1, 1], [2, 2, 2, 1], [2, 0, 2, 1], [2, 0, 2, 2], [2, 0, 0, 2]], dtype=np.uint8
    )
    robots = holders(states, boundary)
    assert (robots[:, 0] == NO_ROBOT).all()
    assert robots[1:3, 1].tolist() == [0, 0]
    assert robots[2:5, 2].tolist() == [1, 1, 1]
    assert robots[4:, 3].tolist() == [0, 0]  # the robot that was free
    for row in robots:
        held = row[row >= 0]
        assert len(set(held)) == len(held)


def test_both_orders_show_the_same_states(arch) -> None:
    assembly, plan = arch
    together = Timeline.from_plan(plan, assembly)
    apart = together.turned(Direction.DISASSEMBLY)
    count = len(plan)
    for timeline in (together, apart):
        for place in range(count + 1):
            np.testing.assert_array_equal(timeline.states[timeline.row(place)], plan.states[place])
    assert (together.begin, together.end, list(together.places)) == (0, count, list(range(count + 1)))
    assert (apart.begin, apart.end, list(apart.places)) == (count, 0, list(range(count, -1, -1)))
    # Halfway through a step the state is the one that was left; the step leads to the one ahead.
    assert (together.row(3.5), together.next(3.5)) == (3, 4)
    assert (apart.row(3.5), apart.next(3.5)) == (4, 3)


def test_a_step_has_one_number_in_both_orders(arch) -> None:
    assembly, plan = arch
    together = Timeline.from_plan(plan, assembly)
    apart, count = together.turned(Direction.DISASSEMBLY), len(plan)
    assert together.label(0) == f"step 0 of {count}"
    assert apart.label(count) == f"all {count} steps done"
    for step in plan:
        assert together.label(step.number) == f"step {step.number} of {count}: {step}"
        undone = apart.step_to(step.number - 1)
        assert undone is not None
        assert (undone.number, undone.part, undone.robot) == (step.number, step.part, step.robot)
        assert apart.label(step.number - 1) == f"step {step.number} of {count}: {undone}"
        assert undone.action is step.action.undone


def test_who_holds_when_is_what_the_states_say(timeline) -> None:
    for part in range(timeline.assembly.part_count):
        held = {place for _, first, last in timeline.held_when(part) for place in range(first, last + 1)}
        expected = {
            place
            for place in range(len(timeline) + 1)
            if timeline.states[timeline.row(place), part] == HELD and not timeline.assembly.boundary[part]
        }
        assert held == expected


def test_ways_out_are_those_of_the_clearance_table(timeline) -> None:
    for part in np.flatnonzero(timeline.insertion > 0):
        assert np.linalg.norm(timeline.exit_directions[part]) == pytest.approx(1.0)
        state = timeline.states[timeline.insertion[part]]
        np.testing.assert_array_equal(
            timeline.exit_directions[part], timeline.assembly.clearance.exit_direction(state, part)
        )


def test_a_guessed_way_out_leads_away_from_what_is_touched() -> None:
    stack = load_structure("stack:blocks=4")
    state = np.where(stack.boundary, 2, 1).astype(np.uint8)
    top = int(np.argmax(stack.mass.center[:, 2]))
    np.testing.assert_allclose(exit_direction_of(stack, state, top, exact_up_to=0), [0, 0, 1], atol=1e-9)
    alone = np.where(stack.boundary, 2, 0).astype(np.uint8)
    np.testing.assert_allclose(exit_direction_of(stack, alone, top, exact_up_to=0), [0, 0, 1], atol=1e-9)


def test_a_plan_of_another_structure_is_refused(arch) -> None:
    with pytest.raises(PlanError, match="parts"):
        Timeline.from_plan(arch[1], load_structure("arch:blocks=6"))


def test_colours_are_those_of_state_and_robots(timeline) -> None:
    for place in range(len(timeline) + 1):
        appearance = appearance_at(timeline, place, travelling=False)
        state = timeline.states[timeline.row(place)]
        np.testing.assert_array_equal(appearance.opacity > 0, state != REMOVED)
        for part in range(len(state)):
            if timeline.assembly.boundary[part]:
                assert tuple(appearance.color[part]) == rgb(BOUNDARY)
            elif state[part] == HELD:
                assert tuple(appearance.color[part]) == rgb(robot_color(int(appearance.holder[part])))


def test_a_part_fades_out_along_its_way(arch) -> None:
    assembly, plan = arch
    timeline = Timeline.from_plan(plan, assembly, Direction.DISASSEMBLY)
    some = np.flatnonzero(timeline.insertion > 0)
    step = int(timeline.insertion[some].min())
    part = int(some[np.argmin(timeline.insertion[some])])
    first = int(np.argmax(timeline.insertion))
    begin = int(timeline.insertion[first])
    places = begin - np.linspace(0, FADE, 9)
    looks = [appearance_at(timeline, place) for place in places]
    opacity = [appearance.opacity[first] for appearance in looks]
    assert opacity[0] == 1.0
    assert opacity[-1] == 0.0
    assert (np.diff(opacity) < 0).all()
    along = [appearance.shift[first] @ timeline.exit_directions[first] for appearance in looks[:-1]]
    assert (np.diff(along) > 0).all()
    assert looks[4].ghosts.tolist() == [first] or first in looks[4].ghosts
    assert appearance_at(timeline, step - 1).opacity[part] < 1.0


def test_probabilities_colour_only_what_can_be_acted_on(timeline) -> None:
    action_probabilities = np.full(timeline.assembly.part_count, np.nan)
    action_probabilities[2] = 0.75
    place = len(timeline)
    plain, asked = (
        appearance_at(timeline, place),
        appearance_at(timeline, place, action_probabilities=action_probabilities),
    )
    assert tuple(asked.color[2]) == tuple(ramp(0.75))
    np.testing.assert_array_equal(np.delete(asked.color, 2, 0), np.delete(plain.color, 2, 0))


def test_a_ray_hits_the_nearest_part_that_is_seen(timeline) -> None:
    assembly = timeline.assembly
    appearance = appearance_at(timeline, len(timeline))
    above = np.array([0.0, 0.0, 10.0])
    keystone = int(np.argmax(assembly.mass.center[:, 2]))
    hit = pick(assembly, appearance, assembly.mass.center[keystone] + above, np.array([0.0, 0.0, -2.0]))
    assert hit == keystone
    assert pick(assembly, appearance, assembly.mass.center[keystone] + above, np.array([0.0, 0.0, 1.0])) is None
    assert pick(assembly, appearance, np.array([50.0, 0.0, 10.0]), np.array([0.0, 0.0, -1.0])) is None
    empty = appearance_at(timeline, 0, travelling=False)
    assert pick(assembly, empty, assembly.mass.center[keystone] + above, np.array([0.0, 0.0, -1.0])) is None


def test_chosen_places_begin_at_the_beginning_and_end_at_the_end(timeline) -> None:
    apart = list(interesting(timeline.turned(Direction.DISASSEMBLY), 5))
    chosen = list(interesting(timeline, 5))
    assert apart == chosen[::-1]
    assert chosen[0] == 0
    assert chosen[-1] == len(timeline)
    assert chosen == sorted(set(chosen))
    assert list(interesting(timeline, 1000)) == sorted(set(interesting(timeline, 1000)))

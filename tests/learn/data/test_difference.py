"""Difference of two plans: what must hold of any two, and what people read."""

from __future__ import annotations

import json

import numpy as np
import pytest

from falsework import Direction, Plan, PlannerSettings, Replanner, find_plans, load_structure
from falsework.errors import PlanError
from falsework.replanning import difference

ARCH = load_structure("arch:blocks=7")


@pytest.fixture(scope="module")
def plans() -> tuple[Plan, ...]:
    """Plans that differ."""
    return find_plans(ARCH, settings=PlannerSettings(alternatives=4), forces=False).plans


def test_a_plan_does_not_differ_from_itself(plans: tuple[Plan, ...]) -> None:
    for plan in plans:
        same = difference(plan, plan)
        assert same.same
        assert same.moved == ()
        assert same.order_kept == 1.0
        assert same.steps_saved == 0
        assert same.text == f"the plan stays as it was; steps left: {len(plan)}"
        assert difference(plan, plan, Direction.DISASSEMBLY).same


def test_both_ways(plans: tuple[Plan, ...]) -> None:
    """Between plans of one task: places mirror each other, and add up to nothing."""
    for old in plans:
        for new in plans:
            one, other = difference(old, new), difference(new, old)
            assert {(m.part, m.places) for m in one.moved} == {(m.part, -m.places) for m in other.moved}
            assert sum(move.places for move in one.moved) == 0
            assert one.common_steps == other.common_steps
            assert one.first_old == other.first_new
            assert one.order_kept == other.order_kept
            common = one.common_steps
            np.testing.assert_array_equal(old.actions[:common], new.actions[:common])
            if old is not new:
                assert old.actions[common] != new.actions[common]
                assert not one.same
                assert one.order_kept < 1.0 or not one.moved


def test_from_the_middle(plans: tuple[Plan, ...]) -> None:
    """A new plan from a state of the old one is compared with what was left of that."""
    replanner = Replanner(ARCH)
    old = plans[0]
    state = old.states[6]
    new = replanner.replan(state, direction=Direction.ASSEMBLY).plans[0]
    change = difference(old, new)
    assert change.begins_on_the_way
    assert change.old_steps == change.new_steps == len(old) - 6
    assert change.added == change.dropped == ()


def test_what_is_left_to_take_apart(plans: tuple[Plan, ...]) -> None:
    """In disassembly a plan begins with its last state, and a step of it is undone."""
    old = plans[0]
    new = Replanner(ARCH).replan(old.states[6], direction=Direction.DISASSEMBLY).plans[0]
    change = difference(old, new, Direction.DISASSEMBLY)
    assert change.begins_on_the_way
    assert change.old_steps == change.new_steps == 6
    for other in plans[1:]:
        apart = difference(old, other, Direction.DISASSEMBLY)
        common = apart.common_steps
        np.testing.assert_array_equal(old.actions[::-1][:common], other.actions[::-1][:common])
        assert apart.first_old == old.in_order(Direction.DISASSEMBLY)[common].words
        assert apart.first_old.split()[0] in ("hold", "remove")


def test_parts_that_come_and_go(plans: tuple[Plan, ...]) -> None:
    """The old plan is not on the way any more: somebody has placed other parts already."""
    old, new = plans[0], plans[1]
    for step in range(2, len(new), 2):
        rest = Replanner(ARCH).replan(new.states[step], direction=Direction.ASSEMBLY).plans[0]
        change = difference(old, rest)
        placed = set(old.inserted_parts.tolist()) - set(rest.inserted_parts.tolist())
        if not change.begins_on_the_way:
            assert set(change.dropped) == {ARCH.names[part] for part in placed}
            assert change.steps_saved == len(old) - len(rest)
            assert "does not pass through this state" in change.text
            assert "fewer" in change.text
            return
    pytest.fail("the two plans share all their states")


def test_words_and_json(plans: tuple[Plan, ...]) -> None:
    change = difference(plans[0], plans[1])
    text = change.text
    assert "instead of" in text
    assert "later" in text
    assert "earlier" in text
    assert "\n" not in text
    record = json.loads(json.dumps(change.to_dict()))
    assert record["text"] == text
    assert len(record["moved"]) == len(change.moved)
    assert abs(record["moved"][0]["places"]) == max(abs(move.places) for move in change.moved)


def test_plans_of_different_structures(plans: tuple[Plan, ...]) -> None:
    other = find_plans(load_structure("arch:blocks=3"), forces=False).plans[0]
    with pytest.raises(PlanError, match="different structures"):
        difference(other, plans[0])

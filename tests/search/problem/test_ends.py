"""Ends of a task: a structure that slides from rest may stand as it is built."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework import (
    Assembly,
    Direction,
    Outcome,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    find_plans,
    load_structure,
    min_robots,
    replan,
)
from falsework.search.planner import Planner
from falsework.search.problem.ends import judge_ends
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.task import Task
from falsework.stability.contact.replay import Replayer

CONTACT = StabilitySettings("contact")


@pytest.fixture(scope="module")
def vault() -> Assembly:
    return replace(load_structure("vault:parts=30"), friction=0.45)


def test_a_vault_that_slides_from_rest_is_planned_as_it_is_built(vault: Assembly) -> None:
    oracle = StabilityOracle(vault, CONTACT)
    planning = find_plans(vault, oracle=oracle)
    (plan,) = planning.plans
    assert oracle.verdicts(plan.states[-1]).slides.all()
    assert plan.replay is not None
    assert plan.replay.stands
    assert Replayer(vault, CONTACT).replay(plan.states, presses=plan.presses_before).good
    assert (plan.states[-1] == np.where(vault.boundary, 2, 1)).all()


def test_robots_are_enough_for_a_vault_that_slides_from_rest(vault: Assembly) -> None:
    answer = min_robots(vault, oracle=StabilityOracle(vault, CONTACT))
    assert answer.value == answer.bound == 2


@pytest.mark.parametrize(
    ("friction", "directions", "told"),
    [
        (0.32, (Direction.ASSEMBLY, Direction.DISASSEMBLY), "from rest the complete structure slides"),
        (0.45, (Direction.DISASSEMBLY,), "the complete structure slides"),
    ],
)
def test_without_a_way_to_build_it_the_search_gives_up(
    vault: Assembly, friction: float, directions: tuple[Direction, ...], told: str
) -> None:
    weak = replace(vault, friction=friction)
    planning = find_plans(weak, oracle=StabilityOracle(weak, CONTACT), settings=PlannerSettings(directions=directions))
    assert planning.outcome is Outcome.NOT_FOUND
    assert planning.result.limit == told
    assert not planning.result.interrupted


def test_what_is_proven_unstable_is_not_built(vault: Assembly) -> None:
    weak = replace(vault, friction=0.1)
    task, oracle = Task.from_rules(weak.boundary), StabilityOracle(weak, CONTACT)
    failed, doubt = judge_ends(task, oracle, (Direction.ASSEMBLY,))
    assert not doubt
    assert failed is not None
    assert failed.outcome is Outcome.PROVED_IMPOSSIBLE


def test_a_plan_of_a_vault_that_slides_from_rest_is_continued(vault: Assembly) -> None:
    plan = find_plans(vault, oracle=StabilityOracle(vault, CONTACT)).plans[0]
    answer = replan(vault, plan.states[20], direction=Direction.ASSEMBLY, stability=CONTACT)
    assert answer.found
    assert (answer.plans[0].states[-1] == plan.states[-1]).all()


def test_the_ends_are_judged_once(vault: Assembly) -> None:
    oracle = StabilityOracle(vault, CONTACT)
    planner = Planner(Task.from_rules(vault.boundary), oracle)
    planner.run(stop=lambda: True)
    asked = oracle.counters.asked
    assert asked
    planner.run(stop=lambda: True)
    assert oracle.counters.asked == asked


def test_the_start_is_not_judged_again_in_each_turn_of_a_search_that_holds_parts_again(rules: Any) -> None:
    tower, asked = rules.tower(4), Counter[bytes]()

    class Noted(Oracle):
        def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
            asked.update(state.tobytes() for state in states)
            return tower.verdicts(states)

    task = Task.from_rules(rules.ground(4), 2, allow_regrasp=True)
    planner = Planner(task, Noted(), PlannerSettings(directions=(Direction.DISASSEMBLY,)))
    planner.run(stop=lambda: True)
    before = asked[task.start.tobytes()]
    assert before
    assert planner.run().found
    assert asked[task.start.tobytes()] == before

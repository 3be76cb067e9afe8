"""Plans with the largest margin of the weakest step: what is reached, what bounds it, and what ends the search."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from falsework import StabilityOracle, find_plans, load_structure, make_task, maximise_margin
from falsework.search import Demands, PlanMargins, SearchProgress


@pytest.mark.parametrize("kind", ["friction", "tilt"])
def test_the_weakest_step_reaches_the_bound_of_both_ends(kind: Literal["friction", "tilt"]) -> None:
    """The complete catenary is its own weakest state."""
    assembly = load_structure("catenary:blocks=9")
    margins = maximise_margin(assembly, make_task(assembly, 2), kind).plans[0].margins
    assert margins is not None
    assert margins.maximised == kind
    weakest = margins.weakest(kind)
    assert weakest is not None
    assert margins.bound is not None
    assert weakest[1] == pytest.approx(margins.bound, rel=0.02)


def test_plans_made_for_it_need_less_friction() -> None:
    assembly = load_structure("arch:blocks=15")
    first = find_plans(assembly, robots=2).plans[0]
    before = PlanMargins.from_oracle(StabilityOracle(assembly), first.states, Demands(), also="friction").weakest(
        "friction"
    )
    margins = maximise_margin(assembly, make_task(assembly, 2), "friction").plans[0].margins
    assert before is not None
    assert margins is not None
    after = margins.weakest("friction")
    assert after is not None
    assert after[1] < 0.9 * before[1]


def test_a_bound_that_no_search_reaches_does_not_hold_it_up() -> None:
    """Every plan found of the arch has a state weaker than both ends, which bound it: to slide is no proof."""
    assembly = load_structure("arch:blocks=7")
    asked: list[int] = []

    def note(progress: SearchProgress) -> None:
        asked.append(progress.asked)

    plan = maximise_margin(assembly, make_task(assembly, 2), "push", progress=note).plans[0]
    assert plan.margins is not None
    assert plan.margins.bound is not None
    weakest = plan.margins.weakest("push")
    assert weakest is not None
    assert 0 < weakest[1] <= plan.margins.bound
    assert max(asked) < 1200
    assert np.all(StabilityOracle(assembly).verdicts(plan.states).stable)


def test_a_stopped_search_returns_the_first_plan_with_its_margins() -> None:
    assembly = load_structure("arch:blocks=9")
    calls: list[int] = []

    def stop() -> bool:
        calls.append(1)
        return len(calls) > most

    most = 10**9
    find_plans(assembly, robots=2, stop=stop)
    most = len(calls) + 1
    calls.clear()
    found = maximise_margin(assembly, make_task(assembly, 2), "friction", stop=stop)
    assert len(calls) > most
    assert found.found
    assert found.result.interrupted
    margins = found.plans[0].margins
    assert margins is not None
    assert margins.maximised == "friction"
    assert len(margins.measured["friction"]) == len(found.plans[0].states)

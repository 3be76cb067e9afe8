"""Robot plans under both criteria: the checked actions, and delivery of plans with a successful replay alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Direction, StabilityOracle, StabilitySettings, Task, load_structure, plan_robots
from falsework.assembly import HELD, complete_state
from falsework.robots import Cell, HybridSettings
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.result import Route
from falsework.stability.contact.history import History, Replay
from tests.robots.plans.orders import APART

ARCH = load_structure("arch:blocks=5")
TASK = Task.from_rules(ARCH.boundary, 2)


class Watched(StabilityOracle):
    """Remembers the states that it was asked about."""

    def __init__(self, assembly: Assembly, criterion: Any) -> None:
        super().__init__(assembly, StabilitySettings(criterion=criterion))
        self.seen: set[bytes] = set()

    def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
        self.seen |= {state.tobytes() for state in np.atleast_2d(states)}
        return super().verdicts(states, near=near, require_certificate=require_certificate)


class Falling:
    """A replayer that calls states of whole routes bad, and those reached by steps inside a search if told so."""

    def __init__(self, real: Any, bad: Callable[[np.ndarray], bool], inside: bool = False) -> None:
        self.real, self.bad, self.inside, self.routes = real, bad, inside, []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.real, name)

    def step(self, history: History, before: np.ndarray, after: np.ndarray) -> tuple[bool, History]:
        stands, history = self.real.step(history, before, after)
        return stands and not (self.inside and self.bad(after)), history

    def replay(self, states: np.ndarray, history: History | None = None, presses: Any = None) -> Replay:
        found = self.real.replay(states, history, presses)
        if history is not None or len(states) == 1:  # where a search begins, or pieces of a route that stands
            return found
        self.routes.append(states)
        falls = [row for row, state in enumerate(states) if self.bad(state)]
        if not falls:
            return found
        stands = found.stands.copy()
        stands[falls[0] :] = 0
        return replace(found, stands=stands)


def removals(states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Remove wherever it can be done."""
    return np.tile(np.repeat([0.0, 1.0], ARCH.part_count), (len(states), 1))


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_rollouts_ask_about_holds_where_they_must(criterion: str) -> None:
    oracle = Watched(ARCH, criterion)
    route = SolvabilityCheck(ARCH, TASK, oracle, score=removals).roll_out(None)
    assert route is not None
    asked = np.array([state.tobytes() in oracle.seen for state in route.states[1:]])
    removal = route.actions >= ARCH.part_count
    assert asked[removal].all()
    assert asked[~removal].all() == (criterion == "contact")
    assert asked[~removal].any() == (criterion == "contact")


def test_rollouts_go_around_what_is_forbidden() -> None:
    solvability = SolvabilityCheck(ARCH, TASK, StabilityOracle(ARCH), score=removals)
    assert solvability.prepare().found
    first = solvability.roll_out(None)
    assert first is not None
    forbidden = first.states[3].tobytes()
    assert solvability.forbid(first, TASK.steps - 3)
    for seed in range(4):
        second = solvability.roll_out(np.random.default_rng(seed))
        assert second is not None
        assert forbidden not in {state.tobytes() for state in second.states}


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_what_is_solvable_under_contact_has_been_asked_about(criterion: str) -> None:
    """States that only the search for a way met count as solvable too, so their holds must have had a verdict."""
    oracle = Watched(ARCH, criterion)
    solvability = SolvabilityCheck(ARCH, TASK, oracle)
    assert solvability.prepare().found
    known = len(solvability)
    state, found = complete_state(ARCH.boundary), []
    for action in solvability.legal(state):
        if not solvability.known(state, action) and solvability.solvable(state, action):
            found.append(action)
    assert found
    assert all(action < ARCH.part_count for action in found)  # nothing is held that could be removed
    held = []
    for action in found:
        after = state.copy()
        after[action] = HELD
        held.append(after.tobytes() in oracle.seen)
    assert len(solvability) > known
    assert held == [criterion == "contact"] * len(held)


def test_a_hold_on_the_way_that_does_not_stand_is_gone_around() -> None:
    def prepared(oracle: StabilityOracle) -> SolvabilityCheck:
        solvability = SolvabilityCheck(ARCH, TASK, oracle)
        assert solvability.prepare().found
        return solvability

    class Refusing(StabilityOracle):
        refused = np.empty((0, ARCH.part_count), dtype=np.uint8)

        def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
            verdicts = super().verdicts(states, near=near, require_certificate=require_certificate)
            verdicts.verdict[(np.atleast_2d(states)[:, None] == self.refused).all(axis=2).any(axis=1)] = 0
            return verdicts

    state, tried = complete_state(ARCH.boundary), 0
    for action in prepared(StabilityOracle(ARCH)).legal(state):
        plain = prepared(StabilityOracle(ARCH))
        after = state.copy()
        after[action] = HELD
        before = [later for later in plain.legal(after) if plain.known(after, later)]
        if plain.known(state, action) or not plain.solvable(state, action):
            continue
        for later in plain.legal(after):
            if later >= ARCH.part_count or later in before or not plain.known(after, later):
                continue
            oracle = Refusing(ARCH)
            oracle.refused = after[None].copy()
            oracle.refused[0, later] = HELD
            solvability = prepared(oracle)
            solvability.solvable(state, action)
            assert not solvability.known(after, later)
            tried += 1
    assert tried


def test_another_abstract_plan_costs_a_bounded_number_of_verdicts() -> None:
    oracle = StabilityOracle(ARCH)
    solvability = SolvabilityCheck(ARCH, TASK, oracle, varied_verdicts=0)
    assert solvability.prepare().found
    known = len(solvability)
    asked = oracle.counters.asked
    solvability.perturb(1)
    assert oracle.counters.asked == asked
    assert len(solvability) == known


def test_the_deadline_ends_later_searches_too() -> None:
    oracle, late = StabilityOracle(ARCH), False
    solvability = SolvabilityCheck(ARCH, TASK, oracle)
    assert solvability.prepare(lambda: late).found
    late, known, asked = True, len(solvability), oracle.counters.asked
    solvability.perturb(1)
    solvability.relax(0.5)
    assert oracle.counters.asked == asked
    assert len(solvability) == known


def test_a_forbidden_state_takes_its_only_ways_with_it() -> None:
    """One part at a time on one way: whatever comes before the forbidden state is not solvable any more."""
    oracle = StabilityOracle(ARCH)
    solvability = SolvabilityCheck(ARCH, TASK, oracle)
    assert solvability.prepare().found
    route = SolvabilityCheck(ARCH, TASK, oracle, score=removals).roll_out(None)
    assert route is not None
    states, actions = route.states, route.actions
    row = len(states) - 3
    assert solvability.forbid(Route(states, actions), row)
    state = states[::-1][row + 1]  # the one before, in the order of disassembly
    action = int(actions[::-1][row])
    assert not solvability.known(state, action)
    assert not solvability.solvable(state, action)
    short = Route(states[:2], actions[:1])
    assert not solvability.forbid(short, 1)


def test_a_plan_says_by_which_criterion_it_stands(column: Assembly, cell: Cell, result: HybridResult) -> None:
    assert result.value is not None
    assert result.statistics["criterion"] == "contact"
    assert result.statistics["replay"]["stands"]
    assert result.value.plan.claim.criterion == "contact"
    plain = plan_robots(
        column,
        cell,
        oracle=StabilityOracle(column, StabilitySettings(criterion="equilibrium")),
        settings=APART,
    )
    assert plain.value is not None
    assert plain.statistics["criterion"] == "equilibrium"
    assert plain.statistics["replay"] is None
    assert plain.value.plan.claim.criterion == "equilibrium"


def test_a_plan_that_falls_is_not_delivered_but_another_one_is(
    column: Assembly, cell: Cell, result: HybridResult
) -> None:
    """The search for a plan without motions replays its steps; the plan with motions is replayed as a whole."""
    assert result.value is not None
    bad = result.value.states[2].copy()
    oracle = StabilityOracle(column)
    falling = Falling(oracle.replayer, lambda state: np.array_equal(state, bad))
    oracle.__dict__["replayer"] = falling
    found = plan_robots(column, cell, oracle=oracle, settings=APART)
    assert found.value is not None
    assert (falling.routes[0] == bad).all(axis=1).any()
    assert found.statistics["replays_fallen"] == 1
    assert not (found.value.plan.states == bad).all(axis=1).any()
    assert found.statistics["replay"]["stands"]
    assert validate_plan(found.value.plan, column).good


def test_where_every_plan_falls_none_is_delivered_and_the_step_is_named(column: Assembly, cell: Cell) -> None:
    """Whenever cube 2 is held, the replay falls, and without holding it there is no plan."""
    for inside in (False, True):
        oracle = StabilityOracle(column)
        oracle.__dict__["replayer"] = Falling(oracle.replayer, lambda state: bool(state[2] == HELD), inside)
        found = plan_robots(column, cell, oracle=oracle, settings=HybridSettings(Direction.DISASSEMBLY, attempts=2))
        assert not found.found
        assert found.partial is None or not (found.partial.plan.states[:, 2] == HELD).any()
        assert found.explanation is not None
        assert found.explanation.outcome == "not_found"
        assert "the structure collapses in the replay at step" in found.explanation.text
        assert "inserting block-2" in found.explanation.text

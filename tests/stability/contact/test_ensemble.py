"""Replays of ensembles agree with replays under each of their settings."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Plan, PlannerSettings, StabilitySettings, find_plans, load_structure
from falsework.search.beam.paths import PathHistories
from falsework.stability import HoldSettings
from falsework.stability.contact import varied_replay
from falsework.stability.contact.history import Change, Presses, ReplaySettings
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.varied_replay import MANY, replay_varied, variations

CONTACT = StabilitySettings(criterion="contact", reserve=1.1)


def planned(assembly: Assembly, seed: int, reserve: float) -> Plan:
    settings = PlannerSettings(seed=seed)
    return find_plans(assembly, stability=replace(CONTACT, reserve=reserve), settings=settings).plans[0]


def members(replayer: Replayer, plan: Plan) -> list[tuple[Change, Replayer, Presses]]:
    """Return a replayer for each change, and the presses that err as it says."""
    changes = variations(5)
    return [(change, replayer.vary(change), change.inexact(plan.presses_before)) for change in changes]


@pytest.mark.parametrize("stiffness", [np.inf, 1e7])
def test_histories_are_those_of_single_replays(stiffness: float) -> None:
    """Also step by step, and where robots are springs."""
    assembly = load_structure("vault:parts=40")
    plan = planned(assembly, 0, 1.1)
    settings = replace(CONTACT, holds=replace(plan.claim.holds, stiffness=stiffness))
    ensemble = Replayer(assembly, settings)
    each = members(ensemble, plan)
    ensemble.also_under([change for change, _, _ in each])
    whole = ensemble.replay(plan.states, presses=plan.presses_before)
    alone = [replayer.replay(plan.states, presses=presses) for _, replayer, presses in each]
    assert whole.good == all(replay.good for replay in alone)
    for row, history in enumerate(whole.histories):
        for own, replay in zip(history.changed, alone, strict=True):
            np.testing.assert_array_equal(own.springs, replay.histories[row].springs)
            np.testing.assert_array_equal(own.displacement, replay.histories[row].displacement)
    middle = len(whole.histories) // 2
    stands, after = ensemble.step(
        whole.histories[middle - 1], plan.states[middle - 1], plan.states[middle], plan.presses_before[middle]
    )
    assert stands
    for own, other in zip(after.changed, whole.histories[middle].changed, strict=True):
        np.testing.assert_array_equal(own.springs, other.springs)


def test_a_replay_ends_where_one_of_the_settings_fails() -> None:
    """With so little friction that a plan just stands under its own settings alone."""
    assembly = load_structure("vault:parts=40")
    plan, first = planned(assembly, 1, 1.0), None
    for reserve in np.arange(2.0, 1.0, -0.05).tolist():
        ensemble = Replayer(assembly, replace(CONTACT, reserve=reserve))
        if not ensemble.replay(plan.states, presses=plan.presses_before).good:
            continue
        each = members(ensemble, plan)
        fails = [replayer.replay(plan.states, presses=given).falls_at for _, replayer, given in each]
        first = min((row for row in fails if row is not None), default=None)
        if first is not None:
            break
    assert first is not None
    ensemble.also_under([change for change, _, _ in each])
    found = ensemble.replay(plan.states, presses=plan.presses_before)
    assert found.falls_at == first
    assert len(found.histories) == len(found.presses) == first
    assert (found.stands[first + 1 :] == 0).all()


def test_a_first_state_that_falls_under_a_change_ends_the_replay() -> None:
    """Parts that soft robots hold from the start; under further changes there is nothing left to replay."""
    assembly = load_structure("arch:blocks=7")
    settings = StabilitySettings(holds=HoldSettings(stiffness=1e5))
    states = np.array([[1, 1, 2, 0, 2, 1, 1, 2, 2], [1, 1, 2, 2, 2, 1, 1, 2, 2]], dtype=np.uint8)
    ensemble = Replayer(assembly, settings)
    assert ensemble.replay(states).good
    softer, stiffer = variations(2)
    assert (softer.hold_factor, stiffer.hold_factor) == (1 / 3, 3.0)
    ensemble.also_under([softer, stiffer])
    found = ensemble.replay(states)
    assert (found.falls_at, found.histories, found.presses) == (0, (), ())


def test_a_path_whose_first_state_falls_under_a_change_that_is_learned_ends() -> None:
    """Though another is learned with it."""
    states = np.array([[1, 1, 2, 0, 2, 1, 1, 2, 2], [1, 1, 2, 2, 2, 1, 1, 2, 2]], dtype=np.uint8)
    replayer = Replayer(load_structure("arch:blocks=7"), StabilitySettings(holds=HoldSettings(stiffness=1e5)))
    paths = PathHistories(replayer, lambda row: row - 1 if row else None, lambda row: states[row])
    for row in range(2):
        paths.keep(row, paths.step(row - 1, states[row]) if row else replayer.replay(states[:1]).histories[0])
    assert paths.summary(1) is not None
    replayer.also_under(variations(2))
    assert paths.summary(1) is None


def test_a_history_of_one_setting_goes_on_under_it_alone() -> None:
    assembly = load_structure("arch:blocks=7")
    plan = planned(assembly, 0, 1.1)
    plain, ensemble = Replayer(assembly, CONTACT), Replayer(assembly, CONTACT)
    ensemble.also_under(variations(1))
    history = plain.replay(plan.states[:5]).histories[-1]
    found = ensemble.replay(plan.states[4:], history)
    assert found.good
    assert not any(some.changed for some in found.histories)


def test_a_path_goes_on_under_a_change_that_is_learned_on_the_way() -> None:
    """With the histories that it would have had from the beginning."""
    assembly = load_structure("vault:parts=40")
    plan = planned(assembly, 0, 1.1)
    ensemble, whole = (Replayer(assembly, CONTACT) for _ in range(2))
    paths = PathHistories(ensemble, lambda row: row - 1 if row else None, lambda row: plan.states[row])
    learned = variations(4)
    history = None
    for row in range(1, len(plan.states)):
        history = paths.step(row - 1, plan.states[row])
        assert history is not None
        paths.keep(row, history)
        if row in (len(plan.states) // 3, len(plan.states) // 2):
            ensemble.also_under(learned[: len(ensemble.changes) + 1])
    whole.also_under(ensemble.changes)
    summary = paths.summary(len(plan.states) - 1)
    assert summary is not None
    expected = whole.replay(plan.states, presses=summary.presses).histories[-1]
    assert history is not None
    assert len(history.changed) == 2
    for own, other in zip((history, *history.changed), (expected, *expected.changed), strict=True):
        np.testing.assert_array_equal(own.springs, other.springs)


def test_a_plan_with_a_reserve_stands_under_every_change() -> None:
    """So every default plan does, and says so."""
    assembly = load_structure("vault:parts=40")
    for reserve in (1.0, 1.1):
        plan = planned(assembly, 0, reserve)
        assert plan.replay is not None
        assert plan.replay.varied == (reserve > 1.0)
        if reserve > 1.0:
            replayer = Replayer(assembly, replace(CONTACT, holds=plan.claim.holds))
            cases = replay_varied(replayer, plan.states, plan.presses_before, changes=variations(8))
            assert all(case.good for case in cases)


def test_changes_have_every_pair_of_extremes() -> None:
    """All four of each pair of settings in the first eight, of all but one pair in four; sixteen have them all."""
    changes = variations(MANY)
    assert len(set(changes)) == len({change.name for change in changes}) == MANY

    def extremes(change: Change) -> tuple[float | None, ...]:
        return change.ratio, change.replay.increments, change.replay.first_step, change.hold_factor

    assert len({extremes(change) for change in changes}) == 16
    for first in range(0, 16, 4):
        four = changes[first : first + 4]
        assert {change.press for change in four} == set(range(4))
        pairs = [{(extremes(change)[a], extremes(change)[b]) for change in four} for a, b in combinations(range(4), 2)]
        assert [len(pair) for pair in pairs] == [4, 4, 4, 4, 4, 2]
    assert len({extremes(change)[2:] for change in changes[:8]}) == 4
    draws = [change.replay.seed for change in changes if change.replay.friction_noise]
    assert len(set(draws)) == len(draws) == 8


@pytest.mark.parametrize("deadline", [None, 60.0])
def test_without_a_plan_that_stands_under_changes_one_with_the_reserve_comes_before_one_without(
    monkeypatch: pytest.MonkeyPatch, deadline: float | None
) -> None:
    """On contacts as slippery as ice none stands; the plan that is delivered says what it keeps."""
    ice = Change("ice", ratio=1e-9, hold_factor=1.0, press=0, replay=ReplaySettings())
    monkeypatch.setattr(varied_replay, "variations", lambda count: [ice])
    arch = load_structure("arch:blocks=5")
    planning = find_plans(arch, stability=CONTACT, deadline=deadline)
    assert planning.found
    assert not planning.accepted
    plan = planning.plans[0]
    assert plan.claim.reserve == 1.1
    assert plan.replay is not None
    assert not plan.replay.varied


def test_blocks_that_stand_alone_stand_under_every_change(scenes: Any) -> None:
    """A change that throws single blocks off would be one of the method, not of the site."""
    blocks = [scenes.box([2 * k, 0, 0], [2 * k + 1, 1, 1], f"block-{k}") for k in range(12)]
    row = scenes.make([*blocks, scenes.box([0, 0, -1], [24, 1, 0], "ground")], [12])
    plan = planned(row, 0, 1.1)
    cases = replay_varied(Replayer(row, CONTACT), plan.states, plan.presses_before)
    assert [case.name for case in cases if not case.good] == []

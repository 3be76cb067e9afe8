"""Replays of ensembles agree with replays under each of their settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from falsework import Assembly, Plan, PlannerSettings, StabilityOracle, StabilitySettings, find_plans, load_structure
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.varied_replay import GROUPS, EnsembleReplayer, changed, variations
from falsework.stability.holds import Press

CLOSE = 0.05
"""Share by which forces and displacements of a member, which is left sooner, may differ from those of its own replay.
"""
CONTACT = StabilitySettings(criterion="contact", reserve=1.1)


def planned(assembly: Assembly, seed: int, reserve: float) -> Plan:
    settings = PlannerSettings(seed=seed)
    return find_plans(assembly, stability=replace(CONTACT, reserve=reserve), settings=settings).plans[0]


def members(replayer: Replayer, plan: Plan) -> list[tuple[Replayer, list[Sequence[Press]]]]:
    """Return a replayer for each group of changes, and the presses that err as it says."""
    found = []
    for group in GROUPS:
        known = variations(replayer.settings, len(GROUPS), plan.presses_before)
        settings, numerics, presses = changed([c for c in group if c in known], replayer.settings, plan.presses_before)
        found.append((replayer.vary(settings, numerics), list(presses)))
    return found


@pytest.mark.parametrize("stiffness", [np.inf, 1e7])
def test_histories_are_those_of_single_replays(stiffness: float) -> None:
    """Also step by step, and where robots are springs."""
    assembly = load_structure("vault:parts=40")
    plan = planned(assembly, 0, 1.1)
    settings = replace(CONTACT, holds=replace(plan.claim.holds, stiffness=stiffness))
    ensemble = EnsembleReplayer(assembly, settings)
    whole = ensemble.replay(plan.states, presses=plan.presses_before)
    alone = [replayer.replay(plan.states, presses=presses) for replayer, presses in members(ensemble, plan)]
    assert whole.good == all(replay.good for replay in alone)
    for row, history in enumerate(whole.histories):
        for own, replay in zip(history.changed, alone, strict=True):
            other = replay.histories[row]
            for some, same in ((own.springs, other.springs), (own.displacement, other.displacement)):
                assert np.linalg.norm(some - same) <= CLOSE * np.linalg.norm(same)
    middle = len(whole.histories) // 2
    stands, after = ensemble.step(
        whole.histories[middle - 1], plan.states[middle - 1], plan.states[middle], plan.presses_before[middle]
    )
    assert stands
    for own, other in zip(after.changed, whole.histories[middle].changed, strict=True):
        np.testing.assert_array_equal(own.springs, other.springs)


def test_a_replay_ends_where_one_of_the_settings_fails() -> None:
    """With so little friction that a plan stands under its own settings alone."""
    structures = [load_structure(name) for name in ("vault", "vault:parts=40")]
    plans = [(assembly, planned(assembly, 1, 1.0)) for assembly in structures]
    for (assembly, plan), reserve in product(plans, np.arange(1.0, 2.0, 0.05).tolist()):
        plain = Replayer(assembly, replace(CONTACT, reserve=reserve))
        fails = [replayer.replay(plan.states, presses=given).falls_at for replayer, given in members(plain, plan)]
        first = min((row for row in fails if row is not None), default=None)
        if first is not None and plain.replay(plan.states, presses=plan.presses_before).good:
            break
    assert first is not None
    found = EnsembleReplayer(assembly, plain.settings).replay(plan.states, presses=plan.presses_before)
    assert found.falls_at == first
    assert len(found.histories) == len(found.presses) == first
    assert (found.stands[first + 1 :] == 0).all()


def test_a_history_of_one_setting_goes_on_under_it_alone() -> None:
    assembly = load_structure("arch:blocks=7")
    plan = planned(assembly, 0, 1.1)
    plain, ensemble = Replayer(assembly, CONTACT), EnsembleReplayer(assembly, CONTACT)
    history = plain.replay(plan.states[:5]).histories[-1]
    found = ensemble.replay(plan.states[4:], history)
    assert found.good
    assert not any(some.changed for some in found.histories)


def test_a_reserve_asks_for_an_ensemble() -> None:
    """So every default plan stands under changed settings, and says so."""
    assembly = load_structure("vault:parts=40")
    for reserve in (1.0, 1.1):
        replayer = StabilityOracle(assembly, replace(CONTACT, reserve=reserve)).replayer
        assert replayer is not None
        assert replayer.varies == (reserve > 1.0)
        replay = planned(assembly, 0, reserve).replay
        assert replay is not None
        assert replay.varied == (reserve > 1.0)

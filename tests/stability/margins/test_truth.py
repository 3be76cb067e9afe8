"""Replays of states just inside and just outside of their margins."""

from __future__ import annotations

import numpy as np
import pytest

from falsework import StabilityOracle, StabilitySettings, load_structure
from falsework.stability import HoldSettings
from falsework.stability.contact.replay import Replayer
from falsework.stability.margins.conditions import Condition

STRUCTURES = ("arch:blocks=5", "corbel", "catenary:blocks=5")
BESIDE = 0.02
RIGID = StabilitySettings(holds=HoldSettings(stiffness=np.inf, force=0.0))
"""Margins are those of a state in which held parts do not move, whatever they bear."""


@pytest.mark.parametrize("kind", ["friction", "horizontal", "push"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_replays_come_to_rest_inside_and_fall_outside(name: str, kind: str) -> None:
    """Parts are removed and held at random; the same answer must come of a replay in which loads grow slowly."""
    random = np.random.default_rng(sum(map(ord, name + kind)))
    assembly, looked_at = load_structure(name, friction=0.6), 0
    oracle = StabilityOracle(assembly)
    for _ in range(8):
        state = random.choice(3, assembly.part_count, p=(0.15, 0.75, 0.1)).astype(np.uint8)
        state[assembly.boundary] = 2
        (found,) = oracle.margins(state, (kind,))
        bound = getattr(found, kind)
        if not found.stands or bound.outside is None or not bound.monotone or not bound.proven:
            continue
        assert bound.inside_condition.friction == bound.outside_condition.friction or kind == "friction"
        for at, sign, rests in ((bound.inside_condition, -1, True), (bound.outside_condition, 1, False)):
            share = 1 + sign * BESIDE
            friction = at.friction / share if kind == "friction" else at.friction
            changed = Condition(friction, (1.0 if kind == "friction" else share) * at.extra).applied_to(assembly)
            assert (Replayer(changed, RIGID).replay(state[None]).stands[0] == 1) == rests, (state, bound.value)
        looked_at += 1
    assert looked_at or kind == "friction"

"""Verdicts, proofs and replays under loads, against closed forms and an independent judge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from settling import settle

from falsework import StabilityOracle, StabilitySettings, Verdict
from falsework.assembly import Loads, complete_state
from falsework.stability.contact.replay import Replayer


def verdict(assembly: Any, **settings: Any) -> int:
    """Verdict of the complete structure; the checker has accepted its proof."""
    return int(
        StabilityOracle(assembly, StabilitySettings(**settings))
        .verdicts(complete_state(assembly.boundary), require_certificate=True)
        .verdict[0]
    )


@pytest.mark.parametrize("settings", [{}, {"criterion": "equilibrium", "cone": "quadratic"}, {"solver": "exact"}])
def test_a_push_moves_a_block_past_mu_times_its_weight(scenes: Any, settings: dict[str, Any]) -> None:
    block = scenes.slope(0.0, friction=0.4)
    limit = 0.4 * 9.81 * block.mass.mass[0]
    if settings.get("solver") == "exact":
        settings = {"criterion": "equilibrium", "cone": "quadratic", "solver": "exact"}
    for share, stands in ((0.99, True), (1.01, False)):
        wrench = np.zeros((2, 6))
        wrench[0, :2] = share * limit * np.array([0.6, -0.8])
        loaded = block.replace(loads=Loads.from_arrays(2, wrench=wrench))
        assert (verdict(loaded, **settings) == Verdict.STABLE) == stands
        assert (settle(loaded, complete_state(loaded.boundary)).stands[0] == 1) == stands


def test_a_weight_past_the_edge_tips_a_block(scenes: Any) -> None:
    """A force `P` a distance `e` past the edge of a block of weight `W` and half width `b` tips it for `P e > W b`."""
    tower = scenes.tower(1)
    weight = 9.81 * tower.mass.mass[0]
    for share, stands in ((0.98, True), (1.02, False)):
        wrench = np.zeros((2, 6))
        force = share * weight * 0.5 / 0.25  # a quarter of a metre past the edge
        wrench[0, 2], wrench[0, 4] = -force, 0.75 * force
        loaded = tower.replace(loads=Loads.from_arrays(2, wrench=wrench))
        assert (verdict(loaded) == Verdict.STABLE) == stands


def test_a_load_acts_only_while_its_part_is_there(scenes: Any) -> None:
    tower = scenes.tower(2)
    wrench = np.zeros((3, 6))
    wrench[1, 0] = 9.81 * tower.mass.mass[1]
    loaded = tower.replace(loads=Loads.from_arrays(3, wrench=wrench), friction=0.4)
    oracle = StabilityOracle(loaded)
    assert oracle.verdicts([[1, 1, 2], [1, 0, 2], [1, 2, 2]], require_certificate=True).verdict.tolist()[1:] == [1, 1]
    assert oracle.verdicts([[1, 1, 2]], require_certificate=True).verdict[0] != Verdict.STABLE


def test_a_replay_takes_loads_up_when_a_robot_lets_go(scenes: Any) -> None:
    block = scenes.slope(0.0, friction=0.4)
    states = np.array([[0, 2], [2, 2], [1, 2]], np.uint8)
    for earthquake, falls_at in ((0.39, None), (0.41, 2)):
        shaken = block.replace(loads=Loads.from_arrays(2, acceleration=[earthquake, 0, 0]))
        assert Replayer(shaken).replay(states).falls_at == falls_at

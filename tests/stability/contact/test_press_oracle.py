"""Verdicts on single states in which robots press."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict
from falsework.errors import InputError
from falsework.stability import HoldSettings, PressOracle, Proof
from falsework.stability.holds import HoldMode, inexact_presses
from falsework.stability.settings import EQUILIBRIUM

PLATES = 3


def beside_wall(scenes: Any, friction: float = 0.5) -> Assembly:
    """Three plates side by side at a wall, with nothing below them."""
    plates = [scenes.box([0.2 * k, 0, 0], [0.2 * k + 0.2, 1, 1], f"plate-{k}") for k in range(PLATES)]
    return scenes.make([*plates, scenes.box([-1, -1, -1], [0, 2, 2], "wall")], [PLATES], friction=friction)


STATES = np.array([[1, 2, 0, 2], [1, 1, 2, 2], [2, 2, 0, 2], [1, 0, 0, 2], [1, 1, 1, 2]], np.uint8)
"""One plate and two plates pressed against the wall, two held, and some that nothing holds."""


@pytest.mark.parametrize("mode", [HoldMode.FORCE, HoldMode.HYBRID])
def test_a_state_stands_if_its_robot_can_press(scenes: Any, mode: HoldMode) -> None:
    assembly = beside_wall(scenes)
    plain = StabilityOracle(assembly, StabilitySettings(holds=HoldSettings(mode=mode)))
    pressing = PressOracle(plain)
    assert [Verdict(v).name for v in plain.verdicts(STATES).verdict] == [
        "SLIDES",
        "SLIDES",
        "STABLE",
        "UNSTABLE",
        "UNSTABLE",
    ]
    verdicts = pressing.verdicts(STATES)
    assert verdicts.stable.tolist() == [True, True, True, False, False]
    assert (verdicts.proof[:2] == Proof.HISTORY).all()
    for state, count in zip(STATES[:2], (1, 2), strict=True):
        presses = pressing.presses(state)
        assert presses is not None
        (press,) = presses
        weight = 9.81 * assembly.mass.mass[0]
        assert state[press.part] == 2
        assert -press.wrench[0] > count * weight  # half of a plate hangs on the wall, half on the robot
        assert len(inexact_presses(presses)) == 4
    assert pressing.presses(STATES[3]) is None


@pytest.mark.parametrize("weights", [1.5, 10.0])
def test_a_weak_robot_does_not_hold_them(scenes: Any, weights: float) -> None:
    assembly = beside_wall(scenes)
    force = weights * 9.81 * float(assembly.mass.mass[0])
    pressing = PressOracle(StabilityOracle(assembly, StabilitySettings(holds=HoldSettings(force=force))))
    assert pressing.verdicts(STATES[:1]).stable.tolist() == [weights > 2]


def test_without_presses_there_is_no_such_oracle(scenes: Any) -> None:
    assembly = beside_wall(scenes)
    with pytest.raises(InputError, match="under the criterion contact alone"):
        PressOracle(StabilityOracle(assembly, EQUILIBRIUM))
    for holds in (HoldSettings(mode=HoldMode.LOCKED), HoldSettings(force=0.0)):
        with pytest.raises(InputError, match="never press"):
            PressOracle(StabilityOracle(assembly, StabilitySettings(holds=holds)))

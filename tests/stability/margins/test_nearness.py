"""Utilisation of parts against slipping and tipping in closed-form cases."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework import StabilityOracle, StabilitySettings
from falsework.assembly import complete_state
from falsework.stability.margins.nearness import nearness_to_limit


def nearness(assembly: Any) -> np.ndarray:
    state = complete_state(assembly.boundary)
    verdicts = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium", cone="quadratic")).verdicts(
        state, require_certificate=True
    )
    assert verdicts.stable[0]
    assert verdicts.forces is not None
    return nearness_to_limit(assembly, state, verdicts.forces[0])


@pytest.mark.parametrize("slope", [0.1, 0.3])
def test_a_block_on_a_slope_uses_its_share_of_friction(scenes: Any, slope: float) -> None:
    shares = nearness(scenes.slope(slope, friction=0.5))
    assert shares[0] == pytest.approx(np.tan(slope) / 0.5, rel=1e-3)
    assert np.isnan(shares[1])


@pytest.mark.parametrize("out", [0.2, 0.45])
def test_a_block_near_an_edge_is_near_tipping(scenes: Any, out: float) -> None:
    """Its weight acts at the middle of the block; the joint below reaches from the edge of the lower block inwards."""
    cube, upper = scenes.box([0, 0, 0], [1, 1, 1], "cube"), scenes.box([out, 0, 1], [1 + out, 1, 2], "upper")
    assembly = scenes.make([upper, cube], [1], friction=0.5)
    half = (1 - out) / 2  # of the joint, whose middle is half of the overhang from that of the block
    assert nearness(assembly)[0] == pytest.approx((out / 2) / half, rel=1e-2)


def test_it_does_not_depend_on_the_tangents_of_a_curved_contact(scenes: Any) -> None:
    """Each of its points has a frame of its own, whose tangents may lie anywhere."""
    assembly, state = scenes.slope(0.3, friction=0.5), np.array([1, 2], np.uint8)
    settings = StabilitySettings(criterion="equilibrium", cone="quadratic")
    verdicts = StabilityOracle(assembly, settings).verdicts(state, require_certificate=True)
    assert verdicts.forces is not None
    forces, contacts = verdicts.forces[0], assembly.contacts
    turn = np.array([scenes.about_z(angle)[:2, :2] for angle in range(len(forces))])
    frames = contacts.point_frames.copy()
    frames[:, 1:] = turn @ frames[:, 1:]
    other = replace(assembly, contacts=replace(contacts, curved=frames))
    turned = np.column_stack([forces[:, 0], (turn @ forces[:, 1:, None])[:, :, 0]])
    np.testing.assert_allclose(nearness_to_limit(other, state, turned), nearness_to_limit(assembly, state, forces))

"""Arches: closed forms, and the oldest theorem about them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from falsework.assembly.library import arch, catenary


@pytest.mark.parametrize("blocks", [3, 8, 15])
def test_arch_volume_and_contacts(blocks: int, touching) -> None:
    assembly = arch(blocks, radius=2.0, thickness=0.3, depth=0.7)
    free = ~assembly.boundary
    # A voussoir is a trapezoid: the difference of two isosceles triangles of angle pi / blocks.
    expected = 0.5 * math.sin(math.pi / blocks) * (2.15**2 - 1.85**2) * 0.7
    np.testing.assert_allclose(assembly.mass.volume[free], expected, rtol=1e-12)
    chain = {(k, k + 1) for k in range(blocks - 1)} | {(0, blocks), (blocks - 1, blocks + 1)}
    assert touching(assembly) == chain
    np.testing.assert_allclose(assembly.contacts.areas, 0.3 * 0.7, rtol=1e-6)
    radial = assembly.mass.center[free][:, [0, 2]]
    np.testing.assert_allclose(np.ptp(np.linalg.norm(radial, axis=1)), 0.0, atol=1e-12)


@pytest.mark.parametrize(("thickness", "answer"), [(0.1065, False), (0.1085, True)])
def test_semicircle_needs_a_tenth_of_its_radius(thickness: float, answer: bool, stands) -> None:
    """Milankovitch 1907: 0.1075 of the radius, for fine voussoirs and friction that prevents sliding."""
    assert stands(arch(blocks=100, thickness=thickness), None) is answer


def test_semicircle_does_not_stand_without_friction(stands) -> None:
    assert not stands(arch().replace(friction=0.0))


def test_half_an_arch_falls_unless_held(stands) -> None:
    assembly = arch(blocks=9)
    state = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0, 2, 2])
    assert not stands(assembly, state)
    state[3] = 2
    assert stands(assembly, state)


def test_catenary_length_and_height() -> None:
    # z = 1 - (cosh x - 1) has its ends at x = +-1 if the rise is cosh 1 - 1; its length is 2 sinh 1.
    assembly = catenary(blocks=400, span=2.0, rise=math.cosh(1.0) - 1.0, thickness=0.05, depth=0.5)
    free = ~assembly.boundary
    assert assembly.mass.volume[free].sum() == pytest.approx(2 * math.sinh(1.0) * 0.05 * 0.5, rel=1e-4)
    assert np.ptp(assembly.mass.volume[free]) < 1e-3 * assembly.mass.volume[0]
    x, z = assembly.mass.center[free][:, [0, 2]].T
    height = z - z.max() + (math.cosh(1.0) - 1.0)
    np.testing.assert_allclose(height, math.cosh(1.0) - np.cosh(x), atol=1e-4)


@pytest.mark.parametrize("blocks", [5, 40])
def test_catenary_stands_where_a_semicircle_falls(blocks: int, stands, touching) -> None:
    thin = catenary(blocks, span=2.0, rise=1.0, thickness=0.01)
    assert stands(thin)
    assert len(touching(thin)) == len(thin.contacts) == blocks + 1
    assert not stands(arch(blocks=40, radius=1.0, thickness=0.01))

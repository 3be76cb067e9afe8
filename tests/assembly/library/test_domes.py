"""Hemispherical dome: closed forms, and what ties its foot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from falsework.assembly.library import dome


def faceted_hemisphere(rings: int, blocks: int) -> float:
    """Volume within the unit hemisphere whose parallels are polygons of `2 blocks` corners, up to the key's plane."""
    corners = 2 * blocks
    angle = np.linspace(0, math.pi / 2, rings + 2)[:-1]
    area = corners / 2 * math.sin(2 * math.pi / corners) * np.cos(angle) ** 2
    lower, upper = area[:-1], area[1:]
    return float((np.diff(np.sin(angle)) / 3 * (lower + upper + np.sqrt(lower * upper))).sum())


@pytest.mark.parametrize(("rings", "blocks"), [(1, 3), (4, 8), (6, 5)])
@pytest.mark.parametrize("stagger", [0, 1])
def test_volume_and_contacts(rings: int, blocks: int, stagger: int, touching) -> None:
    assembly = dome(rings, blocks, radius=1.0, thickness=0.2, stagger=stagger)
    free = ~assembly.boundary
    assert assembly.part_count == rings * blocks + 2
    # All joints are radial, so the solid between two similar surfaces is the difference of their cones.
    expected = (1.1**3 - 0.9**3) * faceted_hemisphere(rings, blocks)
    assert assembly.mass.volume[free].sum() == pytest.approx(expected, rel=1e-12)

    beds = 2 * blocks if stagger else blocks
    assert len(touching(assembly)) == rings * blocks + (rings - 1) * beds + 2 * blocks
    # A bed joint consists of facets of the polygon; only the ground is flat all round.
    assert len(assembly.contacts) == rings * blocks + (rings - 1) * 2 * blocks + 2 * blocks + blocks


def test_thickness_that_needs_no_tie(stands) -> None:
    """Heyman 1967: above 0.042 of the radius a hemisphere stands though cut along its meridians."""
    assert stands(dome(rings=8, blocks=12, thickness=0.05, stagger=0))


def test_thin_dome_needs_staggered_joints(stands) -> None:
    assert not stands(dome(rings=10, blocks=20, thickness=0.01, stagger=0))
    assert stands(dome(rings=10, blocks=20, thickness=0.01, stagger=1))


def test_ring_by_ring_without_centring(stands) -> None:
    """A dome needs no centring between rings: it stands whenever its uppermost ring is complete."""
    assembly = dome(rings=5, blocks=8)
    for rings in range(1, 6):
        state = np.where(np.arange(assembly.part_count) < 8 * rings, 1, 0)
        state[-1] = 2
        assert stands(assembly, state), rings

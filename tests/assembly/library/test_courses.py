"""Wall, stack and corbelled arch: counts by formula, overhangs by the theorems."""

from __future__ import annotations

import math

import numpy as np
import pytest

from falsework.assembly.library import corbel, stack, wall


@pytest.mark.parametrize(("bricks", "courses"), [(1, 1), (1, 4), (5, 6), (3, 7)])
def test_wall_counts(bricks: int, courses: int, touching, stands) -> None:
    assembly = wall(bricks, courses, length=0.3, height=0.1, depth=0.15)
    odd = courses // 2
    even = courses - odd
    assert assembly.part_count == even * bricks + odd * (bricks + 1) + 1
    head_joints = even * (bricks - 1) + odd * bricks
    bed_joints = bricks + (courses - 1) * 2 * bricks
    assert len(touching(assembly)) == len(assembly.contacts) == head_joints + bed_joints
    assert assembly.mass.volume[:-1].sum() == pytest.approx(bricks * 0.3 * courses * 0.1 * 0.15, rel=1e-12)
    assert stands(assembly)


@pytest.mark.parametrize("blocks", [1, 2, 5, 12])
def test_stack_reaches_the_harmonic_sum_and_no_further(blocks: int, stands) -> None:
    harmonic = sum(1 / k for k in range(1, blocks + 1))
    for share, answer in ((0.995, True), (1.005, False)):
        assembly = stack(blocks, overhang=share, length=0.8)
        reach = max(mesh.bounds[1, 0] for mesh in assembly.meshes)
        assert reach == pytest.approx(share * 0.4 * harmonic, rel=1e-12)
        assert stands(assembly) is answer
        assert len(assembly.contacts) == blocks
    assert assembly.mass.volume[:-1].sum() == pytest.approx(blocks * 0.8 * 0.12 * 0.3)


@pytest.mark.parametrize("courses", [2, 3, 6])
def test_half_a_corbelled_arch(courses: int, touching, stands) -> None:
    length = 0.7
    for share, answer in ((0.99, True), (1.01, False)):
        step = share * length / courses
        assembly = corbel(courses, span=2 * (courses - 1) * step, length=length)
        left = np.array([mesh.bounds[1, 0] <= 1e-9 for mesh in assembly.meshes])
        assert left.sum() == courses
        state = np.where(left, 1, 0)
        state[-1] = 2
        assert stands(assembly, state) is answer
    assert len(touching(assembly)) == len(assembly.contacts) == 2 * courses + 1
    assert assembly.mass.volume[:-1].sum() == pytest.approx(2 * courses * length * 0.15 * 0.4)


def test_corbelled_arch_closes_at_the_crown() -> None:
    assembly = corbel(courses=5, span=1.3)
    crown = assembly.contacts.points[np.abs(assembly.contacts.points[:, 0]) < 1e-9]
    assert len(crown) == 4
    ground = [mesh.bounds for mesh in assembly.meshes[:2]]
    assert math.isclose(ground[1][0, 0] - ground[0][1, 0], 1.3)

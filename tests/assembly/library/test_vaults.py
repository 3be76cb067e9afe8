"""The vault: its form is in equilibrium, its blocks fit, it stands at every size, and two robots can build it."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle
from falsework.assembly import library
from falsework.assembly.library.funicular import find_form
from falsework.assembly.library.vaults import Grid, nearest_grid
from falsework.stability.settings import EQUILIBRIUM

SUPPORT = 0.7 / 4.0


@cache
def vault(parts: int = 60, **shape: float) -> Assembly:
    """Build once what several tests look at."""
    return library.vault(parts, **shape)


@pytest.mark.parametrize("rise", [0.1, 1.0, 2.0])
def test_form_is_in_equilibrium(rise: float) -> None:
    """The thrust round every circle about the axis carries the weight of all that lies within."""
    form = find_form(rim=2.0, rise=rise)
    assert form.height[0] == pytest.approx(rise)
    assert form.height[-1] == pytest.approx(0.0, abs=1e-12)
    r, slope = form.radius, form.slope
    area_rate = 2 * np.pi * r * np.hypot(1.0, slope)
    weight = np.concatenate([[0.0], np.cumsum((area_rate[1:] + area_rate[:-1]) / 2 * np.diff(r))])
    ratio = weight[200:] / (-slope[200:] * 2 * np.pi * r[200:])  # thrust over weight per area, one number
    np.testing.assert_allclose(ratio, ratio[-1], rtol=1e-5)
    assert (np.diff(slope) < 0).all()  # concave
    np.testing.assert_allclose(np.gradient(form.height, r)[1:-1], slope[1:-1], atol=2e-3)


def test_flat_form_is_a_paraboloid() -> None:
    form = find_form(rim=3.0, rise=0.01)
    np.testing.assert_allclose(form.height, 0.01 * (1 - (form.radius / 3.0) ** 2), atol=1e-7)


def test_number_of_parts_is_near_what_was_asked() -> None:
    for parts in [*range(30, 100), *range(100, 1001, 25)]:
        found = nearest_grid(parts, SUPPORT).part_count(SUPPORT)
        assert abs(found / parts - 1.0) <= 0.08, parts
    for parts in (30, 60, 125, 250):
        assembly = vault(parts)
        assert assembly.part_count == nearest_grid(parts, SUPPORT).part_count(SUPPORT)
        assert assembly.boundary.sum() == 4


def lattice_pairs(grid: Grid) -> set[tuple[int, int]]:
    """Neighbours in running bond, by counting alone."""
    lengths = [grid.length - course % 2 for course in range(grid.courses)]
    first = np.concatenate([[0], np.cumsum(lengths)])
    pairs = set()
    for course, length in enumerate(lengths):
        pairs |= {(first[course] + k, first[course] + k + 1) for k in range(length - 1)}
        for beside in (course - 1, course + 1):
            if course % 2 and 0 <= beside < grid.courses:  # a cell of a short course lies on two of a long one
                for k, shift in itertools.product(range(length), (0, 1)):
                    a, b = first[course] + k, first[beside] + k + shift
                    pairs.add((min(a, b), max(a, b)))
    return {(int(a), int(b)) for a, b in pairs}


@pytest.mark.parametrize("parts", [30, 60, 250])
def test_who_touches_whom(parts: int, touching) -> None:
    grid = nearest_grid(parts, SUPPORT)
    corner = grid.corners(SUPPORT)
    free = np.cumsum(corner < 0) - 1
    number = np.where(corner < 0, free, free[-1] + 1 + corner)
    expected = {
        (int(min(p)), int(max(p))) for a, b in lattice_pairs(grid) if len(set(p := (number[a], number[b]))) == 2
    }
    assert touching(vault(parts)) == expected


@pytest.mark.parametrize("parts", [30, 250])
def test_volume_is_area_times_thickness(parts: int) -> None:
    assembly = vault(parts, span=4.0, rise=1.0, thickness=0.1)
    form = find_form(2.0 * math.sqrt(2.0), 1.0)
    x = (np.arange(400) + 0.5) / 100 - 2.0
    slope = np.interp(np.hypot(*np.meshgrid(x, x)), form.radius, form.slope)
    area = np.hypot(1.0, slope).mean() * 16.0
    assert assembly.mass.volume.sum() == pytest.approx(0.1 * area, rel=0.3 / math.sqrt(parts))


def outer_normals(assembly: Assembly) -> NDArray[np.float64]:
    """Normal of the outer face of each block: the face that looks up most."""
    normals = []
    for mesh in assembly.meshes:
        cross = np.cross(mesh.triangles[:, 1] - mesh.triangles[:, 0], mesh.triangles[:, 2] - mesh.triangles[:, 0])
        cross /= np.linalg.norm(cross, axis=1, keepdims=True)
        normals.append(cross[cross[:, 2].argmax()])
    return np.array(normals)


@pytest.mark.parametrize("spec", [{}, {"parts": 250}, {"parts": 40, "rise": 2.0, "thickness": 0.3}])
def test_joints_are_flat_halve_the_angle_and_let_blocks_out(spec: dict) -> None:
    assembly = vault(**spec)
    up = outer_normals(assembly)
    contacts = assembly.contacts
    for contact, (a, b) in enumerate(contacts.parts):
        if assembly.boundary[[a, b]].any():
            continue
        normal = contacts.normals[contact]
        points = contacts.points[contacts.start[contact] : contacts.start[contact + 1]]
        assert abs(normal @ (up[a] + up[b])) < 1e-6
        level = points.mean(axis=0) @ normal
        np.testing.assert_allclose(points @ normal, level, atol=1e-9)
        assert (assembly.meshes[a].vertices @ normal <= level + 1e-9).all()
        assert (assembly.meshes[b].vertices @ normal >= level - 1e-9).all()
        assert normal @ up[a] < 0 < normal @ up[b]  # so each block leaves along its own outward normal


def test_outer_faces_are_a_thickness_apart() -> None:
    assembly = vault(thickness=0.2)
    for mesh, normal in zip(assembly.meshes[:-4], outer_normals(assembly)[:-4], strict=True):
        assert np.ptp(mesh.vertices @ normal) == pytest.approx(0.2, abs=1e-9)


@pytest.mark.parametrize("parts", [30, 60, 250, 1000])
def test_stands_at_every_size(parts: int, stands) -> None:
    assembly = vault(parts)
    assert stands(assembly)
    # A quarter of the friction is margin for equilibrium; without prestress some of these slide.
    assert stands(assembly.replace(friction=0.42), settings=EQUILIBRIUM)
    assert not stands(assembly.replace(friction=0.1))


def test_a_hundredth_of_the_span_is_thick_enough(stands) -> None:
    assert stands(vault(parts=100, thickness=0.04))


def test_falls_when_one_edge_is_missing(stands) -> None:
    """Free edges are arches between springers; without one of their blocks the edge has nothing to thrust against."""
    assembly = vault()
    middle = int(np.argmin(np.abs(assembly.mass.center[:, 0]) + 10 * assembly.mass.center[:, 1]))
    state = np.where(assembly.boundary, 2, 1)
    state[middle] = 0
    assert not stands(assembly, state)


def rings_of_chains(grid: Grid) -> list[list[list[int]]]:
    """Blocks by rings from the free edges inwards; each ring as the rows and columns that make its sides."""
    sites = grid.sites[grid.corners(SUPPORT) < 0]
    across = (0.5 - np.abs(sites)) * [grid.length, grid.courses] + 0.01
    ring = np.floor(across.min(axis=1)).astype(int)
    level = np.floor(across[:, 1]) == ring
    side = np.where(level, sites[:, 1] < 0, 2 + (sites[:, 0] < 0))
    along = np.where(level, sites[:, 0], sites[:, 1])
    return [
        [
            sorted(np.flatnonzero((ring == r) & (side == s)).tolist(), key=lambda block: along[block])
            for s in np.unique(side[ring == r])
        ]
        for r in range(ring.max() + 1)
    ]


@pytest.mark.parametrize("parts", [30, 60, 125])
def test_two_robots_can_build_it(parts: int) -> None:
    """One robot holds the tip of a row, the other adds the next block, from the free edges to the crown."""
    assembly = vault(parts)
    stability = StabilityOracle(assembly, EQUILIBRIUM)
    state = np.where(assembly.boundary, 2, 0).astype(np.uint8)

    def built(chain: list[int]) -> NDArray[np.uint8]:
        states = np.repeat(state[None], len(chain) + 1, axis=0)
        for step, block in enumerate(chain):
            states[step, block] = 2
            states[step + 1 :, block] = 1
        return states

    for chains in rings_of_chains(nearest_grid(parts, SUPPORT)):
        left = chains
        while left:
            for chain in left:
                ways = [built(way) for way in (chain, chain[::-1])]
                states = next((states for states in ways if stability.verdicts(states).stable.all()), None)
                if states is not None:
                    state = states[-1]
                    left = [other for other in left if other is not chain]
                    break
            else:
                pytest.fail("no row of this ring can be built")
    assert (state[~assembly.boundary] == 1).all()

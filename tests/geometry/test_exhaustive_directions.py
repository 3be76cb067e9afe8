"""Proofs that no way out is missing: closed forms, and agreement with sweeps along random directions."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from falsework.geometry import ContactSettings, find_contacts, load_meshes
from falsework.geometry.clearance.cover import Triangles
from falsework.geometry.clearance.directions import exit_directions
from falsework.geometry.clearance.exhaustive_directions import all_exits
from falsework.geometry.clearance.sweep import Sweeper
from falsework.geometry.clearance.table import StraightWays
from falsework.utils.bits import unpack

TOLERANCE = 1e-4


def table_of(meshes, directions=1000):
    return StraightWays(meshes, find_contacts(meshes), directions, tolerance=TOLERANCE).table


def slot(shapes):
    """A slider with a T-shaped section in a rail that grips it, and a stop at either end of the rail."""
    half = [(3, -3), (3, 3), (1.01, 3), (1.01, 1), (2, 1), (2, -2)]
    rail = [*half, *((-x, y) for x, y in reversed(half))]
    slider = [(-1.9, -1.9), (1.9, -1.9), (1.9, 0.9), (1, 0.9), (1, 4), (-1, 4), (-1, 0.9), (-1.9, 0.9)]
    turn = shapes.rotation(5)
    meshes = [
        shapes.extruded(slider, 0.3, 2.7, "slider"),
        shapes.extruded(rail, 0.0, 3.0, "rail"),
        shapes.box((-3, -3, 3), (3, 5, 4), "top"),
        shapes.box((-3, -3, -1), (3, 5, 0), "bottom"),
    ]
    return [shapes.moved(mesh, (2, 1, 0), turn) for mesh in meshes], turn


def test_a_slider_leaves_along_its_rail_alone(shapes):
    """Nothing touches the slider, so no contact says which direction is the right one."""
    meshes, turn = slot(shapes)
    table = table_of(meshes)
    states = np.array([(1, 1, *stops) for stops in itertools.product((0, 1), repeat=2)], dtype=np.uint8)
    assert table.exact[0]
    assert table.can_leave(states)[:, 0].tolist() == [True, True, True, False]
    way = table.exit_direction(states[1], 0)
    assert way is not None
    assert way @ turn[:, 2] > np.cos(np.radians(3)), "out at the end that is open"
    assert table.exit_direction(np.array([1, 0, 1, 1], np.uint8), 0) is not None


def test_a_block_in_a_box_that_it_does_not_touch_is_locked_in(shapes):
    core = shapes.box((0.05, 0.07, 0.06), (0.95, 0.97, 0.93), "core")
    walls = []
    for axis, side in itertools.product(range(3), (0, 1)):
        low, high = -np.ones(3), 2 * np.ones(3)
        low[axis], high[axis] = (1, 2) if side else (-1, 0)
        low[:axis], high[:axis] = 0, 1
        walls.append(shapes.box(low, high))
    table = table_of([core, *walls])
    states = np.array([(1, *present) for present in itertools.product((0, 1), repeat=6)], dtype=np.uint8)
    assert (table.can_leave(states)[:, 0] == (states[:, 1:] == 0).any(axis=1)).all()
    assert table.exact.all()
    assert table.caveat(np.ones(7, bool)) == ""


@pytest.mark.parametrize("name", ["dog-35", "cube-17"])
def test_no_direction_beats_the_ways_of_an_exact_part(shared_assembly, name):
    """Sweeps along other directions, some a hair beside a way, never find fewer blockers than a way has."""
    meshes = load_meshes(shared_assembly(name))
    contacts = find_contacts(meshes)
    _, overlap = ContactSettings().lengths(meshes)
    table = StraightWays(meshes, contacts, tolerance=overlap).table
    assert table.exact.all()
    sweeper = Sweeper(meshes, contacts, overlap)
    random = np.random.default_rng(4)
    for part in range(len(meshes)):
        ways = slice(table.start[part], table.start[part + 1])
        rows = unpack(table.blockers[ways])[:, : len(meshes)].astype(bool)
        near = np.repeat(table.directions[ways], 5, axis=0)
        near = near + random.standard_normal(near.shape) * 10.0 ** random.uniform(-4, -1, (len(near), 1))
        directions = np.concatenate([near, random.standard_normal((30, 3))])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        blocked = sweeper.blocked(part, directions)
        fine = np.asarray((~(rows[None] & ~blocked[:, None])).all(axis=2))
        assert fine.any(axis=1).all()


def test_cones_of_convex_parts_are_what_sweeping_finds(shapes):
    """Both ways round: a convex part is blocked in the cone over the Minkowski difference and nowhere else."""
    meshes = [
        shapes.moved(shapes.box((-1, -1, -1), (1, 0.5, 2)), rotation=shapes.rotation(0)),
        shapes.moved(shapes.peg(7, 1.0, 2.0), (4, 1, -1), shapes.rotation(1)),
        shapes.moved(shapes.box((0, 0, 0), (1, 2, 1)), (-1, 4, 2), shapes.rotation(2)),
    ]
    sweeper = Sweeper(meshes, find_contacts(meshes), TOLERANCE)
    directions = np.random.default_rng(5).standard_normal((3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for part, other in itertools.permutations(range(3), 2):
        cones = sweeper.cones(part, np.array([other]))
        assert len(cones) == 1
        assert (cones.part == other).all()
        inside = (directions @ cones.facets.T > cones.offset).all(axis=1)
        clear_of_edges = np.abs(directions @ cones.facets.T).min(axis=1) > 1e-6
        blocked = sweeper.blocked(part, directions)[:, other]
        assert (inside == blocked)[clear_of_edges].all()
        assert 20 < inside.sum() < 2000


def test_cones_of_faces_are_never_too_large(shapes):
    """A part that is not convex is covered by cones of its faces; they claim no direction that is free."""
    ring, peg = shapes.drilled(12, 0.5, 1.0, 0.4), shapes.peg(6, 0.2, 0.3, 0.3)
    meshes = [ring, shapes.moved(peg, (0.05, 0.0, 0.05))]
    sweeper = Sweeper(meshes, find_contacts(meshes), TOLERANCE)
    cones = sweeper.cones(1, np.array([0]))
    assert len(cones) > len(ring.faces) / 2
    directions = np.random.default_rng(6).standard_normal((2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    inside = np.logical_and.reduceat(directions @ cones.facets.T > cones.offset, cones.start[:-1], axis=1).any(axis=1)
    blocked = sweeper.blocked(1, directions)[:, 0]
    assert blocked[inside].all()
    assert np.asarray(inside)[blocked].mean() > 0.995, "the cones of the peg, one piece, say it all"
    assert 500 < inside.sum() < 1900


def test_quarters_of_triangles_make_up_the_whole():
    """The solid angles of the sphere and of all its pieces add up to that of the sphere."""

    def solid_angle(triangles):
        a, b, c = triangles.corners.transpose(1, 0, 2)
        above = np.abs(np.einsum("ti,ti->t", a, np.cross(b, c)))
        below = 1 + np.einsum("ti,ti->t", a, b) + np.einsum("ti,ti->t", b, c) + np.einsum("ti,ti->t", c, a)
        return 2 * np.arctan2(above, below).sum()

    triangles = Triangles.sphere()
    for _ in range(3):
        assert solid_angle(triangles) == pytest.approx(4 * np.pi, rel=1e-12)
        triangles = triangles.quartered()


def test_gives_up_on_a_part_among_very_many(shapes):
    meshes = [shapes.box((0.05, 0.07, 0.06), (3.95, 3.97, 3.93), "core")]
    for axis, side in itertools.product(range(3), (0, 1)):
        for row, column in itertools.product(range(4), repeat=2):
            low = np.insert([float(row), float(column)], axis, 4.0 if side else -1.0)
            meshes.append(shapes.box(low, low + 1.0))
    contacts = find_contacts(meshes)
    sweeper = Sweeper(meshes, contacts, TOLERANCE)
    sampled = sweeper.least_blocked(0, exit_directions(contacts, 0, 200))
    exits, complete = all_exits(sweeper, 0, sampled)
    assert not complete
    assert exits is sampled


def test_says_for_which_parts_ways_may_be_missing(shapes):
    table = replace(table_of(slot(shapes)[0], 500), exact=np.array([False, False, True, True]))
    assert table.caveat(np.array([False, False, True, True])) == ""
    assert "500 directions" in table.caveat(np.ones(4, bool))

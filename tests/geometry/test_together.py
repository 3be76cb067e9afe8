"""Sets of parts that leave together: which are candidates, and what blocks them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from falsework.errors import InputError
from falsework.geometry import TriangleMesh, find_contacts
from falsework.geometry.clearance import locked
from falsework.geometry.clearance.directions import sphere_directions
from falsework.geometry.clearance.locked import LockedSets
from falsework.geometry.clearance.part_sets import SetClearance
from falsework.geometry.clearance.relative_motions import can_begin_to_move
from falsework.geometry.clearance.sweep import Sweeper
from falsework.geometry.clearance.table import StraightWays

TOLERANCE = 1e-4


def clearance_of(meshes) -> SetClearance:
    contacts = find_contacts(meshes)
    singles = StraightWays(meshes, contacts, tolerance=TOLERANCE)
    return SetClearance(meshes, contacts, singles, TOLERANCE)


def locked_sets(meshes) -> LockedSets:
    contacts = find_contacts(meshes)
    normals = LockedSets.directions(contacts.normals)
    return LockedSets(*Sweeper(meshes, contacts, TOLERANCE).spans(normals), normals)


def clasp(shapes):
    """Two combs that interlock along x and y, between a lid and a floor: they leave along z only, or together."""
    one = [(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 2), (2, 2), (2, 3), (0, 3)]
    other = [(1, 1), (3, 1), (3, 3), (4, 3), (4, 4), (0, 4), (0, 3), (2, 3), (2, 2), (1, 2)]
    return [
        shapes.extruded(one, 0, 1, "one"),
        shapes.extruded(other, 0, 1, "other"),
        shapes.box((-1, -1, 1), (5, 5, 2), "lid"),
        shapes.box((-1, -1, -1), (5, 5, 0), "floor"),
    ]


def test_parts_that_hook_each_other_between_two_walls_leave_together(shapes):
    """Without the lid either leaves along z alone; with it neither does, but both together slide out sideways."""
    meshes = clasp(shapes)
    clearance, pair = clearance_of(meshes), (0, 1)
    movable = np.array([True, True, False, False])
    assert clearance.sets(movable, 2) == (pair,)
    closed, open_ = np.array([[1, 1, 1, 1]], np.uint8), np.array([[1, 1, 0, 1]], np.uint8)
    assert not clearance.singles.can_leave(closed)[0, :2].any()
    assert clearance.leave_together(pair, closed).all()
    motion = clearance.exit_motion(pair, closed[0])
    assert motion is not None
    np.testing.assert_allclose(motion[0], motion[1])
    assert abs(motion[0, 2]) < np.sin(np.radians(3))
    assert not clearance.leave_together(pair, open_).any(), "one of them goes first"
    assert clearance.exit_motion(pair, open_[0]) is not None, "both could"
    assert clearance.caveat((pair,)) == ""
    absent = np.array([[0, 0, 1, 1]], np.uint8)
    assert clearance.leave_together(pair, absent).all(), "what matters is the place, not whether the set is there"


def test_a_set_is_blocked_by_what_blocks_one_of_its_parts(shapes):
    meshes = clasp(shapes)
    sweeper = Sweeper(meshes, find_contacts(meshes), TOLERANCE)
    ways = sphere_directions(200)
    alone = [sweeper.blocked(part, ways) for part in (0, 1)]
    together = sweeper.blocked((0, 1), ways)
    np.testing.assert_array_equal(together[:, 2:], (alone[0] | alone[1])[:, 2:])
    assert not together[:, :2].any()
    assert (sweeper.blocked((1,), ways) == alone[1]).all()


def test_parts_with_a_plane_between_them_never_lock(shapes):
    """Blocks of a wall can be split by planes, however many there are."""
    meshes = [shapes.box((x, 0, z), (x + 1, 1, z + 1)) for x, z in itertools.product(range(3), range(2))]
    sets = locked_sets(meshes)
    assert sets.find(np.arange(6), 4) == ()


def test_three_cells_around_an_edge_do_not_block_each_other_in_turn(shapes):
    """No plane splits them, but their normals add up to zero, so along no direction does each run into the next."""
    corners = [(np.cos(a), np.sin(a)) for a in np.radians([30, 90, 150, 210, 270, 330])]
    meshes = [shapes.extruded([(0, 0), *(corners[(2 * k + i) % 6] for i in (0, 1, 2))], 0, 1) for k in range(3)]
    sets = locked_sets(meshes)
    joined, _ = sets.neighbours((0, 1, 2), np.arange(3))
    assert joined, "planes alone do not tell"
    assert sets.find(np.arange(3), 3) == ()


def test_beams_that_lie_on_each_other_in_turn_may_lock(shapes):
    """Four beams of a reciprocal frame, each above the next: downwards each runs into the next. Two never do."""
    meshes = []
    for turn in range(4):
        angle = np.pi / 2 * turn
        rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        lean = np.array([[1, 0, 0], [0, np.cos(0.2), -np.sin(0.2)], [0, np.sin(0.2), np.cos(0.2)]])
        flap = shapes.moved(shapes.box((-0.2, -1.9, -0.1), (0.2, 1.9, 0.1)), (0, 0, 0), lean)
        meshes.append(shapes.moved(shapes.moved(flap, (1.2, 0.0, 0)), (0, 0, 0), rotation))
    sets = locked_sets(meshes)
    found = sets.find(np.arange(4), 4)
    assert (0, 1, 2, 3) in found
    assert all(len(parts) > 2 for parts in found)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 12])
def test_one_direction_in_each_region_between_great_circles(count):
    """Circles of which no three meet cut the sphere into `n^2 - n + 2` regions."""
    normals = np.random.default_rng(count).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    directions = locked.one_in_each_cell(normals)
    sides = {tuple(side) for side in (directions @ normals.T > 0).tolist()}
    assert len(sides) == count**2 - count + 2


def test_regions_where_many_circles_meet(shapes):
    """Planes of symmetry of a cube: 9 circles, 48 triangles."""
    normals = [np.eye(3)[k] for k in range(3)]
    normals += [np.eye(3)[i] + sign * np.eye(3)[j] for i, j in itertools.combinations(range(3), 2) for sign in (1, -1)]
    normals = np.array(normals) / np.linalg.norm(normals, axis=1)[:, None]
    directions = locked.one_in_each_cell(normals)
    assert len({tuple(side) for side in (directions @ normals.T > 0).tolist()}) == 48


def test_a_block_that_can_turn_but_not_shift(shapes):
    """Below one half a floor, above the other a ceiling, and walls likewise: it turns about its middle."""
    walls = [((0.5, 0, -1), (1, 1, 0)), ((0, 0, 1), (0.5, 1, 2)), ((-1, 0, 0), (0, 1, 0.5)), ((1, 0, 0.5), (2, 1, 1))]
    sides = [((-1, -1, -1), (2, 0, 2)), ((-1, 1, -1), (2, 2, 2))]
    for ceiling, turns in ((0.5, True), (1.0, False)):
        walls[1] = ((0, 0, 1), (ceiling, 1, 2))
        meshes = [shapes.box((0, 0, 0), (1, 1, 1)), *(shapes.box(low, high) for low, high in walls + sides)]
        contacts = find_contacts(meshes)
        assert can_begin_to_move(contacts, (0,), np.ones(7, dtype=bool)) is turns
        assert not StraightWays(meshes, contacts, tolerance=TOLERANCE).can_leave(np.ones((1, 7), np.uint8))[0, 0]
        assert can_begin_to_move(contacts, (0,), np.arange(7) != 6), "out at the side"


@pytest.mark.parametrize("wide", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("seed", range(4))
def test_a_block_in_a_channel_of_inexact_faces_can_begin_to_move(shapes, seed, wide):
    """Both sides lean towards the block by rounding, in each direction: to first order they hold it as a wedge does."""
    rng = np.random.default_rng(seed)
    boxes = [((0, 0, 0), (1, 1, 1)), ((-3, -1, 0), (0, 2, 4)), ((1, -1, 0), (4, 2, 4)), ((-3, -1, -1), (4, 2, 0))]
    boxes += [((0, -1, 0), (1, 0, 4)), ((0, 1, 0), (1, 2, 4))]
    solids = [shapes.moved(shapes.box(*box), rotation=shapes.rotation(seed)) for box in boxes]
    meshes = [
        TriangleMesh.from_arrays("box", wide * (mesh.vertices + rng.uniform(-1e-5, 1e-5, (8, 3))), mesh.faces)
        for mesh in solids
    ]
    contacts, there = find_contacts(meshes), np.ones(len(meshes), dtype=bool)
    assert can_begin_to_move(contacts, (0,), there), "out of the channel"
    lid = shapes.moved(shapes.box((0, 0, 1), (1, 1, 2)), rotation=shapes.rotation(seed))
    closed = [*meshes, TriangleMesh.from_arrays("lid", wide * lid.vertices, lid.faces)]
    assert not can_begin_to_move(find_contacts(closed), (0,), np.append(there, True))


def test_a_part_that_touches_nothing_can_begin_to_move(shapes):
    meshes = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((1, 0, 0), (2, 1, 1))]
    contacts = find_contacts(meshes)
    assert can_begin_to_move(contacts, (0,), np.array([True, False]))
    assert can_begin_to_move(contacts, (0, 1), np.array([True, True]))


def test_too_many_sets_are_refused(shapes):
    with pytest.raises(InputError, match=r"more than 3 sets of up to 2 parts may lock each other.*allow fewer"):
        locked_sets(clasp(shapes)).find(np.arange(4), 2, most=3)

"""Ways out: closed forms, and agreement with moving solids step by step and intersecting their volumes."""

from __future__ import annotations

import itertools

import manifold3d
import numpy as np
import pytest

from falsework.errors import InputError
from falsework.geometry import ContactSettings, find_contacts, load_meshes
from falsework.geometry.clearance.directions import exit_directions, sphere_directions
from falsework.geometry.clearance.sweep import Sweeper
from falsework.geometry.clearance.table import StraightWays

TOLERANCE = 1e-4


def table_of(meshes, directions=1000):
    return StraightWays(meshes, find_contacts(meshes), directions, tolerance=TOLERANCE).table


def blocked_by_stepping(one, other, direction, steps, ignore=0.0):
    """Largest share of the smaller volume that the two have in common on the way, less `ignore`."""
    solid, obstacle = (
        manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint64)))
        for mesh in (one, other)
    )
    reach = np.linalg.norm(one.bounds - other.bounds, axis=1).max() + np.linalg.norm(np.ptp(one.bounds, axis=0))
    common = max((solid.translate(tuple(direction * far)) ^ obstacle).volume() for far in np.linspace(0, reach, steps))
    return max(common - ignore, 0.0) / min(one.volume, other.volume)


def test_directions_are_even_and_always_the_same():
    directions = sphere_directions(1000)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(1000))
    assert (directions == sphere_directions(2000)[:1000]).all()
    probes = np.random.default_rng(0).standard_normal((5000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    nearest = np.degrees(np.arccos((probes @ directions.T).max(axis=1)))
    assert nearest.max() < 8.0
    assert np.linalg.norm(directions.mean(axis=0)) < 0.01


def test_contact_normals_come_first(shapes):
    blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 1), (1, 1, 2)), shapes.box((1, 0, 1), (2, 1, 2))]
    directions = exit_directions(find_contacts(blocks), 1, 50)
    assert directions.shape == (50, 3)
    assert {tuple(np.round(row).astype(int)) for row in directions[:2]} == {(0, 0, 1), (-1, 0, 0)}
    assert len(exit_directions(find_contacts(blocks), 1, 1)) == 1


def test_a_block_in_a_corner_leaves_into_the_open_octant(shapes):
    """Three walls leave exactly the directions away from all of them, their planes included."""
    walls = [
        shapes.box((-1, -1, -1), (5, 5, 0)),
        shapes.box((-1, -1, 0), (0, 5, 5)),
        shapes.box((0, -1, 0), (5, 0, 5)),
    ]
    meshes = [*walls, shapes.box((0, 0, 0), (1, 1, 1))]
    contacts = find_contacts(meshes)
    sweeper = Sweeper(meshes, contacts, TOLERANCE)
    directions = np.concatenate([exit_directions(contacts, 3, 1000), np.eye(3), -np.eye(3)])
    blocked = sweeper.blocked(3, directions)
    assert (blocked[:, 0] == (directions[:, 2] < -1e-6)).all()
    assert ((~blocked.any(axis=1)) == (directions > -1e-6).all(axis=1)).all()
    assert not blocked[:, 3].any(), "a part is never in its own way"


def test_a_peg_leaves_along_its_axis_alone(shapes):
    pair = [shapes.drilled(24, 0.1, 0.3, 0.2), shapes.peg(24, 0.1, 0.2)]
    table = table_of([shapes.moved(mesh, rotation=shapes.rotation(3)) for mesh in pair], directions=400)
    axis = shapes.rotation(3)[:, 2]
    exit_way = table.exit_direction(np.ones(2, np.uint8), 1)
    assert exit_way is not None
    assert abs(exit_way @ axis) == pytest.approx(1.0, abs=1e-9)


def test_a_part_in_a_closed_box_stays_until_a_wall_is_gone(shapes):
    """Six walls; the part can leave if and only if at least one is missing."""
    part = shapes.box((0, 0, 0), (1, 1, 1), "core")
    walls = []
    for axis, side in itertools.product(range(3), (0, 1)):
        low, high = -np.ones(3), 2 * np.ones(3)
        low[axis], high[axis] = (1, 2) if side else (-1, 0)
        # Earlier axes own the corners, so that walls do not overlap.
        low[:axis], high[:axis] = 0, 1
        walls.append(shapes.box(low, high))
    table = table_of([part, *walls], directions=200)
    states = np.array([(1, *present) for present in itertools.product((0, 2), repeat=6)], dtype=np.uint8)
    assert (table.can_leave(states)[:, 0] == (states[:, 1:] == 0).any(axis=1)).all()
    assert table.exit_direction(states[-1], 0) is None
    state = states[-1].copy()
    state[2] = 0
    assert table.exit_direction(state, 0) == pytest.approx([1, 0, 0])


def test_a_ring_blocks_sideways_at_a_distance(shapes):
    """What is enclosed by a part without touching it leaves only through its opening."""
    ring = shapes.drilled(16, 0.5, 1.0, 0.4)
    meshes = [ring, shapes.box((-0.1, -0.1, 0.1), (0.1, 0.1, 0.3))]
    sweeper = Sweeper(meshes, find_contacts(meshes), TOLERANCE)
    directions = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1), (1, 1, 0.1), (0.1, 0, 1)], float)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert sweeper.blocked(1, directions)[:, 0].tolist() == [True, True, False, False, True, False]
    assert sweeper.blocked(0, directions)[:, 1].tolist() == [True, True, False, False, True, False]


def test_a_large_part_that_swallows_a_small_one_is_blocked(shapes):
    """The small part lies wholly inside what the large one sweeps; no outlines cross."""
    meshes = [shapes.box((0, 0, 0), (4, 4, 1)), shapes.box((1.5, 1.5, 2), (2.5, 2.5, 3))]
    sweeper = Sweeper(meshes, find_contacts(meshes), TOLERANCE)
    up = np.array([[0.0, 0.0, 1.0]])
    assert sweeper.blocked(0, up)[0, 1]
    assert not sweeper.blocked(0, -up)[0, 1]
    assert sweeper.blocked(1, -up)[0, 0]


def test_sliding_past_a_neighbour_is_free_and_into_it_is_not(shapes):
    for seed in range(3):
        turn = shapes.rotation(seed)
        blocks = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((1, 0, 0), (2, 1, 1))]
        meshes = [shapes.moved(block, (3, 4, 5), turn) for block in blocks]
        sweeper = Sweeper(meshes, find_contacts(meshes), TOLERANCE)
        along = np.array([(0, 1, 0), (0, 0, -1), (0, 0.6, 0.8), (1, 0, 0), (0.1, 0, 1)]) @ turn.T
        assert sweeper.blocked(0, along)[:, 1].tolist() == [False, False, False, True, True]


def test_fewer_parts_never_close_a_way(shared_assembly):
    meshes = load_meshes(shared_assembly("dog-35"))
    table = table_of(meshes, directions=200)
    random = np.random.default_rng(1)
    states = random.integers(0, 3, (200, len(meshes)), dtype=np.uint8)
    fewer = states * random.integers(0, 2, states.shape, dtype=np.uint8)
    assert (table.can_leave(fewer) >= table.can_leave(states)).all()
    assert table.can_leave(np.zeros_like(states)).all()
    assert not table.can_leave(np.ones_like(states)).all()


def test_what_is_left_out_of_the_table_changes_no_answer(shared_assembly):
    meshes = load_meshes(shared_assembly("cube-17"))
    contacts = find_contacts(meshes)
    _, overlap = ContactSettings().lengths(meshes)
    table = StraightWays(meshes, contacts, 300, tolerance=overlap).table
    sweeper = Sweeper(meshes, contacts, overlap)
    random = np.random.default_rng(2)
    states = random.integers(0, 2, (300, len(meshes)), dtype=np.uint8)
    whole = np.stack(
        [
            ~(sweeper.blocked(part, exit_directions(contacts, part, 300)) @ states.T.astype(bool)).all(axis=0)
            for part in range(len(meshes))
        ],
        axis=1,
    )
    assert (table.can_leave(states) == whole).all()
    assert len(table.directions) < 300
    for row, part in [(0, 3), (7, 11), (40, 16)]:
        way = table.exit_direction(states[row], part)
        assert (way is not None) == whole[row, part]


@pytest.mark.parametrize("name", ["dome-37", "vault-62", "dog-35"])
def test_agrees_with_moving_volumes_step_by_step(shared_assembly, name):
    """An independent library moves one solid past another in 400 steps.

    Steps see what overlaps for longer than one of them. So a way with a common volume must be blocked, and
    a blocked one, looked at in steps fine enough, must have one.
    """
    meshes = load_meshes(shared_assembly(name))
    contacts = find_contacts(meshes)
    _, overlap = ContactSettings().lengths(meshes)
    sweeper = Sweeper(meshes, contacts, overlap)
    random = np.random.default_rng(3)
    seen = {True: 0, False: 0}
    for _ in range(25):
        part = int(random.integers(len(meshes)))
        direction = exit_directions(contacts, part, 1000)[random.integers(1000)][None]
        free, known = sweeper._known(part, direction)
        swept = np.flatnonzero(~free[0] & ~known[0])
        others = np.append(random.permutation(swept)[:3], random.integers(len(meshes)))
        blocked = sweeper.blocked(part, direction)[0]
        for other in others[others != part].tolist():
            still = blocked_by_stepping(meshes[part], meshes[other], direction[0], 1)
            small = min(meshes[part].volume, meshes[other].volume)
            common = blocked_by_stepping(meshes[part], meshes[other], direction[0], 400, still * small)
            if common > 1e-3:
                assert blocked[other], f"{part} hits {other} along {direction[0]}"
            if blocked[other] and common == 0 and still == 0:
                common = blocked_by_stepping(meshes[part], meshes[other], direction[0], 20_000)
                assert common > 0, f"{part} passes {other} along {direction[0]}"
            seen[bool(blocked[other])] += 1
    assert min(seen.values()) > 5, "both answers were tried"


def test_bad_questions(shapes):
    meshes = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((0, 0, 1), (1, 1, 2))]
    contacts = find_contacts(meshes)
    with pytest.raises(InputError, match="0 directions"):
        StraightWays(meshes, contacts, 0, tolerance=TOLERANCE)
    table = StraightWays(meshes, contacts, 10, tolerance=TOLERANCE).table
    with pytest.raises(InputError, match=r"\(1, 3\).*\(batch, 2\)"):
        table.can_leave(np.zeros((1, 3), np.uint8))

"""Kinds of parts that leave by turning: bolts and nuts of either hand, keys in slots, plugs with lugs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework.assembly.library.blocks import gather
from falsework.assembly.library.voxels import surface
from falsework.geometry import TriangleMesh, find_contacts
from falsework.geometry.clearance.moves import ExitPath
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.path_search import PathSearch
from tests.assembly.test_settling import box
from tests.search.test_exit_paths import bolt, rings

Array = NDArray[np.float64]
TOLERANCE = 1e-4


def way_out(meshes: list[TriangleMesh], moves: int, part: int = 0) -> ExitPath | None:
    """Way out of a part past all others, which is swept anew; straight moves alone find none."""
    motions = PartMotions(meshes, find_contacts(meshes), TOLERANCE)
    others = np.arange(len(meshes)) != part
    assert PathSearch(motions, (part,), others).run(moves).way is None
    way = PathSearch(motions, (part,), others).run(moves, turns=True).way
    assert way is None or motions.leaves(way, others) == ""
    return way


def mirrored(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh.from_arrays(mesh.name, mesh.vertices * (-1, 1, 1), mesh.faces[:, ::-1])


@pytest.mark.parametrize("leaves", ["bolt", "plate"])
@pytest.mark.parametrize("left_handed", [False, True])
def test_threads_of_either_hand_screw_apart(leaves: str, left_handed: bool) -> None:
    """The bolt out of its plate, or the plate, as a nut, down from the bolt."""
    meshes = [mirrored(mesh) if left_handed else mesh for mesh in bolt().meshes]
    names = [mesh.name for mesh in meshes]
    way = way_out(meshes, 1, names.index(leaves))
    assert way is not None
    (move,) = way
    assert move.direction[2] == pytest.approx(1.0 if leaves == "bolt" else -1.0, abs=1e-3)
    assert move.distance / move.angle == pytest.approx((-1 if left_handed else 1) * 0.1 / np.pi, rel=5e-3)


def key(clearance: float, bar: float = 0.02) -> list[TriangleMesh]:
    """A key whose bar is under a slot in the lid of a case, across it; its neck is in the slot."""
    wide = 0.006 + clearance
    case = [
        box("floor", (-0.04, -0.04, 0.0), (0.04, 0.04, 0.01)),
        *(box("side", (x, -0.04, 0.01), (x + 0.01, 0.04, 0.04)) for x in (-0.04, 0.03)),
        *(box("end", (-0.03, y, 0.01), (0.03, y + 0.01, 0.04)) for y in (-0.04, 0.03)),
        *(box("lid", (-0.04, y, 0.04), (0.04, y + 0.04 - wide, 0.05)) for y in (-0.04, wide)),
        *(box("lid", (x, -wide, 0.04), (x + 0.04 - bar - clearance, wide, 0.05)) for x in (-0.04, bar + clearance)),
    ]
    x, y, z = (
        np.array([-0.005, -0.004, 0.004, 0.005]),
        np.array([-bar, -0.004, 0.004, bar]),
        np.array([0.01, 0.02, 0.08]),
    )
    cells = {(i, j, 0) for i in range(3) for j in range(3)} | {(1, 1, 1)}
    drawn = gather([surface("key", frozenset(cells), (1, 1, 1), (0, 0, 0))]).meshes[0]
    i, j, k = np.round(drawn.vertices).astype(int).T
    return [TriangleMesh.from_arrays("key", np.stack([x[i], y[j], z[k]], axis=1), drawn.faces), *case]


@pytest.mark.parametrize("clearance", [2e-4, 1e-3])
def test_a_key_is_turned_until_its_bar_is_along_the_slot(clearance: float) -> None:
    way = way_out(key(clearance), 2)
    assert way is not None
    turn, lift = way
    assert abs(turn.direction[2]) == pytest.approx(1.0)
    assert abs(np.sin(turn.angle)) == pytest.approx(1.0, abs=0.05)
    assert lift.direction == (0.0, 0.0, 1.0)


def test_a_key_that_is_longer_than_its_slot_stays() -> None:
    longer = key(1e-3)
    longer[0] = TriangleMesh.from_arrays("key", longer[0].vertices * (1, 1.2, 1), longer[0].faces)
    assert way_out(longer, 2) is None


def ring(name: str, outer: Array, inner: Array, low: float, high: float) -> TriangleMesh:
    """A prism with a hole, both given by radii around the vertical."""
    angle = 2 * np.pi * np.arange(len(outer)) / len(outer)
    edges = [(outer, low), (outer, high), (inner, high), (inner, low)]
    sections = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(len(r), z)], axis=1) for r, z in edges]
    return rings(name, sections, close=True)


@pytest.mark.parametrize("count", [2, 4])
def test_a_plug_turns_until_its_lugs_are_below_their_slots(count: int) -> None:
    """A bayonet: a chamber, and a lid whose slots are half of the angle between two lugs away from these."""
    angle, play = 2 * np.pi * np.arange(32) / 32, 1.03
    lugs = np.where(np.cos(count * angle) > 0.7, 0.015, 0.01)
    wall, slots = np.full(32, 0.025), play * np.roll(lugs, 16 // count)
    meshes = [
        ring("plug", lugs, np.full(32, 0.002), 0.0, 0.01),
        box("floor", (-0.03, -0.03, -0.01), (0.03, 0.03, 0.0)),
        ring("chamber", wall, np.full(32, 0.015 * play), 0.0, 0.0105),
        ring("lid", wall, slots, 0.0105, 0.02),
    ]
    way = way_out(meshes, 2)
    assert way is not None
    assert np.cos(count * way[0].angle) == pytest.approx(-1.0, abs=1e-3)
    assert way[1].direction == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("stop", [False, True])
def test_a_leaf_is_turned_on_its_hinge_until_it_lifts_off(stop: bool) -> None:
    """A lift-off hinge: a lintel lies above the leaf where it is shut; where a stop keeps it shut, it stays."""
    around = 2 * np.pi * np.arange(24) / 24
    outer = np.where(np.cos(around) > 0.96, 0.06, 0.02)
    pin, hole = np.full(24, 0.01), np.full(24, 0.0105)
    meshes = [
        ring("leaf", outer, hole, 0.0, 0.02),
        box("floor", (-0.08, -0.08, -0.02), (0.08, 0.08, -0.01)),
        ring("pin", pin, np.full(24, 0.002), -0.01, 0.03),
        ring("seat", np.full(24, 0.018), np.full(24, 0.0102), -0.01, 0.0),
        box("lintel", (0.035, -0.03, 0.0205), (0.07, 0.03, 0.04)),
    ]
    if stop:
        meshes += [box("stop", (0.04, y, -0.01), (0.05, y + 0.01, 0.02)) for y in (-0.0221, 0.0121)]
    way = way_out(meshes, 2)
    assert (way is None) == stop
    if way is not None:
        turn, lift = way
        assert abs(turn.direction[2]) == pytest.approx(1.0)
        np.testing.assert_allclose(turn.point[:2], 0.0, atol=1e-3)
        assert lift.direction == (0.0, 0.0, 1.0)

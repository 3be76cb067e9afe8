"""Joints as `assembly.json` gives them, and what is wrong with those that cannot be used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, load_structure
from falsework.assembly import Joints, fasten, library
from falsework.assembly.store import load_assembly, save_assembly
from falsework.errors import AssemblyError, InputError
from falsework.geometry import TriangleMesh

CUBE = [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2),
        (1, 3, 7), (1, 7, 5)]  # fmt: skip


def cube(name: str, *corner: float) -> TriangleMesh:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    return TriangleMesh.from_arrays(name, corners + np.array(corner), CUBE)


def stack() -> Assembly:
    """Two cubes on a fixed one, and a fixed one that stands on the highest on an edge."""
    cubes = [cube("a", 0, 0, 0), cube("b", 0, 0, 1), cube("c", 0, 0, 2)]
    half = np.sqrt(0.5)
    turn = np.array([[half, 0, half], [0, 1, 0], [-half, 0, half]])
    turned = (cubes[0].vertices - 0.5) @ turn.T + [0.5, 0.5, 3 + half]
    cubes.append(TriangleMesh.from_arrays("d", turned, CUBE))
    with pytest.warns(UserWarning, match="along a line"):
        return Assembly.from_meshes(cubes, boundary=[0, 3])


def test_pascals_become_newtons_shared_by_the_points() -> None:
    tower = stack()
    joints = Joints.from_arrays(tower.contacts, tension=np.where(tower.contacts.dimension == 2, 100.0, 0.0))
    flat = tower.contacts.dimension[tower.contacts.contact_of_point] == 2
    np.testing.assert_allclose(joints.tension, np.where(flat, 25.0, 0.0))


def test_the_last_joint_of_a_contact_counts() -> None:
    tower = stack()
    entries = [
        {"tension": 100.0},
        {"between": ["brick", "stone"], "friction": 0.7, "cohesion": 80.0},
        {"parts": ["c", "b"], "tension": 40.0},
    ]
    joints = Joints.from_entries(entries, ["stone", "brick", "brick", "stone"], tower.names, tower.contacts)
    assert joints is not None
    pairs = tower.contacts.parts[tower.contacts.contact_of_point]

    def of(a: int, b: int) -> tuple[float, ...]:
        row = int(np.flatnonzero((pairs == (a, b)).all(axis=1))[0])
        return joints.friction[row], joints.cohesion[row], joints.tension[row]

    np.testing.assert_equal(of(0, 1), (0.7, 20.0, 25.0))
    np.testing.assert_equal(of(1, 2), (np.nan, np.nan, 10.0))
    np.testing.assert_equal(of(2, 3), (0.7, np.nan, 0.0))  # an edge has friction, but no strength


def test_a_folder_keeps_its_joints(tmp_path: Path) -> None:
    wall = library.build("wall:bricks=3,courses=2")
    save_assembly(wall, tmp_path / "wall")
    file = tmp_path / "wall" / "assembly.json"
    described = json.loads(file.read_text())
    described["joints"] = [{"cohesion": 2e5, "tension": 1e5, "sets": [[0, 0], [4, 1]]}]
    file.write_text(json.dumps(described))
    mortared = load_structure(tmp_path / "wall")
    assert mortared.joints is not None
    assert mortared.joints.setting == (((0.0, 0.0), (4.0, 1.0)),)
    assert mortared.identity != wall.identity
    dry = load_assembly(tmp_path / "wall", joints=[])
    assert dry.identity == wall.identity
    with pytest.raises(InputError, match="joints"):
        save_assembly(mortared, tmp_path / "copy")


def test_a_ground_is_of_a_material_of_its_own(tmp_path: Path) -> None:
    tower = Assembly.from_meshes([cube("a", 0, 0, 0), cube("b", 0, 0, 1)], boundary=[1])
    joined = tower.replace(joints=Joints.from_arrays(tower.contacts, tension=8.0))
    grounded = joined.with_ground()
    assert grounded.joints is not None
    assert grounded.joints.tension.sum() == pytest.approx(8.0)
    assert len(grounded.joints.tension) == len(grounded.contacts.points)
    joints = Joints.from_entries(
        [{"between": ["stone", "ground"], "tension": 4.0}], ["stone", "stone"], grounded.names, grounded.contacts
    )
    assert joints is not None
    assert joints.tension.sum() == pytest.approx(4.0)


def test_setting_is_linear_between_its_steps() -> None:
    tower = stack()
    sets = np.where(tower.contacts.dimension == 2, 0, -1)
    joints = Joints.from_arrays(tower.contacts, setting=[((0, 0.2), (4, 1.0))], sets=sets)
    points = len(tower.contacts.points)
    share = joints.set_share(np.array([[age] * points for age in (0, 2, 4, 9)], np.int32))
    flat = sets[tower.contacts.contact_of_point] == 0
    np.testing.assert_allclose(share[:, flat], np.repeat([[0.2], [0.6], [1.0], [1.0]], flat.sum(), axis=1))
    assert (share[:, ~flat] == 1.0).all()


@pytest.mark.parametrize(
    ("entries", "materials", "message"),
    [
        ([{"cohesion": -1.0}], None, "joints[0].cohesion is -1.0; give a number >= 0 (Pa)"),
        ([{"tension": float("nan")}], None, "joints[0].tension is nan; give a number >= 0"),
        ([{"friction": 1e9}], None, "joints[0].friction is 1000000000.0; give a number <= 100000000 (coefficient)"),
        ([{"tension": 1e13}], None, "joints[0].tension is 10000000000000.0; give a number <= 1000000000000 (Pa)"),
        ([{"friction": "rough"}], None, "joints[0].friction is 'rough'; give a number (coefficient)"),
        ([{"tension": True}], None, "joints[0].tension is True; give a number (Pa)"),
        ([{"parts": ["a", "b"]}], None, "joints[0] has no strength; give friction, cohesion or tension"),
        ([{"tension": 1.0, "glue": 1}], None, "joints[0].glue is not known; known are between, cohesion,"),
        ([7], None, "joints[0] is 7; give an object"),
        ([{"tension": 1.0, "parts": ["a", "z"]}], None, "a joint is of part 'z', which does not exist"),
        ([{"tension": 1.0, "parts": ["a", "c"]}], None, "parts a and c do not meet, so no joint is between them"),
        ([{"tension": 1.0, "parts": ["c", "d"]}], None, "parts c and d touch along a line or at a point"),
        ([{"tension": 1.0, "between": ["m", "g"]}], ["s", "s", "m", "g"], "parts c and d touch along a line or at"),
        ([{"tension": 1.0, "parts": ["a"]}], None, "joints[0].parts is ['a']; give a list of length >= 2"),
        ([{"tension": 1.0, "between": ["x", "y"]}], None, "no part is of material 'x'; materials of the parts are not"),
        ([{"tension": 1.0, "between": ["stone", "y"]}], "stone", "no part is of material 'y'; materials of the parts"),
        ([{"tension": 1.0, "ductile": 1}], None, "joints[0].ductile is 1; give true or false"),
        ([{"tension": 1.0, "between": "stone"}], "stone", "joints[0].between is 'stone'; give a list (two materials)"),
        ([{"tension": 1.0, "between": ["s", "s"], "parts": [0, 1]}], "s", "joint between s and s has parts too"),
        ([{"tension": 1.0}], ["stone"], "materials must be one name, or 4 names"),
        ([], ["stone"], "materials must be one name, or 4 names"),
        ([{"tension": 1.0, "sets": [[0, 1], [4, 0]]}], None, "a joint sets by"),
        ([{"tension": 1.0, "sets": [[0, 0.5]]}], None, "that rise to 1, such as"),
        ([{"tension": 1.0, "sets": 5}], None, "joints[0].sets is 5; give a list"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_joint(entries: Any, materials: Any, message: str) -> None:
    tower = stack()
    with pytest.raises(AssemblyError) as refused:
        Joints.from_entries(entries, materials, tower.names, tower.contacts)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_fastener_is_a_contact_point_among_those_of_its_pair() -> None:
    tower = stack()
    joined = tower.replace(
        joints=Joints.from_arrays(tower.contacts, cohesion=np.where(tower.contacts.dimension == 2, 8.0, 0.0))
    )
    screwed = fasten(joined, [{"parts": ("b", "a"), "at": [0.5, 0.5, 1.0], "tension": 90.0, "shear": 40.0}])
    pairs = screwed.contacts.parts[screwed.contacts.contact_of_point]
    assert (np.diff(pairs[:, 0] * 10 + pairs[:, 1]) >= 0).all()
    (row,) = np.flatnonzero((screwed.contacts.points == [0.5, 0.5, 1.0]).all(axis=1))
    assert pairs[row].tolist() == [0, 1]
    np.testing.assert_allclose(screwed.contacts.frames[screwed.contacts.contact_of_point[row], 0], [0, 0, 1])
    assert screwed.joints is not None
    assert (screwed.joints.tension[row], screwed.joints.cohesion[row]) == (90.0, 40.0)
    rest = np.delete(np.arange(len(pairs)), row)
    assert joined.joints is not None
    np.testing.assert_array_equal(screwed.joints.cohesion[rest], joined.joints.cohesion)
    np.testing.assert_array_equal(screwed.contacts.points[rest], tower.contacts.points)
    assert screwed.identity != joined.identity


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tension": -1}, "fasteners[0].tension is -1; give a number >= 0 (N)"),
        ({"shear": "much"}, "fasteners[0].shear is 'much'; give a number (N"),
        ({"at": [0, 0]}, "fasteners[0].at is [0, 0]; give a list of length >= 3 (place, m)"),
        ({"axis": [0, 0, 0]}, "needs an axis that is not zero"),
        ({"parts": ["a", "a"]}, "a fastener is between part a and itself; give two parts"),
        ({"at": [0.5, 0.5, 1000.0]}, "away from part a; give its place in metres, within the parts"),
        ({"parts": ["a", "c"]}, "has no contact to be normal to; give its axis"),
        ({"parts": ["a", "z"]}, "a fastener is in part 'z', which does not exist"),
        ({"parts": "ab"}, "fasteners[0].parts is 'ab'; give a list"),
        ({"ductile": 1}, "fasteners[0].ductile is 1; give true or false"),
        ({"glue": 1}, "fasteners[0].glue is not known; known are at, axis, ductile,"),
    ],
)
def test_what_cannot_be_a_fastener(change: dict[str, Any], message: str) -> None:
    with pytest.raises(AssemblyError) as refused:
        fasten(stack(), [{"parts": ["a", "b"], "at": [0.5, 0.5, 1.0], "tension": 90.0} | change])
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_cannot_be_the_strength_of_contacts() -> None:
    tower = stack()
    with pytest.raises(AssemblyError, match="tension of a joint is -1 Pa; give a number from 0 to"):
        Joints.from_arrays(tower.contacts, tension=-1.0)
    with pytest.raises(AssemblyError, match="parts 2 and 3 touch along a line or at a point, which has no area"):
        Joints.from_arrays(tower.contacts, tension=1.0)
    with pytest.raises(AssemblyError, match="friction has shape"):
        Joints.from_arrays(tower.contacts, friction=[0.5, 0.5])
    other = library.build("arch:blocks=5")
    with pytest.raises(AssemblyError, match="joints are of"):
        other.replace(joints=Joints.from_arrays(tower.contacts))

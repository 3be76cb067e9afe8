"""Folders of meshes whose poses are in a file of their own."""

from __future__ import annotations

import json

import numpy as np
import pytest

from falsework import Outcome, doctor, find_plans, load_structure
from falsework.errors import InputError, ReadWarning, UntouchedPartError
from falsework.geometry.mesh.obj import obj_text
from falsework.interop.posed_meshes import read_posed
from falsework.utils.files.formats import reader_of
from tests.assembly.test_settling import box, lid, peg, rings, tube, wheel

FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
]  # fmt: skip


def write_box(path, size):
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in FACES]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def folder(tmp_path):
    """Slab with a bar on it that lies along x in its mesh and along y when it is assembled; the ids have a gap."""
    write_box(tmp_path / "0.obj", (10, 10, 2))
    write_box(tmp_path / "3.obj", (8, 1, 1))
    return tmp_path


POSES = {
    "0": {"initial_state": [50, 0, 1, 0, 0, 0], "final_state": [0, 0, 1]},
    "3": {"final_state": [1, 0, 2.5, 0, 0, np.pi / 2]},
}


def loaded(folder, **options):
    with pytest.warns(ReadWarning, match="there is no part 1"):
        return load_structure(folder, **options)


def test_poses_of_a_configuration_and_ids_with_gaps(folder):
    (folder / "config.json").write_text(json.dumps({"contact_eps": 0.2, **POSES}))
    assembly = loaded(folder, boundary=["0"])
    assert assembly.names == ("0", "3")
    assert assembly.name == folder.name
    # Centimetres, since no file says otherwise.
    assert assembly.meshes[1].bounds == pytest.approx(np.array([(0.005, -0.04, 0.02), (0.015, 0.04, 0.03)]))
    assert assembly.contacts.parts.tolist() == [[0, 1]]
    assert loaded(folder, boundary=["0"], unit="mm").meshes[1].bounds[1, 2] == pytest.approx(0.003)


def test_angles_are_about_fixed_axes_in_turn(folder):
    state = [0, 0, 0, 0.3, -0.4, 0.5]
    (folder / "config.json").write_text(json.dumps({"3": {"final_state": state}, "0": {"final_state": [0, 0, -6]}}))
    with pytest.warns(ReadWarning):
        draft = read_posed(folder)
    (a, b, c), (s, t, u) = np.cos(state[3:]), np.sin(state[3:])
    turn = (
        np.array([[c, -u, 0], [u, c, 0], [0, 0, 1]])
        @ np.array([[b, 0, t], [0, 1, 0], [-t, 0, b]])
        @ np.array([[1, 0, 0], [0, a, -s], [0, s, a]])
    )
    flat = np.array([[x, y, z] for x in (-4, 4) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    assert draft.blocks[1].vertices == pytest.approx(flat @ turn.T)


def test_translations_of_their_own(folder):
    (folder / "translation.json").write_text(json.dumps({"0": [0, 0, 1], "3": [0, 0, 2.5]}))
    assembly = loaded(folder, boundary=["0"])
    assert assembly.meshes[1].bounds[:, 2] == pytest.approx([0.02, 0.03])


def test_a_configuration_without_poses_says_only_whose_the_folder_is(folder):
    (folder / "config.json").write_text('{"contact_eps": 0.2}')
    write_box(folder / "3.obj", (8, 1, 2))
    with pytest.raises(InputError, match="pass through each other"):
        loaded(folder, boundary=["0"])


def test_parts_without_a_pose_and_poses_without_a_part_are_warned_of(folder):
    poses = {"3": {"final_state": [0, 0, 1.5]}, "7": {"final_state": [0, 0, 0]}}
    (folder / "config.json").write_text(json.dumps(poses))
    with (
        pytest.warns(ReadWarning, match="poses of parts without a mesh have no effect: 7"),
        pytest.warns(ReadWarning, match="parts without a pose stay where their meshes are: 0"),
        pytest.warns(ReadWarning, match="there is no part 1"),
    ):
        load_structure(folder, boundary=["0"])


@pytest.mark.parametrize("state", [[1, 2], [1, 2, 3, 4], [0, 0, "1"], None, [0, 0, 1e999], [True, 0, 0]])
def test_a_pose_that_is_none_is_named(folder, state):
    (folder / "config.json").write_text(json.dumps({"0": {"final_state": state}, "3": {"initial_state": [0, 0, 0]}}))
    with pytest.warns(ReadWarning), pytest.raises(InputError, match=r"config\.json: the pose of part 0 is .*; give a"):
        load_structure(folder, boundary=["0"])


def test_a_ground_is_added_where_nothing_is_fixed(folder):
    (folder / "config.json").write_text(json.dumps(POSES))
    with pytest.warns(ReadWarning, match="a ground was added"):
        assembly = loaded(folder)
    assert assembly.names[-1] == "ground"
    assert not assembly.boundary[:-1].any()


def test_other_folders_with_json_files_are_not_taken_for_them(folder):
    assert reader_of(folder) is None
    (folder / "config.json").write_text('{"camera": [1, 2, 3]}')
    assert reader_of(folder) is None
    (folder / "config.json").write_text("{damaged")
    assert reader_of(folder) is None


def test_the_description_of_the_folder_counts_too(folder):
    (folder / "config.json").write_text(json.dumps(POSES))
    (folder / "assembly.json").write_text('{"boundary": ["0"], "friction": 0.3, "settle": 0.0005}')
    assembly = loaded(folder)
    assert assembly.friction == 0.3
    assert assembly.settlement is not None
    report = doctor(folder)
    assert report.loads
    assert report.parts[1].name == "3"


# Fits


def write_posed(folder, meshes):
    """Meshes in centimetres, each with a pose, as these projects write them."""
    for number, mesh in enumerate(meshes):
        scaled = type(mesh).from_arrays(mesh.name, 100 * mesh.vertices, mesh.faces)
        (folder / f"{number}.obj").write_text(obj_text(scaled))
    config = {str(number): {"final_state": [0, 0, 0]} for number in range(len(meshes))}
    (folder / "config.json").write_text(json.dumps(config))
    return folder


FITS = [(wheel, (2e-4,)), (peg, (1e-4, 3e-4)), (lid, (4e-4,)), (rings, (3, 1e-4))]


@pytest.mark.parametrize(("fit", "lengths"), FITS)
def test_parts_of_a_fit_settle_unasked_and_come_apart(fit, lengths, tmp_path):
    """In every one of these a part touches nothing, or on one side only, where it is modelled."""
    folder = write_posed(tmp_path, fit(*lengths))
    with pytest.warns(
        ReadWarning, match=r"(touches no other|is not stable), so parts settle .* by at most .*--settle 0"
    ):
        assembly = load_structure(folder, boundary=["0"])
    assert assembly.settlement is not None
    assert assembly.settlement.stopped.all()
    assert 0 < assembly.settlement.motion.max() < 4 * max(lengths[-2:]) * len(assembly.names)
    assert find_plans(assembly, robots=1).outcome is Outcome.FOUND


def test_parts_stay_where_they_are_if_they_rest_there_or_are_told_to(tmp_path):
    with pytest.raises(UntouchedPartError, match="touches no other part"):
        load_structure(write_posed(tmp_path, wheel()), boundary=["0"], settle=0)
    resting = tmp_path / "resting"
    resting.mkdir()
    assert load_structure(write_posed(resting, lid(0.0)), boundary=["0"]).settlement is None


def test_an_unstable_assembly_settles_only_into_clearance(tmp_path):
    """A wheel that touches its axle from below settles; a block that would fall anyhow is left where it is."""
    axle, ring = (
        tube("axle", 0.002, 0.01, -0.05, 0.05, axis="y"),
        tube("ring", 0.0101, 0.03, -0.01, 0.01, axis="y", at=(0, 0, 1e-4)),
    )
    with pytest.warns(ReadWarning, match="the complete assembly is not stable, so parts settle"):
        hung = load_structure(write_posed(tmp_path, [axle, ring]), boundary=["0"])
    assert hung.settlement is not None
    falls = tmp_path / "falls"
    falls.mkdir()
    wall, block = box("wall", (0, 0, 0), (0.1, 0.1, 0.1)), box("block", (0.1, 0, 0), (0.2, 0.1, 0.1))
    assert load_structure(write_posed(falls, [wall, block]), boundary=["0"]).settlement is None

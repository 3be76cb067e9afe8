"""Every format gives the same parts; every damaged input one line that says what to do."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from trimesh.exchange.stl import export_stl_ascii

from falsework.errors import InputError, MeshError, ReadWarning
from falsework.geometry import RepairWarning, load_meshes
from falsework.geometry.mesh.obj import obj_text, read_obj

Y_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], float)
"""Turns z up into the y up of glTF."""


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.fixture
def boxes(shapes):
    return [shapes.box((0, 0, 0), (0.2, 0.3, 0.4), "0"), shapes.box((0.2, 0, 0), (0.7, 0.3, 0.1), "1")]


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb"])
def test_a_folder_of_any_format(tmp_path, boxes, suffix):
    for box in boxes:
        solid = as_trimesh(box)
        if suffix == "glb":
            solid.apply_transform(Y_UP)
        solid.export(tmp_path / f"{box.name}.{suffix}")
    meshes = load_meshes(tmp_path)
    assert [mesh.name for mesh in meshes] == ["0", "1"]
    for mesh, box in zip(meshes, boxes, strict=True):
        assert mesh.bounds == pytest.approx(box.bounds, abs=1e-6)
        assert mesh.volume == pytest.approx(box.volume, rel=1e-5)


def test_one_glb_with_one_object_per_part(tmp_path, boxes):
    scene = trimesh.Scene()
    for number in (1, 0):  # order in the file does not matter where names are ids
        solid = as_trimesh(boxes[number])
        shift = trimesh.transformations.translation_matrix((0, 0, number))
        scene.add_geometry(solid, node_name=str(number), geom_name=f"g{number}", transform=Y_UP @ shift)
    scene.export(tmp_path / "all.glb")
    meshes = load_meshes(tmp_path / "all.glb")
    assert [mesh.name for mesh in meshes] == ["0", "1"]
    for number, mesh in enumerate(meshes):
        assert mesh.bounds == pytest.approx(boxes[number].bounds + (0, 0, number), abs=1e-6)


@pytest.mark.parametrize("keyword", ["o", "g"])
def test_one_obj_with_one_object_per_part(tmp_path, boxes, keyword):
    text, first = "# two parts\n", 1
    for name, box in zip(("sill", "post"), boxes, strict=True):
        text += f"{keyword} {name}\n" + "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in box.vertices.tolist())
        text += "".join(f"f {a + first}/1/2 {b + first}//3 {c + first}\n" for a, b, c in box.faces.tolist())
        first += len(box.vertices)
    (tmp_path / "all.obj").write_text(text)
    for source in (tmp_path, tmp_path / "all.obj"):
        meshes = load_meshes(source)
        assert [mesh.name for mesh in meshes] == ["sill", "post"]
        assert all((mesh.triangles == box.triangles).all() for mesh, box in zip(meshes, boxes, strict=True))


@pytest.mark.parametrize("suffix", ["stl", "ply"])
def test_one_file_without_objects_is_split_into_its_solids(tmp_path, shapes, suffix):
    solids = [shapes.box((0, 0, 0), (1, 1, 1)), shapes.box((3, 0, 0), (4, 2, 1)), shapes.box((6, 0, 0), (7, 1, 3))]
    trimesh.util.concatenate([as_trimesh(solid) for solid in solids]).export(tmp_path / f"all.{suffix}")
    meshes = load_meshes(tmp_path / f"all.{suffix}")
    assert sorted(mesh.volume for mesh in meshes) == pytest.approx([1, 2, 3], rel=1e-5)


def test_ascii_stl_keeps_its_solids(tmp_path, boxes):
    text = "".join(export_stl_ascii(as_trimesh(box)).replace("solid ", f"solid {box.name}") + "\n" for box in boxes)
    (tmp_path / "all.stl").write_text(text)
    assert [mesh.volume for mesh in load_meshes(tmp_path / "all.stl")] == pytest.approx(
        [box.volume for box in boxes], rel=1e-5
    )


def test_units(tmp_path, boxes):
    (tmp_path / "0.obj").write_text(obj_text(boxes[0]))
    metre, inch = load_meshes(tmp_path)[0], load_meshes(tmp_path, unit="in")[0]
    assert inch.vertices == pytest.approx(metre.vertices * 0.0254)
    with pytest.raises(InputError, match=r"unknown unit 'parsec'.*mm"):
        load_meshes(tmp_path, unit="parsec")


def test_millimetres_read_as_metres_are_caught(tmp_path, shapes):
    (tmp_path / "0.obj").write_text(obj_text(shapes.box((0, 0, 0), (2000, 300, 300))))
    with pytest.raises(MeshError, match=r"part box is 2,000 m long.*unit"):
        load_meshes(tmp_path)
    assert load_meshes(tmp_path, unit="mm")[0].volume == pytest.approx(0.18)


def test_obj_survives_writing_to_the_last_bit(tmp_path, shapes):
    mesh = shapes.moved(shapes.box((0, 0, 0), (1 / 3, np.pi, 1e-5)), (1e3, 0, -1e-9), shapes.rotation(9))
    (tmp_path / "0.obj").write_text(obj_text(mesh))
    [read] = read_obj(tmp_path / "0.obj")
    assert (read.vertices == mesh.vertices).all()
    assert (read.faces == mesh.faces).all()


def test_concave_polygons_and_indices_from_the_end(tmp_path, shapes):
    outline = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)]
    prism = shapes.extruded(outline, 0, 1)
    lines = [f"v {x} {y} {z}" for x, y, z in prism.vertices]
    lines += ["f " + " ".join(str(i - 16) for i in range(7, -1, -1)), "f " + " ".join(str(i + 9) for i in range(8))]
    lines += [f"f {i + 1} {(i + 1) % 8 + 1} {(i + 1) % 8 + 9} \\\n {i + 9}  # side" for i in range(8)]
    (tmp_path / "c.obj").write_text("\n".join(lines))
    mesh = load_meshes(tmp_path)[0]
    assert mesh.volume == pytest.approx(prism.volume)
    corners = mesh.triangles
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(2 * 7 + 16), "a fan over a concave polygon would fold over and count area twice"


def test_names_are_put_in_natural_order(tmp_path, boxes):
    for name in ("stone-10", "stone-9", "base"):
        (tmp_path / f"{name}.obj").write_text(obj_text(boxes[0]))
    assert [mesh.name for mesh in load_meshes(tmp_path)] == ["base", "stone-9", "stone-10"]


def test_ids_are_put_in_order_of_number(tmp_path, boxes):
    for name in range(11):
        (tmp_path / f"{name}.obj").write_text(obj_text(boxes[0]))
    assert [mesh.name for mesh in load_meshes(tmp_path)] == [str(number) for number in range(11)]


def write(path, box):
    path.write_text(obj_text(box))


def test_bad_folders(tmp_path, boxes):
    with pytest.raises(InputError, match=r"there is no .*nowhere"):
        load_meshes(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"no mesh in .*; put one file per part"):
        load_meshes(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match=r"cannot read .*notes\.txt"):
        load_meshes(tmp_path / "notes.txt")
    write(tmp_path / "0.obj", boxes[0])
    write(tmp_path / "2.obj", boxes[1])
    with pytest.warns(ReadWarning, match="there is no part 1: the 2 parts are numbered from 0 to 1 in the order"):
        assert [mesh.name for mesh in load_meshes(tmp_path)] == ["0", "2"]
    write(tmp_path / "1.obj", boxes[1])
    write(tmp_path / "02.obj", boxes[1])
    with pytest.raises(InputError, match="part 2 occurs 2 times"):
        load_meshes(tmp_path)


def test_one_name_in_two_formats(tmp_path, boxes):
    write(tmp_path / "sill.obj", boxes[0])
    as_trimesh(boxes[0]).export(tmp_path / "sill.stl")
    with pytest.raises(InputError, match="'sill' occurs 2 times"):
        load_meshes(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 zero\n", r"line 1 of .*0\.obj: 'v 0 0 zero'"),
        ("v 0 0\n", "line 1"),
        ("v 0 0 0\nf 1 x 2\n", "line 2"),
        ("v 0 0 0\nv 1 0 0\nf 1 2\n", "line 3"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "does not exist"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n", "does not exist"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4"),
        ("v 0 0 0\n", "no mesh in"),
        ("", "no mesh in"),
    ],
)
def test_damaged_obj(tmp_path, text, message):
    (tmp_path / "0.obj").write_text(text)
    with pytest.raises(MeshError, match=message):
        load_meshes(tmp_path)


@pytest.mark.parametrize("suffix", ["stl", "ply", "glb"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01 not a mesh at all", b"solid x\nfacet"])
def test_damaged_files_of_other_formats(tmp_path, suffix, content):
    (tmp_path / f"0.{suffix}").write_bytes(content)
    with pytest.raises(MeshError, match=rf"0\.{suffix}|part 0"):
        load_meshes(tmp_path)


def test_a_face_of_a_ply_file_that_uses_a_vertex_that_is_not_there(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "0.ply").write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    with pytest.raises(MeshError, match="does not exist"):
        load_meshes(tmp_path)


def test_messages_are_one_line(tmp_path):
    (tmp_path / "0.glb").write_bytes(b"garbage")
    with pytest.raises(MeshError) as caught:
        load_meshes(tmp_path)
    assert "\n" not in str(caught.value)


def test_supports_that_are_open_surfaces_get_a_thickness_away_from_their_neighbour(tmp_path, shapes):
    """Whichever way the surface was wound; a part that is no support is refused as before."""
    block = shapes.box((0, 0, 0), (1, 1, 1))
    (tmp_path / "0.obj").write_text(obj_text(block))
    for loop in ("1 2 3 4", "4 3 2 1"):
        (tmp_path / "1.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf {loop}\n")
        with pytest.warns(RepairWarning, match=r"open surfaces \(1, the first is part 1\)"):
            _, sheet = load_meshes(tmp_path, supports=[1])
        assert sheet.bounds[:, 2] == pytest.approx([-np.sqrt(2) / 100, 0])
        assert sheet.volume == pytest.approx(np.sqrt(2) / 100)
        with pytest.raises(MeshError, match="part 1 is not closed"):
            load_meshes(tmp_path, supports=["0"])

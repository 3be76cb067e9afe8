"""Short files that would grow to any size in memory are refused before they do."""

from __future__ import annotations

import json
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import load_structure
from falsework.cli.arguments import read_states
from falsework.errors import InputError, MeshError
from falsework.geometry import load_meshes
from falsework.geometry.mesh.bounds import LARGEST_POLYGON, check_growth
from falsework.geometry.mesh.polygon import triangulate

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="<f4")
FACES = np.array([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3], dtype="<u2")


def document(points: np.ndarray = POINTS, faces: np.ndarray = FACES) -> tuple[dict[str, Any], bytes]:
    """JSON and data of a GLB file with one mesh."""
    kind = {"<u2": 5123, "<u4": 5125}[faces.dtype.str]
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3"},
            {"bufferView": 1, "componentType": kind, "count": len(faces), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": faces.nbytes},
        ],
        "buffers": [{"byteLength": points.nbytes + faces.nbytes}],
    }, points.tobytes() + faces.tobytes()


def write_glb(path: Path, content: dict[str, Any], data: bytes) -> Path:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def many() -> tuple[dict[str, Any], bytes]:
    """A mesh of 20,000 corners."""
    faces = (FACES.astype("<u4") + 4 * np.arange(5000, dtype="<u4")[:, None]).ravel()
    return document(np.tile(POINTS, (5000, 1)), faces)


def instances() -> tuple[dict[str, Any], bytes]:
    content, data = many()
    content["nodes"] = [{"mesh": 0, "name": f"part {number}"} for number in range(2000)]
    content["scenes"][0]["nodes"] = list(range(2000))
    return content, data


def primitives() -> tuple[dict[str, Any], bytes]:
    content, data = many()
    content["meshes"][0]["primitives"] *= 2000
    return content, data


def zeros() -> tuple[dict[str, Any], bytes]:
    """An array that is not in the file: the standard says it is zeros."""
    content, data = document()
    content["accessors"][0] = {"componentType": 5126, "count": 300_000_000, "type": "VEC3"}
    return content, data


def claims() -> tuple[dict[str, Any], bytes]:
    content, data = document()
    content["accessors"][1]["count"] = 1 << 40
    return content, data


@pytest.mark.parametrize("make", [instances, primitives, zeros, claims])
def test_glb_that_grows(make: Callable[[], tuple[dict[str, Any], bytes]], tmp_path: Path) -> None:
    path = write_glb(tmp_path / "model.glb", *make())
    assert path.stat().st_size < 1_000_000
    tracemalloc.start()
    try:
        with pytest.raises(MeshError, match=r"model.glb grows to \d+ corners and triangles, at most"):
            load_structure(path)
        assert tracemalloc.get_traced_memory()[1] < 60e6  # trimesh itself, when first imported, takes half of it
    finally:
        tracemalloc.stop()


def test_data_beside_a_file_count(tmp_path: Path) -> None:
    """A file whose arrays are in another may be as large as both; a node that is below others many times is copies."""
    path, beside = tmp_path / "model.gltf", tmp_path / "data.bin"
    content, data = many()
    content["buffers"][0]["uri"] = beside.name
    content["nodes"] = [{"children": [1] * 200}, {"mesh": 0}]
    path.write_text(json.dumps(content))
    beside.write_bytes(data)
    most = 4_000_000 + path.stat().st_size + beside.stat().st_size
    with pytest.raises(MeshError, match=f"grows to 16000000 corners and triangles, at most {most} are"):
        load_meshes(path)


def test_copies_of_usual_size_are_read(tmp_path: Path) -> None:
    content, data = document()
    content["nodes"] = [{"mesh": 0, "name": str(k), "translation": [0, k, 0]} for k in range(2)]
    content["scenes"][0]["nodes"] = [0, 1]
    assert len(load_meshes(write_glb(tmp_path / "model.glb", content, data))) == 2


def test_bounds_follow_from_the_size_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(1000))
    check_growth(path, 4_001_000)
    with pytest.raises(MeshError, match=r"grows to 4001001 corners .*at most 4001000.*fewer copies"):
        check_growth(path, 4_001_001)


def nested(depth: int) -> str:
    """Models of bricks, each with two of the next."""
    line = "1 1 0 0 0 1 0 0 0 1 0 0 0 1 "
    models = [f"0 FILE m{k}\n" + f"{line}m{k + 1}\n" * 2 for k in range(depth)]
    return "".join([*models, f"0 FILE m{depth}\n{line}3001.dat\n"])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("wide.txt", "99999x99999 (0,0,0)\n", "more than 4000 bricks or 200000 studs"),
        ("many.txt", "1x1 (0,0,0)\n" * 4001, "more than 4000 bricks"),
        ("doubling.mpd", nested(30), "more than 4000 bricks"),
        ("deep.mpd", nested(2000), "nested deeper than 32"),
    ],
)
def test_bricks(name: str, content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        load_structure(tmp_path / name)


def test_blocks_in_blocks_of_rhino(tmp_path: Path) -> None:
    rhino3dm = pytest.importorskip("rhino3dm", reason="needs rhino3dm; pip install 'falsework[rhino]'")
    model = rhino3dm.File3dm()
    model.Settings.ModelUnitSystem = rhino3dm.UnitSystem.Meters
    mesh = rhino3dm.Mesh()
    for corner in POINTS.tolist():
        mesh.Vertices.Add(*corner)
    for face in FACES.reshape(-1, 3).tolist():
        mesh.Faces.AddFace(*face)
    origin, still = rhino3dm.Point3d(0, 0, 0), rhino3dm.Transform(1.0)
    inner: Any = mesh
    for level in range(30):
        attributes = (rhino3dm.ObjectAttributes(), rhino3dm.ObjectAttributes())
        index = model.InstanceDefinitions.Add(f"b{level}", "", "", "", origin, (inner, inner), attributes)
        inner = rhino3dm.InstanceReference(model.InstanceDefinitions[index].Id, still)
    model.Objects.Add(inner)
    path = tmp_path / "model.3dm"
    assert model.Write(str(path), 7)
    with pytest.raises(MeshError, match=r"model.3dm grows to \d+ corners"):
        load_structure(path)


def test_polygons_with_many_corners(tmp_path: Path) -> None:
    def circle(count: int) -> np.ndarray:
        angle = np.arange(count) * (2 * np.pi / count)
        return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])

    assert len(triangulate(circle(LARGEST_POLYGON))) == LARGEST_POLYGON - 2
    with pytest.raises(MeshError, match=r"a face has 2001 corners.*cut it into triangles"):
        triangulate(circle(LARGEST_POLYGON + 1))


def test_states_that_are_not_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "states.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|i1", "fortran_order": False, "shape": (1 << 31, 7)})
    with pytest.raises(InputError, match=r"states.npy cannot be read"):
        read_states(path)
    np.save(path, np.ones((2, 3), dtype=np.int8))
    assert read_states(path).tolist() == [[1, 1, 1]] * 2

"""Every row of the tables under "What is read" in docs/files.md: what becomes of the contents of files.

Each row has a case here that makes a file with that content and says what the structure must be. The last column of
the row is compared with what happens: `used` and `left alone` without a warning, `warned` with one, `refused`.
"""

from __future__ import annotations

import base64
import ctypes
import json
import re
import struct
import uuid
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, export, load_structure
from falsework.errors import InputError, ReadWarning

PAGE = Path(__file__).resolve().parents[2] / "docs" / "files.md"
TREATMENTS = ("used", "left alone", "warned", "refused")

Box = tuple[Sequence[float], Sequence[float]]
LOW: Box = ((0, 0, 0), (1, 1, 1))
HIGH: Box = ((0, 0, 1), (1, 1, 2))
SIDE: Box = ((1, 0, 1), (1.6, 1, 2))
FAR: Box = ((3, 0, 0), (4, 1, 1))
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
"""Faces of a box whose corners run through x, then y, then z."""


def corners(box: Box) -> list[tuple[float, ...]]:
    low, high = box
    return [tuple((low, high)[bit][axis] for axis, bit in enumerate((n & 1, n >> 1 & 1, n >> 2))) for n in range(8)]


def triangles(quads: Sequence[Sequence[int]] = QUADS) -> list[tuple[int, int, int]]:
    return [piece for a, b, c, d in quads for piece in ((a, b, c), (a, c, d))]


@dataclass(frozen=True)
class Case:
    """A structure to load, and what is expected of it."""

    path: Path | str
    parts: tuple[str, ...] | None = None
    """Names of the parts."""
    says: str = ""
    """Pattern of the warning or the refusal."""
    check: Callable[[Assembly], bool] = lambda assembly: True
    ground: bool = True
    boundary: tuple[str, ...] | None = None


CASES: dict[tuple[str, str], Callable[[Path], Case]] = {}


def case(section: str, content: str) -> Callable[[Callable[[Path], Case]], Callable[[Path], Case]]:
    """Register the case of a row."""

    def register(make: Callable[[Path], Case]) -> Callable[[Path], Case]:
        assert (section, content) not in CASES
        CASES[section, content] = make
        return make

    return register


def rows() -> list[tuple[str, str, str]]:
    """Return section, content and treatment of every row of the page."""
    page = PAGE.read_text(encoding="utf-8").split("\n## What is read\n")[1].split("\n## ")[0]
    found = []
    for section in page.split("\n### ")[1:]:
        title, *lines = section.splitlines()
        for line in lines:
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if line.startswith("| ") and cells[-1] in TREATMENTS:
                found.append((title, cells[0], cells[-1]))
    return found


def test_every_row_has_a_case_and_every_case_a_row() -> None:
    assert len(rows()) == len({row[:2] for row in rows()})
    assert {row[:2] for row in rows()} == set(CASES)


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize(("section", "content", "treatment"), rows(), ids=[f"{a}: {b}" for a, b, _ in rows()])
def test_what_becomes_of(
    section: str, content: str, treatment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    case = CASES[section, content](tmp_path)
    options: dict[str, Any] = {"boundary": list(case.boundary)} if case.boundary else {"ground": case.ground or None}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            assembly, refusal = load_structure(case.path, **options), ""
        except InputError as error:
            assembly, refusal = None, str(error)
    said = [str(warning.message) for warning in caught if issubclass(warning.category, ReadWarning)]
    happened = "refused" if assembly is None else "warned" if said else treatment
    assert happened == treatment, refusal or said
    if treatment in ("warned", "refused"):
        assert case.says, "a case that is told says what is told"
        assert any(re.search(case.says, text) for text in [*said, refusal]), [*said, refusal]
        assert "\n" not in refusal
    if assembly is not None:
        names = tuple(name for name in assembly.names if name not in ("ground", "baseplate"))
        assert case.parts is None or names == case.parts
        assert case.check(assembly)


# OBJ ---------------------------------------------------------------------------------------------------------------


def obj(path: Path, *lines: str | Box) -> Path:
    """Write lines, and boxes with vertices of their own."""
    text, first = [], 1
    for line in lines:
        if isinstance(line, str):
            text.append(line)
            continue
        text += [f"v {x} {y} {z}" for x, y, z in corners(line)]
        text += ["f " + " ".join(str(first + corner) for corner in quad) for quad in QUADS]
        first += 8
    path.write_text("\n".join(text) + "\n")
    return path


def volumes(*expected: float) -> Callable[[Assembly], bool]:
    return lambda assembly: bool(np.allclose(assembly.mass.volume[: len(expected)], expected))


@case("OBJ", "objects")
def _(folder: Path) -> Case:
    return Case(obj(folder / "a.obj", "o z", LOW, "o a", HIGH), ("z", "a"), check=volumes(1, 1))


@case("OBJ", "groups without objects")
def _(folder: Path) -> Case:
    return Case(obj(folder / "a.obj", "g z", LOW, "g a", HIGH), ("z", "a"), check=volumes(1, 1))


@case("OBJ", "groups of faces of one solid")
def _(folder: Path) -> Case:
    faces = ["f " + " ".join(str(corner + 1) for corner in quad) for quad in QUADS]
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners(LOW)), "g sides", *faces[:4], "g ends", *faces[4:]]
    return Case(obj(folder / "a.obj", *lines), ("0",), "groups were left out.*: sides, ends", volumes(1))


@case("OBJ", "several objects of one name")
def _(folder: Path) -> Case:
    path = obj(folder / "a.obj", "o brick", LOW, "o brick", HIGH, "o brick", SIDE)
    return Case(path, ("brick", "brick-2", "brick-3"), "3 objects are called brick", volumes(1, 1, 0.6))


@case("OBJ", "open surfaces of one name, which enclose space together")
def _(folder: Path) -> Case:
    faces = ["f " + " ".join(str(corner + 1) for corner in quad) for quad in QUADS]
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners(LOW)), "o brick", *faces[:3], "o brick", *faces[3:]]
    return Case(obj(folder / "a.obj", *lines), ("brick",), "2 open surfaces called brick were joined", volumes(1))


@case("OBJ", "objects of one name that share the face which both lack")
def _(folder: Path) -> Case:
    lines = [*(f"v {x} {y} {z}" for box in (LOW, HIGH) for x, y, z in corners(box))]
    for first, lacking in ((1, 1), (9, 0)):
        faces = [quad for number, quad in enumerate(QUADS) if number != lacking]
        lines += ["o brick", *("f " + " ".join(str(first + corner) for corner in quad) for quad in faces)]
    return Case(obj(folder / "a.obj", *lines), ("brick", "brick-2"), "2 objects are called brick", check=volumes(1, 1))


@case("OBJ", "an object of several separate solids")
def _(folder: Path) -> Case:
    path = obj(folder / "a.obj", "o wall", LOW, SIDE, "o top", HIGH)
    return Case(path, ("wall-0", "wall-1", "top"), "object wall has 2 separate solids", volumes(1, 0.6, 1))


@case("OBJ", "blocks without objects")
def _(folder: Path) -> Case:
    return Case(obj(folder / "a.obj", LOW, HIGH, SIDE), ("0", "1", "2"), check=volumes(1, 1, 0.6))


@case("OBJ", "solids that share edges and cannot be told apart")
def _(folder: Path) -> Case:
    lines = [f"v {x} {y} {z}" for x, y, z in [*corners(LOW), (0.5, 3, 0.5)]]
    lines += ["f " + " ".join(str(corner + 1) for corner in quad) for quad in QUADS]
    return Case(obj(folder / "a.obj", *lines, "f 1 5 9"), says="do not show where one part ends")


@case("OBJ", "concave polygons")
def _(folder: Path) -> Case:
    outline = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)]
    lines = [f"v {x} {y} {z}" for z in (0, 1) for x, y in outline]
    lines += ["f " + " ".join(map(str, range(8, 0, -1))), "f " + " ".join(map(str, range(9, 17)))]
    lines += [f"f {i + 1} {(i + 1) % 8 + 1} {(i + 1) % 8 + 9} {i + 9}" for i in range(8)]
    return Case(obj(folder / "a.obj", *lines), ("0",), check=volumes(7))


@case("OBJ", "lines and points")
def _(folder: Path) -> Case:
    return Case(obj(folder / "a.obj", LOW, "l 1 2", "p 1"), ("0",), "were left out: 1 of 'l', 1 of 'p'")


@case("OBJ", "free-form surfaces")
def _(folder: Path) -> Case:
    return Case(obj(folder / "a.obj", LOW, "surf 0 1 0 1 1 2 3 4"), says="line 15 of .* is 'surf'")


@case("OBJ", "materials, textures, normals")
def _(folder: Path) -> Case:
    return Case(obj(folder / "a.obj", "mtllib a.mtl", "usemtl red", "s off", "vt 0 0", "vn 0 0 1", LOW), ("0",))


@case("OBJ", "a unit in a comment, also behind a statement")
def _(folder: Path) -> Case:
    path = obj(folder / "a.obj", "s off  # File units = inches", LOW)
    return Case(path, ("0",), "the unit is in; it was read so", volumes(0.0254**3))


@case("OBJ", "names that are not in UTF-8")
def _(folder: Path) -> Case:
    path = obj(folder / "a.obj", "o S\u00e4ule", LOW, "o St\u00fctze", HIGH)
    path.write_bytes(path.read_text(encoding="utf-8").encode("cp1252"))
    return Case(path, ("S\u00e4ule", "St\u00fctze"), "it is not in UTF-8; names were read as Western text")


@case("OBJ", "text in UTF-16")
def _(folder: Path) -> Case:
    path = obj(folder / "a.obj", LOW)
    path.write_bytes(path.read_text().encode("utf-16"))
    return Case(path, says="it is no text in UTF-8; save it as UTF-8")


# STL ---------------------------------------------------------------------------------------------------------------


def stl(path: Path, *solids: tuple[str, Sequence[Box]]) -> Path:
    lines = []
    for name, boxes in solids:
        lines.append(f"solid {name}")
        for box in boxes:
            points = corners(box)
            for face in triangles():
                lines += ["facet normal 0 0 0", "outer loop"]
                lines += ["vertex {} {} {}".format(*points[corner]) for corner in face]
                lines += ["endloop", "endfacet"]
        lines.append(f"endsolid {name}")
    path.write_text("\n".join(lines) + "\n")
    return path


def binary_stl(path: Path, *boxes: Box, header: bytes = b"", attribute: int = 0) -> Path:
    content = b""
    for box in boxes:
        points = corners(box)
        for face in triangles():
            flat = [value for corner in face for value in points[corner]]
            content += struct.pack("<12fH", 0, 0, 0, *flat, attribute)
    path.write_bytes(header.ljust(80, b"\0") + struct.pack("<I", 12 * len(boxes)) + content)
    return path


@case("STL", "several named solids")
def _(folder: Path) -> Case:
    return Case(stl(folder / "a.stl", ("z", [LOW]), ("a", [HIGH])), ("z", "a"))


@case("STL", "several solids of one name")
def _(folder: Path) -> Case:
    path = stl(folder / "a.stl", ("export", [LOW]), ("export", [HIGH]))
    return Case(path, ("export", "export-2"), "2 objects are called export")


@case("STL", "a binary file of touching blocks")
def _(folder: Path) -> Case:
    return Case(binary_stl(folder / "a.stl", LOW, HIGH, SIDE), ("0", "1", "2"))


@case("STL", "a named solid of touching blocks")
def _(folder: Path) -> Case:
    path = stl(folder / "a.stl", ("export", [LOW, HIGH, SIDE]))
    return Case(path, ("export-0", "export-1", "export-2"), "object export has 3 separate solids")


@case("STL", "normals and colours")
def _(folder: Path) -> Case:
    return Case(binary_stl(folder / "a.stl", LOW, attribute=0x7FFF), ("0",), check=volumes(1))


@case("STL", "a unit in the header")
def _(folder: Path) -> Case:
    return Case(binary_stl(folder / "a.stl", LOW, header=b"UNITS=mm"), ("0",), "unit is mm", volumes(1e-9))


@case("STL", "a unit in the name of a solid")
def _(folder: Path) -> Case:
    return Case(stl(folder / "a.stl", ("export unit=mm", [LOW])), ("export unit=mm",), "unit is mm", volumes(1e-9))


@case("STL", "open surfaces of one name, which enclose space together")
def _(folder: Path) -> Case:
    path = stl(folder / "a.stl", ("brick", [LOW]))
    head, *facets = path.read_text().split("facet normal")
    halves = head + "facet normal".join(["", *facets[:6]]), head + "facet normal".join(["", *facets[6:]])
    path.write_text(halves[0] + "endsolid brick\n" + halves[1])
    return Case(path, ("brick",), "2 open surfaces called brick were joined into one part", volumes(1))


@case("STL", "a byte order mark, and newlines of any system")
def _(folder: Path) -> Case:
    path = stl(folder / "a.stl", ("a", [LOW]), ("b", [HIGH]))
    path.write_bytes(path.read_text().replace("\n", "\r").encode("utf-8-sig"))
    return Case(path, ("a", "b"), check=volumes(1, 1))


@case("STL", "a binary file of another length than it says")
def _(folder: Path) -> Case:
    (folder / "a.stl").write_bytes(b"solid binary".ljust(80) + struct.pack("<I", 12) + bytes(50 * 11))
    return Case(folder / "a.stl", says="neither text that begins with 'solid' nor as long as its number of facets says")


@case("STL", "text that is damaged")
def _(folder: Path) -> Case:
    path = stl(folder / "a.stl", ("a", [LOW]))
    path.write_text(path.read_text().replace("vertex 0 0 0", "vertex 0 0 zero", 1))
    return Case(path, says=r"cannot read line \d+ of .*a\.stl: 'vertex 0 0 zero'")


# PLY ---------------------------------------------------------------------------------------------------------------


def ply(path: Path, *boxes: Box, header: str = "", face: str = "", tail: str = "", data: str = "") -> Path:
    points = [point for box in boxes for point in corners(box)]
    lines = ["ply", "format ascii 1.0", *header.splitlines(), f"element vertex {len(points)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {6 * len(boxes)}", "property list uchar int vertex_indices", *face.splitlines()]
    lines += [*tail.splitlines(), "end_header", *(" ".join(map(str, point)) for point in points)]
    for number in range(len(boxes)):
        for quad in QUADS:
            lines.append("4 " + " ".join(str(8 * number + corner) for corner in quad) + " 7" * len(face.splitlines()))
    path.write_text("\n".join([*lines, data]) + "\n")
    return path


@case("PLY", "touching blocks")
def _(folder: Path) -> Case:
    return Case(ply(folder / "a.ply", LOW, HIGH, SIDE), ("0", "1", "2"), check=volumes(1, 1, 0.6))


@case("PLY", "a byte order mark, and newlines of any system")
def _(folder: Path) -> Case:
    path = ply(folder / "a.ply", LOW, HIGH)
    path.write_bytes(path.read_text().replace("\n", "\r").encode("utf-8-sig"))
    return Case(path, ("0", "1"), check=volumes(1, 1))


@case("PLY", "concave polygons")
def _(folder: Path) -> Case:
    outline = [(0, 0), (3, 0), (3, 1), (1, 1), (1, 2), (3, 2), (3, 3), (0, 3)]
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 16\n" + "".join(f"property float {a}\n" for a in "xyz")
    head += "element face 10\nproperty list uchar ushort vertex_index\nend_header\n"
    faces = [range(7, -1, -1), range(8, 16), *((i, (i + 1) % 8, (i + 1) % 8 + 8, i + 8) for i in range(8))]
    content = b"".join(struct.pack(">3f", x, y, z) for z in (0, 1) for x, y in outline)
    content += b"".join(struct.pack(f">B{len(face)}H", len(face), *face) for face in faces)
    (folder / "a.ply").write_bytes(head.encode() + content)
    return Case(folder / "a.ply", ("0",), check=volumes(7))


@case("PLY", "colours and normals")
def _(folder: Path) -> Case:
    return Case(ply(folder / "a.ply", LOW, face="property uchar red\nproperty uchar blue"), ("0",))


@case("PLY", "properties of faces that are not known")
def _(folder: Path) -> Case:
    return Case(ply(folder / "a.ply", LOW, face="property int part_id"), ("0",), "faces were left out: part_id")


@case("PLY", "elements beside vertices and faces")
def _(folder: Path) -> Case:
    path = ply(folder / "a.ply", LOW, tail="element edge 1\nproperty int vertex1\nproperty int vertex2", data="0 1")
    return Case(path, ("0",), "left out: 1 of 'edge'")


@case("PLY", "triangle strips")
def _(folder: Path) -> Case:
    path = ply(folder / "a.ply", LOW, tail="element tristrips 1\nproperty list int int vertex_indices", data="3 0 1 2")
    return Case(path, says="has triangle strips")


@case("PLY", "more data than the header says")
def _(folder: Path) -> Case:
    path = ply(folder / "a.ply", LOW, HIGH)
    path.write_text(path.read_text().replace("element face 12", "element face 6"))
    return Case(path, says="has more data than its header says, such as further faces")


@case("PLY", "an element, a property or the corners of faces given twice")
def _(folder: Path) -> Case:
    other = "property list uchar int vertex_index"
    path = ply(folder / "a.ply", LOW, face=other)
    path.write_text(re.sub(r"^(4 .*) 7$", r"\1 0", path.read_text(), flags=re.MULTILINE))
    return Case(path, says="has corners of faces twice, so that one of them would be lost")


@case("PLY", "a unit in a comment")
def _(folder: Path) -> Case:
    return Case(ply(folder / "a.ply", LOW, header="comment unit: cm"), ("0",), "unit is cm", volumes(1e-6))


# glTF --------------------------------------------------------------------------------------------------------------


class Gltf:
    """glTF file in the making, with y up: a cube of one metre about the origin as mesh 0."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}]}
        for name in ("nodes", "meshes", "accessors", "bufferViews"):
            self.json[name] = []
        self.points = self.accessor(np.array(corners(((-0.5,) * 3, (0.5,) * 3)), "<f4"), 5126, "VEC3")
        self.mesh(triangles())

    def accessor(self, values: np.ndarray, component: int, kind: str) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += values.tobytes()
        view = len(self.json["bufferViews"]) - 1
        entry = {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        self.json["accessors"].append(entry)
        return len(self.json["accessors"]) - 1

    def primitive(self, faces: Any, **more: Any) -> dict[str, Any]:
        indices = self.accessor(np.array(faces, "<u2").ravel(), 5123, "SCALAR")
        return {"attributes": {"POSITION": self.points}, "indices": indices, **more}

    def mesh(self, *pieces: Any, **more: Any) -> int:
        self.json["meshes"].append({"primitives": [self.primitive(faces) for faces in pieces], **more})
        return len(self.json["meshes"]) - 1

    def node(self, up: float, name: str = "", mesh: int = 0, *, root: bool = True, **more: Any) -> int:
        self.json["nodes"].append({"mesh": mesh, "translation": [0, up, 0], **({"name": name} if name else {}), **more})
        if root:
            self.json["scenes"][0]["nodes"].append(len(self.json["nodes"]) - 1)
        return len(self.json["nodes"]) - 1

    def write(self, path: Path, uri: str = "", **more: Any) -> Path:
        content = {**self.json, **more, "buffers": [{"byteLength": len(self.data), **({"uri": uri} if uri else {})}]}
        text = json.dumps(content).encode()
        if path.suffix == ".gltf":
            path.write_bytes(text)
            return path
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
        return path


def stack() -> Gltf:
    """A cube named `z` on the ground, and one named `a` on it."""
    gltf = Gltf()
    gltf.node(0.5, "z")
    gltf.node(1.5, "a")
    return gltf


@case("glTF", "nodes with meshes, moved, turned, mirrored and scaled")
def _(folder: Path) -> Case:
    gltf = Gltf()
    top = gltf.node(1, "top", root=False, scale=[-1, 1, 1])
    gltf.node(1, "base", scale=[2, 2, 2], rotation=[0, np.sin(np.pi / 4), 0, np.cos(np.pi / 4)], children=[top])

    def heights(found: Assembly) -> bool:
        return bool(np.allclose(found.mass.center[:2, 2], [1, 3]))

    return Case(gltf.write(folder / "a.glb"), ("base", "top"), check=lambda a: heights(a) and volumes(8, 8)(a))


@case("glTF", "several nodes with one mesh")
def _(folder: Path) -> Case:
    gltf = Gltf()
    for level in range(3):
        gltf.node(level + 0.5)
    return Case(gltf.write(folder / "a.glb"), ("0", "1", "2"), check=volumes(1, 1, 1))


@case("glTF", "a mesh of several primitives")
def _(folder: Path) -> Case:
    gltf = Gltf()
    gltf.node(0.5, "base")
    gltf.node(1.5, "top", gltf.mesh(triangles()[:2], triangles()[2:]))
    return Case(gltf.write(folder / "a.glb"), ("base", "top"), check=volumes(1, 1))


@case("glTF", "strips and fans of triangles")
def _(folder: Path) -> Case:
    gltf = Gltf()
    strips = [gltf.primitive([a, b, d, c], mode=5) for a, b, c, d in QUADS[:3]]
    fans = [gltf.primitive(quad, mode=6) for quad in QUADS[3:]]
    gltf.json["meshes"].append({"primitives": strips + fans})
    gltf.node(0.5, "base", 1)
    return Case(gltf.write(folder / "a.glb"), ("base",), check=volumes(1))


@case("glTF", "several nodes of one name")
def _(folder: Path) -> Case:
    gltf = Gltf()
    gltf.node(0.5, "brick")
    gltf.node(1.5, "brick")
    return Case(gltf.write(folder / "a.glb"), ("brick", "brick-2"), "2 objects are called brick")


@case("glTF", "hidden nodes")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.node(2.5, "ghost", extensions={"KHR_node_visibility": {"visible": False}})
    path = gltf.write(folder / "a.glb", extensionsUsed=["KHR_node_visibility"])
    return Case(path, ("z", "a"), "hidden nodes were left out: ghost")


@case("glTF", "nodes scaled to nothing")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.node(2.5, "ghost", scale=[0, 0, 0])
    return Case(gltf.write(folder / "a.glb"), ("z", "a"), "scaled to nothing were left out: ghost")


@case("glTF", "nodes outside the scene")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.node(2.5, "ghost", root=False)
    return Case(gltf.write(folder / "a.glb"), ("z", "a"), "not in scene 0 were left out: ghost")


@case("glTF", "points and lines")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.json["meshes"][0]["primitives"].append(gltf.primitive([0, 1], mode=1))
    return Case(gltf.write(folder / "a.glb"), ("z", "a"), "points and lines were left out: 1")


@case("glTF", "animations")
def _(folder: Path) -> Case:
    return Case(stack().write(folder / "a.glb", animations=[{"channels": []}]), ("z", "a"), "parts are read at rest")


@case("glTF", "skins")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.node(2.5, "bent", skin=0)
    return Case(gltf.write(folder / "a.glb"), says="node bent is deformed by a skin")


@case("glTF", "morph targets that act")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.node(2.5, "bent", weights=[0.5])
    return Case(gltf.write(folder / "a.glb"), says="node bent is deformed by morph targets")


@case("glTF", "extensions that may change shapes")
def _(folder: Path) -> Case:
    path = stack().write(folder / "a.glb", extensionsUsed=["KHR_draco_mesh_compression", "KHR_materials_unlit"])
    return Case(path, says="it uses KHR_draco_mesh_compression, which")


@case("glTF", "such extensions that the file uses and does not declare")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.json["nodes"][1]["extensions"] = {"EXT_mesh_gpu_instancing": {}}
    return Case(gltf.write(folder / "a.glb"), says="it uses EXT_mesh_gpu_instancing, which may change")


@case("glTF", "a version after 2.0 that is needed")
def _(folder: Path) -> Case:
    path = stack().write(folder / "a.glb", asset={"version": "2.0", "minVersion": "2.1"})
    return Case(path, says=r"its version of glTF is 2\.1, not 2\.0")


@case("glTF", "values beyond the end of their view")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.json["bufferViews"][gltf.json["accessors"][gltf.points]["bufferView"]]["byteLength"] -= 12
    return Case(gltf.write(folder / "a.glb"), says=r"the 8 values of accessors\[0\] go beyond the end of their view")


@case("glTF", "blank names")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.json["nodes"][1]["name"] = " "
    return Case(gltf.write(folder / "a.glb"), ("z", "1"))


@case("glTF", "rotations and matrices that are none")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.json["nodes"][1]["rotation"] = [0, 0.6, 0, 0.6]
    return Case(gltf.write(folder / "a.glb"), says=r"nodes\[1\]\.rotation is no unit quaternion")


@case("glTF", "data in a file beside it, also with an encoded name")
def _(folder: Path) -> Case:
    gltf = stack()
    (folder / "my part.bin").write_bytes(gltf.data)
    return Case(gltf.write(folder / "a.gltf", "./my%20part.bin"), ("z", "a"), check=volumes(1, 1))


@case("glTF", "data elsewhere")
def _(folder: Path) -> Case:
    gltf = stack()
    (folder.parent / "a.bin").write_bytes(gltf.data)
    return Case(
        gltf.write(folder / "a.gltf", "../a.bin"), says=r"its data are in '\.\./a\.bin', which is no file beside"
    )


@case("glTF", "numbers, boundary, density, friction and the name of the structure as falsework writes them")
def _(folder: Path) -> Case:
    arch = load_structure("arch:blocks=5", density=1800.0, friction=0.7)
    export(arch, folder / "a.gltf")

    def same(found: Assembly) -> bool:
        alike = np.array_equal(found.boundary, arch.boundary) and np.array_equal(found.density, arch.density)
        alike &= (found.name, found.friction) == (arch.name, 0.7)
        return alike and np.allclose(found.mass.center, arch.mass.center, atol=1e-6)

    return Case(folder / "a.gltf", arch.names, check=same, ground=False)


@case("glTF", "such numbers with a gap, or given twice")
def _(folder: Path) -> Case:
    gltf = Gltf()
    gltf.node(0.5, "z", extras={"part": 0, "boundary": True})
    gltf.node(1.5, "a", extras={"part": 2})
    path = gltf.write(folder / "a.glb")
    return Case(path, ("z", "a"), "numbers that are not 0 to 1, so these are left out: z 0, a 2", ground=False)


@case("glTF", "boundary and density without a number")
def _(folder: Path) -> Case:
    gltf = Gltf()
    gltf.node(0.5, "z", extras={"boundary": True})
    gltf.node(1.5, "a")

    def free(found: Assembly) -> bool:
        return found.boundary.tolist() == [False, False, True]

    return Case(gltf.write(folder / "a.glb"), ("z", "a"), "count only beside the number of a part", free)


@case("glTF", "a plan in motion")
def _(folder: Path) -> Case:
    return Case(stack().write(folder / "a.glb", extras={"plan": {}}), says="shows a plan in motion")


@case("glTF", "materials, cameras and lights")
def _(folder: Path) -> Case:
    gltf = stack()
    gltf.json["nodes"].append({"camera": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}})
    gltf.json["scenes"][0]["nodes"].append(2)
    path = gltf.write(folder / "a.gltf", "data:;base64," + base64.b64encode(gltf.data).decode(),
                      materials=[{}], cameras=[{}], extensionsUsed=["KHR_lights_punctual"])  # fmt: skip
    return Case(path, ("z", "a"))


# Folder and assembly.json ------------------------------------------------------------------------------------------


def pair(folder: Path, **described: Any) -> Path:
    """Write two blocks on each other as a folder, with entries for `assembly.json`."""
    place = folder / "pair"
    place.mkdir()
    obj(place / "a.obj", LOW)
    obj(place / "b.obj", HIGH)
    if described:
        (place / "assembly.json").write_text(json.dumps(described))
    return place


@case("Folder", "one file for each part")
def _(folder: Path) -> Case:
    return Case(pair(folder), ("a", "b"))


@case("Folder", "a file with several separate solids")
def _(folder: Path) -> Case:
    place = pair(folder)
    obj(place / "b.obj", "o high", HIGH, "o far", FAR)
    return Case(place, ("a", "b"), "part b consists of 2 separate solids, which count as one", volumes(1, 2))


@case("Folder", "files whose names begin with a dot")
def _(folder: Path) -> Case:
    place = pair(folder)
    (place / "._a.obj").write_bytes(b"\0\5\26\7")
    obj(place / ".backup.obj", FAR)
    return Case(place, ("a", "b"))


@case("Folder", "files of other formats, or a folder with meshes")
def _(folder: Path) -> Case:
    place = pair(folder)
    (place / "roof.3dm").write_bytes(b"3D Geometry File Format")
    (place / "more").mkdir()
    obj(place / "more" / "c.obj", FAR)
    return Case(place, ("a", "b"), r"were left out: roof\.3dm, more/")


@case("Folder", "packed files, copies such as `1.obj.bak`, meshes in deeper folders")
def _(folder: Path) -> Case:
    place = pair(folder)
    for name in ("c.obj.gz", "d.obj.bak", "e.zip"):
        (place / name).write_bytes(b"")
    (place / "more" / "deep").mkdir(parents=True)
    obj(place / "more" / "deep" / "f.obj", FAR)
    return Case(place, ("a", "b"), r"left out: c\.obj\.gz, d\.obj\.bak, e\.zip, more/")


@case("Folder", "a link that leads nowhere, or a folder, with the name of a mesh")
def _(folder: Path) -> Case:
    place = pair(folder)
    (place / "c.obj").symlink_to(folder / "gone.obj")
    return Case(place, says=r"c\.obj is a link that leads nowhere, not the mesh of a part")


@case("Folder", "numbers as names, with a gap")
def _(folder: Path) -> Case:
    obj(folder / "0.obj", LOW)
    obj(folder / "2.obj", HIGH)
    return Case(folder, ("0", "2"), "there is no part 1: the 2 parts are numbered")


@case("Folder", "one name in two formats")
def _(folder: Path) -> Case:
    place = pair(folder)
    ply(place / "b.ply", HIGH)
    return Case(place, says="part 'b' occurs 2 times")


@case("Folder", "a folder named like a built-in structure")
def _(folder: Path) -> Case:
    pair(folder).rename(folder / "wall")
    return Case("wall", ("a", "b"), "wall is a folder or file here, which is read, and .*, which is wall:")


@case("Folder", "all parts as boundary")
def _(folder: Path) -> Case:
    return Case(pair(folder), ("a", "b"), "every part of pair is boundary", boundary=("a", "b"))


def posed(folder: Path, **config: Any) -> Path:
    """Write the blocks of `pair`, the upper one beside its place, with a configuration of poses in centimetres."""
    place = folder / "posed"
    place.mkdir()
    obj(place / "a.obj", ((0, 0, 0), (100, 100, 100)))
    obj(place / "b.obj", ((300, 0, 0), (400, 100, 100)))
    (place / "config.json").write_text(json.dumps(config))
    return place


POSES = {"a": {"final_state": [0, 0, 0]}, "b": {"final_state": [-300, 0, 100]}}


def upper_at(low: float) -> Callable[[Assembly], bool]:
    return lambda assembly: np.allclose(assembly.meshes[1].bounds[0], (0, 0, low))


@case(
    "Poses beside meshes", "`final_state` of a part: a translation, or a translation and angles about fixed x, y and z"
)
def _(folder: Path) -> Case:
    turned = {"final_state": [100, -300, 100, 0, 0, np.pi / 2]}
    place = posed(folder, a={"final_state": [0, 0, 0]}, b=turned)
    return Case(place, ("a", "b"), check=upper_at(1))


@case("Poses beside meshes", "a translation for each part (`translation.json`)")
def _(folder: Path) -> Case:
    place = posed(folder)
    (place / "translation.json").write_text(json.dumps({"a": [0, 0, 0], "b": [-300, 0, 100]}))
    return Case(place, ("a", "b"), check=upper_at(1))


@case("Poses beside meshes", "`initial_state`, and settings such as `contact_eps`")
def _(folder: Path) -> Case:
    poses = {"a": {**POSES["a"], "initial_state": [900, 0, 0]}, "b": POSES["b"], "contact_eps": 0.2}
    return Case(posed(folder, **poses), ("a", "b"), check=upper_at(1))


@case("Poses beside meshes", "parts without a pose beside others")
def _(folder: Path) -> Case:
    return Case(posed(folder, b=POSES["b"]), ("a", "b"), "stay where their meshes are: a", check=upper_at(1))


@case("Poses beside meshes", "poses of parts without a mesh")
def _(folder: Path) -> Case:
    return Case(posed(folder, **POSES, c={"final_state": [0, 0, 0]}), ("a", "b"), "without a mesh have no effect: c")


@case("Poses beside meshes", "orientations of the whole for each step (`pose/`)")
def _(folder: Path) -> Case:
    place = posed(folder, **POSES)
    (place / "pose").mkdir()
    return Case(place, ("a", "b"), "orientations of the whole for each step were left out")


@case("Poses beside meshes", "no fixed part")
def _(folder: Path) -> Case:
    return Case(posed(folder, **POSES), ("a", "b"), "a ground was added under the lowest point", ground=False)


@case("Poses beside meshes", "a pose that is none")
def _(folder: Path) -> Case:
    return Case(posed(folder, **{**POSES, "b": {"final_state": [1, 2]}}), says=r"the pose of part b is \[1, 2\]")


@case("assembly.json", "notes")
def _(folder: Path) -> Case:
    return Case(pair(folder, source="a book", licence="CC0", comment="x"), ("a", "b"))


@case("assembly.json", "unknown entries")
def _(folder: Path) -> Case:
    return Case(pair(folder, gravity=1.6, up="y"), ("a", "b"), "have no effect: gravity, up")


@case("assembly.json", "entries misspelt")
def _(folder: Path) -> Case:
    return Case(pair(folder, frictoin=0.5), says="'frictoin', which is unknown; write 'friction'")


@case("assembly.json", "an entry given twice")
def _(folder: Path) -> Case:
    place = pair(folder)
    (place / "assembly.json").write_text('{"boundary": ["a"], "boundary": ["a", "b"]}')
    return Case(place, says="has the entry 'boundary' twice")


@case("assembly.json", "a byte order mark")
def _(folder: Path) -> Case:
    place = pair(folder)
    (place / "assembly.json").write_text('{"friction": 0.3}', encoding="utf-8-sig")
    return Case(place, ("a", "b"), check=lambda found: found.friction == 0.3)


@case("assembly.json", "names of parts that are empty")
def _(folder: Path) -> Case:
    return Case(pair(folder, names=["low", " "]), says=r"names\[1\] is ' '; give a text that is not blank")


@case("assembly.json", "loads on parts that are boundary")
def _(folder: Path) -> Case:
    loads = [{"part": part, "force": [0, 0, -1]} for part in ("a", "b")]
    return Case(pair(folder, loads=loads), ("a", "b"), "boundary have no effect: a$", boundary=("a",))


@case("assembly.json", "names of parts beside a file that names its parts itself")
def _(folder: Path) -> Case:
    (folder / "assembly.json").write_text('{"names": ["one", "two"]}')
    return Case(compas(folder, mesh(LOW), mesh(HIGH)), says="names its parts itself; leave them out")


@case("assembly.json", "a part by a text that is the name of one and the number of another")
def _(folder: Path) -> Case:
    path = obj(folder / "a.obj", "o 1", LOW, "o top", HIGH)
    return Case(path, says="'1', which is the name of part 0 and the number of part 'top'", boundary=("1",))


# COMPAS ------------------------------------------------------------------------------------------------------------


def compas(folder: Path, *content: Any) -> Path:
    (folder / "model.json").write_text(json.dumps(content if len(content) > 1 else content[0]))
    return folder / "model.json"


def mesh(*boxes: Box, name: str = "", **attributes: Any) -> dict[str, Any]:
    points = [point for box in boxes for point in corners(box)]
    vertex = {str(number): dict(zip("xyz", point, strict=True)) for number, point in enumerate(points)}
    faces = [[8 * block + corner for corner in quad] for block in range(len(boxes)) for quad in QUADS]
    data = {"attributes": attributes, "vertex": vertex, "face": {str(n): face for n, face in enumerate(faces)}}
    return {"dtype": "compas.datastructures/Mesh", "data": data, **({"name": name} if name else {})}


def shape(kind: str, at: Sequence[float], **sizes: float) -> dict[str, Any]:
    frame = {"point": list(at), "xaxis": [1, 0, 0], "yaxis": [0, 1, 0]}
    return {"dtype": f"compas.geometry/{kind}", "data": {**sizes, "frame": frame}}


def element(kind: str = "compas_dem.elements/Block", **data: Any) -> dict[str, Any]:
    return {"dtype": kind, "inheritance": ["compas_model.elements/Element"], "data": data}


def model(elements: dict[str, Any], *placed: str) -> dict[str, Any]:
    tree = {"root": {"children": [{"element": guid} for guid in placed]}}
    return {"dtype": "compas_dem.models/BlockModel", "data": {"elements": elements, "tree": tree}}


@case("COMPAS", "meshes, polyhedra and boxes")
def _(folder: Path) -> Case:
    solid = {"vertices": corners(HIGH), "faces": QUADS}
    box = shape("Box", (0.5, 0.5, 2.5), xsize=1, ysize=1, zsize=1)
    content = mesh(LOW, name="low"), {"dtype": "compas.geometry/Polyhedron", "data": solid}, box
    return Case(compas(folder, *content), ("low", "1", "2"), check=volumes(1, 1, 1))


@case("COMPAS", "blocks in a dictionary")
def _(folder: Path) -> Case:
    return Case(compas(folder, {"low": mesh(LOW), "high": mesh(HIGH, name="top")}), ("low", "top"))


@case("COMPAS", "frames whose axes are no unit vectors")
def _(folder: Path) -> Case:
    box = shape("Box", (0.5, 0.5, 1.5), xsize=1, ysize=1, zsize=1)
    box["data"]["frame"] |= {"xaxis": [2, 0, 0], "yaxis": [1, 3, 0]}
    return Case(compas(folder, mesh(LOW), box), ("0", "1"), check=volumes(1, 1))


@case("COMPAS", "corners that are not three numbers")
def _(folder: Path) -> Case:
    wrong = [mesh(HIGH) for _ in range(3)]
    for one, value in zip(wrong, ("1", True, float("nan")), strict=True):
        one["data"]["vertex"]["3"]["x"] = value
    flat = {"vertices": [[0, 0], [1, 0], [0, 1]] * 2, "faces": [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]}
    others = [*wrong, {"dtype": "compas.geometry/Polyhedron", "data": flat}]
    for other in others[:-1]:  # the last one is read by the test
        with pytest.raises(InputError, match=r"\[1\]\.data\.vertex\.3\.x is (not finite|'1'|True); give a number"):
            load_structure(compas(folder, mesh(LOW), other))
    return Case(
        compas(folder, mesh(LOW), others[-1]), says=r"\[1\]\.data\.vertices\[0\] is \[0, 0\]; give a list of length 3"
    )


@case("COMPAS", "a transformation beside a shape")
def _(folder: Path) -> Case:
    moved = {"data": {"matrix": [[1, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}
    return Case(compas(folder, mesh(LOW), mesh(HIGH) | {"transformation": moved}), says="has a transformation beside")


@case("COMPAS", "cylinders, cones, spheres, capsules and tori")
def _(folder: Path) -> Case:
    solids = [
        shape("Cylinder", (0, 0, 0.5), radius=0.3, height=1), shape("Cone", (2, 0, 0), radius=0.3, height=1),
        shape("Sphere", (4, 0, 0.5), radius=0.5), shape("Capsule", (6, 0, 0.8), radius=0.3, height=1),
        shape("Torus", (9, 0, 0.2), radius_axis=1, radius_pipe=0.2),
    ]  # fmt: skip
    exact = np.pi * np.array([0.09, 0.03, 4 / 3 * 0.125, 0.09 + 4 / 3 * 0.027, 2 * np.pi * 0.04])

    def close(found: Assembly) -> bool:
        share = found.mass.volume[:5] / exact
        return bool(((share < 1) & (share > 0.995)).all() and np.allclose(found.meshes[3].bounds[:, 2], [0, 1.6]))

    return Case(compas(folder, *solids), says="a part may rest that rolls in fact: Cylinder, Cone, Sphere", check=close)


@case("COMPAS", "solids of other classes, such as Breps")
def _(folder: Path) -> Case:
    return Case(
        compas(folder, mesh(LOW), {"dtype": "compas_occ.brep/OCCBrep", "data": {}}), says="is a compas_occ.brep"
    )


@case("COMPAS", "points, curves and surfaces")
def _(folder: Path) -> Case:
    point = {"dtype": "compas.geometry/Point", "data": [0, 0, 0]}
    return Case(compas(folder, mesh(LOW), point), ("0",), r"bounds no solid was left out: 1 compas\.geometry/Point")


@case("COMPAS", "elements with a transformation")
def _(folder: Path) -> Case:
    up = {"data": {"matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]]}}
    content = element(geometry=mesh(LOW)), element(geometry=mesh(LOW, name="top"), transformation=up, is_support=True)

    def fixed(found: Assembly) -> bool:
        return found.boundary.tolist() == [False, True]

    return Case(compas(folder, *content), ("0", "top"), check=lambda a: fixed(a) and volumes(1, 1)(a), ground=False)


@case("COMPAS", "elements without a mesh")
def _(folder: Path) -> Case:
    beam = element("compas_model.elements/BeamElement", width=1, name="sill")
    return Case(compas(folder, mesh(LOW), beam), says="element sill is a compas_model.elements/BeamElement without its")


@case("COMPAS", "elements with features that change their shape")
def _(folder: Path) -> Case:
    cut = element(geometry=mesh(LOW), features=[{"dtype": "compas_model.elements/Cut", "data": {}}], name="sill")
    return Case(compas(folder, mesh(HIGH), cut), says="element sill has features")


@case("COMPAS", "elements outside the tree of their model")
def _(folder: Path) -> Case:
    elements = {"one": element(geometry=mesh(LOW)), "two": element(geometry=mesh(HIGH))}
    return Case(compas(folder, model(elements, "one")), ("0",), "left out: 1 element outside the tree")


@case("COMPAS", "nodes of an assembly without a block")
def _(folder: Path) -> Case:
    graph = {"node": {"0": {"block": mesh(LOW)}, "1": {"x": 0}}, "edge": {}}
    assembly = {"dtype": "compas_assembly.datastructures/Assembly", "data": {"graph": graph}}
    return Case(compas(folder, assembly), ("0",), "left out: 1 node without a block")


@case("COMPAS", "a block of several separate solids")
def _(folder: Path) -> Case:
    return Case(compas(folder, mesh(LOW, FAR)), ("0",), "consists of 2 separate solids", volumes(2))


@case("COMPAS", "a density for some blocks only")
def _(folder: Path) -> Case:
    path = compas(folder, mesh(LOW, density=2000), mesh(HIGH))
    return Case(path, ("0", "1"), "without a density.*2400 kg/m3: 1", lambda a: a.density.tolist()[:2] == [2000, 2400])


@case("COMPAS", "blocks of different friction")
def _(folder: Path) -> Case:
    return Case(compas(folder, mesh(LOW, friction=0.5), mesh(HIGH, friction=0.6)), says="blocks of different friction")


@case("COMPAS", "a support that is neither true nor false")
def _(folder: Path) -> Case:
    return Case(
        compas(folder, mesh(LOW, is_support="false"), mesh(HIGH)),
        says="attributes.is_support is 'false'; give true or false",
    )


@case("COMPAS", "interfaces whose corners are no points")
def _(folder: Path) -> Case:
    edge = {"0": {"1": {"interfaces": [{"points": [[0, 0, 1], [1, 0], [1, 1, 1]]}]}}}
    graph = {"node": {"0": {"block": mesh(LOW)}, "1": {"block": mesh(HIGH)}}, "edge": edge}
    assembly = {"dtype": "compas_assembly.datastructures/Assembly", "data": {"graph": graph}}
    return Case(compas(folder, assembly), says=r"interfaces\[0\]\.points\[1\] is \[1, 0\]; give a list")


# Rhino -------------------------------------------------------------------------------------------------------------


class Rhino:
    """Rhino file in the making, in metres."""

    def __init__(self) -> None:
        self.api = pytest.importorskip("rhino3dm", reason="needs rhino3dm; pip install 'falsework[rhino]'")
        self.file = self.api.File3dm()
        self.file.Settings.ModelUnitSystem = self.api.UnitSystem.Meters
        self.parts = self.layer("Parts")

    def layer(self, name: str, *, visible: bool = True) -> int:
        layer = self.api.Layer()
        layer.Name, layer.Visible = name, visible
        return self.file.Layers.Add(layer)

    def attributes(self, name: str = "", layer: int | None = None) -> Any:
        attributes = self.api.ObjectAttributes()
        attributes.Name, attributes.LayerIndex = name, self.parts if layer is None else layer
        return attributes

    def mesh(self, *boxes: Box) -> Any:
        mesh = self.api.Mesh()
        for number, box in enumerate(boxes):
            for point in corners(box):
                mesh.Vertices.Add(*point)
            for quad in QUADS:
                mesh.Faces.AddFace(*(8 * number + corner for corner in quad))
        return mesh

    def add(self, *boxes: Box, name: str = "", layer: int | None = None, mode: str = "Normal") -> None:
        attributes = self.attributes(name, layer)
        attributes.Mode = getattr(self.api.ObjectMode, mode)
        self.file.Objects.AddMesh(self.mesh(*boxes), attributes)

    def write(self, folder: Path) -> Path:
        self.file.Write(str(folder / "model.3dm"), 8)
        return folder / "model.3dm"


@case("Rhino", "meshes on layers of supports")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base", layer=rhino.layer("Boundary"))
    rhino.add(HIGH, name="top")
    return Case(
        rhino.write(folder), ("base", "top"), check=lambda a: a.boundary.tolist() == [True, False], ground=False
    )


@case("Rhino", "locked objects")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base", mode="Locked")
    return Case(rhino.write(folder), ("base",))


@case("Rhino", "hidden objects and layers")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base")
    rhino.add(HIGH, name="hidden", mode="Hidden")
    rhino.add(FAR, name="off", layer=rhino.layer("Off", visible=False))
    return Case(rhino.write(folder), ("base",), "hidden objects were left out: 1 on layer Parts, 1 on layer Off")


@case("Rhino", "parts beside the layer Blocks")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base", layer=rhino.layer("Blocks"))
    rhino.add(FAR, name="far")
    return Case(rhino.write(folder), ("base",), "parts beside the layer Blocks were left out: 1")


def instance(rhino: Rhino, definition: Any) -> None:
    """Add an instance of a block, mirrored and lifted."""
    place = rhino.api.Transform(1.0)
    place.M22, place.M23 = -1.0, 2.0
    rhino.file.Objects.AddInstanceObject(rhino.api.InstanceReference(definition, place), rhino.attributes("lifted"))


@case("Rhino", "instances of blocks, mirrored")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base")
    origin = rhino.api.Point3d(0, 0, 0)
    rhino.file.InstanceDefinitions.Add("pair", "", "", "", origin, (rhino.mesh(LOW),), (rhino.attributes("unit"),))
    instance(rhino, rhino.file.InstanceDefinitions.FindIndex(0).Id)

    def middle(found: Assembly) -> bool:
        return bool(np.allclose(found.mass.center[1], [0.5, 0.5, 1.5]))

    return Case(rhino.write(folder), ("base", "lifted"), check=lambda a: middle(a) and volumes(1, 1)(a))


@case("Rhino", "instances of blocks without objects")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base")
    instance(rhino, uuid.uuid4())
    return Case(rhino.write(folder), says="instance lifted is of a block without objects")


@case("Rhino", "a mesh of several separate solids")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, HIGH, SIDE, name="wall")
    return Case(rhino.write(folder), ("wall-0", "wall-1", "wall-2"), "object wall has 3 separate solids")


@case("Rhino", "several objects of one name")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="brick")
    rhino.add(HIGH, name="brick")
    return Case(rhino.write(folder), ("brick", "brick-2"), "2 objects are called brick")


@case("Rhino", "curves, points and texts")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base")
    rhino.file.Objects.AddPoint(rhino.api.Point3d(0, 0, 0))
    rhino.file.Objects.AddLine(rhino.api.Point3d(0, 0, 0), rhino.api.Point3d(1, 0, 0))
    return Case(rhino.write(folder), ("base",), "curves, points, texts and the like were left out: 2")


@case("Rhino", "open surfaces")
def _(folder: Path) -> Case:
    rhino = Rhino()
    rhino.add(LOW, name="base")
    sheet = rhino.api.Mesh()
    for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)):
        sheet.Vertices.Add(x, y, 1)
    sheet.Faces.AddFace(0, 1, 2, 3)
    rhino.file.Objects.AddMesh(sheet, rhino.attributes("sheet"))
    near, far = (rhino.api.LineCurve(rhino.api.Point3d(0, y, 1), rhino.api.Point3d(1, y, 1)) for y in (0, 1))
    ruled = rhino.api.NurbsSurface.CreateRuledSurface(near, far)
    rhino.file.Objects.AddSurface(ruled, rhino.attributes("ruled"))
    return Case(rhino.write(folder), ("base",), "surfaces that are not solids were left out: 2 on layer Parts")


@case("Rhino", "objects without a render mesh, also closed surfaces such as spheres")
def _(folder: Path) -> Case:
    rhino = Rhino()
    point = rhino.api.Point3d
    box = rhino.api.Box(rhino.api.BoundingBox(point(0, 0, 0), point(1, 1, 1)))
    rhino.file.Objects.AddBrep(rhino.api.Brep.CreateFromBox(box), rhino.attributes("solid"))
    with pytest.raises(InputError, match="Brep solid has no render mesh"):
        load_structure(rhino.write(folder), ground=True)
    rhino = Rhino()
    rhino.add(LOW, name="base")
    rhino.file.Objects.AddSphere(rhino.api.Sphere(point(0.5, 0.5, 1.5), 0.5), rhino.attributes("ball"))
    return Case(rhino.write(folder), says="NurbsSurface ball has no render mesh")


@case("Rhino", "curved faces")
def _(folder: Path) -> Case:
    rhino = Rhino()
    circle = rhino.api.Circle(rhino.api.Point3d(0.5, 0.5, 0), 0.5)
    drum = rhino.api.Extrusion.CreateCylinderExtrusion(rhino.api.Cylinder(circle, 1.0), True, True)
    shown = rhino.mesh(LOW)
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(shown))  # from here on it belongs to the extrusion
    drum.SetMesh(shown, rhino.api.MeshType.Render)
    rhino.file.Objects.AddExtrusion(drum, rhino.attributes("drum"))
    return Case(rhino.write(folder), ("drum",), "a part may rest that rolls in fact: drum")


# STEP --------------------------------------------------------------------------------------------------------------


def step(folder: Path, *shapes: Any) -> Path:
    control = pytest.importorskip("OCP.STEPControl", reason="needs cadquery-ocp; pip install 'falsework[step]'")
    writer = control.STEPControl_Writer()
    for solid in shapes:
        writer.Transfer(solid, control.STEPControl_StepModelType.STEPControl_AsIs)
    writer.Write(str(folder / "model.step"))
    return folder / "model.step"


def step_box() -> Any:
    prim = pytest.importorskip("OCP.BRepPrimAPI", reason="needs cadquery-ocp; pip install 'falsework[step]'")
    return prim.BRepPrimAPI_MakeBox(1000.0, 1000.0, 1000.0).Shape()


@case("STEP", "solids")
def _(folder: Path) -> Case:
    return Case(step(folder, step_box()), check=volumes(1))


@case("STEP", "names of products and of their occurrences")
def _(folder: Path) -> Case:
    """Of two bodies that a program calls alike."""
    low = step_box()
    from OCP.gp import gp_Trsf, gp_Vec
    from OCP.TopLoc import TopLoc_Location

    up = gp_Trsf()
    up.SetTranslation(gp_Vec(0.0, 0.0, 1000.0))
    path = step(folder, low, low.Moved(TopLoc_Location(up)))
    text = path.read_text().replace("MANIFOLD_SOLID_BREP('", "MANIFOLD_SOLID_BREP('Body1")
    for name in ("low", "high"):
        text = re.sub(
            r"= PRODUCT\('Open CASCADE[^']*'\s*,\s*'Open CASCADE[^']*'", f"= PRODUCT('{name}','{name}'", text, count=1
        )
    path.write_text(text)
    return Case(path, ("low", "high"), check=volumes(1, 1))


@case("STEP", "curved faces")
def _(folder: Path) -> Case:
    step_box()
    from OCP.BRepPrimAPI import BRepPrimAPI_MakeCylinder

    return Case(step(folder, BRepPrimAPI_MakeCylinder(300.0, 500.0).Shape()), says="may rest that rolls in fact")


@case("STEP", "surfaces and curves")
def _(folder: Path) -> Case:
    box = step_box()
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeFace
    from OCP.gp import gp_Dir, gp_Pln, gp_Pnt

    plane = BRepBuilderAPI_MakeFace(gp_Pln(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), 0.0, 1.0, 0.0, 1.0).Face()
    return Case(step(folder, box, plane), says="surfaces that bound no solid were left out: 1")


@case("STEP", "hidden objects")
def _(folder: Path) -> Case:
    path = step(folder, step_box())
    head, end, tail = path.read_text().rpartition("ENDSEC;")
    path.write_text(f"{head}#99999 = INVISIBILITY((#1));\n{end}{tail}")
    return Case(path, says=r"it hides objects \(1 lists\), which were read as well", check=volumes(1))


# Bricks and other formats ------------------------------------------------------------------------------------------


def bricks(folder: Path, *lines: str) -> Path:
    (folder / "a.mpd").write_text("\n".join(lines) + "\n")
    return folder / "a.mpd"


BRICK = "1 4 {} {} 0 1 0 0 0 1 0 0 0 1 {}"
LOWER, UPPER = BRICK.format(0, 0, "3001.dat"), BRICK.format(20, -24, "3001.dat")


@case("Bricks", "bricks in models within models")
def _(folder: Path) -> Case:
    path = bricks(folder, "0 FILE main", LOWER, BRICK.format(0, 0, "sub"), "0 FILE sub", UPPER)
    return Case(path, ("0", "1"), boundary=("0",))


@case("Bricks", "no fixed brick")
def _(folder: Path) -> Case:
    return Case(bricks(folder, LOWER, UPPER), ("0", "1"), "a baseplate .* was added as the last part", ground=False)


@case("Bricks", "lines and faces beside bricks")
def _(folder: Path) -> Case:
    path = bricks(folder, LOWER, UPPER, "2 24 0 0 0 1 0 0", "3 4 0 0 0 1 0 0 0 1 0")
    return Case(path, ("0", "1"), "drawn beside bricks were left out: 2", boundary=("0",))


@case("Bricks", "hidden bricks")
def _(folder: Path) -> Case:
    path = bricks(folder, LOWER, UPPER, f"0 MLCAD HIDE {BRICK.format(20, -48, '3001.dat')}")
    return Case(path, ("0", "1"), "hidden bricks were left out: 1", boundary=("0",))


@case("Bricks", "models that the first one does not contain")
def _(folder: Path) -> Case:
    path = bricks(folder, "0 FILE main", LOWER, UPPER, "0 FILE spare", LOWER)
    return Case(path, ("0", "1"), "does not contain were left out: spare", boundary=("0",))


@case("Bricks", "two models of one name")
def _(folder: Path) -> Case:
    return Case(
        bricks(folder, "0 FILE main", LOWER, "0 FILE main", UPPER), says="there are two models main", ground=False
    )


@case("Bricks", "bricks that come and go (`BUFEXCHG`)")
def _(folder: Path) -> Case:
    path = bricks(folder, LOWER, "0 BUFEXCHG A STORE", UPPER, "0 BUFEXCHG A RETRIEVE")
    return Case(path, says="bricks come and go", ground=False)


@case("Bricks", "statements in small letters")
def _(folder: Path) -> Case:
    path = bricks(folder, "0 file main", LOWER, BRICK.format(0, 0, "sub"), "0 nofile", LOWER, "0 file sub", UPPER)
    path.write_text(path.read_text().replace(f"0 nofile\n{LOWER}\n", "0 nofile\n"))
    return Case(path, ("0", "1"), boundary=("0",))


@case("Bricks", "parts that are no bricks")
def _(folder: Path) -> Case:
    return Case(
        bricks(folder, BRICK.format(0, 0, "3039.dat")), says=r"part 3039\.dat is not a known brick", ground=False
    )


@case("Bricks", "colours and building steps")
def _(folder: Path) -> Case:
    return Case(bricks(folder, LOWER, "0 STEP", UPPER.replace("1 4 ", "1 14 ")), ("0", "1"), boundary=("0",))


@case("Other formats", "files of other formats")
def _(folder: Path) -> Case:
    (folder / "a.off").write_text("OFF\n")
    return Case(folder / "a.off", says=r"cannot read .*a\.off; a structure is .*\.obj, \.stl, \.ply, \.glb, \.gltf")

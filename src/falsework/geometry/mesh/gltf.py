"""Reader of glTF 2.0, as one binary file (.glb) or as text (.gltf)."""

from __future__ import annotations

import base64
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError
from falsework.geometry.mesh.bounds import check_growth
from falsework.geometry.mesh.surface import PartSurface, content_of, joined, warn_of
from falsework.utils.files.input_file import read_content
from falsework.utils.json_text import parse_json
from falsework.utils.quantity import is_number, listed

Array = NDArray[np.float64]

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_STRIP, _FAN, _TRIANGLES = 5, 6, 4
_HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "EXT_texture_",
    "EXT_lights_",
    "KHR_xmp_",
    "KHR_animation_",
)
"""Beginnings of the names of extensions that say nothing about the shape."""
_KNOWN = {"KHR_mesh_quantization", "KHR_node_visibility", "MSFT_texture_dds", "ADOBE_materials_clearcoat_specular"}
_SHAPED = ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers")
"""Lists of what shapes are made of."""
_UNIT = 0.01
"""Difference from one up to which the length of a rotation counts as rounded."""
_LEVELS = 64
"""Nodes that may contain each other."""
_NODES = 100_000
"""Nodes that a scene may have; one that is used often, within others that are, must not fill the memory."""


def read_gltf(file: Path) -> list[PartSurface]:
    """Read the nodes with meshes in the scene of a glTF file, in the order of the file, turned to z up.

    A part is a node; the primitives of its mesh, one for each material, are one surface. The entries `part`,
    `boundary` and `density` in the `extras` of a node, which falsework writes, are its number, whether it is fixed,
    and its density; `friction` in those of `asset` is the coefficient of all contacts. Hidden nodes, points and lines,
    other scenes and animations are left out with a warning.

    Raises:
        MeshError: a file that is damaged, that has too many copies of its meshes (see `check_growth`), or whose shape
            depends on what is not read: skins, morph targets, compression, instancing.
    """
    content = content_of(file)
    reader = _Reader(file)
    try:
        return reader.read(content)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, struct.error, OverflowError) as error:
        if isinstance(error, MeshError):
            raise
        why = " ".join(str(error).split())[:80] if type(error) is ValueError else type(error).__name__
        raise MeshError(
            f"cannot read {file}: it is no glTF 2.0 file, or is damaged ({why}); export it again"
        ) from error


class _Reader:
    def __init__(self, file: Path) -> None:
        self._file = file
        self._json: dict[str, Any] = {}
        self._chunk = b""
        self._buffers: dict[int, bytes] = {}
        self._meshes: dict[int, PartSurface | None] = {}
        self._hidden: list[str] = []
        self._flat: list[str] = []
        self._lacking: list[str] = []
        self._lines = 0
        self._count = 0

    def read(self, content: bytes) -> list[PartSurface]:
        if content[:4] == b"glTF":
            content = self._chunks(content)
        self._json = parse_json(content.decode("utf-8-sig"))
        asset = self._json["asset"]
        if not str(asset["version"]).startswith("2") or asset.get("minVersion", "2.0") != "2.0":
            version = asset.get("minVersion", asset["version"])
            self._fail(f"its version of glTF is {version}, not 2.0", "export it as glTF 2.0")
        if "plan" in (self._json.get("extras") or {}):
            self._fail("it shows a plan in motion", "give the structure of the plan")
        shaping = [name for name in self._extensions() if name not in _KNOWN and not name.startswith(_HARMLESS)]
        if shaping:
            self._fail(f"it uses {listed(shaping)}, which may change its shapes", "export it without extensions")
        uses = [use for root in self._roots() for use in self._uses(root, np.eye(4), 0, False)]
        self._check_growth(uses)
        surfaces = [surface for use in uses if (surface := self._part(*use)) is not None]
        self._report()
        stated = [surface.number for surface in surfaces if surface.number is not None]
        if sorted(stated) == list(range(len(surfaces))):
            return sorted(surfaces, key=lambda surface: surface.number or 0)
        if stated:
            said = listed([f"{surface.name} {surface.number}" for surface in surfaces if surface.number is not None])
            warn_of(
                self._file, f"nodes state numbers that are not 0 to {len(surfaces) - 1}, so these are left out: {said}"
            )
        return [replace(surface, number=None) for surface in surfaces]

    def _extensions(self) -> list[str]:
        """Return the extensions that the file declares, or uses where shapes are without declaring them."""
        found = [*self._json.get("extensionsUsed", []), *self._json.get("extensionsRequired", [])]
        holders = [entry for kind in _SHAPED for entry in self._json.get(kind, [])]
        holders += [primitive for mesh in self._json.get("meshes", []) for primitive in mesh["primitives"]]
        for holder in holders:
            found += holder.get("extensions") or {}
        return list(dict.fromkeys(found))

    def _chunks(self, content: bytes) -> bytes:
        """Return the JSON of a binary file, and keep its buffer."""
        version, _ = struct.unpack_from("<II", content, 4)
        if version != 2:
            self._fail(f"its version of glTF is {version}, not 2", "export it as glTF 2.0")
        at, text = 12, b""
        while at + 8 <= len(content):
            size, kind = struct.unpack_from("<I4s", content, at)
            chunk = content[at + 8 : at + 8 + size]
            if len(chunk) < size:
                raise ValueError("the file ends too soon")
            if kind == b"JSON" and not text:
                text = chunk
            elif kind == b"BIN\0" and not self._chunk:
                self._chunk = chunk
            at += 8 + size
        return text

    def _roots(self) -> list[int]:
        """Return the root nodes of the scene."""
        nodes, scenes = self._json.get("nodes", []), self._json.get("scenes", [])
        below = {child for node in nodes for child in node.get("children", [])}
        if not scenes:
            return [number for number in range(len(nodes)) if number not in below]
        chosen = self._json.get("scene", 0)
        roots = scenes[chosen].get("nodes", [])
        reached, todo = set(roots), list(roots)
        while todo:
            fresh = set(nodes[todo.pop()].get("children", [])) - reached
            reached |= fresh
            todo += fresh
        lost = [n for n, node in enumerate(nodes) if "mesh" in node and n not in reached]
        if lost:
            names = listed([self._name(nodes[number], number) for number in lost])
            warn_of(self._file, f"nodes that are not in scene {chosen} were left out: {names}")
        return roots

    def _uses(self, number: int, above: Array, level: int, hidden: bool) -> Iterator[tuple[int, Array, bool]]:
        """Yield a node and those below it that have a mesh: number, place, and whether it is hidden."""
        self._count += 1
        if level > _LEVELS or self._count > _NODES:
            self._fail("its nodes contain themselves, or are too many", "export it again")
        node = self._entry("nodes", number)
        place = above @ _transform(node)
        hidden = hidden or (node.get("extensions") or {}).get("KHR_node_visibility", {}).get("visible") is False
        if "mesh" in node:
            yield number, place, hidden
        for child in node.get("children", []):
            yield from self._uses(child, place, level + 1, hidden)

    def _check_growth(self, uses: Sequence[tuple[int, Array, bool]]) -> None:
        """Refuse copies of meshes and claims of arrays beyond the size of the files, before any is read."""
        accessors = self._json.get("accessors", [])
        sizes = [
            sum(
                max(0, int(accessors[index]["count"]))
                for primitive in mesh["primitives"]
                for index in (primitive["attributes"].get("POSITION"), primitive.get("indices"))
                if index is not None
            )
            for mesh in self._json.get("meshes", [])
        ]
        beside = {self._beside(uri) for buffer in self._json.get("buffers", []) if (uri := buffer.get("uri"))}
        size = sum(file.stat().st_size for file in beside if file is not None)
        check_growth(self._file, sum(sizes[self._json["nodes"][number]["mesh"]] for number, _, _ in uses), beside=size)

    def _part(self, number: int, place: Array, hidden: bool) -> PartSurface | None:
        """Return the surface of a node in its place; None if it is left out."""
        node = self._entry("nodes", number)
        name = self._name(node, number)
        if "skin" in node:
            self._fail(f"node {name} is deformed by a skin", "apply it and export plain meshes")
        surface = self._mesh(node["mesh"], name, node)
        if hidden:
            self._hidden.append(name)
        elif surface is not None and not np.linalg.det(place[:3, :3]):
            self._flat.append(name)
        elif surface is not None:
            return self._placed(surface, number, node, place)
        return None

    def _placed(self, surface: PartSurface, index: int, node: dict[str, Any], place: Array) -> PartSurface:
        points = surface.vertices @ place[:3, :3].T + place[:3, 3]
        faces = surface.faces if np.linalg.det(place[:3, :3]) > 0 else surface.faces[:, ::-1]
        extras = node.get("extras")
        extras = extras if isinstance(extras, dict) else {}
        number, density = extras.get("part"), extras.get("density")
        friction = (self._json["asset"].get("extras") or {}).get("friction")
        own = isinstance(number, int) and not isinstance(number, bool)
        if not own and extras.keys() & {"boundary", "density"}:
            self._lacking.append(self._name(node, index))
        return PartSurface(
            node.get("name") or self._json["meshes"][node["mesh"]].get("name") or "",
            points[:, [0, 2, 1]] * (1.0, -1.0, 1.0),
            faces,
            support=own and extras.get("boundary") is True,
            number=number if own else None,
            density=float(density) if own and is_number(density) else None,
            friction=float(friction) if own and is_number(friction) else None,
            whole=own,
        )

    def _mesh(self, index: int, name: str, node: dict[str, Any]) -> PartSurface | None:
        """Return the surface of a mesh, all primitives together; None if it has no triangles."""
        mesh = self._entry("meshes", index)
        if any(node.get("weights") or mesh.get("weights") or ()):
            self._fail(f"node {name} is deformed by morph targets", "apply them and export plain meshes")
        if index not in self._meshes:
            pieces = []
            for primitive in mesh["primitives"]:
                if primitive.get("mode", _TRIANGLES) < _TRIANGLES:
                    self._lines += 1
                    continue
                points = self._numbers(primitive["attributes"]["POSITION"], "VEC3")
                pieces.append(PartSurface("", points, self._faces(primitive, len(points))))
            self._meshes[index] = joined("", pieces) if pieces else None
        return self._meshes[index]

    def _faces(self, primitive: dict[str, Any], count: int) -> NDArray[np.int64]:
        corners = np.arange(count)
        if "indices" in primitive:
            corners = self._numbers(primitive["indices"], "SCALAR").ravel().astype(np.int64)
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _TRIANGLES:
            faces = corners.reshape(-1, 3)
        elif mode == _STRIP:
            faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
            faces[1::2] = faces[1::2][:, [1, 0, 2]]
        elif mode == _FAN:
            faces = np.stack([np.full(max(len(corners) - 2, 0), corners[0]), corners[1:-1], corners[2:]], axis=1)
        else:
            raise ValueError("an unknown kind of primitive")
        if len(faces) and (faces.min() < 0 or faces.max() >= count):
            self._fail("a face uses a vertex that does not exist", "export it again")
        return faces.astype(np.int64)

    def _numbers(self, index: int, kind: str) -> Array:
        """Return the values of an accessor, shape (count, width)."""
        accessor = self._entry("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            self._fail("it has sparse accessors", "export it again without them")
        if accessor["type"] != kind:
            raise ValueError("values of another type")
        view = self._entry("bufferViews", accessor["bufferView"])
        dtype = np.dtype(_COMPONENTS[accessor["componentType"]])
        width, count = _WIDTHS[kind], accessor["count"]
        stride = view.get("byteStride") or width * dtype.itemsize
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        buffer = self._buffer(view["buffer"])
        size = (count - 1) * stride + width * dtype.itemsize if count else 0
        within = accessor.get("byteOffset", 0) + size <= view["byteLength"]
        if min(start, count, size) < 0 or start + size > len(buffer) or not within:
            raise ValueError("values beyond the end of their view or of the buffer")
        values = np.ndarray((count, width), dtype, buffer, start, (stride, dtype.itemsize)).astype(np.float64)
        if accessor.get("normalized") and dtype.kind != "f":
            values = np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values

    def _buffer(self, index: int) -> bytes:
        """Return a buffer: that in the file, in its text, or in a file beside it."""
        if index not in self._buffers:
            uri = self._entry("buffers", index).get("uri")
            if uri is None:
                self._buffers[index] = self._chunk
            elif uri.startswith("data:"):
                self._buffers[index] = base64.b64decode(uri.partition(",")[2], validate=True)
            else:
                beside = self._beside(uri)
                if beside is None:
                    self._fail(f"its data are in {uri[:80]!r}, which is no file beside it", "export it as .glb")
                self._buffers[index] = read_content(beside)
        return self._buffers[index]

    def _beside(self, uri: str) -> Path | None:
        """Return the file beside this one that a buffer names; None if it is no such file."""
        name = unquote(uri).removeprefix("./")
        beside = self._file.parent / Path(name).name
        return beside if self._file.suffix.lower() == ".gltf" and beside.name == name and beside.is_file() else None

    def _entry(self, kind: str, index: int) -> dict[str, Any]:
        if index < 0:
            raise IndexError(f"entry {index} of {kind}")
        return self._json[kind][index]

    def _report(self) -> None:
        """Warn of what was left out."""
        for names, what in ((self._hidden, "hidden nodes"), (self._flat, "nodes that are scaled to nothing")):
            if names:
                warn_of(self._file, f"{what} were left out: {listed(names)}")
        if self._lacking:
            said = listed(self._lacking)
            warn_of(
                self._file, f"boundary and density count only beside the number of a part, and were left out: {said}"
            )
        if self._lines:
            warn_of(self._file, f"points and lines were left out: {self._lines} primitives")
        if self._json.get("animations"):
            warn_of(self._file, f"animations were left out: {len(self._json['animations'])}; parts are read at rest")

    def _name(self, node: dict[str, Any], number: int) -> str:
        return str(node.get("name") or f"number {number}")

    def _fail(self, what: str, remedy: str) -> NoReturn:
        raise MeshError(f"cannot read {self._file}: {what}; {remedy}")


def _transform(node: dict[str, Any]) -> Array:
    """Return the matrix of a node, shape (4, 4)."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0)):
            raise ValueError("the matrix of a node is not affine")
    else:
        x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
        if not abs(x * x + y * y + z * z + w * w - 1) <= _UNIT:
            raise ValueError("the rotation of a node is no unit quaternion")
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        matrix = np.eye(4)
        matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
        matrix[:3, 3] = node.get("translation", (0, 0, 0))
    if not np.isfinite(matrix).all():
        raise ValueError("a place that is not a number")
    return matrix

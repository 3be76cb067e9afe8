"""Reader of PLY, text and binary."""

from __future__ import annotations

from codecs import BOM_UTF8
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import MeshError
from falsework.geometry.mesh.polygon import triangles_of
from falsework.geometry.mesh.surface import PartSurface, content_of, stated_unit, warn_of
from falsework.utils.quantity import listed

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_APPEARANCE = {
    "red", "green", "blue", "alpha", "r", "g", "b", "a", "nx", "ny", "nz", "u", "v", "s", "t", "texture_u", "texture_v",
    "texcoord", "texnumber", "flags", "quality", "intensity", "material_index",
}  # fmt: skip
"""Properties of faces that say nothing about the shape."""


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    """Type of NumPy without the order of bytes."""
    length: str = ""
    """Type of the length of a list; empty for a number."""


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


def read_ply(file: Path) -> list[PartSurface]:
    """Read the surface in a PLY file. Colours, normals and textures are ignored.

    Raises:
        MeshError: a file that is damaged, has triangle strips, or has more or other data than its header says.
    """
    content = content_of(file).removeprefix(BOM_UTF8)
    try:
        order, elements, start = _header(content)
        if twice := _stated_twice(elements):
            raise MeshError(
                f"the header of {file} has {twice} twice, so that one of them would be lost; export it again"
            )
        data = _Numbers(content, start, order)
        values = {element.name: _read(data, element) for element in elements}
        if data.rest():
            raise MeshError(f"{file} has more data than its header says, such as further faces; export it again")
        if "tristrips" in values:
            raise MeshError(f"{file} has triangle strips; export its faces one by one")
        vertex, face = values.get("vertex", {}), values.get("face", {})
        points = np.stack([np.asarray(vertex[axis], dtype=np.float64) for axis in "xyz"], axis=1) if vertex else None
        corners = next((face[name] for name in _CORNERS if name in face), [])
    except MeshError:
        raise
    except (ValueError, KeyError, IndexError, UnicodeDecodeError, OverflowError, TypeError) as error:
        raise MeshError(f"cannot read {file}: it is no PLY file, or ends too soon; export it again") from error
    others = [f"{element.count} of {element.name!r}" for element in elements if element.name not in ("vertex", "face")]
    if others:
        warn_of(file, f"elements that make no surface were left out: {listed(others)}")
    unused = sorted(set(face) - set(_CORNERS) - _APPEARANCE)
    if unused:
        warn_of(file, f"properties of faces were left out: {listed(unused)}")
    if points is None or not len(corners):
        return []
    if any(len(polygon) < 3 for polygon in corners):
        raise MeshError(f"a face in {file} has fewer than three corners; export it again")
    unit = stated_unit(content[:start].decode("ascii", errors="replace"))
    return [PartSurface("", points, triangles_of(str(file), points, corners), unit=unit)]


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Return the order of bytes, the elements, and where the data begin."""
    end = content.index(b"end_header")
    start = content.index(b"\n" if b"\n" in content[:end] else b"\r", end) + 1  # older programs end lines by a return
    lines = content[:end].decode("ascii", errors="replace").splitlines()
    if lines[0].strip() != "ply":
        raise ValueError("no PLY file")
    order, elements = "", []
    form = None
    for line in lines[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
            order = _ORDERS[form]
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
        elif words[:1] == ["property"]:
            elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
    if form is None or any(element.count < 0 for element in elements):
        raise ValueError("no format")
    return order, elements, start


def _stated_twice(elements: list[_Element]) -> str:
    """Return which element, property or list of corners a header has twice; empty if it has none."""
    places = [repr(element.name) for element in elements]
    for element in elements:
        places += [f"{entry.name!r} of {element.name!r}" for entry in element.properties]
        if element.name == "face":
            places += ["corners of faces" for entry in element.properties if entry.name in _CORNERS]
    return next((place for number, place in enumerate(places) if place in places[:number]), "")


class _Numbers:
    """Numbers of a file, read one after the other."""

    def __init__(self, content: bytes, start: int, order: str) -> None:
        self.content, self.at, self.order = content, start, order
        self.words = content[start:].split() if not order else []
        self.word = 0

    def take(self, kind: str, count: int) -> np.ndarray:
        """Return the next numbers of a type."""
        if not self.order:
            words = self.words[self.word : self.word + count]
            self.word += count
            if len(words) < count:
                raise ValueError("too few numbers")
            return np.array([float(word) for word in words]) if kind[0] == "f" else np.array([int(w) for w in words])
        values = np.frombuffer(self.content, self.order + kind, count, self.at)
        self.at += values.nbytes
        return values

    def rest(self) -> bool:
        """Return whether numbers are left."""
        return self.word < len(self.words) if not self.order else bool(self.content[self.at :].strip())

    def table(self, kinds: list[str], count: int) -> list[np.ndarray]:
        """Return the columns of rows that are numbers of these types."""
        if not self.order:
            flat = self.take("f8", count * len(kinds)).reshape(count, len(kinds))
            return list(flat.T)
        row = np.dtype([(str(column), self.order + kind) for column, kind in enumerate(kinds)])
        values = np.frombuffer(self.content, row, count, self.at)
        self.at += values.nbytes
        return [values[str(column)] for column in range(len(kinds))]


def _read(data: _Numbers, element: _Element) -> dict[str, Any]:
    """Return the values of each property of an element: an array of numbers, or lists."""
    lists = [entry for entry in element.properties if entry.length]
    if not lists:
        columns = data.table([entry.kind for entry in element.properties], element.count) if element.properties else []
        return {entry.name: column for entry, column in zip(element.properties, columns, strict=True)}
    values: dict[str, list[Any]] = {entry.name: [] for entry in element.properties}
    for _ in range(element.count):
        for entry in element.properties:
            if entry.length:
                count = int(data.take(entry.length, 1)[0])
                if count < 0:
                    raise ValueError("a list of no length")
                values[entry.name].append(data.take(entry.kind, count).tolist())
            else:
                values[entry.name].append(data.take(entry.kind, 1)[0])
    return values

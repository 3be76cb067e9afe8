"""Reader and writer of Wavefront OBJ that keep every digit."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.polygon import triangles_of
from falsework.geometry.mesh.surface import PartSurface, content_of, joined, regrouped, stated_unit, text_of, warn_of
from falsework.utils.files.printable import printable
from falsework.utils.quantity import listed

_APPEARANCE = {"vt", "vn", "s", "usemtl", "mtllib", "usemap", "maplib", "bevel", "c_interp", "d_interp"}
"""Statements that say nothing about the shape."""
_FREE_FORM = {"surf", "curv", "curv2", "cstype", "call", "csh", "vp", "bzp", "bsp", "cdc", "cdp", "res"}
"""Statements of free-form curves and surfaces, or that read other files."""


@dataclass(frozen=True)
class _Section:
    """Polygons between two lines that begin an object or a group."""

    place: int
    """Number of its object in the file."""
    owner: str
    group: str
    polygons: list[list[int]]


def read_obj(file: Path) -> list[PartSurface]:
    """Read the objects of an OBJ file.

    Objects begin at `o` lines, or at `g` lines in a file that has not two objects. Polygons are cut into triangles,
    concave ones too. Textures, normals and materials are ignored.

    Raises:
        MeshError: a line that cannot be understood, a face with a vertex that is not there, or a free-form surface.
    """
    text = text_of(file, content_of(file))
    vertices: list[tuple[float, float, float]] = []
    sections = [_Section(0, "", "", [])]
    unused: Counter[str] = Counter()
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        keyword = words[0]
        try:
            if keyword == "v":
                x, y, z = words[1:4]
                vertices.append((float(x), float(y), float(z)))
            elif keyword == "f":
                indices = [int(word.split("/", 1)[0]) for word in words[1:]]
                sections[-1].polygons.append([index - 1 if index > 0 else len(vertices) + index for index in indices])
                if len(indices) < 3 or 0 in indices:
                    raise ValueError
            elif keyword in ("o", "g"):
                name, last = " ".join(words[1:]), sections[-1]
                begun = (last.place + 1, name, "") if keyword == "o" else (last.place, last.owner, name)
                sections.append(_Section(*begun, []))
            elif keyword in _FREE_FORM:
                raise MeshError(
                    f"line {number} of {file} is {keyword!r}, which is no mesh (free-form, or another file); "
                    "export the parts as polygon meshes"
                )
            elif keyword not in _APPEARANCE:
                unused[keyword] += 1
        except ValueError as error:
            if isinstance(error, MeshError):
                raise
            raise MeshError(f"cannot read line {number} of {file}: {line.strip()[:60]!r}; export it again") from None
    if unused:
        kinds = listed([f"{count} of {keyword!r}" for keyword, count in unused.items()])
        warn_of(file, f"lines that make no surface were left out: {kinds}")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    unit = stated_unit("\n".join(line.partition("#")[2] for line in text.splitlines() if "#" in line))
    surfaces = _objects(file, points, [section for section in sections if section.polygons])
    return [replace(surface, unit=unit) for surface in surfaces]


def _objects(file: Path, points: NDArray[np.float64], sections: list[_Section]) -> list[PartSurface]:
    """Return the objects that sections make."""
    pieces = [
        PartSurface.from_faces("", points, triangles_of(str(file), points, section.polygons)) for section in sections
    ]
    names = list(dict.fromkeys(section.group or "(none)" for section in sections))
    if len({section.place for section in sections}) < 2 and len(names) > 1:
        groups = regrouped(
            file, [replace(piece, name=section.group) for piece, section in zip(pieces, sections, strict=True)]
        )
        if any(surface.closed for surface in groups):
            return groups
        warn_of(file, f"groups were left out, since their faces enclose no space each: {listed(names)}")
    pairs = zip(pieces, sections, strict=True)
    objects = groupby(pairs, key=lambda pair: (pair[1].place, pair[1].owner))
    return regrouped(file, [joined(owner, [piece for piece, _ in some]) for (_, owner), some in objects])


def obj_text(mesh: TriangleMesh) -> str:
    """Return an OBJ file whose numbers read back as the same float64."""
    lines = [f"o {printable(mesh.name)}"]  # a name of several lines would be read as statements
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(lines) + "\n"

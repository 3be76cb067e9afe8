"""Reader of STL, binary and text."""

from __future__ import annotations

from codecs import BOM_UTF8
from dataclasses import replace
from pathlib import Path

import numpy as np

from falsework.errors import MeshError
from falsework.geometry.mesh.surface import PartSurface, content_of, regrouped, stated_unit, text_of

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
"""Bytes before the facets of a binary file: a comment and their number."""


def read_stl(file: Path) -> list[PartSurface]:
    """Read the solids of an STL file. Normals and colours are ignored; the order of corners gives the outside.

    Raises:
        MeshError: a file that is damaged.
    """
    content = content_of(file)
    count = int.from_bytes(content[_HEADER - 4 : _HEADER], "little") if len(content) >= _HEADER else -1
    if len(content) == _HEADER + count * _FACET.itemsize:
        corners = np.frombuffer(content, _FACET, offset=_HEADER)["corners"].astype(np.float64)
        unit = stated_unit(content[: _HEADER - 4].decode("ascii", errors="replace"))
        return [replace(_surface("", corners), unit=unit)] if count else []
    text = content.removeprefix(BOM_UTF8)
    if not text.lstrip()[:5].lower() == b"solid" or b"\0" in text:
        raise MeshError(
            f"cannot read {file}: it is neither text that begins with 'solid' nor as long as its number of facets "
            "says; export it again"
        )
    return _read_text(file, text_of(file, text))


def _read_text(file: Path, text: str) -> list[PartSurface]:
    solids: list[tuple[str, list[list[float]]]] = []
    inside = False
    first = 0
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        keyword = words[0].lower() if words else ""
        wrong = False
        if keyword == "solid":
            wrong, inside = inside, True
            solids.append((" ".join(words[1:]), []))
        elif keyword == "endsolid":
            wrong, inside = not inside, False
        elif keyword == "vertex":
            try:
                x, y, z = map(float, words[1:])
                solids[-1][1].append([x, y, z])
            except ValueError:
                wrong = True
        elif keyword == "facet":
            first = len(solids[-1][1])
        elif keyword == "endfacet":
            wrong = len(solids[-1][1]) != first + 3
        else:
            wrong = bool(keyword) and keyword not in ("outer", "endloop")
        if wrong or (keyword not in ("", "endsolid") and not inside):
            raise MeshError(f"cannot read line {number} of {file}: {line.strip()[:60]!r}; export it again")
    if inside or any(len(points) % 3 for _, points in solids):
        raise MeshError(f"cannot read {file}: its last solid does not end; export it again")
    found = [_surface(name, np.array(points).reshape(-1, 3, 3)) for name, points in solids if points]
    unit = stated_unit("\n".join(name for name, _ in solids))
    return [replace(surface, unit=unit) for surface in regrouped(file, found)]


def _surface(name: str, corners: np.ndarray) -> PartSurface:
    return PartSurface(name, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))

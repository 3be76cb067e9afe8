"""Surfaces as files have them, unchecked: one for each part, with the name that the file gives it."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.errors import MeshError, ReadWarning
from falsework.geometry.mesh.bodies import merge_equal, separate_solids
from falsework.geometry.mesh.edges import is_closed
from falsework.geometry.mesh.mesh import joined_faces
from falsework.geometry.mesh.repair import closes
from falsework.utils.files.input_file import read_content
from falsework.utils.quantity import listed

_UNIT = re.compile(
    r"\bunits?\b\W{0,3}(?:(?:is|are|in)\W)?\W{0,2}"
    r"(mm|cm|dm|m|in|ft|(?:milli|centi|deci)?met(?:er|re)s?|inch(?:es)?|feet|foot)\b",
    re.IGNORECASE,
)
"""Statement of a unit in a comment."""
_SHORT = {"millim": "mm", "centim": "cm", "decime": "dm", "meter": "m", "metre": "m", "inch": "in", "f": "ft"}
"""Units by the beginnings of their names."""


@dataclass(frozen=True, eq=False)
class PartSurface:
    """Surface of one part in a file."""

    name: str
    """Empty if the file gives none."""
    vertices: NDArray[np.float64]
    """Shape (vertices, 3), in the unit of the file, z up."""
    faces: NDArray[np.int64]
    """Triangles, shape (faces, 3)."""
    support: bool = False
    """Whether the file says that it is boundary."""
    number: int | None = None
    """Number of the part that the file gives it."""
    density: float | None = None
    """kg/m3, if the file gives it."""
    friction: float | None = None
    """Coefficient of friction of all contacts, if the file gives it."""
    unit: str = ""
    """Unit that a comment of the file names; empty for none."""
    structure: str = ""
    """Name of the structure, if the file gives it."""
    whole: bool = False
    """Whether the file says that this is one part, even if it consists of several solids."""
    error: str = ""
    """Why the part cannot be read; the arrays are then empty."""

    @staticmethod
    def from_faces(name: str, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> PartSurface:
        """Make a surface of some faces of a file, with the vertices that they use."""
        used, index = np.unique(faces, return_inverse=True)
        return PartSurface(name, vertices[used], index.reshape(-1, 3).astype(np.int64))

    @property
    def closed(self) -> bool:
        """Whether the surface is closed, apart from degenerate faces."""
        if not len(self.faces):
            return False
        _, corners = merge_equal(self.vertices, self.faces)
        solid = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        return bool(solid.any()) and is_closed(corners[solid])


def stated_unit(comments: str) -> str:
    """Return the unit that comments of a file name, such as `# File units = inches`; empty for none."""
    match = _UNIT.search(comments)
    if match is None:
        return ""
    word = match[1].lower()
    return next((unit for beginning, unit in _SHORT.items() if word.startswith(beginning)), word)


def content_of(file: Path) -> bytes:
    """Return the bytes of a file of meshes; MeshError if it cannot be read."""
    try:
        return read_content(file)
    except OSError as error:
        raise MeshError(f"cannot read {file}: {error.strerror}") from error


def text_of(file: Path, content: bytes) -> str:
    """Return the text of a file in UTF-8, or with a warning as Western text, in which programs write names too.

    Raises:
        MeshError: it is no text of single bytes, such as UTF-16.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
        if "\0" not in text:
            warn_of(file, "it is not in UTF-8; names were read as Western text (Windows-1252)")
    if "\0" in text:
        raise MeshError(f"cannot read {file}: it is no text in UTF-8; save it as UTF-8")
    return text


def warn_of(file: Path, what: str) -> None:
    """Warn in one line of what the structure lacks of a file, or has in another way."""
    warnings.warn(f"{file}: {what}", ReadWarning, stacklevel=3)


def warn_of_curves(file: Path, names: Sequence[str]) -> None:
    """Warn of parts with curved faces, which became flat ones."""
    if names:
        what = "curved faces became flat ones, on which a part may rest that rolls in fact"
        warn_of(file, f"{what}: {listed(names)}")


def joined(name: str, surfaces: Sequence[PartSurface]) -> PartSurface:
    """Return surfaces as one."""
    return PartSurface(
        name,
        *joined_faces([surface.vertices for surface in surfaces], [surface.faces for surface in surfaces]),
        support=any(surface.support for surface in surfaces),
        unit=next((surface.unit for surface in surfaces if surface.unit), ""),
    )


def regrouped(file: Path, surfaces: Sequence[PartSurface]) -> list[PartSurface]:
    """Join surfaces of the same name that are open, with a warning, as exporters write a part of several materials.

    Those that are closed each, or would be if flat holes were closed, are parts of their own, whatever their name:
    two blocks whose common face was left out are no rigid one.
    """
    of_name: dict[str, list[PartSurface]] = {}
    for surface in surfaces:
        of_name.setdefault(surface.name, []).append(surface)
    found: list[PartSurface] = []
    for surface in surfaces:
        group = of_name[surface.name]
        if len(group) == 1 or all(other.closed or closes(other.vertices, other.faces) for other in group):
            found.append(surface)
        elif surface is group[0]:
            called = f"called {surface.name}" if surface.name else "without a name"
            warn_of(file, f"{len(group)} open surfaces {called} were joined into one part")
            found.append(joined(surface.name, group))
    return found


def separated(file: Path, surfaces: Sequence[PartSurface]) -> list[PartSurface]:
    """Make a part of each separate solid, with a warning if the solids have a name in common.

    Blocks that are one rigid part hold each other, blocks that are several do not: what is not said to be one part
    is several.

    Raises:
        MeshError: solids that share edges, so that their surfaces do not show where one ends.
    """
    found: list[PartSurface] = []
    for surface in surfaces:
        one = surface.whole or surface.error
        solids = [surface.faces] if one else separate_solids(surface.vertices, surface.faces)
        if not solids:
            of = f" of {surface.name}" if surface.name else ""
            raise MeshError(
                f"surfaces{of} in {file} share edges and do not show where one part ends; "
                "give each part an object of its own, or put each part into a file of its own"
            )
        if len(solids) == 1:
            found.append(surface)
            continue
        names = [f"{surface.name}-{number}" if surface.name else "" for number in range(len(solids))]
        if surface.name:
            warn_of(
                file,
                f"object {surface.name} has {len(solids)} separate solids, which are the parts {names[0]} to "
                f"{names[-1]}; if they are one rigid part, put each part into a file of its own in a folder",
            )
        for name, faces in zip(names, solids, strict=True):
            part = PartSurface.from_faces(name, surface.vertices, faces)
            found.append(replace(surface, name=name, vertices=part.vertices, faces=part.faces))
    return found


def distinct_names(file: Path, names: Sequence[str]) -> list[str]:
    """Return a different name for each part: its own, with a number behind it if others have it too.

    Parts without a name, or with a blank one, are called by their numbers. Names that several parts have are warned of.
    """
    names = [name if name.strip() else "" for name in names]
    taken = {name for name in names if name}
    labels: dict[str, list[str]] = {}
    found: dict[str, None] = {}
    for number, name in enumerate(names):
        plain = label = name or str(number)
        suffix = 2
        while label in found or (label in taken and label != name):
            label, suffix = f"{plain}-{suffix}", suffix + 1
        found[label] = None
        labels.setdefault(name, []).append(label)
    for name, some in labels.items():
        if name and len(some) > 1:
            warn_of(file, f"{len(some)} objects are called {name}; they are the parts {listed(some)}")
    return list(found)

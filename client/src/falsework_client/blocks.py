"""Blocks, and their folder as falsework reads it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falsework_client.errors import ClientError

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length of a unit in metres."""


@dataclass(frozen=True)
class Block:
    """Rigid block as a closed mesh."""

    vertices: Sequence[Sequence[float]]
    """Three coordinates a vertex, in the unit of the structure, z up."""
    faces: Sequence[Sequence[int]]
    """Three or more vertices a face, counted from 0, counter-clockwise from outside."""
    name: str = ""
    """Its number if empty."""
    support: bool = False
    """Whether it is fixed for ever."""
    density: float | None = None
    """kg/m3; that of the structure if None."""


def names_of(blocks: Sequence[Block]) -> list[str]:
    """Return the name of each block.

    Raises:
        ClientError: two blocks have the same name.
    """
    names = [block.name or str(number) for number, block in enumerate(blocks)]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise ClientError(f"two blocks are named {name!r}; give each a name of its own, or none a name")
    return names


def write_folder(
    blocks: Sequence[Block],
    folder: str | Path,
    *,
    unit: str,
    friction: float | None = None,
    density: float | None = None,
    name: str = "blocks",
    ground: bool = False,
) -> None:
    """Write blocks as a folder of meshes with `assembly.json`, which every command of falsework reads.

    Args:
        blocks: of the structure; their order is that of the parts.
        folder: an empty or new folder.
        unit: of the coordinates, one of `UNITS`.
        friction: coefficient of friction of every contact; the default of falsework if None.
        density: of blocks without their own, kg/m3; the default of falsework if None.
        name: of the structure.
        ground: whether falsework will add a fixed ground, so that no block needs to be a support.

    Raises:
        ClientError: blocks or numbers that make no structure, or a folder that cannot be written.
    """
    check(blocks, unit, friction, density, ground)
    names = names_of(blocks)
    described: dict[str, Any] = {"format": "falsework.assembly/1", "name": name, "unit": unit}
    described["parts"] = len(blocks)
    described["names"] = names
    described["boundary"] = [number for number, block in enumerate(blocks) if block.support]
    if friction is not None:
        described["friction"] = friction
    if any(block.density is not None for block in blocks):
        usual = 2400.0 if density is None else density
        described["density"] = [usual if block.density is None else block.density for block in blocks]
    elif density is not None:
        described["density"] = density
    target = Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
        for number, block in enumerate(blocks):
            (target / f"{number}.obj").write_text(_obj_text(block), encoding="utf-8")
        (target / "assembly.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ClientError(f"cannot write {target}: {error.strerror or error}; name another folder") from None


def check(
    blocks: Sequence[Block], unit: str, friction: float | None, density: float | None, ground: bool = False
) -> None:
    """Refuse what makes no structure, before a service is started for it.

    Raises:
        ClientError: what is wrong, and what to do.
    """
    if unit not in UNITS:
        raise ClientError(f"unknown unit {unit!r}; use one of {', '.join(UNITS)}")
    if not blocks:
        raise ClientError("there are no blocks; give at least one support and one block")
    for what, value in [("friction", friction), ("density", density)] + [
        (f"the density of block {number}", block.density) for number, block in enumerate(blocks)
    ]:
        least = 0.0 if what == "friction" else math.ulp(0.0)
        if value is not None and not (math.isfinite(value) and value >= least):
            raise ClientError(f"{what} is {value}; give a {'' if what == 'friction' else 'positive '}number")
    for number, block in enumerate(blocks):
        called = f"block {number}" + (f" ({block.name})" if block.name else "")
        if not len(block.faces):
            raise ClientError(f"{called} has no faces; give a closed mesh")
        if any(len(vertex) != 3 or not all(map(math.isfinite, vertex)) for vertex in block.vertices):
            raise ClientError(f"{called} has a vertex that is not three finite numbers; mend its mesh")
        for face in block.faces:
            if len(face) < 3 or not all(0 <= corner < len(block.vertices) for corner in face):
                raise ClientError(
                    f"{called} has a face {list(face)[:6]}, but vertices 0 to {len(block.vertices) - 1}; mend its mesh"
                )
    if not ground and not any(block.support for block in blocks):
        raise ClientError("no block is a support, so all of them fall; mark at least one, or ask for a ground")


def center_of(block: Block) -> tuple[float, float, float] | None:
    """Return the centre of mass of a closed block in its own unit; None for a mesh without volume."""
    origin = block.vertices[block.faces[0][0]]
    total, sums = 0.0, [0.0, 0.0, 0.0]
    for face in block.faces:
        first, *others = ([value - o for value, o in zip(block.vertices[corner], origin)] for corner in face)
        for b, c in zip(others, others[1:]):
            volume = (
                first[0] * (b[1] * c[2] - b[2] * c[1])
                + first[1] * (b[2] * c[0] - b[0] * c[2])
                + first[2] * (b[0] * c[1] - b[1] * c[0])
            )
            total += volume
            for axis in range(3):
                sums[axis] += volume * (first[axis] + b[axis] + c[axis]) / 4
    if total == 0:
        return None
    x, y, z = (sums[axis] / total + origin[axis] for axis in range(3))
    return x, y, z


def _obj_text(block: Block) -> str:
    lines = ["v " + " ".join(repr(float(value)) for value in vertex) for vertex in block.vertices]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in block.faces]
    return "\n".join(lines) + "\n"

"""Random shells of five families, always the same for the same name: `barrel-0`, `dome-3`.

`barrel`: barrel vault whose voussoirs are staggered along the axis. `arcade`: arches side by side, which touch and are
not bonded. `groin`: two barrel vaults that cross over a square plan, with groin blocks that reach into both. `dome` and
`vault`: the built-in ones. Each has 30 to 150 parts that are no supports, and stands when it is complete.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle
from falsework.assembly import complete_state, library
from falsework.assembly.library.blocks import Solid, gather, loft, prism
from falsework.geometry import TriangleMesh

Array = NDArray[np.float64]

EACH = 4
"""Shells of a family."""
_LEAST, _MOST = 30, 150
"""Parts that are no supports."""
_DRAWS = 1000


def shell(name: str) -> Assembly:
    """Return the shell of a name.

    Raises:
        ValueError: no such shell.
    """
    family, _, number = name.rpartition("-")
    if family not in FAMILIES or not number.isdecimal():
        raise ValueError(f"there is no shell {name}; give one such as {', '.join(NAMES[:2])}")
    rng = np.random.default_rng((tuple(FAMILIES).index(family), int(number)))
    for _ in range(_DRAWS):
        assembly = FAMILIES[family](rng)
        fits = _LEAST <= int((~assembly.boundary).sum()) <= _MOST
        if (
            fits
            and StabilityOracle(assembly)
            .verdicts(complete_state(assembly.boundary), require_certificate=True)
            .stable[0]
        ):
            return assembly
    raise ValueError(f"no draw of {name} stands and has {_LEAST} to {_MOST} parts")


def _barrel(rng: np.random.Generator) -> Assembly:
    around, along = int(rng.integers(7, 16)), int(rng.integers(3, 9))
    return _made(_segments(rng, around, along, staggered=True))


def _arcade(rng: np.random.Generator) -> Assembly:
    around, along = int(rng.integers(7, 20)), int(rng.integers(3, 7))
    return _made(_segments(rng, around, along, staggered=False))


def _segments(rng: np.random.Generator, around: int, along: int, *, staggered: bool) -> Iterator[Solid]:
    """Yield the blocks of a segmental vault along x on two long supports."""
    opening = np.radians(rng.uniform(90, 150))
    radius, width = 1.0, rng.uniform(0.2, 0.45)
    thickness = radius * rng.uniform(0.14, 0.22)
    angle = np.linspace(-opening / 2, opening / 2, around + 1)
    inner, outer = _arc(radius - thickness / 2, angle), _arc(radius + thickness / 2, angle)
    for course in range(around):
        shift = 0.5 * (staggered and course % 2 == 1)
        cuts = width * np.unique(np.clip(np.arange(along + 2) - shift, 0, along))
        profile = [inner[course], inner[course + 1], outer[course + 1], outer[course]]
        for low, high in pairwise(cuts):
            yield _along("voussoir", profile, low, high)
    length = along * width
    for end, side in ((0, -1.0), (-1, 1.0)):
        far, low = outer[end] + (side * thickness, 0.0), inner[end][1] - thickness
        profile = [inner[end], outer[end], far, np.array([far[0], low]), np.array([inner[end][0], low])]
        yield _along("support", profile, -thickness, length + thickness, fixed=True)


def _groin(rng: np.random.Generator) -> Assembly:
    """Make webs of courses that run from the groins to the edges of a square, and one crown block.

    A course lies between two joints, which are planes through the axis of its barrel. On the diagonals the courses of
    two webs meet in the plane between them, where their first blocks are one.
    """
    courses, pieces = int(rng.integers(4, 7)), int(rng.integers(2, 5))
    opening = np.radians(rng.uniform(55, 70))
    thickness, springing = rng.uniform(0.12, 0.18), int(rng.integers(1, 3))
    angle = opening * (np.arange(courses + 1) + 0.5) / (courses + 0.5)
    inner, outer = _arc(1.0 - thickness / 2, angle), _arc(1.0 + thickness / 2, angle)
    edge = float(outer[-1][0])
    solids: list[tuple[str, list[Solid], bool]] = []
    first = np.array([inner[0], outer[0]])
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    levels = [np.column_stack([square * half, np.full(4, height)]) for half, height in first]
    solids.append(("crown", [loft("crown", levels[0], levels[1])], False))
    for turn in range(4):
        start = np.array([(first[k][0], y * first[k][0], first[k][1]) for k, y in ((0, -1), (0, 1), (1, 1), (1, -1))])
        for low, high in _cuts(start, edge, pieces, 0):
            solids.append(("web", [_turned(_between("web", low, high), turn)], False))
    for course in range(courses):
        corner = [inner[course], inner[course + 1], outer[course + 1], outer[course]]
        start = np.array([(y, y, z) for y, z in corner])
        fixed = course >= courses - springing
        web = _cuts(start, edge, pieces, course + 1) if not fixed else [(start, _at(start, edge))]
        for turn in range(4):
            both = [_turned(_between("groin", *web[0]), turn), _turned(_mirrored(*web[0]), turn)]
            solids.append(("support" if fixed else "groin", both, fixed))
            for low, high in web[1:]:
                solids.append(("web", [_turned(_between("web", low, high), turn)], False))
                solids.append(("web", [_turned(_mirrored(low, high), turn)], False))
    meshes, boundary = [], []
    for number, (kind, bodies, fixed) in enumerate(sorted(solids, key=lambda entry: entry[2])):
        parts = gather(bodies).meshes
        offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
        vertices = np.concatenate([part.vertices for part in parts])
        meshes.append(TriangleMesh.from_arrays(f"{kind}-{number}", vertices, faces))
        boundary.append(fixed)
    return Assembly.from_meshes(meshes, boundary=np.array(boundary))


def _cuts(start: Array, edge: float, pieces: int, course: int) -> list[tuple[Array, Array]]:
    """Return the ends of the blocks of a course from its four corners along x to an edge; odd ones are shifted."""
    begin = float(start[:, 0].max())
    count = max(1, round(pieces * (edge - begin) / edge))
    places = begin + (edge - begin) * (np.arange(1, count) + (0.25 if course % 2 else -0.1)) / count
    ends = [start, *(_at(start, place) for place in places), _at(start, edge)]
    return list(pairwise(ends))


def _at(corners: Array, x: float) -> Array:
    return np.column_stack([np.full(len(corners), x), corners[:, 1:]])


def _between(kind: str, low: Array, high: Array) -> Solid:
    """Return the block between two quadrilaterals, the first nearer to the crown."""
    normal = np.cross(low[1] - low[0], low[2] - low[1])
    turned = slice(None) if normal @ (high - low).mean(axis=0) > 0 else slice(None, None, -1)
    return loft(kind, low[turned], high[turned])


def _mirrored(low: Array, high: Array) -> Solid:
    """Return the block of the web on the other side of the diagonal."""
    swap = [1, 0, 2]
    return _between("groin", low[:, swap], high[:, swap])


def _turned(solid: Solid, quarters: int) -> Solid:
    turn = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    return Solid(solid.kind, solid.vertices @ np.linalg.matrix_power(turn, quarters).T, solid.rings, solid.fixed)


def _arc(radius: float, angle: Array) -> Array:
    """Return points of a circle at angles from its top, `(y, z)`, shape (points, 2)."""
    return radius * np.column_stack([np.sin(angle), np.cos(angle)])


def _along(kind: str, profile: list[Array], low: float, high: float, *, fixed: bool = False) -> Solid:
    """Return the prism over a polygon of (y, z) between two x."""
    base = np.array([(low, y, z) for y, z in profile])
    return prism(kind, base, (high - low, 0.0, 0.0), fixed=fixed)


def _made(solids: Iterator[Solid]) -> Assembly:
    blocks = gather(solids)
    return Assembly.from_meshes(list(blocks.meshes), boundary=blocks.boundary)


def _dome(rng: np.random.Generator) -> Assembly:
    rings, blocks, thickness = rng.integers(3, 8), rng.integers(8, 21), rng.uniform(0.1, 0.2)
    return library.build(f"dome:rings={rings},blocks={blocks},thickness={thickness:.3f}")


def _vault(rng: np.random.Generator) -> Assembly:
    parts, rise, thickness = rng.integers(35, 151), rng.uniform(0.8, 1.4), rng.uniform(0.1, 0.2)
    return library.build(f"vault:parts={parts},rise={rise:.2f},thickness={thickness:.3f}")


FAMILIES: dict[str, Callable[[np.random.Generator], Assembly]] = {
    "barrel": _barrel,
    "arcade": _arcade,
    "groin": _groin,
    "dome": _dome,
    "vault": _vault,
}
NAMES = tuple(f"{family}-{number}" for family in FAMILIES for number in range(EACH))

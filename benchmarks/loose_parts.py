"""Twenty assemblies with clearance, as models pose them: shafts, pins, drawers, lids, tenons, hinges, nested boxes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from fine_pairs import solid_of_revolution
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.library.blocks import gather
from falsework.assembly.library.voxels import surface
from falsework.geometry import TriangleMesh
from falsework.geometry.mesh.obj import obj_text
from falsework.geometry.mesh.polygon import triangles_of

Array = NDArray[np.float64]
Box = tuple[float, float, float, float, float, float]
"""Lowest and highest x, y and z: x0, x1, y0, y1, z0, z1."""
Assembled = Sequence[TriangleMesh]
Place = tuple[float, float, float]

_SIDES = 32
_UPRIGHT, _ALONG_Y, _ALONG_X = (0, 1, 2), (1, 2, 0), (2, 0, 1)
"""Where the coordinates of a solid that is drawn upright go."""


def boxed(name: str, solid: Sequence[Box], hollow: Sequence[Box] = ()) -> TriangleMesh:
    """Return the union of boxes without other boxes, both closed under touching faces."""
    boxes = np.array([*solid, *hollow]).reshape(-1, 3, 2)
    lines = [np.unique(np.round(boxes[:, axis], 9)) for axis in range(3)]
    middles = np.stack(np.meshgrid(*((line[1:] + line[:-1]) / 2 for line in lines), indexing="ij"), axis=-1)
    within = [((middles > box[:, 0]) & (middles < box[:, 1])).all(axis=-1) for box in boxes]
    filled = np.any(within[: len(solid)], axis=0) & ~np.any([np.zeros_like(within[0]), *within[len(solid) :]], axis=0)
    cells = frozenset((x, y, z) for x, y, z in np.argwhere(filled).tolist())
    mesh = gather([surface(name, cells, (1, 1, 1), (0, 0, 0))]).meshes[0]
    places = np.round(mesh.vertices).astype(int).T
    return TriangleMesh.from_arrays(
        name, np.stack([line[k] for line, k in zip(lines, places, strict=True)], 1), mesh.faces
    )


def turned(
    name: str, profile: ArrayLike, axes: tuple[int, int, int] = _UPRIGHT, at: Place = (0.0, 0.0, 0.0)
) -> TriangleMesh:
    """Return a solid of revolution of a polygon of radii and heights; its axis has a bore."""
    mesh = solid_of_revolution(name, profile, _SIDES)
    return TriangleMesh.from_arrays(name, mesh.vertices[:, np.argsort(axes)] + np.array(at), mesh.faces)


def rod(
    name: str,
    radius: float,
    low: float,
    high: float,
    axes: tuple[int, int, int] = _UPRIGHT,
    at: Place = (0.0, 0.0, 0.0),
) -> TriangleMesh:
    """Return a cylinder with a fine bore."""
    return turned(name, [(radius / 5, low), (radius, low), (radius, high), (radius / 5, high)], axes, at)


def bored(
    name: str,
    outline: Callable[[Array], Array],
    hole: Callable[[Array], Array],
    low: float,
    high: float,
    axes: tuple[int, int, int] = _UPRIGHT,
    at: Place = (0.0, 0.0, 0.0),
) -> TriangleMesh:
    """Return a prism with a hole through it, both given as radii over the angle about its axis."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rings = [(outline, low), (outline, high), (hole, high), (hole, low)]
    points = np.concatenate([np.c_[unit * radius(angle)[:, None], np.full(_SIDES, level)] for radius, level in rings])
    faces = []
    for ring in range(4):
        a, b = ring * _SIDES, (ring + 1) % 4 * _SIDES
        faces += [
            (a + i, a + j, b + j, b + i)
            for i, j in zip(range(_SIDES), np.roll(range(_SIDES), -1).tolist(), strict=True)
        ]
    points = points[:, np.argsort(axes)] + np.array(at)
    return TriangleMesh.from_arrays(name, points, triangles_of(name, points, faces))


def prism(name: str, outline: Sequence[tuple[float, float]], low: float, high: float) -> TriangleMesh:
    """Return a prism along y of an outline over x and z, counter-clockwise seen from where y is lower."""
    count = len(outline)
    points = np.array([(x, y, z) for y in (low, high) for x, z in outline])
    sides = [(i + count, (i + 1) % count + count, (i + 1) % count, i) for i in range(count)]
    faces = [tuple(range(count)), tuple(reversed(range(count, 2 * count))), *sides]
    return TriangleMesh.from_arrays(name, points, triangles_of(name, points, faces))


def round_at(radius: float) -> Callable[[Array], Array]:
    """Return a circle as radii over the angle."""
    return lambda angle: np.full(len(angle), radius)


def square_at(half: float) -> Callable[[Array], Array]:
    """Return a square as radii over the angle; the sides are along the axes."""
    return lambda angle: half / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))


def shaft_in_two_bearings(c: float) -> Assembled:
    """A shaft along y through two blocks."""
    blocks = [
        bored(f"bearing {n}", square_at(0.03), round_at(0.01 + c), y - 0.01, y + 0.01, _ALONG_Y, (0, 0, 0.03))
        for n, y in enumerate((-0.05, 0.05))
    ]
    return [*blocks, rod("shaft", 0.01, -0.08, 0.08, axes=_ALONG_Y, at=(0, 0, 0.03))]


def wheel_between_bearings(c: float) -> Assembled:
    """The same with a wheel on the shaft."""
    wheel = bored("wheel", round_at(0.025), round_at(0.01 + c), -0.01, 0.01, _ALONG_Y, (0, 0, 0.03))
    return [*shaft_in_two_bearings(c), wheel]


def dowelled_plates(c: float, count: int = 2) -> Assembled:
    """Plates on each other with a dowel through all."""
    plates = [
        bored(f"plate {n}", square_at(0.04), round_at(0.008 + c), n * (0.02 + c), n * (0.02 + c) + 0.02)
        for n in range(count)
    ]
    return [*plates, rod("dowel", 0.008, c / 2, count * (0.02 + c))]


def rings_on_a_post(c: float) -> Assembled:
    """Four rings around a post with a foot, with play between them."""
    post = turned("post", [(0.002, 0), (0.04, 0), (0.04, 0.01), (0.01, 0.01), (0.01, 0.06), (0.002, 0.06)])
    levels = [0.01 + c + n * (0.01 + c) for n in range(4)]
    rings = [bored(f"ring {n}", round_at(0.03), round_at(0.01 + c), low, low + 0.01) for n, low in enumerate(levels)]
    return [post, *rings]


def headed_bolt(c: float) -> Assembled:
    """A bolt whose head is above a washer on a bored block."""
    block = bored("block", square_at(0.03), round_at(0.006 + c), 0.0, 0.03)
    washer = bored("washer", round_at(0.012), round_at(0.006 + 2 * c), 0.03 + c, 0.033 + c)
    low = 0.033 + 2 * c
    bolt = [(0.001, 0.005), (0.006, 0.005), (0.006, low), (0.01, low), (0.01, low + 0.006), (0.001, low + 0.006)]
    return [block, washer, turned("bolt", bolt)]


def conical_plug(c: float) -> Assembled:
    """A plug above its conical seat."""
    seat = [(0.01, 0.0), (0.04, 0.0), (0.04, 0.03), (0.025, 0.03)]
    plug = [(0.002, 0.005 + c), (0.0125, 0.005 + c), (0.03, 0.04 + c), (0.002, 0.04 + c)]
    return [turned("seat", seat), turned("plug", plug)]


def piston(c: float) -> Assembled:
    """A piston above the bottom of its cylinder."""
    cylinder = [(0.004, 0), (0.03, 0), (0.03, 0.06), (0.02 + c, 0.06), (0.02 + c, 0.01), (0.004, 0.01)]
    return [turned("cylinder", cylinder), rod("piston", 0.02, 0.01 + c, 0.05)]


def hinge(c: float) -> Assembled:
    """Two leaves that lie flat, their knuckles in turn along a pin."""

    def leaf(name: str, side: int, knuckles: Sequence[int]) -> TriangleMesh:
        def box(near: float, far: float, first: float, last: float, high: float) -> Box:
            low, top = sorted((side * near, side * far))
            return low, top, first, last, 0.0, high

        spans = [(0.02 * k + c, 0.02 * (k + 1) - c) for k in knuckles]
        eyes = [box(-0.009, 0.009, *span, 0.012) for span in spans]
        arms = [box(0.009, 0.02, *span, 0.004) for span in spans]
        half = 0.003 + c
        bore = (-half, half, -1.0, 1.0, 0.006 - half, 0.006 + half)
        return boxed(name, [*eyes, *arms, box(0.012, 0.044, 0.0, 0.06, 0.004)], [bore])

    pin = boxed("pin", [(-0.003, 0.003, -0.005, 0.065, 0.003, 0.009)])
    return [leaf("left leaf", -1, (0, 2)), leaf("right leaf", 1, (1,)), pin]


def drawers(c: float, count: int = 1) -> Assembled:
    """Drawers in a case that is open in front."""
    height = 0.06 * count + 0.01
    holes = [(0.01, 0.19, -0.01, 0.14, 0.06 * n + 0.01, 0.06 * n + 0.06) for n in range(count)]
    case = boxed("case", [(0, 0.2, 0, 0.15, 0, height)], holes)
    drawn = []
    for n, (x, far, _, deep, low, high) in enumerate(holes):
        outer = (x + c, far - c, 0.0, deep - c, low + c, high - c)
        inner = (x + 0.01, far - 0.01, 0.01, deep - 0.01, low + 0.01, 1.0)
        drawn.append(boxed(f"drawer {n}", [outer], [inner]))
    return [case, *drawn]


def lidded_box(c: float) -> Assembled:
    """A lid with a lip that reaches into its box."""
    box = boxed("box", [(0, 0.1, 0, 0.08, 0, 0.05)], [(0.008, 0.092, 0.008, 0.072, 0.008, 1.0)])
    lip = (0.008 + c, 0.092 - c, 0.008 + c, 0.072 - c, 0.042 + c, 0.05 + c)
    return [box, boxed("lid", [(0, 0.1, 0, 0.08, 0.05 + c, 0.06 + c), lip])]


def sliding_lid(c: float) -> Assembled:
    """A lid in the grooves of a box that is open at one end above them."""
    groove = (0.006, 0.094, -0.1, 0.194, 0.04, 0.048)
    box = boxed(
        "box",
        [(0, 0.1, 0, 0.2, 0, 0.056)],
        [(0.01, 0.09, 0.01, 0.19, 0.008, 0.05), groove, (0.012, 0.088, -0.1, 0.188, 0.03, 0.1)],
    )
    return [box, boxed("lid", [(0.006 + c, 0.094 - c, -0.006, 0.194 - c, 0.04 + c, 0.048 - c)])]


def nested_boxes(c: float) -> Assembled:
    """Three open boxes in each other, none of which touches the next."""
    boxes = []
    for n in range(3):
        inset = n * (0.008 + c)
        low, far, wide = inset, 0.1 - inset, 0.08 - inset
        hollow = (low + 0.008, far - 0.008, low + 0.008, wide - 0.008, low + 0.008, 1.0)
        boxes.append(boxed(f"box {n}", [(low, far, low, wide, low, 0.07)], [hollow]))
    return boxes


def tenon(c: float) -> Assembled:
    """A post with a mortise through it, and a beam whose tenon in it carries the beam alone."""
    post = boxed("post", [(0, 0.05, 0, 0.05, 0, 0.15)], [(-1, 1, 0.015, 0.035, 0.1, 0.13)])
    beam = boxed(
        "beam", [(0.0, 0.05 + c, 0.015 + c, 0.035 - c, 0.1 + c, 0.13 - c), (0.05 + c, 0.1, 0.005, 0.045, 0.095, 0.135)]
    )
    return [post, beam]


def table(c: float) -> Assembled:
    """A top above four legs, whose tenons reach into it."""
    corners = [(x, y) for x in (0.0, 0.17) for y in (0.0, 0.07)]
    legs = [
        boxed(f"leg {n}", [(x, x + 0.03, y, y + 0.03, 0, 0.08), (x + 0.01, x + 0.02, y + 0.01, y + 0.02, 0.08, 0.095)])
        for n, (x, y) in enumerate(corners)
    ]
    holes = [(x + 0.01 - c, x + 0.02 + c, y + 0.01 - c, y + 0.02 + c, 0, 1) for x, y in corners]
    return [*legs, boxed("top", [(0, 0.2, 0, 0.1, 0.08 + c, 0.1 + c)], holes)]


def tongued_boards(c: float) -> Assembled:
    """Boards that stand on each other, tongue in groove."""
    boards = []
    for n in range(3):
        low = n * (0.05 + c)
        tongue = [(0, 0.2, 0.01, 0.02, low + 0.05, low + 0.058)] if n < 2 else []
        groove = [(-1, 1, 0.01 - c, 0.02 + c, low - 1, low + 0.008 + c)] if n else []
        boards.append(boxed(f"board {n}", [(0, 0.2, 0, 0.03, low, low + 0.05), *tongue], groove))
    return boards


def dovetail(c: float) -> Assembled:
    """A tail between the cheeks of a socket, along which alone it leaves."""
    socket = [
        (-0.03, 0),
        (0.03, 0),
        (0.03, 0.03),
        (0.01, 0.03),
        (0.017, 0.01),
        (-0.017, 0.01),
        (-0.01, 0.03),
        (-0.03, 0.03),
    ]
    tail = [
        (-0.0165 + c, 0.01 + c),
        (0.0165 - c, 0.01 + c),
        (0.0095 - c, 0.03 + c),
        (0.0095 - c, 0.05),
        (-0.0095 + c, 0.05),
        (-0.0095 + c, 0.03 + c),
    ]
    return [prism("socket", socket, 0.0, 0.06), prism("tail", tail, 0.0, 0.06)]


def keyed_shaft(c: float) -> Assembled:
    """A square shaft in a square bore, upright, with a key across it that rests on the block."""
    block = bored("block", square_at(0.04), square_at(0.01 + c), 0.0, 0.03)
    shaft = boxed("shaft", [(-0.01, 0.01, -0.01, 0.01, 0.002, 0.07)], [(-0.003 - c, 0.003 + c, -1, 1, 0.03, 0.045)])
    return [block, shaft, boxed("key", [(-0.003, 0.003, -0.03, 0.03, 0.03 + c, 0.042)])]


def sleeve(c: float) -> Assembled:
    """A sleeve around a post, and a cap above both."""
    post = turned("post", [(0.002, 0), (0.03, 0), (0.03, 0.01), (0.012, 0.01), (0.012, 0.07), (0.002, 0.07)])
    outer = bored("sleeve", round_at(0.02), round_at(0.012 + c), 0.01 + c, 0.06)
    cap = turned(
        "cap",
        [
            (0.003, 0.07 + c),
            (0.012 + c, 0.07 + c),
            (0.012 + c, 0.06 + 2 * c),
            (0.02, 0.06 + 2 * c),
            (0.02, 0.08),
            (0.003, 0.08),
        ],
    )
    return [post, outer, cap]


def placed(make: Callable[[float], Assembled], clearance: float, scale: float = 1.0, turn: float = 0.0) -> Assembled:
    """Return parts that are scaled and turned about the vertical, the clearance before it is scaled, in metres, rad."""
    matrix = scale * np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return [TriangleMesh.from_arrays(part.name, part.vertices @ matrix.T, part.faces) for part in make(clearance)]


LOOSE: dict[str, Callable[[], Assembled]] = {
    "shaft in two bearings": partial(placed, shaft_in_two_bearings, 1e-4),
    "wheel between bearings": partial(placed, wheel_between_bearings, 2e-4, 1.0, 0.3),
    "two dowelled plates": partial(placed, dowelled_plates, 3e-4),
    "four dowelled plates": partial(placed, partial(dowelled_plates, count=4), 5e-5, 20.0, 1.0),
    "rings on a post": partial(placed, rings_on_a_post, 2e-4, 0.1),
    "bolt with a head": partial(placed, headed_bolt, 1e-4, 1.0, 0.7),
    "conical plug": partial(placed, conical_plug, 4e-4),
    "piston": partial(placed, piston, 2e-4, 5.0),
    "hinge": partial(placed, hinge, 2e-4, 1.0, 0.5),
    "drawer": partial(placed, drawers, 5e-4, 2.0),
    "chest of three drawers": partial(placed, partial(drawers, count=3), 1e-3, 3.0, 0.2),
    "lid with a lip": partial(placed, lidded_box, 3e-4),
    "sliding lid": partial(placed, sliding_lid, 4e-4, 1.0, -0.6),
    "nested boxes": partial(placed, nested_boxes, 5e-4, 10.0),
    "tenon": partial(placed, tenon, 2e-4),
    "table": partial(placed, table, 3e-4, 5.0, 0.8),
    "tongued boards": partial(placed, tongued_boards, 5e-4),
    "dovetail": partial(placed, dovetail, 1e-4, 1.0, 1.2),
    "keyed shaft": partial(placed, keyed_shaft, 2e-4),
    "sleeve and cap": partial(placed, sleeve, 1e-4, 0.5, 0.4),
}
"""Assemblies by name: different fits, clearances of 0.05 to 1 mm before scaling, sizes of 5 mm to 2 m, and turns."""


def write_meshes(parts: Assembled, folder: Path) -> Path:
    """Write parts as a folder of meshes without any description."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, part in enumerate(parts):
        (folder / f"{number}.obj").write_text(obj_text(part), encoding="utf-8")
    return folder

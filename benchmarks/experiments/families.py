"""Families beside the built-in ones: walls with an opening, chimneys, Voronoi walls, piles, frames and sail vaults.

Three more are to validate on: towers of bars, heaps of Voronoi cells, and flat arches.

Each draws its own parameters and returns an assembly with fixed parts. Whether it stands is for the caller to check.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection

from falsework import Assembly
from falsework.assembly.library.blocks import Solid, box, gather, ground, loft, prism
from falsework.errors import InputError
from falsework.geometry import TriangleMesh

Draw = np.random.Generator
_SLIVER = 0.2
"""Shortest brick, as a share of a whole one."""
_CARRIED = 0.6
"""Least share of the underside of a brick of a pile that lies on others."""


def opening(draw: Draw) -> Assembly:
    """Wall in running bond with a door or a window under a lintel."""
    bricks, courses = int(draw.integers(4, 11)), int(draw.integers(4, 12))
    length, height, depth = draw.uniform(0.2, 0.35), draw.uniform(0.06, 0.15), draw.uniform(0.1, 0.25)
    left = int(draw.integers(1, bricks - 2))
    right = int(draw.integers(left + 1, bricks - 1))
    below = int(draw.integers(0, courses - 2))
    above = int(draw.integers(below + 1, courses - 1))
    gap, bearing = (left * length, right * length), draw.uniform(0.25, 0.6) * length
    lintel = gap[0] - bearing, gap[1] + bearing
    solids = []
    for course in range(courses):
        joints = np.arange(bricks + 1) * length
        if course % 2:
            joints = np.array([0.0, *(joints[:-1] + length / 2), bricks * length])
        hole = gap if below <= course < above else lintel if course == above else None
        if course == above:
            solids.append(_brick("lintel", *lintel, course * height, height, depth))
        for start, end in pairwise(joints):
            for low, high in _outside(start, end, hole):
                if high - low > _SLIVER * length:
                    solids.append(_brick("brick", low, high, course * height, height, depth))
    return _on_ground(solids, height)


def chimney(draw: Draw) -> Assembly:
    """Square shaft whose courses turn alternately one way and the other, a few bricks a side."""
    courses, each = int(draw.integers(2, 11)), int(draw.integers(1, 4))
    thickness, height = draw.uniform(0.1, 0.2), draw.uniform(0.08, 0.2)
    side = thickness * draw.uniform(2.5, 3.5) * each
    solids = []
    for course in range(courses):
        for quarter in range(4):
            cuts = np.linspace(0, side - thickness, each + 1)
            for low, high in pairwise(cuts):
                base = np.array([(low, 0), (high, 0), (high, thickness), (low, thickness)]) - side / 2
                if course % 2:
                    base = base * (-1, 1)
                turn = np.array([(0, -1), (1, 0)]) if quarter % 2 else np.eye(2)
                base = base @ turn.T * (-1 if quarter > 1 else 1)
                corners = np.column_stack([base, np.full(4, course * height)])
                solids.append(prism("brick", corners, (0.0, 0.0, height)))
    return _on_ground(solids, height)


def voronoi(draw: Draw) -> Assembly:
    """Wall between two fixed piers, cut into Voronoi cells straight through."""
    width, height, depth = draw.uniform(1.0, 3.0), draw.uniform(0.8, 1.6), draw.uniform(0.3, 0.6)
    count = int(np.exp(draw.uniform(np.log(5), np.log(70))))
    points = draw.uniform(size=(count, 2)) * (width, height)
    frame = shapely.box(0, 0, width, height)
    for _ in range(3):  # moved to the centres of their cells, points make rounder ones
        cells = [cell for cell in _cells(points, frame) if cell.area > 0]
        points = np.array([(cell.centroid.x, cell.centroid.y) for cell in cells])
    solids = []
    for cell in cells:
        corners = np.array(shapely.simplify(cell, 1e-9).exterior.coords)[:-1]
        base = np.column_stack([corners[:, 0], np.zeros(len(corners)), corners[:, 1]])
        solids.append(prism("cell", base, (0.0, depth, 0.0)))
    for low, high in ((-0.2, 0.0), (width, width + 0.2)):
        solids.append(box("pier", (low, 0.0, 0.0), (high, depth, height), fixed=True))
    return _on_ground(solids, 0.2)


def pile(draw: Draw) -> Assembly:
    """Layers of bricks of a few sizes on a grid, placed at random, each for the most part on others."""
    across, layers = draw.integers(2, 7, size=2), int(draw.integers(2, 8))
    cell, height = draw.uniform(0.05, 0.2), draw.uniform(0.04, 0.15)
    sizes = [(1, 2), (2, 1), (2, 2), (1, 3), (3, 1), (2, 4), (4, 2), (1, 1)]
    below = np.ones(across, dtype=bool)
    solids = []
    for layer in range(layers):
        here = np.zeros(across, dtype=bool)
        for _ in range(int(draw.integers(2, 4 + across.prod() // 2))):
            size = np.array(sizes[int(draw.integers(len(sizes)))])
            if (size > across).any():
                continue
            low = np.array([draw.integers(0, limit + 1) for limit in across - size])
            place = tuple(slice(a, a + b) for a, b in zip(low, size, strict=True))
            if here[place].any() or below[place].mean() < _CARRIED:
                continue
            here[place] = True
            corner = np.array([*(low * cell), layer * height])
            solids.append(box("brick", corner, corner + [*(size * cell), height]))
        below = here
    if not solids:
        raise InputError("no brick was drawn that fits the grid")
    return _on_ground(solids, height)


def frame(draw: Draw) -> Assembly:
    """Storeys of posts that carry planks, some of which reach beyond their posts."""
    width, depth, thick = draw.uniform(0.8, 2.5), draw.uniform(0.15, 0.4), draw.uniform(0.05, 0.12)
    solids, carriers, level = [], [(0.0, width)], 0.0
    for _ in range(int(draw.integers(2, 7))):
        height, post = draw.uniform(0.1, 0.4), draw.uniform(0.08, 0.15)
        posts: list[float] = []
        for place in draw.uniform(0, width, size=int(draw.integers(3, 12))):
            stands = any(low <= place and place + post <= high for low, high in carriers)
            if stands and all(abs(place - other) > 1.5 * post for other in posts):
                posts.append(float(place))
        posts.sort()
        solids += [box("post", (x, 0.0, level), (x + post, depth, level + height)) for x in posts]
        level += height
        carriers = []
        while posts:
            count = int(draw.integers(1, 4))
            mine, posts = posts[:count], posts[count:]
            before = carriers[-1][1] if carriers else -width
            after = posts[0] if posts else 2 * width
            reach = draw.uniform(0, 2 * post, size=2)
            carriers.append((max(mine[0] - reach[0], before), min(mine[-1] + post + reach[1], after)))
        solids += [box("plank", (low, 0.0, level), (high, depth, level + thick)) for low, high in carriers]
        level += thick
    if not solids:
        raise InputError("no post was drawn that stands on a plank")
    return _on_ground(solids, thick)


def sail(draw: Draw) -> Assembly:
    """Shell of courses over a rectangle, on two or four of its sides; all joints are planes through one point."""
    courses, pieces = (round(float(np.exp(draw.uniform(np.log(4), np.log(11))))) for _ in range(2))
    opening, thickness = np.radians(draw.uniform(20, 50, size=2)), draw.uniform(0.1, 0.25)
    flat, shift = draw.uniform(-0.2, 0.5, size=2), 0.5 * draw.integers(2)
    around = bool(draw.integers(2))
    rows = np.tan(np.linspace(-opening[0], opening[0], courses + 1))

    def corners(low: float, high: float, left: float, right: float, radius: float) -> NDArray[np.float64]:
        rays = np.array([(low, left, 1.0), (high, left, 1.0), (high, right, 1.0), (low, right, 1.0)])
        longer = 1.0 + (rays[:, :2] ** 2) @ flat
        return rays * (radius * longer / np.linalg.norm(rays, axis=1))[:, None]

    solids = []
    for course, (low, high) in enumerate(pairwise(rows)):
        cuts = np.clip(np.arange(pieces + 2) - shift * (course % 2), 0, pieces) / pieces
        columns = np.tan(np.unique(2 * cuts - 1) * opening[1])
        for number, (left, right) in enumerate(pairwise(columns)):
            fixed = course in (0, courses - 1) or (around and number in (0, len(columns) - 2))
            inner, outer = (corners(low, high, left, right, 1.0 + side * thickness / 2) for side in (-1, 1))
            solids.append(loft("support" if fixed else "block", inner, outer, fixed=fixed))
    blocks = gather(solids)
    return Assembly.from_meshes(list(blocks.meshes), boundary=blocks.boundary)


def tower(draw: Draw) -> Assembly:
    """Tower of layers of bars side by side, each across the one below, some of whose bars are not there."""
    layers, each = int(draw.integers(3, 16)), int(draw.integers(2, 5))
    width, height, gap = draw.uniform(0.05, 0.1), draw.uniform(0.03, 0.08), draw.uniform(0, 0.03)
    length, missing = each * (width + gap), draw.uniform(0, 0.5)
    solids = []
    for layer in range(layers):
        there = draw.random(each) >= missing
        there[draw.integers(each)] = True
        for place in np.flatnonzero(there) * (width + gap):
            low = np.array([0.0, place, layer * height]), np.array([length, place + width, (layer + 1) * height])
            turned = [corner[[1, 0, 2]] if layer % 2 else corner for corner in low]
            solids.append(box("bar", *turned))
    return _on_ground(solids, height)


def cells(draw: Draw) -> Assembly:
    """Heap that narrows upwards, cut into convex Voronoi cells, which are flat by a factor."""
    size, flat, narrow = draw.uniform(0.3, 1.0, size=3), draw.uniform(1.0, 3.0), draw.uniform(0.0, 0.5, size=2)
    count = round(float(np.exp(draw.uniform(np.log(6), np.log(50)))))
    sides = [(0.0, 0.0, -1.0, 0.0), (0.0, 0.0, 1.0, -size[2])]
    for axis, sign in ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        normal = np.array([*(sign * np.eye(2)[axis]), narrow[axis] * size[axis] / (2 * size[2])])
        sides.append((*normal, -size[axis] / 2))
    points = (draw.uniform(size=(8 * count, 3)) - (0.5, 0.5, 0.0)) * size
    walls = np.array(sides)
    points = points[(points @ walls[:, :3].T + walls[:, 3] < -0.02 * size.min()).all(axis=1)][:count]
    stretch = np.array([1.0, 1.0, flat**2])
    meshes = []
    for number, point in enumerate(points):
        others = np.delete(points, number, axis=0)
        away, middle = (others - point) * stretch, (others + point) / 2
        planes = np.column_stack([away, -(away * middle).sum(axis=1)])
        planes /= np.linalg.norm(planes[:, :3], axis=1)[:, None]
        found = HalfspaceIntersection(np.concatenate([planes, walls]), point).intersections
        meshes.append(_hull(f"cell-{number}", np.unique(found.round(9), axis=0)))
    slab = gather([ground(-size[:2] / 2, size[:2] / 2, margin=0.1, depth=0.1)]).meshes
    return Assembly.from_meshes([*meshes, *slab], boundary=[len(meshes)])


def flat(draw: Draw) -> Assembly:
    """Flat arches one on another, between two fixed piers: all joints of a course point to one place below."""
    courses, height, depth = int(draw.integers(1, 5)), draw.uniform(0.15, 0.4), draw.uniform(0.2, 0.5)
    focus, spread = draw.uniform(0.6, 2.0), draw.uniform(0.3, 0.8)
    solids, top = [], focus + courses * height
    for course in range(courses):
        low = focus + course * height
        joints = spread * np.linspace(-1, 1, int(draw.integers(3, 12)) + 1)
        for left, right in pairwise(joints):
            corners = [
                (t * z, 0.0, z) for t, z in ((left, low), (right, low), (right, low + height), (left, low + height))
            ]
            solids.append(prism("voussoir", corners, (0.0, depth, 0.0)))
    for side in (-1.0, 1.0):
        far = side * (spread * top + 0.3)
        corners = [
            (side * spread * focus, 0.0, focus),
            (far, 0.0, focus),
            (far, 0.0, top),
            (side * spread * top, 0.0, top),
        ]
        solids.append(prism("pier", corners, (0.0, depth, 0.0), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(list(blocks.meshes), boundary=blocks.boundary)


def _hull(name: str, corners: NDArray[np.float64]) -> TriangleMesh:
    """Return the convex hull of points."""
    hull = ConvexHull(corners)
    faces = hull.simplices.copy()
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    kept, faces = np.unique(faces, return_inverse=True)
    return TriangleMesh.from_arrays(name, corners[kept], faces.reshape(-1, 3))


def _outside(start: float, end: float, hole: tuple[float, float] | None) -> Iterator[tuple[float, float]]:
    if hole is None:
        yield start, end
        return
    yield start, min(end, hole[0])
    yield max(start, hole[1]), end


def _brick(kind: str, low: float, high: float, bottom: float, height: float, depth: float) -> Solid:
    return box(kind, (low, 0.0, bottom), (high, depth, bottom + height))


def _cells(points: NDArray[np.float64], frame: shapely.Polygon) -> list[shapely.Polygon]:
    diagram = shapely.voronoi_polygons(shapely.MultiPoint(points), extend_to=frame)
    cells = (shapely.intersection(cell, frame) for cell in diagram.geoms)
    return [cell for cell in cells if isinstance(cell, shapely.Polygon)]


def _on_ground(solids: list[Solid], depth: float) -> Assembly:
    corners = np.concatenate([solid.vertices for solid in solids])
    slab = ground(corners[:, :2].min(axis=0), corners[:, :2].max(axis=0), margin=depth, depth=depth)
    blocks = gather([*solids, slab])
    return Assembly.from_meshes(list(blocks.meshes), boundary=blocks.boundary)

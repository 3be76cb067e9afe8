"""A small renderer for pictures of blocks: orthographic, with depth buffer, shadows and edges, in software.

Plotting libraries sort whole polygons by depth, which is wrong for interlocking blocks; a depth buffer is right for
every pixel. Pictures need no display and no graphics driver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
"""Red, green, blue in 0..1, shape (height, width, 3)."""
Array = NDArray[np.float64]

INK = np.array([0.13, 0.14, 0.16])
NOTHING = -1
FLOOR = -2


@dataclass(frozen=True)
class Camera:
    """Orthographic view of a box."""

    azimuth: float = -58.0
    """Degrees about z; 0 looks along +y."""
    elevation: float = 24.0
    """Degrees above the horizon."""
    width: int = 640
    """Pixels."""
    height: int = 480
    zoom: float = 1.0
    """1 fits the box into the picture."""

    @property
    def axes(self) -> Array:
        """Rows are right, up and towards the viewer, shape (3, 3)."""
        a, e = np.radians([self.azimuth, self.elevation])
        right = np.array([np.cos(a), np.sin(a), 0.0])
        towards = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
        return np.stack([right, np.cross(towards, right), towards])

    def fit(self, bounds: Array) -> tuple[float, Array]:
        """Pixels per metre, and the point in the plane of the picture that is its middle, shape (2,)."""
        corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        flat = corners @ self.axes[:2].T
        low, high = flat.min(0), flat.max(0)
        return self.zoom * min(self.width / (high[0] - low[0]), self.height / (high[1] - low[1])), (low + high) / 2

    def project(self, points: Array, bounds: Array) -> Array:
        """Pixel coordinates of points, x to the right and y down, shape (..., 2)."""
        scale, center = self.fit(bounds)
        flat = (np.asarray(points) @ self.axes[:2].T - center) * scale
        return np.stack([self.width / 2 + flat[..., 0], self.height / 2 - flat[..., 1]], axis=-1)


@dataclass(frozen=True)
class Solid:
    """One mesh and its colour."""

    vertices: Array
    """Shape (vertices, 3), metres."""
    faces: NDArray[np.integer]
    """Shape (faces, 3), counter-clockwise from outside."""
    color: Sequence[float]
    """Red, green, blue in 0..1."""


def render(solids: Sequence[Solid], camera: Camera, bounds: Array, *, floor: bool = True, samples: int = 3) -> Image:
    """Picture of some solids.

    Args:
        solids: what to show.
        camera: how to look at it.
        bounds: lower and upper corner of the box that the picture shows, shape (2, 3), metres; the same for several
            pictures keeps their scale.
        floor: let a floor under the box catch shadows.
        samples: pixels are averaged over `samples` squared.
    """
    view = camera.axes
    width, height = camera.width * samples, camera.height * samples
    scale, center = camera.fit(bounds)
    scale *= samples

    triangles = np.concatenate([solid.vertices[solid.faces] for solid in solids])
    owner = np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    solid_faces = lengths > 0
    triangles, owner, normals = triangles[solid_faces], owner[solid_faces], normals[solid_faces]
    normals /= lengths[solid_faces, None]

    def on_screen(points: Array) -> Array:
        seen = points @ view.T
        x = (seen[..., 0] - center[0]) * scale + width / 2
        y = height / 2 - (seen[..., 1] - center[1]) * scale
        return np.stack([x, y, seen[..., 2]], axis=-1)

    face, depth = _depth_buffer(on_screen(triangles), normals @ view[2], width, height)

    # Back from pixels to points in space.
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    across = (column - width / 2) / scale + center[0]
    upward = (height / 2 - row) / scale + center[1]
    hit = face >= 0
    ground = float(bounds[0, 2])
    depth = np.where(hit, depth, 0.0)
    if floor:
        # The floor is z = ground: solve for the distance towards the viewer at which each pixel's line meets it.
        floor_depth = (ground - across * view[0, 2] - upward * view[1, 2]) / view[2, 2]
        depth = np.where(hit, depth, floor_depth)
    points = across[..., None] * view[0] + upward[..., None] * view[1] + depth[..., None] * view[2]
    normal = np.where(hit[..., None], normals[face], np.array([0.0, 0.0, 1.0]))

    light = _unit(0.55 * view[2] - 0.55 * view[0] + np.array([0.0, 0.0, 0.95]))
    lit = _lit(points, normal, triangles, normals, light, bounds)
    colors = np.array([solid.color for solid in solids], dtype=float)
    facing = np.clip(normal @ light, 0, 1)
    sky = 0.5 + 0.5 * normal[..., 2]
    strength = 0.40 + 0.17 * sky + 0.49 * facing * lit
    part = np.where(hit, owner[face], NOTHING)
    image = np.where(hit[..., None], colors[part] * strength[..., None], 1.0)
    if floor:
        shade = 1.0 - 0.20 * (1.0 - lit)
        image = np.where(hit[..., None], image, shade[..., None])
    image = np.clip(image, 0, 1)

    line = _edges(part, normal, depth, hit, 1.5 * samples / scale)
    for _ in range(max(1, samples // 2) - 1):
        line = line | np.roll(line, 1, 0) | np.roll(line, 1, 1)
    image = np.where(line[..., None], 0.35 * image + 0.65 * INK, image)
    return image.reshape(camera.height, samples, camera.width, samples, 3).mean((1, 3))


def _lit(points: Array, normal: Array, triangles: Array, normals: Array, light: Array, bounds: Array) -> Array:
    """Share of the light that reaches each point: 0 in shadow, 1 in light, between at soft rims."""
    size = 1400
    side = _unit(np.cross(light, [0.0, 0.0, 1.0]))
    axes = np.stack([side, np.cross(light, side), light])
    reach = float(np.linalg.norm(bounds[1] - bounds[0]))
    middle = axes[:2] @ bounds.mean(0)
    scale = size / (1.3 * reach)

    def in_light(where: Array) -> Array:
        seen = where @ axes.T
        return np.concatenate([(seen[..., :2] - middle) * scale + size / 2, seen[..., 2:]], axis=-1)

    # All faces cast shadows, also those that face away from the light: thin and open shapes then do too.
    _, nearest = _depth_buffer(in_light(triangles), np.ones(len(triangles)), size, size)
    seen = in_light(points + normal * 0.004 * reach)
    total = np.zeros(points.shape[:2])
    offsets = [(x, y) for x in (-2.5, 0.0, 2.5) for y in (-2.5, 0.0, 2.5)]
    for dx, dy in offsets:
        x = np.clip(seen[..., 0] + dx, 0, size - 1).astype(np.int64)
        y = np.clip(seen[..., 1] + dy, 0, size - 1).astype(np.int64)
        total += seen[..., 2] > nearest[y, x] - 0.003 * reach
    return total / len(offsets)


def _edges(part: NDArray[np.integer], normal: Array, depth: Array, hit: NDArray[np.bool_], jump: float) -> NDArray:
    """Pixels where one part ends or a part has a sharp edge."""
    line = np.zeros(part.shape, dtype=bool)
    for axis in (0, 1):
        here, there = [np.s_[:-1], np.s_[1:]] if axis == 0 else [np.s_[:, :-1], np.s_[:, 1:]]
        other = part[here] != part[there]
        crease = (normal[here] * normal[there]).sum(-1) < np.cos(np.radians(30))
        step = np.abs(depth[here] - depth[there]) > 12 * jump
        line[here] |= (hit[here] | hit[there]) & (other | crease | (step & other))
    return line


def _unit(vector: Array | Sequence[float]) -> Array:
    vector = np.asarray(vector, dtype=float)
    return vector / np.linalg.norm(vector)


@numba.njit(cache=True)
def _depth_buffer(triangles, facing, width, height):  # pragma: no cover - compiled
    """Index of the nearest triangle at each pixel (-1 where there is none) and its depth."""
    face = np.full((height, width), -1, dtype=np.int64)
    depth = np.full((height, width), -np.inf)
    for index in range(len(triangles)):
        if facing[index] <= 0:
            continue
        (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = triangles[index]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0:
            continue
        left, right = max(int(np.floor(min(x0, x1, x2))), 0), min(int(np.ceil(max(x0, x1, x2))), width - 1)
        top, bottom = max(int(np.floor(min(y0, y1, y2))), 0), min(int(np.ceil(max(y0, y1, y2))), height - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                a = ((x1 - x) * (y2 - y) - (x2 - x) * (y1 - y)) / area
                b = ((x2 - x) * (y0 - y) - (x0 - x) * (y2 - y)) / area
                c = 1.0 - a - b
                if a >= -1e-9 and b >= -1e-9 and c >= -1e-9:
                    z = a * z0 + b * z1 + c * z2
                    if z > depth[row, column]:
                        depth[row, column] = z
                        face[row, column] = index
    return face, depth

"""Software renderer for pictures of blocks: orthographic, with depth buffer, shadows and edges.

Plotting libraries sort whole polygons by depth, which is wrong for interlocking blocks; a depth buffer is right for
every pixel. Pictures need no display and no graphics driver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
"""Red, green, blue in 0..1, shape (height, width, 3)."""
Array = NDArray[np.float64]

INK = np.array([0.13, 0.14, 0.16])
SHADOW = 1000
"""Pixels along an edge of the shadow map."""
_LEVEL = 1e-6
"""Sine of the elevation below which a camera is level."""


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
        right = np.array([np.cos(a), np.sin(a), 0.0], dtype=np.float64)
        towards = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
        return np.stack([right, np.cross(towards, right), towards])

    def fit(self, bounds: Array) -> tuple[float, Array]:
        """Return pixels per metre, and the point in the plane of the picture that is its middle, shape (2,)."""
        corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        flat = corners @ self.axes[:2].T
        low, high = flat.min(0), flat.max(0)
        return self.zoom * min(self.width / (high[0] - low[0]), self.height / (high[1] - low[1])), (low + high) / 2

    def project(self, points: Array, bounds: Array) -> Array:
        """Return pixel coordinates of points, x to the right and y down, shape (..., 2)."""
        scale, center = self.fit(bounds)
        flat = (np.asarray(points) @ self.axes[:2].T - center) * scale
        return np.stack([self.width / 2 + flat[..., 0], self.height / 2 - flat[..., 1]], axis=-1)


@dataclass(frozen=True)
class ColoredSolid:
    """Mesh with one colour."""

    vertices: Array
    """Shape (vertices, 3), metres."""
    faces: NDArray[np.integer]
    """Shape (faces, 3), counter-clockwise from outside."""
    color: Sequence[float]
    """Red, green, blue in 0..1."""
    opacity: float = 1.0
    """Below 1 solids behind show through; of several such solids behind each other only the nearest shows."""


def render(
    solids: Sequence[ColoredSolid], camera: Camera, bounds: Array, *, floor: bool = True, samples: int = 3
) -> Image:
    """Return the picture of some solids.

    Args:
        solids: solids to show.
        camera: view of it.
        bounds: lower and upper corner of the box that the picture shows, shape (2, 3), metres; the same for several
            pictures keeps their scale.
        floor: let a floor under the box catch shadows.
        samples: pixels are averaged over `samples` squared.
    """
    opaque = [solid for solid in solids if solid.opacity >= 1]
    ghosts = [solid for solid in solids if 0 < solid.opacity < 1]
    eye = _Eye(camera, np.asarray(bounds, dtype=float), samples)
    image, depth = eye.draw(_Surface.of(opaque), floor=floor)
    if ghosts:
        veil, _ = eye.draw(_Surface.of(ghosts), floor=False, behind=depth)
        _lay_over(image, veil)
    return _average(image, samples)


@dataclass(frozen=True)
class _Surface:
    """Triangles of several solids."""

    triangles: Array
    """Shape (triangles, 3, 3)."""
    normals: Array
    """Unit, shape (triangles, 3)."""
    owner: NDArray[np.int64]
    """Solid that each triangle belongs to."""
    colors: Array
    """Of the solids, with opacity, shape (solids, 4)."""

    @classmethod
    def of(cls, solids: Sequence[ColoredSolid]) -> _Surface:
        if not solids:
            return cls(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0, dtype=np.int64), np.ones((1, 4)))
        triangles = np.concatenate([np.asarray(solid.vertices, dtype=float)[solid.faces] for solid in solids])
        owner = np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids])
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        proper = lengths > 0
        colors = np.array([(*solid.color, solid.opacity) for solid in solids], dtype=float)
        return cls(triangles[proper], normals[proper] / lengths[proper, None], owner[proper], colors)


class _Eye:
    """Renderer of surfaces for one camera, with light and shadows."""

    def __init__(self, camera: Camera, bounds: Array, samples: int) -> None:
        self._view = camera.axes
        self._size = camera.width * samples, camera.height * samples
        scale, self._center = camera.fit(bounds)
        self._scale = scale * samples
        self._bounds = bounds
        self._light = _unit(0.55 * self._view[2] - 0.55 * self._view[0] + np.array([0.0, 0.0, 0.95]))
        side = _unit(np.cross(self._light, [0.0, 0.0, 1.0]))
        self._light_axes = np.stack([side, np.cross(self._light, side), self._light])
        self._reach = float(np.linalg.norm(bounds[1] - bounds[0]))

    def draw(self, surface: _Surface, *, floor: bool, behind: Array | None = None) -> tuple[NDArray[np.float32], Array]:
        """Return red, green, blue times opacity, and opacity, shape (height, width, 4), and the depth at each pixel.

        Args:
            surface: surface to draw.
            floor: draw the floor, and white where there is nothing; otherwise nothing is drawn there.
            behind: only surfaces nearer than this are drawn, shape (height, width).
        """
        width, height = self._size
        floor = floor and bool(abs(self._view[2, 2]) > _LEVEL)  # a level camera sees the floor as a line
        face, depth = _depth_buffer(self._on_screen(surface.triangles), surface.normals @ self._view[2], width, height)
        if behind is not None:
            face[depth <= behind] = -1
        light_scale = SHADOW / (1.3 * self._reach)
        middle = self._light_axes[:2] @ self._bounds.mean(0)
        shadow = np.full((SHADOW, SHADOW), -np.inf)
        if behind is None and len(surface.triangles):
            seen = surface.triangles @ self._light_axes.T
            seen[..., :2] = (seen[..., :2] - middle) * light_scale + SHADOW / 2
            # All faces cast shadows, also those that face away from the light: thin and open shapes then do too.
            _, shadow = _depth_buffer(seen, np.ones(len(seen)), SHADOW, SHADOW)
        image = _shade(
            face, depth, surface.normals, surface.owner, surface.colors,
            self._view, self._center, self._scale, float(self._bounds[0, 2]), behind is None, floor,
            self._light_axes, middle, light_scale, shadow, self._reach, INK,
        )  # fmt: skip
        return image, depth

    def _on_screen(self, points: Array) -> Array:
        width, height = self._size
        seen = points @ self._view.T
        seen[..., 0] = (seen[..., 0] - self._center[0]) * self._scale + width / 2
        seen[..., 1] = height / 2 - (seen[..., 1] - self._center[1]) * self._scale
        return seen


def _unit(vector: Any) -> Array:
    vector = np.asarray(vector, dtype=float)
    return vector / np.linalg.norm(vector)


@numba.njit(cache=True, nogil=True)
def _lay_over(image, veil):  # pragma: no cover - compiled
    """Blend a picture with opacity into one without, in place."""
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            share = veil[row, column, 3]
            if share > 0:
                for channel in range(4):
                    image[row, column, channel] = image[row, column, channel] * (1 - share) + veil[row, column, channel]


@numba.njit(cache=True, nogil=True)
def _average(image, samples):  # pragma: no cover - compiled
    """Return the mean over squares of pixels, without opacity."""
    height, width = image.shape[0] // samples, image.shape[1] // samples
    mean = np.zeros((height, width, 3))
    for row in range(height * samples):
        for column in range(width * samples):
            for channel in range(3):
                mean[row // samples, column // samples, channel] += image[row, column, channel]
    return mean / samples**2


@numba.njit(cache=True, nogil=True)
def _depth_buffer(triangles, facing, width, height):  # pragma: no cover - compiled
    """Return the index of the nearest triangle at each pixel (-1 where there is none) and its depth."""
    face = np.full((height, width), -1, dtype=np.int64)
    depth = np.full((height, width), -np.inf)
    for index in range(len(triangles)):
        if facing[index] <= 0:
            continue
        x0, y0, z0 = triangles[index, 0]
        x1, y1, z1 = triangles[index, 1]
        x2, y2, z2 = triangles[index, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0:
            continue
        left, right = max(int(np.floor(min(x0, x1, x2))), 0), min(int(np.ceil(max(x0, x1, x2))), width - 1)
        top, bottom = max(int(np.floor(min(y0, y1, y2))), 0), min(int(np.ceil(max(y0, y1, y2))), height - 1)
        # Barycentric coordinates are linear in x: a value at x = 0 of each row, and a slope.
        a_slope, b_slope = (y1 - y2) / area, (y2 - y0) / area
        for row in range(top, bottom + 1):
            y = row + 0.5
            a_here = (x1 * (y2 - y) - x2 * (y1 - y)) / area
            b_here = (x2 * (y0 - y) - x0 * (y2 - y)) / area
            for column in range(left, right + 1):
                x = column + 0.5
                a = a_here + a_slope * x
                b = b_here + b_slope * x
                c = 1.0 - a - b
                if a >= -1e-9 and b >= -1e-9 and c >= -1e-9:
                    z = a * z0 + b * z1 + c * z2
                    if z > depth[row, column]:
                        depth[row, column] = z
                        face[row, column] = index
    return face, depth


@numba.njit(cache=True, nogil=True)
def _shade(
    face, depth, normals, owner, colors, view, center, scale, ground, whole, floor,
    light_axes, middle, light_scale, shadow, reach, ink,
):  # fmt: skip  # pragma: no cover - compiled
    """Return colours of pixels whose nearest triangle is known: light, shadow and edges."""
    height, width = face.shape
    size = shadow.shape[0]
    image = np.zeros((height, width, 4), dtype=np.float32)
    light = light_axes[2]
    jump = 18.0 / scale
    lift = 0.004 * reach
    crease = np.cos(np.radians(30.0))
    for row in range(height):
        for column in range(width):
            index = face[row, column]
            across = (column + 0.5 - width / 2) / scale + center[0]
            upward = (height / 2 - row - 0.5) / scale + center[1]
            if index >= 0:
                deep = depth[row, column]
                nx, ny, nz = normals[index]
            elif floor:
                # The floor is z = ground: how far towards the viewer each pixel's line meets it.
                deep = (ground - across * view[0, 2] - upward * view[1, 2]) / view[2, 2]
                nx, ny, nz = 0.0, 0.0, 1.0
            else:
                if whole:
                    image[row, column] = 1.0
                continue
            lit = 1.0
            if whole:
                # A little off the surface, so that it does not shade itself.
                px = across * view[0, 0] + upward * view[1, 0] + deep * view[2, 0] + nx * lift
                py = across * view[0, 1] + upward * view[1, 1] + deep * view[2, 1] + ny * lift
                pz = across * view[0, 2] + upward * view[1, 2] + deep * view[2, 2] + nz * lift
                x = light_axes[0, 0] * px + light_axes[0, 1] * py + light_axes[0, 2] * pz
                y = light_axes[1, 0] * px + light_axes[1, 1] * py + light_axes[1, 2] * pz
                x = (x - middle[0]) * light_scale + size / 2
                y = (y - middle[1]) * light_scale + size / 2
                z = light[0] * px + light[1] * py + light[2] * pz + 0.75 * lift
                reached = 0
                for i in range(-1, 2):
                    for j in range(-1, 2):
                        u = min(max(int(x + 1.8 * i), 0), size - 1)
                        v = min(max(int(y + 1.8 * j), 0), size - 1)
                        if z > shadow[v, u]:
                            reached += 1
                lit = reached / 9.0
            if index < 0:
                image[row, column] = 1.0 - 0.20 * (1.0 - lit)
                continue
            facing = max(nx * light[0] + ny * light[1] + nz * light[2], 0.0)
            strength = 0.40 + 0.17 * (0.5 + 0.5 * nz) + 0.49 * facing * lit
            solid = owner[index]
            for channel in range(3):
                image[row, column, channel] = min(colors[solid, channel] * strength, 1.0) * colors[solid, 3]
            image[row, column, 3] = colors[solid, 3]
    # Lines where one solid ends or has a sharp edge.
    for row in range(height - 1):
        for column in range(width - 1):
            here = face[row, column]
            for k in range(2):
                there = face[row + 1, column] if k == 0 else face[row, column + 1]
                if here == there:
                    continue
                if here >= 0 and there >= 0 and owner[here] == owner[there]:
                    step = abs(depth[row, column] - (depth[row + 1, column] if k == 0 else depth[row, column + 1]))
                    bend = 0.0
                    for axis in range(3):
                        bend += normals[here, axis] * normals[there, axis]
                    if bend >= crease and step <= jump:
                        continue
                strength = 1.0
                if here >= 0:
                    strength = colors[owner[here], 3]
                else:
                    strength = colors[owner[there], 3]
                for channel in range(3):
                    image[row, column, channel] = 0.35 * image[row, column, channel] + 0.65 * ink[channel] * strength
                if not whole:
                    image[row, column, 3] = 0.35 * image[row, column, 3] + 0.65 * strength
                break
    return image

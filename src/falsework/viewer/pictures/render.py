"""Software renderer for pictures of blocks: orthographic, with depth buffer, shadows and edges.

Plotting libraries sort whole polygons by depth, which is wrong for interlocking blocks; a depth buffer is right for
every pixel. Pictures need no display and no graphics driver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.arrays import box_corners
from falsework.geometry.mesh.mesh import unit_normals
from falsework.viewer.pictures.raster import average, depth_buffer, lay_over, shade

Image = NDArray[np.float64]
"""Red, green, blue in 0..1, shape (height, width, 3)."""
Array = NDArray[np.float64]

INK = np.array([0.13, 0.14, 0.16])
"""Colour of edges, shares of red, green and blue."""
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
    samples: int = 3
    """Pixels are averaged over so many squared."""

    def __post_init__(self) -> None:
        if not np.isfinite([self.azimuth, self.elevation]).all():
            raise InputError(
                f"a view from {self.azimuth:g} and {self.elevation:g} degrees does not exist; give numbers"
            )

    @property
    def axes(self) -> Array:
        """Rows are right, up and towards the viewer, shape (3, 3)."""
        a, e = np.radians([self.azimuth, self.elevation])
        right = np.array([np.cos(a), np.sin(a), 0.0], dtype=np.float64)
        towards = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
        return np.stack([right, np.cross(towards, right), towards])

    def fit(self, bounds: Array) -> tuple[float, Array]:
        """Return pixels per metre, and the point in the plane of the picture that is its middle, shape (2,)."""
        flat = box_corners(bounds) @ self.axes[:2].T
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


def render(solids: Sequence[ColoredSolid], camera: Camera, bounds: Array, *, floor: bool = True) -> Image:
    """Return the picture of some solids.

    Args:
        bounds: lower and upper corner of the box that the picture shows, shape (2, 3), metres; the same for several
            pictures keeps their scale.
    """
    opaque = [solid for solid in solids if solid.opacity >= 1]
    ghosts = [solid for solid in solids if 0 < solid.opacity < 1]
    eye = _Eye(camera, np.asarray(bounds, dtype=float))
    image, depth = eye.draw(_Surface.from_solids(opaque), floor=floor)
    if ghosts:
        veil, _ = eye.draw(_Surface.from_solids(ghosts), floor=False, behind=depth)
        lay_over(image, veil)
    mean = np.zeros((camera.height, camera.width, 3))
    average(image, camera.samples, mean)
    return mean


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
    def from_solids(cls, solids: Sequence[ColoredSolid]) -> _Surface:
        if not solids:
            return cls(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty(0, dtype=np.int64), np.ones((1, 4)))
        triangles = np.concatenate([np.asarray(solid.vertices, dtype=float)[solid.faces] for solid in solids])
        owner = np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids])
        normals, proper = unit_normals(triangles)
        colors = np.array([(*solid.color, solid.opacity) for solid in solids], dtype=float)
        return cls(triangles[proper], normals, owner[proper], colors)


class _Eye:
    """Renderer of surfaces for one camera, with light and shadows."""

    def __init__(self, camera: Camera, bounds: Array) -> None:
        self._view = camera.axes
        self._size = camera.width * camera.samples, camera.height * camera.samples
        scale, self._center = camera.fit(bounds)
        self._scale = scale * camera.samples
        self._bounds = bounds
        self._light = _unit(0.55 * self._view[2] - 0.55 * self._view[0] + np.array([0.0, 0.0, 0.95]))
        side = _unit(np.cross(self._light, [0.0, 0.0, 1.0]))
        self._light_axes = np.stack([side, np.cross(self._light, side), self._light])
        self._reach = float(np.linalg.norm(bounds[1] - bounds[0]))

    def draw(self, surface: _Surface, *, floor: bool, behind: Array | None = None) -> tuple[NDArray[np.float32], Array]:
        """Return red, green, blue times opacity, and opacity, shape (height, width, 4), and the depth at each pixel.

        Args:
            floor: draw the floor, and white where there is nothing; otherwise nothing is drawn there.
            behind: only surfaces nearer than this are drawn, shape (height, width).
        """
        width, height = self._size
        floor = floor and bool(abs(self._view[2, 2]) > _LEVEL)  # a level camera sees the floor as a line
        face, depth = _nearest(self._on_screen(surface.triangles), surface.normals @ self._view[2], width, height)
        if behind is not None:
            face[depth <= behind] = -1
        light_scale = SHADOW / (1.3 * self._reach)
        middle = self._light_axes[:2] @ self._bounds.mean(0)
        shadow = np.full((SHADOW, SHADOW), -np.inf)
        if behind is None and len(surface.triangles):
            seen = surface.triangles @ self._light_axes.T
            seen[..., :2] = (seen[..., :2] - middle) * light_scale + SHADOW / 2
            # All faces cast shadows, also those that face away from the light: thin and open shapes then do too.
            _, shadow = _nearest(seen, np.ones(len(seen)), SHADOW, SHADOW)
        image = np.zeros((height, width, 4), dtype=np.float32)
        shade(
            face, depth, surface.normals, surface.owner, surface.colors,
            self._view, self._center, self._scale, float(self._bounds[0, 2]), behind is None, floor,
            self._light_axes, middle, light_scale, shadow, self._reach, INK, image,
        )  # fmt: skip
        return image, depth

    def _on_screen(self, points: Array) -> Array:
        width, height = self._size
        seen = points @ self._view.T
        seen[..., 0] = (seen[..., 0] - self._center[0]) * self._scale + width / 2
        seen[..., 1] = height / 2 - (seen[..., 1] - self._center[1]) * self._scale
        return seen


def _nearest(triangles: Array, facing: Array, width: int, height: int) -> tuple[NDArray[np.int64], Array]:
    """Return the index of the nearest triangle at each pixel (-1 where there is none) and its depth."""
    face = np.full((height, width), -1, dtype=np.int64)
    depth = np.full((height, width), -np.inf)
    depth_buffer(np.ascontiguousarray(triangles), facing, face, depth)
    return face, depth


def _unit(vector: Any) -> Array:
    vector = np.asarray(vector, dtype=float)
    return vector / np.linalg.norm(vector)

"""Random rows of blocks between abutments and random stacks on slopes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly
from falsework.geometry import TriangleMesh

_FACES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4)]
_FACES += [(1, 5, 7), (1, 7, 3)]


def prism(name: str, low: NDArray, high: NDArray, depth: float, turn: NDArray) -> TriangleMesh:
    """Prism over a quadrilateral in the plane of x and z.

    Args:
        name: of the part.
        low: x and z of the lower and upper end of its left side, shape (2, 2).
        high: the same of its right side.
        depth: along y.
        turn: rotation of the whole.
    """
    corners = [(side[k][0], y, side[k][1]) for side in (low, high) for y in (0.0, depth) for k in (0, 1)]
    return TriangleMesh.from_arrays(name, np.array(corners) @ turn.T, _FACES)


class RandomScenes:
    """Assemblies drawn at random; the same seed gives the same."""

    @staticmethod
    def row(rng: np.random.Generator) -> Assembly:
        """One to four blocks in a row between two fixed abutments, with joints that lean at random."""
        count = int(rng.integers(1, 5))
        height, depth = rng.uniform(0.3, 1.0), rng.uniform(0.3, 1.0)
        middle = np.cumsum(np.r_[0.0, rng.uniform(0.7, 1.3, count)])
        lean = np.tan(rng.uniform(-0.5, 0.5, count + 1)) * height * rng.uniform(0.2, 1.0)
        lean = np.clip(lean, -0.3, 0.3)
        joints = [np.array([(x - a, 0.0), (x + a, height)]) for x, a in zip(middle, lean, strict=True)]
        outer = [joints[0] - [0.8, 0.0], joints[-1] + [0.8, 0.0]]
        sides = [outer[0], *joints, outer[1]]
        angle = rng.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        blocks = [prism(f"b{k}", sides[k], sides[k + 1], depth, turn) for k in range(count + 2)]
        return Assembly.from_meshes(blocks, boundary=[0, count + 1], friction=float(rng.uniform(0.05, 1.0)))

    @staticmethod
    def slope(rng: np.random.Generator) -> Assembly:
        """One to three blocks on one another on a slope, perhaps with a fixed stop beside the lowest."""
        count, tilt = int(rng.integers(1, 4)), rng.uniform(-0.6, 0.6)
        turn_y = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
        angle = rng.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]) @ turn_y

        def box(name: str, x: tuple[float, float], z: tuple[float, float]) -> TriangleMesh:
            left = np.array([(x[0], z[0]), (x[0], z[1])])
            return prism(name, left, left + [x[1] - x[0], 0.0], 1.0, turn)

        blocks, top = [box("base", (-3.0, 5.0), (-0.3, 0.0))], 0.0
        for k in range(count):
            height, shift = rng.uniform(0.2, 0.8), rng.uniform(-0.3, 0.3) if k else 0.0
            blocks.append(box(f"b{k}", (shift, shift + rng.uniform(0.6, 1.2)), (top, top + height)))
            top += height
        fixed = [0]
        if rng.random() < 0.5:
            first = blocks[1].vertices @ turn
            edge = float(first[:, 0].max()) if tilt > 0 else float(first[:, 0].min())
            stop = (edge, edge + 0.3) if tilt > 0 else (edge - 0.3, edge)
            blocks.append(box("stop", stop, (0.0, float(np.ptp(first[:, 2])) * rng.uniform(0.3, 1.0))))
            fixed.append(len(blocks) - 1)
        return Assembly.from_meshes(blocks, boundary=fixed, friction=float(rng.uniform(0.05, 1.0)))


@pytest.fixture(scope="session")
def random_scenes() -> Any:
    """Makers of random assemblies."""
    return RandomScenes

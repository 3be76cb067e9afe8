"""Polygons keep their area and stay inside when they are cut into triangles."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from falsework.geometry.mesh.polygon import newell_normal, triangulate


def star(corners: int, seed: int) -> np.ndarray:
    """Star-shaped polygon, concave nearly everywhere, counter-clockwise."""
    random = np.random.default_rng(seed)
    turn = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    radius = random.uniform(0.3, 1.0, corners)
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(corners)])


@pytest.mark.parametrize("seed", range(6))
def test_triangles_tile_a_concave_polygon_in_any_plane(shapes, seed):
    flat = star(5 + 4 * seed, seed)
    points = flat @ shapes.rotation(seed).T + 3.0
    triangles = triangulate(points)
    assert len(triangles) == len(points) - 2
    pieces = [shapely.Polygon(flat[list(triangle), :2]) for triangle in triangles]
    whole = shapely.Polygon(flat[:, :2])
    assert all(piece.exterior.is_ccw for piece in pieces)
    assert sum(piece.area for piece in pieces) == pytest.approx(whole.area)
    assert shapely.union_all(pieces).symmetric_difference(whole).area == pytest.approx(0, abs=1e-12)


def test_corners_in_a_line_keep_the_area():
    points = np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 2, 0), (1, 2, 0), (0, 2, 0)], float)
    triangles = triangulate(points)
    areas = [newell_normal(points[list(triangle)])[2] for triangle in triangles]
    assert sum(areas) == pytest.approx(4.0)
    assert min(areas) >= 0
    used = {tuple(sorted(pair)) for t in triangles for pair in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))}
    assert {(i, (i + 1) % 6) if i < 5 else (0, 5) for i in range(6)} <= used, "edges of the outline must remain"


def test_newell_normal_is_the_area_vector():
    points = star(17, 3)
    assert newell_normal(points) == pytest.approx([0, 0, shapely.Polygon(points[:, :2]).area])

"""Convex pieces that cover a mesh."""

from __future__ import annotations

from falsework.geometry.mesh import TriangleMesh
from falsework.robots.shapes import Pieces, hull


def convex_pieces(mesh: TriangleMesh, tolerance: float = 0.02) -> Pieces:
    """Convex pieces whose union contains the solid that a mesh encloses."""
    return (hull(mesh.vertices),)

"""Parts of a structure as bodies in a cell: placed, scaled and covered by convex pieces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.robots.model.cell import Placement
from falsework.robots.model.convex_decomposition import convex_pieces
from falsework.robots.model.shapes import Pieces, move, move_pieces
from falsework.utils.arrays import Array


@dataclass(frozen=True, eq=False)
class PartShapes:
    """Parts of a structure at their places in a cell; the pose of a part is its displacement from there."""

    names: tuple[str, ...]
    boundary: NDArray[np.bool_]
    """Shape (parts,)."""
    meshes: tuple[TriangleMesh, ...]
    """Exact surfaces in the world frame, metres."""
    pieces: tuple[Pieces, ...]
    """Convex pieces in the world frame that cover each part; exact for convex parts."""
    mass: Array
    """Masses in the cell, kg, shape (parts,)."""
    center: Array
    """Centres of mass in the world frame, shape (parts, 3)."""
    turn: Array
    """Rotation from the structure's frame to the world, shape (3, 3): for directions of the clearance table."""

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return len(self.names)


def place_parts(assembly: Assembly, placement: Placement = Placement(), *, tolerance: float = 0.05) -> PartShapes:
    """Place the parts of a structure in a cell; convex pieces may exceed them by a share, as of `convex_pieces`."""
    scale, world = placement.scale, placement.pose
    meshes = tuple(
        TriangleMesh(mesh.name, np.ascontiguousarray(move(world, scale * mesh.vertices)), mesh.faces)
        for mesh in assembly.meshes
    )
    pieces = tuple(
        move_pieces(world, tuple(scale * piece for piece in convex_pieces(mesh, tolerance))) for mesh in assembly.meshes
    )
    density = 1.0 if placement.density is None else placement.density / assembly.density
    mass = assembly.mass.mass * density * scale**3
    center = move(world, scale * assembly.mass.center)
    for array in (mass, center):
        array.setflags(write=False)
    return PartShapes(assembly.names, assembly.boundary, meshes, pieces, mass, center, world[:3, :3])

"""Geometric features of parts and pairs of parts, the input of a policy network.

All of it is invariant to translation and to the unit of length, and made once for a structure. Lengths are in units of
a typical part, so that a joint looks the same in a small structure and in a large one. The position of a part in the
structure is omitted, except for its height: a network would learn to identify parts by position, not by their
surroundings, which does not transfer to another structure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from falsework.assembly.model import Assembly
from falsework.geometry.arrays import read_only

PART_FEATURES = 14
"""Features of a part."""
PAIR_FEATURES = 24
"""Features of a pair of parts."""
PORTS = 7
"""Shares of contact area between two parts: all of it, and by direction."""


@dataclass(frozen=True, eq=False)
class PartFeatures:
    """Geometry of the parts of one structure, read-only float32 arrays."""

    part: NDArray[np.float32]
    """Shape (parts, PART_FEATURES): height, mass, extents, and how contacts surround the part."""
    pair: NDArray[np.float32]
    """Shape (parts, parts, PAIR_FEATURES): part `j` relative to part `i` (first index)."""
    ports: NDArray[np.float32]
    """Shape (PORTS, parts, parts): share of part `i`'s contact area that it has with part `j`; all of it, and the share
    of contacts that press on it towards +x, -x, +y, -y, +z (carries it), -z (rests on it)."""
    boundary: NDArray[np.bool_]
    """Shape (parts,)."""

    @staticmethod
    def from_assembly(assembly: Assembly) -> PartFeatures:
        """Compute the features of a structure."""
        parts = assembly.part_count
        fixed = assembly.boundary
        centre = assembly.mass.center
        bounds = np.array([mesh.bounds for mesh in assembly.meshes])
        extent = bounds[:, 1] - bounds[:, 0]
        movable = ~fixed if not fixed.all() else fixed
        length = float(np.median(np.linalg.norm(extent[movable], axis=1)))

        contacts = assembly.contacts
        a, b = contacts.parts.T
        area = np.zeros((parts, parts))
        push = contacts.pushes(parts)
        spot = np.zeros((parts, parts, 3))
        signed = np.zeros((parts, parts, 6))
        for one, other, sign in ((a, b, -1.0), (b, a, 1.0)):
            normals = sign * contacts.normals
            weighted = contacts.areas[:, None] * normals
            np.add.at(area, (one, other), contacts.areas)
            np.add.at(spot, (one, other), contacts.areas[:, None] * contacts.centres)
            both = np.stack([np.maximum(weighted, 0), np.maximum(-weighted, 0)], axis=2).reshape(-1, 6)
            np.add.at(signed, (one, other), both)
        touches = area > 0
        whole = np.maximum(area.sum(axis=1), 1e-300)
        share = area / whole[:, None]
        spot = np.where(touches[:, :, None], spot / np.maximum(area, 1e-300)[:, :, None] - centre[:, None], 0.0)
        direction = np.divide(push, area[:, :, None], out=np.zeros_like(push), where=touches[:, :, None])
        ports = np.concatenate([share[None], np.moveaxis(signed / whole[:, None, None], 2, 0)])

        hull = (share[:, :, None] * spot).sum(axis=1) / np.maximum(np.linalg.norm(extent, axis=1), 1e-300)[:, None]
        low = bounds[movable, 0, 2].min()
        part = np.concatenate(
            [
                np.log1p(np.maximum(centre[:, 2] - low, 0.0) / length)[:, None],
                np.clip(np.log(assembly.mass.mass / np.median(assembly.mass.mass[movable])), -4, 4)[:, None],
                np.minimum(extent / length, 4.0),
                (share * fixed[None]).sum(axis=1)[:, None],
                touches.sum(axis=1)[:, None] / 6.0,
                (push.sum(axis=1) / whole[:, None]),
                (signed[:, :, 4:].sum(axis=(1, 2)) / whole)[:, None],
                hull,
            ],
            axis=1,
        )
        apart = centre[None] - centre[:, None]
        distance = np.linalg.norm(apart, axis=2)
        hops = shortest_path(touches, unweighted=True)
        near = np.where(np.isfinite(hops), 1.0 / (1.0 + hops), 0.0)
        pair = np.concatenate(
            [
                np.sign(apart) * np.log1p(np.abs(apart) / length),
                np.tanh(apart / length),
                np.log1p(distance / length)[:, :, None],
                np.tanh(distance / length)[:, :, None],
                touches[:, :, None],
                direction,
                np.log1p(area / max(float(area[touches].mean()) if touches.any() else 1.0, 1e-300))[:, :, None],
                share[:, :, None],
                share.T[:, :, None],
                np.eye(parts)[:, :, None],
                np.broadcast_to(fixed[None, :, None], (parts, parts, 1)),
                np.broadcast_to(fixed[:, None, None], (parts, parts, 1)),
                np.tanh(spot / length),
                near[:, :, None],
                np.sign(np.round(apart[:, :, 2:] / length, 3)),
                np.where(hops == 2, 1.0, 0.0)[:, :, None],
            ],
            axis=2,
        )
        arrays = (np.ascontiguousarray(array, dtype=np.float32) for array in (part, pair, ports))
        return PartFeatures(*read_only(*arrays), boundary=fixed)

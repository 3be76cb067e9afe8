"""Places where parts face each other across a gap: where they would touch if they moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.arrays import Rows
from falsework.geometry.contact.narrow_phase import ContactTolerances, Narrow, narrow_places
from falsework.geometry.contact.patches import face_patches
from falsework.geometry.mesh.mesh import TriangleMesh

Array = NDArray[np.float64]

ANGLE = 30.0
"""Largest angle between faces that face each other, degrees: facets of curved surfaces that were cut differently."""


@dataclass(frozen=True, eq=False)
class NearPoints(Rows):
    """Points between two parts, with the distance of their surfaces there."""

    parts: NDArray[np.int32]
    """Part `a` and part `b`, `a < b`, shape (points, 2)."""
    normals: Array
    """From `a` to `b`, unit length, shape (points, 3)."""
    points: Array
    """Midway between the surfaces, shape (points, 3), metres."""
    gaps: Array
    """Along the normal, negative where the parts overlap, shape (points,), metres."""


def near_points(meshes: Sequence[TriangleMesh], reach: float, tolerance: float) -> NearPoints:
    """Find the corners of faces that face each other, and edges and corners that face other parts.

    Args:
        meshes: closed meshes that face outwards.
        reach: largest gap, and largest overlap, metres.
        tolerance: distance up to which places are one, metres.
    """
    patches = face_patches(meshes, gap=reach, overlap=reach, angle=ANGLE, least=tolerance / 1000)
    places = narrow_places(meshes, ContactTolerances(reach, reach, ANGLE, tolerance), Narrow.none())
    return NearPoints(
        np.concatenate([patches.parts[patches.owner], np.repeat(places.parts, 2, axis=0)]),
        np.concatenate([patches.normals[patches.owner], np.repeat(places.normals, 2, axis=0)]),
        np.concatenate([patches.points, places.ends.reshape(-1, 3)]),
        np.concatenate([patches.gaps, places.gaps.ravel()]),
    )

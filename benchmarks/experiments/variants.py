"""Variants of a structure: parts of it merged, left out or fixed, and all of it carried to other angles and sizes.

They make shapes that no generator makes. A collineation maps planes to planes, so flat parts still touch on whole faces:
it stretches, leans and tapers a structure. Where parts merge, others have more neighbours and fit into each other.
Beyond a plane parts are left out or fixed, which leaves stumps, halves, and structures on other supports.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from falsework import Assembly
from falsework.errors import InputError
from falsework.geometry import TriangleMesh

_CHANGE = 0.35
"""Largest change of an entry of a linear map, and of the scale between the middle of a structure and one of its ends."""
_MERGED = 0.4
"""Largest share of the joints across which parts are merged."""
_BODIES = 4
"""Parts that are merged into one, at most."""
_BEYOND = 0.6
"""Largest share of the parts that is left out, and of those that are fixed."""


def variant(assembly: Assembly, draw: np.random.Generator) -> Assembly:
    """Return a structure that is made of another one at random; whether it stands is for the caller to check.

    Raises:
        InputError: too little is left, or the parts do not touch as they should.
    """
    chosen = draw.random(3) < 0.5
    if not chosen.any():
        chosen[draw.integers(3)] = True
    bodies, fixed = np.arange(assembly.part_count), assembly.boundary.copy()
    if chosen[0]:
        gone = _beyond(assembly, draw) & ~assembly.boundary
        also = _beyond(assembly, draw) if draw.integers(2) else fixed
        bodies[gone] = -1
        fixed |= also & ~gone
    if chosen[1]:
        bodies = _merged(assembly, bodies, fixed, draw)
    if not ((bodies >= 0) & ~fixed).any():
        raise InputError("no part is left to be built")
    change = _collineation(assembly, draw) if chosen[2] else None
    meshes, boundary = [], []
    for body in np.unique(bodies[bodies >= 0]):
        mine = np.flatnonzero(bodies == body)
        parts = [assembly.meshes[part] for part in mine]
        offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
        vertices = np.concatenate([part.vertices for part in parts])
        meshes.append(TriangleMesh.from_arrays(parts[0].name, vertices if change is None else change(vertices), faces))
        boundary.append(bool(fixed[mine[0]]))
    return Assembly.from_meshes(meshes, boundary=np.array(boundary), name=assembly.name)


def _beyond(assembly: Assembly, draw: np.random.Generator) -> NDArray[np.bool_]:
    """Return the parts beyond a random plane, a random share of them."""
    normal = draw.normal(size=3)
    place = assembly.mass.center @ normal
    return place > np.quantile(place, 1.0 - draw.uniform(0, _BEYOND))


def _merged(
    assembly: Assembly, bodies: NDArray[np.int64], fixed: NDArray[np.bool_], draw: np.random.Generator
) -> NDArray[np.int64]:
    """Return to which body each part belongs after some of those that touch have become one."""
    pairs = np.unique(assembly.contacts.parts, axis=0)
    pairs = pairs[((bodies >= 0) & ~fixed)[pairs].all(axis=1)]
    wanted = draw.permutation(pairs)[: round(len(pairs) * draw.uniform(0, _MERGED))]
    bodies = bodies.copy()
    for one, other in wanted:
        both = np.isin(bodies, bodies[[one, other]])
        if both.sum() <= _BODIES:
            bodies[both] = bodies[one]
    return bodies


def _collineation(assembly: Assembly, draw: np.random.Generator) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a random map near the identity that takes planes to planes."""
    corners = np.concatenate([mesh.vertices for mesh in assembly.meshes])
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, radius = (low + high) / 2, np.linalg.norm(high - low) / 2
    change = draw.uniform(0, _CHANGE)
    linear = np.eye(3) + draw.uniform(-change, change, size=(3, 3))
    taper = draw.normal(size=3)
    taper *= change / np.linalg.norm(taper)

    def carry(points: NDArray[np.float64]) -> NDArray[np.float64]:
        away = points - middle
        return (away @ linear.T) / (1.0 + away @ taper / radius)[:, None]

    return carry

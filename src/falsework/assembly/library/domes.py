"""Hemispherical dome of voussoir rings."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.library.blocks import Blocks, Solid, gather, ground, loft
from falsework.assembly.library.catalogue import Range, structure
from falsework.errors import InputError


@structure("dome")
def dome(
    rings: Annotated[int, Range(1, 60, "rings of voussoirs below the key")] = 4,
    blocks: Annotated[int, Range(3, 200, "voussoirs in a ring")] = 8,
    radius: Annotated[float, Range(0.01, 100, "radius of the middle surface", "m")] = 1.0,
    thickness: Annotated[float, Range(0.001, 100, "radial thickness", "m")] = 0.15,
    stagger: Annotated[int, Range(0, 1, "1 staggers the joints, 0 lets them run through")] = 1,
) -> Blocks:
    """Hemispherical dome of voussoir rings with staggered joints and one key.

    The joints are radial and stand half a voussoir apart from ring to ring. All faces are flat: a voussoir spans two
    facets of a sphere whose parallels are regular polygons of `2 blocks` corners, so that one facet of it lies on each
    of its two neighbours below. With joints that run through along meridians, nothing ties the foot of the dome and it
    needs a thickness of 0.042 of its radius (Heyman 1967); friction between staggered voussoirs ties it, so that a
    smaller thickness suffices.
    """
    if thickness > radius:
        raise InputError(f"thickness {thickness:g} m is more than radius {radius:g} m; make the dome thinner")
    corners = 2 * blocks
    around = np.arange(corners) * np.pi / blocks
    up = np.linspace(0.0, np.pi / 2, rings + 2)[:-1]
    level = np.stack(
        [
            np.cos(up)[:, None] * np.cos(around),
            np.cos(up)[:, None] * np.sin(around),
            np.repeat(np.sin(up)[:, None], corners, axis=1),
        ],
        axis=-1,
    )  # of the unit sphere, shape (rings + 1, corners, 3)
    inner, outer = (radius - thickness / 2) * level, (radius + thickness / 2) * level
    solids = []
    for ring in range(rings):
        for block in range(blocks):
            reach = (2 * block + stagger * (ring % 2) + np.arange(3)) % corners
            solids.append(_voussoir(inner[ring : ring + 2, reach], outer[ring : ring + 2, reach]))
    solids.append(loft("key", inner[-1], outer[-1]))
    reach = np.full(2, radius + thickness / 2)
    solids.append(ground(-reach, reach, margin=thickness, depth=thickness))
    return gather(solids)


def _voussoir(inner: NDArray[np.float64], outer: NDArray[np.float64]) -> Solid:
    """Return the block between two levels and over two facets; `inner` and `outer` have shape (2, 3, 3)."""
    vertices = np.concatenate([inner.reshape(6, 3), outer.reshape(6, 3)])
    facets = ((0, 1, 4, 3), (1, 2, 5, 4))
    rings = [tuple(reversed(facet)) for facet in facets]
    rings += [tuple(k + 6 for k in facet) for facet in facets]
    edge = (0, 1, 2, 5, 4, 3)  # the outline, counter-clockwise seen from outside
    rings += [(a, b, b + 6, a + 6) for a, b in zip(edge, edge[1:] + edge[:1], strict=True)]
    return Solid("voussoir", vertices, tuple(rings))

"""Arches of voussoirs: semicircular and catenary."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.library.blocks import Blocks, Solid, box, gather, prism
from falsework.assembly.library.catalogue import Range, structure
from falsework.errors import InputError
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]


@structure("arch")
def arch(
    blocks: Annotated[int, Range(3, 1000, "voussoirs")] = 15,
    radius: Annotated[float, Range(0.01, 100, "radius of the middle line", "m")] = 1.0,
    thickness: Annotated[float, Range(0.001, 100, "radial thickness", "m")] = 0.2,
    depth: Annotated[float, Range(0.001, 100, "width across the span", "m")] = 0.4,
) -> Blocks:
    """Semicircular arch of equal voussoirs on two abutments.

    With fine voussoirs it is stable as long as the thickness is above 0.1075 of the radius (Milankovitch 1907, the
    mechanism with five hinges), if friction holds the blocks; few voussoirs leave fewer places for hinges and may allow
    a smaller thickness. The joints are radial, the faces between them flat.
    """
    if thickness > radius:
        raise InputError(f"thickness {thickness:g} m is more than radius {radius:g} m; make the arch thinner")
    angle = np.linspace(np.pi, 0.0, blocks + 1)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    direction[0, 1] = direction[-1, 1] = 0.0  # the springings lie in the plane z = 0, not a rounding below
    inner, outer = (radius - thickness / 2) * direction, (radius + thickness / 2) * direction
    overhang = thickness / 4
    feet = [
        box(
            "abutment",
            (side * radius - thickness / 2 - overhang, -depth / 2 - overhang, -thickness),
            (side * radius + thickness / 2 + overhang, depth / 2 + overhang, 0.0),
            fixed=True,
        )
        for side in (-1, 1)
    ]
    return gather([*_voussoirs(inner, outer, depth), *feet])


@structure("catenary")
def catenary(
    blocks: Annotated[int, Range(3, 1000, "voussoirs")] = 15,
    span: Annotated[float, Range(0.01, 200, "between the ends of the middle line", "m")] = 2.0,
    rise: Annotated[float, Range(0.001, 1000, "height of the middle line", "m")] = 1.2,
    thickness: Annotated[float, Range(0.0001, 100, "thickness across the middle line", "m")] = 0.08,
    depth: Annotated[float, Range(0.001, 100, "width across the span", "m")] = 0.4,
) -> Blocks:
    """Catenary arch of voussoirs of equal length, the inverted hanging chain.

    Its middle line is the line of thrust of its own weight, so it is stable at a far smaller thickness than a
    semicircle. The joints are perpendicular to the middle line, those on the abutments too.
    """
    half = span / 2
    if not 0.02 <= rise / half <= 20:
        raise InputError(f"rise {rise:g} m does not suit span {span:g} m; give 0.01 to 10 times the span")
    from scipy.optimize import root_scalar

    # z = rise - scale (cosh(x / scale) - 1), with scale such that z vanishes at the ends.
    shape = root_scalar(lambda u: (np.cosh(u) - 1.0) / u - rise / half, bracket=(1e-6, 20.0), xtol=1e-15).root
    scale = half / shape
    if thickness >= scale:
        raise InputError(
            f"thickness {thickness:g} m is too much for the curve at the crown; give below "
            f"{format_quantity(scale, 'length')}"
        )
    steepness = np.linspace(-np.sinh(shape), np.sinh(shape), blocks + 1)  # equal steps along the chain
    x = scale * np.arcsinh(steepness)
    middle = np.column_stack([x, rise - scale * (np.cosh(x / scale) - 1.0)])
    normal = np.column_stack([steepness, np.ones_like(x)]) / np.hypot(steepness, 1.0)[:, None]
    inner, outer = middle - thickness / 2 * normal, middle + thickness / 2 * normal
    lift = thickness - inner[:, 1].min()  # the feet of the abutments stand on z = 0
    inner[:, 1] += lift
    outer[:, 1] += lift
    feet = [
        _across("abutment", [inner[end], (inner[end, 0], 0.0), (outer[end, 0], 0.0), outer[end]], depth, fixed=True)
        for end in (0, -1)
    ]
    return gather([*_voussoirs(inner, outer, depth), *feet])


def _voussoirs(inner: Array, outer: Array, depth: float) -> list[Solid]:
    """Return the blocks between consecutive joints by x; `inner` and `outer` are (x, z), shape (joints, 2)."""
    return [_across("voussoir", [inner[k], inner[k + 1], outer[k + 1], outer[k]], depth) for k in range(len(inner) - 1)]


def _across(kind: str, profile: list, depth: float, *, fixed: bool = False) -> Solid:
    """Return the prism over a polygon of (x, z) that reaches `depth` across the span."""
    flat = np.array([(x, -depth / 2, z) for x, z in profile])
    return prism(kind, flat, (0.0, depth, 0.0), fixed=fixed)

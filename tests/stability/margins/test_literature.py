"""A stability bound from the literature with complete data."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework.assembly import Assembly
from falsework.assembly.state import complete_state
from falsework.geometry import TriangleMesh
from falsework.geometry.mesh.polygon import triangulate
from falsework.stability import Stability, StabilitySettings

_DEPTH = 40.0
"""Across the span, m: so wide that the arch fails in its plane."""


def prism(name: str, outline: NDArray) -> TriangleMesh:
    """The outline in the x-z plane, shape (corners, 2), swept along y."""
    count = len(outline)
    flat = np.column_stack([outline[:, 0], np.zeros(count), outline[:, 1]])
    vertices = np.concatenate([flat - [0, _DEPTH / 2, 0], flat + [0, _DEPTH / 2, 0]])
    ends = triangulate(flat)
    faces = [*ends, *((c + count, b + count, a + count) for a, b, c in ends)]
    for i in range(count):
        j = (i + 1) % count
        faces += [(j, i, i + count), (j, i + count, j + count)]
    mesh = TriangleMesh.from_arrays(name, vertices, faces)
    return mesh if mesh.volume > 0 else TriangleMesh.from_arrays(name, vertices, np.array(faces)[:, ::-1])


def circular_arch(radius: float, thickness: float, embrace: float, voussoirs: int) -> Assembly:
    """Arch of equal voussoirs with curved faces and radial joints; the last two parts are its abutments."""
    edges = np.radians(90 + embrace / 2 - embrace * np.arange(voussoirs + 1) / voussoirs)
    inner, outer, parts = radius - thickness / 2, radius + thickness / 2, []
    for k in range(voussoirs):
        angle = np.linspace(edges[k], edges[k + 1], 7)
        rays = np.column_stack([np.cos(angle), np.sin(angle)])
        parts.append(prism(f"voussoir-{k}", np.concatenate([inner * rays, outer * rays[::-1]])))
    for name, angle, side in (("left", edges[0], 1), ("right", edges[-1], -1)):
        ray = np.array([np.cos(angle), np.sin(angle)])
        along = side * thickness * np.array([-ray[1], ray[0]])
        parts.append(prism(name, np.array([inner * ray, outer * ray, outer * ray + along, inner * ray + along])))
    return Assembly.from_meshes(parts, boundary=[voussoirs, voussoirs + 1], friction=2.0)


@pytest.mark.parametrize(
    "settings",
    [StabilitySettings(), StabilitySettings(criterion="equilibrium", cone="quadratic")],
    ids=lambda settings: settings.criterion,
)
def test_the_arch_of_oppenheim(settings: StabilitySettings) -> None:
    """Seven voussoirs, R = 10 m, t / R = 0.15, embrace 157.5 degrees: a mechanism forms at 0.37 g.

    I. J. Oppenheim, The masonry arch as a four-link mechanism under base motion, Earthquake Engineering and Structural
    Dynamics 21 (1992) 1005-1017; taken up by De Lorenzis, DeJong and Ochsendorf, ibid. 36 (2007) 2119-2136.
    """
    arch = circular_arch(10.0, 1.5, 157.5, 7)
    (found,) = Stability(arch, settings).margins(complete_state(arch.boundary), ("horizontal",))
    assert found.horizontal is not None
    assert found.horizontal.proven
    assert found.horizontal.value == pytest.approx(0.37, rel=0.01)

"""Stability bounds from the literature with complete data."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings
from falsework.assembly import complete_state
from falsework.assembly.library.blocks import box, gather
from falsework.geometry import TriangleMesh
from falsework.geometry.mesh.polygon import triangulate

_DEPTH = 40.0
"""Across the span, m: so wide that the structure fails in its plane."""


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
    (found,) = StabilityOracle(arch, settings).margins(complete_state(arch.boundary), ("horizontal",))
    assert found.horizontal is not None
    assert found.horizontal.proven
    assert found.horizontal.value == pytest.approx(0.37, rel=0.01)


_BRICK = (0.4, 0.175)
"""Length and height of a block of the walls, m."""
_EVEN, _ODD, _GAPS, _HALVES = (
    (0.5, 1, 1, 1, 1, 0.5),
    (1,) * 5,
    (1, -1, 1, -1, 1),
    (0.5, 0.5, -1, 0.5, 0.5, -1, 0.5, 0.5),
)
_WIDE, _SHIFTED, _DOOR, _SHIFTED_DOOR = (1,) * 4, (0.5, 1, 1, 1, 0.5), (1, 0.5, -1, 0.5, 1), (0.5, 1, -1, 1, 0.5)
_WALLS = {
    "6 courses": (3 * (_EVEN, _ODD), 0.64286),
    "10 courses": (5 * (_EVEN, _ODD), 0.58000),
    "one opening": (
        (_WIDE, _SHIFTED, _WIDE, *2 * (_SHIFTED_DOOR, _DOOR), _SHIFTED_DOOR, _WIDE, _SHIFTED, _WIDE),
        0.40369,
    ),
    "two openings": ((_EVEN, _ODD, _EVEN, *2 * (_GAPS, _HALVES), _GAPS, _EVEN, _ODD, _EVEN), 0.33195),
}
"""Courses of blocks from the ground up, lengths in blocks, below zero where there is none, and the load factor."""


def block_wall(courses: tuple[tuple[float, ...], ...]) -> Assembly:
    """Wall of dry blocks on a fixed ground, friction 0.65 in all joints, the vertical ones too."""
    length, height = _BRICK
    solids = []
    for row, course in enumerate(courses):
        ends = length * np.cumsum([0.0, *np.abs(course)])
        solids += [
            box(f"block-{row}-{k}", (ends[k], 0, row * height), (ends[k + 1], _DEPTH, (row + 1) * height))
            for k, size in enumerate(course)
            if size > 0
        ]
    solids.append(box("ground", (0, 0, -height), (length * sum(map(abs, courses[0])), _DEPTH, 0), fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=1000.0, friction=0.65)


@pytest.mark.parametrize("name", _WALLS)
def test_the_walls_of_ferris_and_tin_loi(name: str) -> None:
    """Running bond under horizontal body forces: load factors of limit analysis, in which sliding dilates.

    M. C. Ferris and F. Tin-Loi, Limit analysis of frictional block assemblies as a mathematical program with
    complementarity constraints, International Journal of Mechanical Sciences 43 (2001) 209-224, examples 1 to 4; taken
    up by Gilbert, Casapulla and Ahmed, Computers and Structures 84 (2006) 873-887. Limit analysis is the criterion
    `equilibrium`. Without dilatancy walls bear less, as both papers find, and so they do under `contact`.
    """
    courses, factor = _WALLS[name]
    wall = block_wall(courses)
    limit, without = (
        StabilityOracle(wall, settings).margins(complete_state(wall.boundary), ("horizontal",))[0].horizontal
        for settings in (StabilitySettings(criterion="equilibrium", cone="quadratic"), StabilitySettings())
    )
    assert limit is not None
    assert limit.proven
    assert limit.value is not None
    assert limit.outside is not None
    assert 0.999 * limit.value <= factor <= 1.001 * limit.outside
    assert limit.outside <= 1.01 * limit.value
    assert without is not None
    assert without.value is not None
    assert 0.7 * factor < without.value <= factor

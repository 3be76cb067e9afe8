"""A beam that two arms must hold in turn, since each reaches one of the two blocks below it only."""

from __future__ import annotations

import numpy as np

from falsework import Assembly
from falsework.assembly.library.blocks import Solid, box, gather

BEAM, LEFT, RIGHT = 0, 1, 2


def channel(x: float, y: float, low: float, under: float, high: float, wall: float) -> Solid:
    """An inverted channel along the x axis, of half length x and half width y."""
    inner = y - wall
    outline = [(-y, low), (-inner, low), (-inner, under), (inner, under), (inner, low), (y, low), (y, high), (-y, high)]
    ends = [(0, 1, 2), (0, 2, 7), (7, 2, 3), (7, 3, 6), (6, 3, 5), (3, 4, 5)]
    rings = [tuple(8 + k for k in end) for end in ends] + [end[::-1] for end in ends]
    rings += [(k, (k + 1) % 8, (k + 1) % 8 + 8, k + 8) for k in range(8)]
    return Solid("beam", np.array([(side, *point) for side in (-x, x) for point in outline]), tuple(rings))


def bridge_with(spares: int = 0) -> Assembly:
    """A beam under a lintel, astride two blocks on plinths: it can leave, sideways, only when both have left.

    Spare blocks stand by themselves on both sides, as many on each.
    """
    solids = [
        channel(0.3, 0.1, 0.12, 0.2, 0.25, 0.03),
        box("left", (-0.48, -0.07, 0.05), (-0.2, 0.07, 0.2)),
        box("right", (0.2, -0.07, 0.05), (0.48, 0.07, 0.2)),
    ]
    for k in range(spares):
        for x in (-0.5, 0.4):
            solids.append(box("spare", (x, 0.25 + 0.15 * k, 0.0), (x + 0.1, 0.35 + 0.15 * k, 0.15)))
    for name, low, high in (
        ("plinth", (-0.38, -0.07, 0.0), (-0.2, 0.07, 0.05)),
        ("plinth", (0.2, -0.07, 0.0), (0.38, 0.07, 0.05)),
        ("lintel", (-0.03, -0.04, 0.27), (0.03, 0.04, 0.30)),
        ("stop", (-0.36, -0.06, 0.21), (-0.32, 0.06, 0.24)),
        ("stop", (0.32, -0.06, 0.21), (0.36, 0.06, 0.24)),
        ("ground", (-0.8, -0.8, -0.05), (0.8, 0.8, 0.0)),
    ):
        solids.append(box(name, low, high, fixed=True))
    made = gather(solids)
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=250.0, name="bridge")

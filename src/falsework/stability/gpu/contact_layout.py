"""Arrays that the criterion `contact` adds to the GPU layout of a structure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from falsework.stability.contact.newton import ContactArrays
from falsework.stability.gpu.layout import Layout


def add_contact(layout: Layout, structure: ContactArrays, gravity: float, ratio: float) -> Layout:
    """Add stiffness and units of displacement to a layout.

    The kernel measures lengths in `layout.length`, masses in the mean mass and accelerations in gravity. With
    displacements in `scale * gravity` metres, `scale` as in `ContactArrays`, the stiffness of a point has the same
    value as on the CPU.

    Args:
        layout: layout of the structure.
        structure: its stiffness and units.
        gravity: m/s2.
        ratio: ratio of tangential to normal stiffness.
    """
    first, count = layout.arrays["group_first"], layout.arrays["group_count"]
    stiffness = np.zeros((layout.group_size, layout.groups))
    for i in range(layout.group_size):
        rows = np.flatnonzero(count > i)
        stiffness[i, rows] = structure.normal[first[rows] + i]
    return replace(
        layout,
        arrays={**layout.arrays, "stiffness": stiffness},
        tangential=ratio,
        unit=structure.scale * gravity,
        limit=structure.limit,
    )

"""Structures whose parts have clear ways out, and one whose last parts have none."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from palette import BOUNDARY, INK, ROBOTS, SAND
from render import Camera, ColoredSolid, render

from falsework import Assembly
from falsework.assembly.library import house, shelf


def clear_exits(path: Path) -> None:
    """House and shelf pulled apart as far as one part after the other can leave; what is locked in orange."""
    pictures = (
        ("house: every plate has its way out", house(), {"roof": (0.0, 0.0, 0.42), "side": (0.0, 0.0, 0.22)}, ()),
        ("shelf: the last four lock each other", shelf(), {"board": (0.0, -0.45, 0.0)}, ("upright", "top")),
    )
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.2))
    for axis, (title, assembly, moves, locked) in zip(axes, pictures, strict=True):
        axis.set_axis_off()
        axis.set_title(title, fontsize=10, color=INK)
        axis.imshow(_pulled_apart(assembly, moves, locked), interpolation="antialiased")
    figure.subplots_adjust(left=0.005, right=0.995, top=0.92, bottom=0.01, wspace=0.02)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _pulled_apart(assembly: Assembly, moves: dict[str, tuple[float, float, float]], locked: tuple[str, ...]):
    highest = max((mesh.bounds[0, 2] for mesh in assembly.meshes if mesh.name.startswith("side-")), default=0.0)
    solids = []
    for mesh, fixed in zip(assembly.meshes, assembly.boundary, strict=True):
        kind = mesh.name.rpartition("-")[0]
        # Side walls of the lower storey stay: the floor above covers them.
        moved = np.array(moves.get(kind, (0, 0, 0))) * (kind != "side" or mesh.bounds[0, 2] >= highest)
        color = BOUNDARY if fixed else ROBOTS[1] if kind in locked else SAND
        solids.append(ColoredSolid(mesh.vertices + moved, mesh.faces, to_rgb(color)))
    points = np.concatenate([solid.vertices for solid in solids])
    return render(solids, Camera(width=640, height=520, azimuth=-35.0), np.stack([points.min(0), points.max(0)]))

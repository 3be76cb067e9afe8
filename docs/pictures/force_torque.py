"""The force-torque graph of a stack of two blocks, drawn from the graph that the network works on."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from palette import BOUNDARY, FORCE, INK, ROBOTS, SAND
from render import Camera, ColoredSolid, render

from falsework import Assembly, load_structure
from falsework.learn.networks.force_torque_graph import ForceTorqueGraph

TORQUE = ROBOTS[0]
SKIP = ROBOTS[3]
GAP = 2.6
"""Height between a part and the force above it in the drawing."""


def force_torque_graph(path: Path) -> None:
    """Left the blocks with their contact points and normals, right all nodes and edges."""
    assembly = load_structure("stack:blocks=2,overhang=0.5,height=0.2")
    graph = ForceTorqueGraph.from_assembly(assembly)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 5.0), width_ratios=(1, 1.45))
    _blocks(left, assembly, graph)
    _graph(right, assembly, graph)
    for axis in (left, right):
        axis.set_axis_off()
    figure.tight_layout(pad=0.6)
    figure.savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.08)
    plt.close(figure)


def _blocks(axis: Any, assembly: Assembly, graph: ForceTorqueGraph) -> None:
    """Blocks pulled apart, so that what is between them can be seen."""
    lift = _rank(assembly)[:, None] * np.array([0.0, 0.0, 0.42])
    meshes = [(mesh.vertices + up, mesh.faces) for mesh, up in zip(assembly.meshes, lift, strict=True)]
    colors = [BOUNDARY if fixed else SAND for fixed in assembly.boundary]
    everything = np.concatenate([vertices for vertices, _ in meshes])
    bounds = np.stack([everything.min(axis=0) - 0.05, everything.max(axis=0) + 0.05])
    camera = Camera(azimuth=-48, elevation=16, width=560, height=620, zoom=0.97)
    solids = [
        ColoredSolid(vertices, faces, to_rgb(color)) for (vertices, faces), color in zip(meshes, colors, strict=True)
    ]
    axis.imshow(render(solids, camera, bounds, floor=False))
    length = _unit_of_length(assembly, graph)
    for force, normal in enumerate(graph.normals):
        points = np.flatnonzero(graph.point_force == force)
        below, above = graph.force_parts[force]
        base = assembly.mass.center[below] + length * graph.levers[points, 0] + lift[below]
        top = base - lift[below] + lift[above]
        for low, high in zip(camera.project(base, bounds), camera.project(top, bounds), strict=True):
            axis.plot(*np.stack([low, high]).T, ":", color=TORQUE, linewidth=1)
            axis.plot(*np.stack([low, high]).T, "o", color=TORQUE, markersize=4, markeredgecolor="white")
        middle = (base.mean(axis=0) + top.mean(axis=0)) / 2
        ends = camera.project(np.array([middle - 0.1 * normal, middle + 0.1 * normal]), bounds)
        properties = {"arrowstyle": "-|>", "color": FORCE, "linewidth": 2, "shrinkA": 0, "shrinkB": 0}
        axis.annotate("", ends[1], xytext=ends[0], arrowprops=properties)
    axis.set_title("contact points and normals, blocks pulled apart", fontsize=10, color=INK)


def _graph(axis: Any, assembly: Assembly, graph: ForceTorqueGraph) -> None:
    """Parts and forces in the middle, torques on the side of the part that they are about."""
    rank = _rank(assembly)
    part = np.stack([np.zeros(len(rank)), 2 * GAP * rank], axis=1)
    force = part[graph.force_parts].mean(axis=1)
    slot = np.concatenate([np.arange(count) for count in np.bincount(graph.point_force)])
    across = np.array([-3.4, -1.7, 1.7, 3.4])[slot]
    torque = np.stack([[across, force[graph.point_force, 1] + side] for side in (-0.62, 0.62)], axis=0)
    torque = np.moveaxis(torque, (0, 1, 2), (1, 2, 0)).reshape(-1, 2)
    places = {"part": part, "force": force, "torque": torque}
    styles: dict[tuple[str, str, str], tuple[str, float, Any]] = {
        ("torque", "about", "part"): (INK, 0.7, "-"),
        ("torque", "of", "force"): (FORCE, 0.7, "-"),
        ("torque", "against", "torque"): (TORQUE, 1.6, "-"),
        ("force", "into", "part"): (FORCE, 2.4, "-"),
        ("force", "out of", "part"): (FORCE, 2.4, "--"),
    }
    names = {
        ("torque", "about", "part"): "torque about part",
        ("torque", "of", "force"): "torque of force",
        ("torque", "against", "torque"): "two torques of one contact point",
        ("force", "into", "part"): "normal points into part",
        ("force", "out of", "part"): "normal points out of part",
    }
    edges = _edges(graph)
    for kind, (color, width, dash) in styles.items():
        start, end = places[kind[0]], places[kind[2]]
        for a, b in edges[kind]:
            axis.plot(*np.stack([start[a], end[b]]).T, color=color, linewidth=width, linestyle=dash, zorder=1)
    for a, b in combinations(range(graph.part_count), 2):
        far = abs(rank[a] - rank[b])
        height = np.linspace(0, 1, 60)
        bow = (5.0 + 0.9 * (far - 1)) * np.sin(np.pi * height) ** 0.6
        line = np.stack([bow, part[a, 1] + height * (part[b, 1] - part[a, 1])])
        axis.plot(*line, color=SKIP, linewidth=1.2, zorder=0)
    axis.plot(*torque.T, "o", color=TORQUE, markersize=7, markeredgecolor="white", zorder=3)
    axis.plot(*force.T, "D", color=FORCE, markersize=13, markeredgecolor="white", zorder=3)
    for name, place, fixed in zip(assembly.names, part, assembly.boundary, strict=True):
        box = {"boxstyle": "round,pad=0.45", "facecolor": BOUNDARY if fixed else SAND, "edgecolor": INK}
        axis.text(*place, name, ha="center", va="center", fontsize=10, color="white" if fixed else INK, bbox=box)
    handles = [Line2D([], [], color=c, linewidth=w, linestyle=d, label=names[k]) for k, (c, w, d) in styles.items()]
    handles.append(Line2D([], [], color=SKIP, linewidth=1.2, label="between all parts"))
    kinds = (
        (SAND, "s", "part: held, in the target, mass"),
        (FORCE, "D", "force: normal"),
        (TORQUE, "o", "torque: lever arm"),
    )
    nodes = [Line2D([], [], color=c, marker=m, linestyle="", markersize=8, label=text) for c, m, text in kinds]
    axis.legend(handles=nodes + handles, frameon=False, fontsize=8.5, loc="center left", bbox_to_anchor=(0.98, 0.5))
    axis.set_title("the graph: every edge runs both ways", fontsize=10, color=INK)


def _edges(graph: ForceTorqueGraph) -> dict[tuple[str, str, str], list[tuple[int, int]]]:
    """Edges of each kind; torque `2 p + s` is of point `p` about part `s` of its pair."""
    about, (out_of, into) = graph.force_parts[graph.point_force].ravel().tolist(), graph.force_parts.T.tolist()
    return {
        ("torque", "about", "part"): list(enumerate(about)),
        ("torque", "of", "force"): list(enumerate(np.repeat(graph.point_force, 2).tolist())),
        ("torque", "against", "torque"): [(torque, torque ^ 1) for torque in range(len(about))],
        ("force", "into", "part"): list(enumerate(into)),
        ("force", "out of", "part"): list(enumerate(out_of)),
    }


def _rank(assembly: Assembly) -> np.ndarray:
    """Place of every part from the bottom up."""
    return np.argsort(np.argsort(assembly.mass.center[:, 2]))


def _unit_of_length(assembly: Assembly, graph: ForceTorqueGraph) -> float:
    """Metres of a lever arm of length one."""
    a, b = assembly.mass.center[graph.force_parts[graph.point_force[0]]]
    return float(np.linalg.norm(b - a) / np.linalg.norm(graph.levers[0, 0] - graph.levers[0, 1]))

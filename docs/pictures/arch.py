"""Pictures of small arches, seen from the front, made from verdicts and searches of the software itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from palette import BOUNDARY, FORCE, INK, ROBOTS, SAND
from scipy.spatial import ConvexHull

from falsework.assembly import Assembly, load_structure
from falsework.assembly.state import HELD, REMOVED, complete_state
from falsework.search.exhaustive import ExhaustiveSearch
from falsework.search.task import Task
from falsework.stability import Stability

Array = NDArray[np.float64]


def proofs(path: Path) -> None:
    """A thick arch with the forces that prove it stable, a thin one with the motion that proves it unstable."""
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.9))
    for axis, thickness in zip(axes, (0.2, 0.08), strict=True):
        assembly = load_structure(f"arch:blocks=15,thickness={thickness}")
        verdicts = Stability(assembly).check(complete_state(assembly.boundary))
        _draw(axis, assembly, complete_state(assembly.boundary))
        if verdicts.stable[0]:
            assert verdicts.forces is not None
            _draw_forces(axis, assembly, verdicts.forces[0])
            title = f"thickness {thickness} of the radius: these forces balance it"
        else:
            assert verdicts.velocity is not None
            _draw_motion(axis, assembly, verdicts.velocity[0])
            title = f"thickness {thickness}: with this motion it collapses"
        axis.set_title(title, fontsize=10, color=INK)
    _finish(figure, path)


def state_graph(path: Path) -> None:
    """All stable states of a small arch with every action between them, and one plan."""
    assembly = load_structure("arch:blocks=4,thickness=0.3")
    task = Task.create(assembly.boundary, robots=2)
    graph = ExhaustiveSearch(task, Stability(assembly)).run().graph
    useful = graph.solvable & graph.reachable
    level = graph.level
    # Assembly runs from left to right.
    column = level.max() - level
    row = np.zeros(len(graph))
    for step in range(column.max() + 1):
        members = np.flatnonzero(column == step)
        row[members] = np.arange(len(members)) - (len(members) - 1) / 2
    figure, axis = plt.subplots(figsize=(9.6, 0.62 * (np.ptp(row) + 1.2)))
    route = graph.sample_route(np.random.default_rng(3))
    assert route is not None
    on_route = set(graph.index.find(route.states).tolist())
    for source, target in zip(graph.source, graph.target, strict=True):
        chosen = source in on_route and target in on_route
        color = ROBOTS[1] if chosen else "#b9bbbf"
        ends = np.array([[column[target] + 0.3, row[target]], [column[source] - 0.3, row[source]]])
        axis.plot(*ends.T, color=color, linewidth=3.0 if chosen else 0.8, zorder=2 if chosen else 1)
    for node, state in enumerate(graph.states):
        _icon(axis, assembly, state, (float(column[node]), float(row[node])), faded=not useful[node])
    axis.set_xlim(-0.6, column.max() + 0.6)
    axis.set_ylim(row.min() - 0.7, row.max() + 0.9)
    for step in range(column.max() + 1):
        axis.annotate(str(step), (step, row.max() + 0.55), ha="center", fontsize=8, color=INK)
    _finish(figure, path)


def _outlines(assembly: Assembly) -> list[Array]:
    """Outline of each part seen from the front, shape (corners, 2)."""
    outlines = []
    for mesh in assembly.meshes:
        flat = mesh.vertices[:, [0, 2]]
        outlines.append(flat[ConvexHull(flat).vertices])
    return outlines


def _draw(axis: Any, assembly: Assembly, state: NDArray[np.uint8]) -> None:
    for part, outline in enumerate(_outlines(assembly)):
        color = BOUNDARY if assembly.boundary[part] else ROBOTS[0] if state[part] == HELD else SAND
        if state[part] != REMOVED:
            axis.fill(*outline.T, facecolor=color, edgecolor=INK, linewidth=0.8)
    axis.set_aspect("equal")


def _icon(axis: Any, assembly: Assembly, state: NDArray[np.uint8], place: tuple[float, float], *, faded: bool) -> None:
    outlines = _outlines(assembly)
    points = np.concatenate(outlines)
    low, high = points.min(0), points.max(0)
    scale = 0.54 / (high - low)[0]
    shape = np.array([1.0, 1.5])  # undo the aspect of the axes
    for part, outline in enumerate(outlines):
        moved = (outline - (low + high) / 2) * scale * shape + place
        color = BOUNDARY if assembly.boundary[part] else ROBOTS[0] if state[part] == HELD else SAND
        if state[part] != REMOVED:
            axis.fill(*moved.T, facecolor=color, edgecolor=INK, linewidth=0.4, alpha=0.35 if faded else 1.0, zorder=3)


def _draw_forces(axis: Any, assembly: Assembly, forces: Array) -> None:
    """Resultant of each contact, as it acts on part `b`."""
    contacts = assembly.contacts
    world = np.einsum("pij,pi->pj", contacts.frames[contacts.contact_of_point], forces)
    normal = np.abs(forces[:, 0])
    largest = 0.0
    arrows = []
    for contact in range(len(contacts)):
        points = slice(contacts.start[contact], contacts.start[contact + 1])
        total, weight = world[points].sum(0), normal[points].sum()
        if weight > 0:
            center = (contacts.points[points] * normal[points, None]).sum(0) / weight
            arrows.append((center[[0, 2]], total[[0, 2]]))
            largest = max(largest, float(np.linalg.norm(total)))
    for center, total in arrows:
        half = 0.16 * total / largest
        axis.plot(*np.stack([center - half, center + half]).T, color=FORCE, linewidth=2.2, solid_capstyle="butt")
        axis.plot(*center, "o", color=FORCE, markersize=3.5)


def _draw_motion(axis: Any, assembly: Assembly, velocity: Array) -> None:
    """Where the parts would be after moving on for a while, and arrows at their centres."""
    center = assembly.mass.center[:, [0, 2]]
    shift = velocity[:, [0, 2]]
    turn = -velocity[:, 4]  # about +y a point at +x moves towards -z
    scale = 0.12 / max(float(np.linalg.norm(shift, axis=1).max()), 1e-12)
    for part, outline in enumerate(_outlines(assembly)):
        if assembly.boundary[part]:
            continue
        arm = outline - center[part]
        moved = outline + scale * (shift[part] + turn[part] * np.stack([-arm[:, 1], arm[:, 0]], axis=-1))
        axis.fill(*moved.T, facecolor="none", edgecolor=FORCE, linewidth=1.2, linestyle="--")
        if np.linalg.norm(shift[part]) * scale > 0.02:
            axis.annotate(
                "", center[part] + scale * shift[part], xytext=center[part],
                arrowprops={"arrowstyle": "-|>", "color": FORCE, "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip


def _finish(figure: Any, path: Path) -> None:
    for axis in figure.axes:
        axis.set_axis_off()
    figure.tight_layout(pad=0.6)
    figure.savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.08)
    plt.close(figure)

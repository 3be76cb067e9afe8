"""Contact sheet of a plan: some of its states, in the order of assembly."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from palette import BOUNDARY, INK, ROBOTS, SAND
from render import Camera, Solid, render

from falsework.assembly import Assembly, load_structure
from falsework.search.beam import BeamSearch, BeamSettings
from falsework.search.task import Task
from falsework.stability import Stability

HELD, REMOVED = 2, 0


def robots_of(states: NDArray[np.uint8], boundary: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Robot that holds each part in each state, -1 where none does; a part keeps its robot while it is held.

    Args:
        states: states one action apart, shape (steps + 1, parts).
        boundary: shape (parts,).

    Returns:
        Shape (steps + 1, parts).
    """
    robots = np.full(states.shape, -1, dtype=np.int64)
    for step, state in enumerate(states):
        held = np.flatnonzero((state == HELD) & ~boundary)
        before = robots[step - 1] if step else np.full(len(state), -1)
        robots[step, held] = before[held]
        free = [robot for robot in range(len(state)) if robot not in robots[step, held]]
        for part, robot in zip([part for part in held if robots[step, part] < 0], free, strict=False):
            robots[step, part] = robot
    return robots


def draw_state(
    assembly: Assembly, state: NDArray[np.uint8], robots: NDArray[np.integer], camera: Camera
) -> NDArray[np.float64]:
    """Picture of one state; shape (height, width, 3)."""
    solids = []
    for part in np.flatnonzero(state != REMOVED):
        held_by = int(robots[part])
        color = BOUNDARY if assembly.boundary[part] else SAND if held_by < 0 else ROBOTS[held_by % len(ROBOTS)]
        mesh = assembly.meshes[part]
        solids.append(Solid(mesh.vertices, mesh.faces, to_rgb(color)))
    points = np.concatenate([mesh.vertices for mesh in assembly.meshes])
    return render(solids, camera, np.stack([points.min(0), points.max(0)]))


def contact_sheet(
    path: Path,
    assembly: Assembly,
    states: NDArray[np.uint8],
    *,
    frames: int = 12,
    columns: int = 4,
    camera: Camera = Camera(width=480, height=290, zoom=0.98),
    title: str = "",
) -> None:
    """Write a PNG with evenly spread states of a plan.

    Args:
        path: PNG to write.
        assembly: the structure.
        states: states of a plan in the order of assembly, shape (steps + 1, parts).
        frames: how many states to show.
        columns: pictures in a row.
        camera: how to look at it.
        title: a line above.
    """
    robots = robots_of(states, assembly.boundary)
    chosen = _interesting(states, assembly.boundary, frames)
    rows = -(-len(chosen) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(2.9 * columns, 1.9 * rows + 0.5), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, step in zip(axes.flat, chosen, strict=False):
        axis.imshow(draw_state(assembly, states[step], robots[step], camera), interpolation="antialiased")
        axis.set_title(f"step {step} of {len(states) - 1}", fontsize=8, color=INK, y=0.98, pad=0)
    handles = [Rectangle((0, 0), 1, 1, color=color) for color in (BOUNDARY, SAND, *ROBOTS[: robots.max() + 1])]
    labels = ["boundary", "stands by itself", *(f"held by robot {robot + 1}" for robot in range(robots.max() + 1))]
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), frameon=False, fontsize=9)
    if title:
        figure.suptitle(title, fontsize=11, color=INK)
    figure.subplots_adjust(left=0.005, right=0.995, top=0.93 if title else 0.97, bottom=0.07, wspace=0.02, hspace=0.08)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _interesting(states: NDArray[np.uint8], boundary: NDArray[np.bool_], frames: int) -> Sequence[int]:
    """Steps spread evenly, each moved to a neighbour where the robots hold most."""
    steps = len(states) - 1
    held = ((states == HELD) & ~boundary).sum(1)
    chosen = []
    for step in np.linspace(0, steps, min(frames, steps + 1)).round().astype(int):
        near = [s for s in (step, step - 1, step + 1) if 0 < s < steps] if 0 < step < steps else [step]
        chosen.append(int(max(near, key=lambda s: held[s])))
    return sorted(set(chosen))


def plan_of_a_vault(path: Path) -> None:
    """Plan the built-in vault with two robots, and draw the plan."""
    assembly = load_structure("vault")
    task = Task.create(assembly.boundary, robots=2)
    search = BeamSearch(task, Stability(assembly), BeamSettings(width=256))
    result = search.run()
    contact_sheet(path, assembly, result.routes[0].states[::-1])

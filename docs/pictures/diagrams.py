"""Diagrams for the page "How it works" that need no structure: the friction cone and the block on a slope."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from palette import BOUNDARY, FORCE, GRAVITY, INK, ROBOTS, SAND
from render import Camera, ColoredSolid, render

FRICTION = 0.55


def friction_cone(path: Path) -> None:
    """Two blocks with the force at a contact point, and both cones."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(9.6, 3.6), width_ratios=(1.25, 1, 0.8))

    camera = Camera(azimuth=-52, elevation=20, width=560, height=520, zoom=0.97)
    bounds = np.array([[-0.8, -0.55, -0.62], [0.8, 0.55, 0.75]])
    lower = _box((-0.75, -0.5, -0.6), (0.75, 0.5, 0.0), BOUNDARY)
    upper = _box((-0.35, -0.35, 0.0), (0.45, 0.35, 0.5), SAND)
    left.imshow(render([lower, upper], camera, bounds, floor=False))
    corners = np.array([[-0.35, -0.35, 0.0], [0.45, -0.35, 0.0], [-0.35, 0.35, 0.0]])
    left.plot(*camera.project(corners, bounds).T, "o", color=FORCE, markersize=6, markeredgecolor="white")
    for corner in corners:
        _arrow(left, camera.project(np.array([corner, corner + [0.08, 0.0, 0.30]]), bounds), FORCE)
    frame = np.array([0.45, -0.35, 0.0])
    for text, axis in (("$n$", (0, 0, 0.5)), ("$t_1$", (0.4, 0, 0)), ("$t_2$", (0, 0.42, 0))):
        ends = camera.project(np.array([frame, frame + axis]), bounds)
        _arrow(left, ends, INK, width=1.0)
        left.annotate(text, ends[1], xytext=(4, 2), textcoords="offset points", color=INK, fontsize=11)
    left.set_title("forces at the corners of the contact", fontsize=10, color=INK)
    for text, place in (("part $b$", (0.05, 0.0, 0.5)), ("part $a$", (-0.5, -0.5, -0.3))):
        left.annotate(
            text,
            camera.project(np.array(place), bounds),
            color="black" if "b" in text else "white",
            fontsize=10,
            ha="center",
            va="center",
        )

    view = Camera(azimuth=-60, elevation=16, width=460, height=520, zoom=0.95)
    box = np.array([[-FRICTION, -FRICTION, 0.0], [FRICTION, FRICTION, 1.0]])
    angles = np.linspace(0, 2 * np.pi, 9)[:-1]
    middle.imshow(render([_cone(angles, ROBOTS[5])], view, box, floor=False))
    circle = np.linspace(0, 2 * np.pi, 200)
    rim = np.stack([FRICTION * np.cos(circle), FRICTION * np.sin(circle), np.ones_like(circle)], axis=-1)
    middle.plot(*view.project(rim, box).T, color=ROBOTS[1], linewidth=2)
    outline = np.array(
        [rim[np.argmin(view.project(rim, box)[:, 0])], [0, 0, 0], rim[np.argmax(view.project(rim, box)[:, 0])]]
    )
    middle.plot(*view.project(outline, box).T, color=ROBOTS[1], linewidth=2)
    middle.set_title("admissible forces: a cone", fontsize=10, color=INK)

    right.plot(FRICTION * np.cos(circle), FRICTION * np.sin(circle), color=ROBOTS[1], linewidth=2, label="round")
    corners = FRICTION * np.stack([np.cos(np.append(angles, 0)), np.sin(np.append(angles, 0))])
    right.fill(*corners, color=ROBOTS[5], alpha=0.3)
    right.plot(*corners, color=ROBOTS[0], linewidth=2, label="octagon")
    right.annotate("$\\mu f_n$", (FRICTION / 2, 0.03), color=INK, ha="center", fontsize=11)
    right.annotate("", (FRICTION, 0), xytext=(0, 0), arrowprops={"arrowstyle": "->", "color": INK})
    right.set_aspect("equal")
    right.set_xlim(-0.75, 0.75)
    right.set_ylim(-1.15, 0.75)
    right.legend(frameon=False, loc="lower center", fontsize=9)
    right.set_title("its section", fontsize=10, color=INK)
    _finish(figure, path)


def slope(path: Path) -> None:
    """A block at rest and one that slips: does the cone contain the vertical?"""
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.6))
    for axis, degrees in zip(axes, (20.0, 36.0), strict=True):
        angle, limit = np.radians(degrees), np.arctan(FRICTION)
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        ramp = np.array([[0, 0], [4.4 * np.cos(angle), 0], 4.4 * along])
        axis.fill(*ramp.T, color="#a3a5a9")
        foot = 2.2 * along
        block = np.array(
            [
                foot - 0.55 * along,
                foot + 0.55 * along,
                foot + 0.55 * along + 0.7 * across,
                foot - 0.55 * along + 0.7 * across,
            ]
        )
        axis.fill(*block.T, facecolor=SAND, edgecolor=INK, linewidth=1)
        stands = angle <= limit
        center = foot + 0.35 * across
        contact = center - np.array([0, 0.35 / np.cos(angle)])  # where the vertical through the centre meets the base
        sides = [np.cos(side) * across + np.sin(side) * along for side in (-limit, limit)]
        cone = np.array([contact, contact + 1.75 * sides[0], contact + 1.75 * sides[1]])
        axis.fill(*cone.T, color=ROBOTS[5], alpha=0.3, linewidth=0)
        axis.plot(*cone[[1, 0, 2]].T, color=ROBOTS[0], linewidth=1.5)
        _arrow(axis, np.array([center, center - [0, 0.95]]), GRAVITY)
        axis.annotate("$m\\mathrm{g}$", center - [0, 0.95], xytext=(6, 2), textcoords="offset points", color=GRAVITY)
        needed = np.array([contact, contact + [0, 1.35]])
        _arrow(axis, needed, FORCE, dashed=not stands)
        axis.plot(*center, "o", color=GRAVITY, markersize=5)
        text = (
            "the force that balances\nlies in the cone"
            if stands
            else "the force that would balance\nlies outside the cone"
        )
        place = contact + ([0.42, 1.12] if stands else [0.15, 1.45])
        axis.annotate(text, place, color=FORCE, ha="left", va="bottom", fontsize=9)
        axis.annotate(f"$\\alpha = {degrees:.0f}°$", (0.62, 0.06), color=INK, fontsize=10)
        relation = "\\leq" if stands else ">"
        title = f"$\\tan\\alpha = {np.tan(angle):.2f} {relation} \\mu = {FRICTION}$: {'stands' if stands else 'slips'}"
        axis.set_title(title, fontsize=10, color=INK)
        axis.set_aspect("equal")
        axis.set_xlim(-0.1, 4.4)
        axis.set_ylim(-0.1, 3.6)
    _finish(figure, path)


def two_walls(path: Path) -> None:
    """A block that only walls could hold, the same without prestress, and a wedge that presses its walls itself."""
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.2))
    titles = (
        "in equilibrium, if the walls press",
        "without prestress: it slides",
        "a wedge presses its walls: it stands",
    )
    for number, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        taper, drop = (0.16, 0.05) if number == 2 else (0.0, 0.45 if number == 1 else 0.0)
        low, high = 0.5 - taper, 0.5 + taper
        for side in (-1, 1):
            wall = np.array([(1.6, -0.75), (1.6, 0.75), (high, 0.75), (low, -0.75)])
            if taper:
                wall[2:, 0] = [0.5 + taper * 1.5, 0.5 - taper * 1.5]
            axis.fill(side * wall[:, 0], wall[:, 1], color="#a3a5a9")
        block = np.array([(-low, -0.5), (low, -0.5), (high, 0.5), (-high, 0.5)]) - [0, drop]
        if number == 1:
            ghost = block + [0, drop]
            axis.plot(*np.vstack([ghost, ghost[:1]]).T, color=INK, linewidth=0.8, linestyle=":")
        axis.fill(*block.T, facecolor=SAND, edgecolor=INK, linewidth=1)
        center = np.array([0.0, -drop])
        _arrow(axis, np.array([center, center - [0, 0.5]]), GRAVITY)
        axis.plot(*center, "o", color=GRAVITY, markersize=5)
        if number == 1:
            _arrow(axis, np.array([[0.8, 0.35], [0.8, -0.35]]), INK)
        else:
            for side in (-1, 1):
                foot = np.array([side * 0.5, -drop])
                push = np.array([-side * 0.38, 0.22])
                _arrow(axis, np.array([foot - push, foot]), FORCE, dashed=number == 0)
        axis.set_title(title, fontsize=10, color=INK)
        axis.set_aspect("equal")
        axis.set_xlim(-1.7, 1.7)
        axis.set_ylim(-1.15, 0.85)
    _finish(figure, path)


def _box(low: tuple[float, float, float], high: tuple[float, float, float], color: str) -> ColoredSolid:
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])
    return ColoredSolid(corners, faces, to_rgb(color))


def _cone(angles: np.ndarray, color: str) -> ColoredSolid:
    rim = np.stack([FRICTION * np.cos(angles), FRICTION * np.sin(angles), np.ones_like(angles)], axis=-1)
    points = np.concatenate([[[0, 0, 0], [0, 0, 1]], rim])
    count = len(angles)
    here, there = 2 + np.arange(count), 2 + (np.arange(count) + 1) % count
    faces = [(0, b, a) for a, b in zip(here, there, strict=True)] + [
        (1, a, b) for a, b in zip(here, there, strict=True)
    ]
    return ColoredSolid(points, np.array(faces), to_rgb(color))


def _arrow(axis: Any, ends: np.ndarray, color: str, *, width: float = 2.0, dashed: bool = False) -> None:
    properties = {
        "arrowstyle": "-|>",
        "color": color,
        "linewidth": width,
        "shrinkA": 0,
        "shrinkB": 0,
        "mutation_scale": 12,
        "linestyle": "--" if dashed else "-",
    }
    axis.annotate("", ends[1], xytext=ends[0], arrowprops=properties)


def _finish(figure: Any, path: Path) -> None:
    for axis in figure.axes:
        axis.set_axis_off()
    figure.tight_layout(pad=0.6)
    figure.savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.08)
    plt.close(figure)

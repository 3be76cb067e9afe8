"""Pictures of cells without a display."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure
from falsework.errors import InputError
from falsework.robots.model.cell import Cell
from falsework.robots.motion.near_pairs import NearPair
from falsework.utils.quantity import counted
from falsework.viewer.cells.cell_model import COLLIDES, NEAR, Reach, build_cell_model
from falsework.viewer.palette import INK, MISSING, robot_color, unit_rgb
from falsework.viewer.pictures.contact_sheet import (
    check_suffix,
    import_pillow,
    legend_height,
    to_pixels,
    write_legend,
    write_text,
)
from falsework.viewer.pictures.picture import Picture, png_of
from falsework.viewer.pictures.render import Camera, ColoredSolid, render

Array = NDArray[np.float64]

_WIDTH = 1200
"""Width of pictures where none is given, pixels."""
_LINE = 24
"""Pixels for a line of text."""
_RING_POINTS = 180
"""Points on each edge of the ring of a reach."""
_NEAR_TEXT = "#7a5c00"
"""Colour of near pairs in words, darker than that of their bodies."""


@dataclass(frozen=True)
class CellPicture:
    """What a picture of a cell shows."""

    shows: str
    """In words."""
    faults: tuple[str, ...]
    pairs: tuple[str, ...]
    """Bodies that are too near each other, in words."""


def picture_cell(
    subject: Cell | str | Path,
    path: Path | str,
    structure: AnyStructure | None = None,
    *,
    configurations: Sequence[Array] | None = None,
    width: int = 0,
    azimuth: float = -58.0,
    elevation: float = 24.0,
    title: str = "",
    **options: Any,
) -> CellPicture:
    """Draw a cell with the reach of its arms on the floor, near pairs of bodies in colour, and its faults in words.

    Args:
        subject: the cell, its file, or the name of a built-in one; it need not be valid.
        path: PNG to write.
        structure: structure in it.
        configurations: joint values of every arm; at home if not given.
        width: pixels across; 0 for 1200.
        azimuth: direction of view about the vertical, degrees.
        elevation: direction of view above the horizon, degrees.
        title: line above; the name of the cell if not given.
        options: as for `load_structure`.

    Raises:
        InputError: nothing of the cell can be read, there is no such structure, or the file cannot be written.
        DependencyError: Pillow is not installed.
    """
    check_suffix(path, ".png")
    sight = build_cell_model(subject, structure, **options)
    if sight.cell is None:
        raise InputError("; ".join(sight.faults))
    pillow = import_pillow()
    at = sight.cell.homes if configurations is None else configurations
    pairs = sight.pairs(at)
    camera = Camera(azimuth, elevation, width or _WIDTH, round(0.62 * (width or _WIDTH)), 0.92)
    box = sight.box.copy()
    if sight.cell.floor is not None:
        box[0, 2] = sight.cell.floor
    solids = sight.solids(at, pairs)
    rings = [ring for k, reach in enumerate(sight.reaches) for ring in reach_ring(reach, box[0, 2], k)]
    image = to_pixels(render([*solids, *rings], camera, box))
    said = [(text, MISSING) for text in sight.faults] + [(pair.words, _color(pair)) for pair in pairs]
    said = said or [("no faults: the arms at home are free of collisions", INK)]
    across = max(40, (width or _WIDTH) // 8)
    lines = [(line, color) for text, color in said for line in textwrap.wrap(text, across)]
    arms = [(robot_color(k), f"{robot.name}: {robot.model.name}") for k, robot in enumerate(sight.cell.robots)]
    key = arms + [(COLLIDES, "collision")] * any(pair.collides for pair in pairs)
    key += [(NEAR, "too near")] * any(not pair.collides for pair in pairs)
    foot = camera.height + _LINE * (len(lines) + 1) + 18
    whole = pillow.Image.new("RGB", (camera.width, foot + legend_height(key, camera.width)), "white")
    whole.paste(pillow.Image.fromarray(image), (0, _LINE + 6))
    pen = pillow.ImageDraw.Draw(whole)
    write_text(pen, (camera.width / 2, _LINE / 2 + 3), title or sight.cell.name, 18, across=camera.width)
    for row, (line, color) in enumerate(lines):
        write_text(pen, (16, camera.height + _LINE * (row + 1) + 18), line, 15, color, "lm")
    write_legend(pen, camera.width, foot, key)
    Picture(sight.cell.name, content=png_of(np.asarray(whole))).save(path)
    return CellPicture(
        f"{counted(len(arms), 'arm')} of {sight.cell.name}", sight.faults, tuple(pair.words for pair in pairs)
    )


def reach_ring(reach: Reach, height: float, robot: int) -> list[ColoredSolid]:
    """Return the circle in which the reach of an arm meets a level, as a flat ring; nothing where it does not."""
    under = reach.center[2] - height
    if abs(under) >= reach.radius:
        return []
    radius = float(np.sqrt(reach.radius**2 - under**2))
    angle = np.linspace(0, 2 * np.pi, _RING_POINTS, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    middle = np.array([*reach.center[:2], height + 0.002 * reach.radius])
    points = np.concatenate([middle + (radius - 0.006 * reach.radius) * around, middle + radius * around])
    k = np.arange(_RING_POINTS)
    following = (k + 1) % _RING_POINTS
    faces = np.concatenate(
        [
            np.stack([k, k + _RING_POINTS, following + _RING_POINTS], axis=1),
            np.stack([k, following + _RING_POINTS, following], axis=1),
        ]
    )
    return [ColoredSolid(points, faces, unit_rgb(robot_color(robot)))]


def _color(pair: NearPair) -> str:
    return COLLIDES if pair.collides else _NEAR_TEXT

"""Setting-out drawing of a sheet: plan and elevations to scale, with dimensions and levels in the model's axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.interop.pdf_page import BOLD, REGULAR, jpeg
from falsework.viewer.appearance import bounds_of
from falsework.viewer.palette import BOUNDARY, INK, INSTALLED, unit_rgb
from falsework.viewer.pictures.render import Camera, ColoredSolid, render

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]

_POINTS = 72.0 / 0.0254
"""Points a metre."""
_SCALES = (1.0, 2.0, 2.5, 5.0)
"""Usual scales of drawings, 1 to so many times a power of ten."""
_GAP = 26.0
"""Space between views, points like all lengths on the page."""
_BESIDE = 60.0
"""Space for dimensions at the left of a view and below it."""
_PIXELS = 3.0
"""Pixels a point."""
_EDGE = 0.01
"""Space around a view, as a share of the largest extent."""
_LETTERS = 6.5
"""Size of the letters of dimensions."""
_GREY = "#77797d"


def setting_out(canvas: Canvas, assembly: Assembly, width: float, top: float) -> None:
    """Draw a plan below a front elevation, with a side elevation beside that, in a frame from the origin of the canvas.

    Dimensions are those of the parts that are set out first: the fixed ones, or where that is a ground alone, those
    that stand on it. All coordinates are those of the model.
    """
    feet = _set_out(assembly)
    low, high = bounds_of(assembly, [*feet, *np.flatnonzero(~assembly.boundary).tolist()])
    wide, deep, tall = (high - low).tolist()
    heading = 48.0
    room = (width - _BESIDE - _GAP) / (wide + deep), (top - heading - _BESIDE - _GAP) / (tall + deep)
    scale = usual_scale(min(room))
    points = _POINTS / scale
    _write(canvas, 0.0, top - 10, "Setting out", 13, font=BOLD)
    ratio = f"1:{scale:g}" if scale >= 1 else f"{1 / scale:g}:1"
    words = f"Scale {ratio} on A4. Dimensions in mm, in the axes of the model. Dark parts are fixed, pale ones placed."
    _write(canvas, 0.0, top - 26, words, 8.3)
    x, y = _BESIDE, top - heading - tall * points
    views = (
        (Camera(0.0, 0.0), (0, 2), (x, y), "front, seen along +y"),
        (Camera(90.0, 0.0), (1, 2), (x + wide * points + _GAP, y), "side, seen along -x"),
        (Camera(0.0, 90.0), (0, 1), (x, y - _GAP - deep * points), "plan"),
    )
    bounds = np.stack([low, high])
    for camera, (across, up), (a, b), name in views:
        _view(canvas, assembly, camera, bounds, (across, up), (a, b), points)
        _write(canvas, a, b + (high - low)[up] * points + 4, name, color=_GREY)
    ticks = [_ticks(assembly, feet, axis, low[axis], high[axis]) for axis in range(3)]
    _dimensions(canvas, ticks[2], low[2], y, x, points, upright=True)
    y -= _GAP + deep * points
    _dimensions(canvas, ticks[1], low[1], y, x, points, upright=True)
    _dimensions(canvas, ticks[0], low[0], x, y, points, upright=False)
    if (low[:2] <= 0).all() and (high[:2] >= 0).all():
        _origin(canvas, x - low[0] * points, y - low[1] * points)


def _set_out(assembly: Assembly) -> list[int]:
    """Return the fixed parts; where that is a ground alone, the parts that touch it."""
    fixed = [
        part for part in np.flatnonzero(assembly.boundary).tolist() if not assembly.names[part].startswith("ground")
    ]
    pairs = assembly.contacts.parts
    touching = pairs[assembly.boundary[pairs].any(axis=1)]
    return fixed or [part for part in np.unique(touching).tolist() if not assembly.boundary[part]]


def usual_scale(points: float) -> float:
    """Return the largest usual scale, 1 to so many, at which a metre has at most so many points."""
    least = _POINTS / points
    power = 10.0 ** np.floor(np.log10(least))
    usual = [step * factor * power for factor in (1.0, 10.0) for step in _SCALES]
    return float(next(one for one in usual if one >= least * (1 - 1e-9)))


def _ticks(assembly: Assembly, parts: Sequence[int], axis: int, low: float, high: float) -> list[float]:
    """Return the coordinates that are dimensioned along an axis: ends of the whole and of the parts set out first."""
    ends = [assembly.meshes[part].bounds[side, axis] for part in parts for side in (0, 1)]
    return np.unique(np.round([low, high, *ends], 4)).tolist()


def _view(
    canvas: Canvas,
    assembly: Assembly,
    camera: Camera,
    bounds: Array,
    axes: tuple[int, int],
    place: tuple[float, float],
    points: float,
) -> None:
    """Draw all parts but a ground, seen along an axis, with the lower left of their box at a place."""
    from reportlab.lib.utils import ImageReader

    edge = _EDGE * float(np.ptp(bounds, axis=0).max())
    box = bounds + np.array([[-edge], [edge]])
    size = np.ptp(box, axis=0)[list(axes)] * points
    solids = []
    for part, mesh in enumerate(assembly.meshes):
        if not (assembly.boundary[part] and assembly.names[part].startswith("ground")):
            color = unit_rgb(BOUNDARY if assembly.boundary[part] else INSTALLED)
            solids.append(ColoredSolid(mesh.vertices, mesh.faces, color))
    width, height = (max(round(_PIXELS * side), 2) for side in size.tolist())
    view = Camera(camera.azimuth, camera.elevation, width, height, samples=2)
    image = ImageReader(jpeg(render(solids, view, box, floor=False)))
    canvas.drawImage(image, place[0] - edge * points, place[1] - edge * points, *size.tolist())


def _dimensions(
    canvas: Canvas, ticks: Sequence[float], low: float, begin: float, beside: float, points: float, *, upright: bool
) -> None:
    """Draw a chain of dimensions with coordinates, and the whole length, below a view or, upright, at its left.

    Args:
        ticks: coordinates along the axis, metres.
        low: coordinate of the lower end of the view.
        begin: where that is on the page, along the axis.
        beside: edge of the view across the axis.
    """
    canvas.saveState()
    canvas.translate(*((beside, begin) if upright else (begin, beside)))
    canvas.rotate(90 if upright else 0)
    down = 1.0 if upright else -1.0
    at = [(tick - low) * points for tick in ticks]
    chain, whole = 14 * down, 26 * down
    canvas.setStrokeColor(_GREY)
    canvas.setLineWidth(0.4)
    lines = [(chain, list(zip(at[:-1], at[1:], ticks[:-1], ticks[1:], strict=True)))]
    if len(ticks) > 2:
        lines.append((whole, [(at[0], at[-1], ticks[0], ticks[-1])]))
    for y, spans in lines:
        canvas.line(at[0] - 4, y, at[-1] + 4, y)
        for a, b, first, last in spans:
            for place in (a, b):
                canvas.line(place - 2.5, y - 2.5, place + 2.5, y + 2.5)
            words = _millimetres(last - first)
            wide = canvas.stringWidth(words, REGULAR, _LETTERS)
            if wide < b - a - 3:
                _write(canvas, (a + b - wide) / 2, y + 2, words)
    before = -np.inf
    for number, (place, tick) in enumerate(zip(at, ticks, strict=True)):
        canvas.setStrokeColor(_GREY)
        canvas.line(place, 3 * down, place, whole + 4 * down)
        if number and number < len(at) - 1 and min(place - before, at[-1] - place) < 1.2 * _LETTERS:
            continue  # no room for its coordinate
        before = place
        canvas.saveState()
        canvas.translate(place, whole + (12 if upright else -6))
        canvas.rotate(-90 if upright else 90)
        words = _millimetres(tick)
        _write(canvas, -canvas.stringWidth(words, REGULAR, _LETTERS), -0.35 * _LETTERS, words, color=_GREY)
        canvas.restoreState()
    canvas.restoreState()


def _origin(canvas: Canvas, x: float, y: float) -> None:
    """Mark the origin of the model in the plan."""
    canvas.setStrokeColor(INK)
    canvas.setLineWidth(0.6)
    canvas.circle(x, y, 3, stroke=1, fill=0)
    canvas.line(x - 7, y, x + 14, y)
    canvas.line(x, y - 7, x, y + 14)
    _write(canvas, x + 15, y - 2, "x")
    _write(canvas, x - 2, y + 16, "y")


def _write(
    canvas: Canvas, x: float, y: float, text: str, size: float = _LETTERS, *, font: str = REGULAR, color: str = INK
) -> None:
    canvas.setFillColor(color)
    canvas.setFont(font, size)
    canvas.drawString(x, y, text)


def _millimetres(length: float) -> str:
    """Return a length or a coordinate in millimetres, with tenths where there are any."""
    return f"{round(1000 * length, 1) + 0.0:,.1f}".removesuffix(".0")

"""Line drawings of two-dimensional structures as SVG: arches, walls and stacks, seen from the front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.geometry.mesh.mesh import unit_normals
from falsework.viewer.appearance import appearance_at
from falsework.viewer.arrows import Arrows, arrows_of_step
from falsework.viewer.palette import INK, hex_of
from falsework.viewer.pictures.contact_sheet import caption, in_rows, legend
from falsework.viewer.proof import StateProof
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]

_FLAT = 1e-3
"""Largest component of a normal along the axis of a two-dimensional structure."""
_MARGIN = 12.0
"""Space around a drawing, pixels."""
_TEXT, _LETTER = 13.0, 6.6
"""Size of letters, pixels."""
_LINE = 24.0
"""Height of a line of text, pixels."""


def flat_axis(assembly: Assembly) -> int | None:
    """Return axis, 0 for x or 1 for y, along which nothing about a structure changes; None for one in three."""
    flat = (axis for axis in (1, 0) if all(_is_prism(mesh.triangles, axis) for mesh in assembly.meshes))
    return next(flat, None)


def outlines(assembly: Assembly, axis: int) -> list[list[Array]]:
    """Return closed lines around each part, seen along an axis; holes are lines of their own.

    Args:
        axis: 0 for x, 1 for y.

    Returns:
        For each part lines of shape (corners, 2): across and up, metres.
    """
    import shapely

    kept = [1 - axis, 2]
    # Seen along +y, x runs to the right; seen along -x, y does.
    drawn = []
    for mesh in assembly.meshes:
        triangles: Any = shapely.polygons(mesh.triangles[:, :, kept])
        area: Any = shapely.union_all([some for some in triangles if some.area > 0])
        pieces = [area] if area.geom_type == "Polygon" else list(area.geoms)
        rings = [ring for piece in pieces for ring in (piece.exterior, *piece.interiors)]
        drawn.append([np.asarray(ring.simplify(0.0).coords)[:-1] for ring in rings])
    return drawn


def drawing(
    timeline: Timeline,
    places: Sequence[int],
    *,
    columns: int = 4,
    width: float = 260.0,
    arrows: Sequence[Arrows] = (),
    key: Sequence[tuple[str, str]] | None = None,
    proofs: Mapping[int, StateProof] | None = None,
) -> str:
    """Return the line drawings of some states, with the legend, as SVG.

    Args:
        width: of each, pixels.
        arrows: drawn into each, instead of the presses of its step.
        key: the legend, colour and words; of the timeline if not given.
        proofs: verdicts on states, by place; sliding parts are marked, and verdicts other than stable are written
            above.
    """
    assembly = timeline.assembly
    axis = flat_axis(assembly)
    if axis is None:
        raise InputError(
            f"{assembly.name} is not two-dimensional, so it has no line drawing; write a .png for a picture in three"
        )
    lines = outlines(assembly, axis)
    drawn = {place: list(arrows) or list(arrows_of_step(timeline, place).values()) for place in places}
    seen = [line for part in lines for line in part]
    seen += [some.ends[:, :, [1 - axis, 2]].reshape(-1, 2) for shown in drawn.values() for some in shown]
    points = np.concatenate(seen)
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (width - 2 * _MARGIN) / max(float((high - low).max()), 1e-12)
    height = float((high - low)[1]) * scale + 2 * _MARGIN
    columns = min(columns, len(places))
    rows = -(-len(places) // columns)
    proofs = proofs or {}
    sliding, pressing = any(proof.slides for proof in proofs.values()), any(map(timeline.presses_at, places))
    entries = legend(timeline, sliding, pressing, places=places) if key is None else key
    lengths = [40 + _LETTER * len(words) for _, words in entries]
    captions = {place: caption(timeline, place, proofs.get(place)) for place in places}
    column = max(width, *(_LETTER * len(words) for words in captions.values()))
    whole = max(columns * column, *lengths)
    left_edge = (whole - columns * column) / 2
    body = []
    for number, place in enumerate(places):
        x, y = left_edge + (number % columns) * column, (number // columns) * (height + _LINE)

        def at(line: Array, x: float = x, y: float = y) -> str:
            across = x + (column - (high - low)[0] * scale) / 2 + (line[:, 0] - low[0]) * scale
            down = y + _LINE + height - _MARGIN - (line[:, 1] - low[1]) * scale
            return " ".join(f"{u:.2f},{v:.2f}" for u, v in zip(across, down, strict=True))

        proof = proofs.get(place)
        look = appearance_at(timeline, place, marks=None if proof is None else proof.marks, travelling=False)
        body.append(_text(x + column / 2, y + _LINE - 8, captions[place]))
        for part in np.flatnonzero(look.opacity > 0):
            path = " ".join(f"M{at(line)}Z" for line in lines[part])
            body.append(
                f'<path d="{path}" fill="{hex_of(look.color[part])}" fill-rule="evenodd" '
                f'stroke="{INK}" stroke-width="0.9" stroke-linejoin="round"><title>{escape(assembly.names[part])}'
                "</title></path>"
            )
        for some in drawn[place]:
            kept = [1 - axis, 2]
            for ends in some.ends[:, :, kept]:
                if np.linalg.norm(ends[1] - ends[0]) * scale > 1.0:
                    body.append(
                        f'<polyline points="{at(ends)}" fill="none" stroke="{some.color}" stroke-width="2" '
                        f'marker-end="url(#tip{some.color[1:]})"/>'
                    )
    top = rows * (height + _LINE) + _LINE / 2
    for row in in_rows(lengths, whole):
        x = (whole - sum(lengths[k] for k in row)) / 2
        for number in row:
            color, words = entries[number]
            body.append(f'<rect x="{x + 6:.1f}" y="{top - 7:.1f}" width="18" height="14" fill="{color}"/>')
            body.append(_text(x + 30, top + 4.5, words, anchor="start"))
            x += lengths[number]
        top += _LINE
    tips = "".join(
        f'<marker id="tip{color[1:]}" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="5" markerHeight="5" '
        f'orient="auto"><path d="M0,0L8,4L0,8Z" fill="{color}"/></marker>'
        for color in dict.fromkeys(some.color for shown in drawn.values() for some in shown)
    )
    size = f"{whole:.0f} {top - _LINE / 2 + 4:.0f}"
    wide, tall = size.split()
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{tall}" viewBox="0 0 {size}" '
        f'font-family="sans-serif" font-size="{_TEXT}">\n<defs>{tips}</defs>\n'
        '<rect width="100%" height="100%" fill="white"/>\n' + "\n".join(body) + "\n</svg>\n"
    )


def _is_prism(triangles: Array, axis: int) -> bool:
    """Return whether every face of a mesh is parallel or square to an axis."""
    along = np.abs(unit_normals(triangles)[0][:, axis])
    return bool(((along < _FLAT) | (along > 1 - _FLAT)).all())


def _text(x: float, y: float, words: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{INK}">{escape(words)}</text>'

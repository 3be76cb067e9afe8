"""Pictures of a timeline without a display: one state, or a contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED, States
from falsework.errors import InputError
from falsework.geometry.arrays import apply, box_around
from falsework.search.plans.steps import NO_ROBOT, no_such_step
from falsework.search.problem.task import Direction
from falsework.utils.display.fonts import font_file
from falsework.utils.lazy import importing
from falsework.viewer.appearance import TRAVEL, Appearance, appearance_at, bounds_of, diagonal
from falsework.viewer.arms import Arms, appearance_with_arms, bounds_with_arms, solids_of_arms
from falsework.viewer.arrows import Arrows, arrows_of_step
from falsework.viewer.palette import BOUNDARY, INK, INSTALLED, PRESS, ROBOTS, SLIDING, hex_of, ramp, robot_color
from falsework.viewer.pictures.render import Camera, ColoredSolid, Image, render
from falsework.viewer.proof import StateProof
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Pixels = NDArray[np.uint8]
"""Shape (height, width, 3)."""

CELL = Camera(width=480, height=300, zoom=0.97)
"""Camera for each state of a contact sheet."""
WHOLE = Camera(width=1200, height=800, zoom=0.94)
"""Camera for a single state."""
FRAME = Camera(width=480, height=320, zoom=0.94, samples=2)
"""Camera for the picture of an environment."""
_LINE = 26
"""Pixels for a line of text."""
_SMALLEST = 6
"""Smallest size of a font, pixels."""
_NOT_INSTALLED, PALE = "#f4f1ea", 0.16
"""Colour of parts that are not installed in the legend, and share of their own colour with which they are seen."""
_ARROW = 0.006
"""Thickness of arrows, in diagonals of the structure."""


def solids_of(assembly: Assembly, appearance: Appearance) -> list[ColoredSolid]:
    """Return all parts that are seen, as meshes with their colours."""
    solids = []
    for part in np.flatnonzero(appearance.opacity > 0).tolist():
        mesh = assembly.meshes[part]
        color = tuple(float(channel) / 255 for channel in appearance.color[part])
        points = appearance.moved(part, mesh.vertices)
        solids.append(ColoredSolid(points, mesh.faces, color, float(appearance.opacity[part])))
    return solids


def draw(
    assembly: Assembly,
    appearance: Appearance,
    camera: Camera = WHOLE,
    *,
    bounds: NDArray[np.float64] | None = None,
    arrows: Sequence[Arrows] = (),
    extra: Sequence[ColoredSolid] = (),
    outline: Image | None = None,
) -> Image:
    """Return the picture of one state.

    Args:
        bounds: box that the picture shows, shape (2, 3); the structure if not given.
        arrows: drawn over the parts, which become pale if any of them lie inside.
        extra: other meshes, such as arms.
        outline: of all parts, as `outline_of` returns it, for the same camera and bounds.
    """
    solids = [*solids_of(assembly, appearance), *extra]
    box = bounds_of(assembly) if bounds is None else bounds
    image = render(solids, camera, box)
    if outline is not None:
        image = np.minimum(image, outline)
    if not any(len(some) for some in arrows):
        return image
    thickness = _ARROW * diagonal(assembly)
    inside = [solid for some in arrows for solid in some.solids(thickness)]
    over = render(inside, camera, box, floor=False)
    there = (over < 0.999).any(axis=2, keepdims=True)
    pale = any(some.inside and len(some) for some in arrows)
    return np.where(there, over, 0.55 * image + 0.45 if pale else image)


def outline_of(timeline: Timeline, camera: Camera, bounds: NDArray[np.float64]) -> Image:
    """Return the pale picture of all parts that are in place at some time, which shows those that are not yet there."""
    there = np.where((timeline.states != REMOVED).any(axis=0), 1, REMOVED).astype(np.uint8)
    whole = appearance_at(timeline, timeline.begin, state=there, travelling=False)
    return 1 - PALE * (1 - render(solids_of(timeline.assembly, whole), camera, bounds, floor=False))


def _scene(
    timeline: Timeline, position: float, arms: Arms | None, time: float | None = None, **look: Any
) -> tuple[Appearance, Sequence[ColoredSolid]]:
    """Return the parts, and arms with what they carry, at a place or time; `look` as for `appearance_at`."""
    appearance = appearance_at(timeline, position, **look)
    if arms is None:
        return appearance, ()
    poses = arms.at(position) if time is None else arms.at_time(time)
    return appearance_with_arms(appearance, poses), solids_of_arms(arms, poses, timeline.assembly)


def contact_sheet(
    timeline: Timeline,
    places: Sequence[int],
    *,
    columns: int = 4,
    camera: Camera = CELL,
    title: str = "",
    arms: Arms | None = None,
    proofs: Mapping[int, StateProof] | None = None,
) -> Pixels:
    """Return some states of a timeline with their steps, and the legend.

    Args:
        places: states to show, at least one.
        proofs: verdicts on states, by place; sliding parts are marked, and verdicts other than stable are written
            above.
    """
    pillow = import_pillow()
    columns = min(columns, len(places))
    rows = -(-len(places) // columns)
    head, cell = (_LINE + 6 if title else 0), camera.height + _LINE
    proofs = proofs or {}
    sliding = any(proofs[position].slides for position in places if position in proofs)
    pressing = any(timeline.presses_at(position) for position in places)
    entries = legend(timeline, sliding, pressing, outlined=True, places=places)
    box = bounds_of(timeline.assembly)
    box = box if arms is None else bounds_with_arms(arms, box)
    outline = outline_of(timeline, camera, box)
    across = columns * camera.width
    foot = legend_height(entries, across)
    sheet = pillow.Image.new("RGB", (across, head + rows * cell + foot + 14), "white")
    pen = pillow.ImageDraw.Draw(sheet)
    if title:
        write_text(pen, (across / 2, head / 2 + 2), title, 18, across=across)
    for number, position in enumerate(places):
        left, top = (number % columns) * camera.width, head + (number // columns) * cell
        proof = proofs.get(position)
        marks = None if proof is None else proof.marks
        appearance, extra = _scene(timeline, position, arms, marks=marks, travelling=False)
        arrows = list(arrows_of_step(timeline, position).values())
        drawn = draw(timeline.assembly, appearance, camera, bounds=box, arrows=arrows, extra=extra, outline=outline)
        picture = to_pixels(drawn)
        sheet.paste(pillow.Image.fromarray(picture), (left, top + _LINE))
        text = caption(timeline, position, proof)
        write_text(pen, (left + camera.width / 2, top + _LINE / 2 + 4), text, across=camera.width)
    write_legend(pen, across, sheet.height - foot + _LINE / 2 - 5, entries)
    return np.asarray(sheet)


def one_state(
    timeline: Timeline,
    position: float,
    camera: Camera = WHOLE,
    *,
    arrows: Sequence[Arrows] = (),
    key: Sequence[tuple[str, str]] | None = None,
    arms: Arms | None = None,
    time: float | None = None,
    action_probabilities: NDArray[np.float64] | None = None,
    share_of: str = "",
    bounds: NDArray[np.float64] | None = None,
    words: str | None = None,
    marks: Mapping[int, str] | None = None,
    travelling: bool = True,
    outline: Image | None = None,
) -> Pixels:
    """Return the picture of one place of a timeline, with its action and the legend.

    Args:
        position: where; between whole numbers parts are on their way.
        key: the legend, colour and words; of the timeline if not given.
        time: of their motions, seconds; that at which the place is reached if not given.
        action_probabilities: probability of the action that concerns each part, or another share that colours it, NaN
            where there is none, shape (parts,).
        bounds: box that the picture shows, shape (2, 3); the structure and the ways of its parts if not given.
        words: the lines above; the step if not given.
        marks: colours of parts that stand out, such as those that slide.
        travelling: whether to show the parts that come next on their way.
        outline: as for `draw`.
    """
    pillow = import_pillow()
    appearance, extra = _scene(
        timeline,
        position,
        arms,
        time,
        action_probabilities=action_probabilities,
        marks=marks,
        travelling=travelling and arms is None,
    )
    box = (bounds_with_motions(timeline) if travelling else bounds_of(timeline.assembly)) if bounds is None else bounds
    if arms is not None and bounds is None:
        box = bounds_with_arms(arms, bounds_of(timeline.assembly))
    tips = [some.ends.reshape(-1, 3) for some in arrows if len(some)]
    if tips and bounds is None:
        box = box_around(np.concatenate([box, *tips]))
        box[0, 2] = bounds_of(timeline.assembly)[0, 2]
    drawn = draw(timeline.assembly, appearance, camera, bounds=box, arrows=arrows, extra=extra, outline=outline)
    entries = list(legend(timeline) if key is None else key)
    if action_probabilities is not None:
        entries = entries[:1] + legend_of_shares(share_of)
    lines = (caption(timeline, timeline.next(position)) if words is None else words).split("\n")
    head = _LINE * len(lines) + 4
    height = head + camera.height + legend_height(entries, camera.width) + 10
    image = pillow.Image.new("RGB", (camera.width, height + height % 2), "white")
    image.paste(pillow.Image.fromarray(to_pixels(drawn)), (0, head))
    pen = pillow.ImageDraw.Draw(image)
    for row, text in enumerate(lines):
        write_text(pen, (camera.width / 2, _LINE * (row + 0.5) + 4), text, 18, across=camera.width)
    write_legend(pen, camera.width, head + camera.height + 0.5 * _LINE, entries)
    return np.asarray(image)


def state_frame(assembly: Assembly, state: States, robots: int, words: str) -> Pixels:
    """Draw a state, shape (parts,), with a line of words above and the legend; of one size for a structure.

    Args:
        robots: parts that may be held at once.
    """
    timeline = Timeline.from_state(assembly, state, robots).turned(Direction.DISASSEMBLY)
    box = bounds_of(assembly)
    # Every frame of a film has the same size, so the legend has all robots.
    key = [(robot_color(k), f"held by {timeline.robot_name(k)}") for k in range(min(robots, len(ROBOTS)))]
    key = legend(timeline)[:2] + key
    return one_state(timeline, 0, FRAME, key=key, bounds=box, words=words or assembly.name)


def legend(
    timeline: Timeline,
    sliding: bool = False,
    pressing: bool = False,
    outlined: bool = False,
    *,
    places: Sequence[int] | None = None,
) -> list[tuple[str, str]]:
    """Return the colour and words of all that a timeline shows, or some places of it."""
    entries = [(BOUNDARY, "boundary"), (INSTALLED, "installed")]
    entries += [(_NOT_INSTALLED, "not installed")] * outlined
    holders = timeline.holders if places is None else timeline.holders[[timeline.row(place) for place in places]]
    for robot in range(min(int(timeline.holders.max(initial=NO_ROBOT)) + 1, len(ROBOTS))):
        if places is None or (holders % len(ROBOTS) == robot)[holders != NO_ROBOT].any():
            entries.append((robot_color(robot), f"held by {timeline.robot_name(robot)}"))
    if sliding:
        entries.append((SLIDING, "would slide"))
    if pressing:
        entries.append((PRESS, "robot presses"))
    return entries


def legend_of_shares(share_of: str = "") -> list[tuple[str, str]]:
    """Return the colour and words of some shares, such as `25% of the limit`."""
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    return [(hex_of(ramp(share)), f"{share:.0%}{share_of and f' of {share_of}'}") for share in shares]


def caption(timeline: Timeline, position: int, proof: StateProof | None = None) -> str:
    """Return the caption of a state, such as `step 3 of 90: insert block-7 (R1)`, and its verdict if not stable."""
    verdict = "" if proof is None else f" ({proof.verdict})" if not proof.stable else ""
    if len(timeline) == 0:
        return timeline.assembly.name + verdict
    return timeline.label(position) + verdict


def check_places(timeline: Timeline, places: Sequence[int]) -> None:
    """Refuse states that are not there."""
    for position in places:
        if not 0 <= position <= len(timeline):
            raise InputError(no_such_step(position, len(timeline)))


def bounds_with_motions(timeline: Timeline) -> NDArray[np.float64]:
    """Return the bounds of the structure and of its parts at the end of their paths, shape (2, 3)."""
    box = bounds_of(timeline.assembly)
    if len(timeline) == 0:
        return box
    # Half of the path suffices: farther out a part is nearly invisible.
    far, points = TRAVEL * diagonal(timeline.assembly), [box]
    for part, mesh in enumerate(timeline.assembly.meshes):
        points.append(box_around(apply(timeline.displacements(part, 0.5, far)[part], mesh.vertices)))
    wide = box_around(np.concatenate(points))
    wide[0, 2] = box[0, 2]
    return wide


def to_pixels(image: Image) -> Pixels:
    """Return an image of floats as bytes."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def check_suffix(path: Path | str, *suffixes: str) -> None:
    """Raise for a file whose name promises another format; a name without a suffix promises none."""
    suffix = Path(path).suffix.lower()
    if suffix and suffix not in suffixes:
        raise InputError(f"{path}: pictures are written as {' or '.join(suffixes)}; name such a file")


def import_pillow() -> Any:
    """Return the package that writes pictures."""
    with importing("pictures need Pillow; install it with pip install 'falsework[picture]'"):
        import PIL.Image
        import PIL.ImageDraw
        import PIL.ImageFont
    return PIL


def write_text(
    pen: Any,
    position: tuple[float, float],
    text: str,
    size: int = 14,
    color: str = INK,
    anchor: str = "mm",
    across: float = np.inf,
) -> None:
    """Write a line of text, its middle or another anchor of Pillow at a position, smaller if it is too wide; pixels."""
    while size > _SMALLEST and pen.textlength(text, font=_font(text, size)) > across:
        size -= 1
    pen.text(position, text, fill=color, font=_font(text, size), anchor=anchor)


def _font(text: str, size: int) -> Any:
    """Return the font of Pillow, or for a text with letters beyond ASCII, which that lacks, one that has them."""
    fonts = import_pillow().ImageFont
    if text.isascii():
        return fonts.load_default(size)
    with importing("pictures need Matplotlib; install it with pip install 'falsework[picture]'"):
        return fonts.truetype(font_file(text), size)


def in_rows(lengths: Sequence[float], across: float) -> list[list[int]]:
    """Return the numbers of the entries of a legend, row by row; no row is wider than the picture if it can be."""
    rows: list[list[int]] = [[]]
    for number, length in enumerate(lengths):
        if rows[-1] and sum(lengths[k] for k in rows[-1]) + length > across:
            rows.append([])
        rows[-1].append(number)
    return rows


def _lengths(entries: Sequence[tuple[str, str]]) -> list[float]:
    return [_font(words, 14).getlength(words) + 42 for _, words in entries]


def legend_height(entries: Sequence[tuple[str, str]], across: int) -> int:
    """Return the height of a legend under a picture so many pixels across."""
    return _LINE * len(in_rows(_lengths(entries), across))


def write_legend(pen: Any, across: int, middle: float, entries: Sequence[tuple[str, str]]) -> None:
    """Write colours and words in rows, the middle of the first at a height, in the middle of a picture; pixels."""
    lengths = _lengths(entries)
    for row in in_rows(lengths, across):
        left = (across - sum(lengths[k] for k in row)) / 2 + 8
        for number in row:
            color, words = entries[number]
            pen.rectangle((left, middle - 7, left + 20, middle + 7), fill=color)
            write_text(pen, (left + 26, middle), words, anchor="lm")
            left += lengths[number]
        middle += _LINE

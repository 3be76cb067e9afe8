"""Printable PDF of assembly instructions: cover, stock list, setting-out drawing, then a picture for each step."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import DependencyError, InputError
from falsework.interop.instruction_table import (
    AssemblyInstruction,
    AssemblyInstructions,
    sheet,
)
from falsework.interop.pdf_text import BOLD, REGULAR, broken_lines, jpeg, register_fonts, write_line, write_paragraph
from falsework.interop.setting_out import setting_out
from falsework.utils.files.formats import Exporter, writer_of
from falsework.utils.quantity import counted, listed
from falsework.viewer.appearance import appearance_at, bounds_of, diagonal
from falsework.viewer.arrows import Arrows, arrows_of_step
from falsework.viewer.palette import INK, PRESS, mix, robot_color
from falsework.viewer.pictures.contact_sheet import draw
from falsework.viewer.pictures.render import Camera

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan

Progress = Callable[[int, int], None]

_POINT = 72.0 / 25.4
"""Points a millimetre."""
_PAGE = (210.0 * _POINT, 297.0 * _POINT)
"""Width and height of a page, A4, in points like all lengths below."""
_MARGIN = 14.0 * _POINT
"""Space at the left and the right of a page."""
_ROW = 41.0 * _POINT
"""Height of the row of a step."""
_TOP = 16.0 * _POINT
"""Space above the rows of a page."""
_COVER = (120.0 * _POINT, 76.0 * _POINT)
"""Width and height of the picture on the cover."""
_STOCK_LINE = 11.0
"""Height of a line of the stock list."""
_STOCK_COLUMNS = 2
"""Columns of the stock list."""
_ARROW = 0.16
"""Length of the arrow of an insertion, in diagonals of the structure."""
_PICTURE = (60.0 * _POINT, 38.0 * _POINT)
"""Width and height of the picture of a step."""
_COLUMNS = (0.0, 13.0 * _POINT, 76.0 * _POINT, 126.0 * _POINT)
"""Left edges of the columns: number, picture, action, parts to hold."""
_LISTED_PARTS = 12
"""Names of parts in one line; the rest is a number."""
_LISTED_PRESSES = 2
"""Presses of one step for which there is room."""
CAMERA = Camera(width=480, height=304, zoom=0.96)
"""Default camera of the pictures."""
_GREY = "#77797d"


def instructions_pdf(
    sheet: AssemblyInstructions, *, camera: Camera = CAMERA, progress: Progress | None = None
) -> bytes:
    """Return a PDF of A4 pages.

    Args:
        progress: called with the number of pictures drawn and of all.

    Raises:
        DependencyError: reportlab or matplotlib, whose fonts are used, is not installed.
    """
    for name in ("reportlab", "matplotlib"):
        if find_spec(name) is None:
            raise DependencyError(f"a sheet as PDF needs {name}; pip install 'falsework[sheet]', or write .csv")
    from reportlab import rl_config
    from reportlab.pdfgen.canvas import Canvas

    rl_config.useA85 = 0  # pictures as bytes: their ASCII form is a quarter longer, and slow to write
    register_fonts()
    buffer = io.BytesIO()
    canvas = Canvas(buffer, pagesize=_PAGE, pageCompression=1, invariant=1)
    canvas.setTitle(f"{sheet.assembly.name}: how to build it")
    canvas.setSubject("assembly instructions")
    canvas.setAuthor("")  # else anonymous
    canvas.setCreator("falsework")
    rows = table_rows(sheet)
    room = int((_PAGE[1] - _MARGIN - _TOP) // _ROW)
    pages = [rows[begin : begin + room] for begin in range(0, len(rows), room)]
    stock = _cover(canvas, sheet, camera)
    count = 2 + len(stock) + len(pages)
    _foot(canvas, sheet, 1, count)
    canvas.showPage()
    for number, lines in enumerate(stock, 2):
        _stock(canvas, sheet, lines, _PAGE[1] - _TOP - 12)
        _foot(canvas, sheet, number, count)
        canvas.showPage()
    setting_out(canvas, sheet.assembly, _MARGIN, _PAGE[1] - _TOP, _PAGE[0] - 2 * _MARGIN, _PAGE[1] - _TOP - _MARGIN)
    _foot(canvas, sheet, 2 + len(stock), count)
    canvas.showPage()
    box, done = _box(sheet), 0
    for number, page in enumerate(pages, 3 + len(stock)):
        for place, steps in enumerate(page):
            _row(canvas, sheet, steps, _PAGE[1] - _TOP - (place + 1) * _ROW, camera, box)
            done += 1
            if progress is not None:
                progress(done, len(rows))
        _foot(canvas, sheet, number, count)
        canvas.showPage()
    canvas.save()
    return buffer.getvalue()


def table_rows(sheet: AssemblyInstructions) -> list[tuple[AssemblyInstruction, ...]]:
    """Return the steps of each row: one, or a placing by one support and the release right after it."""
    rows: list[tuple[AssemblyInstruction, ...]] = []
    for step in sheet.steps:
        before = rows[-1] if rows else ()
        released = not step.place and not step.presses and len(before) == 1 and before[0].place
        if released and len(before[0].supports) == 1 and before[0].parts[0] == step.parts[0]:
            rows[-1] = (*before, step)
        else:
            rows.append((step,))
    return rows


def _cover(canvas: Canvas, sheet: AssemblyInstructions, camera: Camera) -> list[list[tuple[int, int]]]:
    """Draw the cover, and return the lines of the stock list, part and step, for which it has no room, by page."""
    y = _head(canvas, sheet) - _COVER[1] - 8
    view = replace(camera, width=900, height=round(900 * _COVER[1] / _COVER[0]))
    look = appearance_at(sheet.timeline, len(sheet.timeline), marks={}, travelling=False)
    canvas.drawImage(jpeg(draw(sheet.assembly, look, view, samples=2)), _MARGIN, y, *_COVER)
    _axes(canvas, camera, _MARGIN + _COVER[0] + 40, y + 30, 26)
    placed = [(part, step.number) for step in sheet.steps if step.place for part in step.parts]
    y -= 20
    write_line(canvas, _MARGIN, y, "Stock list", BOLD, 11)
    first = _STOCK_COLUMNS * int((y - 14 - _MARGIN) // _STOCK_LINE - 1)
    rest = _STOCK_COLUMNS * int((_PAGE[1] - _TOP - 12 - _MARGIN) // _STOCK_LINE - 1)
    _stock(canvas, sheet, placed[:first], y - 16)
    return [placed[begin : begin + rest] for begin in range(first, len(placed), rest)]


def _stock(canvas: Canvas, sheet: AssemblyInstructions, lines: list[tuple[int, int]], top: float) -> None:
    """Draw lines of the stock list: part, mass, centre and the step that places it."""
    broad = (_PAGE[0] - 2 * _MARGIN) / _STOCK_COLUMNS
    high = -(-len(lines) // _STOCK_COLUMNS)
    ends = (0.0, 0.45 * broad, 0.85 * broad, 0.95 * broad)
    for column in range(_STOCK_COLUMNS if lines else 0):
        x = _MARGIN + column * broad
        for end, word in zip(ends, ("part", "kg", "centre x, y, z, m", "step"), strict=True):
            write_line(canvas, x, top, word, REGULAR, 7.5, color=_GREY, end=None if end == 0 else x + end)
        for number, (part, step) in enumerate(lines[column * high : (column + 1) * high], 1):
            y = top - _STOCK_LINE * number
            write_line(canvas, x, y, sheet.name(part), REGULAR, 7.5, width=0.3 * broad)
            for end, word in zip(ends[1:], (_mass(sheet, part), _center(sheet, part), str(step)), strict=True):
                write_line(canvas, x, y, word, REGULAR, 7.5, end=x + end)


def _mass(sheet: AssemblyInstructions, *parts: int) -> str:
    """Return the mass of parts in kg, in full."""
    mass = float(sheet.assembly.mass.mass[list(parts)].sum())
    return f"{mass:,.0f}" if mass >= 1000 else f"{mass:.2f}" if mass >= 1 else f"{mass:.3f}"


def _center(sheet: AssemblyInstructions, part: int) -> str:
    """Return the centre of mass of a part, m, to the millimetre."""
    return ", ".join(f"{value:.3f}" for value in sheet.assembly.mass.center[part].round(3) + 0.0)


def _axes(canvas: Canvas, camera: Camera, x: float, y: float, length: float) -> None:
    """Draw the directions of x, y and z as the camera sees them."""
    canvas.setStrokeColor(INK)
    canvas.setLineWidth(0.8)
    for name, across, up in zip("xyz", *camera.axes[:2], strict=True):
        canvas.line(x, y, x + length * across, y + length * up)
        write_line(canvas, x + 1.25 * length * across - 2, y + 1.25 * length * up - 2, name, REGULAR, 7)


def step_arrows(sheet: AssemblyInstructions, step: AssemblyInstruction) -> Arrows:
    """Return the arrows along which the parts of a step come in, each outside of its part."""
    assert step.directions is not None
    length, ends = _ARROW * diagonal(sheet.assembly), []
    for part, way in zip(step.parts, step.directions, strict=True):
        center = sheet.assembly.mass.center[part]
        half = float(((center - sheet.assembly.meshes[part].vertices) @ way).max())
        ends.append([center - (half + 1.2 * length) * way, center - (half + 0.2 * length) * way])
    return Arrows(np.array(ends), INK, breadth=2.0, inside=False)


def _box(sheet: AssemblyInstructions) -> NDArray[np.float64]:
    """Return the box that all pictures show: the structure and the arrows of insertions, shape (2, 3)."""
    arrows = [step_arrows(sheet, step).ends.reshape(-1, 3) for step in sheet.steps if step.place]
    points = np.concatenate([bounds_of(sheet.assembly), *arrows])
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    box[0, 2] = bounds_of(sheet.assembly)[0, 2]
    return box


def _head(canvas: Canvas, sheet: AssemblyInstructions) -> float:
    """Draw the title, the glossary, and the rules on which the proofs rest; return where they end."""
    assembly, left, y = sheet.assembly, _MARGIN, _PAGE[1] - _MARGIN - 8
    write_line(canvas, left, y, assembly.name, BOLD, 18, width=_PAGE[0] - 2 * _MARGIN)
    placed = [part for step in sheet.steps if step.place for part in step.parts]
    mass = float(assembly.mass.mass[placed].sum())
    work = f"{counted(sheet.supports, 'support')}, {counted(len(sheet.steps), 'step')}"
    facts = f"{counted(len(placed), 'part')} to place, {mass:,.0f} kg; {work}"
    write_line(canvas, left, y - 16, facts, REGULAR, 10.5)
    lines = [
        "A support is a robot (support 1 is R1), a prop or a pair of hands that keeps a part exactly where it is.",
        "Keep to the order. Release no part before the sheet says so: the states of the steps were proved to stand.",
        f"The proofs hold for friction of at least {assembly.friction:g} and parts of the masses given, at rest, "
        "where the model has them.",
        "Arrows show how a part comes in. Dark parts are fixed. Pictures show the state in which the part is held.",
    ]
    if any(step.presses for step in sheet.steps):
        lines.append(
            "PRESS: a support pushes its part with the force given while the other part is released, then stays there."
        )
    if sheet.start:
        lines.append(f"There before step 1: {listed([sheet.name(part) for part in sheet.start], _LISTED_PARTS)}.")
    if sheet.holding(0):
        held = ", ".join(f"{sheet.name(part)} by support {support + 1}" for part, support in sheet.holding(0))
        lines.append(f"Held before step 1: {held}.")
    needed = [step for step in sheet.steps if step.needed]
    if needed:
        when = ", ".join(f"{sheet.named(step)} for step {step.number}" for step in needed)
        lines.append(f"Not delivered yet, and needed: {when}.")
    y -= 32
    for line in lines:
        y = write_paragraph(canvas, left, y, line, 8.3, width=_PAGE[0] - 2 * _MARGIN, leading=11.5)
    x, y = left, y - 4
    for support in range(sheet.supports):
        canvas.setFillColor(robot_color(support))
        canvas.rect(x, y - 2, 10, 10, stroke=0, fill=1)
        x = write_line(canvas, x + 14, y, f"support {support + 1}", REGULAR, 9) + 16
    write_line(canvas, x, y, "pale: just released", REGULAR, 9)
    return y


def _row(
    canvas: Canvas,
    sheet: AssemblyInstructions,
    steps: tuple[AssemblyInstruction, ...],
    y: float,
    camera: Camera,
    box: NDArray[np.float64],
) -> None:
    """Draw one step, or a placing with its release, between `y` and `y` plus the height of a row."""
    step, last = steps[0], steps[-1]
    left, top = _MARGIN, y + _ROW
    canvas.setStrokeColor("#d5d3cd")
    canvas.setLineWidth(0.5)
    canvas.line(left, top, _PAGE[0] - _MARGIN, top)
    write_line(canvas, left, top - 17, ", ".join(str(one.number) for one in steps), BOLD, 14 if len(steps) == 1 else 10)
    canvas.setStrokeColor(INK)
    canvas.rect(left, top - 42, 13, 13, stroke=1, fill=0)
    picture = _picture(sheet, step, camera, box)
    canvas.drawImage(picture, left + _COLUMNS[1], y + 1.5 * _POINT, *_PICTURE, preserveAspectRatio=True)
    _axes(canvas, camera, left + _COLUMNS[1] + 10, y + 12, 11)
    x, width = left + _COLUMNS[2], _COLUMNS[3] - _COLUMNS[2] - 8
    color = robot_color(step.supports[0])
    canvas.setFillColor(color if step.place else mix(color, "#ffffff", 0.55))
    canvas.rect(x, top - 17, 9, 9, stroke=0, fill=1)
    write_line(canvas, x + 13, top - 16, ", ".join(one.verb.upper() for one in steps), BOLD, 10.5)
    write_line(canvas, x, top - 33, sheet.named(step), BOLD, 13, width=width)
    line = top - 46
    several, carried = len(step.parts) > 1, len(step.supports) < len(step.parts)
    if step.directions is not None:
        about = (
            f"{_mass(sheet, *step.parts)} kg, {'come in together' if several else 'comes in'} {sheet.comes_in(step)}"
        )
        line = write_paragraph(canvas, x, line, about, 8.3, width=width)
        if not several:
            line = write_paragraph(canvas, x, line, f"centre {_center(sheet, step.parts[0])}\u00a0m", 8.3, width=width)
        held = f"and {'are' if several else 'is'} held by {_supports(step)}"
        if carried:
            held = f"carried by {_supports(step)}, which holds {sheet.name(step.parts[0])}"
        line = write_paragraph(canvas, x, line, held, 8.3, width=width)
    if not last.place:
        lets_go = "and then lets go" if carried else "which then lets go"
        then = lets_go if step.place else f"{_supports(step)} lets go and is free"
        line = write_paragraph(canvas, x, line, then, 8.3, width=width)
        presses = sheet.pressing(last)
        for number, (what, how) in enumerate(presses[:_LISTED_PRESSES]):
            more = len(presses) - _LISTED_PRESSES if number + 1 == _LISTED_PRESSES else 0
            how += f", and {more} more" if more > 0 else ""
            write_line(canvas, x, line, f"PRESS {what}", BOLD, 8.3, color=PRESS, width=width)
            line = write_paragraph(canvas, x, line - 10, how, 8.3, color=PRESS, width=width)
    if step.needed:
        write_line(canvas, x, line, "was late: is it there?", BOLD, 8.3, width=width)
    placed = f"{counted(last.placed, 'part')} placed{'; ' if last.margins else ''}{last.margins}"
    lines = broken_lines(placed, 7.8, _PAGE[0] - 2 * _MARGIN - _COLUMNS[2])
    for number, words in enumerate(lines):
        write_line(canvas, x, y + 5 + 9.5 * (len(lines) - 1 - number), words, REGULAR, 7.8, color=_GREY)
    x, width = left + _COLUMNS[3], _PAGE[0] - 2 * _MARGIN - _COLUMNS[3]
    write_line(
        canvas, x, top - 16, "HOLD until released" if last.hold else "nothing is held", REGULAR, 8.3, color=_GREY
    )
    room = max(int((_ROW - 40) // 13), 1)
    shown = last.hold if len(last.hold) <= room else last.hold[: room - 1]
    for number, (part, support) in enumerate(shown):
        line = top - 32 - 13 * number
        canvas.setFillColor(robot_color(support))
        canvas.rect(x, line - 1, 8, 8, stroke=0, fill=1)
        write_line(canvas, x + 12, line, sheet.name(part), REGULAR, 9.5, width=width - 12)
    if len(shown) < len(last.hold):
        more = f"and {len(last.hold) - len(shown)} more that are coloured"
        write_line(canvas, x, top - 32 - 13 * len(shown), more, REGULAR, 8.3)


def _supports(step: AssemblyInstruction) -> str:
    """Return the supports of a step, such as `supports 1 and 2`."""
    numbers = [str(support + 1) for support in step.supports]
    return f"support {numbers[0]}" if len(numbers) == 1 else f"supports {', '.join(numbers[:-1])} and {numbers[-1]}"


def _foot(canvas: Canvas, sheet: AssemblyInstructions, number: int, pages: int) -> None:
    y = _MARGIN - 16
    about = f"{sheet.assembly.name}, structure {sheet.assembly.identity[:12]}"
    write_line(canvas, _MARGIN, y, about, REGULAR, 7.5, color=_GREY, width=_PAGE[0] / 2)
    canvas.setFont(REGULAR, 7.5)
    canvas.setFillColor(_GREY)
    canvas.drawRightString(_PAGE[0] - _MARGIN, y, f"page {number} of {pages}")


def _picture(sheet: AssemblyInstructions, step: AssemblyInstruction, camera: Camera, box: NDArray[np.float64]) -> Any:
    """Return the state after a step, as an image for the page."""
    marks = {} if step.place else {step.parts[0]: mix(robot_color(step.supports[0]), "#ffffff", 0.55)}
    look = appearance_at(sheet.timeline, step.number, marks=marks, travelling=False)
    arrows = list(arrows_of_step(sheet.timeline, step.number).values())
    if step.place:
        arrows.append(step_arrows(sheet, step))
    return jpeg(draw(sheet.assembly, look, camera, bounds=box, arrows=arrows, samples=2))


def _pdf_of(
    assembly: Assembly,
    plan: Plan,
    *,
    azimuth: float = CAMERA.azimuth,
    elevation: float = CAMERA.elevation,
    progress: Progress | None = None,
) -> bytes:
    if not -90 < elevation < 90 or elevation == 0:
        raise InputError(f"an elevation of {elevation:g} degrees sees nothing; give one such as 24")
    camera = replace(CAMERA, azimuth=azimuth, elevation=elevation)
    return instructions_pdf(sheet(assembly, plan), camera=camera, progress=progress)


PDF = Exporter(writer_of(_pdf_of), (".pdf",), ("Plan",), ("azimuth", "elevation", "progress"))

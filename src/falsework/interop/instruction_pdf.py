"""Printable PDF of assembly instructions: cover, stock list, setting-out drawing, then a picture for each step."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from falsework.errors import DependencyError, InputError
from falsework.geometry.arrays import box_around
from falsework.interop.instruction_table import AssemblyInstruction, AssemblyInstructions, sheet
from falsework.interop.pdf_page import REGULAR, jpeg, register_fonts
from falsework.interop.setting_out import setting_out
from falsework.utils.files.formats import Exporter, writer_of
from falsework.utils.quantity import counted, listed
from falsework.viewer.appearance import appearance_at, bounds_of, diagonal
from falsework.viewer.arrows import Arrows, arrows_of_step
from falsework.viewer.palette import INK, PRESS, mix, robot_color
from falsework.viewer.pictures.contact_sheet import draw
from falsework.viewer.pictures.render import Camera

if TYPE_CHECKING:
    from reportlab.graphics.shapes import Drawing
    from reportlab.pdfgen.canvas import Canvas
    from reportlab.platypus import Flowable

    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan

Progress = Callable[[int, int], None]

_MM = 72.0 / 25.4
"""Points a millimetre; lengths below are in points."""
_MARGIN, _TOP = 14.0 * _MM, 16.0 * _MM
"""Space around a page, A4, and above its rows."""
_COVER, _PICTURE = (120.0 * _MM, 76.0 * _MM), (60.0 * _MM, 38.0 * _MM)
"""Width and height of the picture on the cover, and of that of a step."""
_COLUMNS = (13.0 * _MM, 62.0 * _MM, 48.0 * _MM, 54.0 * _MM)
"""Widths of the columns of a step: number, picture, action, parts to hold."""
_STOCK = (36.0 * _MM, 14.0 * _MM, 30.0 * _MM, 8.0 * _MM)
"""Widths of the columns of the stock list: part, mass, centre, step."""
_ARROW = 0.16
"""Length of the arrow of an insertion, in diagonals of the structure."""
_LISTED_PARTS = 12
"""Names of parts in one line; the rest is a number."""
CAMERA = Camera(width=480, height=304, zoom=0.96, samples=2)
"""Default camera of the pictures."""
_GREY = "#77797d"


def instructions_pdf(
    sheet: AssemblyInstructions, *, camera: Camera = CAMERA, progress: Progress | None = None
) -> bytes:
    """Return a PDF of A4 pages.

    Args:
        progress: called with the number of pictures drawn and of all.
    """
    for name in ("reportlab", "matplotlib"):
        if find_spec(name) is None:
            raise DependencyError(f"a sheet as PDF needs {name}; pip install 'falsework[sheet]', or write .csv")
    from reportlab import rl_config
    from reportlab.lib.pagesizes import A4
    from reportlab.platypus import PageBreak, SimpleDocTemplate
    from reportlab.platypus.flowables import CallerMacro

    rl_config.useA85 = 0  # pictures as bytes: their ASCII form is a quarter longer, and slow to write
    register_fonts()
    buffer = io.BytesIO()
    document = SimpleDocTemplate(
        buffer,
        pagesize=A4,
        leftMargin=_MARGIN,
        rightMargin=_MARGIN,
        topMargin=_TOP,
        bottomMargin=_MARGIN,
        title=f"{sheet.assembly.name}: how to build it",
        subject="assembly instructions",
        author="",  # else anonymous
        creator="falsework",
        pageCompression=1,
        invariant=1,
    )
    rows, box = table_rows(sheet), _box(sheet)

    def draw_setting_out(flowable: Flowable, *_: float) -> None:  # from the upper left of the frame
        flowable.canv.translate(0, -document.height)
        setting_out(flowable.canv, sheet.assembly, document.width, document.height)

    drawing = CallerMacro(drawCallable=draw_setting_out)
    story = [*_cover(sheet, camera), PageBreak(), drawing, PageBreak()]
    for done, steps in enumerate(rows, 1):
        story.append(_row(sheet, steps, camera, box))
        if progress is not None:
            progress(done, len(rows))
    document.build(story, canvasmaker=_numbered(sheet))
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


def _numbered(sheet: AssemblyInstructions) -> type[Canvas]:
    """Return the canvas that writes at the foot of each page what it is of, once the number of pages is known."""
    from reportlab.lib.pagesizes import A4
    from reportlab.pdfgen.canvas import Canvas

    class NumberedCanvas(Canvas):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self.kept: list[dict[str, Any]] = []

        def showPage(self) -> None:
            self.kept.append(dict(self.__dict__))
            self._startPage()  # type: ignore[missing-attribute]

        def save(self) -> None:
            about = f"{sheet.assembly.name}, structure {sheet.assembly.identity[:12]}"
            for number, page in enumerate(self.kept, 1):
                self.__dict__.update(page)
                self.setFont(REGULAR, 7.5)
                self.setFillColor(_GREY)
                self.drawString(_MARGIN, _MARGIN - 16, about)
                self.drawRightString(A4[0] - _MARGIN, _MARGIN - 16, f"page {number} of {len(self.kept)}")
                super().showPage()
            super().save()

    return NumberedCanvas


def _text(markup: str, size: float = 8.3, color: str = INK) -> Flowable:
    """Return a paragraph; `markup` is XML, `<b>` for bold."""
    from reportlab.lib.styles import ParagraphStyle
    from reportlab.platypus import Paragraph

    style = ParagraphStyle("", fontName=REGULAR, fontSize=size, leading=1.2 * size, textColor=_color(color))
    return Paragraph(markup, style)


def _square(color: str) -> str:
    return f'<font color="{color}">\u25a0</font> '


def _cover(sheet: AssemblyInstructions, camera: Camera) -> list[Flowable]:
    """Return the cover: title, rules on which the proofs rest, glossary, picture and stock list."""
    from reportlab.platypus import Table

    assembly = sheet.assembly
    placed = [(part, step.number) for step in sheet.steps if step.place for part in step.parts]
    mass = float(assembly.mass.mass[[part for part, _ in placed]].sum())
    work = f"{counted(sheet.supports, 'support')}, {counted(len(sheet.steps), 'step')}"
    rules = [
        "A support is a robot (support 1 is R1), a prop or a pair of hands that keeps a part exactly where it is.",
        "Keep to the order. Release no part before the sheet says so: the states of the steps were proved to stand.",
        *sheet.premises,
        "Arrows show how a part comes in. Dark parts are fixed. Pictures show the state in which the part is held.",
    ]
    if any(step.presses for step in sheet.steps):
        rules.append(
            "PRESS: a support pushes its part with the force given while the other part is released, then stays there."
        )
    if sheet.start:
        rules.append(f"There before step 1: {listed([sheet.name(part) for part in sheet.start], _LISTED_PARTS)}.")
    if sheet.holding(0):
        held = ", ".join(f"{sheet.name(part)} by support {support + 1}" for part, support in sheet.holding(0))
        rules.append(f"Held before step 1: {held}.")
    needed = [step for step in sheet.steps if step.needed]
    if needed:
        when = ", ".join(f"{sheet.named(step)} for step {step.number}" for step in needed)
        rules.append(f"Not delivered yet, and needed: {when}.")
    colors = [f"{_square(robot_color(support))}support {support + 1}" for support in range(sheet.supports)]
    view = replace(camera, width=900, height=round(900 * _COVER[1] / _COVER[0]))
    look = appearance_at(sheet.timeline, len(sheet.timeline), marks={}, travelling=False)
    picture = _picture(draw(assembly, look, view), _COVER)
    return [
        _text(f"<b>{escape(assembly.name)}</b>", 18),
        _text(f"{counted(len(placed), 'part')} to place, {mass:,.0f} kg; {work}", 10.5),
        *(_text(escape(rule)) for rule in rules),
        _text(" &nbsp; ".join([*colors, "pale: just released"]), 9),
        Table([[picture, _axes(camera, 26)]], hAlign="LEFT"),
        _text("<b>Stock list</b>", 11),
        _stock(sheet, placed),
    ]


def _stock(sheet: AssemblyInstructions, placed: list[tuple[int, int]]) -> Flowable:
    """Return the stock list, in two columns: part, mass, centre and the step that places it."""
    from reportlab.platypus import LongTable

    lines = [
        (_text(escape(sheet.name(part)), 7.5), _mass(sheet, part), _center(sheet, part), step) for part, step in placed
    ]
    half = -(-len(lines) // 2)
    lines += [("",) * 4] * (2 * half - len(lines))
    rows = [[*left, *right] for left, right in zip(lines[:half], lines[half:], strict=True)]
    style = [("FONT", (0, 0), (-1, -1), REGULAR, 7.5), ("TEXTCOLOR", (0, 0), (-1, 0), _GREY)]
    style += [("VALIGN", (0, 0), (-1, -1), "TOP"), ("TOPPADDING", (0, 0), (-1, -1), 0)]
    style += [("BOTTOMPADDING", (0, 0), (-1, -1), 1)]
    style += [("ALIGN", (first, 0), (first + 2, -1), "RIGHT") for first in (1, 5)]
    heading = ("part", "kg", "centre x, y, z, m", "step")
    return LongTable([heading * 2, *rows], colWidths=_STOCK * 2, style=style, repeatRows=1, hAlign="LEFT")


def _mass(sheet: AssemblyInstructions, *parts: int) -> str:
    """Return the mass of parts in kg, in full."""
    mass = float(sheet.assembly.mass.mass[list(parts)].sum())
    return f"{mass:,.0f}" if mass >= 1000 else f"{mass:.2f}" if mass >= 1 else f"{mass:.3f}"


def _center(sheet: AssemblyInstructions, part: int) -> str:
    """Return the centre of mass of a part, m, to the millimetre."""
    return ", ".join(f"{value:.3f}" for value in sheet.assembly.mass.center[part].round(3) + 0.0)


def _axes(camera: Camera, length: float) -> Drawing:
    """Return the directions of x, y and z as the camera sees them."""
    from reportlab.graphics.shapes import Drawing, Line, String

    size = 1.4 * length
    drawing = Drawing(2 * size, 2 * size)
    for name, across, up in zip("xyz", *camera.axes[:2], strict=True):
        x, y = size + length * across, size + length * up
        drawing.add(Line(size, size, x, y, strokeColor=_color(INK), strokeWidth=0.8))
        drawing.add(String(x + 3 * across - 2, y + 3 * up - 2, name, fontName=REGULAR, fontSize=7))
    return drawing


def _color(text: str) -> Any:
    from reportlab.lib.colors import HexColor

    return HexColor(text)


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
    box = box_around(np.concatenate([bounds_of(sheet.assembly), *arrows]))
    box[0, 2] = bounds_of(sheet.assembly)[0, 2]
    return box


def _row(
    sheet: AssemblyInstructions,
    steps: tuple[AssemblyInstruction, ...],
    camera: Camera,
    box: NDArray[np.float64],
) -> Flowable:
    """Return one step, or a placing with its release: number with a box to tick, picture, action, parts to hold."""
    from reportlab.graphics.shapes import Drawing, Rect
    from reportlab.platypus import Table

    step, last = steps[0], steps[-1]
    tick = Drawing(14, 18)
    tick.add(Rect(0.5, 0.5, 13, 13, fillColor=_color("#ffffff"), strokeColor=_color(INK)))
    number = ", ".join(str(one.number) for one in steps)
    marks = {} if step.place else {step.parts[0]: _pale(step)}
    look = appearance_at(sheet.timeline, step.number, marks=marks, travelling=False)
    arrows = list(arrows_of_step(sheet.timeline, step.number).values())
    if step.place:
        arrows.append(step_arrows(sheet, step))
    picture = _picture(draw(sheet.assembly, look, camera, bounds=box, arrows=arrows), _PICTURE)
    held = [_text(f"{_square(robot_color(by))}{escape(sheet.name(part))}", 9.5) for part, by in last.hold]
    hold = [_text("HOLD until released" if held else "nothing is held", color=_GREY), *held]
    cells = [[_text(f"<b>{number}</b>", 14 if len(steps) == 1 else 9), tick, _axes(camera, 11)], picture]
    style = [("VALIGN", (0, 0), (-1, -1), "TOP"), ("LINEABOVE", (0, 0), (-1, 0), 0.5, "#d5d3cd")]
    style += [("LEFTPADDING", (0, 0), (-1, -1), 2), ("RIGHTPADDING", (0, 0), (-1, -1), 2)]
    # A list of held parts that is longer than a page goes on on the next one.
    return Table([[*cells, _action(sheet, step, last), hold]], colWidths=_COLUMNS, style=style, splitInRow=1)


def _pale(step: AssemblyInstruction) -> str:
    return mix(robot_color(step.supports[0]), "#ffffff", 0.55)


def _action(sheet: AssemblyInstructions, step: AssemblyInstruction, last: AssemblyInstruction) -> list[Flowable]:
    """Return what to do with the parts of a row."""
    verbs = dict.fromkeys((step.verb.upper(), last.verb.upper()))
    color = robot_color(step.supports[0]) if step.place else _pale(step)
    told = [_text(f"{_square(color)}<b>{', '.join(verbs)}</b>", 10.5)]
    told.append(_text(f"<b>{escape(sheet.named(step))}</b>", 13))
    several, carried = len(step.parts) > 1, len(step.supports) < len(step.parts)
    if step.directions is not None:
        comes = f"{'come in together' if several else 'comes in'} {sheet.comes_in(step)}"
        told.append(_text(escape(f"{_mass(sheet, *step.parts)} kg, {comes}")))
        if not several:
            told.append(_text(f"centre {_center(sheet, step.parts[0])}\u00a0m"))
        held = f"and {'are' if several else 'is'} held by {_supports(step)}"
        if carried:
            held = f"carried by {_supports(step)}, which holds {sheet.name(step.parts[0])}"
        told.append(_text(escape(held)))
    if step.joins:
        told.append(_text(f"<b>JOIN</b> {escape(sheet.joining(step))}"))
    if not last.place:
        lets_go = "and then lets go" if carried else "which then lets go"
        told.append(_text(lets_go if step.place else f"{_supports(step)} lets go and is free"))
        for what, how in sheet.pressing(last):
            told.append(_text(f"<b>PRESS {escape(what)}</b> {escape(how)}", color=PRESS))
    if step.needed:
        told.append(_text("<b>was late: is it there?</b>"))
    placed = f"{counted(last.placed, 'part')} placed{'; ' if last.margins else ''}{last.margins}"
    return [*told, _text(escape(placed), 7.8, _GREY)]


def _supports(step: AssemblyInstruction) -> str:
    """Return the supports of a step, such as `supports 1 and 2`."""
    numbers = [str(support + 1) for support in step.supports]
    return f"support {numbers[0]}" if len(numbers) == 1 else f"supports {', '.join(numbers[:-1])} and {numbers[-1]}"


def _picture(image: NDArray[np.floating], size: tuple[float, float]) -> Flowable:
    from reportlab.platypus import Image

    return Image(jpeg(image), *size, kind="proportional")


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

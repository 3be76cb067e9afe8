"""`falsework doctor`: contents, repairs and doubtful parts of the files of a structure, and reach of a cell."""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from falsework.cli.cell_reach import examine_cell, report_reach
from falsework.cli.command import UNSET, Command, LoadOptions
from falsework.cli.exit_code import Exit
from falsework.errors import InputError
from falsework.utils.quantity import counted, format_quantity, listed

if TYPE_CHECKING:
    from falsework.assembly.doctor import Diagnosis
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output

_LISTED = 20
"""Findings that are listed; --json has all."""
_REPAIRED = "#e69f00"
_DOUBTFUL = "#b2182b"


@dataclass(frozen=True, kw_only=True)
class Doctor(Command, LoadOptions):
    """Report the contents of the files of a structure, repairs, and findings about each part.

    Works on structures that do not load, too: open, tiny, overlapping, duplicate and isolated parts are listed. Ends
    with the entries to add to assembly.json, and states whether the structure loads with them. With --cell it also
    reports which robot can hold which part, each alone on the boundary with the other robots at home, and proposes
    better bases where a robot does not reach a part. The file of a cell is examined by itself. Exit code 1 if something
    does not load as it is, or if a part is out of reach of all robots.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework doctor my-folder",
        "falsework doctor model.3dm --picture model.png",
        "falsework doctor my-folder --cell dome-37 --picture reach.png",
        "falsework doctor cell.toml",
    )
    outcomes: ClassVar[tuple[str, str]] = ("loads", "does_not_load")

    path: Annotated[Positional[Path], arg(metavar="PATH")]
    """Folder or file of meshes, COMPAS data, a Rhino or a STEP file; a cell file; or, with --cell, a built-in."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell file, or a built-in cell such as dome-37, whose robots are to reach the parts."""
    picture: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=UNSET)] = None
    """Draw the parts as PNG: doubtful ones red, repaired ones orange; with --cell a plan view of parts and robots,
    coloured by the number of robots that reach a part."""
    write: bool = False
    """Write what is proposed, with the options of the structure that are given, to assembly.json beside the parts. One
    that is there is left as it is."""

    def run(self, output: Output) -> Exit:
        """Diagnose, draw and report."""
        if self.write and (self.cell is not None or self.path.suffix.lower() == ".toml"):
            raise InputError("--write is about the file of a structure; leave out the cell")
        if self.path.suffix.lower() == ".toml":
            if self.cell is not None or self.picture is not None:
                raise InputError(
                    f"{self.path} is a cell; to test what it reaches: falsework doctor STRUCTURE --cell CELL"
                )
            return examine_cell(self.path, output)
        return self._examine_parts(output) if self.cell is None else self._examine_reach(self.cell, output)

    def _examine_parts(self, output: Output) -> Exit:
        from falsework.cli.planning import writable

        if self.picture is not None:
            from falsework.viewer.pictures.contact_sheet import check_suffix

            writable(self.picture)
            check_suffix(self.picture, ".png")
        found = self._diagnose(output)
        if self.picture is not None:
            if found.draft is None:
                output.note(f"falsework: no picture: the parts of {self.path} cannot be read")
            else:
                _draw(found, self.picture)
                output.file(self.picture)
                output.say(f"picture: {self.picture}")
        if self.write:
            self._write(found, output)
            return Exit.DONE
        return Exit.DONE if found.loads else Exit.NO

    def _write(self, found: Diagnosis, output: Output) -> None:
        """Write `assembly.json` with what is proposed and given, if the structure loads with it."""
        from falsework.assembly.store import described_by
        from falsework.utils.json_file import write_json

        file = described_by(self.path)
        kept = ("unit", "density", "friction", "boundary", "settle")
        entries = {name: value for name, value in self.given().items() if name in kept} | found.additions
        if file.exists():
            rest = f"add by hand: {found.line()}" if found.additions else "nothing is missing in it"
            raise InputError(f"{file} is there already and stays as it is; {rest}")
        if not (found.cured or found.loads):
            raise InputError(f"{file} is not written: the structure does not load with it yet ({found.error})")
        if not entries:
            raise InputError(f"{file} is not written: {self.path} loads as it is, and no option is given to be kept")
        if len(found.units) > 1 and self.unit is None:
            raise InputError(f"{file} is not written: the unit may be {' or '.join(found.units)}; say which by --unit")
        write_json(file, entries, ())
        output.file(file)
        output.say(f"{file} has now: {json.dumps(entries)[1:-1]}")

    def _diagnose(self, output: Output) -> Diagnosis:
        from falsework.assembly.doctor import doctor

        found = doctor(self.path, stands=stands, **self.given())
        output.record(found.to_dict())
        for line in _lines(found):
            output.say(line)
        return found

    def _examine_reach(self, name: str, output: Output) -> Exit:
        from falsework.assembly.load import load_structure
        from falsework.robots.cells.cell_file import load_cell

        if self.picture is not None:
            from falsework.robots.grasping.reachability import check_picture

            check_picture(self.picture)
        cell = load_cell(name)
        if self.path.exists() and not self._diagnose(output).loads:
            return Exit.NO
        assembly = load_structure(str(self.path), **self.given())
        return report_reach(assembly, cell, self.picture, output)


def stands(assembly: Assembly) -> bool:
    """Return whether a complete structure stands from rest, as `falsework stability` says."""
    from falsework.assembly.state import complete_state
    from falsework.stability.oracle import StabilityOracle

    return bool(StabilityOracle(assembly).verdicts(complete_state(assembly.boundary)[None]).stable[0])


def _lines(found: Diagnosis) -> list[str]:
    """Return the diagnosis as text."""
    volumes = [report.volume for report in found.parts if report.volume is not None]
    lines = []
    if found.parts:
        fixed = sum(report.boundary for report in found.parts)
        sizes = [report.size for report in found.parts]
        text = f"{counted(len(found.parts), 'part')} ({fixed} boundary), {_range(sizes, 'length')} long"
        if volumes:
            text += f", {_range(volumes, 'volume')}, {format_quantity(sum(volumes), 'volume')} in all"
        width, depth, height = (format_quantity(size, "length") for size in found.extent)
        lines += [text, f"all together {width} by {depth} and {height} high", counted(found.contacts, "contact")]
    if found.stored is not None:
        lines.append(f"stored interfaces: {found.stored}")
    lines += list(found.remarks)
    repaired = [report for report in found.parts if report.repairs]
    for title, reports in (("repaired", repaired), ("doubtful", found.doubtful)):
        alike: dict[str, list[str]] = {}
        for report in reports:
            what = report.repairs if title == "repaired" else "; ".join(report.findings)
            alike.setdefault(what, []).append(report.name)
        lines += [f"{title}: {counted(len(reports), 'part')}"] * bool(reports)
        for what, names in list(alike.items())[:_LISTED]:
            several = f"{counted(len(names), 'part')} ({listed(names)}): {what}"
            lines.append(f"  {several if len(names) > 1 else f'part {names[0]} {what}'}")
        if rest := sum(map(len, list(alike.values())[_LISTED:])):
            lines.append(f"  and {counted(rest, 'part')} more")
    lines.append("it loads" if found.loads else f"it does not load: {found.error}")
    if found.additions:
        lines.append(f"add to assembly.json: {found.line()}")
        if not found.cured:
            lines.append("with that it does not load yet: mend the parts above")
        elif not found.loads:
            lines.append("with that it loads")
    return lines


def _range(values: list[float], kind: str) -> str:
    return f"{format_quantity(min(values), kind)} to {format_quantity(max(values), kind)}"


def _draw(found: Diagnosis, path: Path) -> None:
    """Draw all parts, with repaired and doubtful ones in colours."""
    import numpy as np

    from falsework.viewer.palette import BOUNDARY, INSTALLED, unit_rgb
    from falsework.viewer.pictures.contact_sheet import to_pixels
    from falsework.viewer.pictures.picture import Picture, png_of
    from falsework.viewer.pictures.render import Camera, ColoredSolid, render

    assert found.draft is not None
    solids = []
    for report, block in zip(found.parts, found.draft.blocks, strict=True):
        fans = [(face[0], one, two) for face in block.faces for one, two in pairwise(face[1:])]
        if not fans:
            continue
        color = BOUNDARY if report.boundary else INSTALLED
        color = _DOUBTFUL if report.findings else _REPAIRED if report.repairs else color
        vertices, faces = block.vertices * found.draft.scale, np.array(fans)
        # An open part is seen from inside as well.
        both = np.concatenate([faces, faces[:, ::-1]]) if report.volume is None else faces
        solids.append(ColoredSolid(vertices, both, unit_rgb(color)))
    corners = np.concatenate([solid.vertices[np.unique(solid.faces)] for solid in solids])
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    drawn = to_pixels(render(solids, Camera(width=1200, height=900, zoom=0.95), bounds))
    Picture("parts", content=png_of(drawn)).save(path)

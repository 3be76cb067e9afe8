"""`falsework doctor`: contents, repairs and doubtful parts of the files of a structure."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command, LoadOptions
from falsework.cli.exit_code import Exit
from falsework.cli.output import counted

if TYPE_CHECKING:
    from falsework.assembly.doctor import Diagnosis
    from falsework.cli.output import Output

_LISTED = 20
"""Parts that are listed; --json has all."""
_MENDED = "#e69f00"
_DOUBTFUL = "#b2182b"


@dataclass(frozen=True, kw_only=True)
class Doctor(Command, LoadOptions):
    """Report the contents of the files of a structure, repairs, and doubts about each part.

    Works on structures that do not load, too: open, tiny, overlapping, duplicate and isolated parts are listed. Ends
    with the entries to add to assembly.json, and states whether the structure loads with them. Exit code 1 if it does
    not load as it is.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework doctor my-folder",
        "falsework doctor model.3dm --picture model.png",
    )

    path: Annotated[Positional[Path], arg(metavar="PATH")]
    """Folder or file of meshes, COMPAS data, a Rhino or a STEP file."""
    picture: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=UNSET)] = None
    """Draw the parts as PNG: doubtful ones red, repaired ones orange."""

    def run(self, output: Output) -> Exit:
        """Diagnose, draw and report."""
        from falsework.assembly.doctor import diagnose
        from falsework.cli.planning import writable

        if self.picture is not None:
            from falsework.viewer.pictures.contact_sheet import check_suffix

            writable(self.picture)
            check_suffix(self.picture, ".png")
        found = diagnose(self.path, **self.given())
        output.record(found.to_dict())
        for line in _lines(found):
            output.say(line)
        if self.picture is not None:
            if found.draft is None:
                output.note(f"falsework: no picture: the parts of {self.path} cannot be read")
            else:
                _draw(found, self.picture)
                output.say(f"picture: {self.picture}")
        return Exit.DONE if found.loads else Exit.NO


def _lines(found: Diagnosis) -> list[str]:
    """Return the diagnosis as text."""
    volumes = [report.volume for report in found.parts if report.volume is not None]
    lines = []
    if found.parts:
        fixed = sum(report.boundary for report in found.parts)
        sizes = [report.size for report in found.parts]
        text = f"{counted(len(found.parts), 'part')} ({fixed} boundary), {min(sizes):.3g} to {max(sizes):.3g} m long"
        if volumes:
            text += f", {min(volumes):.3g} to {max(volumes):.3g} m3, {sum(volumes):.3g} m3 in all"
        lines += [text, counted(found.contacts, "contact")]
    if found.stored is not None:
        lines.append(f"stored interfaces: {found.stored}")
    lines += list(found.remarks)
    mended = [report for report in found.parts if report.mended]
    for title, listed in (("mended", mended), ("doubtful", found.doubtful)):
        if listed:
            lines.append(f"{title}: {counted(len(listed), 'part')}")
        for report in listed[:_LISTED]:
            lines.append(f"  part {report.name} {report.mended if title == 'mended' else '; '.join(report.doubts)}")
        if len(listed) > _LISTED:
            lines.append(f"  and {len(listed) - _LISTED} more")
    lines.append("it loads" if found.loads else f"it does not load: {found.error}")
    if found.additions:
        lines.append(f"add to assembly.json: {found.line()}")
        lines.append("with that it loads" if found.cured else "with that it does not load yet: mend the parts above")
    return lines


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
        color = _DOUBTFUL if report.doubts else _MENDED if report.mended else color
        vertices, faces = block.vertices * found.draft.scale, np.array(fans)
        # An open part is seen from inside as well.
        both = np.concatenate([faces, faces[:, ::-1]]) if report.volume is None else faces
        solids.append(ColoredSolid(vertices, both, unit_rgb(color)))
    corners = np.concatenate([solid.vertices[np.unique(solid.faces)] for solid in solids])
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    drawn = to_pixels(render(solids, Camera(width=1200, height=900, zoom=0.95), bounds))
    Picture("parts", content=png_of(drawn)).save(path)

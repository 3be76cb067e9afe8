"""`falsework sheet`: assembly instructions for a crew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command, LoadOptions
from falsework.cli.exit_code import Exit
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class MakeSheet(Command):
    """Write a plan as assembly instructions: which part to place, which to hold, which to release.

    The sheet is a PDF to print, with a picture and a box to tick for every step, or CSV, always in assembly order. The
    robots of the plan appear as supports, which may be robots, props or pairs of hands.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework sheet plan.json --out site.csv",
        "falsework sheet plan.json --out site.pdf",
    )

    plan: Annotated[Positional[Path], arg(metavar="PLAN")]
    """Plan, as `falsework plan` wrote it."""
    out: Annotated[Path, arg(metavar="FILE")]
    """File to write; its name ends in .pdf or .csv."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure, instead of the one that the plan names."""
    reading: LoadOptions
    azimuth: float = -58.0
    """Azimuth of the camera, degrees; 0 looks along +y."""
    elevation: float = 24.0
    """Elevation of the camera, degrees."""

    def run(self, output: Output) -> Exit:
        """Load, lay out, write."""
        from falsework.cli.planning import writable
        from falsework.interop.instruction_table import assembly_instructions, instructions_csv, write_sheet
        from falsework.search.plans.plan_file import load_plan
        from falsework.search.plans.plan_source import structure_of_plan

        kind = self.out.suffix.lower()
        if kind not in (".pdf", ".csv"):
            raise InputError(f"cannot tell from {self.out} what to write; let the name end in .pdf or .csv")
        if not -90 < self.elevation < 90 or self.elevation == 0:
            raise InputError(f"an elevation of {self.elevation:g} degrees sees nothing; give one such as 24")
        writable(self.out)
        plan = load_plan(self.plan)
        sheet = assembly_instructions(plan, structure_of_plan(plan, self.plan, self.structure, **self.reading.given()))
        if kind == ".csv":
            content = instructions_csv(sheet).encode(
                "utf-8-sig"
            )  # with the byte order mark by which spreadsheets detect the encoding
        else:
            from dataclasses import replace

            from falsework.interop.instruction_pdf import CAMERA, instructions_pdf

            camera = replace(CAMERA, azimuth=self.azimuth, elevation=self.elevation)
            with output.bar("drawing") as show:
                content = instructions_pdf(
                    sheet, camera=camera, progress=lambda done, total: show(done, total, f"step {done} of {total}")
                )
        write_sheet(self.out, content)
        output.record({"file": str(self.out), "steps": len(sheet.steps), "supports": sheet.supports})
        output.say(f"{self.out}: {len(sheet.steps)} steps with {sheet.supports} supports")
        return Exit.DONE

"""`falsework export`: structures and plans in the formats of other programs, and sheets for a crew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, Command, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.errors import InputError
from falsework.utils.files.formats import EXPORTERS, format_names
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.cli.output import Output

    Format = str
else:
    Format = Literal[format_names(EXPORTERS)]


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a structure, an animated plan, a page, or assembly instructions.

    STRUCTURE may be a plan, too. A folder has one mesh per part and assembly.json. A page (.html) is one file that
    plays a plan or robot plan in any browser, without falsework. glTF (.glb, .gltf) opens in Blender and any viewer,
    USD (.usda) in robot simulators; both show a plan as an animation. COMPAS data (.json) are a list of meshes;
    compas-assembly and compas-dem write block assemblies of the packages of that name. A plan as .pdf is a sheet to
    print, with a picture and a box to tick for every step in assembly order, as .csv a table; its robots appear as
    supports, which may be robots, props or pairs of hands.
    """

    rare: ClassVar[tuple[str, ...]] = ("of", "step_seconds", "azimuth", "elevation")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework export arch:blocks=15 --out my-arch",
        "falsework export shell.glb --unit mm --boundary 0-3 --out my-shell",
        "falsework export plan.json --out plan.html",
        "falsework export plan.json --out plan.glb",
        "falsework export plan.json --out site.pdf",
        "falsework export arch --format compas-dem --out arch.json",
    )

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="PATH")]
    """File to write, or folder, which must be new or empty."""
    format: Annotated[Format | None, arg(help_behavior_hint="(default: by the name of the file, else a folder)")] = None
    """Output format."""
    of: Annotated[str | None, arg(name="structure", metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure of a plan, instead of the one that the plan names."""
    step_seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint=UNSET)] = None
    """Duration of a step of a plan in motion; 1 s if not given."""
    azimuth: Annotated[float | None, arg(metavar="DEG", help_behavior_hint=UNSET)] = None
    """Azimuth of the pictures of a PDF, degrees; 0 looks along +y."""
    elevation: Annotated[float | None, arg(metavar="DEG", help_behavior_hint=UNSET)] = None
    """Elevation of the pictures of a PDF, degrees."""

    def run(self, output: Output) -> Exit:
        """Load and export."""
        from falsework.cli.planning import writable
        from falsework.interop.formats import export, format_of, read_exportable
        from falsework.robots.plans.robot_plan import RobotPlan
        from falsework.search.plans.plan import Plan
        from falsework.utils.files.output_file import check_folder

        chosen = self.format or format_of(self.out)
        if chosen == "folder":
            if self.out.exists() and not (self.out.is_dir() and not any(self.out.iterdir())):
                raise InputError(f"{self.out} exists and is not empty; choose a new folder")
            check_folder(self.out)
        else:
            writable(self.out)
        subject, assembly = read_exportable(self.structure.spec, self.of, **self.structure.given())
        plan = subject.plan if isinstance(subject, RobotPlan) else subject if isinstance(subject, Plan) else None
        if assembly is None and chosen != "html":
            raise InputError(f"{self.structure.spec} is a robot plan; use falsework robots export, or write .html")
        if self.of is not None and plan is None:
            raise InputError(
                f"--structure names the structure of a plan, which {self.structure.spec} is not; leave it out"
            )
        # The cell of a robot plan is looked for beside its file.
        options = self.structure.given() if assembly is None else {}
        with output.count("drawing", "step") as progress:
            export(
                self.structure.spec if assembly is None else subject,
                self.out,
                self.of if assembly is None else assembly,
                format=chosen,
                step_seconds=self.step_seconds,
                azimuth=self.azimuth,
                elevation=self.elevation,
                progress=progress,
                **options,
            )
        made = plan or assembly
        assert made is not None
        parts = len(made.boundary)
        output.file(self.out)
        output.record({"parts": parts, "identity": made.identity, "kind": chosen})
        output.record({"steps": None if plan is None else len(plan)})
        what = counted(parts, "part") if plan is None else counted(len(plan), "step")
        output.say(f"{what} of {made.name} are in {self.out}")
        return Exit.DONE

"""`falsework export`: structures and plans in the formats of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, Command, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output

Format = Literal["folder", "glb", "gltf", "usd", "html", "compas", "compas-assembly", "compas-dem"]


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a structure or an animated plan in the format of another program, or as a page.

    STRUCTURE may be a plan, too. A folder has one mesh per part and assembly.json. A page (.html) is one file that
    plays a plan or robot plan in any browser, without falsework. glTF (.glb, .gltf) opens in Blender and any viewer,
    USD (.usda) in robot simulators; both show a plan as an animation. COMPAS data (.json) are a list of meshes;
    compas-assembly and compas-dem write block assemblies of the packages of that name.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework export arch:blocks=15 --out my-arch",
        "falsework export shell.glb --unit mm --boundary 0-3 --out my-shell",
        "falsework export plan.json --out plan.html",
        "falsework export plan.json --out plan.glb",
        "falsework export arch --format compas-dem --out arch.json",
    )

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="PATH")]
    """File to write, or folder, which must be new or empty."""
    format: Annotated[Format | None, arg(help_behavior_hint="(default: by the name of the file, else a folder)")] = None
    """Output format."""
    step_seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint=UNSET)] = None
    """Duration of a step of a plan; 1 s if not given."""

    def run(self, output: Output) -> Exit:
        """Load and export."""
        from falsework.cli.planning import writable
        from falsework.interop.formats import export, format_of, read_exportable
        from falsework.robots.plans.robot_plan import RobotPlan
        from falsework.search.plans.plan import Plan

        chosen = self.format or format_of(self.out)
        if chosen == "folder":
            if self.out.exists() and not (self.out.is_dir() and not any(self.out.iterdir())):
                raise InputError(f"{self.out} exists and is not empty; choose a new folder")
        else:
            writable(self.out)
        subject, assembly = read_exportable(self.structure.spec, **self.structure.given())
        plan = subject.plan if isinstance(subject, RobotPlan) else subject if isinstance(subject, Plan) else None
        if assembly is not None:
            export(subject, self.out, assembly, format=chosen, step_seconds=self.step_seconds)
        elif chosen == "html":  # the cell is looked for beside the file
            options = self.structure.given()
            export(self.structure.spec, self.out, format=chosen, step_seconds=self.step_seconds, **options)
        else:
            raise InputError(f"{self.structure.spec} is a robot plan; export it by falsework robots export")
        made = plan or assembly
        assert made is not None
        parts = len(made.boundary)
        record = {"parts": parts, "identity": made.identity, "format": chosen}
        place = "folder" if chosen == "folder" else "file"
        output.record({place: str(self.out), **record, "steps": None if plan is None else len(plan)})
        what = f"{parts} parts" if plan is None else f"{len(plan)} steps"
        output.say(f"{what} of {made.name} are in {self.out}")
        return Exit.DONE

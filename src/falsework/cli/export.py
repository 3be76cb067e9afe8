"""`falsework export`: a structure or a plan in the files of other programs."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.command import UNSET, Command, Exit, StructureOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.search.plans.plan import Plan

Format = Literal["folder", "glb", "gltf", "usd", "compas", "compas-assembly", "compas-dem"]

_BY_SUFFIX: dict[str, Format] = {
    ".glb": "glb",
    ".gltf": "gltf",
    ".usd": "usd",
    ".usda": "usd",
    ".json": "compas",
}
_MOVING = ("glb", "gltf", "usd")
"""Formats that can show a plan."""


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a structure, or a plan in motion, for other programs.

    STRUCTURE may be a plan, too. A folder has one mesh a part and assembly.json. glTF (.glb, .gltf) opens in Blender
    and any viewer, USD (.usda) in robot simulators; both show a plan as an animation. COMPAS data (.json) are a list of
    meshes; compas-assembly and compas-dem write block assemblies of the packages of that name.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework export arch:blocks=15 --out my-arch",
        "falsework export shell.glb --unit mm --boundary 0-3 --out my-shell",
        "falsework export plan.json --out plan.glb",
        "falsework export arch --format compas-dem --out arch.json",
    )

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="PATH")]
    """File to write, or folder, which must be new or empty."""
    format: Annotated[Format | None, arg(help_behavior_hint="(default: by the name of the file, else a folder)")] = None
    """What to write."""
    step_seconds: Annotated[float | None, arg(metavar="S", help_behavior_hint=UNSET)] = None
    """Length of a step of a plan; a second if not given."""

    def run(self, output: Output) -> Exit:
        """Load and save."""
        from falsework.cli.planning import writable

        chosen = self.format or _BY_SUFFIX.get(self.out.suffix.lower(), "folder")
        if chosen == "folder":
            if self.out.exists() and not (self.out.is_dir() and not any(self.out.iterdir())):
                raise InputError(f"{self.out} is there and not empty; choose a new folder")
        else:
            writable(self.out)
        assembly, plan = self._load()
        if plan is not None and chosen not in _MOVING:
            raise InputError(f"{chosen} cannot show a plan; write {', '.join(_MOVING)}, or name the structure instead")
        if plan is None and self.step_seconds is not None:
            raise InputError("--step-seconds is for plans; leave it out")
        _write(self.out, chosen, assembly, plan, 1.0 if self.step_seconds is None else self.step_seconds)
        record = {"parts": assembly.part_count, "identity": assembly.identity, "format": chosen}
        place = "folder" if chosen == "folder" else "file"
        output.record({place: str(self.out), **record, "steps": None if plan is None else len(plan)})
        what = f"{assembly.part_count} parts" if plan is None else f"{len(plan)} steps"
        output.say(f"{what} of {assembly.name} are in {self.out}")
        return Exit.DONE

    def _load(self) -> tuple[Assembly, Plan | None]:
        """The structure, and the plan if one was named."""
        from falsework.cli.loading import structure_of
        from falsework.search.plans.plan_file import load_plan

        path = Path(self.structure.spec)
        if not _is_plan(path):
            return self.structure.load(), None
        plan = load_plan(path)
        return structure_of(plan, path, **self.structure.given()), plan


def _is_plan(path: Path) -> bool:
    """Whether a file says that it is a plan, of whatever version."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        return False
    return isinstance(data, dict) and str(data.get("format", "")).startswith("falsework.plan/")


def _write(path: Path, form: Format, assembly: Assembly, plan: Plan | None, step_seconds: float) -> None:
    if form == "folder":
        from falsework.assembly.store import save_assembly

        save_assembly(assembly, path)
    elif form == "usd":
        from falsework.interop.usd import write_usd

        write_usd(path, assembly, plan, step_seconds=step_seconds)
    elif form in ("glb", "gltf"):
        from falsework.interop.gltf import write_gltf

        write_gltf(path, assembly, plan, kind=form, step_seconds=step_seconds)
    else:
        from falsework.interop.compas_write import CompasKind, write_compas

        kinds: dict[str, CompasKind] = {"compas": "meshes", "compas-assembly": "assembly", "compas-dem": "dem"}
        write_compas(path, assembly, kinds[form])

"""`falsework export`: a structure as a folder of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import arg

from falsework.cli.command import Command, Exit, StructureOptions
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a structure as a folder with one mesh a part and assembly.json.

    Turns a built-in structure into files to start from, or a single file in millimetres into a folder in metres.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework export arch:blocks=15 --out my-arch",
        "falsework export shell.glb --unit mm --boundary 0-3 --out my-shell",
    )

    structure: StructureOptions
    out: Annotated[Path, arg(metavar="FOLDER")]
    """Folder to write; it must be new or empty."""

    def run(self, output: Output) -> Exit:
        """Load and save."""
        from falsework.assembly.store import save_assembly

        if self.out.exists() and not (self.out.is_dir() and not any(self.out.iterdir())):
            raise InputError(f"{self.out} is there and not empty; choose a new folder")
        assembly = self.structure.load()
        save_assembly(assembly, self.out)
        output.record({"folder": str(self.out), "parts": assembly.part_count, "identity": assembly.identity})
        output.say(f"{assembly.part_count} parts of {assembly.name} are in {self.out}")
        return Exit.DONE

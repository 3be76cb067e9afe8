"""`falsework cell new`: first draft of a cell file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command, LoadOptions
from falsework.cli.exit_code import Exit
from falsework.errors import CellError, InputError
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.cli.output import Output
    from falsework.robots.cells.new_cell import Arm


@dataclass(frozen=True, kw_only=True)
class NewCell(Command):
    """Write a cell file with some arms, to be edited.

    Arms are URDF files, or built in: crb15000-5/0.95, irb2600-12/1.65, ur10e. They stand around the structure and face
    it, with homes that are free of collisions and places that they reach; the gripper is a template. `falsework view`
    shows the file while it is edited. Exit code 1 if the cell is not valid yet.
    """

    outcomes: ClassVar[tuple[str, str]] = ("done", "does_not_load")
    examples: ClassVar[tuple[str, ...]] = (
        "falsework cell new ur10e,ur10e --out cell.toml",
        "falsework cell new left=panda.urdf,right=panda.urdf --gripper jaw --structure my-folder --out cell.toml",
    )

    arms: Annotated[Positional[str], arg(metavar="ARMS")]
    """Built-in arms and URDF files, separated by commas, each with a name if wanted: left=ur10e,right=arm.urdf."""
    out: Annotated[Path, arg(metavar="FILE")]
    """File to write; it must not exist."""
    gripper: Literal["suction", "jaw"] = "suction"
    """Kind of the gripper."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure that the arms are clear of at home."""
    reading: LoadOptions

    def run(self, output: Output) -> Exit:
        """Propose and write."""
        from falsework.assembly.load import load_structure
        from falsework.robots.cells.cell_file import load_faulty_cell
        from falsework.robots.cells.new_cell import new_cell
        from falsework.robots.cells.validate import check_cell
        from falsework.robots.model.part_shapes import place_parts
        from falsework.utils.files.output_file import check_writable, write_whole

        if self.out.suffix.lower() != ".toml":
            raise InputError(f"--out {self.out}: a cell is a TOML file; give a name that ends in .toml")
        if self.out.exists():
            raise InputError(f"--out {self.out} exists; choose another name, so that nothing is lost")
        check_writable(self.out)
        assembly = None if self.structure is None else load_structure(self.structure, **self.reading.given())
        arms = parse_arms(self.arms)
        text = new_cell(arms, self.out.parent, gripper=self.gripper, assembly=assembly)
        write_whole(self.out, lambda file: file.write(text.encode()))
        cell, faults = load_faulty_cell(self.out)
        if cell is not None and assembly is not None and not faults:
            try:
                check_cell(cell, place_parts(assembly, cell.placement))
            except CellError as error:
                faults = [str(error)]
        output.file(self.out)
        output.record({"robots": [arm.name for arm in arms], "faults": faults})
        output.say(f"{self.out}: {counted(len(arms), 'robot')}; falsework view {self.out} shows it while you edit it")
        for fault in faults:
            output.note(f"falsework: {fault}")
        return Exit.NO if faults else Exit.DONE


def parse_arms(text: str) -> list[Arm]:
    """Read arms such as `left=ur10e,right=arm.urdf`; those without a name are called left and right, or by number."""
    from falsework.robots.cells.new_cell import Arm

    entries = [piece.strip() for piece in text.split(",")]
    names = ("left", "right") if len(entries) == 2 else tuple(f"arm {k + 1}" for k in range(len(entries)))
    found = []
    for piece, standard in zip(entries, names, strict=True):
        name, sign, model = piece.partition("=")
        name, model = (name.strip(), model.strip()) if sign else (standard, piece)
        if not name or not model:
            raise InputError(
                f"ARMS: {piece!r} names no arm; give arms such as ur10e,ur10e or left=ur10e,right=arm.urdf"
            )
        if name in [arm.name for arm in found]:
            raise InputError(f"ARMS: two arms are called {name!r}; give every arm its own name")
        found.append(Arm(name, model))
    return found

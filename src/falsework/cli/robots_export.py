"""`falsework robots export`: motions of a robot plan for controllers and other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command
from falsework.cli.exit_code import Exit
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class ExportRobots(Command):
    """Write the motions of a robot plan for robot controllers.

    ROS 2 joint trajectories as JSON or YAML and tables as CSV, each one file per step and one for the plan, with one
    motion after the other; goals of ROS 2 actions for each arm, which wait for each other; ABB RAPID and URScript as
    one program per robot, which wait for each other, with the tool loads and signals of the cell; an MCAP bag of ROS 2
    messages with the times of the schedule, and with the shapes of the parts if the structure is found. The robots must
    be those of the cell, and the motions within its limits; `falsework robots check` checks everything else.
    """

    rare: ClassVar[tuple[str, ...]] = ("rate", "joint_prefix")
    examples: ClassVar[tuple[str, ...]] = (
        "falsework robots export robot_plan.json --format ros2-goals --out motions",
        "falsework robots export robot_plan.json --format rapid --out rapid",
    )

    plan: Annotated[Positional[Path], arg(metavar="ROBOT_PLAN")]
    """Plan to export, as `falsework robots plan` wrote it."""
    format: Literal["ros2-json", "ros2-yaml", "ros2-goals", "csv", "rapid", "urscript", "mcap"] = "ros2-json"
    """Output format."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """Folder to write into."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure whose shapes a bag has, and whose parts robots carry and press, instead of the one that the plan
    names."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell that the programs are for, instead of the one that the plan names."""
    rate: float = 50.0
    """Rows per second, for csv and urscript."""
    joint_prefix: Annotated[str, arg(metavar="TEXT", help_behavior_hint=UNSET)] = ""
    """Prefix of the names of joints in ros2-json, ros2-yaml and ros2-goals; {robot} in it is the name of the robot."""
    force: bool = False
    """Write RAPID for arms of other makers than ABB, and URScript for others than Universal Robots."""

    def run(self, output: Output) -> Exit:
        """Load and write."""
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.exports.export import export_notes, export_plan, structure_for_export
        from falsework.robots.plans.robot_plan_file import load_robot_plan
        from falsework.utils.files.output_file import check_folder

        check_folder(self.out)
        plan = load_robot_plan(self.plan)
        cell = load_cell(self.cell or plan.cell_place(self.plan))
        shapes, lacking = structure_for_export(plan, self.format, self.plan, self.structure)
        output.replaced = self.out if self.out.is_dir() and any(self.out.iterdir()) else None
        options = {name: getattr(self, name) for name in ("rate", "joint_prefix", "force")}
        paths = export_plan(plan, self.out, self.format, structure=shapes, cell=cell, **options)
        notes = lacking + export_notes(plan, self.format, cell)
        for path in paths:
            output.file(path)
        output.say(f"{counted(len(paths), 'file')} in {self.out}")
        for note in notes:
            output.note(f"falsework: {note}")
        return Exit.DONE

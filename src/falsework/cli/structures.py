"""`falsework structures`: built-in structures and their parameters."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, ClassVar

from falsework.cli.command import Command
from falsework.cli.exit_code import Exit

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class Structures(Command):
    """List the built-in structures with their parameters and defaults."""

    examples: ClassVar[tuple[str, ...]] = ("falsework structures",)

    def run(self, output: Output) -> Exit:
        """Print one row per structure."""
        from rich.table import Table

        from falsework.assembly.library import structures

        table = Table("name and parameters", "what it is", box=None, pad_edge=False, header_style="bold")
        for entry in structures():
            parameters = [{**asdict(detail), "kind": detail.kind.__name__} for detail in entry.details]
            output.record({"name": entry.name, "description": entry.description, "parameters": parameters})
            table.add_row(entry.name, entry.description)
            for detail in entry.details:
                about = f"{detail.meaning}, {detail.minimum:g} to {detail.maximum:g} {detail.unit}".rstrip()
                table.add_row(f"  {detail.name}={detail.default:g}", f"  {about}", style="dim")
        output.say(table)
        return Exit.DONE

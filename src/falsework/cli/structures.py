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
        from falsework.assembly.library import structures
        from falsework.utils.quantity import format_number

        rows: list[tuple[str, str]] = []
        for entry in structures():
            parameters = [{**asdict(detail), "kind": detail.kind.__name__} for detail in entry.details]
            output.row("structures", {"name": entry.name, "description": entry.description, "parameters": parameters})
            rows.append((entry.name, entry.description))
            for detail in entry.details:
                low, high, default = (
                    format_number(value, 10) for value in (detail.minimum, detail.maximum, detail.default)
                )
                rows.append(
                    (f"  {detail.name}={default}", f"  {detail.meaning}, {low} to {high} {detail.unit}".rstrip())
                )
        output.table(("name and parameters", "what it is"), rows, dim="  ")
        return Exit.DONE

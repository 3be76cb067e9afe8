"""What all subcommands share: their base, exit codes, and the options that name a structure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from falsework.cli.arguments import parse_parts

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output

UNSET = ""
"""Shown in place of a default where leaving an option out is the default."""


class Exit(IntEnum):
    """Exit codes; scripts rely on them."""

    DONE = 0
    NO = 1
    """The question was understood and the answer is no."""
    WRONG_INPUT = 2
    INTERRUPTED = 130
    """As shells report it: 128 plus the number of SIGINT."""


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """Base of all subcommands; its fields are options of each."""

    examples: ClassVar[tuple[str, ...]] = ()
    """Command lines for the end of the help text."""

    json: bool = False
    """Print JSON for machines, one object a line; everything for people goes to the error stream."""
    debug: bool = False
    """Show the traceback of an error."""

    @abstractmethod
    def run(self, output: Output) -> Exit:
        """Do the work and return the exit code."""


@dataclass(frozen=True, kw_only=True)
class StructureOptions:
    """Options that say which structure is meant; they replace what its files say."""

    spec: Annotated[Positional[str], arg(metavar="STRUCTURE")]
    """Built-in such as `vault` or `arch:blocks=15,thickness=0.2`, or a folder or file of meshes."""
    unit: Annotated[str | None, arg(metavar="UNIT", help_behavior_hint=UNSET)] = None
    """Unit of the meshes, such as mm."""
    density: Annotated[float | None, arg(metavar="KG/M3", help_behavior_hint=UNSET)] = None
    """Density of every part."""
    friction: Annotated[float | None, arg(metavar="MU", help_behavior_hint=UNSET)] = None
    """Coefficient of friction of every contact."""
    boundary: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that are fixed for ever, such as 0,3 or 0-16."""
    ground: bool = False
    """Put a fixed ground under the lowest point."""

    def load(self) -> Assembly:
        """Build or read the structure.

        Raises:
            InputError: no such structure, or it cannot be used; the message says what to do.
        """
        from falsework.assembly import load_structure

        boundary = None if self.boundary is None else parse_parts(self.boundary, "--boundary")
        return load_structure(
            self.spec,
            unit=self.unit,
            density=self.density,
            friction=self.friction,
            boundary=boundary,
            ground=self.ground,
        )

"""Options that select the subject of a picture, a video or the viewer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, LoadOptions

if TYPE_CHECKING:
    from falsework.viewer.viewable import Viewable


@dataclass(frozen=True, kw_only=True)
class ViewableOptions(LoadOptions):
    """Options that name the file or structure to show."""

    rare: ClassVar[tuple[str, ...]] = ("structure", "cell")

    spec: Annotated[Positional[str], arg(metavar="WHAT")]
    """Plan, run, robot plan, state graph, a cell, or a structure: built-in, folder or file of meshes."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure of the plan or graph, where the file does not name it or it has moved; structure in a cell."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell of a robot plan, where the file does not name it or it has moved."""
    order: Literal["assembly", "disassembly"] = "assembly"
    """Order in which the steps of a plan are shown."""

    def open(self, robots: int = 2) -> Viewable:
        """Detect the kind of the file or structure and read it.

        Args:
            robots: number of robots, if no plan gives it.
        """
        from falsework.search.problem.task import Direction
        from falsework.viewer.viewable import open_file

        direction = Direction(self.order)
        return open_file(self.spec, self.structure, cell=self.cell, direction=direction, robots=robots, **self.given())

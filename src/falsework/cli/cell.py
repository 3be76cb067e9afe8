"""`falsework cell check`: reachability of parts by the robots of a cell, and proposals for better bases."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command, StructureOptions
from falsework.cli.exit_code import Exit

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.robots.grasping.reachability import BaseProposal, ReachTable
    from falsework.robots.model.cell import Cell
    from falsework.robots.model.part_shapes import PartShapes


@dataclass(frozen=True, kw_only=True)
class CheckCell(Command):
    """Report which robot of a cell can hold which part of a structure, and propose better bases.

    Every part is tested alone on the boundary, with the other robots at home. Exit code 1 if a part is out of reach of
    all robots.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework cell check cell.toml my-folder --picture reach.png",
        "falsework cell check dome-37 my-folder --json",
    )

    cell: Annotated[Positional[str], arg(metavar="CELL")]
    """TOML file, or a built-in cell such as `dome-37`."""
    structure: StructureOptions
    picture: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=UNSET)] = None
    """Plan view of parts and robots, coloured by the number of robots that reach a part."""
    propose: Literal["auto", "always", "never"] = "auto"
    """Search for better bases; auto: if a robot cannot reach a part."""

    def run(self, output: Output) -> Exit:
        """Load, test and print."""
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.cells.validate import check_cell
        from falsework.robots.grasping.reachability import Reachability, propose_bases, reach_table
        from falsework.robots.model.part_shapes import place_parts

        if self.picture is not None:
            from falsework.robots.grasping.reachability_plot import check_picture

            check_picture(self.picture)
        cell = load_cell(self.cell)
        assembly = self.structure.load()
        parts = place_parts(assembly, cell.placement)
        check_cell(cell, parts)
        with output.bar("reaching") as show:
            table = reach_table(assembly, cell, parts, lambda done, total: show(done, total, f"part {done} of {total}"))
        proposal = None
        if self.propose == "always" or (self.propose == "auto" and (table.levels == Reachability.OUT_OF_REACH).any()):
            with output.bar("looking for bases") as show:
                proposal = propose_bases(
                    assembly, cell, parts, lambda done, total: show(done, total, f"place {done} of {total}")
                )
        self._say(output, assembly, cell, parts, table)
        self._propose(output, proposal)
        if self.picture is not None:
            from falsework.robots.grasping.reachability_plot import draw_reach

            draw_reach(cell, parts, table, self.picture)
            output.note(f"picture written to {self.picture}")
        missing = [assembly.names[part] for part in table.unreached]
        if missing:
            output.note(f"falsework: no robot reaches {len(missing)} parts: {', '.join(missing[:12])}")
        return Exit.NO if missing else Exit.DONE

    def _say(self, output: Output, assembly: Assembly, cell: Cell, parts: PartShapes, table: ReachTable) -> None:
        """Print one row per part."""
        from falsework.robots.cells.home import missing_homes
        from falsework.robots.grasping.reachability import Reachability

        shown: list[tuple[str, ...]] = []
        for row, part in enumerate(table.parts.tolist()):
            levels = [Reachability(int(level)) for level in table.levels[row]]
            record: dict[str, Any] = {
                "part": part,
                "name": assembly.names[part],
                "mass": round(float(parts.mass[part]), 4),
                "reach": {name: level.name.lower() for name, level in zip(table.robots, levels, strict=True)},
            }
            near = [(k, table.pairs[part, k]) for k in range(len(levels)) if (part, k) in table.pairs]
            pairs = {table.robots[k]: list(pair) for k, pair in near}
            output.record({**record, "too_near": pairs})
            words = [
                f"{level.words} ({' and '.join(pairs[name])})" if name in pairs else level.words
                for name, level in zip(table.robots, levels, strict=True)
            ]
            shown.append((assembly.names[part], f"{parts.mass[part]:.2f}", *words))
        output.table(("part", "kg", *table.robots), shown)
        reached = (table.levels == Reachability.REACHED).sum(axis=0)
        counts = ", ".join(f"{name} {count}" for name, count in zip(table.robots, reached, strict=True))
        output.say(f"{cell.name}: of {len(table.parts)} parts within reach: {counts}")
        for text in missing_homes(cell, parts):
            output.say(text)
        if boundless := sorted({robot.gripper.name for robot in cell.robots if not robot.gripper.has_limits}):
            names = ", ".join(boundless)
            output.say(
                f"grippers without force and moment bear fifty weights of the heaviest part in planning: {names}"
            )

    def _propose(self, output: Output, proposal: BaseProposal | None) -> None:
        """Propose better robot bases."""
        import numpy as np

        if proposal is None:
            return
        better = proposal.after > proposal.before
        bases = {
            robot.name: {
                "position": (np.round(robot.base[:3, 3], 3) + 0.0).tolist(),
                "yaw": round(float(np.degrees(np.arctan2(robot.base[1, 0], robot.base[0, 0]))), 1),
            }
            for robot in proposal.cell.robots
        }
        output.record({"proposal": bases if better else None, "before": proposal.before, "after": proposal.after})
        if not better:
            output.say(f"no better bases found: {proposal.before} of {proposal.pairs} pairs of robot and part in reach")
            return
        counts = f"{proposal.after} of {proposal.pairs} pairs of robot and part"
        output.say(f"better bases, with {counts} within reach instead of {proposal.before}:")
        for name, base in bases.items():
            output.say(f"  {name}: base = {{ position = {base['position']}, yaw = {base['yaw']} }}")

"""Part of `falsework doctor`: reachability of parts by the robots of a cell, and proposals for better bases."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.cli.exit_code import Exit
from falsework.errors import CellError
from falsework.utils.quantity import counted, format_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.robots.grasping.reachability import BaseProposal, ReachTable
    from falsework.robots.model.cell import Cell
    from falsework.robots.model.part_shapes import PartShapes


def examine_cell(path: Path, output: Output) -> Exit:
    """Report whether a cell can be used by itself: its file, bases, home configurations and tools."""
    from falsework.robots.cells.cell_file import load_cell

    try:
        cell = load_cell(path)
    except CellError as error:
        output.record({"loads": False, "error": str(error)})
        output.note(f"falsework: {error}")
        return Exit.NO
    names = [robot.name for robot in cell.robots]
    output.record({"loads": True, "error": None, "robots": names})
    output.say(f"{cell.name}: {counted(len(names), 'robot')} ({', '.join(names)}); bases, homes and tools are clear")
    return Exit.DONE


def report_reach(assembly: Assembly, cell: Cell, picture: Path | None, output: Output) -> Exit:
    """Report which robot can hold which part, each alone on the boundary, and better bases where one cannot.

    Returns:
        `Exit.NO` if a part is out of reach of all robots.
    """
    from falsework.robots.cells.validate import check_cell
    from falsework.robots.grasping.reachability import Reachability, propose_bases, reach_table
    from falsework.robots.model.cell_holds import CellScale
    from falsework.robots.model.part_shapes import place_parts

    parts = place_parts(assembly, cell.placement)
    check_cell(cell, parts)
    CellScale.from_cell(assembly, cell)  # which refuses a cell in which other states are stable
    with output.count("reaching", "part") as progress:
        table = reach_table(assembly, cell, parts, progress)
    proposal = None
    if (table.levels == Reachability.OUT_OF_REACH).any():
        with output.count("looking for bases", "place") as progress:
            proposal = propose_bases(assembly, cell, parts, progress)
    _say(output, assembly, cell, parts, table)
    _propose(output, proposal)
    if picture is not None:
        from falsework.robots.grasping.reachability import draw_reach

        draw_reach(cell, parts, table, picture)
        output.file(picture)
        output.say(f"picture: {picture}")
    missing = [assembly.names[part] for part in table.unreached]
    if not missing:
        return Exit.DONE
    output.note(f"falsework: no robot reaches {counted(len(missing), 'part')}: {', '.join(missing[:12])}")
    return output.outcome("out_of_reach")


def _say(output: Output, assembly: Assembly, cell: Cell, parts: PartShapes, table: ReachTable) -> None:
    """Print one row per part."""
    from falsework.robots.cells.validate import missing_homes
    from falsework.robots.grasping.reachability import Reachability
    from falsework.robots.model.cell_holds import boundless

    shown: list[tuple[str, ...]] = []
    for row, part in enumerate(table.parts.tolist()):
        levels = [Reachability(int(level)) for level in table.levels[row]]
        near = [(k, table.pairs[part, k]) for k in range(len(levels)) if (part, k) in table.pairs]
        pairs = {table.robots[k]: list(pair) for k, pair in near}
        mass = float(parts.mass[part])
        record: dict[str, Any] = {"part": part, "name": assembly.names[part], "mass_kg": round(mass, 4)}
        record["reach"] = {name: level.name.lower() for name, level in zip(table.robots, levels, strict=True)}
        output.row("reach", {**record, "too_near": pairs})
        words = [
            f"{level.words} ({' and '.join(pairs[name])})" if name in pairs else level.words
            for name, level in zip(table.robots, levels, strict=True)
        ]
        shown.append((assembly.names[part], format_quantity(mass, "mass"), *words))
    output.table(("part", "mass", *table.robots), shown)
    reached = (table.levels == Reachability.REACHED).sum(axis=0)
    counts = ", ".join(f"{name} {count}" for name, count in zip(table.robots, reached, strict=True))
    output.say(f"{cell.name}: of {counted(len(table.parts), 'part')} within reach: {counts}")
    for text in missing_homes(cell, parts):
        output.say(text)
    if text := boundless(cell):
        output.say(text)


def _propose(output: Output, proposal: BaseProposal | None) -> None:
    """Propose better robot bases."""
    import numpy as np

    if proposal is None:
        return
    better = proposal.after > proposal.before
    bases = {
        robot.name: {
            "position_m": (np.round(robot.base[:3, 3], 3) + 0.0).tolist(),
            "yaw_deg": round(float(np.degrees(np.arctan2(robot.base[1, 0], robot.base[0, 0]))), 1),
        }
        for robot in proposal.cell.robots
        if robot.is_upright  # others stay where they are
    }
    counts = {"bases": bases if better else None, "before": proposal.before, "after": proposal.after}
    output.record({"proposal": {**counts, "pairs": proposal.pairs}})
    if not better:
        output.say(f"no better bases found: {proposal.before} of {proposal.pairs} pairs of robot and part in reach")
        return
    reached = f"{proposal.after} of {proposal.pairs} pairs of robot and part"
    output.say(f"better bases, with {reached} within reach instead of {proposal.before}:")
    for name, base in bases.items():
        output.say(f"  {name}: base = {{ position = {base['position_m']}, yaw = {base['yaw_deg']} }}")

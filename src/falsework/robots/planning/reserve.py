"""Reserve of robot plans: the one that is asked for, or none where no order of the parts keeps it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from falsework.assembly.model import Assembly
from falsework.robots.model.cell import Cell
from falsework.robots.model.cell_holds import stability_in
from falsework.robots.planning.hybrid_result import HybridResult, HybridSettings
from falsework.search.problem.deadline import Deadline
from falsework.stability.oracle import Stability
from falsework.stability.settings import StabilitySettings


def keeping_reserve(
    search: Callable[[Stability, HybridSettings], HybridResult],
    assembly: Assembly,
    cell: Cell,
    stability: StabilitySettings,
    settings: HybridSettings,
) -> HybridResult:
    """Return the result of a search with the reserve, or where it finds no order of the parts, of one without.

    Args:
        search: finds a plan with an oracle, within limits.
        assembly: the structure.
        cell: the robots, whose limits hold.
        stability: criterion, reserve and holds, as in the cell.
        settings: limits of both searches together.

    Raises:
        CellError: a gripper bears less than the weight of a part.
    """
    clock = Deadline(settings.deadline)
    result = search(Stability(assembly, stability_in(cell, assembly, stability)), settings)
    if not result.no_order or stability.reserve <= 1.0 or clock.passed:
        return result
    plain = stability_in(cell, assembly, replace(stability, reserve=1.0))
    return search(Stability(assembly, plain), replace(settings, deadline=clock.left if clock.limited else None))

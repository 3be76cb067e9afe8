"""Robot plan that was interrupted, from which `falsework robots plan --from` goes on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.errors import InputError
from falsework.utils.quantity import format_quantity, parse_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.robots.model.cell import Cell
    from falsework.robots.plans.robot_plan import RobotPlan
    from falsework.robots.plans.timeline import Interruption


@dataclass(frozen=True, eq=False)
class InterruptedPlan:
    """Robot plan, its structure and cell, and where it was interrupted."""

    plan: RobotPlan
    file: Path
    assembly: Assembly
    cell: Cell
    now: Interruption

    @classmethod
    def from_options(
        cls, file: Path, at: str | None, order: str, structure: str | None, cell: str | None, **options: Any
    ) -> InterruptedPlan:
        """Read the plan, and find out where it stands.

        Args:
            at: time of the interruption, such as `7.2s`.
            options: as for `load_structure`.

        Raises:
            InputError: no such plan, a time that it does not have, another order, structure or cell.
        """
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.plans.robot_plan_file import load_robot_plan
        from falsework.robots.plans.timeline import interruption
        from falsework.search.plans.plan_source import structure_of_plan

        if at is None:
            raise InputError(f"--from {file}: name the time of the interruption by --at, such as --at 7.2s")
        seconds = parse_quantity(at, "duration", "--at")
        plan = load_robot_plan(file)
        if seconds >= plan.makespan:
            raise InputError(
                f"--at {at}: {file} ends after {format_quantity(plan.makespan, 'duration')}; give an earlier time"
            )
        if plan.direction != order:
            raise InputError(f"--order {order}: {file} is a plan of {plan.direction}; go on in that order")
        assembly = structure_of_plan(plan.plan, file, structure, **options)
        place = load_cell(cell or plan.cell_place(file))
        plan.check_identity(assembly, place)
        return cls(plan, file, assembly, place, interruption(plan, seconds))

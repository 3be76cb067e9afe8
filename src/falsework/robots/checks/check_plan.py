"""Independent check of a plan, with motions or without."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import overload

from falsework.assembly.groups import groups_of
from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.robots.cells.cell_file import AnyCell
from falsework.robots.checks.check import CheckReport, check_robot_plan
from falsework.robots.plans.loose_plan import loose_plan
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.margins.demands import Demands
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_report import PlanReport
from falsework.stability.settings import StabilitySettings


@overload
def check(
    assembly: AnyStructure,
    plan: Plan,
    cell: None = None,
    *,
    stability: StabilitySettings = ...,
    demands: Demands | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PlanReport: ...
@overload
def check(
    assembly: AnyStructure,
    plan: RobotPlan,
    cell: AnyCell,
    *,
    stability: StabilitySettings = ...,
    demands: Demands | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CheckReport: ...
def check(
    assembly: AnyStructure,
    plan: Plan | RobotPlan,
    cell: AnyCell | None = None,
    *,
    stability: StabilitySettings = StabilitySettings(),
    demands: Demands | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PlanReport | CheckReport:
    """Check a plan by code that shares nothing with the planners: its rules, its states and, with a cell, its motions.

    States are checked as `validate_plan` does, motions and the schedule as `check_robot_plan` does. The plan gives no
    fact about the structure or the cell: both are those of the caller.

    Args:
        assembly: the structure, or its name or path.
        plan: a plan or a robot plan.
        cell: cell of a robot plan, or its name or file.
        stability: criterion that the states must satisfy.
        demands: margins that every state must keep; those that the plan was made to keep if not given.
        progress: called with the number of states, or of steps with motions, that are checked, and of all.

    Returns:
        A report that is `good` or says what is wrong; that of a robot plan has the one of its states in `states`.

    Raises:
        PlanError: the plan is for another structure or cell.
        InputError: neither plan, or a robot plan without a cell or a plan with one.
        DependencyError: motions are to be checked, and Pinocchio or Coal is missing.
    """
    if isinstance(plan, RobotPlan):
        if cell is None:
            raise InputError("a robot plan is checked in a cell; give its name, its file or a Cell")
        structure = as_assembly(assembly)
        motions = check_robot_plan(plan, structure, cell, progress=progress)
        return replace(motions, states=check_states(plan, structure, stability, demands))
    if not isinstance(plan, Plan):
        raise InputError(
            f"{type(plan).__name__} is no plan; give the structure first, then a plan, such as the value of a result"
        )
    if cell is not None:
        raise InputError("a plan without motions needs no cell; leave it out")
    return validate_plan(plan, assembly, stability, demands=demands, progress=progress)


def check_states(
    plan: RobotPlan, assembly: Assembly, stability: StabilitySettings, demands: Demands | None
) -> PlanReport:
    """Check the stability of the states of a robot plan; joined parts have to stand loose, too.

    Args:
        stability: criterion that the states must satisfy.
        demands: margins that every state must keep; those that the plan was made to keep if not given.
    """
    states = validate_plan(plan.plan, assembly, stability, demands=demands)
    groups = groups_of(assembly)
    if groups is None or not states.good:
        return states
    return validate_plan(loose_plan(plan.plan, groups), groups.loose, stability, demands=demands)

"""Export of motions for execution: ROS 2 joint trajectories, tables, RAPID and URScript programs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.errors import InputError, PlanError
from falsework.robots.cells.cell_file import AnyCell, as_cell
from falsework.robots.exports.bag_view import PlacedParts
from falsework.robots.exports.controller import MAKERS, Language, check_makers, controller_settings, program_notes
from falsework.robots.exports.mcap_bag import write_bag
from falsework.robots.exports.payloads import PartLoads, part_loads
from falsework.robots.exports.programs import rapid_modules, ur_scripts
from falsework.robots.exports.ros2 import lost_schedule, ros2_goals, ros2_messages
from falsework.robots.exports.tables import csv_tables
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.plans.robot_forces import GripLoad, TimedPress, has_presses, timed_presses
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import schedule_of
from falsework.robots.plans.trajectory import check_limits
from falsework.search.plans.plan_source import structure_of_plan
from falsework.stability.holds import HoldMode
from falsework.utils.files.output_file import write_whole

Format = Literal["ros2-json", "ros2-yaml", "ros2-goals", "csv", "rapid", "urscript", "mcap"]

FORMATS: tuple[str, ...] = get_args(Format)


def export_plan(
    plan: RobotPlan,
    folder: Path | str,
    form: str,
    *,
    rate: float = 50.0,
    structure: AnyStructure | None = None,
    cell: AnyCell | None = None,
    joint_prefix: str = "",
    force: bool = False,
) -> list[Path]:
    """Write the motions of a robot plan into a folder.

    Args:
        plan: the robot plan; reverse it first to export the assembly of a plan for disassembly.
        folder: output folder; created if it does not exist.
        form: `ros2-json` and `ros2-yaml` (one file per step and one for the plan), `ros2-goals` (one file, with goals
            of `FollowJointTrajectory` and waits for each robot), `csv` (one file per step and one for the plan, and
            one for presses if there are any), `rapid` and `urscript` (one program per robot, synchronised according to
            the schedule), or `mcap` (one bag with the times of the schedule).
        rate: positions per second for `csv` and `urscript`; the other formats get the knots.
        structure: structure of the plan; with it and the cell a bag has the shapes of the parts, and programs have the
            loads of carried parts. A plan for assembly in which robots press needs both.
        cell: cell of the plan; with it nothing is written for other robots than those of the cell, nor motions and
            presses beyond its limits. Without it the plan is taken as it is. Programs need it: it has the loads of the
            tools and the signals of the grippers.
        joint_prefix: prefix of the names of joints in `ros2-json`, `ros2-yaml` and `ros2-goals`, in which `{robot}`
            stands for the name of the robot; by default none, as in the descriptions of the arms.
        force: write programs for arms of another maker, or of an unknown one, too.

    Returns:
        The files written.

    Raises:
        InputError: no such format, or one that cannot have robots that move at the same instant; a rate that is not
            above zero, a folder that cannot be written, programs for arms of another maker, or a signal that a program
            cannot have.
        PlanError: the plan is for another structure or cell, or exceeds the limits of the cell, or robots press and
            the structure or cell is missing, or a program is wanted without the cell.
    """
    if form not in FORMATS:
        raise InputError(f"no export format {form!r}; choose {', '.join(FORMATS)}")
    if not 0 < rate <= 10_000:
        raise InputError(f"a rate of {rate:g} positions per second cannot be exported; give one above 0, up to 10000")
    if joint_prefix and not form.startswith("ros2-"):
        raise InputError(f"a prefix of joints is for ros2-json, ros2-yaml and ros2-goals, not {form}; leave it out")
    joint = next((k for k, step in enumerate(plan.steps) if step.partners), None)
    if joint is not None and form == "urscript":
        others = ", ".join(kept for kept in FORMATS if kept != form)
        raise InputError(
            f"in step {plan.number(joint)} ({plan.does(joint)}) several robots move at the same instant, which "
            f"urscript cannot say: each controller has a clock of its own; choose {others}"
        )
    writers: dict[str, Callable[[], Iterable[tuple[str, str]]]] = {
        "ros2-json": lambda: ros2_messages(plan, presses, "json", joint_prefix),
        "ros2-yaml": lambda: ros2_messages(plan, presses, "yaml", joint_prefix),
        "ros2-goals": lambda: ros2_goals(plan, presses, joint_prefix),
        "csv": lambda: csv_tables(plan, presses, rate),
        "rapid": lambda: rapid_modules(plan, _needed(cell), presses, loads),
        "urscript": lambda: ur_scripts(plan, _needed(cell), rate, presses, loads),
    }
    placed: PlacedParts | None = None
    loads: PartLoads | None = None
    if cell is not None:
        cell = as_cell(cell)
        plan.check_cell(cell)
        if fault := _limit_fault(plan, cell):
            raise PlanError(f"the robot plan cannot be exported for {cell.name}: {fault}; plan again")
    presses = _presses(plan, structure, cell, form)
    language = _language(form)
    if language is not None:
        if cell is None:
            raise PlanError(f"{form} programs have the loads and signals of a cell; give the cell of the plan")
        if not force:
            check_makers(cell, language)
        if structure is not None:
            structure = as_assembly(structure)
            plan.check_identity(structure, cell)
            loads = part_loads(plan, structure, cell)
    if form == "mcap" and structure is not None and cell is not None:
        structure = as_assembly(structure)
        plan.check_identity(structure, cell)
        placed = PlacedParts(place_parts(structure, cell.placement), cell)
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}; choose another place") from None
    paths = []
    if form == "mcap":
        paths.append(folder / "plan.mcap")
        write_bag(plan, paths[0], placed, presses)
    for name, text in [*writers[form]()] if form in writers else ():
        paths.append(folder / name)
        write_whole(paths[-1], lambda file, text=text: file.write(text.encode("utf-8", "backslashreplace")))
    return paths


def structure_for_export(
    plan: RobotPlan, form: str, file: Path | str | None, structure: AnyStructure | None, **options: Any
) -> tuple[Assembly | None, list[str]]:
    """Return the structure that an export needs, None for none, and what the export lacks without it, a line each.

    Args:
        file: of the plan, for structures that it names.
        structure: instead of the one that the plan names.
        options: as for `load_structure`.

    Raises:
        InputError: robots press, or a structure is given, and it cannot be read, or is another one.
    """
    pressed = has_presses(plan)
    if form not in ("mcap", *MAKERS) and not pressed:
        return None, []
    try:
        return structure_of_plan(plan.plan, file, structure, **options), []
    except InputError as error:
        if structure is not None or pressed:
            raise
        what = "the bag has no shapes" if form == "mcap" else "programs have no loads"
        return None, [f"{what} of parts: {error}"]


def export_losses(plan: RobotPlan, form: str) -> list[str]:
    """Return what an export does not keep of a plan, each in one line."""
    lost = lost_schedule(plan, form)
    losses = [lost] if lost else []
    if form == "urscript" and has_presses(plan) and plan.plan.claim.holds.mode is HoldMode.FORCE:
        losses.append(
            "robots press with moments, and in all directions, in this plan, and URScript has the force along one "
            "direction alone: what is proven of these presses does not hold; plan with --press-mode hybrid"
        )
    return losses


def export_notes(plan: RobotPlan, form: str, cell: Cell) -> list[str]:
    """Return what an export does not keep, or takes for granted, each in one line."""
    language, notes = _language(form), export_losses(plan, form)
    if language is not None:
        notes += program_notes(cell, language)
        for number, robot in enumerate(cell.robots):
            set_up = "; ".join(controller_settings(plan, cell, number, language))
            notes.append(f"set up the controller of {robot.name}: {set_up}")
    return notes


def _language(form: str) -> Language | None:
    """Return the language of a format of programs; None for another format."""
    return next((language for language in MAKERS if language == form), None)


def _needed(cell: AnyCell | None) -> Cell:
    assert isinstance(cell, Cell)
    return cell


def _presses(plan: RobotPlan, structure: AnyStructure | None, cell: Cell | None, form: str) -> tuple[TimedPress, ...]:
    """Return the presses of a plan, at the times of its schedule in a bag, else of one motion after the other."""
    if not has_presses(plan):
        return ()
    if structure is None or cell is None:
        missing = "its structure" if structure is None else "its cell"
        raise PlanError(f"robots press in this plan, and only with the places of its parts it says how; give {missing}")
    graph = schedule_of(plan if form == "mcap" else replace(plan, schedule=None))
    presses = timed_presses(plan, as_assembly(structure), cell, graph)
    for press in presses:
        force, moment = np.split(press.wrench_in(press.tool), 2)
        load = GripLoad(press.step + 1, press.robot, press.part, force, moment, presses=True)
        if fault := load.fault(plan, cell):
            raise PlanError(f"the robot plan cannot be exported for {cell.name}: {fault}; plan again")
    return presses


def _limit_fault(plan: RobotPlan, cell: Cell) -> str:
    """Return the first fault that `check_limits` finds in a plan, with its step and robot; empty if there is none."""
    for step, robot, trajectory in plan.moves():
        faults = check_limits(trajectory, cell.robots[robot].model, cell.speed).faults
        if faults:
            return f"step {step + 1}, {cell.robots[robot].name}: {faults[0]}"
    return ""

"""Export of structures, plans and robot plans in registered formats, chosen by file suffix or name."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from falsework.assembly.load import as_assembly, load_options, load_structure
from falsework.assembly.model import Assembly
from falsework.errors import ExportWarning, InputError
from falsework.files import load_own
from falsework.robots.cells.cell_file import AnyCell
from falsework.robots.exports.export import export_losses, export_plan, structure_for_export
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.utils.files.formats import EXPORTERS, FOLDER, check_ending, exporter_by_suffix, formats, write_format
from falsework.utils.models import check_options


def format_of(path: Path | str) -> str:
    """Return the format that the name of a file stands for; a name without an ending is a folder."""
    found, suffix = exporter_by_suffix(path), Path(path).suffix.lower()
    if found is None and suffix[1:2].isalpha() and not Path(path).is_dir():
        known = dict.fromkeys(ending for exporter in formats(EXPORTERS).values() for ending in exporter.suffixes)
        endings = ", ".join(ending for ending in known if ending != FOLDER)
        raise InputError(f"no export format ends in {suffix}; write {endings}, or a folder, whose name has no ending")
    return found or "folder"


def read_exportable(
    path: str | Path, structure: Assembly | str | Path | None = None, **options: Any
) -> tuple[Assembly | Plan | RobotPlan, Assembly | None]:
    """Read a plan, robot plan or structure, whichever the file is.

    Returns:
        The object read, and the structure, which is not loaded for a robot plan.
    """
    found = load_own(path) if Path(path).suffix.lower() == ".json" else None
    if isinstance(found, RobotPlan):
        return found, None
    if isinstance(found, Plan):
        return found, structure_of_plan(found, path, structure, **options)
    assembly = load_structure(path, **options)
    return assembly, assembly


def export(
    subject: Assembly | Plan | RobotPlan | str | Path,
    path: Path | str,
    structure: Assembly | str | Path | None = None,
    *,
    format: str | None = None,
    step_seconds: float | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    cell: AnyCell | None = None,
    **options: Any,
) -> None:
    """Write a structure, a plan in motion or as a sheet, or the motions of a robot plan for other programs.

    A sheet has the assembly instructions of a plan for a crew: which part to place, to hold and to release. Files of
    other programs hold no joints, loads and given contacts; what is left out, of a robot plan too, is an
    `ExportWarning`.

    Args:
        subject: a structure, plan or robot plan, or what `load_structure`, `load_plan` or `load_robot_plan` read.
        path: file to write, or folder, which must be new or empty.
        structure: structure of a plan that does not name it.
        format: `folder` (one mesh a part), `glb`, `gltf`, `usd`, `html` (a page that opens without a server),
            `compas`, `compas-assembly` or `compas-dem`, or one that another package registers; for a sheet `pdf` or
            `csv`; for a robot plan `html`,
            `ros2-json`, `ros2-yaml`, `ros2-goals`, `csv`, `rapid`, `urscript` or `mcap`. By the name of the file if
            not given.
        step_seconds: length of a step of a plan in motion; 1 s if not given.
        azimuth: of the pictures of a sheet, degrees; 0 looks along +y.
        elevation: of the pictures of a sheet, degrees.
        progress: called with the number of pictures of a sheet drawn and of all.
        cell: cell of a robot plan, as for `export_plan`; that of a file is the one that the file names, if not given.
        options: as for `load_structure`.

    Raises:
        InputError: no such format, one that cannot show the subject, or a place that cannot be written.
    """
    check_options(export, options, load_options())
    file, given = subject if isinstance(subject, (str, Path)) else None, structure
    if isinstance(subject, (str, Path)):
        subject, structure = read_exportable(subject, structure, **options)
    view = {"step_seconds": step_seconds, "azimuth": azimuth, "elevation": elevation, "progress": progress}
    if isinstance(subject, RobotPlan):
        if cell is None and file is not None:
            cell = subject.cell_place(file)
        chosen = format or ("html" if Path(path).suffix.lower() == ".html" else "ros2-json")
        if chosen == "html":
            shown = structure_of_plan(subject.plan, file, given, **options)
            write_format(shown, path, chosen, subject, cell=cell, **view)
            return
        check_ending(path, f"a folder of {chosen}")
        needed, lacking = structure_for_export(subject, chosen, file, given, **options)
        export_plan(subject, path, chosen, structure=needed, cell=cell)
        for lost in lacking + export_losses(subject, chosen):
            warnings.warn(lost, ExportWarning, stacklevel=2)
        return
    chosen = format_of(path) if format is None else format
    if isinstance(subject, Plan):
        write_format(structure_of_plan(subject, None, structure, **options), path, chosen, subject, **view)
    else:
        write_format(as_assembly(subject), path, chosen, **view)

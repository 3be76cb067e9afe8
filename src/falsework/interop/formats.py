"""Export formats of structures, plans and robot plans, chosen by file suffix or name."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Literal, get_args

from falsework.assembly.load import as_assembly, load_structure
from falsework.assembly.model import Assembly
from falsework.assembly.store import save_assembly
from falsework.errors import InputError
from falsework.interop.compas_write import CompasKind, write_compas
from falsework.interop.gltf import write_gltf
from falsework.interop.usd import write_usd
from falsework.robots.cells.cell_file import AnyCell
from falsework.robots.exports.export import export_plan
from falsework.robots.plans.presses import has_presses
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.robot_plan_file import load_robot_plan
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_file import load_plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.utils.json_file import read_format

Format = Literal["folder", "glb", "gltf", "usd", "compas", "compas-assembly", "compas-dem"]

_BY_SUFFIX: dict[str, Format] = {
    ".glb": "glb",
    ".gltf": "gltf",
    ".usd": "usd",
    ".usda": "usd",
    ".json": "compas",
}
_MOVING = ("glb", "gltf", "usd")
"""Formats that can show a plan."""


class ExportWarning(UserWarning):
    """Property of a structure that a file of another program does not hold."""


def format_of(path: Path | str) -> Format:
    """Return the format that the name of a file stands for; a name without an ending is a folder.

    Raises:
        InputError: an ending that stands for no format.
    """
    suffix = Path(path).suffix.lower()
    if suffix[1:2].isalpha() and suffix not in _BY_SUFFIX and not Path(path).is_dir():
        raise InputError(
            f"no export format ends in {suffix}; write {', '.join(_BY_SUFFIX)}, or choose the format folder"
        )
    return _BY_SUFFIX.get(suffix, "folder")


def read_exportable(
    path: str | Path, structure: Assembly | str | Path | None = None, **options: Any
) -> tuple[Assembly | Plan | RobotPlan, Assembly | None]:
    """Read a plan, robot plan or structure, whichever the file is.

    Args:
        path: as for `export`.
        structure: as for `export`.
        options: as for `load_structure`.

    Returns:
        The object read, and the structure, which is not loaded for a robot plan.

    Raises:
        InputError: none of them.
    """
    file = Path(path)
    kind = read_format(file) if file.suffix.lower() == ".json" and file.is_file() else ""
    if kind.startswith("falsework.robot-plan/"):
        return load_robot_plan(file), None
    if kind.startswith("falsework.plan/"):
        plan = load_plan(file)
        return plan, structure_of_plan(plan, file, structure, **options)
    assembly = load_structure(path, **options)
    return assembly, assembly


def export(
    subject: Assembly | Plan | RobotPlan | str | Path,
    path: Path | str,
    structure: Assembly | str | Path | None = None,
    *,
    format: str | None = None,
    step_seconds: float | None = None,
    cell: AnyCell | None = None,
    **options: Any,
) -> None:
    """Write a structure, a plan in motion, or the motions of a robot plan for other programs.

    Files of other programs hold no joints and loads; what is left out is an `ExportWarning`.

    Args:
        subject: a structure, plan or robot plan, or what `load_structure`, `load_plan` or `load_robot_plan` read.
        path: file to write, or folder, which must be new or empty.
        structure: structure of a plan that does not name it; of a robot plan only where robots press.
        format: `folder` (one mesh a part), `glb`, `gltf`, `usd`, `compas`, `compas-assembly` or `compas-dem`; for a
            robot plan `ros2-json`, `ros2-yaml`, `ros2-goals`, `csv`, `rapid`, `urscript` or `mcap`. By the name of
            the file if not given.
        step_seconds: length of a step of a plan; 1 s if not given.
        cell: cell of a robot plan, as for `export_plan`; that of a file is the one that the file names, if not given.
        options: as for `load_structure`.

    Raises:
        InputError: no such format, one that cannot show the subject, or a place that cannot be written.
    """
    file, given = subject if isinstance(subject, (str, Path)) else None, structure
    if isinstance(subject, (str, Path)):
        subject, structure = read_exportable(subject, structure, **options)
    if isinstance(subject, RobotPlan):
        if cell is None and file is not None:
            cell = subject.cell_place(file)
        pressed = structure_of_plan(subject.plan, file, given, **options) if has_presses(subject) else None
        export_plan(subject, path, format or "ros2-json", structure=pressed, cell=cell)
        return
    chosen = format_of(path) if format is None else format
    if chosen not in get_args(Format):
        raise InputError(f"no export format {chosen!r}; choose {', '.join(get_args(Format))}")
    plan = None
    if isinstance(subject, Plan):
        plan, assembly = subject, structure_of_plan(subject, None, structure, **options)
        if chosen not in _MOVING:
            raise InputError(f"{chosen} cannot show a plan; write {', '.join(_MOVING)}, or name the structure instead")
    else:
        assembly = as_assembly(subject)
        if step_seconds is not None:
            raise InputError("--step-seconds is for plans; leave it out")
    seconds = 1.0 if step_seconds is None else step_seconds
    held = (("joints", assembly.joints), ("loads", assembly.loads))
    left_out = " and ".join(name for name, given in held if given is not None)
    # The writer of a folder knows what it can hold; a plan in motion is looked at only.
    if left_out and chosen != "folder" and plan is None:
        warnings.warn(
            f"{chosen} files have no {left_out}: those of {assembly.name} are left out, without which "
            "its stability differs",
            ExportWarning,
            stacklevel=2,
        )
    if chosen == "folder":
        save_assembly(assembly, path)
    elif chosen == "usd":
        write_usd(path, assembly, plan, step_seconds=seconds)
    elif chosen == "glb" or chosen == "gltf":
        write_gltf(path, assembly, plan, kind=chosen, step_seconds=seconds)
    else:
        kinds: dict[str, CompasKind] = {"compas": "meshes", "compas-assembly": "assembly", "compas-dem": "dem"}
        write_compas(path, assembly, kinds[chosen])

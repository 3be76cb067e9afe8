"""Reading and writing of files of this package, whichever kind they are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.assembly.load import load_structure, name_of
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.robots.cells.cell_file import load_cell
from falsework.robots.model.cell import Cell
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.robot_plan_file import load_robot_plan, save_robot_plan
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_file import load_plan, save_plan
from falsework.search.problem.state_graph import StateGraph, load_state_graph, save_state_graph
from falsework.utils.files.formats import check_json_name, exporter_by_suffix, write_format
from falsework.utils.json_file import read_format

if TYPE_CHECKING:
    from falsework.learn.training.checkpoint import Run


def load(path: Path | str, **options: Any) -> Assembly | Plan | RobotPlan | StateGraph | Cell | Run:
    """Read a file or folder of this package: a plan, robot plan, state graph, cell, run or structure.

    Args:
        path: file or folder; also the name of a built-in structure, and files of other programs that hold one.
        options: of a structure, as for `load_structure`.

    Raises:
        InputError: no such file, a damaged one, or one of another kind; or options for what is no structure.
        DependencyError: a run without torch.
    """
    found = load_own(name_of(path))
    if found is None:
        return load_structure(path, **options)
    if options:
        raise InputError(f"{path} is no structure, and takes no {', '.join(sorted(options))}; leave that out")
    return found


def load_own(path: Path | str) -> Plan | RobotPlan | StateGraph | Cell | Run | None:
    """Read a file of this package; None for anything else, such as a structure.

    Raises:
        InputError: a damaged file, or one of a kind that only its own command reads.
        DependencyError: a run without torch.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if file.is_dir():
        return _load_run(file) if (file / "run.json").is_file() else None
    if not file.is_file() or suffix not in (".json", ".npz", ".toml"):
        return None
    if suffix != ".json":
        return load_state_graph(file) if suffix == ".npz" else load_cell(file)
    form = read_format(file)
    if form.startswith("falsework.plan/"):
        return load_plan(file)
    if form.startswith("falsework.robot"):
        return load_robot_plan(file)
    if form and not form.startswith("falsework.assembly/"):
        raise InputError(f"{file} has format {form!r}, which cannot be shown or read here; give a plan or a structure")
    return None


def save(thing: Assembly | Plan | RobotPlan | StateGraph, path: Path | str, *, proofs: bool = False) -> None:
    """Write a structure, plan, robot plan or state graph, whole or not at all; `load` reads it.

    Args:
        path: file to write; of a structure a folder, which must be new or empty, or a file of an export format.
        proofs: write the proofs of the states of a plan too.

    Raises:
        InputError: something that has no file, proofs of what is no plan, or a place that cannot be written.
        PlanError: a plan without the proofs that are requested.
    """
    if proofs and not isinstance(thing, Plan):
        raise InputError(f"{type(thing).__name__} is saved without a choice of proofs; leave proofs out")
    if isinstance(thing, (Plan, RobotPlan)):
        check_json_name(path, "a plan")
    if isinstance(thing, Plan):
        save_plan(thing, path, proofs=proofs)
    elif isinstance(thing, RobotPlan):
        save_robot_plan(thing, path)
    elif isinstance(thing, StateGraph):
        save_state_graph(thing, path)
    elif isinstance(thing, Assembly):
        write_format(thing, path, (exporter_by_suffix(path) if Path(path).suffix else None) or "folder")
    else:
        raise InputError(
            f"{type(thing).__name__} has no file; save an assembly, a plan, a robot plan or a state graph; results of "
            "searches have theirs in plans"
        )


def _load_run(folder: Path) -> Run:
    from falsework.utils.tensors import check_torch

    check_torch()
    from falsework.learn.training.checkpoint import load_run

    return load_run(folder)

"""Structure of a plan, loaded from the source that the plan records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from falsework.assembly.library import is_built_in
from falsework.assembly.load import as_assembly, load_structure
from falsework.assembly.model import Assembly
from falsework.assembly.props import with_props
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.utils.files.output_file import path_beside


def structure_of_plan(
    plan: Plan, file: Path | str | None = None, structure: str | Path | Assembly | None = None, **options: Any
) -> Assembly:
    """Load the structure of a plan, the one that is given, else the one that the plan names, with the plan's props.

    A plan that was saved from Python names a built-in structure only by its name.

    Args:
        plan: the plan.
        file: where the plan was read from; a path in the plan is relative to its folder, or without a file, to the
            current folder.
        structure: structure to take instead, by name, by path, or as it is.
        options: as for `load_structure`; they override those of the plan.

    Raises:
        PlanError: neither names a structure, or the named one is gone.
        InputError: the structure cannot be used.
    """
    if structure is not None:
        given = as_assembly(structure, **options)
        return given if given.props else with_props(given, plan.props)
    source = dict(plan.source or {})
    if "built_in" in source:
        spec = source.pop("built_in")
    elif "path" in source:
        folder = Path() if file is None else Path(file).resolve().parent
        spec = folder / source.pop("path")
        if not spec.exists():
            raise PlanError(f"the structure of the plan, {spec}, is gone; name another place (--structure)")
    else:  # saved from Python; a structure that is not built in may have the same name
        spec = plan.name
        if not is_built_in(spec) or with_props(load_structure(spec), plan.props).identity != plan.identity:
            raise PlanError(f"{file or 'the plan'} does not say where its structure is; name it (--structure)")
    return with_props(load_structure(spec, **{**source, **options}), plan.props)


def moved_source(plan: Plan, file: Path, beside: Path) -> Mapping[str, Any] | None:
    """Return the source of a plan that was read from one file for another file, to whose folder its path is relative.

    Args:
        plan: the plan.
        file: where it was read from.
        beside: where it is going to be written.
    """
    if plan.source is None or "path" not in plan.source:
        return plan.source
    return {**plan.source, "path": path_beside(file.resolve().parent / plan.source["path"], beside)}

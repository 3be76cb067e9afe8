"""Structure of a plan or state graph, loaded from the source that it records, with or without the options in it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from falsework.assembly.library import built_in, is_built_in
from falsework.assembly.load import as_assembly, load_structure
from falsework.assembly.model import Assembly
from falsework.assembly.props import with_props
from falsework.errors import InputError, PlanError
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_model import SourceEntry
from falsework.search.problem.state_graph import StateGraph
from falsework.utils.files.output_file import path_beside
from falsework.utils.models import read_model

PLACES = ("built_in", "path")
"""Entries of a source that say where the structure is; all others are options of `load_structure`."""


def structure_of_plan(
    plan: Plan | StateGraph,
    file: Path | str | None = None,
    structure: str | Path | Assembly | None = None,
    **options: Any,
) -> Assembly:
    """Load the structure of a plan, the one that is given, else the one that the plan names, with the plan's props.

    A plan that was saved from Python names a built-in structure only by its name.

    Args:
        plan: the plan, or a state graph, whose file names its structure in the same way.
        file: where the plan was read from; a path in the plan is relative to its folder, or without a file, to the
            current folder.
        structure: structure to take instead, by name, by path, or as it is.
        options: as for `load_structure`; they override those of the plan.

    Raises:
        PlanError: neither names a structure, or the named one is gone.
        InputError: the structure cannot be used.
    """
    subject = str(file or ("the graph" if isinstance(plan, StateGraph) else "the plan"))
    if isinstance(plan, StateGraph):
        named, props, identity = plan.origin, (), plan.task.identity
        if named is not None:
            about = f"{subject}: "
            check_source(read_model(SourceEntry, named, about, PlanError, "origin"), about, "origin")
    else:
        named, props, identity = plan.source, plan.props, plan.identity
    if structure is not None:
        given = as_assembly(structure, **options)
        return given if given.props else with_props(given, props)
    source = dict(named or {})
    if "built_in" in source:
        name = source.pop("built_in")
        if not is_built_in(name):
            raise PlanError(f"{subject} names a built-in structure {name!r}, which there is not; plan again")
        spec = built_in(name)
    elif "path" in source:
        folder = Path() if file is None else Path(file).resolve().parent
        spec = folder / source.pop("path")
        if not spec.exists():
            raise PlanError(f"the structure of {subject}, {spec}, is gone; name another place (--structure)")
    else:  # saved from Python; a structure that is not built in may have the same name
        spec = built_in(plan.name)
        if not is_built_in(spec) or with_props(load_structure(spec), props).identity != identity:
            raise PlanError(f"{subject} does not say where its structure is; name it (--structure)")
    return with_props(load_structure(spec, **{**source, **options}), props)


def structure_to_check(
    plan: Plan, file: Path | str | None = None, structure: str | Path | Assembly | None = None, **options: Any
) -> tuple[Assembly, dict[str, Any]]:
    """Load the structure of a plan for a check, as its own files and the caller describe it if it was planned for that.

    Options that the plan records, such as its friction, are applied only if the plan is for another structure without
    them. A structure with options is read twice for this.

    Args:
        file, structure: as for `structure_of_plan`.
        options: options of `load_structure` from the caller.

    Returns:
        The structure, and the options of the plan that it depends on and that the caller did not give.

    Raises:
        PlanError: as `structure_of_plan`.
        InputError: as `structure_of_plan`.
    """
    own = {key: value for key, value in (plan.source or {}).items() if key not in PLACES and options.get(key) is None}
    if structure is not None or not own:
        return structure_of_plan(plan, file, structure, **options), {}
    bare = replace(plan, source={key: value for key, value in (plan.source or {}).items() if key in PLACES})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            found = structure_of_plan(bare, file, **options)
        except InputError:  # such as a structure without boundary, which needs a ground
            found = None
    if found is None or found.identity != plan.identity:
        return structure_of_plan(plan, file, **options), own
    for warning in caught:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return found, {}


def made_for(plan: Plan) -> str:
    """Return the end of a message on a structure that a plan is not for: which to give."""
    source = plan.source or {}
    options = {key: value for key, value in source.items() if key not in PLACES}
    spec = next((str(source[place]) for place in PLACES if place in source), plan.name)
    set_so = "".join(f", {key} {value}" for key, value in options.items())
    return f"give the structure that it was made for: {spec}{set_so}"


def check_source(source: SourceEntry, about: str, where: str = "structure.source") -> None:
    """Raise for a source that does not say where the structure is; whether it exists is not checked.

    Raises:
        PlanError: it has neither place, or both; `about` begins the message.
    """
    if (source.built_in is None) == (source.path is None):
        raise PlanError(f"{about}{where} must have either built_in or path")


def moved_source(plan: Plan, file: Path, beside: Path) -> Mapping[str, Any] | None:
    """Return the source of a plan that was read from one file for another file, to whose folder its path is relative.

    Args:
        file: where it was read from.
        beside: where it is going to be written.
    """
    if plan.source is None or "path" not in plan.source:
        return plan.source
    return {**plan.source, "path": path_beside(file.resolve().parent / plan.source["path"], beside)}

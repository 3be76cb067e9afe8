"""Loader of the structure that a command names: built in, meshes, COMPAS data, or the structure of a plan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.errors import PlanError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan


def load(spec: str, **options: Any) -> Assembly:
    """Return a structure by name or path: what `load_structure` knows, and files of COMPAS data.

    Args:
        spec: name of a built-in structure, a folder or file of meshes, or a file that `compas.json_dump` wrote.
        options: as for `load_structure`.

    Raises:
        InputError: no such structure, or it cannot be used; the message says what to do.
    """
    from falsework.assembly import load_structure
    from falsework.interop.compas_read import is_compas, load_compas

    return load_compas(spec, **options) if is_compas(spec) else load_structure(spec, **options)


def structure_of(plan: Plan, file: Path, structure: str | None = None, **options: Any) -> Assembly:
    """Return the structure of a plan: the one that is named, else the one that the plan says it was made for.

    Args:
        plan: the plan.
        file: where it was read from; paths in it are relative to that.
        structure: structure to take instead.
        options: as for `load_structure`; they come before what the plan says.

    Raises:
        PlanError: nobody says where the structure is, or it is gone.
        InputError: it cannot be used.
    """
    if structure is not None:
        return load(structure, **options)
    source = dict(plan.source or {})
    if "built_in" in source:
        spec = source.pop("built_in")
    elif "path" in source:
        spec = str(file.resolve().parent / source.pop("path"))
        if not Path(spec).exists():
            raise PlanError(f"the structure of the plan, {spec}, is gone; name it with --structure")
    else:
        raise PlanError(f"{file} does not say where its structure is; name it with --structure")
    return load(spec, **{**source, **options})

"""The structure to build: an immutable assembly, states of it, and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from falsework.assembly.model import Assembly
from falsework.assembly.store import load_assembly, save_assembly
from falsework.errors import InputError

__all__ = ["Assembly", "load_assembly", "load_structure", "save_assembly"]


def load_structure(structure: str | Path, **options: Any) -> Assembly:
    """A structure by the name of a built-in one, such as `arch:blocks=15`, or by the path of an assembly.

    Args:
        structure: a path that exists, or the name of a built-in structure with its parameters.
        options: what `load_assembly` takes: unit, density, friction, boundary, ground, contact_settings.

    Raises:
        InputError: neither, or options that a built-in structure does not take.
    """
    from falsework.assembly import library

    text = str(structure)
    looks_like_path = isinstance(structure, Path) or Path(text).exists() or "/" in text or "\\" in text
    if looks_like_path or text.split(":", 1)[0] not in {entry.name for entry in library.structures()}:
        return load_assembly(structure, **options)
    assembly = library.build(text)
    if options.pop("unit", None) is not None:
        raise InputError(f"{text} is a built-in structure in metres; leave the unit out")
    if options.pop("contact_settings", None) is not None:
        raise InputError(f"{text} is a built-in structure with its own contact tolerances; leave them out")
    ground = options.pop("ground", False)
    changes = {key: value for key, value in options.items() if value is not None}
    assembly = assembly.replace(**changes) if changes else assembly
    return assembly.with_ground() if ground else assembly

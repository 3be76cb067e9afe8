"""The structure to build: an immutable assembly, states of it, and files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from falsework.assembly.model import Assembly, ContactWarning
from falsework.assembly.store import load_assembly, save_assembly
from falsework.errors import InputError

__all__ = ["Assembly", "ContactWarning", "load_assembly", "load_structure", "save_assembly"]


def load_structure(structure: str | Path, **options: Any) -> Assembly:
    """A structure by the name of a built-in one, such as `arch:blocks=15`, or by the path of an assembly.

    A bare name that is both means the built-in one; `./arch` is the folder.

    Args:
        structure: name of a built-in structure with its parameters, or a folder or file.
        options: what `load_assembly` takes: unit, density, friction, boundary, ground, contact_settings;
            None is as good as left out. A built-in structure takes neither unit nor contact_settings.

    Raises:
        InputError: neither a path nor a built-in structure, or an option that it does not take.
    """
    from falsework.assembly import library

    text = str(structure)
    given = {key: value for key, value in options.items() if value is not None}
    if isinstance(structure, Path) or not library.is_built_in(text):
        if not Path(text).exists() and Path(text).name == text:
            names = ", ".join(entry.name for entry in library.structures())
            raise InputError(f"there is no folder, file or built-in structure {text!r}; built in are {names}")
        return load_assembly(structure, **given)
    for option in ("unit", "contact_settings"):
        if option in given:
            raise InputError(f"{text} is a built-in structure and has its own {option}; leave it out")
    ground = given.pop("ground", False)
    assembly = library.build(text, density=given.pop("density", None), friction=given.pop("friction", None))
    if given:
        assembly = assembly.replace(**given)
    return assembly.with_ground() if ground else assembly

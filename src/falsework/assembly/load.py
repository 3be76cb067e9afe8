"""Structures by name or path: built-in ones, meshes, and the formats of readers that are registered."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

_READERS: list[tuple[str, str]] = []
"""Probe and reader of each format, as `package.module:function`; imported at the first file that they may know."""


def register_reader(probe: str, reader: str) -> None:
    """Let `load_structure` read files of another format.

    Args:
        probe: `package.module:function` that takes the path of a file and says whether it is of this format.
        reader: `package.module:function` that takes the path and the options of `load_structure`, and returns an
            `Assembly`.
    """
    if (probe, reader) not in _READERS:
        _READERS.append((probe, reader))


def load_structure(structure: str | Path, **options: Any) -> Assembly:
    """Load a structure by the name of a built-in one, such as `arch:blocks=15`, or by its path.

    A path is a folder or file of meshes, with or without `assembly.json`, or a file of COMPAS data. A bare name that is
    both means the built-in structure; `./arch` is the folder.

    Args:
        structure: name of a built-in structure with its parameters, or a folder or file.
        options: unit, density (kg/m3), friction, boundary, ground and contact_settings as for `load_assembly`; None is
            as good as left out. A built-in structure takes neither unit nor contact_settings.

    Raises:
        InputError: neither a path nor a built-in structure, or an option that it does not take.
    """
    from falsework.assembly import library
    from falsework.assembly.store import load_assembly

    text = str(structure)
    given = {key: value for key, value in options.items() if value is not None}
    if isinstance(structure, Path) or not library.is_built_in(text):
        path = Path(text)
        if not path.exists() and path.name == text:
            names = ", ".join(entry.name for entry in library.structures())
            raise InputError(f"there is no folder, file or built-in structure {text!r}; built in are {names}")
        for probe, reader in _READERS if path.is_file() else ():
            if _resolve(probe)(path):
                return _resolve(reader)(path, **given)
        return load_assembly(path, **given)
    for option in ("unit", "contact_settings"):
        if option in given:
            raise InputError(f"{text} is a built-in structure and has its own {option}; leave it out")
    ground = given.pop("ground", False)
    assembly = library.build(text, density=given.pop("density", None), friction=given.pop("friction", None))
    if given:
        assembly = assembly.replace(**given)
    return assembly.with_ground() if ground else assembly


def _resolve(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)

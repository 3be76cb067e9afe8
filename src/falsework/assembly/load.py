"""Loader of structures by name or path: built-in ones, meshes, and registered formats."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from falsework.errors import InputError, ReadWarning
from falsework.utils.files.damage import blamed_on
from falsework.utils.files.formats import FOLDER, READERS, Reader, formats, reader_of
from falsework.utils.models import check_options

if TYPE_CHECKING:
    from falsework.assembly.draft import Draft
    from falsework.assembly.model import Assembly

AnyStructure: TypeAlias = "Assembly | str | Path"
"""Structure as it is, or what `load_structure` takes."""

LOAD_OPTIONS = ("loads", "earthquake", "materials", "joints", "fasteners")
"""Options that load or join the parts of a structure and that its reader need not know."""


def read_draft(path: Path, unit: str | None = None) -> Draft | None:
    """Read the parts of a file of a registered format, unchecked; None if no reader of parts knows the file."""
    reader = _reader_of(path)
    if reader is None or reader.parts is None:
        return None
    with blamed_on(path, "write it again"):
        return reader.parts(path, unit=unit)


def _reader_of(path: Path) -> Reader | None:
    from falsework.geometry.mesh.read import SUFFIXES

    return None if path.is_file() and path.suffix.lower() in SUFFIXES else reader_of(path)


def load_structure(structure: str | Path, **options: Any) -> Assembly:
    """Load a structure by the name of a built-in one, such as `arch:blocks=15`, or by its path.

    A path is a folder or file of meshes, with or without `assembly.json`, or a file of another format: COMPAS data,
    Rhino, STEP, bricks; `assembly.json` beside it is read too, and stands for its folder. A name that is both a path
    and a built-in structure means the path, with a warning; with a colon, such as `arch:`, it is the built-in one.
    What a file has and the structure has not, or in another way, is a `ReadWarning`.

    Args:
        structure: name of a built-in structure with its parameters, or a folder or file.
        options: unit, density (kg/m3), friction, boundary, ground, contact_settings, settle, loads, earthquake,
            materials, joints and fasteners as for `load_assembly`, groups as for `join_parts`, and interfaces
            (`found`, `stored` or `compare`) as for COMPAS data; None is equivalent to omission. A built-in structure
            takes no unit, contact_settings or settle, and only COMPAS data store interfaces.

    Raises:
        InputError: neither a path nor a built-in structure, or an option that it does not take.
    """
    from falsework.assembly import library
    from falsework.assembly.fasteners import furnish

    text = check_given(load_structure, structure, options)
    if (groups := options.pop("groups", None)) is not None:
        from falsework.assembly.groups import join_parts

        return join_parts(load_structure(structure, **options), groups)
    given = {key: value for key, value in options.items() if value is not None}
    if not means_built_in(structure):
        path = Path(text)
        if isinstance(structure, str) and library.is_built_in(text):
            warnings.warn(
                f"{text} is a folder or file here, which is read, and the name of a built-in structure, "
                f"which is {library.built_in(text)}",
                ReadWarning,
                stacklevel=2,
            )
        with blamed_on(path, "write it again"):
            assembly = _read_structure(path, text, given)
        return _not_all_fixed(assembly)
    if given.pop("interfaces", "found") != "found":
        raise InputError(f"{text} is a built-in structure and stores no interfaces; leave out --interfaces")
    for option in ("unit", "contact_settings", "settle"):
        if option in given:
            has = "parts without clearance" if option == "settle" else f"its own {option}"
            raise InputError(f"{text} is a built-in structure and has {has}; leave out {option}")
    ground, acting = given.pop("ground", False), {name: given.pop(name, None) for name in LOAD_OPTIONS}
    assembly = library.build(text, density=given.pop("density", None), friction=given.pop("friction", None))
    if given:
        assembly = assembly.replace(**given)
    return _not_all_fixed(furnish(assembly.with_ground() if ground else assembly, **acting))


def load_options() -> tuple[str, ...]:
    """Return the names of the options of `load_structure`."""
    from falsework.assembly.store import load_assembly

    return "groups", "interfaces", *(load_assembly.__kwdefaults__ or ())


def name_of(given: object) -> str:
    """Return the text of a name or path.

    Raises:
        InputError: it is blank, which would be the present folder, or neither a text nor a path.
    """
    if not isinstance(given, (str, Path)):
        raise InputError(f"{type(given).__name__} names no structure or file; give a name or a path")
    if not str(given).strip():
        raise InputError("the structure has no name; give that of a built-in one, or a path")
    return str(given)


def check_given(taker: Callable[..., Any], structure: object, options: dict[str, Any]) -> str:
    """Return the text of a name or path; raise for options of a function that `load_structure` does not take either."""
    check_options(taker, options, load_options())
    return name_of(structure)


def means_built_in(structure: str | Path) -> bool:
    """Return whether a text names a built-in structure and no folder or file that exists."""
    from falsework.assembly.library import is_built_in

    return isinstance(structure, str) and is_built_in(structure) and not Path(structure).exists()


def _not_all_fixed(assembly: Assembly) -> Assembly:
    if assembly.boundary.all():
        warnings.warn(
            f"every part of {assembly.name} is boundary: nothing can move, so every verdict is stable and every plan "
            "is empty",
            ReadWarning,
            stacklevel=3,
        )
    return assembly


def _read_structure(path: Path, text: str, given: dict[str, Any]) -> Assembly:
    """Read a structure from a path; arguments as of `load_structure`."""
    from falsework.assembly import library
    from falsework.assembly.fasteners import furnish
    from falsework.assembly.store import FILE, load_assembly

    if path.name == FILE and path.is_file():
        path = path.parent
    if not path.exists() and path.name == text:
        names = ", ".join(entry.name for entry in library.structures())
        raise InputError(f"there is no folder, file or built-in structure {text!r}; built in are {names}")
    if (reader := _reader_of(path)) is not None:
        options = {**described_options(path), **given}
        acting = {name: options.pop(name, None) for name in LOAD_OPTIONS}
        return furnish(reader.read(path, **options), **acting)
    if given.pop("interfaces", "found") != "found":
        raise InputError(f"{text} is made of meshes and stores no interfaces; leave out --interfaces")
    check_meshes_path(path)
    return load_assembly(path, **given)


def as_assembly(structure: AnyStructure, **options: Any) -> Assembly:
    """Return a structure that is given as it is, or load it by its name or path.

    Args:
        options: as for `load_structure`; without effect on a structure that is given as it is.
    """
    from falsework.assembly.model import Assembly

    check_options(load_structure, options, load_options())
    if isinstance(structure, Assembly):
        return structure
    if isinstance(structure, (str, Path)):
        return load_structure(structure, **options)
    raise InputError(f"a structure is an Assembly, a name or a path, not {type(structure).__name__}")


def described_options(path: Path) -> dict[str, Any]:
    """Return the entries of `assembly.json` beside a file or in a folder of a registered format, as reader options."""
    from falsework.assembly.store import described_by, read_description
    from falsework.geometry.contact.interfaces import ContactSettings

    file = described_by(path)
    if not file.is_file():
        return {}
    described = read_description(path)
    if "names" in described:
        raise InputError(f"{file} has names, but {path} names its parts itself; leave them out")
    settings = described.pop("contact")
    if settings != ContactSettings():
        described["contact_settings"] = settings
    options = ("unit", "density", "friction", "boundary", "contact_settings", "settle", *LOAD_OPTIONS)
    return {name: described[name] for name in options if name in described}


def check_meshes_path(path: Path) -> None:
    """Raise for a file that neither a registered reader nor the reader of meshes knows."""
    from falsework.geometry.mesh.read import SUFFIXES
    from falsework.utils.json_file import read_format

    if not path.is_file() or path.suffix.lower() in SUFFIXES:
        return
    form = read_format(path) if path.suffix.lower() == ".json" else ""
    if form.startswith("falsework."):
        raise InputError(f"{path} is a file of format {form}, not a structure; give the structure that it belongs to")
    if path.suffix.lower() == ".toml":
        raise InputError(f"{path} is no structure; a cell is given by --cell, beside the structure in it")
    others = [
        f"{name} ({', '.join(reader.suffixes)})"
        for name, reader in formats(READERS).items()
        if FOLDER not in reader.suffixes
    ]
    raise InputError(
        f"cannot read {path}; a structure is a folder of meshes or one file: {', '.join(SUFFIXES)}, {', '.join(others)}"
    )

"""Assemblies on disk: a folder of meshes and `assembly.json`."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.assembly_model import FORMAT, AssemblyFile
from falsework.assembly.draft import Draft
from falsework.assembly.fasteners import furnish
from falsework.assembly.findings import likely_units, part_sizes
from falsework.assembly.groups import groups_of
from falsework.assembly.model import Assembly
from falsework.assembly.part_numbers import part_ids
from falsework.errors import AssemblyError, InputError
from falsework.geometry.contact.interfaces import ContactSettings
from falsework.geometry.mesh.obj import obj_text
from falsework.geometry.mesh.surface import warn_of
from falsework.utils.files.formats import FOLDER, Exporter
from falsework.utils.files.input_file import read_text
from falsework.utils.json_text import parse_json
from falsework.utils.models import read_model
from falsework.utils.quantity import format_quantity, listed

FILE = "assembly.json"
_NOTES = frozenset(
    ("source", "licence", "license", "author", "comment", "comments", "note", "notes", "description", "date", "url")
)
"""Entries that say nothing about the structure. Any other is warned of, or refused if nearly one that does."""
_ALIKE = 0.8
"""Similarity from which the name of an entry is taken for a misspelt one."""


def load_assembly(
    path: str | Path,
    *,
    unit: str | None = None,
    density: ArrayLike | None = None,
    friction: float | None = None,
    boundary: ArrayLike | None = None,
    ground: bool = False,
    contact_settings: ContactSettings | None = None,
    settle: float | None = None,
    loads: list[dict[str, Any]] | None = None,
    earthquake: float | list[float] | None = None,
    materials: str | list[str] | None = None,
    joints: list[dict[str, Any]] | None = None,
    fasteners: list[dict[str, Any]] | None = None,
) -> Assembly:
    """Read an assembly: a folder of meshes, or one file with one object per part.

    `assembly.json` in the folder, or beside the file, gives `name`, `unit`, `density` (one number or one a
    part, kg/m3), `friction`, `boundary` (ids or names of parts), `names`, `contact` (fields of
    `ContactSettings`), `settle` (m), `loads` and `earthquake` (see `Loads.from_entries`), `materials` and `joints` (see
    `Joints.from_entries`), and `fasteners` (see `fasten`); all of them may be missing. Arguments take
    precedence over the file.

    Args:
        path: folder or mesh file.
        unit: unit of the coordinates: m, dm, cm, mm, in or ft.
        density: kg/m3.
        friction: coefficient of friction of every contact.
        boundary: ids of the fixed parts, or a mask of shape (parts,).
        ground: add a fixed slab under the lowest point, as the last part, as for `Draft.assemble`.
        settle: largest motion with which parts settle into their clearance first, metres, as for `Draft.assemble`.
        loads: objects with `part`, `force` (N) and perhaps `at` (m) and `moment` (Nm).
        earthquake: pseudo-static horizontal acceleration in shares of gravity, along x, or along x and y.
        materials: of each part, or one for all.
        joints: objects with `friction`, `cohesion` (Pa) or `tension` (Pa), and `between` (materials) or `parts`.
        fasteners: objects with `parts`, `at` (m), `tension` (N) and perhaps `shear` (N), `axis` and `ductile`.
    """
    source = Path(path)
    described = read_description(source)
    draft = described_draft(source, described, unit)
    if unit is None and not draft.says_unit and not described_by(source).is_file():
        _ask_for_unit(draft)
    own = described.get("boundary") if boundary is None else None
    if own is not None:  # wrong names are of the file, not of an option
        part_ids(own, draft.names, f"{described_by(source)}: boundary")
    assembly = draft.assemble(
        density=described.get("density") if density is None else density,
        friction=described.get("friction") if friction is None else friction,
        boundary=own if boundary is None else boundary,
        ground=ground,
        contact_settings=described["contact"] if contact_settings is None else contact_settings,
        settle=described.get("settle") if settle is None else settle,
        name=described.get("name"),
    )
    given = {"loads": loads, "earthquake": earthquake, "materials": materials, "joints": joints, "fasteners": fasteners}
    acting = {name: described.get(name) if value is None else value for name, value in given.items()}
    return furnish(assembly, **acting)


def _ask_for_unit(draft: Draft) -> None:
    """Warn where parts that were read in metres, since nothing says their unit, have an unlikely size."""
    size = float(np.median(part_sizes(draft)))
    if likely := likely_units(size, draft.scale):
        warn_of(
            draft.path,
            f"nothing says the unit; in metres, as it was read, a typical part is {format_quantity(size, 'length')} "
            f"long: give --unit {' or '.join(likely)}, or --unit m if that is right",
        )


def described_draft(source: Path, described: Mapping[str, Any], unit: str | None = None) -> Draft:
    """Read the parts of a folder or file of meshes, unchecked, with the unit and names of its description.

    Args:
        described: what `read_description` returns.
        unit: in place of the unit of the description.
    """
    draft = Draft.from_meshes(source, described.get("unit") if unit is None else unit)
    count = described.get("parts", len(draft.blocks))
    if count != len(draft.blocks):
        raise AssemblyError(
            f"{source} has {len(draft.blocks)} meshes, but {FILE} says {count} parts; ids are missing or extra"
        )
    names = described.get("names")
    if names is None:
        return draft
    if len(names) != len(draft.blocks) or len(set(names)) != len(names):
        raise AssemblyError(f"names in {FILE} must be {len(draft.blocks)} different ones, one a part; mend {source}")
    return draft.renamed(names)


def save_assembly(assembly: Assembly, folder: str | Path) -> Path:
    """Write an assembly as a folder that `load_assembly` reads back with the same identity.

    The folder is written under a temporary name and renamed, so that it is complete or absent. An
    assembly that is already there is replaced.
    """
    if not isinstance(assembly, Assembly):
        raise InputError(f"save_assembly writes an Assembly, not {type(assembly).__name__}; load_structure makes one")
    for name, count in Counter(assembly.names).items():
        if count > 1 or not name.strip():  # no file may hold such names
            parts = "parts have" if count > 1 else "part has"
            raise InputError(f"{count} {parts} the name {name!r}; give each one of its own, then save {assembly.name}")
    target = Path(folder).resolve()  # links stay
    if assembly.contacts_given:
        raise InputError(f"{assembly.name} has given contacts, which a folder of meshes cannot keep; find them instead")
    if target.exists() and not (target.is_dir() and (not any(target.iterdir()) or (target / FILE).is_file())):
        raise InputError(f"{target} exists and is not an assembly; choose another folder")
    if assembly.props:
        raise InputError(f"{assembly.name} has props, which {FILE} cannot express; save it without (keep_props)")
    if groups_of(assembly) is not None:
        raise InputError(f"{assembly.name} has joined parts; save the loose ones, and join them where they are loaded")
    if assembly.joints is not None:
        raise InputError(f"{assembly.name} has joints, which belong to its contacts; write them into {FILE} by hand")
    density = assembly.density
    description: dict[str, Any] = {
        "format": FORMAT,
        "name": assembly.name,
        "unit": "m",
        "density": float(density[0]) if (density == density[0]).all() else density.tolist(),
        "friction": assembly.friction,
        "boundary": np.flatnonzero(assembly.boundary).tolist(),
        "parts": assembly.part_count,
        "contact": asdict(assembly.contact_settings),
    }
    if assembly.names != tuple(str(part) for part in range(assembly.part_count)):
        description["names"] = list(assembly.names)
    if assembly.loads is not None:
        description |= assembly.loads.describe()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as scratch:
            fresh = Path(scratch) / "new"
            fresh.mkdir()
            for part, mesh in enumerate(assembly.meshes):
                (fresh / f"{part}.obj").write_text(obj_text(mesh), encoding="utf-8")
            (fresh / FILE).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
            if target.exists():
                target.rename(Path(scratch) / "old")
            fresh.rename(target)
            shutil.rmtree(Path(scratch) / "old", ignore_errors=True)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    return Path(folder)


def described_by(source: Path) -> Path:
    """Return the path of `assembly.json` in a folder or beside a file."""
    return (source if source.is_dir() else source.parent) / FILE


def read_description(source: Path) -> dict[str, Any]:
    """Read `assembly.json` in a folder or beside a file, with types checked; `contact` becomes `ContactSettings`."""
    file = described_by(source)
    described: dict[str, Any] = {}
    if file.is_file():
        try:
            described = parse_json(read_text(file))
        except (OSError, ValueError) as error:
            raise AssemblyError(f"cannot read {file}: {error}; write it again") from error
        if not isinstance(described, dict):
            raise AssemblyError(
                f"{file} holds a {type(described).__name__}; expected an object with name, boundary, ..."
            )
        version = described.get("format", FORMAT)
        if version != FORMAT:
            raise AssemblyError(f"{file} is of format {version!r}; this version reads {FORMAT!r}")
        known = AssemblyFile.__struct_fields__
        unknown = sorted(set(described) - set(known) - _NOTES)
        for key in unknown:
            if near := get_close_matches(key, known, n=1, cutoff=_ALIKE):
                raise AssemblyError(f"{file} has the entry {key!r}, which is unknown; write {near[0]!r}")
        if unknown:
            warn_of(file, f"entries that are not known have no effect: {listed(unknown)}")
        described = {key: value for key, value in described.items() if key in known and value is not None}
        read_model(AssemblyFile, described, f"{file}: ", AssemblyError)
    described["contact"] = ContactSettings(**described.get("contact", {}))
    return described


def _write_folder(assembly: Assembly, path: str | Path, _: None) -> None:
    save_assembly(assembly, path)


EXPORTER = Exporter(_write_folder, (FOLDER,), complete=True)

"""Diagnosis of the files of a structure, part by part, whether or not it loads."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from falsework.assembly.draft import Block, Draft
from falsework.assembly.interfaces import InterfaceComparison, compare_interfaces, interface_contacts
from falsework.assembly.load import LOAD_OPTIONS, check_meshes_path, described_options, read_draft
from falsework.assembly.model import Assembly
from falsework.assembly.store import read_description
from falsework.errors import AssemblyError, InputError, MeshError
from falsework.geometry.contact.interfaces import ContactSettings, exact_contacts, find_contacts
from falsework.geometry.contact.joints import depths_beyond, find_joints
from falsework.geometry.contact.overlap import Overlaps, depth, find_overlaps
from falsework.geometry.mesh.collision import nearest
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.obj import read_obj
from falsework.geometry.mesh.read import SUFFIXES, UNITS, load_meshes, natural_key, unit_length
from falsework.geometry.mesh.repair import check_mesh, thicken_supports

_TINY = 1e-3
"""Volume below which a part is doubtful, as a share of the median."""
_SAME = 1e-6
"""Distance of the bounds of duplicates, as a share of a part's size."""
_SIZES = (0.02, 5.0)
"""Smallest and largest size of a typical part that raises no doubt about the unit, metres."""


@dataclass(frozen=True)
class PartReport:
    """Findings on one part."""

    part: int
    name: str
    size: float
    """Diagonal of its bounding box, metres."""
    volume: float | None
    """m3; None for a part that bounds no solid."""
    boundary: bool
    mended: str
    """Repairs of its mesh; empty for none."""
    doubts: tuple[str, ...]
    """Doubts about it."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Findings on a structure."""

    path: str
    error: str
    """Reason why it does not load, in one line; empty if it loads."""
    remarks: tuple[str, ...]
    """Doubts about the whole structure, and repairs of it."""
    unit: str
    """Likely unit of the coordinates; empty where the present one raises no doubt."""
    parts: tuple[PartReport, ...]
    contacts: int
    """Contacts of the structure; of one that does not load, those of the pairs of parts that can be judged."""
    stored: InterfaceComparison | None
    """Differences between the stored interfaces and the contacts; None if there are none, or the structure does not
    load."""
    additions: dict[str, Any]
    """Entries to add to `assembly.json`; empty if there are none."""
    cured: bool
    """Whether the structure loads with these entries."""
    draft: Draft | None
    """The parts as in the files; None if they cannot be read."""

    @property
    def loads(self) -> bool:
        """Whether the structure can be used as it is."""
        return not self.error

    @property
    def doubtful(self) -> tuple[PartReport, ...]:
        """Parts with a doubt."""
        return tuple(report for report in self.parts if report.doubts)

    def line(self) -> str:
        """Return the entries for `assembly.json` as text, without braces."""
        return json.dumps(self.additions)[1:-1]

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values, without the meshes of the parts."""
        return {
            "path": self.path,
            "loads": self.loads,
            "error": self.error or None,
            "remarks": list(self.remarks),
            "unit": self.unit or None,
            "contacts": self.contacts,
            "stored_interfaces": self.stored.to_dict() if self.stored else None,
            "add": self.additions,
            "loads_with_it": self.cured,
            "parts": [asdict(report) for report in self.parts],
        }


def diagnose(path: str | Path, unit: str | None = None) -> Diagnosis:
    """Examine a folder or file of parts, and collect all errors instead of stopping at the first.

    Args:
        path: folder or file, as for `load_structure`.
        unit: unit of the coordinates; that of `assembly.json` or the file if not given.

    Raises:
        InputError: no such path, or an unknown unit.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"there is no {path}; give a folder of meshes or a file with the parts")
    if unit is not None:
        unit_length(unit)
    try:
        draft, options = _read(path, unit)
    except InputError as error:
        return Diagnosis(str(path), str(error), (), "", (), 0, None, {}, False, None)
    solids, mended, errors = _solids(draft, options.get("boundary"))
    size = np.array([np.linalg.norm(np.ptp(block.vertices, axis=0)) * draft.scale for block in draft.blocks])
    doubts: list[list[str]] = [[error] if error else [] for error in errors]
    _compare_parts(solids, doubts)
    assembly, error, remarks = _load(draft, options)
    error = error if assembly is None else ""
    fixed = assembly.boundary if assembly is not None else _boundary(draft, options)
    additions: dict[str, Any] = {}
    if assembly is not None:
        count, stored = len(assembly.contacts), None
        if draft.interfaces:
            try:
                stored = compare_interfaces(interface_contacts(assembly.meshes, draft.interfaces), assembly.contacts)
            except AssemblyError as reason:
                remarks.append(str(reason))
    else:
        stored = None
        settings = options.get("contact_settings") or ContactSettings()
        count = _contacts(solids, settings, fixed, doubts)
        fitted = replace(settings, gap=None, overlap=None)
        if settings != fitted and _load(draft, {**options, "contact_settings": fitted})[0] is not None:
            remarks.append("it loads without the lengths gap and overlap of its contacts: joints are then fitted")
        if not fixed.any():
            remarks.append("no part is boundary")
            additions["boundary"] = _lowest(draft)
        if draft.interfaces and _load(draft, {**options, "interfaces": "stored"})[0] is not None:
            remarks.append(f"it loads with its {len(draft.interfaces)} stored interfaces (--interfaces stored)")
    likely = "" if path.suffix.lower() in (".3dm", ".step", ".stp") else _unit(float(np.median(size)), draft.scale)
    if likely:
        remarks.append(f"a typical part is {np.median(size):.3g} m long; the unit may be {likely}")
        additions = {"unit": likely, **{key: value for key, value in additions.items() if key == "boundary"}}
    cured = False
    if additions:
        scaled = replace(draft, scale=unit_length(likely)) if likely else draft
        fixing = {"boundary": additions["boundary"]} if "boundary" in additions else {}
        cured = _load(scaled, {**options, **fixing})[0] is not None
    reports = tuple(
        PartReport(
            number,
            block.name,
            float(size[number]),
            None if (solid := solids[number]) is None else solid.volume,
            bool(fixed[number]),
            mended[number],
            tuple(doubts[number]),
        )
        for number, block in enumerate(draft.blocks)
    )
    return Diagnosis(str(path), error, tuple(remarks), likely, reports, count, stored, additions, cured, draft)


def _read(path: Path, unit: str | None) -> tuple[Draft, dict[str, Any]]:
    """Return the unchecked parts of a structure, and the options in its description."""
    options = described_options(path) if path.is_file() else {}
    if unit is not None:
        options["unit"] = unit
    chosen = options.pop("unit", None)
    draft = read_draft(path, chosen)
    if draft is not None:
        return draft, {key: value for key, value in options.items() if key not in LOAD_OPTIONS}
    check_meshes_path(path)
    described = read_description(path)
    chosen = unit or described.get("unit", "m")
    options = {key: described[key] for key in ("density", "friction", "boundary") if key in described}
    options["contact_settings"] = described["contact"]
    return Draft.of(path, unit_length(chosen), _mesh_blocks(path)), options


def _mesh_blocks(path: Path) -> list[Block]:
    """Return the parts of a folder or file of meshes; of a file other than OBJ only whole solids can be told apart."""
    if path.is_file():
        objects = read_obj(path) if path.suffix.lower() == ".obj" else []
        if len(objects) > 1:
            return [Block(name, vertices, faces.tolist()) for name, vertices, faces in objects]
        return [Block(mesh.name, mesh.vertices, mesh.faces.tolist()) for mesh in load_meshes(path)]
    files = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()]
    if not files:
        raise InputError(f"no mesh in {path}; put one file per part there ({', '.join(SUFFIXES)})")
    if len(files) == 1:
        return _mesh_blocks(files[0])
    return [_one_block(file) for file in sorted(files, key=lambda file: natural_key(file.stem))]


def _one_block(file: Path) -> Block:
    """Return all objects of a file as one part; a part without faces if it cannot be read."""
    try:
        if file.suffix.lower() == ".obj":
            objects = [(vertices, faces) for _, vertices, faces in read_obj(file)]
        else:
            objects = [(mesh.vertices, mesh.faces) for mesh in load_meshes(file)]
    except MeshError as error:
        return Block(file.stem, np.zeros((1, 3)), [], attributes={"error": str(error)})
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in objects)])
    faces = [face for first, (_, some) in zip(starts, objects, strict=False) for face in (some + first).tolist()]
    return Block(file.stem, np.concatenate([vertices for vertices, _ in objects]), faces)


def _solids(draft: Draft, boundary: Any) -> tuple[list[TriangleMesh | None], list[str], list[str]]:
    """Return the mesh of each part or None, its repairs, and its errors."""
    none = np.zeros((0, 3))
    surfaces: list[tuple[str, np.ndarray, np.ndarray]] = []
    errors = []
    for block in draft.blocks:
        try:
            surface, error = block.triangles(draft.scale), ""
        except MeshError as reason:
            surface, error = (block.name, none, none.astype(np.int64)), str(block.attributes.get("error", reason))
        surfaces.append(surface)
        errors.append(error)
    solids: list[TriangleMesh | None] = []
    mended = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        whole = thicken_supports(surfaces, draft.supports(boundary))
        for part, (before, after) in enumerate(zip(surfaces, whole, strict=True)):
            caught.clear()
            try:
                solids.append(None if errors[part] else check_mesh(*after))
            except MeshError as reason:
                solids.append(None)
                errors[part] = str(reason)
            done = [str(warning.message).split(": ", 1)[-1] for warning in caught]
            mended.append("; ".join([*(["given a thickness"] if after is not before else []), *done]))
    names = [block.name for block in draft.blocks]
    shortened = (
        error.removeprefix(f"part {name} ").removeprefix(f"part {name}: ")
        for name, error in zip(names, errors, strict=True)
    )
    return solids, mended, list(shortened)


def _compare_parts(solids: Sequence[TriangleMesh | None], doubts: list[list[str]]) -> None:
    """Note parts that are tiny compared with the others, and duplicates."""
    there = [number for number, solid in enumerate(solids) if solid is not None]
    meshes = [solid for solid in solids if solid is not None]
    if not meshes:
        return
    volume = np.array([mesh.volume for mesh in meshes])
    for row in np.flatnonzero(volume < _TINY * np.median(volume)).tolist():
        doubts[there[row]].append(f"is tiny: {volume[row]:.3g} m3, where a typical part has {np.median(volume):.3g} m3")
    corners = np.array([mesh.bounds.ravel() for mesh in meshes])
    reach = _SAME * float(np.median(np.linalg.norm(corners[:, 3:] - corners[:, :3], axis=1)))
    for i, j in sorted(KDTree(corners).query_pairs(reach)):
        if abs(volume[i] - volume[j]) <= 1e-6 * volume[i]:
            doubts[there[j]].append(f"is a duplicate of part {meshes[i].name}")


def _load(draft: Draft, options: dict[str, Any]) -> tuple[Assembly | None, str, list[str]]:
    """Return the assembly or why there is none, and the warnings that do not concern the mesh of one part."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            assembly, error = draft.assemble(**options), ""
        except InputError as reason:
            assembly, error = None, str(reason)
    texts = dict.fromkeys(str(warning.message) for warning in caught)
    return assembly, error, [text for text in texts if " was repaired: " not in text]


def _boundary(draft: Draft, options: dict[str, Any]) -> np.ndarray:
    """Return the mask of the parts that the files name as boundary, as far as these exist."""
    fixed = np.array([block.support for block in draft.blocks])
    if "boundary" in options:
        names = {block.name: number for number, block in enumerate(draft.blocks)}
        ids = [names.get(item, -1) if isinstance(item, str) else item for item in options["boundary"]]
        fixed[:] = False
        fixed[[number for number in ids if 0 <= number < len(fixed)]] = True
    return fixed


def _contacts(
    solids: Sequence[TriangleMesh | None], settings: ContactSettings, fixed: np.ndarray, doubts: list[list[str]]
) -> int:
    """Note pairs that overlap and parts without a contact; return the number of contacts."""
    there = [number for number, solid in enumerate(solids) if solid is not None]
    meshes = [solid for solid in solids if solid is not None]
    if not meshes:
        return 0
    gap, overlap = settings.lengths(meshes)
    overlaps = find_overlaps(meshes, overlap, corner=settings.corner)
    depths = _depths(meshes, overlaps, settings, max(gap, overlap))
    for (i, j), deep in zip(overlaps.parts.tolist(), depths.tolist(), strict=True):
        if deep:
            for one, other in ((i, j), (j, i)):
                doubts[there[one]].append(f"passes through part {meshes[other].name} by {1000 * deep:.3g} mm")
    touching = np.zeros(len(meshes), dtype=bool)
    touching[overlaps.parts] = True
    try:
        contacts = exact_contacts(meshes, settings) if depths.any() else find_contacts(meshes, settings)
    except AssemblyError:  # an overlap whose depth was underestimated
        contacts = exact_contacts(meshes, settings)
    touching[contacts.parts] = True
    for row in np.flatnonzero(~touching & ~fixed[there]).tolist():
        other, away = nearest(row, meshes)
        where = f"; part {meshes[other].name} is nearest, {1000 * away:.3g} mm away" if other >= 0 else ""
        doubts[there[row]].append(f"touches no other part{where}")
    return len(contacts)


def _depths(
    meshes: Sequence[TriangleMesh], overlaps: Overlaps, settings: ContactSettings, tolerance: float
) -> np.ndarray:
    """Return the depth of each overlap that is deeper than allowed, zero for the others, shape (pairs,), metres."""
    first, second = overlaps.parts.T
    if not (settings.gap is None and settings.overlap is None):
        deep = np.array([depth(meshes[a], meshes[b]) for a, b in overlaps.parts.tolist()])
        return np.where(deep > overlaps.limit, deep, 0.0)
    among = np.zeros((len(meshes), len(meshes)), dtype=bool)
    among[first, second] = True
    bound = find_joints(meshes, among, settings.curvature, 2 * tolerance).bound
    return depths_beyond(meshes, overlaps, bound[first, second])


def _lowest(draft: Draft) -> list[int]:
    """Return the parts that reach down to the lowest level."""
    low = np.array([block.vertices[:, 2].min() for block in draft.blocks])
    high = max(block.vertices[:, 2].max() for block in draft.blocks)
    return np.flatnonzero(low <= low.min() + 0.01 * (high - low.min())).tolist()


def _unit(size: float, scale: float) -> str:
    """Return the unit in which a typical part has a likely size; empty if it has one already."""
    if _SIZES[0] <= size <= _SIZES[1]:
        return ""
    lengths = {unit: size / scale * length for unit, length in UNITS.items()}
    likely = [unit for unit in ("mm", "cm", "m", "in", "ft", "dm") if _SIZES[0] <= lengths[unit] <= _SIZES[1]]
    return likely[0] if likely else ""

"""Diagnosis of the files of a structure, part by part, whether or not it loads."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falsework.assembly.draft import Draft
from falsework.assembly.fasteners import furnish
from falsework.assembly.findings import (
    compare_parts,
    inclination_findings,
    likely_units,
    lowest,
    material_findings,
    part_sizes,
    support_findings,
    upright_finding,
)
from falsework.assembly.interfaces import InterfaceComparison, compare_interfaces, interface_contacts
from falsework.assembly.load import LOAD_OPTIONS, check_given, check_meshes_path, described_options, read_draft
from falsework.assembly.model import Assembly
from falsework.assembly.store import described_draft, read_description
from falsework.errors import AssemblyError, InputError, MeshError, ReadWarning
from falsework.geometry.contact.interfaces import Contacts, ContactSettings, exact_contacts, find_contacts
from falsework.geometry.contact.joints import deepest_of_joints, depths_beyond, find_joints
from falsework.geometry.contact.overlap import Overlaps, coarse_depth, depth, find_overlaps
from falsework.geometry.mesh.collision import nearest
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.read import unit_length
from falsework.geometry.mesh.repair import check_mesh, thicken_supports
from falsework.utils.files.formats import reader_of
from falsework.utils.quantity import format_quantity

_MANY = 2000
"""Faces of a pair of parts from which the depth of an overlap is measured at vertices and on a coarse grid."""
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns y to z."""
_HAVE_UNITS = {".3dm", ".step", ".stp", ".glb", ".gltf", ".ldr", ".mpd", ".txt"}
"""Files that say their unit."""


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
    repairs: str
    """Repairs of its mesh; empty for none."""
    findings: tuple[str, ...]
    """Findings about it."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values, with units in names."""
        record = asdict(self)
        return {"size_m": record.pop("size"), "volume_m3": record.pop("volume"), **record}


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Findings on a structure."""

    path: str
    error: str
    """Reason why it does not load, in one line; empty if it loads."""
    remarks: tuple[str, ...]
    """Findings about the whole structure, and repairs of it."""
    units: tuple[str, ...]
    """Likely units of the coordinates; empty where the present one raises no finding. With one alone, all but `error`
    is said of parts with this unit."""
    parts: tuple[PartReport, ...]
    contacts: int
    """Contacts of the structure; of one that does not load, those of the pairs of parts that can be judged."""
    stored: InterfaceComparison | None
    """Differences between the stored interfaces and the contacts; None if there are none, or if it does not load."""
    additions: dict[str, Any]
    """Entries to add to `assembly.json`; empty if there are none."""
    cured: bool
    """Whether the structure loads with these entries."""
    draft: Draft | None
    """The parts as in the files; None if they cannot be read."""

    def __repr__(self) -> str:
        return f"<Diagnosis of {self.path}: {len(self.parts)} parts, {self.error or 'it loads'}>"

    @property
    def loads(self) -> bool:
        """Whether the structure can be used as it is."""
        return not self.error

    @property
    def extent(self) -> tuple[float, float, float]:
        """Size along x, y and z of all parts together, metres; zeros where there are none."""
        blocks = [] if self.draft is None else [block.vertices for block in self.draft.blocks if len(block.vertices)]
        if not blocks or self.draft is None:
            return 0.0, 0.0, 0.0
        x, y, z = (np.ptp(np.concatenate(blocks), axis=0) * self.draft.scale).tolist()
        return x, y, z

    @property
    def doubtful(self) -> tuple[PartReport, ...]:
        """Parts with a finding."""
        return tuple(report for report in self.parts if report.findings)

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
            "unit": self.units[0] if len(self.units) == 1 else None,
            "contacts": self.contacts,
            "extent_m": list(self.extent),
            "stored_interfaces": self.stored.to_dict() if self.stored else None,
            "add": self.additions,
            "loads_with_it": self.cured,
            "parts": [report.to_dict() for report in self.parts],
        }


def doctor(
    path: str | Path, unit: str | None = None, *, stands: Callable[[Assembly], bool] | None = None, **options: Any
) -> Diagnosis:
    """Examine a folder or file of parts, and collect all errors instead of stopping at the first.

    Args:
        path: folder or file, as for `load_structure`.
        unit: unit of the coordinates; that of `assembly.json` or the file if not given.
        stands: tells whether a complete structure stands, to find out which way is up; not asked without it.
        options: others of `load_structure`, such as boundary, ground, density and friction.

    Raises:
        InputError: no such path, or an unknown unit.
    """
    path = Path(check_given(doctor, path, options))
    if not path.exists():
        raise InputError(f"there is no folder or file {path}, and built-in structures need no doctor; give meshes")
    unit_length(unit or "m")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            draft, described = _read(path, unit)
        except InputError as error:
            return Diagnosis(str(path), str(error), (), (), (), 0, None, {}, False, None)
    given = {name: value for name, value in options.items() if value is not None}
    options = {**described, **given}
    size = part_sizes(draft)
    middle = float(np.median(size))
    likely = [] if path.suffix.lower() in _HAVE_UNITS else likely_units(middle, draft.scale)
    if len(likely) == 1:  # what else is found and proposed, parts of this size have
        found = doctor(path, likely[0], stands=stands, **given)
        typical = format_quantity(middle, "length")
        remark = f"a typical part would be {typical} long: the unit is taken to be {likely[0]}"
        return replace(
            found,
            error=_load(draft, options)[1],
            remarks=(remark, *found.remarks),
            units=(likely[0],),
            additions={"unit": likely[0], **found.additions},
            cured=found.cured if found.additions else found.loads,
        )
    solids, repairs, errors, notes = _solids(draft, options.get("boundary"))
    findings = [[*([error] if error else []), *more] for error, more in zip(errors, notes, strict=True)]
    compare_parts(solids, findings)
    # Parts are judged where they are modelled, on no ground, although the structure may load if they settle on one.
    supports = draft.supports(options.get("boundary"))
    assembly, error, remarks = _load(draft, {"settle": 0.0, **options, "boundary": supports})
    if error:
        _, error, remarks = _load(draft, options)
    remarks = list(dict.fromkeys(str(warning.message) for warning in caught) | dict.fromkeys(remarks))
    fixed = np.zeros(len(draft.blocks), dtype=bool)
    fixed[supports] = True
    additions, stored = dict[str, Any](), None
    if assembly is not None:
        contacts: Contacts | None = assembly.contacts
        if draft.interfaces:
            try:
                stored = compare_interfaces(interface_contacts(assembly.meshes, draft.interfaces), assembly.contacts)
            except AssemblyError as reason:
                remarks.append(str(reason))
    else:
        settings = options.get("contact_settings") or ContactSettings()
        contacts = _contacts(solids, settings, fixed, findings)
        fitted = replace(settings, gap=None, overlap=None)
        if settings != fitted and _load(draft, {**options, "contact_settings": fitted})[0] is not None:
            remarks.append("it loads without the lengths gap and overlap of its contacts: joints are then fitted")
        if draft.interfaces and _load(draft, {**options, "interfaces": "stored"})[0] is not None:
            remarks.append(f"it loads with its {len(draft.interfaces)} stored interfaces (--interfaces stored)")
    lying = ""
    if stands is not None and None not in solids and len(solids) > 1:
        known = assembly if assembly is not None and not options.get("ground") else None
        upright = stands(known) if known is not None and not fixed.all() else _stands(draft, solids, options, stands)
        lying = upright_finding(upright, lambda: _stands(draft, solids, options, stands, _Y_UP), contacts)
    remarks += material_findings(draft, options, assembly)
    remarks += inclination_findings(draft.names if assembly is None else assembly.names, contacts)
    remarks += [lying] if lying else []
    if fixed.any() and (fixed.all() or not options.get("ground")):
        remarks += support_findings(draft, solids, fixed)
    elif not options.get("ground"):
        remarks.append("no part is boundary")
        low = lowest(solids)
        if 0 < len(low) < len(solids) and not lying:
            names = [draft.names[part] for part in low]  # which stay when a file is added
            additions["boundary"] = low if any(name.isdecimal() for name in names) else names
        else:
            remarks.append("which parts are fixed cannot be seen: name them (--boundary), or put a --ground under all")
    if likely:
        typical = format_quantity(middle, "length")
        remarks.append(f"a typical part is {typical} long; the unit may be {' or '.join(likely)}")
    cured = bool(additions) and _load(draft, {**options, **additions})[0] is not None
    reports = tuple(
        PartReport(
            number,
            block.name,
            float(size[number]),
            None if (solid := solids[number]) is None else solid.volume,
            bool(fixed[number]),
            repairs[number],
            tuple(findings[number]),
        )
        for number, block in enumerate(draft.blocks)
    )
    return Diagnosis(
        path=str(path),
        error=error,
        remarks=tuple(remarks),
        units=tuple(likely),
        parts=reports,
        contacts=0 if contacts is None else len(contacts),
        stored=stored,
        additions=additions,
        cured=cured,
        draft=draft,
    )


def _read(path: Path, unit: str | None) -> tuple[Draft, dict[str, Any]]:
    """Return the unchecked parts of a structure, and the options in its description."""
    options = described_options(path) if path.is_file() or reader_of(path) is not None else {}
    chosen = options.pop("unit", None) if unit is None else unit
    draft = read_draft(path, chosen)
    if draft is None:
        check_meshes_path(path)
        described = read_description(path)
        draft = described_draft(path, described, unit)
        names = ("density", "friction", "boundary", "settle", *LOAD_OPTIONS)
        options = {name: described[name] for name in names if name in described}
        options["contact_settings"] = described["contact"]
    options.pop("unit", None)
    return draft, options


def _solids(draft: Draft, boundary: Any) -> tuple[list[TriangleMesh | None], list[str], list[str], list[list[str]]]:
    """Return the mesh of each part or None, its repairs, its error, and other findings about it."""
    none = np.zeros((0, 3))
    surfaces: list[tuple[str, np.ndarray, np.ndarray]] = []
    errors = []
    for block in draft.blocks:
        try:
            surface, error = block.triangles(draft.scale), ""
        except MeshError as reason:
            surface, error = (block.name, none, none.astype(np.int64)), str(reason)
        surfaces.append(surface)
        errors.append(error)
    solids: list[TriangleMesh | None] = []
    repairs, notes = [], []
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
            read = [warning for warning in caught if issubclass(warning.category, ReadWarning)]
            done = [str(warning.message).split(": ", 1)[-1] for warning in caught if warning not in read]
            repairs.append("; ".join([*(["given a thickness"] if after is not before else []), *done]))
            notes.append([_of_part(str(warning.message), draft.names[part]) for warning in read])
    errors = [_of_part(error, name) for error, name in zip(errors, draft.names, strict=True)]
    return solids, repairs, errors, notes


def _of_part(text: str, name: str) -> str:
    """Return a message on a part without the name of the part."""
    return text.removeprefix(f"part {name} ").removeprefix(f"part {name}: ")


def _stands(
    draft: Draft,
    solids: Sequence[TriangleMesh | None],
    options: dict[str, Any],
    stands: Callable[[Assembly], bool],
    turn: np.ndarray = np.eye(3),
) -> bool | None:
    """Return whether the parts, once turned, stand on those that are boundary, or if none is, on the lowest.

    None if that are all, or if they do not load so.
    """
    blocks = tuple(replace(block, vertices=block.vertices @ turn.T) for block in draft.blocks)
    turned = [solid and replace(solid, vertices=solid.vertices @ turn.T) for solid in solids]
    fixed = draft.supports(options.get("boundary")) or lowest(turned)
    others = {"boundary": fixed, "ground": False, "interfaces": "found", "settle": options.get("settle", 0.0)}
    assembly = _load(replace(draft, blocks=blocks, interfaces=()), {**options, **others})[0]
    return None if assembly is None or len(fixed) == len(blocks) else stands(assembly)


def _load(draft: Draft, options: dict[str, Any]) -> tuple[Assembly | None, str, list[str]]:
    """Return the assembly or why there is none, and the warnings that do not concern the mesh of one part."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            acting = {name: options.get(name) for name in LOAD_OPTIONS}
            given = {name: value for name, value in options.items() if name not in LOAD_OPTIONS}
            assembly, error = furnish(draft.assemble(**given), **acting), ""
        except InputError as reason:
            assembly, error = None, str(reason)
    texts = dict.fromkeys(str(warning.message) for warning in caught)
    of_parts = re.compile(r"parts? .* ((was|were) repaired: |consists of )")  # told of the parts
    return assembly, error, [text for text in texts if not of_parts.match(text)]


def _contacts(
    solids: Sequence[TriangleMesh | None], settings: ContactSettings, fixed: np.ndarray, findings: list[list[str]]
) -> Contacts | None:
    """Note pairs that overlap and parts without a contact; return the contacts, None if no part is a solid.

    Parts of the contacts are numbered as in `solids`.
    """
    there = [number for number, solid in enumerate(solids) if solid is not None]
    meshes = [solid for solid in solids if solid is not None]
    if not meshes:
        return None
    gap, overlap = settings.lengths(meshes)
    overlaps = find_overlaps(meshes, overlap, corner=settings.corner)
    depths = _depths(meshes, overlaps, settings, max(gap, overlap))
    for (i, j), deep in zip(overlaps.parts.tolist(), depths.tolist(), strict=True):
        if deep:
            for one, other in ((i, j), (j, i)):
                findings[there[one]].append(
                    f"passes through part {meshes[other].name} by {format_quantity(float(deep), 'length')}"
                )
    touching = np.zeros(len(meshes), dtype=bool)
    touching[overlaps.parts] = True
    try:
        contacts = exact_contacts(meshes, settings) if depths.any() else find_contacts(meshes, settings)
    except AssemblyError:  # an overlap whose depth was underestimated
        contacts = exact_contacts(meshes, settings)
    touching[contacts.parts] = True
    for row in np.flatnonzero(~touching & ~fixed[there]).tolist():
        other, away = nearest(row, meshes)
        where = f"; part {meshes[other].name} is nearest, {format_quantity(away, 'length')} away" if other >= 0 else ""
        findings[there[row]].append(f"touches no other part{where}")
    return replace(contacts, parts=np.asarray(there, dtype=np.int32)[contacts.parts])


def _depths(
    meshes: Sequence[TriangleMesh], overlaps: Overlaps, settings: ContactSettings, tolerance: float
) -> np.ndarray:
    """Return the depth of each overlap that is deeper than allowed, zero for the others, shape (pairs,), metres."""
    first, second = overlaps.parts.T
    if not (settings.gap is None and settings.overlap is None):
        deep = np.array([depth(meshes[a], meshes[b]) for a, b in overlaps.parts.tolist()])
        return np.where(deep > overlaps.limit, deep, 0.0)
    # Joints of pairs that are deeper than any joint may be would take minutes to find where these have many faces.
    most = deepest_of_joints(meshes, overlaps)
    deep, rest = np.zeros(len(most)), []
    for row, (a, b) in enumerate(overlaps.parts.tolist()):
        found = coarse_depth(meshes[a], meshes[b], float(most[row]))
        if found <= most[row]:
            rest.append(row)
        else:
            deep[row] = depth(meshes[a], meshes[b]) if len(meshes[a].faces) + len(meshes[b].faces) < _MANY else found
    if rest:
        among = np.zeros((len(meshes),) * 2, dtype=bool)
        among[first[rest], second[rest]] = True
        bound = find_joints(meshes, among, settings.curvature, 2 * tolerance).bound
        others = Overlaps(overlaps.parts[rest], overlaps.limit[rest], overlaps.layer[rest])
        deep[rest] = depths_beyond(meshes, others, bound[first[rest], second[rest]])
    return deep

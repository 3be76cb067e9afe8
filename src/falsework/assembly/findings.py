"""Findings about a structure as a whole: its unit, materials, supports, and which way is up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from falsework.assembly.draft import Draft
from falsework.assembly.model import Assembly
from falsework.assembly.touching import inclinations
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.read import UNITS
from falsework.utils.quantity import format_quantity, listed

_TINY = 1e-3
"""Volume below which a part is doubtful, as a share of the median."""
_SAME = 1e-6
"""Distance of the bounds of duplicates, as a share of a part's size."""
_SIZES = (0.02, 5.0)
"""Smallest and largest size of a typical part that raises no finding about the unit, metres."""
_DENSITIES = (100.0, 10_000.0)
"""Smallest and largest density that raises no finding, kg/m3."""
_FRICTION = 1.5
"""Largest coefficient of friction that raises no finding."""
_LEVEL = 0.01
"""Difference in height, as a share of that of the structure, up to which parts are level."""
_INCLINED = 1.0
"""Angle between faces that touch from which they are doubtful, degrees."""


def material_findings(draft: Draft, options: dict[str, Any], assembly: Assembly | None) -> list[str]:
    """Return findings about densities and friction."""
    if assembly is not None:
        return findings_on_materials(assembly, len(draft.blocks))
    density = np.ravel(options.get("density", [])).tolist()
    density = density or [block.attributes.get("density") for block in draft.blocks]
    return _material_findings(density, [options.get("friction")], draft.names)


def findings_on_materials(assembly: Assembly, parts: int | None = None) -> list[str]:
    """Return findings about the densities and the friction of a structure, or of its first parts."""
    frictions = [assembly.friction]
    if assembly.joints is not None:
        frictions += [value for value in assembly.joints.friction.tolist() if np.isfinite(value)]
    return _material_findings(assembly.density[:parts].tolist(), frictions, assembly.names)


def _material_findings(density: list[Any], frictions: list[Any], names: Sequence[str]) -> list[str]:
    findings = []
    for part, value in enumerate(density):
        if isinstance(value, (int, float)) and not _DENSITIES[0] <= value <= _DENSITIES[1]:
            of = f" of part {names[part]}" if len(set(density)) > 1 and part < len(names) else ""
            findings.append(f"the density{of} is {value:g} kg/m3, which no building material has; stone has about 2400")
            break
    high = max((value for value in frictions if isinstance(value, (int, float))), default=0.0)
    if high > _FRICTION:
        findings.append(f"a coefficient of friction is {high:g}; it is the tangent of an angle, 0.4 to 0.8 for stone")
    return findings


def inclination_findings(names: Sequence[str], contacts: Contacts | None) -> list[str]:
    """Return findings about pairs of parts whose faces touch without being parallel."""
    if contacts is None or contacts.lean is None:
        return []
    angles, pairs = inclinations(contacts), np.unique(contacts.parts, axis=0)
    worst = [row for row in np.argsort(-angles, kind="stable").tolist() if angles[row] > _INCLINED]
    if not worst:
        return []
    said = [
        f"{names[a]} and {names[b]} ({format_quantity(np.radians(angles[row]), 'angle', 2)})"
        for row in worst
        for a, b in [pairs[row]]
    ]
    return [
        f"faces that touch are inclined to each other, of parts {listed(said, noun='pairs')}: contacts bear what both "
        "faces would, so that half of the angle is lost to friction"
    ]


def support_findings(draft: Draft, solids: Sequence[TriangleMesh | None], fixed: np.ndarray) -> list[str]:
    """Return findings about the parts that are boundary."""
    if fixed.all():
        return ["every part is boundary: nothing can move, so every verdict is stable and every plan is empty"]
    low, level = _heights(solids)
    free = np.where(fixed | ~np.isfinite(low), np.inf, low)
    held = low[fixed & np.isfinite(low)]
    if len(held) and free.min() < held.min() - level:
        return [f"part {draft.names[int(np.argmin(free))]} reaches lower than every part that is boundary"]
    return []


def _heights(solids: Sequence[TriangleMesh | None]) -> tuple[np.ndarray, float]:
    """Return the lowest level of each part, NaN for one that is no solid, and the difference that is none, metres."""
    low = np.array([np.nan if solid is None else solid.bounds[0, 2] for solid in solids])
    high = max((solid.bounds[1, 2] for solid in solids if solid is not None), default=0.0)
    return low, _LEVEL * float(high - np.nanmin(low)) if np.isfinite(low).any() else 0.0


def lowest(solids: Sequence[TriangleMesh | None]) -> list[int]:
    """Return the parts that reach down to the lowest level."""
    low, level = _heights(solids)
    if not np.isfinite(low).any():
        return []
    return np.flatnonzero(low <= np.nanmin(low) + level).tolist()


def upright_finding(upright: bool | None, with_y_up: Callable[[], bool | None], contacts: Contacts | None) -> str:
    """Return the finding that a structure was made with y up.

    An arch on its side stands too: then no joint is inclined to the vertical, and with y up some are.

    Args:
        upright: whether it stands as it is; None if it has nothing to stand on, or all of it lies on the ground.
        with_y_up: the same with y up; called only where it is in doubt.
        contacts: of its parts, where they are known.
    """
    on_its_side = bool(upright) and contacts is not None and not _inclined(contacts, 2) and _inclined(contacts, 1)
    if (upright and not on_its_side) or not with_y_up():
        return ""
    if on_its_side:
        return (
            "it stands as it is, where all joints are level or upright, and with y up, where some are inclined as in "
            "an arch: if that is meant, export the model with z up"
        )
    now = "all parts lie on the ground or touch no other as it is" if upright is None else "it falls as it is"
    return f"{now}, but would stand with y up: export the model with z up"


def _inclined(contacts: Contacts, axis: int) -> bool:
    """Return whether a joint is neither level nor upright where an axis is vertical."""
    along, least = np.abs(contacts.normals[:, axis]), np.sin(np.radians(_INCLINED))
    return bool(((along > least) & (along < np.sqrt(1 - least**2))).any())


def part_sizes(draft: Draft) -> np.ndarray:
    """Return the diagonals of the boxes around the parts, shape (parts,), metres."""
    boxes = [np.ptp(block.vertices, axis=0) if len(block.vertices) else np.zeros(3) for block in draft.blocks]
    return np.linalg.norm(boxes, axis=1) * draft.scale


def likely_units(size: float, scale: float) -> list[str]:
    """Return the units in which a typical part has a likely size; none where it has one already."""
    if _SIZES[0] <= size <= _SIZES[1]:
        return []
    return [unit for unit in ("mm", "cm", "m", "in") if _SIZES[0] <= size / scale * UNITS[unit] <= _SIZES[1]]


def compare_parts(solids: Sequence[TriangleMesh | None], findings: list[list[str]]) -> None:
    """Note parts that are tiny compared with the others, and duplicates."""
    there = [number for number, solid in enumerate(solids) if solid is not None]
    meshes = [solid for solid in solids if solid is not None]
    if not meshes:
        return
    volume = np.array([mesh.volume for mesh in meshes])
    for row in np.flatnonzero(volume < _TINY * np.median(volume)).tolist():
        tiny, typical = (format_quantity(float(value), "volume") for value in (volume[row], np.median(volume)))
        findings[there[row]].append(f"is tiny: {tiny}, where a typical part has {typical}")
    corners = np.array([mesh.bounds.ravel() for mesh in meshes])
    reach = _SAME * float(np.median(np.linalg.norm(corners[:, 3:] - corners[:, :3], axis=1)))
    for i, j in sorted(KDTree(corners).query_pairs(reach)):
        if abs(volume[i] - volume[j]) <= 1e-6 * volume[i]:
            findings[there[j]].append(f"is a duplicate of part {meshes[i].name}")

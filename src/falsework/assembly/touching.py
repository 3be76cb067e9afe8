"""Parts that touch nothing, and pairs of parts that touch on less than a face."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.errors import AssemblyError, UntouchedPartError
from falsework.geometry.contact.interfaces import Contacts, ContactSettings, default_gap
from falsework.geometry.mesh.collision import nearest
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.quantity import format_number, format_quantity

_WARNED = 3
"""Pairs of parts that are named in warnings when an assembly is made; the rest is counted."""


class ContactWarning(UserWarning):
    """Contact that real parts may lack, such as along a line only."""


def warn_of(lines: Sequence[str]) -> None:
    """Warn of contacts that real parts may lack, where an assembly is made from meshes."""
    for line in lines[:_WARNED]:
        warnings.warn(line, ContactWarning, stacklevel=3)
    if len(lines) > _WARNED:
        more = len(lines) - _WARNED
        warnings.warn(
            f"{more} more pairs of parts touch along lines, on strips or at points only, or carry nothing",
            ContactWarning,
            stacklevel=3,
        )


def contact_warnings(
    meshes: Sequence[TriangleMesh], boundary: NDArray[np.bool_], contacts: Contacts, friction: float
) -> tuple[str, ...]:
    """Return one line for all joints that were resolved, and one for each pair that touches on less than a face.

    Also one for each pair whose faces are inclined by more than friction allows, so that it carries nothing.
    """
    names = [mesh.name for mesh in meshes]
    pairs, pair = np.unique(contacts.parts, axis=0, return_inverse=True)
    widest = np.zeros(len(pairs), dtype=np.int8)
    np.maximum.at(widest, pair.ravel(), contacts.dimension)
    width, narrow = np.zeros(len(pairs)), default_gap(meshes)
    np.maximum.at(width, pair.ravel(), contacts.width)
    lines = [contacts.report.line(names)] if len(contacts.report) else []
    least = inclinations(contacts, np.minimum)
    carries = np.zeros(len(pairs), dtype=bool)
    carries[pair.ravel()[contacts.contact_of_point[~contacts.idle(friction)]]] = True
    for number in np.flatnonzero(~carries & ~boundary[pairs].all(axis=1)).tolist():
        a, b = (names[part] for part in pairs[number].tolist())
        lines.append(
            f"faces of parts {a} and {b} are inclined to each other by "
            f"{format_quantity(np.radians(least[number]), 'angle', 2)} at least, more than "
            f"friction of {friction:g} holds on both: nothing is carried there"
        )
    for number in np.flatnonzero((width < narrow) & ~boundary[pairs].all(axis=1)).tolist():
        a, b = (names[part] for part in pairs[number].tolist())
        if widest[number] == 2:
            lines.append(
                f"parts {a} and {b} touch on a strip {format_quantity(width[number], 'length', 2)} wide: verdicts "
                f"may depend on it"
            )
            continue
        count = int(np.sum(pair.ravel() == number))
        where = ("at a point", "along a line")[widest[number]]
        if count > 1:
            where = ("at points", "along lines")[widest[number]]
        lines.append(f"parts {a} and {b} touch {where} only: verdicts may depend on it")
    return tuple(lines)


def inclinations(contacts: Contacts, of: np.ufunc = np.maximum) -> NDArray[np.float64]:
    """Return the angle between the faces of each pair of parts that touch, in order of the parts, degrees.

    Args:
        of: maximum or minimum over the contact points of a pair.
    """
    pairs, pair = np.unique(contacts.parts, axis=0, return_inverse=True)
    angles = np.full(len(pairs), 0.0 if of is np.maximum else np.inf)
    of.at(angles, pair.ravel()[contacts.contact_of_point], 2 * np.degrees(contacts.point_lean))
    return angles


def check_touching(
    meshes: Sequence[TriangleMesh],
    boundary: NDArray[np.bool_],
    contacts: Contacts,
    settings: ContactSettings,
    settled: float | None = None,
) -> None:
    """Raise for a part without contacts; boundary parts may stand alone, as obstacles do.

    Args:
        settled: length within which parts have settled, metres; None if they have not.
    """
    alone = ~boundary
    alone[contacts.parts.ravel()] = False
    if alone.any():
        part = int(np.argmax(alone))
        other, gap = nearest(part, meshes)
        touches = f"part {meshes[part].name} touches no other part"
        if other < 0:
            raise AssemblyError(f"{touches}, and there is none; add the parts that carry it")
        where = f"{touches}; part {meshes[other].name} is nearest, {format_quantity(gap, 'length')} away"
        allowed = settings.lengths(meshes)[0]
        if gap <= allowed:
            raise AssemblyError(
                f"{where}, within the gap of {format_quantity(allowed, 'length')} that is allowed, but no faces "
                f"look at each other "
                f"there to within {settings.angle:g} degrees; move it into place, or raise that angle "
                '("contact": {"angle": degrees} in assembly.json)'
            )
        farther = 1000 * float(_above(gap)) if settled is None else 2000 * settled
        how = "let parts settle" if settled is None else "let parts settle farther"
        raise UntouchedPartError(
            f"{where}, and {format_quantity(allowed, 'length')} is allowed; move it into place, {how} (--settle "
            f"{format_number(farther, 2)}), or "
            f'allow the gap if it is meant to be filled ("contact": {{"gap": {_above(gap)}}} in assembly.json)'
        )


def _above(length: float) -> str:
    """Return a length with two digits, rounded up by 2 to 12 percent."""
    digits = int(np.floor(np.log10(length))) - 1
    return format_number(np.ceil(1.02 * length / 10.0**digits) * 10.0**digits, 2)

"""Clearance of parts in their fits, and parts that settle into it without being asked."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from falsework.errors import UntouchedPartError
from falsework.geometry.contact.interfaces import ContactSettings, default_gap
from falsework.geometry.contact.near import near_points
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.surface import warn_of
from falsework.geometry.settling.settlement import Settlement
from falsework.utils.quantity import format_number, format_quantity

_FIT = 1 / 20
"""Largest clearance of a fit, as a share of the thickness of the thinnest part."""


class Settled(Protocol):
    """Assembly, as far as its clearance goes."""

    @property
    def settlement(self) -> Settlement | None:
        """Motion of its parts, if they settled."""
        ...

    @property
    def clearance_hint(self) -> str:
        """What to do about parts with clearance; empty if none has."""
        ...


Made = TypeVar("Made", bound=Settled)


def clearance_hint(meshes: Sequence[TriangleMesh], boundary: NDArray[np.bool_], settings: ContactSettings) -> str:
    """Return what to do about parts that face others across a clearance; empty if none does.

    Such parts touch on one side only, or not where they would in fact, so that the poses of the model are none in which
    they rest.
    """
    thinnest = min(mesh.thickness for mesh in meshes)
    tolerance = max(*settings.lengths(meshes), default_gap(meshes))
    near = near_points(meshes, _FIT * thinnest, tolerance)
    near = near.take(np.flatnonzero((near.gaps > tolerance) & ~boundary[near.parts].all(axis=1)))
    if not len(near.gaps):
        return ""
    widest = int(near.gaps.argmax())
    a, b = (meshes[part].name for part in near.parts[widest].tolist())
    gap = float(near.gaps[widest])
    return (
        f"parts {a} and {b} face each other {format_quantity(gap, 'length', 2)} apart, and parts can settle into "
        f"such clearance before they "
        f"are judged: --settle {format_number(2000 * gap, 2)}"
    )


def settled_if_loose(make: Callable[[float | None], Made], meshes: Sequence[TriangleMesh], path: Path) -> Made:
    """Make an assembly whose parts settle, with a warning, if they do not rest where they are modelled.

    That is, if a part touches no other, or if parts have clearance and move into it. Those in equilibrium do not.

    Args:
        make: makes it of parts that settle by at most a length, metres, or do not.
        meshes: its parts, without a ground.
        path: the file, for the warning.

    Raises:
        AssemblyError: they make no assembly even if they settle by the thickness of the thinnest.
    """
    with warnings.catch_warnings(record=True) as of_model:
        warnings.simplefilter("always")
        try:
            as_modelled = make(None)
        except UntouchedPartError:
            as_modelled = None
    play = min(min(mesh.thickness, float(np.ptp(mesh.bounds, axis=0).min()) / 2) for mesh in meshes)
    within = (
        f"so parts settle into their clearance by at most {format_quantity(play, 'length')}, the thickness of the "
        "thinnest; --settle 0 (settle=0) leaves them where they are"
    )
    if as_modelled is None:
        warn_of(path, f"a part touches no other, {within}")
        return make(play)
    with warnings.catch_warnings(record=True) as of_settling:
        warnings.simplefilter("always")
        settled = make(play) if as_modelled.clearance_hint else as_modelled
    moved = settled.settlement is not None and bool(settled.settlement.motion.any())
    if moved:
        warn_of(path, f"the complete assembly is not stable, {within}")
    for warning in of_settling if moved else of_model:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return settled if moved else as_modelled

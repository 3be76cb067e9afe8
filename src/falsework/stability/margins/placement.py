"""Share of states that are stable when parts are placed with an error."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.props import keep_props, with_props
from falsework.assembly.state import as_states
from falsework.errors import InputError
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.utils.quantity import check_seed

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PlacementCurve:
    """Share of draws in which each state is stable, by placement error."""

    tolerances: Array
    """Placement errors: largest movement of any point of a part, m, shape (tolerances,)."""
    shares: Array
    """Share of draws that are stable, shape (tolerances, states)."""
    refused: NDArray[np.int64]
    """Draws in which a part lost all contacts or overlapped another; they count as not stable. Shape (tolerances,)."""
    draws: int


def placement_curve(
    assembly: Assembly,
    states: ArrayLike,
    tolerances: Sequence[float],
    stable: Callable[[Assembly, NDArray[np.uint8]], NDArray[np.bool_]],
    *,
    draws: int = 1000,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> PlacementCurve:
    """Move and rotate every part at random, detect contacts again, and count the stable states.

    A part is moved by up to half of the tolerance along each axis and rotated about its centre so that no corner moves
    by more than the other half. Joints that open or overlap by as much as two neighbours can be off are closed midway
    between the parts, as mortar, shims or dressing would. Joints with tensile strength keep their strength per area.

    Args:
        states: shape (batch, parts).
        tolerances: m, each above zero.
        stable: decides which states of a moved structure are stable, such as `StabilityOracle(moved, settings).stable`.
        draws: number of draws per tolerance.
        seed: seed of the draws; the same draws, scaled, serve all tolerances.
        progress: callback `(done, total)` with numbers of draws.

    Raises:
        InputError: no tolerance or draw, a tolerance that is not positive, or contacts that were given, not detected.
    """
    batch = as_states(states, assembly.boundary)
    if not len(tolerances) or not all(np.isfinite(tolerance) and tolerance > 0 for tolerance in tolerances):
        raise InputError(f"placement errors are {list(tolerances)} m; give numbers above zero")
    if draws < 1:
        raise InputError(f"the number of draws is {draws}; give at least 1")
    check_seed(seed)
    check_detectable(assembly)
    stands, refused = np.zeros((len(tolerances), len(batch))), np.zeros(len(tolerances), np.int64)
    for row, tolerance in enumerate(tolerances):
        random = np.random.default_rng(seed)
        for draw in range(draws):
            moved = moved_assembly(assembly, tolerance, random)
            if moved is None:
                refused[row] += 1
            else:
                stands[row] += stable(moved, batch)
            if progress is not None:
                progress(row * draws + draw + 1, draws * len(tolerances))
    return PlacementCurve(np.array(tolerances, float), stands / draws, refused, draws)


def check_detectable(assembly: Assembly) -> None:
    """Refuse a structure whose contacts cannot be detected again for moved parts.

    Raises:
        InputError: they were given, not detected.
    """
    if assembly.contacts_given:
        raise InputError(
            "contacts of this structure were given, or have fasteners or studs, so they cannot be detected again for "
            "moved parts; leave out the placement error"
        )


def moved_assembly(assembly: Assembly, tolerance: float, random: np.random.Generator) -> Assembly | None:
    """Return the structure with its parts displaced at random; None where they make no valid assembly.

    Props are placed under the parts where these are then.
    """
    from scipy.spatial.transform import Rotation

    parts, meshes, place = keep_props(assembly, ()), [], {}
    for part, (mesh, center) in enumerate(zip(parts.meshes, parts.mass.center, strict=True)):
        shift, turn = random.uniform(-1, 1, 3), random.uniform(-1, 1, 3)
        if parts.boundary[part]:
            meshes.append(mesh)
            continue
        reach = float(np.linalg.norm(mesh.vertices - center, axis=1).max())
        turned = Rotation.from_rotvec(0.5 * tolerance / reach * turn / np.sqrt(3.0)).as_matrix().T
        place[part] = partial(_placed, center=center, turned=turned, shift=0.5 * tolerance * shift)
        meshes.append(TriangleMesh.from_arrays(mesh.name, place[part](mesh.vertices), mesh.faces))
    own = parts.contact_settings
    wider = {name: max(getattr(own, name) or 0.0, 2.5 * tolerance) for name in ("gap", "overlap")}
    settings = replace(own, **wider)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            moved = Assembly.from_meshes(
                meshes,
                boundary=parts.boundary,
                density=parts.density,
                friction=parts.friction,
                name=parts.name,
                contact_settings=settings,
            )
        joints = parts.joints and parts.joints.recomputed(parts.contacts, moved.contacts)
        heads = [(prop, tuple(place[prop.part](np.array(prop.at)).tolist())) for prop in assembly.props]
        return with_props(
            moved.replace(loads=parts.loads, joints=joints), [structs.replace(prop, at=at) for prop, at in heads]
        )
    except InputError:
        return None


def _placed(points: Array, center: Array, turned: Array, shift: Array) -> Array:
    """Return points of a part, shape (..., 3), that is turned about its centre and shifted."""
    return center + (points - center) @ turned + shift

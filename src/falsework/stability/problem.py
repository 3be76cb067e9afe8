"""Equilibrium problem of a structure: wrench maps, masses, scaling, and the masks of a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, States
from falsework.errors import AssemblyError
from falsework.geometry.mesh.edges import components
from falsework.stability.contact_geometry import ContactGeometry, geometry_of
from falsework.stability.criterion import Cone
from falsework.stability.strength import Strength, strength_of
from falsework.stability.verdict import Verdicts

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Problem:
    """Equilibrium problem of one structure, computed once and shared by all solvers.

    Contact point `c` acts between part `a` and part `b` with a force in the frame `(n, t1, t2)`; the force
    acts on `b`, its opposite on `a`. Wrenches are `(force, moment about the centre of mass)`.

    Solvers iterate on a scaled problem. Rows are whitened by the masses (`M = L L^T` per part, rows multiplied
    by `L^-1`), each contact point's columns are divided by their Frobenius norm, and the whole map by its
    largest singular value; `variable * force_scale = force`. The friction cone does not change, since each
    contact point is scaled by one positive number. The map is kept in factors: all points between one pair
    of parts act through the same 6-vector (force and moment about the centre of the pair's points), so

        block of part a = transfer_a[pair] @ basis[point],    block of part b = transfer_b[pair] @ basis[point]

    which halves the work of an iteration and leaves `S = G G^T` a sum of one small matrix per pair.
    """

    parts: int
    boundary: Mask
    """Parts that never move, including props, shape (parts,)."""
    geometry: ContactGeometry
    """Contact points, and the map of their forces to wrenches on the parts."""
    friction: float
    """Coefficient of friction of contact points without one of their own from a joint."""
    strength: Strength
    """Strength of each contact point."""
    cone: Cone
    gravity_wrench: Array
    """Weight and loads, shape (parts, 6), N and Nm."""
    pair_parts: NDArray[np.int32]
    """Parts `a < b` of every pair in contact, shape (pairs, 2)."""
    pair_start: NDArray[np.int32]
    """Pair `q` owns contact points `pair_start[q]:pair_start[q + 1]`, shape (pairs + 1,)."""
    basis: Array
    """Scaled force and moment about the pair's centre, shape (points, 6, 3)."""
    transfer_a: Array
    """Whitened wrench on part `a` of the pair's 6-vector (sign included), shape (pairs, 6, 6)."""
    transfer_b: Array
    """Whitened wrench on part `b` of the pair's 6-vector, shape (pairs, 6, 6)."""
    scaled_gravity: Array
    """Whitened weight and loads, shape (parts, 6)."""
    whitening: Array
    """`L^-1`, shape (parts, 6, 6)."""
    momentum: Array
    """`L`: maps a whitened velocity to a momentum, shape (parts, 6, 6)."""
    acceleration: Array
    """`L^-T`: maps a whitened residual to an acceleration, shape (parts, 6, 6)."""
    measure: Array
    """Residual per m/s2 of linear and per rad/s2 of angular acceleration, shape (parts, 2). The first is `1 / gravity`,
    the second the part's largest radius of gyration over gravity: the residual is a share of gravity at any size."""
    force_scale: Array
    """Force in N of a scaled variable of 1, shape (points,)."""
    weight: float
    """Weight of all parts that are not boundary, N."""

    @property
    def points(self) -> int:
        """Number of contact points."""
        return len(self.geometry.part_a)

    @property
    def pairs(self) -> int:
        """Number of pairs of parts in contact."""
        return len(self.pair_parts)

    def undecided(self, batch: int, *, certificates: bool = True, displaced: bool = False) -> Verdicts:
        """Return undecided verdicts on a batch of states, with room for certificates, and for displacements in them."""
        points, parts = (self.points, self.parts) if certificates else (None, None)
        return Verdicts.all_undecided(batch, points=points, parts=parts, displaced=displaced)

    def hold_apart(self, states: States, origins: States) -> States:
        """Return states in which free parts that no contact between free parts joins to what changed are held.

        Verdicts on these are verdicts on the states: elsewhere forces balance them as they do the origins, and what
        falls here falls there, since holding fewer parts never helps. Where nothing changed, nothing is held.

        Args:
            states: shape (batch, parts).
            origins: for each a stable state that differs in few parts, shape (batch, parts).

        Returns:
            Shape (batch, parts).
        """
        apart = states.copy()
        for state, origin in zip(apart, origins, strict=True):
            free, changed = state == INSTALLED, state != origin
            if not changed.any():
                continue
            a, b = self.pair_parts[(free | changed)[self.pair_parts].all(axis=1)].T
            piece = components(a, b, self.parts)
            state[free & ~np.isin(piece, piece[changed])] = HELD
        return apart

    def active(self, states: States) -> Mask:
        """Return the contact points that act: both parts present, not both fixed, not idle. Shape (batch, points)."""
        return self.geometry.acts(states) & ~self.strength.idle


def build_problem(
    assembly: Assembly, *, cone: Cone = "octagon", gravity: float = 9.81, reserve: float = 1.0
) -> Problem:
    """Set up the equilibrium problem of an assembly (paper, equations 2 to 6; docs/how-it-works), or return it again.

    Args:
        assembly: parts, contacts, masses and friction.
        cone: `octagon` (the paper's eight tangents) or `quadratic` (Coulomb).
        gravity: acceleration of gravity along -z, m/s2.
        reserve: number by which friction is divided.

    Raises:
        AssemblyError: a part whose inertia is not positive definite.
    """
    given = cone, gravity, reserve
    known, problem = _latest.get(assembly, (None, None))
    if problem is None or known != given:
        problem = _build(assembly, cone, gravity, reserve)
        _latest[assembly] = given, problem
    return problem


_latest: WeakKeyDictionary[Assembly, tuple[tuple[Cone, float, float], Problem]] = WeakKeyDictionary()
"""Problem of each assembly that was asked for last; oracles and replays of one assembly share it."""


def _build(assembly: Assembly, cone: Cone, gravity: float, reserve: float) -> Problem:
    contacts, mass = assembly.contacts, assembly.mass
    owner, geometry = contacts.contact_of_point, geometry_of(contacts, mass)
    axes = contacts.point_frames.transpose(0, 2, 1)  # columns n, t1, t2

    ends = contacts.parts[owner]
    first = np.flatnonzero(np.r_[True, (np.diff(ends, axis=0) != 0).any(axis=1)]) if len(owner) else []
    pair_start = np.r_[first, len(owner)].astype(np.int32)
    pair_parts = ends[pair_start[:-1]]
    pair_of_point = np.repeat(np.arange(len(pair_parts)), np.diff(pair_start))
    middle = np.zeros((len(pair_parts), 3))
    np.add.at(middle, pair_of_point, contacts.points)
    middle /= np.diff(pair_start)[:, None]

    whitening, momentum = _mass_factors(assembly)
    basis = _unit_wrenches(axes, contacts.points - middle[pair_of_point])
    a, b = pair_parts.T
    transfer_a = -whitening[a] @ _shift(middle - mass.center[a])
    transfer_b = whitening[b] @ _shift(middle - mass.center[b])
    # A boundary part never moves, so its rows appear in no state and must not influence the scaling.
    immovable = assembly.immovable
    transfer_a[immovable[a]] = 0.0
    transfer_b[immovable[b]] = 0.0
    norms = np.sqrt(
        ((transfer_a[pair_of_point] @ basis) ** 2).sum((1, 2)) + ((transfer_b[pair_of_point] @ basis) ** 2).sum((1, 2))
    )
    norms[norms == 0] = 1.0
    basis = basis / norms[:, None, None]
    top = _largest_singular_value(basis, pair_of_point, pair_parts, transfer_a, transfer_b, assembly.part_count)

    gravity_wrench = assembly.applied_wrench(gravity)
    arrays: dict[str, NDArray] = {
        "boundary": immovable,
        "gravity_wrench": gravity_wrench,
        "pair_parts": pair_parts.astype(np.int32),
        "pair_start": pair_start,
        "basis": basis / top,
        "transfer_a": transfer_a,
        "transfer_b": transfer_b,
        "scaled_gravity": (whitening @ gravity_wrench[:, :, None])[:, :, 0],
        "whitening": whitening,
        "momentum": momentum,
        "acceleration": whitening.transpose(0, 2, 1),
        "measure": np.stack([np.ones(assembly.part_count), mass.gyration], axis=1) / gravity,
        "force_scale": 1.0 / (norms * top),
    }
    for name, array in arrays.items():
        arrays[name] = array = np.ascontiguousarray(array)
        array.setflags(write=False)
    return Problem(
        parts=assembly.part_count,
        friction=float(assembly.friction) / reserve,
        strength=strength_of(assembly, gravity, reserve),
        cone=cone,
        geometry=geometry,
        weight=float(gravity * mass.mass[~immovable].sum()),
        **arrays,
    )


def _mass_factors(assembly: Assembly) -> tuple[Array, Array]:
    """Return `L^-1` and `L` of every part's mass matrix `L L^T`, shapes (parts, 6, 6)."""
    mass = assembly.mass
    try:
        inertia_factor = np.linalg.cholesky(mass.inertia)
    except np.linalg.LinAlgError:
        worst = int(np.argmin(np.linalg.eigvalsh(mass.inertia)[:, 0]))
        raise AssemblyError(f"part {worst} has an inertia that is not positive; repair its mesh") from None
    whitening = np.zeros((assembly.part_count, 6, 6))
    momentum = np.zeros_like(whitening)
    momentum[:, :3, :3] = np.eye(3) * np.sqrt(mass.mass)[:, None, None]
    momentum[:, 3:, 3:] = inertia_factor
    whitening[:, :3, :3] = np.eye(3) / np.sqrt(mass.mass)[:, None, None]
    whitening[:, 3:, 3:] = np.linalg.inv(inertia_factor)
    return whitening, momentum


def _unit_wrenches(axes: Array, arms: Array) -> Array:
    """Return the force and moment of unit forces along the columns of `axes` at `arms`. Shape (points, 6, 3)."""
    moments = np.cross(arms[:, None, :], axes.transpose(0, 2, 1)).transpose(0, 2, 1)
    return np.concatenate([axes, moments], axis=1)


def _shift(arms: Array) -> Array:
    """Return matrices that map (force, moment) at a point to (force, moment) about a point `-arm` away."""
    shift = np.zeros((len(arms), 6, 6))
    shift[:] = np.eye(6)
    x, y, z = arms.T
    shift[:, 3, 1], shift[:, 3, 2] = -z, y
    shift[:, 4, 0], shift[:, 4, 2] = z, -x
    shift[:, 5, 0], shift[:, 5, 1] = -y, x
    return shift


def _largest_singular_value(
    basis: Array, pair_of_point: NDArray, pair_parts: NDArray, transfer_a: Array, transfer_b: Array, parts: int
) -> float:
    """Return the largest singular value of the wrench map over the parts that can move, by power iteration."""
    if not len(basis):
        return 1.0
    stiffness = np.zeros((len(pair_parts), 6, 6))
    np.add.at(stiffness, pair_of_point, basis @ basis.transpose(0, 2, 1))
    a, b = pair_parts.T
    rows = (6 * pair_parts.T.reshape(-1, 1) + np.arange(6)).ravel()
    vector = np.random.default_rng(0).standard_normal((parts, 6))
    value = 1.0
    for _ in range(60):
        vector /= np.linalg.norm(vector)
        strain = np.einsum("qji,qj->qi", transfer_a, vector[a]) + np.einsum("qji,qj->qi", transfer_b, vector[b])
        stress = np.einsum("qij,qj->qi", stiffness, strain)
        ends = [np.einsum("qij,qj->qi", transfer, stress) for transfer in (transfer_a, transfer_b)]
        image = np.bincount(rows, np.concatenate(ends).ravel(), 6 * parts).reshape(parts, 6)
        value, vector = float(np.sqrt(max(np.vdot(vector, image), 0.0))), image
        if value == 0.0:
            return 1.0
    return value

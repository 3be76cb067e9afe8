"""Certificate checker: verifies a proof in float64 from the assembly alone, without any code of the solvers.

A displacement proves that a state is stable under the criterion `contact`: the check evaluates the contact law, which
keeps forces inside the friction cones, and computes the residual that they leave. It also proves equilibrium.

Forces and virtual velocities bound the same number, the smallest residual that admissible contact forces can leave.
Admissible forces lie in the friction cones, and their normal components sum to at most the force bound. The residual
is the largest acceleration of a part as a share of gravity; an angular acceleration is multiplied by the part's largest
radius of gyration, so the residual is dimensionless and independent of size, density and gravity. Forces bound it from
above, a virtual velocity from below, so a state cannot pass both tests, unless the verdict itself says that it depends
on the tolerance: then a velocity proves that some residual is left, though less than the tolerance. Joints with tensile
strength or cohesion enlarge the set of admissible forces (`Strength`).

A motion proves that a rest position is an unstable equilibrium, where the forces after it make it grow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.criterion import CONTACT, StabilityCriterion
from falsework.stability.second_order.growth import NEUTRAL, growth_of_motion
from falsework.stability.second_order.springs import ROUNDING, into_cone, springs_of_displacement
from falsework.stability.state_arrays import StateArrays
from falsework.stability.stiffness import movement_limit, movement_of, reach_of, structure_size
from falsework.stability.strength import TEARS, strength_of
from falsework.stability.verdict import Proof, Verdicts, proof_of

Array = NDArray[np.float64]

_CHUNK_POINTS = 1 << 18
"""Contact points of all states that are checked at once: small enough for the processor's cache."""


def verify_certificates(
    assembly: Assembly, states: States, verdicts: Verdicts, claim: StabilityCriterion | None = None
) -> NDArray[np.bool_]:
    """Return whether each verdict is proven by its certificate.

    Args:
        states: shape (batch, parts).
        verdicts: with forces and velocity, under `contact` with displacement.
        claim: criterion, cone, gravity, tolerance and force bound; if not given, those that `StabilityOracle` has by
            default under `contact`, for verdicts with displacements, or under `equilibrium`, for others.

    Returns:
        Shape (batch,); an undecided verdict is never accepted. Of a sliding state, only the proof that forces in
        equilibrium exist is checked; of a stable one, not that no motion from rest grows.

    Raises:
        InputError: verdicts without certificates, or with shapes that do not fit the states.
    """
    if verdicts.forces is None or verdicts.velocity is None:
        raise InputError(
            "these verdicts carry no certificates; ask for them with Stability.verdicts(..., require_certificate=True)"
        )
    if np.ndim(states) != 2:
        raise InputError(f"states have shape {np.shape(states)}; expected (batch, parts)")
    if claim is None:
        claim = StabilityCriterion() if verdicts.displacement is None else CONTACT
    batch, parts = states.shape
    shapes = [
        ("states", states.shape, (len(verdicts), len(assembly.meshes))),
        ("forces", verdicts.forces.shape, (batch, len(assembly.contacts.points), 3)),
        ("velocity", verdicts.velocity.shape, (batch, parts, 6)),
    ]
    if claim.criterion == "contact":
        if verdicts.displacement is None:
            raise InputError(
                "these verdicts carry no displacements; ask for certificates under the criterion `contact`"
            )
        shapes.append(("displacement", verdicts.displacement.shape, (batch, parts, 6)))
    for name, given, expected in shapes:
        if given != expected:
            raise InputError(f"{name} have shape {given}; expected {expected} for this assembly")
    proof, points = proof_of(verdicts.verdict, claim.criterion), len(assembly.contacts.points)
    accepted, displacement = np.zeros(batch, dtype=bool), verdicts.displacement
    for rows in chunks(np.flatnonzero((proof == Proof.DISPLACEMENT) | (proof == Proof.MOTION)), points):
        assert displacement is not None
        residual = residual_of_displacement(assembly, states[rows], displacement[rows], claim)
        accepted[rows] = residual <= claim.tolerance
        if len(tips := rows[proof[rows] == Proof.MOTION]):
            motion = displacement[tips], verdicts.velocity[tips]
            accepted[tips] &= growth_of_motion(assembly, states[tips], *motion, claim) > NEUTRAL
    balanced = np.flatnonzero(proof == Proof.FORCES)
    forces = [verdicts.forces[row] for row in balanced]
    accepted[balanced] = residual_of_forces(assembly, states[balanced], forces, claim) <= claim.tolerance
    for rows in chunks(np.flatnonzero(proof == Proof.VELOCITY), points):
        bound = residual_bound_of_velocity(assembly, states[rows], verdicts.velocity[rows], claim)
        accepted[rows] = bound > np.where(verdicts.on_tolerance[rows], claim.resolution, claim.tolerance)
    return accepted


def residual_of_displacement(
    assembly: Assembly, states: States, displacement: Array, claim: StabilityCriterion
) -> Array:
    """Return the residual left by the contact forces of a displacement; infinity where the displacement is too large.

    The law is that of `contact/law.py`, implemented independently: normal springs that break beyond their tensile
    strength, tangential springs limited by friction and cohesion, no force at zero displacement.

    Args:
        states: shape (batch, parts).
        displacement: `(translation, rotation)` about the centres of mass in m and rad, shape (batch, parts, 6);
            those of parts that are fixed in a state are ignored.
        claim: cone, gravity, force bound and stiffness ratio.

    Returns:
        As `residual_of_forces`, shape (batch,).
    """
    displacement = np.where((states == 1)[:, :, None], displacement, 0.0)
    finite = np.asarray(np.isfinite(displacement).all(axis=(1, 2)))
    displacement = np.where(finite[:, None, None], displacement, 0.0)
    moved = movement_of(displacement, reach_of(assembly)).max(axis=1, initial=0.0)
    springs = springs_of_displacement(assembly, states, displacement, claim)
    compression = np.where(springs.closed, -springs.gap, 0.0).max(axis=1, initial=0.0)
    limit = movement_limit(structure_size(assembly), compression)
    residual = residual_of_forces(assembly, states, springs.forces, claim)
    return np.where(finite & (moved <= limit * TEARS), residual, np.inf)


def residual_of_forces(
    assembly: Assembly,
    states: States,
    forces: Array | StateArrays | list[Array],
    claim: StabilityCriterion = StabilityCriterion(),
) -> Array:
    """Return the residual that contact forces leave; infinity where they are not admissible.

    Args:
        states: shape (batch, parts).
        forces: `(n, t1, t2)` in N at every contact point of each state, shape (points, 3); not all of them need to be
            in memory. Those that do not act in a state are ignored.
        claim: cone, gravity and force bound.

    Returns:
        Shares of gravity, shape (batch,).
    """
    running = RunningResidual(assembly, claim)
    return np.array([running.step(state, forces[row]) for row, state in enumerate(states)], dtype=np.float64)


class RunningResidual:
    """Residual of states one after the other, as in a plan.

    Most forces in a state of a plan are, bit by bit, those of the state before. So only the parts are evaluated
    where forces or the presence of parts differ from those of the state before, which is found by comparing them; all
    other parts keep their residual.
    """

    def __init__(self, assembly: Assembly, claim: StabilityCriterion) -> None:
        """Begin before the first state; `claim` has cone, gravity and force bound."""
        self._assembly, self._claim = assembly, claim
        self._strength = strength_of(assembly, claim.gravity, claim.reserve)
        self._geometry = geometry_of(assembly.contacts, assembly.mass)
        self._weight = claim.gravity * float(assembly.mass.mass[~assembly.immovable].sum())
        self._loads = assembly.applied_wrench(claim.gravity)
        points = len(assembly.contacts.points)
        self._inside, self._refused = np.zeros((points, 3)), np.zeros(points, dtype=bool)
        self._share = np.zeros(assembly.part_count)
        self._before: tuple[States, Array] | None = None

    def step(self, state: States, forces: Array) -> float:
        """Return the residual of the next state, of shape (parts,), as `residual_of_forces`; shape (points, 3)."""
        assembly, claim, geometry = self._assembly, self._claim, self._geometry
        owners = geometry.part_a, geometry.part_b
        force = np.array(forces, dtype=np.float64, order="C")
        changed = np.ones(len(state), dtype=bool)
        if self._before is not None:
            known, before = self._before
            changed = state != known
            other = np.flatnonzero(force.view(np.uint64).ravel() != before.view(np.uint64).ravel()) // 3
            for owner in owners:
                changed[owner[other]] = True
        # Whether a force acts depends on both parts, so their neighbours may lose or gain one.
        at = np.flatnonzero(changed[owners[0]] | changed[owners[1]])
        for owner in owners:
            changed[owner[at]] = True
        self._admit(at, np.where(geometry.acts(state[None], at)[0][:, None], force[at], 0.0))
        parts = np.flatnonzero(changed)
        net = geometry.wrenches_on(parts, self._inside) + self._loads[parts]
        linear = net[:, :3] / assembly.mass.mass[parts, None]
        angular = np.einsum("pij,pj->pi", geometry.inverse_inertia[parts], net[:, 3:])
        turning = np.abs(angular).max(axis=1) * geometry.gyration[parts]
        self._share[parts] = np.maximum(np.abs(linear).max(axis=1), turning) / claim.gravity
        self._before = state, force
        if self._refused.any() or self._inside[:, 0].sum() > claim.force_bound * self._weight * (1 + ROUNDING):
            return np.inf
        return float(np.where(state == 1, self._share, 0.0).max(initial=0.0))

    def _admit(self, at: NDArray[np.int64], forces: Array) -> None:
        """Take the forces at some contact points, shape (some, 3), into their cones; refuse what is far outside."""
        size = np.linalg.norm(forces, axis=1)
        finite = np.isfinite(size)
        forces = np.where(finite[:, None], forces, 0.0)
        inside, outside = into_cone(forces[None], self._strength.take(at), self._claim.cone)
        self._inside[at] = inside[0]
        self._refused[at] = ~(finite & (outside[0] <= ROUNDING * (size + self._weight)))


def residual_bound_of_velocity(
    assembly: Assembly, states: States, velocity: Array, claim: StabilityCriterion = StabilityCriterion()
) -> Array:
    """Return the lower bound, proven by a velocity, on the residual that any admissible contact forces leave.

    For forces with sum of normals at most `U`, the power of all forces on velocity `w` is at least
    `w . loads - B max_c s_c - T`, weight among the loads, where `s_c` is the largest power that contact point `c` can
    absorb per newton of normal force, `T` the largest absorbed by tension and cohesion, and `B` is `U` plus the tensile
    strength of all points. This power is also acceleration times momentum of `w`, so at most the residual times gravity
    times the 1-norm of the momentum, angular momenta divided by the radii of gyration (a quantitative Farkas lemma).

    Args:
        states: shape (batch, parts).
        velocity: `(linear, angular)` about the centres of mass, shape (batch, parts, 6); ignored for parts that are
            fixed in a state.
        claim: cone, gravity and force bound.

    Returns:
        Shares of gravity, shape (batch,); zero or less where nothing is proven.
    """
    velocity = np.where((states == 1)[:, :, None], velocity, 0.0)
    taken, momentum = resistance_to_velocity(assembly, states, velocity, claim)
    proven = np.einsum("bpi,pi->b", velocity, assembly.applied_wrench(claim.gravity)) - taken
    bound = np.divide(proven, momentum, out=np.zeros_like(proven), where=momentum > 0)
    return np.where(np.isfinite(bound), bound, 0.0)


def resistance_to_velocity(
    assembly: Assembly, states: States, velocity: Array, claim: StabilityCriterion
) -> tuple[Array, Array]:
    """Return the largest power in W that admissible forces can absorb from a velocity, and its momentum.

    The momentum is in N m/s: the power of the loads minus the absorbed power, divided by it, bounds the residual from
    below. Neither depends on the loads. Arguments as for `residual_bound_of_velocity`, shapes (batch,).
    """
    mass, geometry = assembly.mass, geometry_of(assembly.contacts, assembly.mass)
    strength = strength_of(assembly, claim.gravity, claim.reserve)
    acts = geometry.acts(states) & ~strength.idle
    relative = geometry.relative(velocity)
    slip = _slip(relative, claim.cone)
    taken = np.where(acts, strength.friction * slip - relative[..., 0], 0.0).max(axis=1, initial=0.0)
    joined = np.where(acts, strength.stick * slip + strength.pull * relative[..., 0], 0.0).sum(axis=1)
    most = claim.force_bound * claim.gravity * mass.mass[~assembly.immovable].sum() + acts @ strength.pull
    momentum = np.abs(mass.mass[None, :, None] * velocity[:, :, :3]).sum(axis=(1, 2))
    turning = np.abs(np.einsum("pij,bpj->bpi", mass.inertia, velocity[:, :, 3:])).sum(axis=2)
    return most * taken + joined, claim.gravity * (momentum + (turning / geometry.gyration).sum(axis=1))


def _slip(relative: Array, cone: str) -> Array:
    """Return the largest power that a tangential force of at most 1 N can absorb from a relative velocity."""
    tangent = relative[..., 1:]
    if cone == "quadratic":
        return np.hypot(tangent[..., 0], tangent[..., 1])
    angle = np.arange(8) * np.pi / 4
    return (tangent @ np.stack([np.cos(angle), np.sin(angle)])).max(axis=-1)


def chunks(rows: NDArray, points: int, least: int = 1) -> list[NDArray]:
    """Split rows of states with a number of contact points into chunks whose arrays fit into the cache.

    Args:
        points: contact points of the structure.
        least: states of a chunk, however many points they have.
    """
    size = max(_CHUNK_POINTS // max(points, 1), least)
    return [rows[first : first + size] for first in range(0, len(rows), size)]

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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.state_arrays import StateArrays
from falsework.stability.stiffness import MOVEMENT, TANGENTIAL_RATIO, normal_stiffness, structure_size
from falsework.stability.strength import Strength, strength_of
from falsework.stability.verdict import Criterion, Verdict, Verdicts

Array = NDArray[np.float64]

_ROUNDING = 1e-9
"""Largest distance of a force from its cone, as a share of the force and of the structure's weight; such a force
is moved into the cone before the residual is computed."""
_TEARS = 1.0 + 1e-6
"""A contact point breaks at this multiple of its tensile strength; the excess over 1 covers rounding of the solvers."""
NEUTRAL = 1e-3
"""Growth of a motion, as `growth_of_motion` measures it, up to which an equilibrium counts as neutral, not unstable."""
_ALONG = 0.01
"""Largest deviation of the unbalanced forces from the direction of a motion that they make grow, as a share of them."""
_MANY_POINTS = 4096
"""Contact points from which states one after the other are evaluated only where they change."""
_RESOLUTION = 1e-3
"""Residual at which verdicts are decided, as a share of the tolerance."""
_WELL_BELOW = 0.1
"""Residual of a stable state, as a share of the tolerance, above which the verdict depends on the tolerance."""
_CHUNK_POINTS = 1 << 18
"""Contact points of all states that are checked at once: small enough for the processor's cache."""


@dataclass(frozen=True)
class StabilityCriterion:
    """Criterion, cone, gravity, tolerance and bounds that a verdict refers to."""

    cone: str = "octagon"
    """Friction cone, `octagon` or `quadratic`."""
    gravity: float = 9.81
    """m/s2 along -z."""
    tolerance: float = 1e-4
    """Largest residual of a stable state, as a share of gravity."""
    force_bound: float = 1e3
    """Bound on the sum of all normal forces, in weights of the structure."""
    criterion: Criterion = "equilibrium"
    """Definition of stability."""
    stiffness_ratio: float = TANGENTIAL_RATIO
    """Ratio of tangential to normal contact stiffness, under the criterion `contact`."""

    @property
    def resolution(self) -> float:
        """Residual at which verdicts are decided, a share of gravity."""
        return _RESOLUTION * self.tolerance

    @property
    def well_below(self) -> float:
        """Residual up to which a stable state does not depend on the tolerance, a share of gravity."""
        return _WELL_BELOW * self.tolerance

    def on_tolerance(self, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return which verdicts depend on the tolerance, shape (batch,); see `Verdicts.on_tolerance`."""
        residual = verdicts.residual
        return (verdicts.stable & (residual > self.well_below)) | (verdicts.unstable & (residual <= self.tolerance))


CONTACT = StabilityCriterion(cone="quadratic", criterion="contact")
"""The default criterion of verdicts, plans and replays."""


def verify_certificates(
    assembly: Assembly, states: States, verdicts: Verdicts, claim: StabilityCriterion | None = None
) -> NDArray[np.bool_]:
    """Return whether each verdict is proven by its certificate.

    Args:
        assembly: the structure.
        states: shape (batch, parts).
        verdicts: with forces and velocity, under `contact` with displacement.
        claim: criterion, cone, gravity, tolerance and force bound; if not given, those that `Stability` has by default
            under `contact`, for verdicts with displacements, or under `equilibrium`, for others.

    Returns:
        Shape (batch,); an undecided verdict is never accepted. Of a sliding state, only the proof that forces in
        equilibrium exist is checked; of a stable one, not that no motion from rest grows.

    Raises:
        InputError: verdicts without certificates, or with shapes that do not fit the states.
    """
    if verdicts.forces is None or verdicts.velocity is None:
        raise InputError("these verdicts carry no certificates; get verdicts from Stability.check, which returns them")
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
                "these verdicts carry no displacements; get verdicts from Stability.check, under `contact`"
            )
        shapes.append(("displacement", verdicts.displacement.shape, (batch, parts, 6)))
    for name, given, expected in shapes:
        if given != expected:
            raise InputError(f"{name} have shape {given}; expected {expected} for this assembly")
    accepted, points = np.zeros(len(states), dtype=bool), len(assembly.contacts.points)
    stable, unstable = np.flatnonzero(verdicts.stable), np.flatnonzero(verdicts.verdict == Verdict.UNSTABLE)
    balanced = stable
    if claim.criterion == "contact":
        assert verdicts.displacement is not None
        balanced = np.flatnonzero(verdicts.slides)
        for rows in chunks(stable, points):
            residual = residual_of_displacement(assembly, states[rows], verdicts.displacement[rows], claim)
            accepted[rows] = residual <= claim.tolerance
        for rows in chunks(np.flatnonzero(verdicts.tips), points):
            known = states[rows], verdicts.displacement[rows]
            growth = growth_of_motion(assembly, *known, verdicts.velocity[rows], claim)
            accepted[rows] = (residual_of_displacement(assembly, *known, claim) <= claim.tolerance) & (growth > NEUTRAL)
    forces = [verdicts.forces[row] for row in balanced]
    accepted[balanced] = residuals_in_order(assembly, states[balanced], forces, claim) <= claim.tolerance
    for rows in chunks(unstable, points):
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
        assembly: the structure.
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
    moved = np.linalg.norm(displacement[:, :, :3], axis=2).max(axis=1, initial=0.0)
    forces = forces_of_displacement(assembly, states, displacement, claim)
    residual = residual_of_forces(assembly, states, forces, claim)
    return np.where(finite & (moved <= np.sqrt(3.0) * MOVEMENT * structure_size(assembly)), residual, np.inf)


def forces_of_displacement(assembly: Assembly, states: States, displacement: Array, claim: StabilityCriterion) -> Array:
    """Return the contact forces `(n, t1, t2)` in N that the law gives at a displacement, shape (batch, points, 3)."""
    return springs_of_displacement(assembly, states, displacement, claim).forces


class Springs(NamedTuple):
    """Contact points as springs at a displacement: how they answer small further motions."""

    forces: Array
    """Contact forces `(n, t1, t2)` in N, shape (batch, points, 3)."""
    normal: Array
    """Normal stiffness of each point where it is closed, N/m, shape (points,)."""
    tangential: Array
    """Tangential stiffness of each point where it sticks, N/m, shape (points,)."""
    closed: NDArray[np.bool_]
    """Whether each point bears more than the tolerance times the weight of the lighter part, shape (batch, points)."""
    open: NDArray[np.bool_]
    """Whether it bears none but would if a motion closed it, shape (batch, points)."""
    gap: Array
    """How far it is open, m, shape (batch, points)."""
    pull: Array
    """Unit vector along the force of friction at its limit, zero where the point sticks, shape (batch, points, 2)."""
    across: Array
    """Share of the tangential stiffness across `pull`: 1 where the point sticks, shape (batch, points)."""

    @property
    def slips(self) -> NDArray[np.bool_]:
        """Whether friction is at its limit, shape (batch, points, 1)."""
        return (self.across < 1.0)[..., None]


def springs_of_displacement(
    assembly: Assembly, states: States, displacement: Array, claim: StabilityCriterion
) -> Springs:
    """Return the contact forces that the law gives at a displacement, and the stiffness of the contact points there.

    Arguments as for `residual_of_displacement`.
    """
    geometry = geometry_of(assembly.contacts, assembly.mass)
    relative = geometry.relative(displacement)
    stiffness = normal_stiffness(assembly, claim.gravity)
    strength = strength_of(assembly, claim.gravity)
    normal = -stiffness * relative[..., 0]
    whole = ~strength.tears | (normal >= -_TEARS * strength.pull)
    tangential = claim.stiffness_ratio * stiffness
    tangent = -tangential[:, None] * relative[..., 1:]
    springs = np.concatenate([normal[..., None], tangent], axis=2)
    forces, outside = _into_cone(springs, strength, claim.cone)
    acts = geometry.acts(states)
    forces = np.where((acts & whole)[:, :, None], forces, 0.0)
    lighter = np.minimum(assembly.mass.mass[geometry.part_a], assembly.mass.mass[geometry.part_b])
    closed = acts & whole & (normal + strength.pull > claim.tolerance * claim.gravity * lighter)
    slips = closed & (outside >= 0.0)
    size, trial = np.linalg.norm(forces[..., 1:], axis=2), np.linalg.norm(tangent, axis=2)
    pull = np.divide(
        forces[..., 1:], size[..., None], out=np.zeros_like(tangent), where=(slips & (size > 0))[..., None]
    )
    across = np.where(slips, np.divide(size, trial, out=np.zeros_like(size), where=trial > 0), 1.0)
    return Springs(forces, stiffness, tangential, closed, acts & ~closed, relative[..., 0], pull, across)


def growth_of_motion(
    assembly: Assembly, states: States, displacement: Array, motion: Array, claim: StabilityCriterion
) -> Array:
    """Return how fast a small motion from rest grows: positive where it proves that the equilibrium is unstable.

    After the motion contact forces have changed, by the law of springs and friction and because their points, and
    without friction their normals too, turn with the parts (docs/decisions/0151). Where the unbalanced forces
    accelerate every part along the motion, it grows exponentially.

    Args:
        assembly: the structure.
        states: shape (batch, parts).
        displacement: of the parts at rest, shape (batch, parts, 6).
        motion: `(linear, angular)` about the centres of mass, of any size, shape (batch, parts, 6).
        claim: cone, gravity and stiffness ratio.

    Returns:
        Accelerations over those of parts that move along `motion` with gravity over their largest radius of gyration as
        acceleration, shape (batch,): 0.43 for a cube on its edge. Zero where they are not along the motion.
    """
    free = (states == 1)[:, :, None]
    springs = springs_of_displacement(assembly, states, np.where(free, displacement, 0.0), claim)
    motion = np.where(free, motion, 0.0)
    geometry, mass, contacts = geometry_of(assembly.contacts, assembly.mass), assembly.mass, assembly.contacts
    axes = contacts.frames[contacts.contact_of_point]
    relative = geometry.relative(motion)
    normal = np.where(springs.closed, relative[..., 0], 0.0)
    normal += np.where(closing_points(assembly, springs, motion, relative), relative[..., 0], 0.0)
    tangent = relative[..., 1:]
    along = (springs.pull * tangent).sum(axis=2, keepdims=True)
    friction = strength_of(assembly, claim.gravity).friction[:, None]
    stuck = -springs.tangential[:, None] * tangent
    dragged = springs.across[..., None] * (stuck + (springs.tangential[:, None] * along) * springs.pull)
    dragged -= (springs.normal * normal)[..., None] * friction * springs.pull
    change = np.empty_like(relative)
    change[..., 0] = -springs.normal * normal
    change[..., 1:] = np.where(springs.closed[..., None], np.where(springs.slips & (along <= 0.0), dragged, stuck), 0.0)
    force, shift = np.einsum("bpi,pij->bpj", springs.forces, axes), np.einsum("bpi,pij->bpj", relative, axes)
    press = np.where(springs.closed & (friction[:, 0] == 0.0), springs.forces[..., 0], 0.0)[..., None] * axes[:, 0]
    turned, leaning = geometry.wrenches(change), []
    for part, sign in ((geometry.part_a, -1.0), (geometry.part_b, 1.0)):
        turn, arm = motion[:, part, 3:], contacts.points - mass.center[part]
        moment = sign * np.cross(np.cross(turn, arm), force)
        turned[..., 3:] += _sum_by_part(moment, part, states.shape[1])
        lean = np.einsum("bpj,pij->bpi", np.cross(turn, press), axes)
        leans = geometry.wrenches(lean)
        leans[..., 3:] -= _sum_by_part(np.cross(shift, press), part, states.shape[1])
        leaning.append(leans)
    growth = np.zeros(len(states))
    for leans in leaning:
        wrench = np.where(free, turned + leans, 0.0)
        own = np.concatenate(
            [mass.mass[:, None] * motion[..., :3], np.einsum("pij,bpj->bpi", mass.inertia, motion[..., 3:])], 2
        )
        own *= (claim.gravity / geometry.gyration)[:, None]
        size = (motion * own).sum(axis=(1, 2))
        found = np.divide((motion * wrench).sum(axis=(1, 2)), size, out=np.zeros_like(size), where=size > 0.0)
        left = wrench - found[:, None, None] * own
        lengths = np.repeat(np.stack([np.ones_like(geometry.gyration), geometry.gyration], axis=1), 3, axis=1)
        error, scale = np.abs(left / lengths).max(axis=(1, 2)), np.abs(own / lengths).max(axis=(1, 2))
        growth = np.maximum(growth, np.where(error <= _ALONG * found * scale, found, 0.0))
    return growth


def _sum_by_part(values: Array, part: NDArray[np.int32], parts: int) -> Array:
    """Return the sums over the contact points of each part, shapes (batch, points, 3) and (batch, parts, 3)."""
    total = np.zeros((len(values), parts, 3))
    for row, value in enumerate(values):
        np.add.at(total[row], part, value)
    return total


def closing_points(assembly: Assembly, springs: Springs, motion: Array, relative: Array) -> NDArray[np.bool_]:
    """Return the open points that a motion closes before a part moves by more than the displacement limit.

    Args:
        assembly: the structure.
        springs: at rest.
        motion: shape (batch, parts, 6).
        relative: the motion at every contact point in its frame, shape (batch, points, 3).
    """
    turn = np.linalg.norm(motion[..., 3:], axis=2) * assembly.mass.gyration
    moved = np.maximum(np.linalg.norm(motion[..., :3], axis=2), turn).max(axis=1, initial=0.0)
    limit = MOVEMENT * structure_size(assembly)
    return (
        springs.open
        & (relative[..., 0] < -_ROUNDING * moved[:, None])
        & (springs.gap * moved[:, None] <= -relative[..., 0] * limit)
    )


def residual_of_forces(
    assembly: Assembly, states: States, forces: Array, claim: StabilityCriterion = StabilityCriterion()
) -> Array:
    """Return the residual that contact forces leave; infinity where they are not admissible.

    Args:
        assembly: the structure.
        states: shape (batch, parts).
        forces: `(n, t1, t2)` in N at every contact point, shape (batch, points, 3); those that do not act in
            a state are ignored.
        claim: cone, gravity and force bound.

    Returns:
        Shares of gravity, shape (batch,).
    """
    strength, geometry = strength_of(assembly, claim.gravity), geometry_of(assembly.contacts, assembly.mass)
    forces, refused = _admit(forces, geometry.acts(states), strength, claim.cone, _weight(assembly, claim))
    admissible = ~refused.any(axis=1) & (forces[:, :, 0].sum(axis=1) <= _most(assembly, claim))
    share = _share_of_gravity(assembly, geometry.wrenches(forces), np.arange(states.shape[1]), claim)
    residual = np.where(states == 1, share, 0.0).max(axis=1, initial=0.0)
    return np.where(admissible, residual, np.inf)


def residuals_in_order(
    assembly: Assembly,
    states: States,
    forces: Array | StateArrays | list[Array],
    claim: StabilityCriterion = StabilityCriterion(),
) -> Array:
    """Return the residuals of `residual_of_forces` for states one after the other, as in a plan.

    Most forces in a state of a large plan are, bit by bit, those of the state before. So only the parts are evaluated
    where forces or the presence of parts differ from those of the state before, which is found by comparing them; all
    other parts keep their residual.

    Args:
        assembly: the structure.
        states: shape (batch, parts).
        forces: of each state, shape (points, 3); not all of them need to be in memory.
        claim: cone, gravity and force bound.

    Returns:
        Shares of gravity, shape (batch,).
    """
    residual, points = np.empty(len(states)), len(assembly.contacts.points)
    if points < _MANY_POINTS:
        for rows in chunks(np.arange(len(states)), points):
            residual[rows] = residual_of_forces(assembly, states[rows], np.array([forces[k] for k in rows]), claim)
        return residual
    strength, geometry = strength_of(assembly, claim.gravity), geometry_of(assembly.contacts, assembly.mass)
    weight, most, owners = _weight(assembly, claim), _most(assembly, claim), (geometry.part_a, geometry.part_b)
    inside, refused = np.zeros((points, 3)), np.zeros(points, dtype=bool)
    share, known = np.zeros(states.shape[1]), None
    for row, state in enumerate(states):
        force = np.ascontiguousarray(forces[row], dtype=np.float64)
        changed = np.ones(len(state), dtype=bool)
        if known is not None:
            changed = state != known[0]
            other = np.flatnonzero(force.view(np.uint64).ravel() != known[1].view(np.uint64).ravel()) // 3
            for owner in owners:
                changed[owner[other]] = True
        # Whether a force acts depends on both parts, so their neighbours may lose or gain one.
        at = np.flatnonzero(changed[owners[0]] | changed[owners[1]])
        for owner in owners:
            changed[owner[at]] = True
        acts = geometry.acts(state[None], at)
        good, bad = _admit(force[None, at], acts, strength.of(at), claim.cone, weight)
        inside[at], refused[at] = good[0], bad[0]
        parts = np.flatnonzero(changed)
        share[parts] = _share_of_gravity(assembly, geometry.wrenches_on(parts, inside), parts, claim)
        admissible = not refused.any() and inside[:, 0].sum() <= most
        residual[row] = np.where(state == 1, share, 0.0).max(initial=0.0) if admissible else np.inf
        known = state, force
    return residual


def _weight(assembly: Assembly, claim: StabilityCriterion) -> float:
    """Return the weight of all parts that can move, N."""
    return claim.gravity * float(assembly.mass.mass[~assembly.immovable].sum())


def _most(assembly: Assembly, claim: StabilityCriterion) -> float:
    """Return the largest sum of normal forces that is admissible, N."""
    return claim.force_bound * _weight(assembly, claim) * (1 + _ROUNDING)


def _admit(
    forces: Array, acts: NDArray[np.bool_], strength: Strength, cone: str, weight: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Return forces inside their cones, zero where none acts, and which of them are not admissible.

    Shapes (batch, points, 3) and (batch, points).
    """
    forces = np.where(acts[:, :, None], forces, 0.0)
    size = np.linalg.norm(forces, axis=2)
    finite = np.isfinite(size)
    inside, outside = _into_cone(np.where(finite[:, :, None], forces, 0.0), strength, cone)
    refused = acts & ~(finite & (outside <= _ROUNDING * (size + weight)))
    return np.where(acts[:, :, None], inside, 0.0), refused


def _share_of_gravity(assembly: Assembly, wrench: Array, parts: NDArray[np.int64], claim: StabilityCriterion) -> Array:
    """Return the acceleration of some parts under contact forces and loads, a share of gravity, shape (..., parts).

    Args:
        assembly: the structure.
        wrench: of the contact forces, shape (..., parts, 6).
        parts: their numbers.
        claim: gravity.
    """
    mass, geometry = assembly.mass, geometry_of(assembly.contacts, assembly.mass)
    net = wrench + assembly.applied_wrench(claim.gravity)[parts]
    linear = net[..., :3] / mass.mass[parts, None]
    angular = np.einsum("pij,...pj->...pi", geometry.inverse_inertia[parts], net[..., 3:])
    turning = np.abs(angular).max(axis=-1) * geometry.gyration[parts]
    return np.maximum(np.abs(linear).max(axis=-1), turning) / claim.gravity


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
        assembly: the structure.
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
    strength, acts = strength_of(assembly, claim.gravity), geometry.acts(states)
    relative = geometry.relative(velocity)
    slip = _slip(relative, claim.cone)
    taken = np.where(acts, strength.friction * slip - relative[..., 0], 0.0).max(axis=1, initial=0.0)
    joined = np.where(acts, strength.stick * slip + strength.pull * relative[..., 0], 0.0).sum(axis=1)
    most = claim.force_bound * claim.gravity * mass.mass[~assembly.immovable].sum() + acts @ strength.pull
    momentum = np.abs(mass.mass[None, :, None] * velocity[:, :, :3]).sum(axis=(1, 2))
    turning = np.abs(np.einsum("pij,bpj->bpi", mass.inertia, velocity[:, :, 3:])).sum(axis=2)
    return most * taken + joined, claim.gravity * (momentum + (turning / geometry.gyration).sum(axis=1))


def _into_cone(forces: Array, strength: Strength, cone: str) -> tuple[Array, Array]:
    """Return forces with tangents shrunk until they are admissible, and how far outside the cone they were, in N.

    Shapes (batch, points, 3) and (batch, points).
    """
    normal, tangent = forces[..., 0], forces[..., 1:]
    radius = strength.friction * np.maximum(normal + strength.pull, 0.0) + strength.stick
    if cone == "quadratic":
        reach, limit = np.hypot(tangent[..., 0], tangent[..., 1]), radius
    else:
        # The octagon has its corners at multiples of 45 degrees, so the normals of its sides are half way between; the
        # nearest normal is 22.5 degrees from the axis along which the tangent is larger.
        x, y = np.abs(tangent[..., 0]), np.abs(tangent[..., 1])
        reach = np.cos(np.pi / 8) * np.maximum(x, y) + np.sin(np.pi / 8) * np.minimum(x, y)
        limit = np.cos(np.pi / 8) * radius
    inside = forces.copy()
    inside[..., 0] = np.maximum(normal, -strength.pull)
    inside[..., 1:] *= np.divide(limit, reach, out=np.ones_like(reach), where=reach > limit)[..., None]
    return inside, np.maximum(reach - limit, -normal - strength.pull)


def _slip(relative: Array, cone: str) -> Array:
    """Return the largest power that a tangential force of at most 1 N can absorb from a relative velocity."""
    tangent = relative[..., 1:]
    if cone == "quadratic":
        return np.hypot(tangent[..., 0], tangent[..., 1])
    angle = np.arange(8) * np.pi / 4
    return (tangent @ np.stack([np.cos(angle), np.sin(angle)])).max(axis=-1)


def chunks(rows: NDArray, points: int) -> list[NDArray]:
    """Split rows of states with a number of contact points into chunks whose evaluation fits into the cache."""
    size = max(_CHUNK_POINTS // max(points, 1), 1)
    return [rows[first : first + size] for first in range(0, len(rows), size)]

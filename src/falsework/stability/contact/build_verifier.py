"""Certificate of a build: the displacements in the increments of its steps, evaluated in float64.

The verifier follows the contact law from state to state: springs take up the displacements, friction limits them,
what slid keeps its force. So the forces of each state are a consequence of the displacements, inside the friction cones
by construction, and what is left to check are sums: the forces balance every part that nothing holds, each robot bears
what its spring and its presses give it, within its limits, and parts move little. This module shares no code with the
solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.joints import SET
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, States
from falsework.stability.certificate import RunningResidual
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.criterion import StabilityCriterion
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, Press, limits_of
from falsework.stability.second_order.springs import ROUNDING, into_cone
from falsework.stability.stiffness import movement_limit, movement_of, reach_of, spring_stiffness, structure_size
from falsework.stability.strength import TEARS, Strength, strength_of
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]

_CLOSE = TEARS - 1.0
"""Rounding that is allowed in movements and wrenches of robots, as a share of their limits: as in tensile strength."""


class StepCertificate(NamedTuple):
    """Certificate of the step to a state, in the order of assembly."""

    displacement: Array
    """Displacement of each part in each increment of the step, m and rad, shape (increments, parts, 6)."""
    torn: NDArray[np.bool_]
    """Contact points that have lost their tensile strength, shape (points,), or (0,) if none has."""
    presses: tuple[Press, ...] = ()
    """Presses of the step."""


@dataclass(frozen=True, eq=False)
class StepProof:
    """Result of the evaluation of a step."""

    residual: float
    """Largest acceleration of a part that nothing holds, a share of gravity; infinite where the state is not proven."""
    forces: Array
    """Contact forces `(n, t1, t2)`, N, shape (points, 3)."""
    wrenches: Array
    """Wrench that a robot bears on each held part, N and N m about its centre, zero for others, shape (parts, 6)."""
    moved: float
    """Largest movement of a part since it was placed, m; see `movement_of`."""
    reason: str = ""
    """Why the state is not proven; empty if it is."""


class BuildVerifier:
    """Evaluation of the certificates of a build, step by step."""

    def __init__(self, assembly: Assembly, claim: StabilityCriterion) -> None:
        """Begin before the first state.

        Args:
            claim: cone, gravity, tolerance, reserve, and the stiffness and limits of robots.
        """
        self._assembly, self._claim = assembly, claim
        self._law = _Law(assembly, claim)
        self._limits = limits_of(assembly, claim.holds, claim.gravity)
        self._stiffness, self._hybrid = claim.holds.stiffness, claim.holds.mode is HoldMode.HYBRID
        self._size, self._reach, self._names = structure_size(assembly), reach_of(assembly), assembly.names
        self._loads = assembly.applied_wrench(claim.gravity)
        self._before: States | None = None
        self._residual = RunningResidual(assembly, claim)
        self._springs, self._forces = np.zeros((self._law.points, 3)), np.zeros((self._law.points, 3))
        self._age = np.full(self._law.points, SET, np.int32)
        self._moved, self._borne = np.zeros((assembly.part_count, 6)), np.zeros((assembly.part_count, 6))

    def step(self, state: States, certificate: StepCertificate) -> StepProof:
        """Evaluate the step to the next state, shape (parts,); the first one is loaded from rest."""
        assembly, law = self._assembly, self._law
        before = np.zeros_like(state) if self._before is None else self._before
        there, was = law.geometry.present(state), law.geometry.present(before)
        if self._before is not None:
            self._age = np.where(there & was, self._age + 1, 0)
        steps = certificate.displacement * ((state != REMOVED) & ~assembly.immovable)[None, :, None]
        sound = bool(np.isfinite(steps).all())
        steps = steps if sound else np.zeros_like(steps)
        torn = certificate.torn if len(certificate.torn) else np.zeros(law.points, dtype=bool)
        strength = law.whole.at(torn, self._age, assembly.joints)
        springs, forces = (np.where((there & was)[:, None], kept, 0.0) for kept in (self._springs, self._forces))
        held = np.flatnonzero((state == HELD) & ~assembly.immovable)
        taken = held[before[held] != HELD]  # it came with its robot, or its robot takes it as it is
        if len(taken):
            at, passed = law.geometry.points_on(taken), np.zeros_like(springs)
            passed[at] = law.forces(springs[at], strength.take(at))
            self._borne[taken] = -(law.geometry.wrenches_on(taken, passed) + self._loads[taken])
        points = law.points_of(steps, there)
        springs[points], forces[points], whole = law.follow(springs[points], steps, points, strength.take(points), torn)
        moved = np.where(((before != REMOVED) & (state != REMOVED))[:, None], self._moved, 0.0) + steps.sum(axis=0)
        residual = self._residual.step(state, forces)
        borne = np.zeros_like(moved)
        borne[held] = -(law.geometry.wrenches_on(held, forces) + self._loads[held])
        movement = movement_of(moved, self._reach)
        farthest = float(movement.max(initial=0.0))
        limit = float(movement_limit(self._size, law.compression(springs)))
        reason = self._broken(before, state, certificate.presses, steps.sum(axis=0), borne)
        if not (sound and whole):
            reason = "the certificate is damaged, or calls a contact whole that breaks"
        elif farthest > limit * (1 + _CLOSE):
            part = self._names[int(movement.argmax())]
            reason = (
                f"{part} moves by {format_quantity(farthest, 'length')}, more than the limit of "
                f"{format_quantity(limit, 'length')}"
            )
        self._before, self._springs, self._forces, self._moved, self._borne = state, springs, forces, moved, borne
        return StepProof(residual if not reason else np.inf, forces, borne, farthest, reason)

    def _broken(self, before: States, state: States, presses: Sequence[Press], step: Array, borne: Array) -> str:
        """Return why the robots cannot bear what a state asks of them; empty if they can.

        Args:
            before, state: shape (parts,).
            presses: of the step.
            step: displacement of the parts in the step, shape (parts, 6).
            borne: wrenches on the held parts, shape (parts, 6).
        """
        assembly, (most_force, most_moment) = self._assembly, self._limits
        added = {press.part: np.asarray(press.wrench) for press in presses}
        mass, inertia, gyration = assembly.mass.mass, assembly.mass.inertia, self._law.geometry.gyration
        held = (state == HELD) & (before == HELD) & ~assembly.immovable
        stray = [part for part in added if not held[part]]
        if stray:
            return f"a robot presses {self._names[stray[0]]}, which it does not hold"
        if len(added) < len(presses):
            return "a part is pressed twice in one step"
        turning = [part for part, wrench in added.items() if self._hybrid and wrench[3:].any()]
        if turning:
            return f"the robot that presses {self._names[turning[0]]} adds a moment, which hybrid control does not"
        for part in np.flatnonzero((state == HELD) & ~assembly.immovable).tolist():
            name, weight = self._names[part], mass[part] * self._claim.gravity
            force, moment = np.linalg.norm(borne[part, :3]), np.linalg.norm(borne[part, 3:])
            if force > most_force * (1 + _CLOSE) or moment > most_moment * (1 + _CLOSE):
                return (
                    f"the robot that holds {name} bears {format_quantity(float(force), 'force', 4)} and "
                    f"{format_quantity(float(moment), 'moment', 4)}, more than it can"
                )
            turned = np.concatenate([step[part, :3], inertia[part] @ step[part, 3:] / mass[part]])
            off, strayed = self._off(added.get(part), turned, borne[part] - self._borne[part], gyration[part])
            if strayed:
                return f"the certificate moves {name}, which a rigid hold fixes"
            off = off / weight
            if off.max() > self._claim.tolerance + _CLOSE * max(1.0, force / weight):
                return f"the robot that holds {name} does not bear what its stiffness and its presses give"
        return ""

    def _off(self, press: Array | None, turned: Array, change: Array, gyration: float) -> tuple[Array, bool]:
        """Return by how much a robot does not bear what it should, N, and whether its part moves where it cannot.

        Args:
            press: wrench that it adds; None if it does not press.
            turned: movement of the part in the step as a spring of 1 N/m resists it, shape (6,).
            change: of the wrench that the robot bears, shape (6,).
            gyration: of the part, m.
        """
        across = self._stiffness
        along = across if press is None else min(across, PRESS_STIFFNESS)
        added, line = np.zeros(6) if press is None else press, np.zeros(6)
        if press is not None and self._hybrid:
            line[:3] = press[:3] / max(float(np.linalg.norm(press[:3])), 1e-300)
        else:
            across = along
        given = (line @ turned) * line
        size = np.repeat([1.0, gyration], 3)
        if np.isinf(across):
            bound = np.abs(turned - given) / size
            # By components, as unbalanced forces are measured elsewhere; the robot bears what it takes across the line.
            off = np.abs(line @ (change - added) + (along * (line @ turned) if line.any() else 0.0)) * np.abs(line)
            return off, bool(bound.max() > ROUNDING * np.abs(given).max())
        return np.abs(change - added + along * given + across * (turned - given)) / size, False


class _Law:
    """Contact law with history, from the structure alone."""

    def __init__(self, assembly: Assembly, claim: StabilityCriterion) -> None:
        self.geometry = geometry_of(assembly.contacts, assembly.mass)
        self.whole = strength_of(assembly, claim.gravity, claim.reserve)
        self._stiffness = spring_stiffness(assembly, claim.gravity, claim.stiffness_ratio)
        self._cone = claim.cone
        self.points = len(self._stiffness)

    def compression(self, springs: Array) -> Array:
        """Return the largest compression of a contact point at spring forces of shape (points, 3), m, shape ()."""
        return (springs[:, 0] / self._stiffness[:, 0]).max(initial=0.0)

    def forces(self, springs: Array, strength: Strength) -> Array:
        """Return the contact forces at spring forces, shapes (points, 3)."""
        return into_cone(springs[None], strength, self._cone)[0][0]

    def points_of(self, steps: Array, there: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return the contact points whose springs may change in increments of shape (increments, parts, 6).

        Where points may break or joints set, these are all.
        """
        if self.whole.pull.any() or self.whole.stick.any():
            return np.flatnonzero(there)
        moves = np.asarray(steps.any(axis=(0, 2)))
        return np.flatnonzero(there & (moves[self.geometry.part_a] | moves[self.geometry.part_b]))

    def follow(
        self, springs: Array, steps: Array, points: NDArray[np.int64], strength: Strength, torn: NDArray[np.bool_]
    ) -> tuple[Array, Array, bool]:
        """Return spring and contact forces after increments, and whether no point breaks that is called whole.

        Args:
            springs: spring forces of some points before, shape (some, 3).
            steps: displacement in the increments, shape (increments, parts, 6).
            points: these points, shape (some,).
            strength: theirs.
            torn: shape (points,).
        """
        force, tears, broken = springs, strength.tears & ~torn[points] & (strength.pull > 0), False
        for motion in self.geometry.relative_at(points, steps):
            trial = springs - self._stiffness[points] * motion
            broken = broken or bool((tears & (trial[:, 0] < -TEARS * strength.pull)).any())
            force = self.forces(trial, strength)
            springs = np.column_stack([trial[:, 0], force[:, 1:]])
        return springs, force, not broken

"""Choice of the forces with which robots press before a part is released.

Contact forces respond linearly to the forces of robots as long as closed contacts stick. So one factorisation near the
released part, and one solve for each component of a robot's wrench, give all contact forces as an affine function of a
few numbers. Those for which the contact forces come closest to the friction cones, of reduced friction, are the
proposal. The contact law decides: a proposal is used only if the structure comes to rest under it in the replay.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, States
from falsework.stability.contact.hold_loads import CLOSE
from falsework.stability.contact.press_kernel import press_responses
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.holds import Press, inexact_wrenches

Array = NDArray[np.float64]

_SAFETY = (1.5, 1.05)
"""Friction is divided by these numbers in turn: a press with more reserve is tried first."""
_GAINS = (1.0, 1.5)
"""Multiples of the chosen wrench that are tried: contacts that slide take more than those that stick."""
_WEAK = 1e-3
"""Weight of the robots' wrenches beside the energy of the forces outside the cones: the least that help are chosen."""
_STEPS = 50
"""Newton steps of the choice, at most."""
_HELPS = 0.5
"""A press must leave less than this share of the energy of forces outside the cones to be tried."""


class PressPlanner:
    """Proposals of presses for the steps of a replay."""

    def __init__(self, solver: ContactSolver) -> None:
        """Take over the layout of a structure."""
        self._solver, self._problem = solver, solver.problem

    def proposals(
        self, before: States, after: States, springs: Array, torn: NDArray[np.bool_], set_share: Array
    ) -> Iterator[tuple[Press, ...]]:
        """Yield presses that may let the structure come to rest when a part is released, the most promising first.

        Args:
            before, after: states before and after the release, shape (parts,).
            springs, torn, set_share: contact history before the release, as in `settle_step`.
        """
        held = np.flatnonzero((after == HELD) & (before == HELD) & ~self._problem.boundary)
        if not len(held):
            return
        contact, problem = self._solver.contact_structure, self._problem
        columns = 1 + 6 * len(held)
        index, forces = np.zeros(problem.points, np.int64), np.zeros((columns, problem.points, 3))
        moves = np.zeros((columns, columns - 1))
        count = press_responses(contact, before, after, held, springs, torn, set_share, index, forces, moves)
        if not count:
            return
        index, forces = index[:count], forces[:, :count]
        scale, strength = problem.force_scale[index], problem.strength.reached(torn, set_share).take(index)
        forces[0, :, 0] += strength.pull / scale
        compliance = 1.0 / contact.normal[index]
        # What a rigid hold would bear keeps soft arms where they are, and is the least that a press may be.
        still = _within(np.linalg.lstsq(moves[1:].T, -moves[0], rcond=None)[0], contact.force_limit[held])
        errors, limit = self._errors(held), contact.force_limit[held]
        seen = [still if contact.grip[held].any() else np.zeros_like(still)]
        if seen[0].any():
            yield self._presses(held, _along_forces(still) if contact.hybrid else still)
        for safety in _SAFETY:
            cones = strength.friction / safety, strength.stick / scale / safety
            if contact.hybrid:
                soft = bool((contact.grip[held] == contact.press_grip[held]).all())
                added, helps = _least_along(forces, moves, errors, *cones, compliance, limit, soft=soft)
                start = np.zeros_like(still)
            else:
                added, helps = _least_outside(forces, still, errors, *cones, compliance, limit)
                start = still
            for gain in _GAINS if helps else ():
                choice = _within(start + gain * (added - start), limit)
                if not any(np.allclose(choice, other, rtol=CLOSE) for other in seen):
                    seen.append(choice)
                    yield self._presses(held, choice)

    def _errors(self, held: NDArray[np.int64]) -> Array:
        """Return maps from whitened wrenches of held parts to those that robots may exert instead, and to themselves.

        Shape (errors, 6 n, 6 n).
        """
        maps = inexact_wrenches()
        whitened = np.linalg.solve(self._problem.momentum[held], maps[:, None] @ self._problem.momentum[held])
        found = np.zeros((len(maps), len(held), 6, len(held), 6))
        each = np.arange(len(held))
        found[:, each, :, each] = whitened.transpose(1, 0, 2, 3)
        return found.reshape(len(maps), 6 * len(held), 6 * len(held))

    def _presses(self, held: NDArray[np.int64], whitened: Array) -> tuple[Press, ...]:
        """Return presses of the held parts by whitened wrenches, shape (6 n,)."""
        wrenches = (self._problem.momentum[held] @ whitened.reshape(-1, 6, 1))[:, :, 0]
        return tuple(Press(part, tuple(w.tolist())) for part, w in zip(held.tolist(), wrenches, strict=True))


def _least_along(
    forces: Array,
    moves: Array,
    errors: Array,
    friction: Array,
    stick: Array,
    compliance: Array,
    limit: Array,
    *,
    soft: bool,
) -> tuple[Array, bool]:
    """Return the forces of robots that hold parts across their directions, as `_least_outside`.

    Held parts then move along the forces only. Contact forces are linear in these movements, so the best movements are
    sought; each force is the one that moves its part so, along the movement. Robots that are as soft across the force
    as along it add the force alone.

    Args:
        forces, errors, friction, stick, compliance, limit: as in `_least_outside`.
        moves: whitened movements of the pressed parts without pressing, then their change by each component of a
            whitened wrench, shape (1 + 6 n, 6 n).
        soft: whether robots are as soft across the force as along it.
    """
    count, along = len(limit), (6 * np.arange(len(limit))[:, None] + np.arange(3)).ravel()
    # The wrenches by which robots that give way in all directions would move parts in this way.
    wrenches = np.eye(6 * count) if soft else np.linalg.pinv(moves[1:].T)
    still, response = np.zeros(6 * count) if soft else -wrenches @ moves[0], wrenches[:, along].T
    flat = forces[1:].reshape(6 * count, -1)
    base = forces[:1] + (still @ flat).reshape(1, -1, 3)
    moved = np.concatenate([base, (response @ flat).reshape(-1, *forces.shape[1:])])
    nothing, free = np.zeros(3 * count), np.full(count, np.inf)
    found, helps = _least_outside(moved, nothing, errors[:, along[:, None], along], friction, stick, compliance, free)
    size = np.linalg.norm(found.reshape(-1, 3), axis=1)
    line = found.reshape(-1, 3) / np.maximum(size, 1e-300)[:, None]
    wrench = (still + found @ response).reshape(-1, 6)
    force = (wrench[:, :3] * line).sum(axis=1)[:, None] * line
    return np.concatenate([force, np.zeros_like(force)], axis=1).ravel(), helps


def _along_forces(whitened: Array) -> Array:
    """Return whitened wrenches without their moments, shape (6 n,)."""
    return (whitened.reshape(-1, 6) * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]).ravel()


def _least_outside(
    forces: Array, still: Array, errors: Array, friction: Array, stick: Array, compliance: Array, limit: Array
) -> tuple[Array, bool]:
    """Return the wrenches of robots for which contact forces are closest to their cones, and whether they help.

    The distance is an energy: the square of the part of each force outside its cone, times the compliance of the point.
    It is convex and piecewise smooth; Newton's method with the generalised second derivative and halved steps finds its
    least value.

    Args:
        forces: contact forces without pressing, then their change by each component of a whitened wrench on each
            pressed part, shape (1 + 6 n, points, 3).
        still: wrenches from which others differ as little as possible, shape (6 n,).
        errors: maps to the wrenches that robots may exert instead, shape (errors, 6 n, 6 n).
        friction, stick: of the cones, shape (points,).
        compliance: of the points, shape (points,).
        limit: largest whitened force on each pressed part, shape (n,).

    Returns:
        Whitened wrenches, shape (6 n,), and whether they leave much less energy outside the cones than `still`.
    """
    count, wrenches = len(errors), len(forces) - 1
    flat = forces[1:].transpose(0, 2, 1).reshape(wrenches, -1)
    response = np.concatenate([(error.T @ flat).reshape(wrenches, 3, -1) for error in errors], axis=2)
    base = np.tile(forces[0].T, count)
    weight, friction, stick = np.tile(compliance, count) / count, np.tile(friction, count), np.tile(stick, count)
    weak = _WEAK * max(float(((response**2).sum(axis=1) @ weight).mean()), 1e-300)

    def measure(x: Array) -> tuple[float, float, Array, Array]:
        force = base + (x @ response.reshape(wrenches, -1)).reshape(3, -1)
        outside = _outside(force, friction, stick)
        energy = 0.5 * float((outside**2).sum(axis=0) @ weight)
        return energy + 0.5 * weak * float((x - still) @ (x - still)), energy, outside, force

    x = still
    value, energy, outside, force = measure(x)
    without = energy
    for _ in range(_STEPS):
        active = np.flatnonzero((outside != 0).any(axis=0))
        some, share = response[:, :, active], np.tile(weight[active], 3)
        gradient = some.reshape(wrenches, -1) @ (share * outside[:, active].ravel()) + weak * (x - still)
        rows = _curved(some, force[:, active], friction[active], stick[active]).reshape(wrenches, -1)
        step = np.linalg.solve((rows * share) @ rows.T + weak * np.eye(len(x)), -gradient)
        length = 1.0
        while length > 1e-3:
            ahead = _within(x + length * step, limit)
            found = measure(ahead)
            if found[0] < value:
                break
            length *= 0.5
        else:
            break
        done = value - found[0] < 1e-6 * value
        x, (value, energy, outside, force) = ahead, found
        if done:
            break
    return x, energy < _HELPS * without


def _within(x: Array, limit: Array) -> Array:
    """Return whitened wrenches, or forces, scaled down until the forces keep the limits, shape (6 n,) or (3 n,)."""
    wrench = x.reshape(len(limit), -1)
    size = np.linalg.norm(wrench[:, :3], axis=1)
    return (wrench * np.minimum(1.0, limit / np.maximum(size, 1e-300))[:, None]).ravel()


def _outside(force: Array, friction: Array, stick: Array) -> Array:
    """Return what forces have outside of quadratic cones that are widened by `stick`, shape (3, points) as theirs."""
    normal, size = force[0], np.sqrt(force[1] ** 2 + force[2] ** 2)
    onto = np.maximum((normal + friction * (size - stick)) / (1 + friction**2), 0.0)
    share = (friction * onto + stick) / np.maximum(size, 1e-300)
    found = force * (1.0 - np.minimum(share, 1.0))
    found[0] = normal - onto
    return np.where((normal >= 0) & (size <= friction * normal + stick), 0.0, found)


def _curved(response: Array, force: Array, friction: Array, stick: Array) -> Array:
    """Return a square root of the second derivative of half the squared distance from the cones, times the response.

    Args:
        response: change of the forces by each component of the wrenches, shape (6 n, 3, points).
        force: outside of the cones, shape (3, points).
        friction, stick: as in `_least_outside`.

    Returns:
        Shape (6 n, 3, points): the sum of its squares over the second axis is the curvature.
    """
    normal, size = force[0], np.maximum(np.sqrt(force[1] ** 2 + force[2] ** 2), 1e-300)
    onto = np.maximum((normal + friction * (size - stick)) / (1 + friction**2), 0.0)
    beyond = 1.0 - np.minimum((friction * onto + stick) / size, 1.0)
    x, y = force[1] / size, force[2] / size
    along, across = response[:, 1] * x + response[:, 2] * y, response[:, 2] * x - response[:, 1] * y
    # On the surface the distance changes along its normal alone; below the apex both components count.
    surface = onto > 0
    first = np.where(surface, (along - friction * response[:, 0]) / np.sqrt(1 + friction**2), response[:, 0])
    second = np.where(~surface & (beyond > 0), along, 0.0)
    return np.stack([first, second, across * np.sqrt(beyond)], axis=1)

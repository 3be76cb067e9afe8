"""Modified Newton steps on the whole with the factors of an earlier state, and full steps near a change.

The weight of a part that is let go of has to reach a support, however far away. Near the part forces change by many
times its weight, since neighbours have to press it; farther away little more than the weight is left, and forces there
change in proportion. So a state is balanced near the change by primal-dual steps (`centring.py`), with the parts around
that region held. What these then bear is spread over the whole structure by chord steps, Newton steps whose matrix was
factored for an earlier state (Kelley, 1995, chapter 5): a solve instead of a factorization. Contacts that reach the
boundaries of their cones on the way leave their neighbours out of balance, where this is done again. Failure proves
nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import INSTALLED, Mask, States
from falsework.stability.cpu.centring import assemble, limit_step, move_inside, run_centring
from falsework.stability.cpu.elimination import lay_out_panels, make_panels
from falsework.stability.cpu.interior_point import strains
from falsework.stability.cpu.layout import (
    FAST,
    KernelArrays,
    Scratch,
    load_forces,
    make_scratch,
    restrict,
    scratch_with,
    store_forces,
)
from falsework.stability.cpu.neighbourhood import changed_parts, measure_ways
from falsework.stability.cpu.panels import factor_panels, solve_panels
from falsework.stability.cpu.repair import accept_forces, keep_border
from falsework.stability.cpu.termination import (
    MARGIN,
    STABLE,
    UNDECIDED,
    Options,
    check_primal,
    residual_of_part,
)
from falsework.utils.kernels import njit

CHORD_RINGS = np.array([4, 8])
"""Contacts from the change to the parts that are held at first, tried in turn."""
_FOLLOWING_RING = 6
"""Contacts from parts that chord steps leave out of balance to those that are held then ..."""
_FOLLOWINGS, _MOST_PARTS = 8, 40
"""... so many times at most, and only where so few are out of balance."""
_CHORD_STEPS = 3
"""Chord steps in a row."""
_NEAR_STEPS = 12
"""Steps near a change."""
_SETTINGS = np.array([0.7, 0.0, 0.98, 0.001])
"""Settings of the steps near a change, see `centring.ATTEMPTS`: without centring, from forces as they are. What moves
forces inside their cones would put the whole region out of balance."""
_INSIDE, _SMALL = 0.999, 0.001
"""The last two of these settings where a matrix is factored."""
_BACK_OFF = 0.9
"""Share of the way to the nearest facet of its cone that a contact goes at most."""


@njit(nogil=True, cache=True)
def factor_state(structure, state, forces, options, work):
    """Factor the Newton matrix of a state at given forces, to be used in `chord_range` for later states.

    Args:
        structure, options: `KernelArrays` and `Options`.
        state: shape (parts,).
        forces: contact forces in N, shape (points, 3).
        work: `Scratch` that keeps the factors.

    Returns:
        Number of pairs that act; 0 where the matrix cannot be factored.
    """
    pairs, _ = restrict(structure, state, work)
    load_forces(structure, work, pairs, forces, work.z)
    lay_out_panels(structure, work.free, work.panels)
    check_primal(structure, work, pairs, work.z, options, work.residual)
    level = structure.weight / len(state)
    move_inside(structure, work, pairs, level, _INSIDE, _SMALL)
    assemble(structure, work, pairs, level, pairs >= 0, 0.0)
    return pairs if factor_panels(structure.elimination.supernode, work.panels, pairs >= 0) else 0


@njit(cache=True)
def _balance_near(structure, state, seeds, count, rings, factored, options, work, free, held, forces):
    """Balance the parts near `seeds[:count]` with those around them held; return whether that succeeded, and steps.

    Those around them are held where the factored state has them; forces on others stay as they are. `seeds` has room
    for all parts and is overwritten, `free` and `held` are scratch, shape (parts,).
    """
    depth = np.empty(len(state), np.int32)
    measure_ways(structure, state, seeds, count, rings, depth)
    for i in range(len(state)):
        far = state[i] == 1 and depth[i] < 0
        free[i] = 2 if far else state[i]
        held[i] = 2 if far and factored[i] == 1 else state[i]
    pairs, _ = restrict(structure, free, work)
    pairs, grounded = keep_border(structure, held, free, work, pairs, forces)
    if not grounded:
        return False, 0
    load_forces(structure, work, pairs, forces, work.z)
    level = structure.weight / len(state)
    verdict, steps = run_centring(structure, work, pairs, options, _NEAR_STEPS, level, _SETTINGS)
    if verdict == STABLE:
        store_forces(structure, work, pairs, forces)
    return verdict == STABLE, steps


@njit(fastmath=FAST, cache=True)
def _spread(structure, reference, pairs, velocity, forces):
    """Change forces by a chord step with given velocities; each contact as far as its own cone allows."""
    metric, scale, friction = reference.weight_steps, structure.force_scale, structure.friction
    strains(structure, reference, pairs, velocity)
    strain = reference.v
    for p in range(pairs):
        shift = structure.pair_start[reference.pair[p]] - reference.start[p]
        for j in range(reference.start[p], reference.start[p + 1]):
            c, v0, v1, v2 = j + shift, strain[j, 0], strain[j, 1], strain[j, 2]
            d0 = -(metric[j, 0] * v0 + metric[j, 1] * v1 + metric[j, 2] * v2)
            d1 = -(metric[j, 1] * v0 + metric[j, 3] * v1 + metric[j, 4] * v2)
            d2 = -(metric[j, 2] * v0 + metric[j, 4] * v1 + metric[j, 5] * v2)
            z0, z1, z2 = forces[c, 0] / scale[c], forces[c, 1] / scale[c], forces[c, 2] / scale[c]
            share = limit_step(friction[c], z0, z1, z2, d0, d1, d2, _BACK_OFF) * scale[c]
            forces[c, 0] += share * d0
            forces[c, 1] += share * d1
            forces[c, 2] += share * d2


@njit(cache=True)
def _take_chord_steps(structure, state, factored, reference, pairs, options, work, velocity, forces):
    """Take chord steps until a state is balanced; return whether it is, and the residual.

    False too where a part is out of balance that the factored state does not have.
    """
    order, bound = structure.elimination.order, (1.0 - MARGIN) * options.tolerance
    for step in range(_CHORD_STEPS):
        residual = accept_forces(structure, state, options, work.residual, forces)
        if residual < bound:
            return True, residual
        if step == _CHORD_STEPS - 1:
            return False, residual
        for j in range(len(order)):
            free = state[order[j]] == 1
            if free and factored[order[j]] != 1 and residual_of_part(structure, order[j], work.residual, j) > bound:
                return False, residual
            for i in range(6):
                velocity[j, i] = work.residual[j, i] if free and factored[order[j]] == 1 else 0.0
        solve_panels(reference.panels, velocity, pairs >= 0)
        _spread(structure, reference, pairs, velocity, forces)
    return False, np.inf


@njit(cache=True)
def _copy(source, target):
    for j in range(len(source)):
        for i in range(3):
            target[j, i] = source[j, i]


@njit(cache=True)
def _chord_state(structure, state, parent, factored, reference, pairs, options, work, forces):
    """Balance a state with forces of its parent; see `chord_range`. Returns whether it is, residual, steps near by."""
    order, bound, taken = structure.elimination.order, (1.0 - MARGIN) * options.tolerance, 0
    parts = len(state)
    seeds, free, held = np.empty(parts, np.int32), np.empty(parts, np.uint8), np.empty(parts, np.uint8)
    velocity, trial = np.empty((len(order), 6)), np.empty((len(forces), 3))
    for k in range(len(CHORD_RINGS)):
        _copy(forces, trial)
        count, rings = changed_parts(state, parent, seeds), CHORD_RINGS[k]
        for _ in range(1 + _FOLLOWINGS):
            near, steps = _balance_near(
                structure, state, seeds, count, rings, factored, options, work, free, held, trial
            )
            taken += steps
            if not near:
                break
            good, residual = _take_chord_steps(
                structure, state, factored, reference, pairs, options, work, velocity, trial
            )
            if good:
                _copy(trial, forces)
                return True, residual, taken
            count, rings = 0, _FOLLOWING_RING
            for j in range(len(order)):
                part = order[j]
                if state[part] == 1 and residual_of_part(structure, part, work.residual, j) > 0.5 * bound:
                    seeds[count] = part
                    count += 1
            if count == 0 or count > _MOST_PARTS:
                break
    return False, np.nan, taken


@njit(nogil=True, cache=True)
def chord_range(
    structure,
    states,
    parents,
    known,
    factored,
    reference,
    pairs,
    options,
    forces,
    verdict,
    residual,
    steps,
):
    """Balance states whose `verdict` is `UNDECIDED` with the forces of their parents, where those are `known`.

    Other arguments as for `repair_range`.

    Args:
        factored: state that `factor_state` was given; all its free parts are free in `states`. Shape (parts,).
        reference: scratch with its factors, not shared with another thread but for what is read.
        pairs: what `factor_state` returned.

    Returns:
        Number of states left undecided.
    """
    work = make_scratch(structure)
    left = 0
    for i in range(len(states)):
        if verdict[i] == UNDECIDED and known[i]:
            good, worst, taken = _chord_state(
                structure, states[i], parents[i], factored, reference, pairs, options, work, forces[i]
            )
            steps[i] += taken
            if good:
                verdict[i], residual[i] = STABLE, worst
        left += verdict[i] == UNDECIDED
    return left


class FactoredState:
    """Factors of the Newton matrix of a state, for chord steps in states that follow it."""

    def __init__(self, structure: KernelArrays, options: Options) -> None:
        """Begin with none."""
        self._structure, self._options = structure, options
        self._scratch: Scratch | None = None
        self._state = np.empty(0, dtype=np.uint8)
        self._pairs = 0

    def prepare(self, states: States, parents: States, forces: NDArray[np.float64]) -> bool:
        """Factor the first of some parents, unless the factors at hand serve all these states.

        They do where every part that was free then is still free.

        Args:
            states, parents: shape (batch, parts).
            forces: contact forces in N that balance the parents, shape (batch, points, 3).

        Returns:
            Whether there are factors that serve all these states.
        """
        if self._pairs > 0 and _all_free(states, self._state):
            return True
        if not _all_free(states, parents[0]):
            return False
        if self._scratch is None:
            panels = make_panels.py_func(self._structure.elimination, len(self._structure.pair_parts))
            self._scratch = scratch_with.py_func(self._structure, panels)
        self._state = parents[0].copy()
        self._pairs = factor_state(self._structure, self._state, forces[0], self._options, self._scratch)
        return self._pairs > 0

    def forget(self) -> None:
        """Let the next call of `prepare` factor anew."""
        self._pairs = 0

    def balance(
        self,
        states: States,
        parents: States,
        known: Mask,
        forces: NDArray[np.float64],
        verdict: NDArray[np.int8],
        residual: NDArray[np.float64],
        steps: NDArray[np.int32],
    ) -> int:
        """Take chord steps; arguments and result as those of `chord_range`. Threads may call this side by side."""
        assert self._scratch is not None
        panels = self._scratch.panels
        strip, strain = np.empty_like(panels.strip), np.empty_like(self._scratch.v)
        own = self._scratch._replace(v=strain, panels=panels._replace(strip=strip))  # what steps write to
        own_factors = self._state, own, self._pairs, self._options
        return chord_range(self._structure, states, parents, known, *own_factors, forces, verdict, residual, steps)


def _all_free(states: States, before: States) -> bool:
    """Return whether all parts that were free in a state before are free in these."""
    return bool((states[:, before == INSTALLED] == INSTALLED).all())

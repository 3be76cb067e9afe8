"""Kernel arrays of a structure on the CPU, and sparse products with its wrench map."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.stability.cpu.cones import CONES
from falsework.stability.cpu.elimination import Elimination, Panels, eliminate, make_panels
from falsework.stability.problem import Problem
from falsework.stability.strength import Strength
from falsework.utils.kernels import njit

FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}
"""Compiler options: all of fast mathematics, but NaN and infinity keep their meaning."""
COMPILED_LAYOUT = ("C", "W")
"""Contiguous and writable, for `np.require`: numba would recompile the kernels for other arrays of states."""


class KernelArrays(NamedTuple):
    """Arrays of a `Problem` in the layout of the kernel; fields of the same name as there."""

    elimination: Elimination
    pair_parts: NDArray[np.int32]
    pair_start: NDArray[np.int32]
    basis: NDArray[np.float64]
    transfer_a: NDArray[np.float64]
    transfer_b: NDArray[np.float64]
    stiffness_aa: NDArray[np.float64]
    """Contribution of each pair to the diagonal block of `S` of part `a`, shape (pairs, 6, 6)."""
    stiffness_bb: NDArray[np.float64]
    stiffness_side: NDArray[np.float64]
    """Contribution to the block in the row of the part that is eliminated first, shape (pairs, 6, 6)."""
    neighbour_start: NDArray[np.int32]
    """Part `i` is in pairs `neighbour_pair[neighbour_start[i]:neighbour_start[i + 1]]`, shape (parts + 1,)."""
    neighbour_pair: NDArray[np.int32]
    gravity: NDArray[np.float64]
    momentum: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    measure: NDArray[np.float64]
    force_scale: NDArray[np.float64]
    weight: float
    friction: NDArray[np.float64]
    """Coefficient of friction of each contact point, shape (points,)."""
    pull: NDArray[np.float64]
    """Scaled tensile strength of each contact point, shape (points,); see `Strength`."""
    stick: NDArray[np.float64]
    """Scaled tangential force that it bears at that tension."""
    tears: NDArray[np.bool_]
    pull_a: NDArray[np.float64]
    """Whitened wrench on part `a` of the points of a pair at their tensile strength, shape (pairs, 6)."""
    pull_b: NDArray[np.float64]
    cone: int


@lru_cache(maxsize=2)
def build_structure(problem: Problem) -> KernelArrays:
    """Lay out a problem for the kernel and eliminate its pattern once; a replay under other settings shares it."""
    pattern = eliminate(problem)
    pair_of_point = np.repeat(np.arange(problem.pairs), np.diff(problem.pair_start))
    stiffness = np.zeros((problem.pairs, 6, 6))
    np.add.at(stiffness, pair_of_point, problem.basis @ problem.basis.transpose(0, 2, 1))
    a, b = problem.transfer_a, problem.transfer_b
    cross = b @ stiffness @ a.transpose(0, 2, 1)
    later_is_b = pattern.position[problem.pair_parts[:, 1]] > pattern.position[problem.pair_parts[:, 0]]
    ends = np.concatenate([problem.pair_parts[:, 0], problem.pair_parts[:, 1]])
    by_part = np.argsort(ends, kind="stable")
    return KernelArrays(
        elimination=pattern,
        pair_parts=problem.pair_parts,
        pair_start=problem.pair_start,
        basis=problem.basis,
        transfer_a=a,
        transfer_b=b,
        stiffness_aa=np.ascontiguousarray(a @ stiffness @ a.transpose(0, 2, 1)),
        stiffness_bb=np.ascontiguousarray(b @ stiffness @ b.transpose(0, 2, 1)),
        stiffness_side=np.ascontiguousarray(np.where(later_is_b[:, None, None], cross.transpose(0, 2, 1), cross)),
        neighbour_start=np.searchsorted(ends[by_part], np.arange(problem.parts + 1)).astype(np.int32),
        neighbour_pair=(by_part % max(problem.pairs, 1)).astype(np.int32),
        gravity=problem.scaled_gravity,
        momentum=problem.momentum,
        acceleration=problem.acceleration,
        measure=problem.measure,
        force_scale=problem.force_scale,
        weight=problem.weight,
        **strength_arrays(problem, problem.strength),
        cone=CONES[problem.cone],
    )


def strength_arrays(problem: Problem, strength: Strength) -> dict[str, NDArray]:
    """Return the fields of `KernelArrays` that hold the strength of contact points.

    Forces in the kernels are relative to the tensile strength: `f = z - (pull, 0, 0)` with `z` in the friction cone
    with tension cut-off. So the wrench of the tensile strength is a load, for the pairs that act.
    """
    pull, stick = strength.pull / problem.force_scale, strength.stick / problem.force_scale
    pair_of_point = np.repeat(np.arange(problem.pairs), np.diff(problem.pair_start))
    force = np.zeros((problem.pairs, 6))
    np.add.at(force, pair_of_point, -pull[:, None] * problem.basis[:, :, 0])
    arrays = {
        "friction": strength.friction,
        "pull": pull,
        "stick": stick,
        "tears": strength.tears,
        "pull_a": np.einsum("qij,qj->qi", problem.transfer_a, force),
        "pull_b": np.einsum("qij,qj->qi", problem.transfer_b, force),
    }
    for name, array in arrays.items():
        arrays[name] = array = np.array(array, order="C")
        array.setflags(write=False)
    return arrays


class Scratch(NamedTuple):
    """Scratch memory of one thread; pairs and points are in the compact order of the current state."""

    free: NDArray[np.bool_]
    """Which positions can move, shape (n,)."""
    slot_a: NDArray[np.int32]
    """Position of part `a` of each acting pair, -1 where it is held or boundary."""
    slot_b: NDArray[np.int32]
    pair: NDArray[np.int32]
    """Acting pairs."""
    start: NDArray[np.int32]
    """Acting pair `p` owns compact points `start[p]:start[p + 1]`."""
    basis: NDArray[np.float64]
    """Basis of the acting points, shape (points, 6, 3)."""
    force_scale: NDArray[np.float64]
    friction: NDArray[np.float64]
    pull: NDArray[np.float64]
    stick: NDArray[np.float64]
    tears: NDArray[np.bool_]
    pulled: NDArray[np.float64]
    """Sum of the tensile strengths of the acting points, N, shape (1,)."""
    load: NDArray[np.float64]
    """Whitened weight, loads and tensile strength of the acting points on the parts that can move, shape (n, 6)."""
    u: NDArray[np.float64]
    """ADMM iterate before projection, shape (points, 3)."""
    z: NDArray[np.float64]
    """Forces in the cone, shape (points, 3)."""
    v: NDArray[np.float64]
    weights: NDArray[np.float64]
    """Interior point: multipliers of the eight rays (or the force), shape (points, 8)."""
    slacks: NDArray[np.float64]
    weight_steps: NDArray[np.float64]
    slack_steps: NDArray[np.float64]
    products: NDArray[np.float64]
    """Products of the predicted steps of both."""
    velocity: NDArray[np.float64]
    """Shape (n, 6), whitened."""
    rhs: NDArray[np.float64]
    residual: NDArray[np.float64]
    proof: NDArray[np.float64]
    """Velocity of the largest bound so far."""
    panels: Panels
    """The matrix; `lay_out_panels` gives its blocks their places in a state."""


@njit(cache=True)
def make_scratch(structure):
    """Return scratch large enough for every state of a structure."""
    n = len(structure.elimination.order)
    pairs = len(structure.pair_parts)
    points = len(structure.basis)
    slot_a, slot_b, pair = np.zeros(pairs, np.int32), np.zeros(pairs, np.int32), np.zeros(pairs, np.int32)
    scale, friction, pull, stick = np.zeros(points), np.zeros(points), np.zeros(points), np.zeros(points)
    u, z, v = np.zeros((points, 3)), np.zeros((points, 3)), np.zeros((points, 3))
    velocity, rhs, residual, proof = np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((n, 6))
    start, basis, tears = np.zeros(pairs + 1, np.int32), np.empty((points, 6, 3)), np.zeros(points, np.bool_)
    weights, weight_steps, products = np.empty((points, 8)), np.empty((points, 8)), np.empty((points, 8))
    slacks, slack_steps = np.empty((points, 8)), np.empty((points, 8))
    free, pulled, load = np.zeros(n, np.bool_), np.zeros(1), np.zeros((n, 6))
    return Scratch(
        free, slot_a, slot_b, pair, start, basis, scale, friction, pull, stick, tears, pulled, load, u, z, v,
        weights, slacks, weight_steps, slack_steps, products, velocity, rhs, residual, proof,
        make_panels(structure.elimination, pairs),
    )  # fmt: skip


@njit(fastmath=FAST, cache=True)
def set_gravity(structure, state, out):
    """Write the whitened weight and loads of the parts that can move to `out`, shape (n, 6)."""
    gravity, order = structure.gravity, structure.elimination.order
    for j in range(len(order)):
        if state[order[j]] == 1:
            for r in range(6):
                out[j, r] = gravity[order[j], r]


@njit(cache=True)
def restrict(structure, state, work):
    """Copy the acting pairs and points of a state to the front of the scratch; return numbers of pairs and parts."""
    position, order = structure.elimination.position, structure.elimination.order
    parts, first, basis, scale = structure.pair_parts, structure.pair_start, structure.basis, structure.force_scale
    free, pair, start = work.free, work.pair, work.start
    slot_a, slot_b, local, local_scale = work.slot_a, work.slot_b, work.basis, work.force_scale
    friction, pull, stick, tears = structure.friction, structure.pull, structure.stick, structure.tears
    local_friction, local_pull, local_stick, local_tears = work.friction, work.pull, work.stick, work.tears
    pull_a, pull_b, load = structure.pull_a, structure.pull_b, work.load
    set_gravity(structure, state, load)
    pulled = 0.0
    count = 0
    for j in range(len(order)):
        free[j] = state[order[j]] == 1
        count += free[j]
    pairs = 0
    points = 0
    for q in range(len(parts)):
        a, b = parts[q, 0], parts[q, 1]
        if state[a] == 0 or state[b] == 0 or (state[a] == 2 and state[b] == 2):
            continue
        pair[pairs] = q
        slot_a[pairs] = position[a] if state[a] == 1 else -1
        slot_b[pairs] = position[b] if state[b] == 1 else -1
        start[pairs] = points
        for c in range(first[q], first[q + 1]):
            for i in range(6):
                for k in range(3):
                    local[points, i, k] = basis[c, i, k]
            local_scale[points] = scale[c]
            local_friction[points], local_pull[points] = friction[c], pull[c]
            local_stick[points], local_tears[points] = stick[c], tears[c]
            pulled += pull[c] * scale[c]
            points += 1
        for r in range(6):
            if slot_a[pairs] >= 0:
                load[slot_a[pairs], r] += pull_a[q, r]
            if slot_b[pairs] >= 0:
                load[slot_b[pairs], r] += pull_b[q, r]
        pairs += 1
    start[pairs] = points
    work.pulled[0] = pulled
    return pairs, count


# In every inner loop below: arrays in local names and elements by index. A field of a named tuple or a row
# view costs two atomic reference counts each time, which made an iteration six times slower.


@njit(inline="always", fastmath=FAST)
def _add_velocity(transfer, q, part, velocity, s0, s1, s2, s3, s4, s5):
    for r in range(6):
        w = velocity[part, r]
        s0 += transfer[q, r, 0] * w
        s1 += transfer[q, r, 1] * w
        s2 += transfer[q, r, 2] * w
        s3 += transfer[q, r, 3] * w
        s4 += transfer[q, r, 4] * w
        s5 += transfer[q, r, 5] * w
    return s0, s1, s2, s3, s4, s5


@njit(inline="always", fastmath=FAST)
def pair_velocity(transfer_a, transfer_b, q, a, b, velocity):
    """Return the relative velocity and rotation at the centre of pair `q`, six numbers.

    `a` and `b` are the positions of its parts, -1 where a part is held or boundary.
    """
    s0, s1, s2, s3, s4, s5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if a >= 0:
        s0, s1, s2, s3, s4, s5 = _add_velocity(transfer_a, q, a, velocity, s0, s1, s2, s3, s4, s5)
    if b >= 0:
        s0, s1, s2, s3, s4, s5 = _add_velocity(transfer_b, q, b, velocity, s0, s1, s2, s3, s4, s5)
    return s0, s1, s2, s3, s4, s5


@njit(inline="always", fastmath=FAST)
def _add_wrench(transfer, q, part, f0, f1, f2, f3, f4, f5, out):
    for r in range(6):
        out[part, r] += (
            transfer[q, r, 0] * f0
            + transfer[q, r, 1] * f1
            + transfer[q, r, 2] * f2
            + transfer[q, r, 3] * f3
            + transfer[q, r, 4] * f4
            + transfer[q, r, 5] * f5
        )


@njit(inline="always", fastmath=FAST)
def add_pair_wrench(transfer_a, transfer_b, q, a, b, f0, f1, f2, f3, f4, f5, out):
    """Add the six numbers of a force and moment at the centre of pair `q` to its parts that can move."""
    if a >= 0:
        _add_wrench(transfer_a, q, a, f0, f1, f2, f3, f4, f5, out)
    if b >= 0:
        _add_wrench(transfer_b, q, b, f0, f1, f2, f3, f4, f5, out)


@njit(inline="always", fastmath=FAST)
def point_velocity(basis, j, s0, s1, s2, s3, s4, s5):
    """Return the relative velocity of contact point `j` in its frame from the six numbers of its pair."""
    return (
        basis[j, 0, 0] * s0 + basis[j, 1, 0] * s1 + basis[j, 2, 0] * s2
        + basis[j, 3, 0] * s3 + basis[j, 4, 0] * s4 + basis[j, 5, 0] * s5,
        basis[j, 0, 1] * s0 + basis[j, 1, 1] * s1 + basis[j, 2, 1] * s2
        + basis[j, 3, 1] * s3 + basis[j, 4, 1] * s4 + basis[j, 5, 1] * s5,
        basis[j, 0, 2] * s0 + basis[j, 1, 2] * s1 + basis[j, 2, 2] * s2
        + basis[j, 3, 2] * s3 + basis[j, 4, 2] * s4 + basis[j, 5, 2] * s5,
    )  # fmt: skip


@njit(inline="always", fastmath=FAST)
def add_force(basis, j, f0, f1, f2, a0, a1, a2, a3, a4, a5):
    """Return the six numbers of a force and moment at the centre of a pair with a force at point `j` added."""
    return (
        a0 + (basis[j, 0, 0] * f0 + basis[j, 0, 1] * f1 + basis[j, 0, 2] * f2),
        a1 + (basis[j, 1, 0] * f0 + basis[j, 1, 1] * f1 + basis[j, 1, 2] * f2),
        a2 + (basis[j, 2, 0] * f0 + basis[j, 2, 1] * f1 + basis[j, 2, 2] * f2),
        a3 + (basis[j, 3, 0] * f0 + basis[j, 3, 1] * f1 + basis[j, 3, 2] * f2),
        a4 + (basis[j, 4, 0] * f0 + basis[j, 4, 1] * f1 + basis[j, 4, 2] * f2),
        a5 + (basis[j, 5, 0] * f0 + basis[j, 5, 1] * f1 + basis[j, 5, 2] * f2),
    )


@njit(fastmath=FAST, cache=True)
def copy_rows(free, rows, out):
    """Copy motions or wrenches of the parts that can move, shape (n, 6), to `out`."""
    for j in range(len(free)):
        if free[j]:
            for r in range(6):
                out[j, r] = rows[j, r]


@njit(cache=True)
def load_forces(structure, work, pairs, forces, out):
    """Write contact forces in N, shape (points, 3), as the scaled ones of the pairs in `work`, cohesion included."""
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            for r in range(3):
                out[j, r] = forces[j + shift, r] / work.force_scale[j]
            out[j, 0] += work.pull[j]


@njit(cache=True)
def store_forces(structure, work, pairs, forces):
    """Write `work.z` as contact forces in N, shape (points, 3); those of other points stay. Inverse of the above."""
    for p in range(pairs):
        shift = structure.pair_start[work.pair[p]] - work.start[p]
        for j in range(work.start[p], work.start[p + 1]):
            forces[j + shift, 0] = (work.z[j, 0] - work.pull[j]) * work.force_scale[j]
            for r in range(1, 3):
                forces[j + shift, r] = work.z[j, r] * work.force_scale[j]


@njit(cache=True)
def write_motion(structure, work, whitened, scale, out):
    """Write `scale` times a whitened motion, shape (n, 6), as that of the parts that can move, shape (parts, 6)."""
    order, turn = structure.elimination.order, structure.acceleration
    for j in range(len(work.free)):
        if work.free[j]:
            for r in range(6):
                total = 0.0
                for c in range(6):
                    total += turn[order[j], r, c] * whitened[j, c]
                out[order[j], r] = total * scale


@njit(inline="always", fastmath=FAST)
def add_wrench(structure, work, p, forces, out):
    """Add `G forces` of the points of one pair to `out`."""
    basis = work.basis
    a0, a1, a2, a3, a4, a5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(work.start[p], work.start[p + 1]):
        a0, a1, a2, a3, a4, a5 = add_force(basis, j, forces[j, 0], forces[j, 1], forces[j, 2], a0, a1, a2, a3, a4, a5)
    ta, tb, a, b = structure.transfer_a, structure.transfer_b, work.slot_a[p], work.slot_b[p]
    add_pair_wrench(ta, tb, work.pair[p], a, b, a0, a1, a2, a3, a4, a5, out)


@njit(fastmath=FAST, cache=True)
def add_wrenches(structure, work, pairs, forces, out):
    """Add `G forces` to `out`."""
    for p in range(pairs):
        add_wrench(structure, work, p, forces, out)


@njit(fastmath=FAST, cache=True)
def dot(work, left, right):
    """Return the inner product over the parts that can move."""
    free = work.free
    total = 0.0
    for j in range(len(free)):
        if free[j]:
            for i in range(6):
                total += left[j, i] * right[j, i]
    return total

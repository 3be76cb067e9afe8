"""Sparse block elimination of `S`: symbolic once per structure, numeric once per state.

`S` has one 6 x 6 block row a part that can move, and a block wherever two such parts touch. Removing or
holding parts only takes rows away, and the fill of a subgraph lies inside the fill of the whole graph
under the same order; so one symbolic elimination of the complete structure serves every state.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.stability.problem import Problem
from falsework.utils.kernels import njit


class Elimination(NamedTuple):
    """Pattern of the block factor `L D L^T` of a structure, in elimination order."""

    order: NDArray[np.int32]
    """Part at each position, shape (n,); boundary parts are left out."""
    position: NDArray[np.int32]
    """Position of each part, -1 for boundary, shape (parts,)."""
    column: NDArray[np.int32]
    """Column `j` owns blocks `column[j]:column[j + 1]`, shape (n + 1,)."""
    row: NDArray[np.int32]
    """Row position of each block below the diagonal, ascending in a column, shape (blocks,)."""
    first_target: NDArray[np.int64]
    """Where a block's update targets start, shape (blocks + 1,)."""
    target: NDArray[np.int32]
    """For block `e2` and each later block `e1` of its column: the block that `L_e1 D L_e2^T` is taken from."""
    pair_block: NDArray[np.int32]
    """Block of each pair of parts, -1 where one is boundary, shape (pairs,)."""


def eliminate(problem: Problem) -> Elimination:
    """Return the order the parts by minimum degree and find the fill (George and Liu, 1981, chapter 5)."""
    removable = np.flatnonzero(~problem.boundary)
    neighbours: dict[int, set[int]] = {int(part): set() for part in removable}
    for a, b in problem.pair_parts.tolist():
        if a in neighbours and b in neighbours:
            neighbours[a].add(b)
            neighbours[b].add(a)
    order, below = _minimum_degree(neighbours)

    position = np.full(problem.parts, -1, dtype=np.int32)
    position[order] = np.arange(len(order))
    column = np.zeros(len(order) + 1, dtype=np.int32)
    rows: list[list[int]] = [sorted(int(position[part]) for part in below[part_j]) for part_j in order]
    column[1:] = np.cumsum([len(entries) for entries in rows])
    block_of = {(i, j): int(column[j]) + offset for j, entries in enumerate(rows) for offset, i in enumerate(entries)}
    first_target, target = [0], []
    for entries in rows:
        for offset, i2 in enumerate(entries):
            target.extend(block_of[i1, i2] for i1 in entries[offset + 1 :])
            first_target.append(len(target))
    pair_block = np.full(problem.pairs, -1, dtype=np.int32)
    for q, (a, b) in enumerate(problem.pair_parts.tolist()):
        i, j = int(position[a]), int(position[b])
        if i >= 0 and j >= 0:
            pair_block[q] = block_of[max(i, j), min(i, j)]
    return Elimination(
        order=np.array(order, dtype=np.int32),
        position=position,
        column=column,
        row=np.array([i for entries in rows for i in entries], dtype=np.int32),
        first_target=np.array(first_target, dtype=np.int64),
        target=np.array(target, dtype=np.int32),
        pair_block=pair_block,
    )


def _minimum_degree(neighbours: dict[int, set[int]]) -> tuple[list[int], dict[int, set[int]]]:
    """Elimination order, and the later parts that each part is coupled to when its turn comes."""
    order: list[int] = []
    below: dict[int, set[int]] = {}
    while neighbours:
        part = min(neighbours, key=lambda candidate: (len(neighbours[candidate]), candidate))
        clique = neighbours.pop(part)
        order.append(part)
        below[part] = clique
        for other in clique:
            neighbours[other] |= clique
            neighbours[other] -= {other, part}
    return order, below


@njit(inline="always", fastmath=True)
def _invert(block, b, inverse):
    """Inverse of the symmetric positive definite block `block[b]` by its Cholesky factor; False if it is not."""
    for i in range(6):
        for j in range(i + 1):
            total = block[b, i, j]
            for k in range(j):
                total -= inverse[i, k] * inverse[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                inverse[i, i] = np.sqrt(total)
            else:
                inverse[i, j] = total / inverse[j, j]
    # Invert the lower triangle in place, then form L^-T L^-1.
    for j in range(6):
        inverse[j, j] = 1.0 / inverse[j, j]
        for i in range(j + 1, 6):
            total = 0.0
            for k in range(j, i):
                total -= inverse[i, k] * inverse[k, j]
            inverse[i, j] = total / inverse[i, i]
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, 6):
                total += inverse[k, i] * inverse[k, j]
            inverse[i, j] = total
    for i in range(6):
        for j in range(i):
            inverse[j, i] = inverse[i, j]
    return True


@njit(inline="always", fastmath=True)
def _subtract_product(left, e, right, out, t):
    """`out[t] -= left[e] right^T`."""
    for r in range(6):
        for c in range(6):
            total = 0.0
            for k in range(6):
                total += left[e, r, k] * right[c, k]
            out[t, r, c] -= total


@njit(fastmath=True, cache=True)
def factor(elimination, free, diagonal, lower, filled):
    """Replace `S` by its factor: `diagonal` becomes `D^-1`, `lower` becomes `L`.

    Args:
        elimination: the structure's pattern.
        free: which positions take part, shape (n,).
        diagonal: diagonal blocks of `S`, shape (n, 6, 6); overwritten.
        lower: blocks below the diagonal, zero where `S` has none, shape (blocks, 6, 6); overwritten.
        filled: which blocks are not zero, shape (blocks,); fill is marked as it appears.

    Returns:
        False if a pivot is not positive.
    """
    column, row = elimination.column, elimination.row
    first_target, target = elimination.first_target, elimination.target
    scaled, inverse = np.empty((6, 6)), np.empty((6, 6))
    for j in range(len(free)):
        if not free[j]:
            continue
        if not _invert(diagonal, j, inverse):
            return False
        for r in range(6):
            for c in range(6):
                diagonal[j, r, c] = inverse[r, c]
        for e2 in range(column[j], column[j + 1]):
            if not filled[e2]:
                continue
            for r in range(6):  # scaled = A_e2 D^-1, the block of L
                for c in range(6):
                    total = 0.0
                    for k in range(6):
                        total += lower[e2, r, k] * inverse[k, c]
                    scaled[r, c] = total
            _subtract_product(lower, e2, scaled, diagonal, row[e2])
            for e1 in range(e2 + 1, column[j + 1]):
                if filled[e1]:
                    t = target[first_target[e2] + e1 - e2 - 1]
                    filled[t] = True
                    _subtract_product(lower, e1, scaled, lower, t)
            for r in range(6):
                for c in range(6):
                    lower[e2, r, c] = scaled[r, c]
    return True


@njit(inline="always", fastmath=True)
def eliminate_below(column, row, lower, filled, x, j):
    """Forward substitution of column `j`: subtract `L_ij x_j` from every later row."""
    x0, x1, x2, x3, x4, x5 = x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4], x[j, 5]
    for e in range(column[j], column[j + 1]):
        if filled[e]:
            i = row[e]
            for r in range(6):
                x[i, r] -= (
                    lower[e, r, 0] * x0
                    + lower[e, r, 1] * x1
                    + lower[e, r, 2] * x2
                    + lower[e, r, 3] * x3
                    + lower[e, r, 4] * x4
                    + lower[e, r, 5] * x5
                )


@njit(inline="always", fastmath=True)
def substitute_back(column, row, upper, filled, x, j):
    """Backward substitution of row `j`: subtract `U_ji x_i`; `upper` holds the blocks `U_ji^T`."""
    for e in range(column[j], column[j + 1]):
        if filled[e]:
            i = row[e]
            x0, x1, x2, x3, x4, x5 = x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5]
            for c in range(6):
                x[j, c] -= (
                    upper[e, 0, c] * x0
                    + upper[e, 1, c] * x1
                    + upper[e, 2, c] * x2
                    + upper[e, 3, c] * x3
                    + upper[e, 4, c] * x4
                    + upper[e, 5, c] * x5
                )


@njit(inline="always", fastmath=True)
def apply_block(diagonal, x, j):
    """`x[j] = diagonal[j] x[j]`."""
    x0, x1, x2, x3, x4, x5 = x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4], x[j, 5]
    for r in range(6):
        x[j, r] = (
            diagonal[j, r, 0] * x0
            + diagonal[j, r, 1] * x1
            + diagonal[j, r, 2] * x2
            + diagonal[j, r, 3] * x3
            + diagonal[j, r, 4] * x4
            + diagonal[j, r, 5] * x5
        )


@njit(fastmath=True, cache=True)
def solve(elimination, free, diagonal, lower, filled, x):
    """Solve `S x = b` in place with the factor made by `factor`; `x` has shape (n, 6)."""
    column, row = elimination.column, elimination.row
    n = len(free)
    for j in range(n):
        if free[j]:
            eliminate_below(column, row, lower, filled, x, j)
            apply_block(diagonal, x, j)
    for j in range(n - 1, -1, -1):
        if free[j]:
            substitute_back(column, row, lower, filled, x, j)

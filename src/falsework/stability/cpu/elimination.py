"""Symbolic elimination of block matrices with the pattern of `S`: once per structure, and cut down to each state.

`S` has one 6 x 6 block row per part that can move, and a block wherever two of them touch. Consecutive positions with
much the same fill are a supernode; its rows and columns are dense panels (`panels.py`). Removing or holding parts only
takes rows away, and the fill of a subgraph lies inside the fill of the whole graph under the same order; so the pattern
of the complete structure bounds that of every state.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.stability.cpu.products import LANES
from falsework.stability.problem import Problem
from falsework.utils.kernels import njit

_ZEROS = 0.05
"""Share of zeros in the panels of two supernodes up to which they become one."""


class Elimination(NamedTuple):
    """Pattern of the block factors of a structure, in elimination order."""

    order: NDArray[np.int32]
    """Part at each position, shape (n,); boundary parts are left out."""
    position: NDArray[np.int32]
    """Position of each part, -1 for boundary, shape (parts,)."""
    start: NDArray[np.int32]
    """Supernode `s` has the positions `start[s]:start[s + 1]`, shape (supernodes + 1,)."""
    supernode: NDArray[np.int32]
    """Supernode of each position, shape (n,)."""
    row_start: NDArray[np.int32]
    """Supernode `s` has the rows `row[row_start[s]:row_start[s + 1]]` below it, shape (supernodes + 1,)."""
    row: NDArray[np.int32]
    """Positions, ascending in a supernode."""


class Panels(NamedTuple):
    """Panels of the state at hand, for one thread. Members of a supernode are its own free positions, then its rows.

    A panel has six rows an own position, and six columns a member. Entry `(6 i + r, 6 j + c)` of the upper one is entry
    `(r, c)` of the block in row `i` and column `j`, and entry `(c, r)` of block `(j, i)` of the lower one. Diagonal
    blocks are in the upper one; left of them there is nothing of meaning.
    """

    upper: NDArray[np.float64]
    """All panels in one; row pivots, and their inverses and `U` once factored."""
    lower: NDArray[np.float64]
    """The same of the transposes below the diagonal; `L^T` once factored."""
    panel: NDArray[np.int64]
    """Where the panels of each supernode start in both, shape (supernodes + 1,)."""
    width: NDArray[np.int64]
    """Numbers in a row of its panels."""
    own: NDArray[np.int64]
    """How many of its positions are free; the panels of a supernode without are empty."""
    member_start: NDArray[np.int64]
    """Where its members start in `member`, shape (supernodes + 1,)."""
    member: NDArray[np.int64]
    """Positions."""
    diagonal: NDArray[np.int64]
    """Where the diagonal block of each free position is in `upper`, shape (n,)."""
    block: NDArray[np.int64]
    """Where the block of each pair of two free parts is in both, row of the earlier position, shape (pairs,)."""
    place: NDArray[np.int64]
    """Scratch: places of positions among the members of a supernode, shape (n,)."""
    mark: NDArray[np.int64]
    """Scratch: the last supernode that was seen to reach each position, shape (n,)."""
    head: NDArray[np.int64]
    """Scratch: first of the supernodes that wait for each supernode, -1 without; shape (supernodes,)."""
    following: NDArray[np.int64]
    """Scratch: the next that waits for the same."""
    used: NDArray[np.int64]
    """Scratch: first member of each supernode whose row it has not updated."""
    strip: NDArray[np.float64]
    """Scratch: numbers at the members of a supernode, shape (widest,)."""


def eliminate(problem: Problem) -> Elimination:
    """Order the parts by minimum degree (Liu, 1985), as SuperLU does, and join its columns into supernodes."""
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    parts = np.flatnonzero(~problem.boundary)
    position = np.full(problem.parts, -1, dtype=np.int32)
    position[parts] = np.arange(len(parts))
    ends = position[problem.pair_parts]
    ends = ends[(ends >= 0).all(axis=1)].T
    order, start, below = np.zeros(0, np.int64), [0], list[NDArray[np.int64]]()
    if len(parts):
        # Of the factors only the order counts: among thousands of parts entries of the fill are less than any number.
        entries = np.r_[np.full(len(parts), 1.0 + ends.shape[1]), np.full(ends.size, -1.0)]
        places = np.hstack([np.tile(np.arange(len(parts)), (2, 1)), ends, ends[::-1]])
        matrix = csc_array((entries, (places[0], places[1])))
        options = {"SymmetricMode": True}
        rank = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).perm_c
        found = _fill(rank[ends], len(parts))
        new = _postorder([int(row[0]) if len(row) else -1 for row in found])
        number = np.argsort(new)
        order, rows = np.argsort(rank)[new], [np.sort(number[found[j]]) for j in new]
        start = _supernodes([len(row) for row in rows], [int(row[0]) if len(row) else -1 for row in rows])
        below = [rows[last - 1] for last in start[1:]]
    position[parts[order]] = np.arange(len(parts))
    sizes = np.diff(start)
    return Elimination(
        order=parts[order].astype(np.int32),
        position=position,
        start=np.array(start, dtype=np.int32),
        supernode=np.repeat(np.arange(len(sizes)), sizes).astype(np.int32),
        row_start=np.cumsum([0, *map(len, below)]).astype(np.int32),
        row=np.concatenate([*below, np.zeros(0)]).astype(np.int32),
    )


def _fill(ends: NDArray[np.integer], count: int) -> list[NDArray[np.integer]]:
    """Return the rows below each diagonal entry of the factors, ascending.

    Those of a position are what it touches, and the rows of its children in the elimination tree (Liu, 1990).

    Args:
        ends: positions of pairs that touch, shape (2, pairs).
        count: number of positions.
    """
    first, last = ends.min(axis=0), ends.max(axis=0)
    by_first = np.argsort(first, kind="stable")
    touched = np.split(last[by_first], np.cumsum(np.bincount(first, minlength=count))[:-1])
    rows: list[NDArray[np.integer]] = []
    children: list[list[int]] = [[] for _ in range(count)]
    for j in range(count):
        rows.append(np.unique(np.concatenate([touched[j], *(rows[child][1:] for child in children[j])])))
        if len(rows[j]):
            children[rows[j][0]].append(j)
    return rows


def _postorder(parent: list[int]) -> list[int]:
    """Return positions with each subtree of the elimination tree in a row, children first; -1 is parent of roots."""
    children: list[list[int]] = [[] for _ in range(len(parent) + 1)]
    for j, above in enumerate(parent):
        children[above].append(j)
    order, ahead = [], children[-1]
    while ahead:  # parents first, from the last root; then turned round
        order.append(ahead.pop())
        ahead += children[order[-1]]
    return order[::-1]


def _supernodes(below: list[int], parent: list[int]) -> list[int]:
    """Return where supernodes start, with the end, by the rows below each position and its parent, -1 for roots."""
    found: list[tuple[int, int]] = []  # first position, and zeros in the panels
    for j, rows in enumerate(below):
        first, zeros = j, 0
        while found and first <= parent[first - 1] <= j:
            before, more = found[-1]
            size = j + 1 - before
            more += zeros + (first - before) * (j + 1 - first + rows - below[first - 1])
            if more > _ZEROS * size * (size + rows):
                break
            found.pop()
            first, zeros = before, more
        found.append((first, zeros))
    return [*(first for first, _ in found), len(below)]


@njit(cache=True)
def make_panels(elimination, pairs):
    """Return panels large enough for every state of a structure with so many pairs of parts."""
    start, row_start = elimination.start, elimination.row_start
    n, count = len(elimination.order), len(start) - 1
    entries, members, widest = 0, 0, 0
    for s in range(count):
        size = start[s + 1] - start[s]
        width = _padded(6 * (size + row_start[s + 1] - row_start[s]))
        entries += 6 * size * width
        members += size + row_start[s + 1] - row_start[s]
        widest = max(widest, width)
    return Panels(
        # Not filled, lest a few parts cost what all do; blocks are added in rows of eight.
        np.empty(entries + LANES),
        np.empty(entries + LANES),
        np.zeros(count + 1, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count + 1, np.int64),
        np.zeros(members, np.int64),
        np.zeros(n, np.int64),
        np.zeros(pairs, np.int64),
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        np.empty(widest),
    )


@njit(inline="always")
def _padded(size):
    return (size + LANES - 1) // LANES * LANES


@njit(cache=True)
def lay_out_panels(structure, free, panels):
    """Find the fill of a state, whose parts at the positions `free` can move, and give each block its place.

    Every later position that a free one touches is marked for its supernode, and so is what its children in the
    elimination tree have below them.
    """
    elimination = structure.elimination
    start, supernode, row_start, row = elimination.start, elimination.supernode, elimination.row_start, elimination.row
    order, position = elimination.order, elimination.position
    first_pair, pair, parts = structure.neighbour_start, structure.neighbour_pair, structure.pair_parts
    panel, width, own, member_start, member = (
        panels.panel,
        panels.width,
        panels.own,
        panels.member_start,
        panels.member,
    )
    head, following, place, mark = panels.head, panels.following, panels.place, panels.mark
    diagonal, block = panels.diagonal, panels.block
    mark[:] = -1
    head[:] = -1
    entries, members = 0, 0
    for s in range(len(own)):
        begin, after = members, start[s + 1]
        member_start[s], panel[s] = begin, entries
        for j in range(start[s], after):
            if free[j]:
                member[members] = j
                members += 1
        own[s] = members - begin
        if members == begin:
            continue
        for m in range(begin, members):
            part = order[member[m]]
            for k in range(first_pair[part], first_pair[part + 1]):
                q = pair[k]
                i = position[parts[q, 0] + parts[q, 1] - part]
                if i >= after and free[i]:
                    mark[i] = s
        child = head[s]
        while child >= 0:
            for m in range(member_start[child] + own[child], member_start[child + 1]):
                if member[m] >= after:
                    mark[member[m]] = s
            child = following[child]
        for k in range(row_start[s], row_start[s + 1]):
            if mark[row[k]] == s:
                member[members] = row[k]
                members += 1
        member_start[s + 1] = members  # for its parent
        if members > begin + own[s]:
            above = supernode[member[begin + own[s]]]
            following[s], head[above] = head[above], s
        width[s] = _padded(6 * (members - begin))
        for m in range(begin, members):
            place[member[m]] = m - begin
        for m in range(begin, begin + own[s]):
            j = member[m]
            line = entries + 6 * (m - begin) * width[s]
            part = order[j]
            for k in range(first_pair[part], first_pair[part + 1]):
                q = pair[k]
                i = position[parts[q, 0] + parts[q, 1] - part]
                if i > j and free[i]:
                    block[q] = line + 6 * place[i]
            diagonal[j] = line + 6 * (m - begin)
        entries += 6 * own[s] * width[s]
    member_start[len(own)], panel[len(own)] = members, entries

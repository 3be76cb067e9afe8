"""Several parts in one step against an enumeration that shares neither geometry nor rules with the package."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import combinations, product
from math import gcd

import numpy as np
import pytest

from falsework.assembly import Assembly
from falsework.assembly.library.blocks import box, gather, prism
from falsework.assembly.library.voxels import _grow, surface
from falsework.errors import InputError
from falsework.search import Outcome, Task, find_plans
from falsework.search.find import task_of
from falsework.search.problem.task import Direction
from falsework.search.problem.together import TogetherMoves
from falsework.search.together import TogetherBeam
from falsework.stability import Stability, StabilitySettings, Verdict, Verdicts

EDGE = 0.1
SETTINGS = StabilitySettings(criterion="equilibrium")
Cells = frozenset[tuple[int, int, int]]


def assembly_of(pieces: list[Cells]) -> Assembly:
    """Pieces of cubes on a slab that reaches two cubes beyond a region of three by three."""
    solids = [surface("piece", piece, (EDGE,) * 3, (0.0, 0.0, 0.0)) for piece in pieces]
    solids.append(box("slab", (-2 * EDGE, -2 * EDGE, -EDGE), (5 * EDGE, 5 * EDGE, 0.0), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


def drawn(seed: int, count: int, region: tuple[int, int, int]) -> list[Cells]:
    """Cut a box of cubes at random into connected pieces."""
    rng = np.random.default_rng(seed)
    while True:
        pieces = _grow(sorted(product(*map(range, region))), count, rng)
        if pieces is not None:
            return [frozenset(piece) for piece in pieces]


class EveryStateStands:
    """Oracle for which only geometry matters."""

    holds_keep_stable = True
    settings = SETTINGS

    def verdicts(self, states, *, near=None, require_certificate=False):
        verdicts = Verdicts.blank(len(states))
        verdicts.verdict[:] = Verdict.STABLE
        return verdicts


class Enumeration:
    """All plans of boxes, counted by plain recursion.

    Boxes that move along `d` hit others in an open convex cone of directions. A direction that is in none of some cones
    exists if and only if one exists in which two of the planes that bound them meet.
    """

    def __init__(self, pieces: list[Cells], robots: int, largest: int, stands=lambda state: True) -> None:
        boxes = [[(np.array(c), np.array(c) + 1) for c in piece] for piece in pieces]
        boxes.append([(np.array([-2, -2, -1]), np.array([5, 5, 0]))])
        self.pieces, self.count, self.robots, self.largest, self.stands = pieces, len(pieces), robots, largest, stands
        self.gaps = {
            (i, j): [(b[0] - a[1], b[1] - a[0]) for a in boxes[i] for b in boxes[j]]
            for i in range(self.count)
            for j in range(self.count + 1)
            if i != j
        }
        self.ways = self._directions()
        self.hits = {pair: self._hit(pair, self.ways) for pair in self.gaps}
        self.grid = np.array([v for v in product((-2, -1, 0, 1, 2), repeat=3) if any(v)])
        self.number = {tuple(v): k for k, v in enumerate(self.grid.tolist())}
        self.grid_hits = {pair: self._hit(pair, self.grid) for pair in self.gaps}
        self.leaves, self.carries = lru_cache(None)(self._leaves), lru_cache(None)(self._carries)

    def _directions(self) -> np.ndarray:
        planes = set()
        for gaps in self.gaps.values():
            for low, high in gaps:
                for axis in range(3):
                    u, v = [k for k in range(3) if k != axis]
                    for a, b in product((low[u], high[u]), (low[v], high[v])):
                        normal = [0, 0, 0]
                        normal[u], normal[v] = -int(b), int(a)
                        planes.add(self._reduced(normal))
        planes.discard((0, 0, 0))
        planes = np.array(sorted(planes))
        first, second = np.triu_indices(len(planes), 1)
        found = {self._reduced(d) for d in np.cross(planes[first], planes[second]).tolist()}
        found |= {tuple(-x for x in d) for d in found}
        found.discard((0, 0, 0))
        return np.array(sorted(found))

    @staticmethod
    def _reduced(vector) -> tuple[int, ...]:
        by = gcd(*map(int, vector)) or 1
        return tuple(int(x) // by for x in vector)

    def _hit(self, pair: tuple[int, int], ways: np.ndarray) -> np.ndarray:
        hit = np.zeros(len(ways), dtype=bool)
        for low, high in self.gaps[pair]:
            begin, end = np.zeros(len(ways)), np.full(len(ways), np.inf)
            for axis in range(3):
                d = ways[:, axis].astype(float)
                with np.errstate(divide="ignore", invalid="ignore"):
                    one, two = low[axis] / d, high[axis] / d
                still = d == 0
                begin = np.maximum(begin, np.where(still, -np.inf, np.minimum(one, two)))
                end = np.minimum(end, np.where(still, np.inf, np.maximum(one, two)))
                begin[still & ~((low[axis] < 0) & (high[axis] > 0))] = np.inf
            hit |= begin < end - 1e-9
        return hit

    def _leaves(self, parts: tuple[int, ...], others: frozenset[int], apart: bool) -> bool:
        """Whether parts leave past others and the slab along one direction, or, with `apart`, several."""
        rest = [*others, self.count]
        if not np.any([self.hits[i, j] for i in parts for j in rest], axis=0).all():
            return True
        if not apart or len(parts) == 1:
            return False
        unit = [v for v in product((-1, 0, 1), repeat=3) if any(v)]
        own = [[v for v in unit if not any(self.grid_hits[i, j][self.number[v]] for j in rest)] for i in parts]
        for velocities in product(*own):
            between = [
                (i, j, tuple(np.subtract(v, w).tolist()))
                for (i, v), (j, w) in combinations(zip(parts, velocities, strict=True), 2)
            ]
            if all(not any(w) or not self.grid_hits[i, j][self.number[w]] for i, j, w in between):
                return True
        return False

    def together(self, parts: tuple[int, ...], others: frozenset[int], apart: bool) -> bool:
        """Whether parts leave, and no fewer of them past the rest."""
        fewer = [some for count in range(1, len(parts)) for some in combinations(parts, count)]
        straight = self.leaves(parts, others, False)
        blocked = not any(self.leaves(some, others | set(parts) - set(some), False) for some in fewer)
        if straight or not apart:
            return straight and blocked
        still = not any(self.leaves(some, others | set(parts) - set(some), True) for some in fewer)
        return still and self.leaves(parts, others, True)

    def _carries(self, parts: tuple[int, ...], carrier: int) -> bool:
        meshes = [assembly_of(self.pieces).meshes[part] for part in parts]
        reached, left = {carrier}, True
        while left:
            left = {
                j
                for i in reached
                for j in set(parts) - reached
                if any(sum(abs(np.subtract(a, b))) == 1 for a in self.pieces[i] for b in self.pieces[j])
            }
            reached |= left
        if reached != set(parts):
            return False
        group = Assembly.from_meshes(meshes, boundary=[parts.index(carrier)])
        state = np.where(group.boundary, 2, 1).astype(np.uint8)
        return bool(Stability(group, SETTINGS).verdicts(state).stable[0])

    def after(self, state: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        there = [part for part in range(self.count) if state[part]]
        held = [part for part in there if state[part] == 2]
        for part in there:
            if state[part] == 1 and len(held) < self.robots:
                yield self._with(state, (part,), 2)
        for size in range(1, self.largest + 1):
            for parts in combinations(there, size):
                by = [part for part in parts if part in held]
                others = frozenset(there) - set(parts)
                if len(by) == size and self.together(parts, others, apart=True):
                    yield self._with(state, parts, 0)
                elif len(by) == 1 < size and self.together(parts, others, apart=False) and self.carries(parts, by[0]):
                    yield self._with(state, parts, 0)

    @staticmethod
    def _with(state, parts, value) -> tuple[int, ...]:
        return tuple(value if part in parts else old for part, old in enumerate(state))

    def plans(self) -> int:
        @lru_cache(None)
        def count(state: tuple[int, ...]) -> int:
            if not any(state):
                return 1
            return sum(count(after) for after in self.after(state) if self.stands(after))

        return count((1,) * self.count)


def plans_of(task: Task, oracle) -> int:
    """Count the plans of a task by its own moves."""
    moves = TogetherMoves(task, oracle)

    @lru_cache(None)
    def count(key: bytes) -> int:
        state = np.frombuffer(key, dtype=np.uint8)
        if (state == task.target).all():
            return 1
        after, _ = moves.after(state, Direction.DISASSEMBLY)
        stable = oracle.verdicts(after).stable if len(after) else ()
        return sum(count(row.tobytes()) for row, good in zip(after, stable, strict=True) if good)

    return count(task.start.tobytes())


def diverging() -> Assembly:
    """Two parts in channels that lead up to both sides; each has a tongue below a lip of the other, along x.

    Neither leaves without the other, and they leave along different directions only.
    """
    lines_x, lines_y = [-1.5, -0.5, 0.0, 0.5, 1.5], [0.0, 0.3, 0.6, 0.9]
    levels = {0.0: (-0.5, 0.25, 1.0, 2.0), 0.5: (0.0, 0.25, 0.5, 1.5), 1.5: (1.0, 1.25, 1.5, 2.5)}
    owner = {(y, z): "b" if (y, z) in ((0, 1), (2, 0)) else "a" for y, z in [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)]}
    cells = {"a": [(3, y, z) for y in range(3) for z in range(3)], "b": [(0, y, z) for y in range(3) for z in range(3)]}
    for x, ((y, z), name) in product((1, 2), owner.items()):
        cells[name].append((x, y, z))
    solids = []
    for name in ("a", "b"):
        solid = surface(name, frozenset(cells[name]), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
        index = np.rint(solid.vertices).astype(int)
        corners = [(lines_x[i], lines_y[j], levels[abs(lines_x[i])][k]) for i, j, k in index.tolist()]
        solids.append(replace(solid, vertices=np.array(corners)))
    for side in (-1, 1):
        ring = [(0.0, 0.0, -0.5), (2.0 * side, 0.0, 1.5), (2.0 * side, 0.0, -1.5), (0.0, 0.0, -1.5)]
        solids.append(prism("floor", ring[::side], (0.0, 0.9, 0.0), fixed=True))
        low = -0.2 if side < 0 else 0.9
        solids.append(box("wall", (-2.0, low, -1.5), (2.0, low + 0.2, 3.0), fixed=True))
    solids.append(prism("roof", [(0.0, 0.0, 1.0), (2.0, 0.0, 3.0), (-2.0, 0.0, 3.0)], (0.0, 0.9, 0.0), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)

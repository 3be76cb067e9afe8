"""Plans of small structures in which parts leave in several moves, as many as an enumeration by cells counts."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import combinations, product

import numpy as np
import pytest

from falsework import make_task
from falsework.assembly.library.voxels import grow_pieces
from falsework.search import ExhaustiveSearch
from tests.geometry.test_exit_paths import Cells, fewest_moves, solid, structure
from tests.search.test_together import EveryStateStands, plans_of

FLOOR: Cells = frozenset(product(range(-1, 4), range(-1, 4), [-1]))


def drawn(seed: int, count: int) -> tuple[Cells, ...]:
    """A cube of cells cut into pieces at random."""
    rng = np.random.default_rng(seed)
    while True:
        pieces = grow_pieces([(x, y, z) for x, y, z in product(range(3), repeat=3)], count, rng)
        if pieces:
            return tuple(frozenset(piece) for piece in pieces)


@lru_cache(None)
def counted(pieces: tuple[Cells, ...], robots: int, most: int, largest: int = 1) -> int:
    """Orders of holding and removing pieces; those that are held leave in so many moves, others held may move aside.

    Up to `largest` leave together where no fewer of them do, in one move or in so many.
    """

    @lru_cache(None)
    def leave(state: tuple[int, ...], some: tuple[int, ...], most: int) -> bool:
        rest = FLOOR.union(*(pieces[one] for one, there in enumerate(state) if there == 1))
        aside = tuple(pieces[one] for one, there in enumerate(state) if there == 2 and one not in some)
        first, *beside = (pieces[one] for one in some)
        return (fewest_moves(first, rest, most, aside, tuple(beside)) or most + 1) <= most

    @lru_cache(None)
    def plans(state: tuple[int, ...]) -> int:
        if not any(state):
            return 1
        held, total = [part for part, value in enumerate(state) if value == 2], 0
        for part, value in enumerate(state):
            if value == 1 and len(held) < robots:
                total += plans((*state[:part], 2, *state[part + 1 :]))
        for size in range(1, largest + 1):
            for some in combinations(held, size):
                fewer = [few for count in range(1, size) for few in combinations(some, count)]
                ways = {moves for moves in (1, most) if leave(state, some, moves)}
                if any(not any(leave(state, few, moves) for few in fewer) for moves in ways):
                    total += plans(tuple(0 if part in some else value for part, value in enumerate(state)))
        return total

    return plans((1,) * len(pieces))


CASES = [
    (4, 2, 1, 2, 0), (11, 3, 1, 3, 2), (5, 3, 2, 2, 12), (13, 3, 2, 2, 24), (11, 3, 3, 2, 30), (0, 4, 1, 2, 2),
    (8, 5, 1, 2, 4), (1, 6, 1, 2, 24),
]  # fmt: skip
"""Seed, pieces, robots, moves, and how many plans there are more than with one move."""


@pytest.mark.parametrize(("seed", "count", "robots", "most", "more"), CASES)
@pytest.mark.parametrize("turned", [False, True])
def test_as_many_plans_with_several_moves_as_an_enumeration_by_cells(
    seed: int, count: int, robots: int, most: int, more: int, turned: bool
) -> None:
    """Along the axes, and about the vertical, where no grid helps; two to six pieces."""
    pieces = drawn(seed, count)
    solids = [*map(solid, pieces), solid(FLOOR, fixed=True)]
    angle = 0.3 * turned
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    assembly = structure(*(replace(one, vertices=one.vertices @ turn.T) for one in solids))
    expected = [counted(pieces, robots, moves) for moves in range(1, most + 1)]
    assert expected[-1] - expected[0] == more
    if turned and count > 4:
        expected = expected[:1]  # hundreds of states, and a search with swept tests in each
    for moves, number in enumerate(expected, 1):
        task = make_task(assembly, robots, moves=moves, removable_only_if_clear=True)
        assert ExhaustiveSearch(task, EveryStateStands()).run().plans == number


@pytest.mark.parametrize(
    ("seed", "count", "robots", "more"), [(11, 3, 2, 8), (11, 3, 3, 20), (5, 3, 2, 0), (0, 4, 2, 0)]
)
def test_as_many_plans_with_several_parts_in_several_moves(
    seed: int, count: int, robots: int, more: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two at once in two moves, where each is held: more than one at a time where they open anything."""
    monkeypatch.setattr(EveryStateStands, "settings", None)  # says of no group whether a robot can carry it
    pieces = drawn(seed, count)
    assembly = structure(*map(solid, pieces), solid(FLOOR, fixed=True))
    expected = counted(pieces, robots, 2, 2)
    assert expected - counted(pieces, robots, 2) == more
    assert plans_of(make_task(assembly, robots, moves=2, parts_at_once=2), EveryStateStands()) == expected

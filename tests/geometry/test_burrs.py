"""Burrs of six sticks at their published levels: the moves that it takes until the first stick is out.

Pieces have the numbers of Cutler's notation (A Computer Analysis of All 6-Piece Burrs, 1994): bits of the number less
one say which of the twelve inner cubes of a stick of 2 by 2 by 6 are cut away.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import permutations, product

import numpy as np
import pytest

from falsework import Outcome, StabilitySettings, find_plans
from falsework.geometry.clearance.moves import after
from falsework.geometry.paths.path_search import PathSearch
from falsework.search.plans.plan_check import validate_plan
from tests.geometry.test_exit_paths import EDGE, Cells, motions_of, solid, structure

BURRS = {
    "Philippe Dubois": ((120, 160, 256, 512, 880, 960), 6),
    "Piston, by Peter Marineau": ((88, 512, 768, 922, 1008, 1008), 9),
    "Artifactory 5/4": ((412, 480, 512, 704, 704, 960), 5),
}
KEYED = {
    "Yamato": (1, 188, 824, 975, 1024, 1024),
    "Chinese cross": (1, 256, 824, 975, 928, 1024),
    "Hoffmann": (1, 188, 256, 960, 975, 1024),
}
"""Solid burrs, whose first stick is a key that slides out in one move."""
CUBES = [(x, y, 1) for y in (0, 1) for x in (1, 2, 3, 4)] + [(x, y, 0) for y in (0, 1) for x in (2, 3)]
TURNS = [
    turn
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
    if np.linalg.det(turn := np.array(signs)[:, None] * np.eye(3, dtype=int)[list(order)]) > 0
]
Place = tuple[int, int, int]
STEPS: list[Place] = [tuple(step) for step in np.concatenate([np.eye(3, dtype=int), -np.eye(3, dtype=int)]).tolist()]


@cache
def placed(number: int, slot: int) -> set[Cells]:
    """Cells that a stick can fill in one of the six slots: two along each axis, beside each other along the next."""
    cut = {cube for bit, cube in enumerate(CUBES) if number - 1 >> bit & 1}
    whole = np.array([*product(range(6), range(2), range(2))])
    left = np.array([tuple(cube) not in cut for cube in whole.tolist()])
    axis, side = divmod(slot, 2)
    low, size = np.array([-1, -1, -1]), np.array([2, 2, 2])
    low[axis], size[axis], low[(axis + 1) % 3] = -3, 6, 2 * side - 2
    found = set()
    for turn in TURNS:
        cells = whole @ turn.T
        cells += low - cells.min(axis=0)
        if (np.ptp(cells, axis=0) + 1 == size).all():
            found.add(frozenset(map(tuple, cells[left].tolist())))
    return found


def assemblies(numbers: tuple[int, ...]) -> Iterator[list[Cells]]:
    """All ways to fill the slots, the first stick in the first slot."""

    def fill(slot: int, rest: tuple[int, ...], done: list[Cells]) -> Iterator[list[Cells]]:
        if not rest:
            yield done
        for number in dict.fromkeys(rest[:1] if slot == 0 else rest):
            left = list(rest)
            left.remove(number)
            for cells in placed(number, slot):
                if all(cells.isdisjoint(other) for other in done):
                    yield from fill(slot + 1, tuple(left), [*done, cells])

    return fill(0, numbers, [])


def plus(a: Place, b: Place = (0, 0, 0), less: Place = (0, 0, 0)) -> Place:
    return a[0] + b[0] - less[0], a[1] + b[1] - less[1], a[2] + b[2] - less[2]


class Sliding:
    """Breadth-first search over shifts of sticks by cells; sets that move are closed under being pushed."""

    def __init__(self, sticks: list[Cells]) -> None:
        self.cells = [np.array(sorted(stick)) for stick in sticks]
        self.count = len(sticks)
        self.hits = {
            (i, j): set(map(tuple, (self.cells[j][None] - self.cells[i][:, None]).reshape(-1, 3).tolist()))
            for i, j in permutations(range(self.count), 2)
        }

    def pushed(self, at: tuple[Place, ...], step: Place, first: int) -> frozenset[int]:
        found, todo = {first}, [first]
        while todo:
            i = todo.pop()
            for j in set(range(self.count)) - found:
                if plus(at[i], step, at[j]) in self.hits[i, j]:
                    found.add(j)
                    todo.append(j)
        return frozenset(found)

    def sets(self, at: tuple[Place, ...], step: Place) -> set[frozenset[int]]:
        closed = {self.pushed(at, step, first) for first in range(self.count)}
        while len(more := closed | {a | b for a, b in product(closed, repeat=2)}) > len(closed):
            closed = more
        return {some for some in closed if len(some) < self.count}

    def apart(self, at: tuple[Place, ...], some: frozenset[int]) -> bool:
        here, there = (
            np.concatenate([self.cells[i] + at[i] for i in range(self.count) if (i in some) == inside])
            for inside in (True, False)
        )
        return bool(((here.max(axis=0) < there.min(axis=0)) | (there.max(axis=0) < here.min(axis=0))).any())

    def level(self, most: int = 13) -> tuple[int | None, frozenset[int]]:
        """Fewest moves until some sticks are beside the others, and which; None if that needs more."""
        front, seen = [((0, 0, 0),) * self.count], {((0, 0, 0),) * self.count}
        for number in range(1, most + 1):
            reached = []
            for at, step in product(front, STEPS):
                for some in self.sets(at, step):
                    now = at
                    while all(self.pushed(now, step, first) <= some for first in some):
                        now = tuple(plus(p, step) if i in some else p for i, p in enumerate(now))
                        if self.apart(now, some):
                            return number, some
                        rooted = tuple(plus(p, less=now[0]) for p in now)
                        if rooted not in seen:
                            seen.add(rooted)
                            reached.append(rooted)
            front = reached
        return None, frozenset()


@cache
def opened(name: str) -> tuple[list[Cells], int]:
    """The sticks of a burr as the assembly that comes apart has them, and the one that is out first."""
    numbers, level = BURRS[name]
    for sticks in assemblies(numbers):
        found, some = Sliding(sticks).level(level)
        if found == level and len(some) == 1:
            return sticks, min(some)
    raise AssertionError(f"{name} has no assembly of level {level}")


@pytest.mark.parametrize("name", BURRS)
def test_burrs_open_at_their_published_levels(name: str) -> None:
    """Not in one move less, and no other stick is out as soon; one stick stays, the others are held."""
    level, (sticks, first) = BURRS[name][1], opened(name)
    motions = motions_of(*map(solid, sticks))
    stays = (first + 1) % 6
    rest = np.arange(6) == stays
    for part in np.flatnonzero(~rest).tolist() if level < 9 else [first]:
        aside = tuple(other for other in range(6) if other not in (part, stays))
        assert PathSearch(motions, (part,), rest, aside).run(level - 1).way is None
        found = PathSearch(motions, (part,), rest, aside).run(level)
        assert (found.way is None) == (part != first)
        if found.way is not None:
            assert len(found.way) == level
            assert motions.leaves(found.way, np.ones(6, dtype=bool)) == ""


@pytest.mark.parametrize("name", BURRS)
def test_later_sticks_leave_at_their_levels(name: str) -> None:
    """As in a search by cells, in which any sticks may part from the others, one stick after the other."""
    sticks, _ = opened(name)
    motions, left, levels = motions_of(*map(solid, sticks)), list(range(6)), list[int]()
    while len(left) > 1:
        level, some = Sliding([sticks[part] for part in left]).level()
        assert level is not None
        fewest = {}
        for part in left:
            stays = next(other for other in left if other != part)
            aside = tuple(other for other in left if other not in (part, stays))
            search = PathSearch(motions, (part,), np.arange(6) == stays, aside)
            fewest[part] = next((moves for moves in range(1, level + 1) if search.run(moves).way), level + 1)
        assert min(fewest.values()) == level
        levels.append(level)
        out = min(fewest, key=fewest.__getitem__)
        if len(some) in (1, len(left) - 1):
            one_side = some if len(some) == 1 else frozenset(range(len(left))) - some
            assert fewest[left[min(one_side)]] == level
        left.remove(out)
    assert levels[0] == BURRS[name][1]
    assert levels[1] == 2


def test_a_burr_is_planned_and_checked() -> None:
    """Until one stick is left."""
    sticks, first = opened("Philippe Dubois")
    stays = (first + 1) % 6
    assembly = structure(*(solid(stick, fixed=part == stays) for part, stick in enumerate(sticks)))
    settings = StabilitySettings(criterion="equilibrium")
    start = np.full(6, 2)
    one_less = find_plans(assembly, robots=5, moves=5, stability=settings, start=start)
    assert one_less.outcome is not Outcome.FOUND
    (plan,) = find_plans(assembly, robots=5, moves=6, stability=settings, start=start).plans
    ways = [len(way) for way, action in zip(plan.exit_paths, plan.actions, strict=True) if action >= 6]
    assert ways[-1] == plan.moves == 6
    assert len(ways) == 5
    assert validate_plan(plan, assembly, settings).good


@pytest.mark.parametrize("name", BURRS)
def test_whole_burrs_are_planned_from_nothing_held(name: str) -> None:
    """The first stick in its level, and no way longer."""
    level, (sticks, first) = BURRS[name][1], opened(name)
    assembly = structure(*(solid(stick, fixed=part == (first + 1) % 6) for part, stick in enumerate(sticks)))
    settings = StabilitySettings(criterion="equilibrium")
    (plan,) = find_plans(assembly, robots=5, moves=level, stability=settings).plans
    assert max(map(len, plan.exit_paths)) == level
    assert validate_plan(plan, assembly, settings).good


PELIKAN = """
00000000 00000000 00552200 00552200 00552200 00552200 00000000 00000000
00000000 0......0 0...2..0 0......0 0......0 0.5.2..0 0......0 00000000
00444400 0....4.0 1...24.6 11...4.6 666..4.6 6.5..4.6 0......0 00334400
00444400 0....4.0 1...2..6 1...2..6 6.666666 6.53.4.6 0....4.0 00334400
00333300 0.3....0 1.33...1 1..32..1 6..3..11 6.53...1 0..3...0 00334400
00333300 0......0 111111.1 1...2111 6......1 6.55.111 0..3...0 00334400
00000000 0......0 0....2.0 0...22.0 0......0 0..5...0 0......0 00000000
00000000 00000000 00222200 00222200 00555500 00555500 00000000 00000000
"""
"""Pelikan burr by Dic Sonneveld, assembled: a cage, 0, and six pieces in layers of 8 by 8 cells."""
SEPARATED = [
    ((3, 4), "0123456", 98),
    ((3,), "34", 1),
    ((2, 5), "01256", 2),
    ((2,), "25", 1),
    ((1,), "016", 4),
    ((6,), "06", 2),
]
"""What leaves which pieces there, and in how many moves from where these are then: its level, 98.1.2.1.4.2."""


def pelikan() -> list[Cells]:
    rows = np.array([list(row) for row in PELIKAN.split()]).reshape(8, 8, 8)
    return [frozenset(map(tuple, np.argwhere(rows == str(piece))[:, ::-1].tolist())) for piece in range(7)]


def test_the_pelikan_burr_has_its_level() -> None:
    """Two of its pieces leave the cage together, and come apart then."""
    at = np.zeros((7, 3), dtype=int)
    for leaving, there, level in SEPARATED:
        pieces = sorted(map(int, there))
        own = [frozenset(map(tuple, (np.array(sorted(pelikan()[piece])) + at[piece]).tolist())) for piece in pieces]
        motions = motions_of(*map(solid, own))
        out = tuple(map(pieces.index, leaving))
        stays = next(place for place in range(len(pieces)) if place not in out)
        aside = tuple(place for place in range(len(pieces)) if place not in (*out, stays))
        search = PathSearch(motions, out, np.arange(len(pieces)) == stays, aside)
        assert search.run(level - 1).way is None
        way = search.run(level).way
        assert way is not None
        assert len(way) == level
        assert motions.leaves(way, np.ones(len(pieces), dtype=bool)) == ""
        for place, pose in after(way).items():
            at[pieces[place]] += np.rint(pose[:3, 3] / EDGE).astype(int)
    alone = motions_of(*map(solid, pelikan()))
    found = PathSearch(alone, (3,), np.arange(7) == 0, (1, 2, 4, 5, 6))
    assert found.run(98).way is None, "one piece alone needs a move more"
    assert found.run(99).way is not None


def test_the_pelikan_burr_is_planned_and_checked() -> None:
    """Piece by piece; a way begins where all that are left are in place."""
    assembly = structure(*(solid(cells, fixed=piece == 0) for piece, cells in enumerate(pelikan())))
    settings = StabilitySettings(criterion="equilibrium")
    (plan,) = find_plans(assembly, robots=6, moves=99, stability=settings, start=np.full(7, 2)).plans
    assert sorted(map(len, plan.exit_paths)) == sorted([99, 15, 6, 5, 2, 0])
    assert validate_plan(plan, assembly, settings).good


@pytest.mark.parametrize("name", KEYED)
def test_keys_of_solid_burrs_slide_out_in_one_move(name: str) -> None:
    """The stick without a notch, which has number 1, and no other."""
    numbers = KEYED[name]
    for sticks in assemblies(numbers):
        motions = motions_of(*map(solid, sticks))
        out = []
        for part in range(6):
            others = np.arange(6) != part
            out += [part] if PathSearch(motions, (part,), others).run(1).way is not None else []
        assert out == [0]
        assert len(sticks[0]) == 24

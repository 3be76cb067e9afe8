"""Orders of elimination with little fill: minimum degree, within nested dissection where that takes less work.

George (1973) and Liu (1985). Separators halve what is left again and again; each comes after both of the halves that it
keeps apart. That mostly takes less work from some hundred parts on, but more in some regular sheets.
"""

from __future__ import annotations

from heapq import heapify, heappop, heappush

Graph = dict[int, set[int]]

_LEAF = 30
"""Parts that are not dissected further."""


def elimination_order(neighbours: Graph, leaf: int = _LEAF) -> list[int]:
    """Return the parts of a contact graph in the order of elimination; pieces of up to `leaf` are not dissected."""
    order, work = _minimum_degree(neighbours, [set(neighbours)])
    groups: list[set[int]] = []
    _dissect(neighbours, set(neighbours), groups, leaf)
    other, less = _minimum_degree(neighbours, groups)
    return other if less < work else order


def _minimum_degree(neighbours: Graph, groups: list[set[int]]) -> tuple[list[int], int]:
    """Return the parts group by group, in order of degree, then of number; and the work, in products of blocks."""
    order, work = [], 0
    left = {part: set(others) for part, others in neighbours.items()}
    for group in groups:
        heap = [(len(left[part]), part) for part in group]
        heapify(heap)
        while heap:
            degree, part = heappop(heap)
            if part not in left or len(left[part]) != degree:
                continue
            clique = left.pop(part)
            order.append(part)
            work += degree * degree
            for other in clique:
                around = left[other]
                around |= clique
                around -= {other, part}
                if other in group:
                    heappush(heap, (len(around), other))
    return order, work


def _dissect(neighbours: Graph, parts: set[int], groups: list[set[int]], leaf: int) -> None:
    """Append groups of parts in the order of their elimination: the pieces, then what separates them."""
    while parts:
        piece = set(_distances(neighbours, parts, min(parts)))
        parts = parts - piece
        if len(piece) <= leaf:
            groups.append(piece)
            continue
        one, other, between = separate(neighbours, piece)
        if one and other:
            _dissect(neighbours, one, groups, leaf)
            _dissect(neighbours, other, groups, leaf)
            groups.append(between)
        else:
            groups.append(piece)


def _distances(neighbours: Graph, inside: set[int], start: int) -> dict[int, int]:
    """Return the number of contacts between a part and those connected with it, nearest first."""
    distance, ahead = {start: 0}, [start]
    for part in ahead:
        for other in neighbours[part]:
            if other in inside and other not in distance:
                distance[other] = distance[part] + 1
                ahead.append(other)
    return distance


def separate(neighbours: Graph, parts: set[int]) -> tuple[set[int], set[int], set[int]]:
    """Return two sides of a connected graph and a small set of parts between them."""
    from_first = _distances(neighbours, parts, list(_distances(neighbours, parts, min(parts)))[-1])
    from_last = _distances(neighbours, parts, list(from_first)[-1])
    aside = max(parts, key=lambda part: (min(from_first[part], from_last[part]), part))
    from_aside = _distances(neighbours, parts, aside)
    across = _distances(neighbours, parts, list(from_aside)[-1])
    ends = [(from_first, from_last), (from_aside, across), (from_first, from_aside), (from_last, from_aside)]
    found = []
    for here, there in ends:
        ranked = sorted(parts, key=lambda part: (here[part] - there[part], here[part], part))
        one = set(ranked[: len(ranked) // 2])
        between = _cover(neighbours, one, parts - one)
        found.append(_shift(neighbours, one - between, parts - one - between, between))
    return min(found, key=lambda sides: _cost(*map(len, sides)))


def _cost(one: int, other: int, between: int) -> float:
    """Return the size of a separator over those of both sides, the ratio cut (Wei and Cheng, 1989)."""
    return between / one + between / other if min(one, other) else float("inf")


def _cover(neighbours: Graph, one: set[int], other: set[int]) -> set[int]:
    """Return the fewest parts that touch all contacts between two sides, by a maximum matching (Koenig's theorem)."""
    facing = {part: [near for near in neighbours[part] if near in other] for part in sorted(one)}
    facing = {part: near for part, near in facing.items() if near}
    partner: dict[int, int] = {}

    def match(part: int, tried: set[int]) -> bool:
        for near in facing[part]:
            if near not in tried:
                tried.add(near)
                if near not in partner or match(partner[near], tried):
                    partner[near] = part
                    return True
        return False

    alone = [part for part in facing if not match(part, set())]
    reached, beyond = set(alone), set()
    for part in alone:
        for near in facing[part]:
            if near not in beyond:
                beyond.add(near)
                if partner[near] not in reached:
                    reached.add(partner[near])
                    alone.append(partner[near])
    return (set(facing) - reached) | beyond


def _shift(neighbours: Graph, one: set[int], other: set[int], between: set[int]) -> tuple[set[int], set[int], set[int]]:
    """Move a separator part by part as long as it becomes better (Fiduccia and Mattheyses, 1982)."""
    best, moved = (set(one), set(other), set(between)), True
    while moved:
        one, other, between = (set(side) for side in best)
        moved, fixed = False, set()
        for _ in range(len(best[2])):
            options = []
            for part in between - fixed:
                for side, far in ((one, other), (other, one)):
                    drawn = len(neighbours[part] & far)
                    cost = _cost(len(side) + 1, len(far) - drawn, len(between) - 1 + drawn)
                    options.append((cost, part, side is one))
            if not options:
                break
            cost, part, to_one = min(options)
            side, far = (one, other) if to_one else (other, one)
            drawn = neighbours[part] & far
            between.remove(part)
            side.add(part)
            fixed.add(part)
            far -= drawn
            between |= drawn
            if cost < _cost(*map(len, best)):
                best, moved = (set(one), set(other), set(between)), True
    return best

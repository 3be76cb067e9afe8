"""Stages of a way out on which other parts, or the part itself, wait where they stand while robots carry others."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.clearance.moves import ExitPath, Poses, after, way_back
from falsework.geometry.paths.departure import Mask, Parts

States = NDArray[np.uint8]

REMOVED, INSTALLED, HELD = 0, 1, 2
"""Values of a part in a state."""


class PosedStability(Protocol):
    """Stability of states in which parts are not in place."""

    @property
    def immovable(self) -> Mask:
        """Parts that no robot holds, shape (parts,)."""
        ...

    def stands(self, oracle: Any, state: States, poses: Poses) -> bool:
        """Return whether a state, shape (parts,), stands in some poses, by the criterion of an oracle."""
        ...


def hands_free(state: States, leaving: Parts, robots: int, immovable: Mask) -> int:
    """Count the robots that hold nothing in a state, shape (parts,), while others hold what leaves."""
    held = (state == HELD) & ~immovable
    if len(leaving) == 1:  # of several the state says which are held, and which are carried with these
        held[leaving[0]] = True
    return robots - int(held.sum())


def loose_parts(way: ExitPath, state: States, leaving: Parts) -> set[int]:
    """Return the parts that a way moves and no robot holds, but for those that leave."""
    return {one for move in way for one in move.parts if state[one] != HELD and one not in leaving}


def stages(way: ExitPath, state: States, leaving: Parts, spare: int, *, out: bool) -> Iterator[tuple[States, Poses]]:
    """Yield what has to stand along a way: a state, shape (parts,), and the poses of parts that are not in place.

    A move is carried: nothing bears on its parts. Others that robots hold stay held. Where no robot is free for a
    move, that of the part that leaves lets go of it, so that it waits too. When it is out, the others go back as they
    came, the last one first. Before and after each move everything else stands where it is.

    Args:
        way: moves of a part, and of others.
        state: in which it leaves, shape (parts,).
        spare: robots that hold nothing in that state.
        out: whether the way takes the part out, so that others go back.
    """
    (part,), whole = leaving, state.copy()
    whole[part] = HELD
    for number, move in enumerate(way):
        held = whole.copy()
        if lets_go(move.parts, state, leaving, spare):
            held[part] = INSTALLED
        yield from _moved(held, move.parts, after(way[:number]), after(way[: number + 1]), out and move is way[-1])
    if out:
        whole[part] = REMOVED
        back = way_back(way)
        for number, move in enumerate(back):
            yield from _moved(
                whole, move.parts, after((*way, *back[:number])), after((*way, *back[: number + 1])), False
            )


def _moved(state: States, parts: tuple[int, ...], before: Poses, then: Poses, gone: bool) -> Iterator[Any]:
    """Yield a state before parts move, without them, and after it if they are not gone then."""
    rest = state.copy()
    rest[list(parts)] = REMOVED
    yield state, before
    yield rest, before
    if not gone:
        yield state, then


def lets_go(parts: Parts, state: States, leaving: Parts, spare: int) -> bool:
    """Return whether robots are free to carry some parts only if that of a part that leaves lets go of it."""
    return sum(state[one] != HELD and one not in leaving for one in parts) > spare


def has_hands(parts: Parts, state: States, leaving: Parts, spare: int) -> bool:
    """Return whether there are robots to carry some parts; that of a part that leaves alone may let go of it."""
    return not lets_go(parts, state, leaving, spare + (len(leaving) == 1 and leaving[0] not in parts))

"""Rules of a task, by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypedDict

from numpy.typing import ArrayLike


class ExitRules(TypedDict, total=False):
    """Ways on which parts leave."""

    parts_at_once: int
    """Parts that a step may insert or remove at most, where they lock each other and leave together only. More than 1
    implies `removable_only_if_clear`."""
    moves: int
    """Moves in which a part leaves at most, where it has no straight way out; other parts that robots hold may move
    aside meanwhile. More than 1 implies `removable_only_if_clear`."""
    turns: bool
    """Whether the part that leaves may also turn about an axis, and screw; a turn counts as a move. Implies
    `removable_only_if_clear`."""
    waiting: bool
    """Whether parts that no robot holds may be carried aside meanwhile, or the part that leaves be let go of half way
    out, where what waits stands; needs `moves` above 1."""


class AllowsExits(Protocol):
    """What says on which ways parts leave, as `ExitRules`: options, a request or a plan."""

    @property
    def parts_at_once(self) -> int:
        """As of `ExitRules`; so are the others."""
        ...

    @property
    def moves(self) -> int:
        """Moves in which a part leaves at most."""
        ...

    @property
    def turns(self) -> bool:
        """Whether it may turn."""
        ...

    @property
    def waiting(self) -> bool:
        """Whether parts may wait."""
        ...


def exit_rules(*several: AllowsExits) -> ExitRules:
    """Return rules that allow all that one of several allows, such as a plan and what follows it."""
    return {
        "parts_at_once": _most([one.parts_at_once for one in several]),
        "moves": _most([one.moves for one in several]),
        "turns": any(one.turns for one in several),
        "waiting": any(one.waiting for one in several),
    }


def _most(counts: list[int]) -> int:
    """Return the largest count; one that is none, which a task refuses, is not hidden behind it."""
    return min(counts) if min(counts) < 1 else max(counts)


class TaskRules(ExitRules, total=False):
    """Rules of a task in addition to the number of robots, all of them optional."""

    start: ArrayLike | None
    """State to disassemble, where assembly ends, shape (parts,); the complete structure if not given."""
    target: ArrayLike | None
    """State in which disassembly ends, where assembly starts, shape (parts,); the empty structure if not given."""
    fixed: Sequence[int | str]
    """Numbers or names of parts that are neither held nor removed."""
    missing: Sequence[int | str]
    """Numbers or names of parts not delivered yet; assembly defers them as long as possible."""
    removable_only_if_clear: bool
    """Remove a part only if it has a free straight exit."""
    allow_regrasp: bool
    """Release held parts without removing them, and hold parts again."""
    props: int
    """Props that may be in place at a time, of those that the structure has places for; needs `allow_regrasp`."""

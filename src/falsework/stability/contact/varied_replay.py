"""Replays under changed settings, to which the result for a plan must be insensitive.

Stiffness, damping, release, the friction in new contacts and the forces of robots are never known exactly, and on site
all of them are off at once. So each change is one of all of them, and four changes have every extreme of each. A search
plans under the settings proper, and tries what it has built under these changes. Where that falls, steps are tried
under all of them from then on, when they are taken; most plans stand without.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass
from operator import itemgetter
from threading import Event

from falsework.assembly.state import States
from falsework.stability.contact.history import Change, History, Presses, ReplaySettings
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import Press
from falsework.utils.cores import core_count
from falsework.utils.interruption import PIECE
from falsework.utils.quantity import counted

MANY, FEW = 16, 4
"""Numbers of changes: for a thorough test, and for every plan with a reserve. The few have both extremes of every
setting, and so have as many of the others, which are learned together."""
PARTS = 16
"""Parts of a long plan, each of which is replayed under all changes before the next."""
_RATIOS = 0.4, 1.0
_INCREMENTS = 1, 16
_FIRST_STEPS = ReplaySettings.first_step / 30, ReplaySettings.first_step * 30
_HOLD_FACTORS = 1 / 3, 3.0

TRUE_FRICTION = Change(
    "true friction", ratio=None, hold_factor=1.0, press=None, replay=ReplaySettings(keeps_track=False), reserve=1.0
)
"""Settings without the reserve, of whose replays no certificates are made."""


@dataclass(frozen=True)
class Variation:
    """Replay under other settings, and the number of its stable steps."""

    name: str
    good: bool
    falls_at: int | None


class RouteReplay:
    """Replay of routes under changed settings; each begins with what it has in common with the last."""

    def __init__(self, replayer: Replayer, change: Change) -> None:
        """Begin without a route; the replayer is under the settings proper."""
        self.replayer, self._change = replayer.vary(change), change
        self._route: list[tuple[bytes, tuple[Press, ...]]] = []
        self._presses: Presses = []
        self._known: list[tuple[int, History]] = []
        """Numbers of some states of the route that come to rest, in order, with their histories; one for each part of
        it at most."""

    def begin(self, states: States, presses: Presses) -> int:
        """Go on with a route, or more of it; return from which state on it is replayed.

        Args:
            states: in assembly order, shape (states, parts).
            presses: of the steps that lead to each state, one entry a state.
        """
        route = [(state.tobytes(), tuple(some)) for state, some in zip(states, presses, strict=True)]
        shared = [*(old == new for old, new in zip(self._route, route, strict=False)), False].index(False)
        self._route, self._known = route, [known for known in self._known if known[0] < shared]
        self._presses = self._change.inexact(presses)
        return self._known[-1][0] + 1 if self._known else 0

    def pieces(self, states: States) -> Iterator[tuple[int, Sequence[History]]]:
        """Yield the histories of a few states at a time, up to some state of the route or the first that falls.

        Between them a replay can be ended, and those of a whole route take much memory. Each piece is known once the
        next begins.

        Args:
            states: of the route up to there, shape (states, parts).

        Yields:
            Number of the first state, which is the last one before where there is one; histories.
        """
        row, history = self._known[-1] if self._known else (0, None)
        length, good = part_length(len(self._route)), True
        while good and (history is None or row < len(states) - 1):
            rows = slice(row, min(row + 1 + (PIECE if history else 0), len(states)))
            piece = self.replayer.replay(states[rows], history, self._presses[rows])
            good = piece.good
            if piece.histories:
                yield row, piece.histories
                row, history = row + len(piece.histories) - 1, piece.histories[-1]
                if self._known and self._known[-1][0] // length == row // length:
                    self._known.pop()
                self._known.append((row, history))

    def falls_at(self, states: States, over: Event) -> int | None:
        """Return the first state of the route up to some state that does not come to rest; None if all do.

        Args:
            states: of the route up to there.
            over: whether the answer does not matter any more.
        """
        last = self._known[-1][0] if self._known else -1
        for first, histories in self.pieces(states):
            last = first + len(histories) - 1
            if over.is_set():
                break
        return None if last >= len(states) - 1 else last + 1


def part_length(count: int) -> int:
    """Return the states in each of `PARTS` parts of a route of some states."""
    return max(-(-count // PARTS), 2 * PIECE)  # a round of replays has a cost of its own


def _falls(replays: Sequence[RouteReplay], states: States) -> list[int | None]:
    """Return the first state of their route that falls, for each replay; as many run at a time as there are cores.

    Args:
        replays: under each change, all of the same route.
        states: of the route up to some state.
    """
    over = Event()
    with ThreadPoolExecutor(core_count()) as pool:
        # Each in a copy of this context: threads too are interrupted by what interrupts this one.
        running = [pool.submit(copy_context().run, one.falls_at, states, over) for one in replays]
        try:
            return [one.result() for one in running]
        finally:
            over.set()


def variations(count: int) -> list[Change]:
    """Return changes of all settings at once, to extremes.

    In a thicker medium new contacts have friction from the start, of another draw each time. In a thinner one they have
    none: before a contact bears load, nothing but the medium would keep that friction from throwing parts off.

    Any four from a multiple of four on are a fractional factorial design (Box, Hunter and Hunter 2005): every pair of
    extremes of stiffness ratio and release, and of either of them with the medium and the holds, occurs once, and every
    error of presses. Sixteen are the full design.
    """
    changes = []
    for k in range(count):
        first, second = k & 1, k >> 1 & 1
        third, fourth = first ^ second ^ (k >> 2 & 1), first ^ second ^ (k >> 3 & 1)
        increments, press = _INCREMENTS[second], k % 4
        name = (
            f"stiffness ratio {_RATIOS[first]:g}, release in {counted(increments, 'increment')}, "
            f"{(f'thicker medium with initial friction (draw {k + 1})', 'thinner medium')[third]}, "
            f"holds 3 times {('softer', 'stiffer')[fourth]}, presses off by 10% and 5 degrees ({press + 1} of 4)"
        )
        noise = 1.0 - third
        replay = ReplaySettings(increments, _FIRST_STEPS[third], friction_noise=noise, seed=k, keeps_track=False)
        changes.append(Change(name, _RATIOS[first], _HOLD_FACTORS[fourth], press, replay))
    return changes


def replay_varied(
    replayer: Replayer, states: States, presses: Presses | None = None, *, changes: Sequence[Change] | None = None
) -> list[Variation]:
    """Replay a plan under other settings: a plan that collapses under one of them is marginal.

    Args:
        replayer: replayer with the settings of the plan.
        states: in assembly order, shape (states, parts).
        presses: of the steps that lead to each state; none if not given.
        changes: the settings; `MANY` extremes, see `variations`, if not given.
    """
    given: Presses = [()] * len(states) if presses is None else presses
    changes = variations(MANY) if changes is None else changes
    replays = [RouteReplay(replayer, change) for change in changes]
    for one in replays:
        one.begin(states, given)
    rows = zip(changes, _falls(replays, states), strict=True)
    return [Variation(change.name, row is None, row) for change, row in rows]


class AllVariations:
    """Test of plans under changed settings; what it learns stays with the replayer."""

    def __init__(self, replayer: Replayer, count: int = FEW) -> None:
        """Prepare the test of plans with the settings of a replayer, which tries steps under these alone at first.

        Args:
            replayer: of the structure.
            count: number of changes, see `variations`.
        """
        self._replayer, self._changes = replayer, variations(count)
        self._replays: dict[Change, RouteReplay] = {}
        replayer.also_under(())

    def falls_at(self, states: States, presses: Presses) -> int | None:
        """Return the first state in which a plan does not come to rest under some change; None if there is none.

        The changes of the group with the one under which it falls first are those under which the replayer tries steps
        from now on. All changes are tried on one part of the plan before the next, so little of what comes after a fall
        is replayed.

        Args:
            states: in assembly order, of the first steps or of all, shape (steps + 1, parts); they come to rest in the
                replay of the replayer.
            presses: of the steps that lead to each state, one entry a state.
        """
        changes = [change for change in self._changes if change not in self._replayer.changes]
        for change in changes:
            if change not in self._replays:
                self._replays[change] = RouteReplay(self._replayer, change)
            self._replays[change].begin(states, presses)
        replays, length = [self._replays[change] for change in changes], part_length(len(states))
        for end in range(length, len(states) + length, length):
            rows = zip(_falls(replays, states[:end]), changes, strict=True)
            fallen = [(row, change) for row, change in rows if row is not None]
            if fallen:
                row, change = min(fallen, key=itemgetter(0))
                first = self._changes.index(change) // FEW * FEW
                self.add(*self._changes[first : first + FEW])
                return row
        return None

    def add(self, *changes: Change) -> None:
        """Have steps tried under more changes."""
        known = self._replayer.changes
        self._replayer.also_under((*known, *(change for change in changes if change not in known)))

    def learn(self, names: Collection[str]) -> None:
        """Have steps tried under the changes of some names."""
        self._replayer.also_under([change for change in (TRUE_FRICTION, *self._changes) if change.name in names])

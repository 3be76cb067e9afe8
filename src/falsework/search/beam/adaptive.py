"""Beam search that backtracks and widens on failure."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Progress, SearchResult, Stop
from falsework.search.problem.task import Direction, Task

_CHAINS = 8
"""Times in a row that the beam comes back from where its last chain of held parts began, with another one."""
_TURNS = 2
"""Times that the end of each such chain goes another way, from before the part was fixed that no robot let go of."""
_FAR_LEVELS = 128
"""Levels before a chain at most from which it begins anew where one of many robots has been bound since then."""
_TRIALS = 3
"""Times that it then comes back from farther, with the parts in which those chains began first and with other random
preferences, before it is widened; each time as many other chains are tried there."""
_DISORDER = 0.3
"""Spread of the preferences at first; each further trial adds as much. Scores of a guide are shares of 1."""
_WIDENING_FACTOR = 4
"""After that, the beam comes back this many times wider ..."""
_RETREAT_FACTOR = 4
"""... from this many times farther back ..."""
_RETREAT_LEVELS = 8
"""... than so many levels; each trial of one width begins as many times farther back than the last."""
_LOOKAHEAD_STATES = 64
"""States without a need for a verdict that the narrowest beam keeps, so that the next level has a choice."""
_FARTHER_LOOKAHEAD = 256
"""The same after a death."""
_LOOKAHEAD_PER_WIDTH = 16
"""The same for wide beams, as a multiple of the width."""
_EPISODES = 4
"""Hard places, one after the other, at which one part may bind a robot and be left for later. Then it is too late for
this part, and the beam comes back from where that was seen first ..."""
_RETURNS = 8
"""... so many times at most, with random preferences."""
_REMEMBERED_STATES = 4096
"""States whose tried parts are remembered; of a few hundred parts each, so a few megabytes."""
_PLACE = ("failures", "turns", "retreats", "deaths", "farthest", "easy_from", "chain_from", "episode", "returns")
"""Fields of the memory of places where beams died."""


@dataclass(frozen=True)
class AdaptiveSettings:
    """Direction, initial width and seed of an adaptive beam."""

    direction: Direction = Direction.ASSEMBLY
    """Which end to begin at."""
    width: int = 1
    """Width to begin with and to return to after every hard place."""
    compact: bool = False
    """Let robots work in one place, see `BeamSettings`."""
    seed: int = 0
    """Same seed, same machine, same result."""
    gaps: bool = False
    """Come back to place parts that filled gaps before those around them."""
    few_ahead: bool = False
    """Begin with as few states ahead for their number as wide beams keep: until the beam dies, little but what the
    guide puts first is tried."""

    def beam(
        self,
        retreats: int = 0,
        number: int = 0,
        avoided: tuple[int, ...] = (),
        preferred: tuple[int, ...] = (),
        early: tuple[int, ...] = (),
    ) -> BeamSettings:
        """Return settings of the beam after so many retreats from one place, and `number` deaths altogether."""
        widened, trial = self.trial(retreats)
        width = self.width * _WIDENING_FACTOR**widened
        ahead = _FARTHER_LOOKAHEAD if number else 0 if self.few_ahead else _LOOKAHEAD_STATES
        return BeamSettings(
            width=width,
            direction=self.direction,
            diversity="none",
            lookahead=max(ahead, _LOOKAHEAD_PER_WIDTH * width),
            commit=width == 1,
            compact=self.compact,
            retries=0,
            disorder=_DISORDER * trial,
            avoided=avoided,
            preferred=preferred,
            early=early,
            number=number,
            seed=self.seed,
        )

    @staticmethod
    def trial(retreats: int) -> tuple[int, int]:
        """Return how often the beam is widened after so many retreats, and which trial of that width it is."""
        return divmod(retreats, _TRIALS + 1)


class AdaptiveBeam:
    """Beam search that takes another way where it dies, then a wider one, and narrows again afterwards.

    Robots mostly hold a chain of parts, one after the other, until it closes and all can be let go of; which chain
    closes is seen only at its end. Where the beam dies, it comes back before the part that no robot can let go of, and,
    after a few turns, before the chain, to begin another: a depth-first search for chains that close. Parts that led
    nowhere from a state are fixed there after all others. If asked to, it places a part that filled a gap between parts
    that stand without it, and cannot be let go of, before those around it on the next way. Where no chain closes, the
    beam comes back from farther with the parts first in which those began, and with other random preferences; and after
    some trials wider. Once it is well past the place, it follows its guide again, and is narrow. Verdicts asked before
    are in the oracle's memory, so going over the same ground costs little.
    """

    def __init__(self, task: Task, oracle: Oracle, settings: AdaptiveSettings, *, guide: Guide | None = None) -> None:
        """Begin narrow, at the origin of the direction."""
        self.settings = settings
        self.search = BeamSearch(task, oracle, settings.beam(), guide=guide)
        self._failures = self._turns = self._retreats = self._deaths = 0
        self._farthest = -1
        self._easy_from = self._chain_from = -1
        self._episode = self._returns = 0
        self._tried: dict[str, list[int]] = {}
        """Parts that were fixed and led nowhere, by the state before."""
        self._left: dict[int, list[tuple[int, int]]] = {}
        """Parts not yet let go of that bound robots where the beam died: hard places, and levels."""
        self._gaps: list[int] = []
        """Parts that filled gaps and could not be let go of; the beam came back to place them before those around."""

    @property
    def infeasible(self) -> bool:
        """Whether the search is dead with no state left out: there is no plan."""
        return self.search.done and not self.search.found and self.search.exhaustive

    def run(
        self,
        widest: int,
        *,
        deaths: int | None = None,
        progress: Progress | None = None,
        stop: Stop | None = None,
    ) -> SearchResult:
        """Search until the goal is reached, a beam wider than `widest` would be needed, or `stop` returns true.

        Args:
            widest: limit on the width, except near by where the beam dies; run again with a larger one to go on.
            deaths: limit on how often the beam comes back from where it died, earlier runs included.
            progress: called after every level.
            stop: asked before every level.
        """
        eased = False

        def halt() -> bool:
            nonlocal eased
            eased = self._eased()
            return eased or (stop is not None and stop())

        while True:
            eased = False
            result = self.search.run(progress=progress, stop=halt)
            if eased:
                self._failures = self._retreats = 0
                self._episode += 1
                self.search.rewind(len(self.search.levels) - 1, self.settings.beam())
            elif result.interrupted or result.found or self.infeasible:
                return result
            elif (deaths is not None and self._deaths >= deaths) or not self._widen(widest):
                if not result.undecided and not result.sliding:
                    limit = f"beams up to a width of {self.search.settings.width} died; wider ones may come through"
                    result = replace(result, limit=limit)
                return result

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the search as it stands: plain values, and arrays."""
        header, arrays = self.search.pack()
        own = {name: getattr(self, f"_{name}") for name in _PLACE}
        return header | {
            "adaptive": own,
            "tried": self._tried,
            "left": list(self._left.items()),
            "gaps": self._gaps,
            "base": asdict(self.settings),
        }, arrays

    @classmethod
    def unpack(
        cls,
        header: dict[str, Any],
        arrays: dict[str, NDArray[Any]],
        task: Task,
        oracle: Oracle,
        *,
        guide: Guide | None = None,
    ) -> AdaptiveBeam:
        """Return the search that `pack` described.

        Raises:
            KeyError, TypeError, ValueError: not what `pack` returned for this task.
        """
        base = header["base"] | {"direction": Direction(header["base"]["direction"])}
        beam = cls(task, oracle, AdaptiveSettings(**base))
        beam.search = BeamSearch.unpack(header, arrays, task, oracle, guide=guide)
        for name in _PLACE:
            setattr(beam, f"_{name}", int(header["adaptive"][name]))
        beam._tried = {state: [int(part) for part in parts] for state, parts in header["tried"].items()}
        beam._gaps = [int(part) for part in header["gaps"]]
        beam._left = {int(part): [(int(a), int(b)) for a, b in places] for part, places in header["left"]}
        return beam

    def _eased(self) -> bool:
        """Return whether the beam came back and is well past the place where it died."""
        came_back = self.search.settings.number > 0
        return came_back and len(self.search.levels) - 1 > self._easy_from and not self.search.done

    def _widen(self, widest: int) -> bool:
        """Go back and come again, another way or wider; False if that would be too wide."""
        search = self.search
        level = len(search.levels) - 1
        late = self._left_too_long(level)
        if late >= 0:
            self._return_before(late)
            return True
        if self.settings.gaps and self._close_gaps():
            return True
        (begun, part), binding = search.chain(), search.binding()
        before = sum(fixed < begun for fixed, _ in binding)
        if before and (before >= search.task.robots - 1 or begun - binding[0][0] <= _FAR_LEVELS):
            begun, part = binding[0]  # robots were bound all along, and one laid the rest
        else:
            binding = binding[before:]
        if begun > self._chain_from and level > self._farthest + 2:
            self._failures = self._retreats = 0
        back, turned = begun, False
        if binding and binding[0][0] > begun and self._turns < _TURNS:
            turned = binding[0][1] not in self._tried_from(binding[0][0])
            back, part = binding[0] if turned else (begun, part)
        tried = self._tried_from(back)
        again = part in tried
        if not again:
            tried.append(part)
        self._turns = self._turns + 1 if turned else 0
        self._failures += not turned
        avoided, preferred, early = tuple(tried), search.settings.preferred, search.settings.early
        if again or self._failures > _CHAINS:
            retreats = self._retreats + 1
            widened, trial = self.settings.trial(retreats)
            if self.settings.width * _WIDENING_FACTOR**widened > widest:
                return False
            self._failures, self._retreats, avoided, early = 0, retreats, (), ()
            back = begun - _RETREAT_LEVELS * _RETREAT_FACTOR ** (widened + trial)
            preferred = (*preferred, *(each for each in tried if each not in preferred)) if trial else ()
        self._farthest, self._chain_from = max(self._farthest, level), begun
        self._come_back(back, avoided, preferred, early)
        return True

    def _left_too_long(self, level: int) -> int:
        """Note which parts bind robots where the beam died; return the level from which one was left too often, or -1.

        What is built beside a part that was left for later makes it harder to fix: arches along free edges, say.
        """
        held_now = self.search.levels[-1].states[0]
        loosened = INSTALLED if self.settings.direction is Direction.ASSEMBLY else REMOVED
        self._left = {part: places for part, places in self._left.items() if held_now[part] != loosened}
        for part in np.flatnonzero((held_now == HELD) & ~self.search.task.boundary).tolist():
            places = self._left.setdefault(part, [])
            if not places or places[-1][0] < self._episode:
                places.append((self._episode, level))
        late = [places[0][1] for places in self._left.values() if len(places) >= _EPISODES]
        return max(late) if late and self._returns < _RETURNS else -1

    def _return_before(self, level: int) -> None:
        """Come back from far before a level, with random preferences until it is passed."""
        self._returns += 1
        self._failures = self._turns = 0
        self._retreats = 1
        self._left = {}
        self._farthest, self._chain_from = level, -1
        self._come_back(level - _RETREAT_LEVELS * _RETREAT_FACTOR**2)

    def _close_gaps(self) -> bool:
        """Come back to place parts before those around them; False where none came too late.

        A part that fills a gap between parts that stand without it gets no thrust from them, and may slide.
        """
        search = self.search
        late = {part: level for part, level in search.gaps().items() if part not in self._gaps}
        if not late:
            return False
        self._gaps += late
        self._farthest = max(self._farthest, len(search.levels) - 1)
        self._failures = self._turns = 0
        settings = search.settings
        self._come_back(min(late.values()), preferred=settings.preferred, early=(*settings.early, *late))
        return True

    def _come_back(
        self,
        level: int,
        avoided: tuple[int, ...] = (),
        preferred: tuple[int, ...] = (),
        early: tuple[int, ...] = (),
    ) -> None:
        """Count a death, and go on from a level; ground is easy again well past the farthest one."""
        self._deaths += 1
        self._easy_from = self._farthest + 2 * _RETREAT_LEVELS
        settings = self.settings.beam(self._retreats, self._deaths, avoided, preferred, early)
        self.search.rewind(max(level, 0), settings)

    def _tried_from(self, level: int) -> list[int]:
        """Return the parts that led nowhere from the state at a level on the way to the best scored one."""
        state = self.search.before(level).tobytes().hex()
        tried = self._tried[state] = self._tried.pop(state, [])  # the last used is the last forgotten
        if len(self._tried) > _REMEMBERED_STATES:
            del self._tried[next(iter(self._tried))]
        return tried

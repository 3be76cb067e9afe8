"""Beam search that learns from dead ends, jumps back and restarts."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import Any

from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.histories import ReplaySummary
from falsework.search.beam.nogoods import luby
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Progress, SearchCounters, SearchResult, Stop
from falsework.search.problem.task import Direction, Task

WIDENING = 4
"""A beam that restarts is so many times wider."""
_LOOKAHEAD_PER_WIDTH = 16
"""States without a need for a verdict that wide beams keep at least, as a multiple of the width."""


@dataclass(frozen=True)
class BackjumpingSettings:
    """Direction, first width and seed of a beam that jumps back."""

    direction: Direction = Direction.ASSEMBLY
    """Which end to begin at."""
    width: int = 1
    """Width to begin with."""
    seed: int = 0
    """Same seed, same machine, same result."""
    lookahead: int = 64
    """States without a need for a verdict that narrow beams keep, so that the next level has a choice; with fewer,
    little but what the guide puts first is tried."""

    def beam(self, width: int, conflicts: int = 0) -> BeamSettings:
        """Return settings of a beam of some width after so many conflicts."""
        return BeamSettings(
            width=width,
            direction=self.direction,
            diversity="none",
            lookahead=max(self.lookahead, _LOOKAHEAD_PER_WIDTH * width),
            commit=width == 1,
            number=conflicts,
            seed=self.seed,
        )


class BackjumpingBeam:
    """Beam search with conflict-directed backjumping and restarts.

    Robots mostly hold a chain of parts, one after the other, until it closes and all can be let go of; whether it
    closes is seen only at its end. Where the beam dies, the parts that robots hold in all its states are the conflict.
    The beam jumps back to a choice that led to it, and does not make that again. Over how many choices it jumps follows
    the Luby sequence, until the beam gets farther than ever before; where it would jump beyond the origin, it restarts
    wider. Verdicts asked before are in the oracle's memory, so going over the same ground costs little.
    """

    def __init__(
        self,
        task: Task,
        oracle: Oracle,
        settings: BackjumpingSettings = BackjumpingSettings(),
        *,
        guide: Guide | None = None,
    ) -> None:
        """Begin narrow, at the origin of the direction."""
        self.settings = settings
        self.search = BeamSearch(task, oracle, settings.beam(settings.width), guide=guide)
        self._farthest = self._since = 0
        """Farthest level since the last restart, and conflicts since it was reached."""

    @property
    def infeasible(self) -> bool:
        """Whether the search is dead with no state left out: there is no plan."""
        return self.search.done and not self.search.found and self.search.exhaustive

    @property
    def asked(self) -> int:
        """Verdicts requested so far."""
        return self.search.asked

    @property
    def counters(self) -> SearchCounters:
        """Work done so far."""
        return self.search.counters

    def forbid(self, states: States) -> None:
        """Leave states out from now on, see `BeamSearch.forbid`."""
        self.search.forbid(states)

    def replay_summary(self) -> ReplaySummary | None:
        """Return the replay of the route found, see `BeamSearch.replay_summary`."""
        return self.search.replay_summary()

    def run(self, widest: int, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Search until the goal is reached, a beam wider than `widest` would be needed, or `stop` returns true.

        Args:
            widest: limit on the width; run again with a larger one to go on.
            progress: called after every level.
            stop: asked before every level.
        """
        while True:
            result = self.search.run(progress=progress, stop=stop)
            if result.interrupted or result.found or self.infeasible:
                return result
            if not self.jump_back() and not self._restart(widest):
                if not result.undecided and not result.sliding:
                    limit = f"beams up to a width of {self.search.settings.width} died; wider ones may come through"
                    result = replace(result, limit=limit)
                return result

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the search as it stands: plain values, and arrays."""
        header, arrays = self.search.pack()
        own = {"farthest": self._farthest, "since": self._since}
        return header | {"jumps": own, "base": asdict(self.settings)}, arrays

    @classmethod
    def unpack(
        cls,
        header: dict[str, Any],
        arrays: dict[str, NDArray[Any]],
        task: Task,
        oracle: Oracle,
        *,
        guide: Guide | None = None,
    ) -> BackjumpingBeam:
        """Return the search that `pack` described.

        Raises:
            KeyError, TypeError, ValueError: not what `pack` returned for this task.
        """
        base = header["base"] | {"direction": Direction(header["base"]["direction"])}
        beam = cls(task, oracle, BackjumpingSettings(**base))
        beam.search = BeamSearch.unpack(header, arrays, task, oracle, guide=guide)
        beam._farthest, beam._since = int(header["jumps"]["farthest"]), int(header["jumps"]["since"])
        return beam

    def jump_back(self) -> bool:
        """Learn from the dead end and jump back; False where that would be beyond the origin."""
        search, conflicts = self.search, self.search.conflicts
        level = len(search.levels) - 1
        if level > self._farthest:
            self._farthest, self._since = level, 0
        choice = next(islice(search.choices(), luby(self._since + 1) - 1, None), None)
        if choice is None:
            return False
        self._since += 1
        back, action = choice
        conflicts.learn(search.before(back), action)
        search.rewind(back, self.settings.beam(search.settings.width, conflicts.count))
        return True

    def _restart(self, widest: int) -> bool:
        """Begin again with a wider beam, which may make all choices; False if it would be too wide."""
        width = self.search.settings.width * WIDENING
        if width > widest:
            return False
        conflicts = self.search.conflicts
        conflicts.refuted.clear()
        self._farthest = self._since = 0
        self.search.rewind(0, self.settings.beam(width, conflicts.count))
        return True

"""Beam search that learns from dead ends, jumps back and restarts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.level_search import Beams
from falsework.search.beam.nogoods import luby
from falsework.search.beam.settings import AHEAD, BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Outcome, Progress, Route, SearchCounters, SearchResult, Stop
from falsework.search.problem.search import ReplaySummary, Search
from falsework.search.problem.task import Direction, Task

WIDENING = 4
"""A beam that restarts is so many times wider. Beams for missing parts restart once; those for other plans begin so
wide, and restart once."""


@dataclass(frozen=True)
class BackjumpingSettings:
    """Direction, first width and seed of a beam that jumps back."""

    direction: Direction = Direction.ASSEMBLY
    """Which end to begin at."""
    width: int = 1
    """Width to begin with."""
    seed: int = 0
    """Same seed, same machine, same result."""
    lookahead: int = WIDENING * AHEAD
    """States without a need for a verdict that narrow beams keep, so that the next level has a choice; with fewer,
    little but what the guide puts first is tried."""

    def beam(self, width: int, conflicts: int = 0) -> BeamSettings:
        """Return settings of a beam of some width after so many conflicts."""
        return BeamSettings(
            width=width,
            direction=self.direction,
            diversity="none",
            lookahead=max(self.lookahead, AHEAD * width),
            commit=width == 1,
            number=conflicts,
            seed=self.seed,
        )


class BackjumpingBeam(Search):
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
        beams: Beams = BeamSearch,
    ) -> None:
        """Begin narrow, at the origin of the direction, with a beam of some backend."""
        self.task, self.direction, self.settings = task, settings.direction, settings
        self.search = beams(task, oracle, settings.beam(settings.width), guide=guide)
        self._farthest = self._since = 0
        """Farthest level since the last restart, and conflicts since it was reached."""
        self._over = False
        """Whether a jump would lead beyond the origin, and a restart beyond the width of the present run."""

    @property
    def infeasible(self) -> bool:
        """Whether the search is dead with no state left out: there is no plan."""
        return self.search.done and not self.search.found and self.search.exhaustive

    @property
    def found(self) -> bool:
        """See `Search.found`."""
        return self.search.found

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        return self.found or self.infeasible or self._over

    @property
    def asked(self) -> int:
        """See `Search.asked`."""
        return self.search.asked

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        return self.search.counters

    def forbid(self, states: States) -> None:
        """See `Search.forbid`."""
        self.search.forbid(states)

    def route(self) -> Route:
        """See `Search.route`."""
        return self.search.route()

    def replay_summary(self) -> ReplaySummary | None:
        """See `Search.replay_summary`."""
        return self.search.replay_summary()

    def run(self, widest: int = 0, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """See `Search.run`."""
        self._over = False
        return super().run(widest, progress=progress, stop=stop)

    def step(self) -> bool:
        """Find the next level; where there is none, jump back from the dead end, or restart wider."""
        stepped = self.search.step()
        if self.search.done and not self.found and not self.infeasible:
            self._over = not self.jump_back() and not self._restart()
        return stepped

    def _failure(self) -> tuple[Outcome, str]:
        outcome, limit = self.search._failure()
        if not self.infeasible and not any(self._open()):
            limit = f"beams up to a width of {self.search.settings.width} died; wider ones may come through"
        return outcome, limit

    def states(self) -> States:
        """See `Search.states`."""
        return self.search.states()

    def _farthest_states(self) -> tuple[int, States, States]:
        return self.search._farthest_states()

    def _place(self) -> tuple[int, int, int]:
        return self.search._place()

    def _open(self) -> tuple[int, int]:
        return self.search._open()

    def _notes(self, outcome: Outcome) -> tuple[str, ...]:
        return self.search._notes(outcome)

    def _ended(self) -> None:
        self.search._ended()

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the search as it stands: plain values, and arrays."""
        assert isinstance(self.search, BeamSearch)
        header, arrays = self.search.pack()
        own = {"farthest": self._farthest, "since": self._since, "seconds": self._seconds}
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
        jumps = header["jumps"]
        beam._farthest, beam._since, beam._seconds = (
            int(jumps["farthest"]),
            int(jumps["since"]),
            float(jumps["seconds"]),
        )
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

    def _restart(self) -> bool:
        """Begin again with a wider beam, which may make all choices; False if it would be too wide."""
        width = self.search.settings.width * WIDENING
        if width > self._widest:
            return False
        conflicts = self.search.conflicts
        conflicts.refuted.clear()
        self._farthest = self._since = 0
        self.search.rewind(0, self.settings.beam(width, conflicts.count))
        return True

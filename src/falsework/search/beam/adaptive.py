"""Beam search that backtracks and widens on failure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Progress, SearchResult, Stop
from falsework.search.problem.task import Direction, Task

_LOOKED_FARTHER, _BOUND_OTHERWISE, _WIDE_NEARBY = 1, 2, 3
"""Retries after the first three deaths: with a larger lookahead; from before robots were bound to a part that they
could not release, which is avoided; and wider, from a few levels back."""
_TRIALS = 3
"""Times in a row that the beam comes back as narrow as it was, with other random preferences, before it is widened."""
_DISORDER = 0.3
"""Spread of these preferences at first; each further trial adds as much. Scores of a guide are shares of 1."""
_WIDENING_FACTOR = 4
"""After that, the beam comes back this many times wider ..."""
_RETREAT_FACTOR = 4
"""... from this many times farther back ..."""
_RETREAT_LEVELS = 8
"""... than so many levels; each trial of one width begins twice as far back as the last."""
_LOOKAHEAD_STATES = 64
"""States without a need for a verdict that the narrowest beam keeps, so that the next level has a choice."""
_FARTHER_LOOKAHEAD = 256
"""The same after a death."""
_LOOKAHEAD_PER_WIDTH = 16
"""The same for wide beams, as a multiple of the width."""
_PLACE = ("failures", "deaths", "farthest", "easy_from")
"""Fields of the memory of places where beams died."""


@dataclass(frozen=True)
class AdaptiveSettings:
    """Direction, initial width and seed of an adaptive beam."""

    direction: Direction = Direction.ASSEMBLY
    """Which end to begin at."""
    width: int = 1
    """Width to begin with and to return to after every hard place."""
    seed: int = 0
    """Same seed, same machine, same result."""

    def beam(self, failures: int, number: int = 0, avoided: tuple[int, ...] = ()) -> BeamSettings:
        """Return settings of the beam after so many deaths in a row at one place, and `number` deaths altogether."""
        widened, trial = self.trial(failures)
        width = self.width * _WIDENING_FACTOR ** (1 if failures == _WIDE_NEARBY else widened)
        return BeamSettings(
            width=width,
            direction=self.direction,
            diversity="none",
            lookahead=max(_LOOKAHEAD_STATES if failures == 0 else _FARTHER_LOOKAHEAD, _LOOKAHEAD_PER_WIDTH * width),
            commit=width == 1,
            retries=0,
            disorder=_DISORDER * trial,
            avoided=avoided,
            number=number,
            seed=self.seed,
        )

    @staticmethod
    def trial(failures: int) -> tuple[int, int]:
        """Return how often the beam is widened after so many deaths, and which trial of that width it is."""
        return divmod(max(failures - _WIDE_NEARBY, 0), _TRIALS + 1)


class AdaptiveBeam:
    """Beam search that takes another way where it dies, then a wider one, and narrows again afterwards.

    Where the beam dies, it first comes back from near by: with more states ahead, then without binding a robot to the
    part that all its last states hold, then wider. After that it is taken back some levels and prefers other parts, at
    random; if it dies there again, back farther, and after some trials wider. A narrow beam that takes another way
    costs a fraction of a wide one, whose states are mostly the same parts in another order. Once it is well past the
    place, it follows its guide again, and is narrow. Verdicts asked before are in the oracle's memory, so going over
    the same ground costs little.
    """

    def __init__(self, task: Task, oracle: Oracle, settings: AdaptiveSettings, *, guide: Guide | None = None) -> None:
        """Begin narrow, at the origin of the direction."""
        self.settings = settings
        self.search = BeamSearch(task, oracle, settings.beam(0), guide=guide)
        self._failures = self._deaths = 0
        self._farthest = -1
        self._easy_from = -1

    @property
    def infeasible(self) -> bool:
        """Whether the search is dead with no state left out: there is no plan."""
        return self.search.done and not self.search.found and self.search.exhaustive

    def run(self, widest: int, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Search until the goal is reached, a beam wider than `widest` would be needed, or `stop` returns true.

        Args:
            widest: limit on the width, except near by where the beam dies; run again with a larger one to go on.
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
                self._failures = 0
                self.search.rewind(len(self.search.levels) - 1, self.settings.beam(0))
            elif result.interrupted or result.found or self.infeasible:
                return result
            elif not self._widen(widest):
                if not result.undecided and not result.sliding:
                    limit = f"beams up to a width of {self.search.settings.width} died; wider ones may come through"
                    result = replace(result, limit=limit)
                return result

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the search as it stands: plain values, and arrays."""
        header, arrays = self.search.pack()
        own = {name: getattr(self, f"_{name}") for name in _PLACE}
        return header | {"adaptive": own, "base": self.settings.width, "base_seed": self.settings.seed}, arrays

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
        direction = Direction(header["settings"]["direction"])
        beam = cls(task, oracle, AdaptiveSettings(direction, int(header["base"]), int(header["base_seed"])))
        beam.search = BeamSearch.unpack(header, arrays, task, oracle, guide=guide)
        for name in _PLACE:
            setattr(beam, f"_{name}", int(header["adaptive"][name]))
        return beam

    def _eased(self) -> bool:
        """Return whether the beam is wide and well past the place where it died."""
        return self._failures > 0 and len(self.search.levels) - 1 > self._easy_from and not self.search.done

    def _widen(self, widest: int) -> bool:
        """Go back and come again, another way or wider; False if that would be too wide."""
        search = self.search
        level = len(search.levels) - 1
        failures = 1 if level > self._farthest + 2 else self._failures + 1
        robots, bound = search.task.robots, search.bound()
        widened, trial = self.settings.trial(failures)
        retreat, avoided = _RETREAT_LEVELS * _RETREAT_FACTOR**widened * 2 ** max(trial - 1, 0), ()
        if failures == _LOOKED_FARTHER:
            retreat = robots
        elif failures == _BOUND_OTHERWISE and bound is not None:
            part, since = bound
            avoided, retreat = (part,), level - since + robots
        if self.settings.width * _WIDENING_FACTOR**widened > widest:
            return False
        settings = self.settings.beam(failures, self._deaths + 1, avoided)
        self._failures, self._farthest = failures, max(self._farthest, level)
        self._deaths += 1
        self._easy_from = self._farthest + 2 * _RETREAT_LEVELS
        search.rewind(max(level - retreat, 0), settings)
        return True

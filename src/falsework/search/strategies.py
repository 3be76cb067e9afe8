"""Portfolio of the searches that a planner runs in turns: which there are, and how each begins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from falsework.assembly.state import held_count
from falsework.errors import InputError
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import WIDENING, BeamSettings
from falsework.search.beam.state_search import StateSearch
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.search import Search
from falsework.search.problem.task import STAGE, Direction, Task
from falsework.search.settings import PlannerSettings
from falsework.utils.interruption import interrupted_by

EDGES = "edges"
"""Beam that closes free edges first, see `EdgeGuide`."""
REGRASP = "regrasp-"
"""Before the name of a direction: search through single states in which parts may be held again."""
TOGETHER = "together-"
"""Before the name of a direction: search through single states in which steps may move several parts. Beams are named
after their direction."""

_LEVEL_WORTH = 4
"""Verdicts for each state kept at a level that the search for it may cost: some two to three times what it costs where
no beam dies."""

_LEAD = 2
"""Times the work of the strategy that has worked least at which the turn of another is over; checked on a structure of
399 parts with three and four robots, and on perturbed shells of 37 and 53 parts that the second strategy solves."""

_DOUBTED_ROUNDS = 2
"""Rounds of turns for a start that does not come to rest by itself: mostly it does not as it is built either."""
_PIECES = 64
"""Pieces of searches for ways out in the first turn of a strategy; each further turn has twice as many."""


@dataclass
class Turn:
    """What a strategy asked for in its turn and how far it got, since the strategy began."""

    asked: float = 0
    level: int = 0
    """Farthest level."""
    owed: float = 0.0
    """Verdicts of this turn that new levels do not make up for."""
    tested: int = 0
    """Level up to which what it has built was tested."""

    def note(self, search: Search, width: int) -> None:
        """Note how far the search of the strategy is now, whose beams began with some width."""
        worth = _LEVEL_WORTH * width * max(search.level - self.level, 0)
        self.owed = max(self.owed + search.effort - self.asked - worth, 0.0)
        self.asked, self.level = search.effort, max(search.level, self.level)


class Pace:
    """Pieces of searches for ways out, after which the turn of a strategy is over too; they go on where they were."""

    def __init__(self, others: Callable[[], bool]) -> None:
        """Take what says whether there are other strategies."""
        self._others, self._left = others, 0.0
        self.over = False
        """Whether the last turn ended since it had too many."""

    @contextmanager
    def turn(self, round: int) -> Iterator[None]:
        """Count the pieces of a turn, of a round from 0, and end the search in which it is over."""
        self._left, self.over = _PIECES * 2.0**round, False
        with interrupted_by(self._count, large=True):
            yield

    def _count(self) -> None:
        self._left -= 1
        self.over = self._left < 0 and self._others()
        if self.over:
            raise DeadlineExceeded


@dataclass(frozen=True)
class Portfolio:
    """Strategies of one search, which take turns."""

    names: tuple[str, ...]
    """In the order of their turns."""
    later: tuple[str, ...] = field(default=(), kw_only=True)
    """Those that begin once all these have given up."""
    narrowest: int
    """Width of beams to begin with."""
    widest: int
    """Width up to which they restart."""
    patience: float = np.inf
    """Verdicts of the first turn of each that new levels do not make up for, over the width of beams to begin with;
    each further turn has twice as many."""
    rounds: float = np.inf
    """Rounds of turns after which the search gives up."""

    def is_over(self, round: int, turn: Turn, work: int = 0, least: float = np.inf) -> bool:
        """Return whether the turn of a strategy is over.

        Verdicts are no measure across strategies: one from the complete structure may take as long as thirty from the
        empty one. So a turn is over too where a strategy is far ahead of another in work.

        Args:
            round: counted from 0.
            work: `Search.work` of the strategy.
            least: work of the other strategy that has begun and worked least.
        """
        ahead = bool(np.isfinite(self.patience)) and work > _LEAD * least
        return ahead or turn.owed >= self.patience * self.narrowest * 2.0**round

    def assembly_first(self) -> Portfolio:
        """Return the strategies where contact histories decide: beams in the order of disassembly come last.

        Those judge states from rest, which is stricter than as they are built, and replay complete plans only. But they
        may prove that there is no plan.
        """
        first = tuple(name for name in self.names if direction_of(name) is Direction.ASSEMBLY)
        later = tuple(name for name in self.names if name not in first)
        return replace(self, names=first, later=later) if first else self

    def doubted(self) -> Portfolio:
        """Return the strategies where the start does not come to rest by itself: those that build it, for some time."""
        return replace(self.assembly_first(), later=(), rounds=_DOUBTED_ROUNDS)

    @classmethod
    def from_settings(
        cls, settings: PlannerSettings, stage: str, task: Task, *, edges: bool = False, wide: bool = False
    ) -> Portfolio:
        """Return the strategies of a search.

        Args:
            stage: `plan`, `postpone` or `alternatives`.
            edges: in stage `plan`, a beam that closes free edges first takes turns too.
            wide: beams are as wide as they may be from the beginning, so that verdicts are asked for in batches.
        """
        if wide:
            narrow = cls.from_settings(settings, stage, task, edges=edges)
            return replace(narrow, narrowest=narrow.widest)
        names = [direction.value for direction in settings.directions]
        sets = [TOGETHER + name for name in names] if task.together is not None else []
        if stage == "postpone":
            return cls((*names, *sets), 1, min(WIDENING, settings.width))
        if stage == "alternatives":
            # Disassembly leaves more freedom in the order of removal than assembly.
            names = sorted(sets or names, key=lambda name: direction_of(name) is not Direction.DISASSEMBLY)
            # One state a level leaves no choice.
            narrowest, widest = (min(width, settings.width) for width in (WIDENING, WIDENING**2))
            return cls(tuple(names), narrowest, widest)
        patience = settings.patience * task.part_count
        if regrasps(task, settings):
            again = [REGRASP + name for name in names]
            once = [*names[:1], *sets] if (STAGE[task.target] >= STAGE[task.start]).all() else []
            return cls((*again, *once), 1, settings.width, patience)
        names += sets  # plans that move one part at a time come first, as they are simpler
        if edges and Direction.ASSEMBLY in settings.directions:
            names.insert(0, EDGES)
        return cls(tuple(names), 1, settings.width, patience)


def regrasps(task: Task, settings: PlannerSettings) -> bool:
    """Return whether holding parts again is allowed and can make a difference.

    A single robot that releases a part without removing it returns to the state before the hold. So between states in
    which nothing is held, and without props, repeated holds allow it nothing more.

    Raises:
        InputError: they do, and the settings ask for alternatives.
    """
    nothing_held = not held_count(np.stack([task.start, task.target]), task.boundary).any()
    if not task.allow_regrasp or (task.robots == 1 and not task.prop_limit and nothing_held):
        return False
    if settings.alternatives > 1:
        raise InputError("plans with repeated holds have no alternatives yet; ask for one plan")
    return True


def direction_of(name: str) -> Direction:
    """Return the direction in which a strategy searches."""
    return Direction.ASSEMBLY if name == EDGES else Direction(name.removeprefix(REGRASP).removeprefix(TOGETHER))


def start(
    name: str,
    task: Task,
    oracle: Oracle,
    portfolio: Portfolio,
    seed: int,
    guide_of: Callable[[str], Guide | None],
) -> Search:
    """Return a strategy at its beginning; `guide_of` returns the guide of each."""
    direction, guide = direction_of(name), guide_of(name)
    if name.startswith(REGRASP):
        return StateSearch(task, oracle, direction, guide=guide)
    once = replace(task, allow_regrasp=False)
    if name.startswith(TOGETHER):
        return StateSearch(once, oracle, direction, guide=guide)
    settings = BeamSettings.from_width(portfolio.narrowest, direction, seed=seed)
    return BeamSearch(replace(once, together=None), oracle, settings, guide=guide)

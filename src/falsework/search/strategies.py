"""Portfolio of the searches that a planner runs in turns: which there are, and how each begins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.state import held_count
from falsework.errors import InputError
from falsework.search.beam.backjumping import WIDENING, BackjumpingBeam, BackjumpingSettings
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.level_search import Beams
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.search import Search
from falsework.search.problem.task import STAGE, Direction, Task
from falsework.search.regrasp.beam import RegraspBeam
from falsework.search.regrasp.exhaustive import ExhaustiveRegraspSearch
from falsework.search.settings import PlannerSettings
from falsework.search.together_beam import TogetherBeam

EDGES = "edges"
"""Beam that closes free edges first, see `EdgeGuide`."""
REGRASP = "regrasp-"
"""Before the name of a direction: beam in which parts may be held again."""
EVERYWHERE = "everywhere"
"""Exhaustive search in which parts may be held again. Beams are named after their direction."""
TOGETHER = "together-"
"""Before the name of a direction: beam in which steps may move several parts, at last without a limit."""


@dataclass(frozen=True)
class Portfolio:
    """Strategies of one search, which take turns."""

    names: tuple[str, ...]
    """In the order of their turns."""
    narrowest: int
    """Width of beams to begin with."""
    widest: int
    """Width up to which they restart."""
    share: float | None = None
    """Verdicts of the first turn of each; each further turn has twice as many. None: until it gives up."""

    def allowance(self, round: int) -> float:
        """Return the verdicts that a strategy may ask for up to and with a round, counted from 0."""
        return np.inf if self.share is None else self.share * (2.0 ** (round + 1) - 1.0)

    def is_over(self, round: int, name: str, search: Search) -> bool:
        """Return whether the turn of a strategy in a round is over.

        The first turn of the beam of free edges ends at its first dead end too: where edges have to be closed first, it
        hardly comes to one, and most shells need not.
        """
        return (round == 0 and name == EDGES and search.dead_ends > 0) or search.asked >= self.allowance(round)

    @classmethod
    def from_settings(
        cls, settings: PlannerSettings, stage: str, task: Task, *, edges: bool = False, wide: bool = False
    ) -> Portfolio:
        """Return the strategies of a search.

        Args:
            settings: effort and directions.
            stage: `plan`, `postpone` or `alternatives`.
            task: the rules.
            edges: in stage `plan`, a beam that closes free edges first takes turns too.
            wide: beams are as wide as they may be from the beginning, which costs little on tensors.
        """
        if wide:
            narrow = cls.from_settings(settings, stage, task, edges=edges)
            share = None if narrow.share is None else narrow.widest * narrow.share
            return replace(narrow, narrowest=narrow.widest, share=share)
        names = [direction.value for direction in settings.directions]
        if stage == "postpone":
            return cls(tuple(names), 1, min(WIDENING, settings.width))
        if stage == "alternatives":
            # Disassembly leaves more freedom in the order of removal than assembly.
            names.sort(key=lambda name: name != Direction.DISASSEMBLY)
            # One state a level leaves no choice.
            narrowest, widest = (min(width, settings.width) for width in (WIDENING, WIDENING**2))
            return cls(tuple(names), narrowest, widest)
        share = settings.share * task.part_count
        if regrasps(task, settings):
            again = [REGRASP + name for name in names]
            once = names[:1] if (STAGE[task.target] >= STAGE[task.start]).all() else []
            return cls((again[0], EVERYWHERE, *again[1:], *once), 1, settings.width, share)
        if moves_together(task, settings):  # plans that move one part at a time come first, as they are simpler
            names += [TOGETHER + name for name in names]
        if edges and Direction.ASSEMBLY in settings.directions:
            names.insert(0, EDGES)
        return cls(tuple(names), 1, settings.width, share)


def regrasps(task: Task, settings: PlannerSettings) -> bool:
    """Return whether holding parts again is allowed and can make a difference.

    A single robot that releases a part without removing it returns to the state before the hold. So between states in
    which nothing is held, and without props, repeated holds allow it nothing more.

    Raises:
        InputError: they do, and the settings ask for a judge or for alternatives.
    """
    nothing_held = not held_count(np.stack([task.start, task.target]), task.boundary).any()
    if not task.allow_regrasp or (task.robots == 1 and not task.prop_limit and nothing_held):
        return False
    if settings.judge or settings.alternatives > 1:
        what = "judge yet; leave it out" if settings.judge else "alternatives yet; ask for one plan"
        raise InputError(f"plans with repeated holds have no {what}")
    return True


def moves_together(task: Task, settings: PlannerSettings) -> bool:
    """Return whether steps may move several parts.

    Raises:
        InputError: they may, and the settings ask for alternatives.
    """
    if task.together is not None and settings.alternatives > 1:
        raise InputError("plans with several parts in one step have no alternatives yet; ask for one plan")
    return task.together is not None


def direction_of(name: str) -> Direction:
    """Return the direction in which a strategy searches."""
    if name == EVERYWHERE:
        return Direction.DISASSEMBLY
    return Direction.ASSEMBLY if name == EDGES else Direction(name.removeprefix(REGRASP).removeprefix(TOGETHER))


def start(
    name: str,
    task: Task,
    oracle: Oracle,
    portfolio: Portfolio,
    seed: int,
    guide_of: Callable[[str], Guide | None],
    beams: Beams = BeamSearch,
) -> Search:
    """Return a strategy at its beginning, with beams of some backend; `guide_of` returns the guide of each."""
    direction, guide = direction_of(name), guide_of(name)
    if name == EVERYWHERE:
        return ExhaustiveRegraspSearch(task, oracle)
    if name.startswith(REGRASP):
        assert guide is not None
        return RegraspBeam(task, oracle, direction, guide=guide, width=portfolio.narrowest)
    if name.startswith(TOGETHER):
        return TogetherBeam(task, oracle, direction, guide=guide, width=portfolio.narrowest)
    settings = BackjumpingSettings(direction, portfolio.narrowest, seed)
    alone = replace(task, allow_regrasp=False, together=None)
    return BackjumpingBeam(alone, oracle, settings, guide=guide, beams=beams)

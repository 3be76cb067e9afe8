"""Level search: what the beam searches on the host and on a device have in common."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.beam.frontier import Level, PackedLevel
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.result import Progress, Route, SearchProgress, SearchResult, Stop
from falsework.search.problem.task import Direction, Task


class LevelSearch(ABC):
    """Search level by level from one end of a task, each level one move from the last."""

    levels: list[Level | PackedLevel]
    """Levels so far, from the origin on."""

    def __init__(self, task: Task, settings: BeamSettings) -> None:
        """Begin without a level.

        Raises:
            InputError: a task in which steps may move several parts.
        """
        if task.together is not None:
            raise InputError(
                "beams of levels move one part at a time; search with find_plans, or without parts_at_once"
            )
        self.task, self.settings = task, settings
        self._levels: list[Any] = []
        """The same where the search keeps them; entries have `states`."""
        self._dead = False
        self._seconds = 0.0

    @property
    def found(self) -> bool:
        """Whether the goal is reached."""
        return len(self._levels) == self.task.steps + 1

    @property
    def done(self) -> bool:
        """Whether the goal is reached or nothing is left to expand."""
        return self._dead or self.found

    def states(self) -> States:
        """Return all states kept so far, level by level from the origin. Shape (count, parts)."""
        empty = np.empty((0, self.task.part_count), dtype=np.uint8)
        return np.concatenate([empty, *(level.states for level in self.levels)])

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Step until the goal is reached, nothing is left, or `stop` or the keyboard interrupts the search.

        Args:
            progress: called after every level.
            stop: asked before every level, of several processes in all alike; true stops the search, which can then be
                run on.

        Returns:
            A found route, or how far the search came; `interrupted` after an interruption.
        """
        begun = time.perf_counter()
        interrupted = False
        try:
            while not self.done:
                if stop is not None and stop():
                    interrupted = True
                    break
                self._advance()
                if progress is not None:
                    progress(self._report(self._seconds + time.perf_counter() - begun))
        except KeyboardInterrupt:
            interrupted = True
        len(self.levels)  # brings those on a device to the host, which belongs to the time
        self._seconds += time.perf_counter() - begun
        return self.result(interrupted=interrupted)

    def route(self) -> Route:
        """Return the best scored way from start to target, in disassembly order; only once `found`."""
        if not self.found:
            raise InputError("the beam search has not reached its goal; there is no route yet")
        row, states = 0, []
        for level in reversed(self.levels):
            states.append(level.states[row])
            row = int(level.parent[row])
        if self.settings.direction is Direction.DISASSEMBLY:
            states.reverse()
        return Route.from_states(np.array(states))

    @abstractmethod
    def result(self, *, interrupted: bool = False) -> SearchResult:
        """Return the result so far; `interrupted` if the search was stopped from outside."""

    @abstractmethod
    def _advance(self) -> None:
        """Find the next level, or do what is to be done where there is none."""

    @property
    @abstractmethod
    def _asked(self) -> int:
        """Verdicts asked for."""

    def _report(self, seconds: float) -> SearchProgress:
        return SearchProgress(
            self.settings.direction,
            len(self._levels) - 1,
            self.task.steps,
            len(self._levels[-1].states) if self._levels else 0,
            self.settings.width,
            self._asked,
            seconds,
        )

"""Lines of progress between two evaluations of a run."""

from __future__ import annotations

import time
from collections.abc import Mapping

from falsework.learn.algorithms.learner import Learner
from falsework.learn.env.environment import Environment
from falsework.learn.training.budget import TrainingBudget
from falsework.learn.training.logger import Journal

LINE_EVERY = 1.0
"""Seconds between two lines, at least."""


class ProgressLines:
    """Writer of the numbers of a learner at work, with the speeds since the last line."""

    def __init__(self, journal: Journal | None, environment: Environment, budget: TrainingBudget) -> None:
        """Start the clock.

        Args:
            journal: log of the run, if this process writes one.
            environment: counts its steps.
            budget: clock of the run.
        """
        self._journal, self._environment, self._budget = journal, environment, budget
        self._last = (time.perf_counter(), 0, environment.counters.steps)
        """Time, optimizer steps and environment steps of the last line."""

    def write(self, learner: Learner, before: int, numbers: Mapping[str, float]) -> None:
        """Write a line, if the last one is old enough.

        Args:
            learner: at work.
            before: optimizer steps of earlier phases.
            numbers: its figures.
        """
        now, steps, played = time.perf_counter(), before + learner.steps, self._environment.counters.steps
        seconds = now - self._last[0]
        if self._journal is None or seconds < LINE_EVERY:
            return
        line = {
            "seconds": round(self._budget.seconds, 3),
            "steps_per_second": (steps - self._last[1]) / seconds,
            "environment_steps_per_second": (played - self._last[2]) / seconds,
        }
        self._journal.write(steps, line | {f"train/{name}": value for name, value in numbers.items()})
        self._last = now, steps, played

"""Lines of progress between two evaluations of a run."""

from __future__ import annotations

import time
from collections.abc import Mapping

from falsework.learn.algorithms.learner import Learner
from falsework.learn.env.environment import Environment
from falsework.learn.training.budget import TrainingBudget
from falsework.learn.training.logger import Journal


class ProgressLines:
    """Writer of the numbers of a learner at work, with the speeds since the last line."""

    def __init__(
        self, journal: Journal | None, environment: Environment, budget: TrainingBudget, *, every: float
    ) -> None:
        """Start the clock.

        Args:
            journal: log of the run, if this process writes one.
            environment: counts its steps.
            budget: clock of the run.
            every: seconds between two lines, at least.
        """
        self._every = every
        self._journal, self._environment, self._budget = journal, environment, budget
        self._time, self._steps, self._played = time.perf_counter(), 0, environment.counters.steps
        self._learner: Learner | None = None

    def write(self, learner: Learner, before: int, most: int, numbers: Mapping[str, float]) -> None:
        """Write a line, if the last one is old enough.

        Args:
            learner: at work.
            before: steps of the run less those of the learner, where the block begins.
            most: steps of the run where the block ends; a learner that finishes an update takes more.
            numbers: its figures.
        """
        now, played = time.perf_counter(), self._environment.counters.steps
        seconds = now - self._time
        if self._journal is None or seconds < self._every:
            return
        taken = learner.steps - (self._steps if learner is self._learner else 0)
        line = {
            "seconds": round(self._budget.seconds, 3),
            "steps_per_second": taken / seconds,
            "environment_steps_per_second": (played - self._played) / seconds,
        }
        step = min(before + learner.steps, most)
        self._journal.write(step, line | {f"train/{name}": value for name, value in numbers.items()})
        self._time, self._steps, self._played, self._learner = now, learner.steps, played, learner

"""Logs of a training run: JSON lines, TensorBoard, Weights & Biases."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from falsework.errors import DependencyError, InputError
from falsework.learn.algorithms.learner import Learner
from falsework.learn.env.environment import Environment
from falsework.learn.training.budget import TrainingBudget
from falsework.utils.files.output_file import write_whole
from falsework.utils.lazy import importing
from falsework.utils.quantity import is_number

PROGRESS = "progress.jsonl"
TENSORBOARD = "tensorboard"
LOGS = ("tensorboard", "wandb")
"""Logs that may be asked for, beside `progress.jsonl`."""


class Journal:
    """All logs of a run; TensorBoard is left out with a remark where it cannot write."""

    def __init__(
        self,
        folder: Path,
        logs: Sequence[str] = ("tensorboard",),
        *,
        configuration: Mapping[str, Any] | None = None,
        resumed_at: int | None = None,
    ) -> None:
        """Open the logs.

        Args:
            logs: `tensorboard`, `wandb` or both, beside `progress.jsonl`, which is always written.
            configuration: settings of the run, for those that show them.
            resumed_at: step of the checkpoint that training continues from; lines of later steps are dropped, since
                these steps are taken again.

        Raises:
            DependencyError: wandb was asked for and is not installed.
        """
        self.notes: list[str] = []
        self._path = folder / PROGRESS
        kept = [] if resumed_at is None else [line for line in read_progress(folder) if line["step"] <= resumed_at]
        text = "".join(json.dumps(line) + "\n" for line in kept)
        write_whole(self._path, lambda file: file.write(text.encode()))
        self._tensorboard = self._wandb = None
        if "tensorboard" in logs:
            try:
                self._tensorboard = _tensorboard(folder, resumed_at)
            except DependencyError as error:
                self.notes.append(f"{error}; going on without")
        if "wandb" in logs:
            name = folder.resolve().name
            options: dict[str, Any] = {"project": "falsework", "id": name, "name": name, "resume": "allow"}
            self._wandb = _import_wandb().init(config=dict(configuration or {}), **options)

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Note numbers that belong to a step; each line is flushed at once."""
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"step": step, **values}, allow_nan=False, default=str) + "\n")
        except OSError as error:  # a line of the curve is not worth a training run
            warnings.warn(f"cannot write {self._path}: {error.strerror}; training continues", stacklevel=2)
        if self._tensorboard is not None:
            for name, value in values.items():
                if is_number(value):
                    self._tensorboard.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.log(dict(values), step=step)

    def close(self) -> None:
        """Nothing more comes."""
        if self._tensorboard is not None:
            self._tensorboard.close()
        if self._wandb is not None:
            self._wandb.finish()


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


def check_logs(logs: Sequence[str]) -> None:
    """Refuse logs that cannot be written, before anything is computed.

    Raises:
        DependencyError: wandb was asked for and is not installed.
        InputError: an unknown kind of log.
    """
    for name in logs:
        if name not in LOGS:
            raise InputError(f"unknown log {name!r}; choose {' or '.join(LOGS)}")
    if "wandb" in logs:
        _import_wandb()


def read_progress(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of `progress.jsonl` without one that an interruption cut off; none if there is no file."""
    path = folder / PROGRESS
    if not path.is_file():
        return []
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            lines.append(json.loads(line))
        except ValueError:
            continue
    return lines


def _tensorboard(folder: Path, resumed_at: int | None) -> Any:
    with importing("logs for TensorBoard need tensorboard; pip install 'falsework[learn]'"):
        from torch.utils.tensorboard import SummaryWriter
    purge = None if resumed_at is None else resumed_at + 1
    try:
        return SummaryWriter(str(folder / TENSORBOARD), purge_step=purge, flush_secs=10)
    except UnicodeEncodeError:
        raise DependencyError("tensorboard writes no logs into a folder whose name is not UTF-8") from None


def _import_wandb() -> Any:
    with importing("--log wandb needs wandb; pip install 'falsework[wandb]', or leave it out"):
        import wandb
    return wandb

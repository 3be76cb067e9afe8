"""Context of a training run, shared by its data, its learners and its loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch

from falsework.assembly.model import Assembly
from falsework.learn.config.train import TrainSettings
from falsework.learn.data.dataset import training_task
from falsework.search.device.oracle import TensorOracle
from falsework.search.problem.task import Task
from falsework.utils.distributed import ProcessGroup


@dataclass(frozen=True, eq=False)
class RunContext:
    """Structure, settings, verdicts and processes of one run."""

    assembly: Assembly
    settings: TrainSettings
    """Resolved."""
    oracle: TensorOracle
    """Verdicts."""
    device: torch.device
    """Where data, rollouts and networks are."""
    shards: ProcessGroup = field(default_factory=ProcessGroup)
    """Processes that work on the run together."""
    folder: Path | None = None
    """Of the run, if it keeps anything."""
    report: Callable[[str], None] | None = None
    """Called with progress messages while data is searched for."""
    note: Callable[[str], None] = lambda text: None
    """Called with warnings."""

    @cached_property
    def task(self) -> Task:
        """Disassembly of the whole structure, under the criterion of the oracle."""
        task = training_task(self.assembly, self.settings.robots, self.settings.removable_only_if_clear)
        return task.judged_by(self.oracle)

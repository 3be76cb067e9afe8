"""Training loggers: JSON lines, TensorBoard, Weights & Biases."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from falsework.errors import DependencyError, InputError
from falsework.utils.files.output_file import write_whole

PROGRESS = "progress.jsonl"
TENSORBOARD = "tensorboard"
LOGS = ("tensorboard", "wandb")
"""Logs that may be asked for, beside `progress.jsonl`."""


class Writer(Protocol):
    """Destination of named metrics."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Note numbers that belong to a step."""
        ...

    def close(self) -> None:
        """Nothing more comes."""
        ...


class Progress:
    """`progress.jsonl`: one JSON object a line, each flushed at once."""

    def __init__(self, folder: Path, resumed_at: int | None = None) -> None:
        """Begin a new file, or continue after the step of the checkpoint.

        Args:
            folder: of the run.
            resumed_at: lines of later steps are dropped, since these steps are taken again.
        """
        self.path = folder / PROGRESS
        kept = [] if resumed_at is None else [line for line in read_progress(folder) if line["step"] <= resumed_at]
        text = "".join(json.dumps(line) + "\n" for line in kept)
        write_whole(self.path, lambda file: file.write(text.encode()))

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """See `Writer`."""
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"step": step, **values}, allow_nan=False, default=str) + "\n")
        except OSError as error:  # a line of the curve is not worth a training run
            warnings.warn(f"cannot write {self.path}: {error.strerror}; training continues", stacklevel=2)

    def close(self) -> None:
        """See `Writer`."""


class TensorBoard:
    """Scalars for TensorBoard."""

    def __init__(self, folder: Path, resumed_at: int | None = None) -> None:
        """Write below the folder of a run.

        Raises:
            DependencyError: tensorboard is not installed, or writes no file of that name.
        """
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise DependencyError("logs for TensorBoard need tensorboard; pip install 'falsework[learn]'") from None
        purge = None if resumed_at is None else resumed_at + 1
        try:
            self._writer = SummaryWriter(str(folder / TENSORBOARD), purge_step=purge, flush_secs=10)
        except UnicodeEncodeError:
            raise DependencyError("tensorboard writes no logs into a folder whose name is not UTF-8") from None

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """See `Writer`."""
        for name, value in values.items():
            if isinstance(value, (int, float)) and not isinstance(value, bool):
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """See `Writer`."""
        self._writer.close()


class WeightsAndBiases:
    """The same numbers for Weights & Biases."""

    def __init__(self, folder: Path, configuration: Mapping[str, Any]) -> None:
        """Begin or continue a run named like the folder.

        Raises:
            DependencyError: wandb is not installed.
        """
        name = folder.resolve().name
        self._run = _import_wandb().init(
            project="falsework", id=name, name=name, resume="allow", config=dict(configuration)
        )

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """See `Writer`."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """See `Writer`."""
        self._run.finish()


class Journal:
    """All writers of a run; TensorBoard is left out with a remark where it cannot write."""

    def __init__(
        self,
        folder: Path,
        logs: Sequence[str] = ("tensorboard",),
        *,
        configuration: Mapping[str, Any] | None = None,
        resumed_at: int | None = None,
    ) -> None:
        """Open the writers.

        Args:
            folder: of the run.
            logs: `tensorboard`, `wandb` or both, beside `progress.jsonl`, which is always written.
            configuration: settings of the run, for those that show them.
            resumed_at: step of the checkpoint that training continues from.

        Raises:
            DependencyError: wandb was asked for and is not installed.
        """
        self.notes: list[str] = []
        self._writers: list[Writer] = [Progress(folder, resumed_at)]
        for name in logs:
            if name == "tensorboard":
                try:
                    self._writers.append(TensorBoard(folder, resumed_at))
                except DependencyError as error:
                    self.notes.append(f"{error}; going on without")
            else:
                self._writers.append(WeightsAndBiases(folder, configuration or {}))

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Note numbers that belong to a step."""
        for writer in self._writers:
            writer.write(step, values)

    def close(self) -> None:
        """Nothing more comes."""
        for writer in self._writers:
            writer.close()


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


def _import_wandb() -> Any:
    try:
        import wandb
    except ImportError:
        raise DependencyError("--log wandb needs wandb; pip install 'falsework[wandb]', or leave it out") from None
    return wandb


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

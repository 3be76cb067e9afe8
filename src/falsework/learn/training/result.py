"""Result of a training run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falsework.learn.networks import policy as policies
from falsework.learn.training.evaluate import Success


@dataclass(frozen=True)
class TrainResult:
    """Result of a training run."""

    folder: Path | None
    steps: int
    """Steps of the optimizer."""
    seconds: float
    """Total time, data and earlier sessions included."""
    data_seconds: float
    train: Success
    """Greedy success on a sample of the paper's training set."""
    validation: Success
    """Greedy success on a sample of the validation set."""
    test: Success
    """Greedy success on a sample of the test set, tried once, at the end."""
    solved: int
    """Number of states learned from."""
    held_out_visit_rate: float
    """Share of the held-out states, symmetric images included, that rollouts visited while training."""
    interrupted: bool
    processes: int
    device: str
    throughput: dict[str, Any]
    """Of the environment, in this session."""
    policy: policies.Policy
    """With the weights that were evaluated, as `load_run` reads them."""
    curve: tuple[dict[str, float], ...] = ()
    """Contents of `progress.jsonl` for this session."""
    notes: tuple[str, ...] = ()
    first: bool = True
    """This process is the one that reports."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "steps": self.steps,
            "seconds": round(self.seconds, 2),
            "data_seconds": round(self.data_seconds, 2),
            "train": self.train.to_dict(),
            "validation": self.validation.to_dict(),
            "test": self.test.to_dict(),
            "solved": self.solved,
            "held_out_visit_rate": round(self.held_out_visit_rate, 6),
            "interrupted": self.interrupted,
            "processes": self.processes,
            "device": self.device,
            "environment": self.throughput,
        }

"""Training of one policy for all structures, and the run that it is kept in."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from experiments.structure_batches import BatchSettings, StructureBatch, StructureBatches
from torch import nn

from falsework.errors import InputError
from falsework.learn.algorithms.imitation import imitation_loss
from falsework.learn.algorithms.policy_optimizer import PolicyOptimizer
from falsework.learn.config.policy import PolicySettings
from falsework.learn.config.train import TrainSettings
from falsework.learn.networks.local_attention import LocalAttention
from falsework.learn.training.checkpoint import WEIGHTS, CheckpointFile, load_weights, save_run
from falsework.utils.quantity import check_seed

_FINAL_LEARNING_RATE = 0.02
"""Learning rate at the end, as a share of the largest."""
_AVERAGE = 0.999
"""Decay of the moving average of the weights that is evaluated and saved."""


@dataclass(frozen=True)
class GeneralSettings(BatchSettings):
    """Settings of the training of a policy for all structures."""

    policy: PolicySettings = field(default_factory=lambda: PolicySettings("local"))
    """Network; only kind `local` learns from many structures at once."""
    seconds: float = 3600.0
    """Time of the whole training, over which the learning rate falls; pieces of it add up."""
    steps: int = 0
    """Steps of the optimizer in place of a time; 0: go by `seconds`."""
    learning_rate: float = 1e-3
    """Largest step of AdamW."""
    warm_up: int = 300
    """Steps in which the learning rate rises."""
    seed: int = 0
    """Of weights and batches."""

    def __post_init__(self) -> None:
        if self.policy.kind != "local" or self.policy.goal_conditioned:
            raise InputError("one policy for all structures is of kind local and has no goals; leave the kind as it is")
        self.check("warm_up")
        if not self.seconds > 0:
            raise InputError(f"training for {self.seconds:g} s learns nothing; give a time above zero")
        check_seed(self.seed)


class GeneralTraining:
    """Training of a network on batches of many structures, continued from its checkpoint in a folder."""

    def __init__(self, folder: Path | str, settings: GeneralSettings, device: torch.device | str = "cpu") -> None:
        """Begin, or continue where the folder has a checkpoint; of a run without one, with its weights.

        Args:
            folder: of checkpoint and weights; made if it is not there.
            settings: those of the checkpoint, if there is one, but for the time.
            device: where to train.

        Raises:
            InputError: the checkpoint is damaged, or of other settings.
        """
        self.folder, self.settings, self.device = Path(folder), settings, torch.device(device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.network = LocalAttention(settings.policy.resolved()).to(self.device)
        self.optimizer = PolicyOptimizer(
            self.network, learning_rate=settings.learning_rate, weight_decay=0.01, only_matrices=True, betas=(0.9, 0.98)
        )
        self.seconds = self.reinforced = 0.0
        """Time trained so far, by imitation and by reinforcement."""
        self._file = CheckpointFile(self.folder)
        if self._file.exists():
            tensors, state = self._file.load()
            if state.get("settings") != self._fixed():
                raise InputError(f"{self._file.path} was trained with other settings; give those, or another folder")
            self.optimizer.load_state_dict({name: tensor.to(self.device) for name, tensor in tensors.items()})
            self.seconds, self.reinforced = float(state["seconds"]), float(state.get("reinforced", 0.0))
        elif (self.folder / WEIGHTS).exists():
            kept = nn.ModuleDict({"network": LocalAttention(settings.policy.resolved())})
            load_weights(kept, self.folder / WEIGHTS)
            self.optimizer.load_policy(cast(LocalAttention, kept["network"]).to(self.device))

    @property
    def steps(self) -> int:
        """Steps of the optimizer taken."""
        return self.optimizer.steps

    @property
    def progress(self) -> float:
        """Share of the whole training that is done."""
        done = self.steps / self.settings.steps if self.settings.steps else self.seconds / self.settings.seconds
        return min(done, 1.0)

    def run(self, batches: StructureBatches, seconds: float) -> dict[str, float]:
        """Train for a time, or to the end of the training.

        Args:
            batches: to learn from.
            seconds: of this call.

        Returns:
            Means over the call: `loss`, the `share` of states in which the most probable action is valid, and
            `gradient_norm`.

        Raises:
            TrainingError: a step was not finite.
        """
        settings, gpu = self.settings, self.device.type == "cuda"
        draw = np.random.default_rng([settings.seed, self.steps])
        generator = torch.Generator(self.device).manual_seed(settings.seed * 1_000_003 + self.steps)
        sums, count = torch.zeros(3, device=self.device), 0
        begun, before = time.perf_counter(), self.seconds
        self.network.train()
        while self.progress < 1.0 and time.perf_counter() - begun < seconds:
            batch = batches.draw(settings.tokens, settings.mix, draw, generator)
            with torch.autocast(self.device.type, torch.bfloat16, enabled=gpu):
                logits, value = self.network(batch.graph, batch.numbers)
            loss = policy_loss(logits, batch)
            norm = self.optimizer.step(
                # Solvable states alone are known, so all values are 1: a beginning for reinforcement, nothing more.
                loss + 0.05 * (value - 1.0).square().mean(),
                learning_rate=settings.learning_rate * self._schedule(),
                average=min(_AVERAGE, (2 + self.steps) / (11 + self.steps)),
            )
            sums += torch.stack([loss.detach(), hit_share(logits.detach(), batch), norm])
            count += 1
            if gpu and count % 20 == 0:
                torch.cuda.synchronize(self.device)
            self.seconds = before + time.perf_counter() - begun
        self.optimizer.check()
        self.network.eval()
        names = ("loss", "share", "gradient_norm")
        return dict(zip(names, (sums / max(count, 1)).tolist(), strict=True))

    @torch.no_grad()
    def validate(self, batches: StructureBatches, count: int = 20) -> dict[str, float]:
        """Return `loss` and `share` of the averaged weights on structures that are not trained on, always the same."""
        network, generator = self.averaged(), torch.Generator(self.device).manual_seed(1)
        draw, sums = np.random.default_rng(1), torch.zeros(2, device=self.device)
        for _ in range(count):
            batch = batches.draw(self.settings.tokens // 4, self.settings.mix, draw, generator)
            logits, _ = network(batch.graph, batch.numbers)
            sums += torch.stack([policy_loss(logits, batch), hit_share(logits, batch)])
        loss, share = (sums / count).tolist()
        return {"loss": loss, "share": share}

    def averaged(self) -> LocalAttention:
        """Return a network with the moving average of the weights."""
        network = LocalAttention(self.settings.policy.resolved()).to(self.device)
        network.load_state_dict(self.network.state_dict())
        self.optimizer.export_policy(network)
        return network.eval()

    def save(self, results: Mapping[str, Any] | None = None) -> None:
        """Write checkpoint and run.

        Args:
            results: JSON values about data and success, kept in `run.json`.
        """
        tensors = self.optimizer.state_dict()
        times = {"seconds": self.seconds, "reinforced": self.reinforced}
        note = self._file.save(tensors, {"settings": self._fixed(), **times})
        if note:
            raise InputError(note)
        settings = TrainSettings(policy=self.settings.policy, seed=self.settings.seed)
        metadata = {
            "structure": None,
            "settings": asdict(settings),
            "policy": {**asdict(self.settings.policy.resolved()), "parameters": _count(self.network)},
            "results": {
                "general": asdict(self.settings),
                **times,
                "steps": self.steps,
                **(results or {}),
            },
            "versions": {"torch": torch.__version__.split("+")[0]},
        }
        save_run(self.folder, nn.ModuleDict({"network": self.averaged()}), metadata)

    def _fixed(self) -> dict[str, Any]:
        """Return the settings that a continued training must share."""
        return {name: value for name, value in asdict(self.settings).items() if name not in ("seconds", "steps")}

    def _schedule(self) -> float:
        rise = min((self.steps + 1) / self.settings.warm_up, 1.0)
        return rise * (
            _FINAL_LEARNING_RATE + (1 - _FINAL_LEARNING_RATE) * 0.5 * (1 + math.cos(math.pi * self.progress))
        )


def policy_loss(logits: torch.Tensor, batch: StructureBatch) -> torch.Tensor:
    """Return the loss of imitation over all states of a batch."""
    return imitation_loss(logits.flatten(0, 1), batch.legal.flatten(0, 1), batch.valid.flatten(0, 1))


def hit_share(logits: torch.Tensor, batch: StructureBatch) -> torch.Tensor:
    """Return the share of states in which the most probable legal action is valid."""
    best = logits.masked_fill(~batch.legal, -torch.inf).argmax(dim=-1, keepdim=True)
    return batch.valid.gather(-1, best).float().mean()


def _count(network: nn.Module) -> int:
    return sum(weight.numel() for weight in network.parameters())

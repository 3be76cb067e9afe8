"""Learners of the phases of a training run, and their state in a checkpoint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from falsework.learn.algorithms.curriculum import Curriculum
from falsework.learn.algorithms.imitation import Imitation
from falsework.learn.algorithms.ppo import PPO
from falsework.learn.algorithms.start_states import MixedStarts, StartSampler
from falsework.learn.config.imitation import ImitationPhase
from falsework.learn.config.train import Phase, TrainSettings
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.networks.policy import Policy
from falsework.learn.training.training_data import TrainingData
from falsework.utils.collectives import gather_rows
from falsework.utils.distributed import ProcessGroup


class Learner(Protocol):
    """Improves a policy, a block of steps at a time."""

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """Take some steps of the optimizer.

        Args:
            steps: how many.
            progress: of the whole training, before and after.

        Returns:
            Numbers to log.
        """
        ...

    def export_policy(self, policy: Policy) -> Policy:
        """Write the weights to be evaluated into another policy of the same kind, and return it."""
        ...

    def load_policy(self, policy: Policy) -> None:
        """Continue with the weights of another policy of the same kind, such as the result of the phase before."""
        ...

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that is the same in all processes."""
        ...

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """Return the state that belongs to this process."""
        ...

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """Restore both; `local` is None if the number of processes has changed."""
        ...


@dataclass(frozen=True, eq=False)
class LearnerContext:
    """Everything that the learners of one run share."""

    environment: Environment
    policy: Policy
    """Trained in place."""
    solved: SolvableStates
    data: TrainingData
    settings: TrainSettings
    """Resolved."""
    shards: ProcessGroup
    folder: Path | None
    """For the batch of a step that is not finite."""

    def make(self, phase: Phase, *, begin: float, compiled: bool) -> Learner:
        """Make the learner of a phase.

        Args:
            phase: its settings.
            begin: progress of the whole training at which the phase begins.
            compiled: compile the network.
        """
        options: dict[str, Any] = {
            "tasks": self.data.tasks,
            "seed": self.settings.seed,
            "precision": self.settings.precision,
            "compiled": compiled,
            "shards": self.shards,
            "folder": self.folder,
        }
        if isinstance(phase, ImitationPhase):
            return Imitation(self.policy, self.solved, phase, **options)
        rules, starts, targets = self.environment.rules, self.data.starts, self.data.targets
        if phase.starts == "mixed":
            rollouts = max(phase.rollouts // self.shards.size, 1)
            tasks = self.data.tasks
            sampler: StartSampler = MixedStarts(starts, self.solved, rules, rollouts, targets=targets, tasks=tasks)
        else:
            if phase.starts == "complete":
                starts, targets = rules.complete(), None
            sampler = Curriculum(starts, rules, phase.curriculum, targets=targets, shards=self.shards)
        return PPO(self.environment, self.policy, sampler, phase, solved=self.solved, begin=begin, **options)


def share_solved(solved: SolvableStates, known: int, shards: ProcessGroup) -> None:
    """Tell all processes what each has found solvable since it knew `known` states."""
    if shards.size > 1:
        solved.add(gather_rows(solved.states[known:], shards))
        solved.learn_held_out_hashes(gather_rows(solved.held_out_hashes(), shards))
        solved.sort()


def gather_local(local: dict[str, torch.Tensor], shards: ProcessGroup, device: torch.device) -> dict[str, torch.Tensor]:
    """Gather the local state of all processes, under names with the rank of each."""
    if shards.size == 1:
        return {f"process.0.{name}": tensor for name, tensor in local.items()}
    whole: dict[str, torch.Tensor] = {}
    for name in sorted(local):
        rows = local[name].to(device)
        counts = gather_rows(torch.tensor([len(rows)], device=device), shards).tolist()
        pieces = gather_rows(rows, shards).split(counts)
        whole |= {f"process.{rank}.{name}": piece for rank, piece in enumerate(pieces)}
    return whole


def local_of(tensors: dict[str, torch.Tensor], shards: ProcessGroup) -> dict[str, torch.Tensor] | None:
    """Return what `gather_local` kept for this process; None if there were more or fewer of them."""
    ranks = {int(name.split(".")[1]) for name in tensors if name.startswith("process.")}
    return below(f"process.{shards.rank}.", tensors) if len(ranks) == shards.size else None


def below(prefix: str, values: dict[str, Any]) -> dict[str, Any]:
    """Return the values under names that begin with a prefix, with the prefix taken off."""
    return {name[len(prefix) :]: value for name, value in values.items() if name.startswith(prefix)}

"""What a batch of rollouts did, as tensors over steps and rollouts that are made once and used again."""

from __future__ import annotations

import torch

from falsework.learn.env.rollout import Move


class Storage:
    """Rollouts as columns of shape (steps, rollouts, ...); a rollout that ended leaves its column unused."""

    def __init__(self, steps: int, rollouts: int, parts: int, device: torch.device, *, targets: bool = False) -> None:
        """Make room.

        Args:
            steps: most actions of a rollout.
            rollouts: how many.
            parts: number of parts.
            device: where.
            targets: keep the target of every rollout too.
        """
        shape = (steps, rollouts)
        self.states = torch.zeros((*shape, parts), dtype=torch.uint8, device=device)
        self.mask = torch.zeros((*shape, 2 * parts), dtype=torch.bool, device=device)
        self.actions = torch.zeros(shape, dtype=torch.int64, device=device)
        self.log_probability = torch.zeros(shape, device=device)
        """Of the action, when it was drawn."""
        self.value = torch.zeros(shape, device=device)
        self.reward = torch.zeros(shape, device=device)
        self.done = torch.zeros(shape, dtype=torch.bool, device=device)
        self.taken = torch.zeros(shape, dtype=torch.bool, device=device)
        """Where there was an action at all."""
        self.targets = torch.zeros((rollouts, parts), dtype=torch.uint8, device=device) if targets else None
        self.success = torch.zeros(rollouts, dtype=torch.bool, device=device)
        self.steps = 0
        """Actions of the longest rollout so far."""

    def fits(self, steps: int, rollouts: int, *, targets: bool) -> bool:
        """Whether rollouts of this size can be written into this storage."""
        room, columns = self.taken.shape
        return steps <= room and rollouts == columns and targets == (self.targets is not None)

    def clear(self, success: torch.Tensor, targets: torch.Tensor | None) -> None:
        """Forget all rollouts; `success` says which of the new ones are at their target before the first action."""
        self.taken.zero_()
        self.steps = 0
        self.success.copy_(success)
        if self.targets is not None and targets is not None:
            self.targets.copy_(targets)

    def write(self, move: Move, log_probability: torch.Tensor) -> None:
        """Add the next action of every rollout that goes on."""
        step, rows = self.steps, move.rows
        for column, values in (
            (self.states, move.states),
            (self.mask, move.mask),
            (self.actions, move.actions),
            (self.log_probability, log_probability),
            (self.value, move.value),
            (self.reward, move.step.reward),
            (self.done, move.step.done),
        ):
            column[step].index_copy_(0, rows, values)
        self.taken[step].index_fill_(0, rows, True)
        self.success.index_copy_(0, rows, move.step.success)
        self.steps += 1

    def returns(self, discount: float, trace: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Advantages and what the values ought to have been (generalised advantage estimation, Schulman et al. 2016).

        All rollouts end by themselves, so nothing beyond their last reward has to be guessed.

        Args:
            discount: what a reward a step later is worth.
            trace: decay of later surprises.

        Returns:
            Both of shape (steps, rollouts), zero where no action was taken.
        """
        used = slice(0, self.steps)
        going = (self.taken & ~self.done)[used].float()
        value, reward = self.value[used], self.reward[used]
        advantage = torch.zeros_like(value)
        later_advantage = later_value = torch.zeros(value.shape[1], device=value.device)
        for step in range(self.steps - 1, -1, -1):
            surprise = reward[step] + discount * going[step] * later_value - value[step]
            later_advantage = surprise + discount * trace * going[step] * later_advantage
            later_value = value[step]
            advantage[step] = later_advantage
        taken = self.taken[used]
        return advantage * taken, (advantage + value) * taken

    def pairs(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Where there was an action: indices into the flattened (steps, rollouts), and the rollout of each."""
        place = self.taken[: self.steps].reshape(-1).nonzero()[:, 0]
        return place, place % self.taken.shape[1]

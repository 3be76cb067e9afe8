"""Policies: networks that propose the next action from any state of a structure (paper, section 5.4).

A policy is a `torch.nn.Module` called as `policy(states, targets=None) -> (logits, value)`; its logits ignore the
rules, which are applied as a mask (`falsework.search.device.rules`).
"""

from __future__ import annotations

from typing import Self

import torch
from torch import Tensor, nn

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.config.policy import PolicySettings


class Policy(nn.Module):
    """Base of all networks: the parts of the structure, and the encoding of states.

    Data of the structure are kept in buffers that `state_dict` omits, so that the weights of a network that does not
    identify parts by number load into the network of any other structure.
    """

    fixed: Tensor
    """Boundary parts, shape (parts,), bool."""

    def __init__(self, assembly: Assembly, settings: PolicySettings) -> None:
        """Remember the boundary of an assembly, and the settings with their defaults filled in."""
        super().__init__()
        self.settings = settings.resolved()
        self.part_count = assembly.part_count
        self.keep("fixed", torch.tensor(assembly.boundary.tolist(), dtype=torch.bool))

    def keep(self, name: str, tensor: Tensor) -> None:
        """Register a tensor that belongs to the structure, not to the weights."""
        self.register_buffer(name, tensor, persistent=False)

    @property
    def goal_conditioned(self) -> bool:
        """Whether targets count."""
        return self.settings.goal_conditioned

    @property
    def kinds_of_part(self) -> int:
        """Number of values of `classes`."""
        return 12 if self.settings.goal_conditioned else 4

    def numbers(self, states: Tensor, targets: Tensor | None) -> Tensor:
        """Return the class of every part: removed 0, installed 1, held 2, boundary 3; times 3 plus the goal, if any.

        Args:
            states: uint8, shape (batch, parts).
            targets: uint8, shape (batch, parts); for a goal-conditioned policy, None is the empty structure. Other
                policies ignore it.

        Returns:
            Shape (batch, parts), int32.
        """
        if states.shape[-1] != self.part_count:
            raise InputError(f"states have {states.shape[-1]} parts; this policy is for {self.part_count}")
        number = torch.where(self.fixed, 3, states.int())
        if self.settings.goal_conditioned:
            goal = torch.where(self.fixed, 2, 0) if targets is None else targets
            number = 3 * number + goal.int()
        return number

    def classes(self, states: Tensor, targets: Tensor | None) -> Tensor:
        """Return the same one-hot, shape (batch, parts, kinds_of_part), bool."""
        numbers = self.numbers(states, targets)
        return numbers[..., None] == torch.arange(self.kinds_of_part, device=states.device, dtype=numbers.dtype)

    def of_task(self, robots: int, *, equilibrium: bool) -> Self:
        """Tell the policy how many parts may be held and under which criterion, and return it.

        Only networks for many structures and tasks have an input for it; others change nothing. A `PolicyGuide` with a
        task says it itself.
        """
        return self

    def forward(self, states: Tensor, targets: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return logits of all actions and an estimate of success.

        Args:
            states: uint8, shape (batch, parts).
            targets: uint8, shape (batch, parts), or None.

        Returns:
            Logits, float32, shape (batch, 2 parts), not masked; value, float32, shape (batch,), in [-1, 1].
        """
        raise NotImplementedError


def small_head(channels: int, outputs: int) -> nn.Linear:
    """Make a last layer whose outputs are near zero at first, so that no action is preferred."""
    head = nn.Linear(channels, outputs)
    nn.init.normal_(head.weight, std=0.01)
    nn.init.zeros_(head.bias)
    return head


def masked_log_probabilities(logits: Tensor, mask: Tensor) -> Tensor:
    """Log probabilities of the actions that a mask allows.

    Args:
        logits: shape (batch, actions).
        mask: bool, shape (batch, actions).

    Returns:
        float32, shape (batch, actions); exactly -inf where the mask is off, so that the probability is exactly zero,
        and in all of a row without legal action. Gradients are finite, and zero where the mask is off.
    """
    logits = logits.float()
    # A large finite number instead of -inf: it underflows to zero all the same, and differentiates without NaN.
    low = torch.where(mask, logits, torch.full_like(logits, -1e30))
    return torch.where(mask, torch.log_softmax(low, dim=-1), -torch.inf)


@torch.no_grad()
def confidences(policy: nn.Module, states: Tensor, mask: Tensor, targets: Tensor | None = None) -> Tensor:
    """Return the probability of each action among the legal ones.

    Args:
        policy: as `make_policy` makes it.
        states: uint8, shape (batch, parts).
        mask: legal actions, bool, shape (batch, 2 parts).
        targets: uint8, shape (batch, parts), or None.

    Returns:
        float32, shape (batch, 2 parts); each row adds up to one, or to zero where no action is legal.
    """
    logits, _ = policy(states, targets)
    return masked_log_probabilities(logits, mask).exp()

"""A policy as the guide of a search, and as the source of rollouts: probabilities on arrays, torch behind the door."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.errors import InputError
from falsework.learn.door import check_torch
from falsework.search.task import Direction, Task

if TYPE_CHECKING:
    import torch

_FLOOR = -30.0
"""Least log probability that a legal action counts with: a search may need what the policy thinks nothing of."""
_BATCH = 4096
"""States that the network sees at once."""


class PolicyGuide:
    """Scores actions by the logarithm of the probability that a policy gives them; a `falsework.search.guide.Guide`.

    In disassembly that is the probability of the action in the state. In assembly an action is undone, and what counts
    is the probability with which the policy would take it from the state before: summed up along a way, both are the
    logarithm of the probability that a rollout of the policy takes this way.
    """

    def __init__(
        self,
        policy: Any,
        device: torch.device | str | None = None,
        *,
        task: Task | None = None,
    ) -> None:
        """Ask `policy`, a `torch.nn.Module` as `falsework.learn.policy.make_policy` makes them.

        Args:
            policy: called with states, and with targets if it was trained for two states.
            device: where the network is moved; where it is if not given.
            task: gives a policy of two states its target, and the search from the target its rules.

        Raises:
            DependencyError: torch is not installed.
        """
        check_torch()
        import torch

        self._torch = torch
        self.policy = policy if device is None else policy.to(device)
        self.policy.eval()
        weights = next(iter(policy.parameters()), None)
        self.device = torch.device("cpu") if weights is None else weights.device
        self.two_states = bool(getattr(getattr(policy, "settings", None), "two_states", False))
        self.task = task

    def for_task(self, task: Task) -> PolicyGuide:
        """The same policy as the guide of another task."""
        return PolicyGuide(self.policy, task=task)

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        """As `falsework.search.guide.Guide`.

        Raises:
            InputError: from the target, without a task.
        """
        if direction is Direction.DISASSEMBLY:
            return np.maximum(self.log_probabilities(states, actions), _FLOOR)
        if self.task is None:
            raise InputError("a policy guides a search from the target only with the task; give PolicyGuide(task=...)")
        scores = np.full(actions.shape, _FLOOR)
        row, action = np.nonzero(actions)
        for begin in range(0, len(row), _BATCH):
            rows, taken = row[begin : begin + _BATCH], action[begin : begin + _BATCH]
            before = self.task.follow(states[rows], taken, Direction.ASSEMBLY)
            legal = self.task.moves(before, Direction.DISASSEMBLY)
            scores[rows, taken] = self.log_probabilities(before, legal)[np.arange(len(rows)), taken]
        return np.maximum(scores, _FLOOR)

    def log_probabilities(self, states: States, legal: Mask, targets: States | None = None) -> NDArray[np.float64]:
        """Logarithms of the probabilities of all actions, minus infinity where they are not legal.

        Args:
            states: shape (batch, parts).
            legal: shape (batch, 2 parts).
            targets: shape (batch, parts); the target of the task if not given, the empty structure without one.

        Returns:
            Shape (batch, 2 parts); a state without a legal action has minus infinity throughout.
        """
        if targets is None and self.task is not None:
            targets = np.broadcast_to(self.task.target, states.shape)
        logits = np.where(legal, self._logits(states, targets), -np.inf)
        largest = logits.max(axis=1, keepdims=True, initial=-np.inf)
        shifted = logits - np.where(np.isfinite(largest), largest, 0.0)
        total = np.exp(shifted).sum(axis=1, keepdims=True)
        return shifted - np.log(np.where(total > 0, total, 1.0))

    def _logits(self, states: States, targets: States | None) -> NDArray[np.float64]:
        """What the network says, each distinct question asked once. Shape (batch, 2 parts)."""
        torch, conditioned = self._torch, self.two_states and targets is not None
        questions = np.concatenate([states, targets], axis=1) if conditioned and targets is not None else states
        questions = np.ascontiguousarray(questions)
        keys = questions.view(np.dtype((np.void, questions.shape[1]))).ravel()
        _, first, back = np.unique(keys, return_index=True, return_inverse=True)
        answers = np.empty((len(first), 2 * states.shape[1]))
        with torch.inference_mode():
            for begin in range(0, len(first), _BATCH):
                rows = first[begin : begin + _BATCH]
                asked = torch.from_numpy(np.ascontiguousarray(states[rows])).to(self.device)
                aim = None
                if conditioned and targets is not None:
                    aim = torch.from_numpy(np.ascontiguousarray(targets[rows])).to(self.device)
                logits, _ = self.policy(asked, aim)
                answers[begin : begin + _BATCH] = logits.float().cpu().numpy()
        if not np.isfinite(answers).all():
            raise InputError("the policy returned values that are not finite; its weights are damaged, train it again")
        return answers[back]

"""Policy as an action heuristic of a search and as a sampler of rollouts, on NumPy arrays."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States
from falsework.errors import InputError
from falsework.search.problem.hashing import chunks
from falsework.search.problem.task import Direction, Task
from falsework.stability.cache import unique_rows
from falsework.utils.tensors import check_torch

_FLOOR = -30.0
"""Least log probability that a legal action counts with: a search may need actions that the policy considers
improbable."""
_BATCH = 4096
"""States evaluated by the network in one batch."""


class PolicyGuide:
    """Action heuristic by the log-probabilities of a policy; a `falsework.search.Guide`.

    In disassembly that is the probability of the action in the state. In assembly an action is undone, and its score is
    the probability with which the policy would take it from the state before: summed along a path, both are the
    logarithm of the probability that a rollout of the policy takes this path.
    """

    def __init__(
        self,
        policy: Any,
        *,
        task: Task | None = None,
    ) -> None:
        """Prepare a guide with `policy`, a `torch.nn.Module` as `falsework.learn.make_policy` returns it.

        Args:
            policy: called with states, and with targets if it is goal-conditioned.
            task: gives a goal-conditioned policy its target, and the search from the target its rules.
        """
        check_torch()
        import torch

        self._torch = torch
        self.policy = policy
        self.policy.eval()
        weights = next(iter(policy.parameters()), None)
        self.device = torch.device("cpu") if weights is None else weights.device
        self.goal_conditioned = bool(getattr(policy, "goal_conditioned", False))
        self.task = task
        self._seconds: dict[int, float] = {}

    def for_task(self, task: Task) -> PolicyGuide:
        """Return the same policy as the guide of another task, whose evaluations are as fast."""
        guide = PolicyGuide(self.policy, task=task)
        guide._seconds = self._seconds
        return guide

    def warm_up(self, state: States, rows: int) -> None:
        """Evaluate the network on one state, then on `rows` different ones, to load it and to measure its speed."""
        for count in {1, max(rows, 1)}:
            states = np.repeat(state[None], count, axis=0)
            held = np.arange(count) % len(state)
            states[np.arange(count), held] = HELD
            self._ask(states, states if self.goal_conditioned else None)

    def seconds_for(self, rows: int) -> float:
        """Estimate the network's time for a number of states from earlier calls, s; 0 if nothing is known."""
        if not self._seconds:
            return 0.0
        nearest = min(self._seconds, key=lambda known: abs(known - rows.bit_length()))
        return self._seconds[nearest] * max(rows / 2 ** (nearest - 1), 1.0) ** 0.5

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        """See `falsework.search.problem.guide.Guide`."""
        if direction is Direction.DISASSEMBLY:
            return np.maximum(self.log_probabilities(states, actions), _FLOOR)
        if self.task is None:
            raise InputError("a policy guides a search from the target only with the task; give PolicyGuide(task=...)")
        scores = np.full(actions.shape, _FLOOR)
        row, action = np.nonzero(actions)
        for piece in chunks(len(row), _BATCH):
            rows, taken = row[piece], action[piece]
            before = self.task.follow(states[rows], taken, Direction.ASSEMBLY)
            legal = self.task.moves(before, Direction.DISASSEMBLY)
            scores[rows, taken] = self.log_probabilities(before, legal)[np.arange(len(rows)), taken]
        return np.maximum(scores, _FLOOR)

    def log_probabilities(self, states: States, legal: Mask, targets: States | None = None) -> NDArray[np.float64]:
        """Return logarithms of the probabilities of all actions, minus infinity where they are not legal.

        Args:
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
        """Evaluate the network on distinct inputs. Shape (batch, 2 parts)."""
        targets = targets if self.goal_conditioned else None
        questions = states if targets is None else np.concatenate([states, targets], axis=1)
        first, back = unique_rows(questions)
        pieces = [first[piece] for piece in chunks(len(first), _BATCH)]
        answers = [self._ask(states[rows], None if targets is None else targets[rows]) for rows in pieces]
        logits = np.concatenate(answers) if answers else np.empty((0, 2 * states.shape[1]))
        if not np.isfinite(logits).all():
            raise InputError("the policy returned values that are not finite; its weights are damaged, train it again")
        return logits[back]

    def _ask(self, states: States, targets: States | None) -> NDArray[np.float64]:
        torch = self._torch
        begun = time.perf_counter()
        if self.task is not None and hasattr(self.policy, "of_task"):
            self.policy.of_task(self.task.robots, equilibrium=self.task.holds_keep_stable)
        with torch.inference_mode():
            asked = torch.from_numpy(np.ascontiguousarray(states)).to(self.device)
            aim = None if targets is None else torch.from_numpy(np.ascontiguousarray(targets)).to(self.device)
            logits, _ = self.policy(asked, aim)
            answer = logits.double().cpu().numpy()
        size, taken = len(states).bit_length(), time.perf_counter() - begun
        self._seconds[size] = taken if size not in self._seconds else 0.5 * (taken + self._seconds[size])
        return answer

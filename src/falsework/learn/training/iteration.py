"""One iteration of a training run, as callbacks see it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from falsework.learn.training.evaluate import Success


@dataclass(frozen=True, eq=False)
class Iteration:
    """What a run knows after one iteration: an update from a collection of rollouts, or a block of imitation."""

    step: int
    """Steps of the optimizer taken."""
    seconds: float
    """Time of the run so far."""
    phase: int
    """Number of the phase, from 0."""
    numbers: Mapping[str, float]
    """What the learner logs, such as `loss`, `kl`, `rollout_success` and `rollout_return`."""
    policy: torch.nn.Module
    """The policy that is being trained."""
    best: Success
    """Best success on the validation set so far; without states before the first evaluation."""


Callback = Callable[[Iteration], object]
"""Called after each iteration, in the first of several processes; one that returns True ends the training when the
block of steps is done, and the best weights so far are the result."""

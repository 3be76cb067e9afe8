"""Two-state tasks: failed rollouts seen as successes at something else, and a policy that is not told its target.

Any state that a stable way passes can be made the target of that way: the actions that led to it keep what it keeps
(paper, section 5.3). So a rollout that failed still shows how to get to all it passed.
"""

from __future__ import annotations

import torch

from falsework.learn.env.rollout import Policy, Rollouts


def relabel(
    rollouts: Rollouts, count: int, generator: torch.Generator, *, failed_only: bool = True
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Hindsight: states of rollouts with a state that was passed later as the target.

    Whatever the rollouts were after, and however they ended, the actions up to a stable state were legal on the way
    to that state and led there.

    Args:
        rollouts: with all states kept.
        count: samples wanted.
        generator: source of randomness on the device of the rollouts.
        failed_only: leave rollouts out that reached what they were after.

    Returns:
        States and targets, both `uint8`, shape (samples, parts), and the action that was taken, `int64`, shape
        (samples,). No samples if no rollout took an action that left it stable.
    """
    stable = rollouts.length - rollouts.unstable.long()
    usable = (stable > 0) & ~(rollouts.success if failed_only else torch.zeros_like(rollouts.success))
    rows = usable.nonzero()[:, 0]
    if len(rows) == 0:
        none = rollouts.states.new_empty((0, rollouts.states.shape[2]))
        return none, none, rollouts.length.new_empty(0)
    device = rows.device
    # A long rollout has more to tell: draw pairs of steps, not rollouts, evenly.
    steps = stable[rows].double()
    row = rows[torch.multinomial(steps * (steps + 1) / 2, count, replacement=True, generator=generator)]
    last = stable[row]
    one, two = (torch.rand(count, generator=generator, device=device, dtype=torch.float64) for _ in range(2))
    first = (one * (last + 1)).long()
    second = (two * last).long()
    second = second + (second >= first).long()  # any other step
    begin, end = torch.minimum(first, second), torch.maximum(first, second)
    return rollouts.states[begin, row], rollouts.states[end, row], rollouts.actions[begin, row].long()


class OneState:
    """A policy that is not told the target, as the baseline for targets.

    What the target keeps, it keeps only because the rules forbid to touch it (`TensorRules.moves` with goals).
    """

    def __init__(self, policy: Policy) -> None:
        """Wrap a policy of one state."""
        self._policy = policy

    def __call__(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """As `Policy`; takes no notice of the targets."""
        return self._policy(states)

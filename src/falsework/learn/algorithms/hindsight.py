"""Hindsight relabelling (Andrychowicz et al. 2017): states that a rollout passed become its goals."""

from __future__ import annotations

import torch

from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.data.solvable_states import SolvableStates


def relabel(
    transitions: Transitions, count: int, solved: SolvableStates, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw two states of one rollout: the later one as the goal of the earlier one.

    Whatever the goal of a rollout, and however it ended, the actions between the two were legal and left the structure
    stable (paper, section 5.3).

    Args:
        transitions: of whole rollouts, in the order in which they were taken.
        count: pairs to draw.
        solved: has the held-out states, which become neither state nor goal.
        generator: source of randomness.

    Returns:
        States and goals, `uint8`, shape (pairs, parts); fewer than asked for where two draws coincide or are held out,
        and none without transitions.
    """
    if len(transitions) == 0:
        return transitions.states, transitions.states
    order = torch.argsort(transitions.rollout, stable=True)
    rollout = transitions.rollout[order]
    length = torch.bincount(rollout, minlength=len(transitions.success))
    begin = torch.cumsum(length, 0) - length
    first = torch.randint(len(order), (count,), generator=generator, device=order.device)
    mine = rollout[first]
    share = torch.rand(count, generator=generator, device=order.device, dtype=torch.float64)
    second = begin[mine] + (share * length[mine]).long()
    apart = (first != second).nonzero()[:, 0]
    early = order[torch.minimum(first, second)[apart]]
    late = order[torch.maximum(first, second)[apart]]
    states, goals = transitions.states[early], transitions.states[late]
    rows = (~solved.is_held_out(states) & ~solved.is_held_out(goals)).nonzero()[:, 0]
    return states[rows], goals[rows]

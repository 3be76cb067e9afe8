"""What every action of a batch of rollouts was worth, as far as success at the end and estimates on the way tell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import play
from falsework.learn.networks.policy import masked_log_probabilities


@dataclass(frozen=True, eq=False)
class Moves:
    """Every action of a batch of rollouts, one a row; `actions` rows in all."""

    states: torch.Tensor
    """`uint8`, shape (actions, parts)."""
    targets: torch.Tensor | None
    """Shape (actions, parts)."""
    actions: torch.Tensor
    """Shape (actions,)."""
    mask: torch.Tensor
    """Legal actions, shape (actions, 2 parts)."""
    log_probability: torch.Tensor
    """Of the action when it was drawn, shape (actions,)."""
    advantage: torch.Tensor
    """By how much it changed the chance of success, as far as the estimates tell, shape (actions,)."""
    chance: torch.Tensor
    """Chance of success to be learned for the state, between 0 and 1, shape (actions,)."""
    rollout: torch.Tensor
    """Rollout that the row belongs to, shape (actions,)."""
    success: torch.Tensor
    """Of every rollout, `bool`, shape (rollouts,)."""

    def __len__(self) -> int:
        return len(self.states)

    def take(self, rows: torch.Tensor) -> Moves:
        """Some of the actions."""
        return Moves(
            self.states[rows],
            None if self.targets is None else self.targets[rows],
            self.actions[rows],
            self.mask[rows],
            self.log_probability[rows],
            self.advantage[rows],
            self.chance[rows],
            self.rollout[rows],
            self.success,
        )


def hindsight(moves: Moves, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs of states that one rollout passed one after the other: the later one as the target of the earlier one.

    Whatever a rollout was after, and however it ended, the actions between the two were legal and left it stable
    (paper, section 5.3).

    Args:
        moves: of whole rollouts, in the order in which they were taken.
        count: pairs to draw.
        generator: source of randomness.

    Returns:
        States and targets, each of shape (pairs, parts); fewer pairs where two draws met, none if nothing moved.
    """
    if len(moves) == 0:
        return moves.states, moves.states
    order = torch.argsort(moves.rollout, stable=True)
    rollout = moves.rollout[order]
    length = torch.bincount(rollout, minlength=len(moves.success))
    begin = torch.cumsum(length, 0) - length
    first = torch.randint(len(order), (count,), generator=generator, device=order.device)
    mine = rollout[first]
    share = torch.rand(count, generator=generator, device=order.device, dtype=torch.float64)
    second = begin[mine] + (share * length[mine]).long()
    apart = (first != second).nonzero()[:, 0]
    early, late = torch.minimum(first, second)[apart], torch.maximum(first, second)[apart]
    return moves.states[order[early]], moves.states[order[late]]


def advantages(
    rows: list[torch.Tensor], chances: list[torch.Tensor], success: torch.Tensor, trace: float
) -> list[torch.Tensor]:
    """Generalised advantages of rollouts that are rewarded at their end alone, without a discount.

    Args:
        rows: for each step the rollouts that took part, shape (going,).
        chances: for each step their estimated chance of success before it, shape (going,).
        success: how each rollout ended, shape (rollouts,).
        trace: lambda; 1 compares with the end, 0 with the next estimate.

    Returns:
        For each step, shape (going,).
    """
    following = success.float()
    sums = torch.zeros_like(following)
    found = []
    for going, chance in zip(reversed(rows), reversed(chances), strict=True):
        advantage = following[going] - chance + trace * sums[going]
        sums[going] = advantage
        following[going] = chance
        found.append(advantage)
    return found[::-1]


def play_and_judge(
    environment: Environment,
    policy: Any,
    starts: torch.Tensor,
    targets: torch.Tensor | None,
    trace: float,
    generator: torch.Generator,
) -> Moves:
    """Draw rollouts and say of every action what it was worth.

    Args:
        environment: rules and verdicts.
        policy: as `Policy`.
        starts: stable states, shape (rollouts, parts).
        targets: shape (rollouts, parts), or None.
        trace: lambda of the advantages.
        generator: source of randomness.
    """
    success = environment.rules.reached(starts, targets)
    rows, states, aims, actions, masks, logs, chances = [], [], [], [], [], [], []
    for move in play(environment, policy, starts, targets, greedy=False, generator=generator):
        rows.append(move.rows)
        states.append(move.states)
        aims.append(move.targets)
        actions.append(move.actions)
        masks.append(move.mask)
        logs.append(masked_log_probabilities(move.logits, move.mask).gather(1, move.actions[:, None])[:, 0])
        chances.append(0.5 + 0.5 * move.value)
        success.index_copy_(0, move.rows, move.step.success)
    if not rows:
        empty = torch.empty(0, device=starts.device)
        none = torch.empty((0, 2 * environment.part_count), dtype=torch.bool, device=starts.device)
        return Moves(starts[:0], targets, empty.long(), none, empty, empty, empty, empty.long(), success)
    gained = torch.cat(advantages(rows, chances, success, trace))
    return Moves(
        torch.cat(states),
        None if targets is None else torch.cat([aim for aim in aims if aim is not None]),
        torch.cat(actions),
        torch.cat(masks),
        torch.cat(logs),
        gained,
        (gained + torch.cat(chances)).clamp(0.0, 1.0),
        torch.cat(rows),
        success,
    )

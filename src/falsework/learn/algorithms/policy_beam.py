"""Beam searches from many states at once, guided by a policy that is evaluated for all of them in one batch."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import PolicyFunction, forward_in_pieces
from falsework.learn.networks.policy import masked_log_probabilities
from falsework.search.device.parallel_beams import ParallelLevel, next_level, with_ancestors
from falsework.search.device.rules import TensorRules

_SPARE = 2
"""Candidates checked for each state that is kept, since some are unstable."""


@dataclass(frozen=True, eq=False)
class PolicyBeamResult:
    """Outcome of the searches."""

    found: torch.Tensor
    """Whether each start has a path to its target, `bool`, shape (starts,)."""
    states: torch.Tensor
    """All states on the paths that were found: proven stable and solvable, `uint8`, shape (count, parts)."""
    owner: torch.Tensor
    """Start that each of them belongs to, shape (count,)."""


def policy_beam_search(
    environment: Environment,
    policy: PolicyFunction,
    starts: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    width: int = 8,
) -> PolicyBeamResult:
    """Search in the order of disassembly from each start, with a beam of its own.

    Candidates of a start are ordered by the log probability of their path under the policy; the best `2 width` of them
    are checked, and the best `width` stable ones are kept.

    Args:
        environment: rules and verdicts.
        policy: guides the search.
        starts: stable, `uint8` on the device, shape (starts, parts).
        targets: shape (starts, parts), or None.
        width: states kept for each start at each step.
    """
    rules, count, device = environment.rules, len(starts), starts.device
    number = torch.arange(count, device=device)
    found = rules.reached(starts, targets)
    levels = [ParallelLevel(starts, number, number, torch.zeros(count, device=device))]
    ends: list[torch.Tensor] = [found.nonzero()[:, 0]]
    going = (~found).nonzero()[:, 0]

    def stable(states: torch.Tensor, parents: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return environment.stable(states, parents, needed=rules.needs_verdict(actions))

    while len(going):
        level = levels[-1].take(going)
        goals = None if targets is None else targets[level.owner]
        mask = rules.moves(level.states, goals)
        logits, _ = forward_in_pieces(policy, level.states, goals, environment.rows_at_once)
        score = level.value[:, None] + masked_log_probabilities(logits, mask)
        kept = next_level(rules, level, _candidates(rules, level, score, mask, width), stable, width, _SPARE)
        if len(kept.states) == 0:
            break
        kept.parent = going[kept.parent]
        levels.append(kept)
        there = rules.reached(kept.states, None if targets is None else targets[kept.owner])
        found = found.index_fill(0, kept.owner[there], True)
        ends.append(there.nonzero()[:, 0])
        going = (~found[kept.owner]).nonzero()[:, 0]
    paths = with_ancestors(levels, ends)[::-1]
    return PolicyBeamResult(
        found, torch.cat([path.states for path in paths]), torch.cat([path.owner for path in paths])
    )


def _best_of_rows(score: torch.Tensor, mask: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the best scored legal actions of each state, at most `count`: rows and actions."""
    best = score.topk(min(count, score.shape[1]), dim=1).indices
    legal = mask.gather(1, best)
    row, place = legal.nonzero(as_tuple=True)
    return row, best[row, place]


def _candidates(
    rules: TensorRules, level: ParallelLevel, score: torch.Tensor, mask: torch.Tensor, width: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the best successors for each start, in the order of their scores."""
    row, action = _best_of_rows(score, mask, _SPARE * width)
    value = score[row, action]
    order = torch.argsort(value, descending=True, stable=True)
    order = order[torch.argsort(level.owner[row][order], stable=True)]
    row, action, value = row[order], action[order], value[order]
    hashes = rules.hashes(rules.follow(level.states[row], action))
    first = _first_of_equals(hashes, level.owner[row])
    return row[first], action[first], value[first]


def _first_of_equals(hashes: torch.Tensor, owner: torch.Tensor) -> torch.Tensor:
    """Return the positions of the first of equal states of one start, in order."""
    order = torch.argsort(hashes, stable=True)
    order = order[torch.argsort(owner[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool, device=order.device)
    first[1:] = (hashes[order][1:] != hashes[order][:-1]) | (owner[order][1:] != owner[order][:-1])
    return torch.sort(order[first]).values

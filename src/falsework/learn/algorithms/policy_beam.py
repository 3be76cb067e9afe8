"""Beam searches from many states at once, guided by a policy: one question to the network serves all of them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import Policy, evaluate
from falsework.learn.networks.policy import masked_log_probabilities
from falsework.utils.tensors import place_in_group

_SPARE = 2
"""Candidates judged for each state that is kept, since some fall."""


@dataclass(frozen=True, eq=False)
class GroupSearch:
    """What became of the searches."""

    found: torch.Tensor
    """Which starts have a way to their target, `bool`, shape (starts,)."""
    states: torch.Tensor
    """All states on the ways that were found: proven stable and solvable, `uint8`, shape (count, parts)."""
    owner: torch.Tensor
    """Start that each of them belongs to, shape (count,)."""


@dataclass(eq=False)
class _Level:
    states: torch.Tensor
    owner: torch.Tensor
    parent: torch.Tensor
    score: torch.Tensor


def search_from(
    environment: Environment,
    policy: Policy,
    starts: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    width: int = 8,
) -> GroupSearch:
    """Search in the order of disassembly from each start, with a beam of its own.

    Candidates of a start are ordered by the logarithm of the probability that the policy goes their way, the best
    `2 width` of them are judged, and the best `width` that stand are kept.

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
    levels = [_Level(starts, number, number, torch.zeros(count, device=device))]
    ends: list[torch.Tensor] = [found.nonzero()[:, 0]]
    going = (~found).nonzero()[:, 0]
    while len(going):
        level = levels[-1]
        states, owner = level.states[going], level.owner[going]
        aims = None if targets is None else targets[owner]
        mask = rules.moves(states, aims)
        logits, _ = evaluate(policy, states, aims, environment.rows_at_once)
        score = level.score[going][:, None] + masked_log_probabilities(logits, mask)
        row, action = _best_of_rows(score, mask, _SPARE * width)
        kept = _choose(environment, states, owner, score, row, action, width)
        if kept is None:
            break
        kept.parent = going[kept.parent]
        levels.append(kept)
        aims = None if targets is None else targets[kept.owner]
        there = rules.reached(kept.states, aims)
        found = found.index_fill(0, kept.owner[there], True)
        ends.append(there.nonzero()[:, 0])
        going = (~found[kept.owner]).nonzero()[:, 0]
    states, owner = _trace(levels, ends)
    return GroupSearch(found, states, owner)


def _best_of_rows(score: torch.Tensor, mask: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The best scored legal actions of each state, at most `count`: rows and actions."""
    best = score.topk(min(count, score.shape[1]), dim=1).indices
    legal = mask.gather(1, best)
    row, place = legal.nonzero(as_tuple=True)
    return row, best[row, place]


def _choose(
    environment: Environment,
    states: torch.Tensor,
    owner: torch.Tensor,
    score: torch.Tensor,
    row: torch.Tensor,
    action: torch.Tensor,
    width: int,
) -> _Level | None:
    """The best stable successors for each start, or None if there are none."""
    if len(row) == 0:
        return None
    rules = environment.rules
    value = score[row, action]
    order = torch.argsort(value, descending=True, stable=True)
    order = order[torch.argsort(owner[row][order], stable=True)]
    row, action, value = row[order], action[order], value[order]
    after = rules.follow(states[row], action)
    first = _first_of_equals(rules.hashes(after), owner[row])
    first = first[place_in_group(owner[row][first]) < _SPARE * width]
    row, action, value, after = row[first], action[first], value[first], after[first]
    stable = environment.stable(after, states[row], needed=rules.needs_verdict(action))
    kept = stable.nonzero()[:, 0]
    kept = kept[place_in_group(owner[row][kept]) < width]
    if len(kept) == 0:
        return None
    return _Level(after[kept], owner[row][kept], row[kept], value[kept])


def _first_of_equals(hashes: torch.Tensor, owner: torch.Tensor) -> torch.Tensor:
    """Positions of the first of equal states of one start, in their order."""
    order = torch.argsort(hashes, stable=True)
    order = order[torch.argsort(owner[order], stable=True)]
    first = torch.ones(len(order), dtype=torch.bool, device=order.device)
    first[1:] = (hashes[order][1:] != hashes[order][:-1]) | (owner[order][1:] != owner[order][:-1])
    return torch.sort(order[first]).values


def _trace(levels: list[_Level], ends: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """All states from which one of the ends was reached, and whose they are."""
    states, owners = [], []
    later = ends[-1][:0]
    for level, own in zip(reversed(levels), reversed(ends), strict=True):
        rows = torch.unique(torch.cat([later, own]))
        states.append(level.states[rows])
        owners.append(level.owner[rows])
        later = level.parent[rows]
    return torch.cat(states), torch.cat(owners)

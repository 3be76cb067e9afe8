"""Rollouts: follow a policy from many states at once until each has ended."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import torch

from falsework.errors import InputError
from falsework.learn.env.environment import Environment, Rollouts, Step


class PolicyFunction(Protocol):
    """Policy and value function; every policy of `falsework.learn.networks.policy` is one."""

    def __call__(
        self, states: torch.Tensor, targets: torch.Tensor | None = None, /
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return logits, not masked, shape (batch, 2 parts), and values in [-1, 1], shape (batch,)."""
        ...


@dataclass(frozen=True, eq=False)
class Move:
    """One action of every rollout that goes on."""

    rows: torch.Tensor
    """Which of the rollouts these are, ascending, shape (going,)."""
    states: torch.Tensor
    """States that the actions were taken in, shape (going, parts)."""
    targets: torch.Tensor | None
    """Shape (going, parts)."""
    mask: torch.Tensor
    """Legal actions there, shape (going, 2 parts)."""
    logits: torch.Tensor
    """As the policy gave them, not masked, `float32`, shape (going, 2 parts)."""
    value: torch.Tensor
    """`float32`, shape (going,)."""
    actions: torch.Tensor
    """Shape (going,)."""
    step: Step
    """Result of the actions."""


def choose_actions(
    logits: torch.Tensor,
    mask: torch.Tensor,
    *,
    greedy: bool = True,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Return one legal action per row, the most probable one or a sampled one.

    Args:
        logits: shape (batch, 2 parts).
        mask: legal actions, at least one a row, shape (batch, 2 parts).
        greedy: take the most probable.
        temperature: divisor of the logits before sampling.
        generator: source of randomness, on the device of the logits.

    Returns:
        `int64`, shape (batch,). Illegal actions are never returned, whatever the logits are.
    """
    if not greedy:
        # The largest of logits with Gumbel noise is a draw from their softmax.
        noise = torch.empty_like(logits).exponential_(generator=generator)
        logits = logits / temperature - noise.log()
    return logits.masked_fill(~mask, -torch.inf).argmax(dim=1)


def play(
    environment: Environment,
    policy: PolicyFunction,
    starts: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    greedy: bool = True,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    checked: bool = False,
) -> Iterator[Move]:
    """Follow a policy, one action of all rollouts that go on at a time; arguments as in `roll_out`.

    Starts that are their target already, or have no legal action, do not take part.
    """
    if not temperature > 0:
        raise InputError(f"temperature is {temperature:g}; give a number above zero, or take greedy rollouts")
    rules = environment.rules
    states, mask = starts, rules.moves(starts, targets)
    rows = torch.arange(len(starts), device=starts.device)
    going = mask.any(dim=1) & ~rules.reached(starts, targets)
    while True:
        kept = going.nonzero()[:, 0]
        if len(kept) == 0:
            return
        if len(kept) < len(rows):
            rows, states, mask = rows[kept], states[kept], mask[kept]
            targets = None if targets is None else targets[kept]
        with environment.timed("seconds_network"):
            logits, value = _ask(environment, policy, states, targets)
            actions = choose_actions(logits, mask, greedy=greedy, temperature=temperature, generator=generator)
        step = environment.step(states, actions, targets)
        if checked:
            step = _taken_back(states, mask.scatter(1, actions[:, None], False), step)
        yield Move(rows, states, targets, mask, logits, value, actions, step)
        states, mask, going = step.states, step.mask, ~step.done


def _taken_back(states: torch.Tensor, others: torch.Tensor, step: Step) -> Step:
    """Return a step without actions after which stability is not proven, where other actions are left to try."""
    back = step.unstable & others.any(dim=1)
    return Step(
        torch.where(back[:, None], states, step.states),
        step.reward.masked_fill(back, 0.0),
        step.done & ~back,
        step.success,
        step.unstable & ~back,
        torch.where(back[:, None], others, step.mask),
    )


def _ask(
    environment: Environment, policy: PolicyFunction, states: torch.Tensor, targets: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return logits and values, in smaller and smaller pieces if memory runs out."""
    while True:
        try:
            return forward_in_pieces(policy, states, targets, environment.rows_at_once)
        except torch.OutOfMemoryError:
            if min(environment.rows_at_once, len(states)) < 2:
                raise
            environment.rows_at_once = min(environment.rows_at_once, len(states)) // 2
            torch.cuda.empty_cache()


@torch.no_grad()
def forward_in_pieces(
    policy: PolicyFunction, states: torch.Tensor, targets: torch.Tensor | None = None, rows_at_once: int = 1 << 13
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return logits and values of many states without gradients; shapes as in `PolicyFunction`, `float32`."""
    pieces = [
        policy(states[rows], None if targets is None else targets[rows])
        for rows in (slice(begin, begin + rows_at_once) for begin in range(0, len(states), rows_at_once))
    ]
    logits, value = (torch.cat(column) if len(pieces) > 1 else column[0] for column in zip(*pieces, strict=True))
    return logits.detach().float(), value.detach().float()


def roll_out(
    environment: Environment,
    policy: PolicyFunction,
    starts: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    greedy: bool = True,
    temperature: float = 1.0,
    generator: torch.Generator | None = None,
    keep: Literal["all", "ends"] = "all",
    checked: bool = False,
) -> Rollouts:
    """Follow a policy from stable start states until every rollout has ended.

    Finished rollouts drop out of the batch that is evaluated.

    Args:
        environment: rules and verdicts.
        policy: called as `policy(states, targets)`; returns logits `(batch, 2 parts)` and values `(batch,)`.
        starts: stable, `uint8` on the device, shape (batch, parts).
        targets: shape (batch, parts), or None.
        greedy: take the most probable action; otherwise draw one.
        temperature: divisor of the logits before sampling.
        generator: source of randomness for drawing; same state of it, same rollouts.
        keep: `all` states and actions, or only the `ends`, which takes little memory.
        checked: take back an action after which stability is not proven, and the next action is another one; states
            then repeat, and such a rollout fails only where no action is left.

    Raises:
        InputError: a temperature that is not above zero.
    """
    count, parts, device = len(starts), environment.part_count, starts.device
    last = starts.clone()
    length = torch.zeros(count, dtype=torch.int64, device=device)
    success = environment.rules.reached(starts, targets)
    unstable = torch.zeros_like(success)
    states, actions = [starts], []
    moves = play(
        environment,
        policy,
        starts,
        targets,
        greedy=greedy,
        temperature=temperature,
        generator=generator,
        checked=checked,
    )
    for move in moves:
        rows = move.rows
        last = last.index_copy(0, rows, move.step.states)
        length.index_add_(0, rows, torch.ones_like(rows))
        success.index_copy_(0, rows, move.step.success)
        unstable.index_copy_(0, rows, move.step.unstable)
        if keep == "all":
            states.append(last)
            taken = torch.full((count,), -1, dtype=torch.int16, device=device)
            actions.append(taken.index_copy_(0, rows, move.actions.to(torch.int16)))
    if keep == "ends":
        states = [starts, last]
    empty = torch.empty((0, count), dtype=torch.int16, device=device)
    return Rollouts(
        torch.stack(states) if count else torch.empty((len(states), 0, parts), dtype=torch.uint8, device=device),
        torch.stack(actions) if actions else empty,
        length,
        success,
        unstable,
    )

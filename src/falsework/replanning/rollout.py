"""Rollouts of a policy for several tasks at once, in lock-step: one question to the network serves all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.replanning.policy_guide import PolicyGuide
from falsework.search.problem.task import Direction, Task

Stable = Callable[[NDArray[np.int64], States, States], Mask]
"""Stability of states: their tasks, shape (batch,), states and parents, shapes (batch, parts), to shape (batch,)."""
Stop = Callable[[int], bool]
"""Whether the rollouts of a task need not go on."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """One way that the policy went, from where it began to where it ended."""

    task: int
    """Number of the task."""
    states: States
    """Shape (steps + 1, parts)."""
    reached: bool
    """Whether the last state is the target. Without verdicts on the way, that proves nothing yet."""
    unstable: bool
    """Whether the last state was found not to stand."""


def roll_out(
    guide: PolicyGuide,
    tasks: Sequence[Task],
    starts: Sequence[States],
    owner: NDArray[np.int64],
    *,
    rng: np.random.Generator | None = None,
    temperature: float = 1.0,
    stable: Stable | None = None,
    stop: Stop | None = None,
) -> list[Rollout]:
    """Follow the policy from some states until the target, an unstable state, or a state without a legal action.

    Args:
        guide: the policy.
        tasks: rules; each may have another target, other robots and other fixed parts.
        starts: state that each rollout begins in, stable, shape (rollouts, parts).
        owner: number of the task of each rollout, ascending, shape (rollouts,).
        rng: draws actions from the probabilities; the most probable are taken if not given.
        temperature: probabilities are raised to the power of one over it; only with `rng`.
        stable: asked after every action that needs a verdict, and ends rollouts that fall; without it they go to their
            ends unasked.
        stop: asked before every step for every task that still runs.

    Returns:
        One rollout for each start, in their order.
    """
    states = np.array(starts, dtype=np.uint8)
    targets = np.stack([task.target for task in tasks])
    history = [states.copy()]
    length = np.zeros(len(states), dtype=np.int64)
    unstable = np.zeros(len(states), dtype=bool)
    running = (states != targets[owner]).any(axis=1)
    while running.any():
        for number in np.unique(owner[running]):
            if stop is not None and stop(int(number)):
                running[owner == number] = False
        rows = np.flatnonzero(running)
        if len(rows) == 0:
            break
        legal = _legal(tasks, states[rows], owner[rows])
        possible = legal.any(axis=1)
        running[rows[~possible]] = False
        rows, legal = rows[possible], legal[possible]
        score = guide.log_probabilities(states[rows], legal, targets[owner[rows]])
        if rng is not None:
            # Adding Gumbel noise and taking the largest draws from the probabilities.
            score = score / temperature + rng.gumbel(size=score.shape)
        actions = np.where(legal, score, -np.inf).argmax(axis=1)
        before = states[rows]
        states[rows] = tasks[0].follow(before, actions, Direction.DISASSEMBLY)
        length[rows] += 1
        if stable is not None:
            asked = np.flatnonzero(tasks[0].needs_verdict(actions, Direction.DISASSEMBLY))
            fell = asked
            if len(asked):
                fell = asked[~stable(owner[rows[asked]], states[rows[asked]], before[asked])]
            unstable[rows[fell]] = True
            running[rows[fell]] = False
        running[rows] &= (states[rows] != targets[owner[rows]]).any(axis=1)
        history.append(states.copy())
    reached = (states == targets[owner]).all(axis=1) & ~unstable
    walked = np.stack(history)
    return [
        Rollout(int(owner[row]), walked[: length[row] + 1, row].copy(), bool(reached[row]), bool(unstable[row]))
        for row in range(len(states))
    ]


def _legal(tasks: Sequence[Task], states: States, owner: NDArray[np.int64]) -> Mask:
    numbers, begins = np.unique(owner, return_index=True)
    pieces = np.split(states, begins[1:])
    masks = [tasks[n].moves(piece, Direction.DISASSEMBLY) for n, piece in zip(numbers, pieces, strict=True)]
    return np.concatenate(masks)

"""Rollouts of an action score for several tasks at once, in lock-step: each step scores all of them together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.problem.task import Direction, Task

Score = Callable[[States, Mask, States], NDArray[np.floating]]
"""Scores of the actions of states, shape (batch, parts), of which some are legal, shape (batch, 2 parts), on the way to
targets, shape (batch, parts). Returns shape (batch, 2 parts)."""
Stable = Callable[[NDArray[np.int64], States, States], Mask]
"""Stability of states: their tasks, shape (batch,), states and parents, shapes (batch, parts), to shape (batch,)."""
Stop = Callable[[int], bool]
"""Whether the rollouts of a task can stop."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """States of one rollout, from its start to where it ended."""

    task: int
    """Number of the task."""
    states: States
    """Shape (steps + 1, parts)."""
    reached: bool
    """Whether the last state is the target. Without verdicts on the path, that proves nothing yet."""
    unstable: bool
    """Whether the last state was found not to be stable."""


def follow_scores(
    tasks: Sequence[Task],
    starts: Sequence[States] | States,
    owner: NDArray[np.int64],
    score: Score,
    *,
    rng: np.random.Generator | None = None,
    stable: Stable | None = None,
    next_best: bool = False,
    stop: Stop | None = None,
) -> list[Rollout]:
    """Follow a score from some states until the target, an unstable state, or a state without an action left.

    Args:
        tasks: rules; each may have another target, other robots and other fixed parts.
        starts: state that each rollout begins in, stable, shape (rollouts, parts).
        owner: number of the task of each rollout, ascending, shape (rollouts,).
        score: scores actions, such as the logarithms of their probabilities.
        rng: draws actions from the probabilities; those with the highest score are taken if not given.
        stable: asked after every action that needs a verdict; without it rollouts continue to their ends without
            verdicts.
        next_best: after an action that leads to an unstable state take the next best one; otherwise the rollout ends.
        stop: asked before every step for every task that still runs.

    Returns:
        One rollout for each start, in their order.
    """
    states = np.array(starts, dtype=np.uint8)
    targets = np.stack([task.target for task in tasks])[owner]
    history = [states.copy()]
    length = np.zeros(len(states), dtype=np.int64)
    unstable = np.zeros(len(states), dtype=bool)
    running = (states != targets).any(axis=1)
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
        scores = score(states[rows], legal, targets[rows])
        if rng is not None:
            # Adding Gumbel noise and taking the largest draws from the probabilities.
            scores = scores + rng.gumbel(size=scores.shape)
        scores = np.where(legal, scores, -np.inf)
        before = states[rows]
        left = np.arange(len(rows))
        while len(left):
            actions = scores[left].argmax(axis=1)
            stuck = np.isneginf(scores[left, actions])
            running[rows[left[stuck]]] = False
            left, actions = left[~stuck], actions[~stuck]
            states[rows[left]] = tasks[0].follow(before[left], actions, Direction.DISASSEMBLY)
            length[rows[left]] += 1
            fell = np.zeros(len(left), dtype=bool)
            if stable is not None:
                fell = tasks[0].needs_verdict(actions, Direction.DISASSEMBLY)
                asked = left[fell]
                if len(asked):
                    fell[fell] = ~stable(owner[rows[asked]], states[rows[asked]], before[asked])
            fallen = left[fell]
            if not next_best:
                unstable[rows[fallen]] = True
                running[rows[fallen]] = False
                break
            states[rows[fallen]] = before[fallen]
            length[rows[fallen]] -= 1
            scores[fallen, actions[fell]] = -np.inf
            left = fallen
        running[rows] &= (states[rows] != targets[rows]).any(axis=1)
        history.append(states.copy())
    reached = (states == targets).all(axis=1) & ~unstable
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

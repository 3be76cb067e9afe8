"""Rollouts: follow what scores best from state to state, each step proven, until the rest of the way is known."""

from __future__ import annotations

from collections.abc import Callable, Container

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.problem.result import Route, Stop
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import Stability

ActionScore = Callable[[States, Mask], NDArray[np.floating]]
"""Scores the actions that lead out of states, as a `falsework.search.problem.guide.Guide` in disassembly."""


def roll_out(
    task: Task,
    oracle: Stability,
    score: ActionScore,
    start: States,
    known: Container[bytes],
    *,
    rng: np.random.Generator | None = None,
    rows: int = 1,
    forbidden: Container[bytes] = (),
    stop: Stop | None = None,
) -> Route | None:
    """Go on from a stable state by the best action after which the structure stands, never back.

    All rows take one step at a time together, so that a policy and the oracle are asked about all of them at once.

    Args:
        task: rules.
        oracle: decides stability.
        score: scores actions.
        start: where to begin, shape (parts,).
        known: states, as bytes, at which a rollout has arrived.
        rng: adds noise to the scores, so that rows differ; with scores that are logarithms of probabilities, actions
            are drawn with these. The best action is taken if not given.
        rows: rollouts at once.
        forbidden: states, as bytes, that no rollout goes through although they may stand.
        stop: asked before every step; true ends the rollouts.

    Returns:
        The way of the first row that arrives, or None if none does.
    """
    task = task.judged_by(oracle)
    states = np.repeat(np.asarray(start, np.uint8)[None], rows, axis=0)
    passed, taken = [states], []
    alive = np.ones(rows, dtype=bool)
    while not (stop is not None and stop()):
        for row in np.flatnonzero(alive):
            if states[row].tobytes() in known:
                actions = np.array([actions[row] for actions in taken], dtype=np.int64)
                return Route(np.stack([states[row] for states in passed]), actions)
        legal: Mask = task.moves(states, Direction.DISASSEMBLY) & alive[:, None]
        alive = np.asarray(legal.any(axis=1))
        if not alive.any():
            return None
        scores = np.full(legal.shape, -np.inf)
        scores[alive] = np.where(legal[alive], score(states[alive], legal[alive]), -np.inf)
        if rng is not None:
            scores += rng.gumbel(size=scores.shape)
        actions = np.zeros(rows, dtype=np.int64)
        after = states.copy()
        left = np.flatnonzero(alive)
        while len(left):
            actions[left] = scores[left].argmax(axis=1)
            stuck = np.isneginf(scores[left, actions[left]])
            alive[left[stuck]] = False
            left = left[~stuck]
            after[left] = task.follow(states[left], actions[left], Direction.DISASSEMBLY)
            barred = np.array([after[row].tobytes() in forbidden for row in left], dtype=bool)
            asked = ~barred & task.needs_verdict(actions[left], Direction.DISASSEMBLY)
            if asked.any():
                rows_asked = left[asked]
                barred[asked] = ~oracle.stable(after[rows_asked], parents=states[rows_asked])
            left = left[barred]  # what does not stand is not taken: the next best
            scores[left, actions[left]] = -np.inf
        after[~alive] = states[~alive]
        states = after
        passed.append(states)
        taken.append(actions)
    return None

"""States of a state graph that a policy completes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from falsework.assembly.state import States, action_mask, apply_actions
from falsework.stability.oracle import Stability

if TYPE_CHECKING:
    from falsework.replanning.policy_guide import PolicyGuide


def visited_states(
    guide: PolicyGuide, oracle: Stability, start: States, robots: int, rollouts: int = 32, seed: int = 0
) -> States:
    """Stable states on the ways that a policy takes from one state, the first way greedily, the others at random.

    Args:
        guide: asks the policy.
        oracle: ends a way where the state does not stand.
        start: where all begin, shape (parts,).
        robots: parts that can be held.
        rollouts: number of ways.
        seed: same seed, same ways.

    Returns:
        Shape (count, parts), each state once.
    """
    boundary = oracle.assembly.boundary
    rng = np.random.default_rng(seed)
    states = np.repeat(np.asarray(start, dtype=np.uint8)[None], rollouts, axis=0)
    greedy = np.zeros(rollouts, dtype=bool)
    greedy[:1] = True
    seen = [states[:1]]
    while len(states):
        legal = action_mask(states, boundary, robots)
        going = legal.any(axis=1)
        states, legal, greedy = states[going], legal[going], greedy[going]
        if len(states) == 0:
            break
        score = guide.log_probabilities(states, legal)
        # The largest of scores with Gumbel noise is a sample of the probabilities.
        noise = rng.gumbel(size=score.shape) * ~greedy[:, None]
        parents = states
        states = apply_actions(states, np.argmax(score + noise, axis=1))
        stable = oracle.judge(states, parents=parents).stable
        states, greedy = states[stable], greedy[stable]
        seen.append(np.unique(states, axis=0))
    return np.unique(np.concatenate(seen), axis=0)

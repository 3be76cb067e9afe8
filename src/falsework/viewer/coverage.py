"""States of a state graph that a policy completes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.search.problem.rollout import follow_scores
from falsework.search.problem.task import Task
from falsework.stability.oracle import StabilityOracle

if TYPE_CHECKING:
    from falsework.replanning.policy_guide import PolicyGuide


def visited_states(
    guide: PolicyGuide, oracle: StabilityOracle, start: States, robots: int, rollouts: int = 32
) -> States:
    """Return the stable states on rollouts of a policy from one state, the first greedy, the others sampled.

    Args:
        start: start of all rollouts, shape (parts,).

    Returns:
        Shape (count, parts), each state once.
    """
    task = Task.from_rules(oracle.assembly.boundary, robots, start=start).judged_by(oracle)
    starts = np.repeat(task.start[None], rollouts, axis=0)

    def stable(_: NDArray[np.int64], states: States, parents: States) -> Mask:
        return oracle.verdicts(states, near=parents).stable

    seen = [starts[:1]]
    for several, rng in ((starts[:1], None), (starts[1:], np.random.default_rng(0))):
        owner = np.zeros(len(several), dtype=np.int64)
        played = follow_scores([task], several, owner, guide.log_probabilities, rng=rng, stable=stable)
        seen += [rollout.states[: len(rollout.states) - rollout.unstable] for rollout in played]
    return np.unique(np.concatenate(seen), axis=0)

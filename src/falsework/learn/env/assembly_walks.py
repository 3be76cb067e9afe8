"""Random walks backwards from solvable states: start states beyond those that a search has found.

From a state that precedes a solvable one by a legal action, the structure can be taken apart too: that action leads
there. So a random walk in the direction of assembly, over states proven stable, ends at a solvable state, wherever it
leads. Starts of this kind are those of reverse curricula (Florensa et al. 2017, "Reverse curriculum generation for
reinforcement learning").
"""

from __future__ import annotations

import torch

from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.search.device.rules import TensorRules
from falsework.search.problem.task import Direction

_LONGEST = 24
"""Actions that a walk tries, at most."""


class AssemblyWalks:
    """Sampler of solvable states at the ends of random walks in the direction of assembly."""

    def __init__(self, environment: Environment, solved: SolvableStates) -> None:
        """Begin with the states known to be solvable.

        Args:
            environment: verdicts.
            solved: where walks begin; their ends are added, so that later walks lead farther.
        """
        self._environment, self._solved = environment, solved
        self._rules = TensorRules(environment.rules.task, environment.device, Direction.ASSEMBLY)

    def draw(self, count: int, horizon: int, generator: torch.Generator) -> torch.Tensor:
        """Draw ends of walks.

        Args:
            count: how many.
            horizon: steps to the end of the disassembly, at most.
            generator: source of randomness, on the device of the environment.

        Returns:
            Solvable states that are not held out, shape (walks, parts); `count` of them or fewer.
        """
        states = self._solved.within(horizon, count, generator)
        count, device = len(states), states.device
        if count == 0:
            return states
        length = torch.randint(1, _LONGEST + 1, (count,), generator=generator, device=device)
        left = self._environment.rules.steps_left(states)
        for step in range(_LONGEST):
            mask = self._rules.moves(states)
            going = mask.any(dim=1) & (step < length) & (left < horizon)
            rows = going.nonzero()[:, 0]
            if len(rows) == 0:
                break
            before = states[rows]
            actions = torch.multinomial(mask[rows].float(), 1, generator=generator)[:, 0]
            after = self._rules.follow(before, actions)
            # An action that leads to a state that is not stable is not taken; another is tried instead.
            stable = self._environment.stable(after, before, needed=self._rules.needs_verdict(actions))
            states[rows[stable]] = after[stable]
            left[rows[stable]] += 1
        states = states[~self._solved.is_held_out(states)]
        self._solved.add(states)
        return states

"""Extension of pairs of start and goal beyond both ends, by random moves to states that no search has found."""

from __future__ import annotations

import torch

from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.search.device.rules import TensorRules
from falsework.search.problem.task import Direction

_MOVES = 8
"""Moves tried beyond each end, at most."""


class Extension:
    """Moves in the direction of assembly from starts, and in that of disassembly from goals.

    Where a path leads from a start to a goal, one leads from all stable states before the start to all stable ones
    after the goal.
    """

    def __init__(self, environment: Environment, solved: SolvableStates) -> None:
        """Keep what is needed.

        Args:
            environment: verdicts, whose cache is shared.
            solved: says which states are held out; these are neither starts nor goals.
        """
        self._environment, self._solved = environment, solved
        self._back = TensorRules(environment.rules.task, environment.device, Direction.ASSEMBLY)

    def extended(
        self, starts: torch.Tensor, targets: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return other starts and targets that a path connects, too.

        Args:
            starts: shape (count, parts).
            targets: shape (count, parts).
            generator: source of randomness, on the device of the environment.
        """
        return (
            self._moved(starts, self._back, generator),
            self._moved(targets, self._environment.rules, generator),
        )

    def _moved(self, states: torch.Tensor, rules: TensorRules, generator: torch.Generator) -> torch.Tensor:
        """Return stable states up to some random moves away."""
        states = states.clone()
        tried = torch.randint(_MOVES + 1, (len(states),), generator=generator, device=states.device)
        for number in range(_MOVES):
            rows = (tried > number).nonzero()[:, 0]
            before = states[rows]
            mask = rules.moves(before)
            possible = mask.any(dim=1)
            rows, before, mask = rows[possible], before[possible], mask[possible]
            if len(rows) == 0:
                break
            actions = torch.multinomial(mask.float(), 1, generator=generator)[:, 0]
            after = rules.follow(before, actions)
            stable = self._environment.stable(after, before, needed=rules.needs_verdict(actions))
            good = stable & ~self._solved.is_held_out(after)
            states[rows[good]] = after[good]
        return states

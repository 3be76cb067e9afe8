"""Exploration of solvable states away from those of the searches, by single moves in the direction of assembly."""

from __future__ import annotations

import torch

from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.search.device.rules import TensorRules
from falsework.search.problem.task import Direction

_SWEEPS = 16
"""Moves that lead to a collection of rollouts, for each start that is drawn for it."""
COMPARED = 16
"""States of which the one of the highest score is left by the next move."""
_DATA = 8192
"""States of the data to which distances are measured, at most."""
_MOST = 2_000_000
"""Explored states beyond which no more are looked for."""


class Exploration:
    """Archive of solvable states, which grows from the states of the searches to states far from them.

    A stable state from which one move leads to a solvable one is solvable. A search keeps a few states a level and so
    sees one way to build the structure among many. Moves backwards therefore begin evenly at all distances from the
    end, since ways part early, and at each distance from the state among several that differs most from the data, by
    parts whose condition differs, less the number of moves from it so far. Where moves begin anywhere, they stay near
    the data: most states are far from the end, and all ways from there are alike. As in Go-Explore (Ecoffet et al.
    2021), states that were reached are stored and returned to.
    """

    def __init__(
        self, environment: Environment, solved: SolvableStates, starts: torch.Tensor, compared: int = COMPARED
    ) -> None:
        """Begin with the states of the searches.

        Args:
            environment: verdicts, whose cache is shared.
            solved: gets all states that are found, and says which are held out; these are not left by further moves.
            starts: solvable states, none of them held out, shape (count, parts).
            compared: states of which the one of the highest score is left by the next move.
        """
        self._environment, self._solved, self._compared = environment, solved, compared
        self._rules = TensorRules(environment.rules.task, environment.device, Direction.ASSEMBLY)
        some = slice(None, None, -(-len(starts) // _DATA) or 1)
        self._data = _one_hot(starts[some]).T.contiguous()
        self._states = starts
        self._left = environment.rules.steps_left(starts)
        self._far = torch.zeros(len(starts), device=starts.device)
        self._moves = torch.zeros(len(starts), device=starts.device)
        """Moves from each state that were tried."""
        self._known = len(starts)

    def __len__(self) -> int:
        return len(self._states)

    @property
    def mean_distance(self) -> float:
        """Mean distance of the states that moves have found to the data, in parts; 0 before there are any."""
        return float(self._far[self._known :].mean()) if len(self) > self._known else 0.0

    def draw(self, count: int, horizon: int, generator: torch.Generator) -> torch.Tensor:
        """Explore, and draw states from the archive, evenly by the number of steps to the end.

        Args:
            horizon: steps to the end that states may be away.
            generator: source of randomness, on the device of the environment.

        Returns:
            Shape (count, parts); no rows if no state is so close.
        """
        for _ in range(_SWEEPS):
            if len(self) >= _MOST:
                break
            self._sweep(count, horizon, generator)
        return self._states[self._choose(count, horizon, 1, generator)]

    def tensors(self) -> dict[str, torch.Tensor]:
        """Return the states that were found and the number of moves from each of the archive, to save."""
        return {"explored": self._states[self._known :], "explored_moves": self._moves}

    def load(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restore what `tensors` returned."""
        self._states, self._left, self._far = (
            column[: self._known] for column in (self._states, self._left, self._far)
        )
        self._moves = self._moves[: self._known]
        self._add(tensors["explored"].to(self._states.device))
        self._moves = tensors["explored_moves"].to(self._states.device).clone()

    def _sweep(self, count: int, horizon: int, generator: torch.Generator) -> None:
        """Leave some states by one random move each, where it leads to a stable state."""
        rows = self._choose(count, horizon - 1, self._compared, generator)
        self._moves.index_add_(0, rows, torch.ones_like(self._moves[rows]))
        before = self._states[rows]
        mask = self._rules.moves(before)
        before, mask = (column[mask.any(dim=1)] for column in (before, mask))
        if len(before) == 0:
            return
        actions = torch.multinomial(mask.float(), 1, generator=generator)[:, 0]
        after = self._rules.follow(before, actions)
        stable = self._environment.stable(after, before, needed=self._rules.needs_verdict(actions))
        after = after[stable]
        if self._environment.record is not None:
            self._environment.record(after)
        stored = len(self._solved)
        self._solved.add(after)
        self._add(self._solved.states[stored:])

    def _add(self, states: torch.Tensor) -> None:
        self._states = torch.cat([self._states, states])
        self._left = torch.cat([self._left, self._environment.rules.steps_left(states)])
        pieces = [(piece @ self._data).amax(dim=1) for piece in _one_hot(states).split(_DATA)]
        alike = torch.cat(pieces).float() if len(states) else self._far[:0]
        self._far = torch.cat([self._far, states.shape[1] - alike])
        self._moves = torch.cat([self._moves, torch.zeros_like(alike)])

    def _choose(self, count: int, most: int, compared: int, generator: torch.Generator) -> torch.Tensor:
        """Return rows of the archive: a random distance to the end for each, and the best of some states there.

        Args:
            most: steps to the end that states may be away.
            compared: states of which the best one is taken, far from the data and not often left.
            generator: source of randomness.
        """
        device = self._states.device
        order = torch.argsort(self._left, stable=True)
        there = torch.bincount(self._left)
        first = there.cumsum(0) - there
        distances = (there[: most + 1] > 0).nonzero()[:, 0]
        if len(distances) == 0:
            return order[:0]
        chosen = distances[torch.randint(len(distances), (count,), generator=generator, device=device)]
        random = torch.rand((2, count, compared), generator=generator, device=device, dtype=torch.float64)
        rows = order[first[chosen][:, None] + (random[0] * there[chosen][:, None]).long()]
        best = (self._far[rows] - self._moves[rows] + random[1]).argmax(dim=1)  # of equal ones any
        return rows.gather(1, best[:, None])[:, 0]


def _one_hot(states: torch.Tensor) -> torch.Tensor:
    """Return states such that products count the parts in the same condition, exactly; shape (count, 3 parts)."""
    kind = torch.float16 if states.device.type == "cuda" else torch.float32
    return torch.nn.functional.one_hot(states.long(), 3).flatten(1).to(kind)

"""Steps of a plan that are done, from which a new plan goes on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from falsework.assembly.state import REMOVED, States
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.search.plans.steps import no_such_step
from falsework.search.problem.result import Route
from falsework.search.problem.task import STAGE, Direction, Task
from falsework.search.together.exits import exit_path
from falsework.stability.contact.history import Presses


@dataclass(frozen=True, eq=False)
class ExecutedSteps:
    """First steps of a plan, which are done; the steps of a new plan follow with the numbers after theirs."""

    plan: Plan
    steps: int

    def __post_init__(self) -> None:
        if not 0 <= self.steps <= len(self.plan):
            raise PlanError(no_such_step(self.steps, len(self.plan)))

    @property
    def state(self) -> States:
        """State that is reached, shape (parts,)."""
        return self.plan.states[self.steps]

    @property
    def history(self) -> tuple[States, Presses]:
        """States up to the one that is reached, and the presses of the steps that led to each of them."""
        rows = slice(self.steps + 1)
        return self.plan.states[rows], self.plan.presses_before[rows]

    def placed_at(self, part: int) -> int | None:
        """Return the step that placed a part last; None if none did."""
        there = self.plan.states[: self.steps + 1, part] != REMOVED
        placing = np.flatnonzero(there[1:] & ~there[:-1])
        return int(placing[-1]) + 1 if len(placing) else None

    def rest(self, task: Task) -> Route | None:
        """Return what is left of the plan, in the order of disassembly; None if a task allows it not, or only by sets.

        Args:
            task: of what follows, whose target is the state that is reached.
        """
        states, actions = self.plan.states[self.steps :][::-1], self.plan.actions[self.steps :][::-1]
        if task.allow_regrasp or task.together is not None or not len(actions):
            return None
        if not (np.array_equal(states[0], task.start) and task.contains(states).all()):
            return None
        legal = task.moves(states[:-1], Direction.DISASSEMBLY)[np.arange(len(actions)), actions]
        one_each = task.follow(states[:-1], actions, Direction.DISASSEMBLY) == states[1:]
        return Route(states.copy(), actions.copy()) if legal.all() and one_each.all() else None

    def extended(self, rest: Route) -> Route:
        """Return the route of these steps and those that follow, in the order of disassembly.

        Args:
            rest: ends at the state that is reached.
        """
        before = self.plan.states[: self.steps][::-1], self.plan.actions[: self.steps][::-1]
        return Route(np.concatenate([rest.states, before[0]]), np.concatenate([rest.actions, before[1]]))

    def whole_task(self, rest: Task) -> Task:
        """Return the task of a plan of these steps and those that follow.

        Args:
            rest: task of what follows, whose target is the state that is reached.
        """
        states = self.history[0]
        touched = set(np.flatnonzero((states != states[0]).any(axis=0)).tolist())
        return Task.from_rules(
            self.plan.boundary,
            max(rest.robots, self.plan.robots),
            start=rest.start,
            target=self.plan.states[0],
            fixed=tuple(part for part in rest.fixed if part not in touched),
            missing=rest.missing,
            clearance=rest.clearance if self._are_clear(rest) else None,
            identity=rest.identity,
            allow_regrasp=rest.allow_regrasp or bool((STAGE[states[1:]] > STAGE[states[:-1]]).any()),
            props=rest.props,
            prop_limit=rest.prop_limit,
            together=rest.together,
        )

    def _are_clear(self, rest: Task) -> bool:
        """Return whether each part that these steps place has a way in, as a task knows ways."""
        if rest.clearance is None or self.plan.removable_only_if_clear:
            return rest.clearance is not None
        own = ~self.plan.immovable
        return all(
            exit_path(rest, state, tuple(placed.tolist())) is not None
            for before, state in pairwise(self.history[0])
            if len(placed := np.flatnonzero((before == REMOVED) & (state != REMOVED) & own))
        )

    def with_ways(self, whole: Plan) -> Plan:
        """Return a plan that begins with these steps, with the ways of several moves on which they were done."""
        ways = (self.plan.exit_paths or ((),) * len(self.plan))[: self.steps]
        return whole.with_ways((*ways, *(whole.exit_paths or ((),) * len(whole))[self.steps :]), self.plan, whole)

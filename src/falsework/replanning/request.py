"""Replanning request: current state, target, and what has changed on site."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.part_numbers import part_ids
from falsework.assembly.props import whole_state
from falsework.assembly.state import HELD, REMOVED, States, check_robots, held_count
from falsework.errors import InputError, StateError
from falsework.replanning.executed_steps import ExecutedSteps
from falsework.replanning.named_state import StateLike, named_state
from falsework.search.find import make_task
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_check import check_identity
from falsework.search.problem.task import STAGE, Direction, Task
from falsework.search.task_rules import TaskRules, exit_rules
from falsework.utils.quantity import check_deadline, check_seed, counted, is_whole

MOST_PLANS = 1000
"""Alternatives that can be asked for."""


@dataclass(frozen=True, eq=False)
class Request:
    """Request to a `Replanner`.

    A plan leads from `state` to `target`. In assembly parts are added: the target is the complete structure unless
    another is given, and the plan lists the parts to insert and to release from now on. In disassembly parts are
    removed, and the target is the empty structure unless another is given.
    """

    state: StateLike | None = None
    """Current state: 0 removed, 1 installed, 2 held, shape (parts,); or as `named_state` reads it. With `plan` it is
    the state after `step`."""
    plan: Plan | None = None
    """Plan that is being carried out; the new one has its first steps, and goes on after them."""
    step: int | None = None
    """Last of its steps that is done; 0 is the start."""
    target: StateLike | None = None
    """Target state, as the current one."""
    direction: Direction | None = None
    """Direction; by default the one that leads to the target, assembly if the state lacks the missing parts, else
    disassembly."""
    robots: int = 2
    """Parts that can be held at a time."""
    missing: Sequence[int | str] = ()
    """Numbers or names of parts not delivered yet; assembly defers them as long as possible."""
    fixed: Sequence[int | str] = ()
    """Numbers or names of parts that are neither held nor released, neither inserted nor removed."""
    alternatives: int = 1
    """Number of requested plans, as different from each other as possible."""
    seed: int = 0
    """Random seed: same seed, same machine, same answer, unless the deadline is reached."""
    deadline: float | None = None
    """Seconds after which the best proven answer so far is returned."""
    removable_only_if_clear: bool = False
    """Move a part only if it has a collision-free straight path in or out. So too where the plan that is carried out
    does, and what that allows, the next four and repeated holds, is allowed from now on; but repeated holds not where
    parts are missing, or alternatives asked for, which plans with them do not take."""
    parts_at_once: int = 1
    """Parts that a step may move at most, where they lock each other; see `TaskRules`."""
    moves: int = 1
    """Moves in which a part leaves at most, where it has no straight way out."""
    turns: bool = False
    """Whether the part that leaves may also turn, and screw."""
    waiting: bool = False
    """Whether parts may wait half way out, standing without a robot."""
    confidences: bool = False
    """Return the action probabilities of the policy in every state of the plan."""

    def current(self, assembly: Assembly) -> States:
        """Return the current state, shape (parts,).

        Raises:
            InputError: no state, a step that the plan does not have, or a plan for another structure.
        """
        built = self.done(assembly)
        if built is not None:
            return built.state
        return _state("complete" if self.state is None else self.state, assembly, "state")

    def done(self, assembly: Assembly) -> ExecutedSteps | None:
        """Return the steps that are done; None if no plan is being carried out.

        Raises:
            InputError: a step that the plan does not have, or a plan for another structure.
        """
        if self.plan is None:
            if self.step is not None:
                raise InputError(f"step {self.step} is of no plan; give the plan too, or the state")
            return None
        if self.state is not None:
            raise InputError("a plan with its step says what the state is; leave one of the two out")
        if not is_whole(self.step):
            given = "" if self.step is None else f"; {self.step!r} is no step"
            raise InputError(f"the plan has {len(self.plan)} steps; name the last one that is done, 0 for none{given}")
        check_identity(self.plan, assembly)
        return ExecutedSteps(self.plan, self.step)

    def resolved_direction(self, assembly: Assembly) -> Direction:
        """Return whether parts are added or removed.

        Raises:
            StateError: malformed states, or a target that neither leads to.
        """
        if self.direction is not None:
            return Direction(self.direction)
        state = self.current(assembly)
        if self.target is not None:
            target = _state(self.target, assembly, "target")
            own = slice(assembly.part_count - len(assembly.props))  # props come and go in either direction
            stage, wanted = STAGE[state[own]], STAGE[target[own]]
            if (stage > wanted).any() and (stage < wanted).any():
                part, other = int(np.argmax(stage > wanted)), int(np.argmax(stage < wanted))
                raise StateError(
                    f"the target is not reachable: part {assembly.names[part]} would have to be added and part "
                    f"{assembly.names[other]} taken away; plan the two one after the other, over a state between them"
                )
            return Direction.ASSEMBLY if (stage > wanted).any() else Direction.DISASSEMBLY
        missing = part_ids(self.missing, assembly.names, "missing")
        if self.plan is not None:
            return Direction.ASSEMBLY
        absent = any(0 <= part < len(state) and state[part] == REMOVED for part in missing)
        return Direction.ASSEMBLY if absent else Direction.DISASSEMBLY

    def task(self, assembly: Assembly) -> Task:
        """Check the request against a structure; plans are always searched for in the order of disassembly.

        Raises:
            InputError: it makes no sense for this structure; the message says what to do.
        """
        if not (is_whole(self.alternatives) and 1 <= self.alternatives <= MOST_PLANS):
            limits = f"at least 1 and at most {MOST_PLANS}"
            raise InputError(f"{self.alternatives} alternatives is not a number of plans; ask for {limits}")
        check_deadline(self.deadline)
        check_seed(self.seed)
        if assembly.props and (self.alternatives > 1 or self.missing):
            other = "alternatives" if self.alternatives > 1 else "missing parts"
            raise InputError(f"plans with props take no {other}; leave out one of the two")
        built, state, robots = self.done(assembly), self.current(assembly), check_robots(self.robots)
        held = int(held_count(state[None], assembly.immovable)[0])
        if held > robots:
            can = f"{counted(robots, 'robot')} can hold {robots}"
            raise StateError(f"the state has {counted(held, 'part')} held; {can}; give more, or let go of some first")
        target = None if self.target is None else _state(self.target, assembly, "target")
        missing = part_ids(self.missing, assembly.names, "missing")
        fixed = part_ids(self.fixed, assembly.names, "fixed")
        order = self.resolved_direction(assembly)
        start, end = (state, target) if order is Direction.DISASSEMBLY else (target, state)
        if order is Direction.ASSEMBLY:
            for part in missing:
                if 0 <= part < len(state) and state[part] != REMOVED and not assembly.boundary[part]:
                    step = None if built is None else built.placed_at(part)
                    since = "the state has it; take it out of one of the two"
                    if step is not None:
                        since = f"step {step} has placed it; name parts that are not placed yet"
                    raise StateError(f"part {assembly.names[part]} is said to be missing, yet {since}")
            if start is None:
                start = whole_state(assembly)
                for part in fixed:
                    if 0 <= part < len(state):
                        start[part] = state[part]
        task = make_task(
            assembly,
            self.robots,
            start=start,
            target=end,
            fixed=fixed,
            missing=missing,
            props=self._props_at_once(state, assembly) if assembly.props else 0,
            **self._rules(assembly),
        )
        _check_first_step(task, order, assembly)
        if built is not None and order is Direction.ASSEMBLY:
            built.whole_task(task)  # refused before anything is searched
        return task

    def _rules(self, assembly: Assembly) -> TaskRules:
        """Return how parts may be held, and leave: as the request says, and as the plan that is carried out does."""
        plan, once = self.plan, len(self.missing) > 0 or self.alternatives > 1
        return {
            "removable_only_if_clear": self.removable_only_if_clear
            or (plan is not None and plan.removable_only_if_clear),
            "allow_regrasp": bool(assembly.props) or (plan is not None and plan.allow_regrasp and not once),
            **exit_rules(self, *([] if plan is None else [plan])),
        }

    def _props_at_once(self, state: States, assembly: Assembly) -> int:
        """Return the number of props that the plan allows at a time, and those that stand at least."""
        standing = int((state[assembly.immovable & ~assembly.boundary] != REMOVED).sum())
        return max(standing, 0 if self.plan is None else self.plan.prop_limit)


def _state(given: StateLike, assembly: Assembly, name: str) -> States:
    return named_state(given, assembly, f"the {name}")


def _check_first_step(task: Task, order: Direction, assembly: Assembly) -> None:
    """Refuse a state in which the rules allow nothing, before anything is searched."""
    state = task.origin(order)
    if task.is_done or task.allow_regrasp or task.together is not None or task.moves(state[None], order).any():
        return
    held = np.flatnonzero((state == HELD) & ~task.boundary)
    busy = int(held_count(state[None], task.boundary)[0])
    names = ", ".join(assembly.names[part] for part in held)
    verb = "held" if busy == 1 else "all held"
    reason = (
        f"{names} {'is' if busy == 1 else 'are'} {verb} and must stay so, and one of {task.robots} robots must be free"
        if busy
        else "no part has a free way"
    )
    raise StateError(f"no action is legal in this state: {reason}; add a robot, or change the state or the target")

"""Robot plans that go on from another one: their steps count on, and their proofs begin with what was built."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.replanning.executed_steps import ExecutedSteps
from falsework.replanning.request_replayer import RequestReplayer
from falsework.robots.plans.robot_plan import RobotPlan, acts
from falsework.search.find import make_task
from falsework.search.plans.plan import Plan
from falsework.search.plans.proofs import prove_route
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings


def continued(rest: RobotPlan, begun: RobotPlan, done: int, assembly: Assembly) -> tuple[RobotPlan, int | None]:
    """Return a robot plan whose steps come after those of another one that are done, and count on from them.

    Its motions are those of `rest`; its plan has the steps that are done too. With it comes None, or where its replay
    fails the number of the state: the history of what was built is then too much for the new steps. In assembly that
    history has the presses with which the steps were done. PlanError if a state cannot be proved.
    """
    if not done:
        return rest, None
    builds = rest.direction is Direction.ASSEMBLY
    new, old = rest.plan.route, begun.plan.route
    if builds:
        count = len(old.actions) - done
        states = np.concatenate([new.states, old.states[count + 1 :]])
        actions = np.concatenate([new.actions, old.actions[count:]])
    else:
        states = np.concatenate([old.states[:done], new.states])
        actions = np.concatenate([old.actions[:done], new.actions])
    route, oracle = Route(states, actions), StabilityOracle(assembly, StabilitySettings.from_claim(rest.plan.claim))
    forces = rest.plan.proof_arrays() is not None
    known = None
    if builds and oracle.replayer is not None:
        built = ExecutedSteps(begun.plan, done).history
        known = RequestReplayer(oracle.replayer, Deadline(), built).replay_in_time(route.states[::-1][done:]).summary
    task = _task(route, rest.plan, begun.plan, assembly)
    whole = prove_route(route, assembly, task, oracle, forces=forces, replay=known)
    if whole.replay is not None and not whole.replay.stands:
        return rest, whole.replay.falls_at
    ways, told = (plan.exit_paths or ((),) * len(plan) for plan in (rest.plan, begun.plan))
    ways = (*told[:done], *ways) if builds else (*ways, *told[len(told) - done :])
    whole = whole.with_ways(ways, rest.plan, begun.plan)
    robots = (*begun.done_by, *(step.robot for step in begun.steps if acts(step)))[:done]
    before, after = (robots, ()) if builds else ((), robots[::-1])
    return replace(rest, plan=replace(whole, source=rest.plan.source), before=before, after=after), None


def _task(route: Route, rest: Plan, begun: Plan, assembly: Assembly) -> Task:
    """Return the task of a route of steps that are done and those that follow."""
    moved = set((begun.actions % len(begun.boundary)).tolist())
    return make_task(
        assembly,
        max(rest.robots, begun.robots),
        start=route.states[0],
        target=route.states[-1],
        fixed=tuple(part for part in rest.fixed if part not in moved),
        missing=rest.missing,
        removable_only_if_clear=rest.removable_only_if_clear and begun.removable_only_if_clear,
        parts_at_once=max(rest.parts_at_once, begun.parts_at_once),
    )

"""Plans with the largest margin of the weakest step."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from falsework.assembly.model import Assembly
from falsework.search.find import Planning, find_plans
from falsework.search.margins.demands import DemandingStability, Demands
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.plans.plan import Plan
from falsework.search.problem.result import Outcome, Progress, Stop
from falsework.search.problem.task import Task
from falsework.search.settings import PlannerSettings
from falsework.stability.settings import StabilitySettings

Maximised = Literal["friction", "tilt", "push"]

_TRIALS = 6
"""Searches after the first; each halves the interval between the margin reached and the bound."""
_CLOSE = 1.02
"""The search ends when the weakest step is within this factor of the bound."""
_FIRST = 2.0
"""Factor from the margin reached to the next demand where no bound is known."""


def maximise_margin(
    assembly: Assembly,
    task: Task,
    kind: Maximised,
    stability: StabilitySettings = StabilitySettings(),
    *,
    demands: Demands = Demands(),
    settings: PlannerSettings = PlannerSettings(),
    progress: Progress | None = None,
    stop: Stop | None = None,
    forces: bool = True,
) -> Planning:
    """Find the plan with the largest margin of its weakest step, by searches under requirements raised by bisection.

    The bound limits the weakest step of any plan: both ends belong to every plan, and no plan can meet a requirement
    under which an exhaustive search found none and proved every rejection. A search that merely finds nothing gives no
    bound.

    Args:
        assembly: the structure.
        task: rules between start and target.
        kind: margin to maximise.
        stability: criterion and solver.
        demands: other margins that every state must keep.
        settings: effort of each search.
        progress: called after every level of every attempt.
        stop: called before every level; true ends it with the best plan so far.
        forces: keep the proofs of the states in the plan.

    Returns:
        The best plan, with its margins of this kind and the bound in `Plan.margins`; the result of the first search if
        there is none.
    """

    def search(level: float | None) -> tuple[Planning, float]:
        asked = demands if level is None else replace(demands, **{kind: _demand(kind, level)})
        oracle = DemandingStability(assembly, stability, asked)
        found = find_plans(
            assembly, task, oracle=oracle, settings=settings, progress=progress, stop=stop, forces=forces
        )
        if not found.found:
            return found, 0.0
        plan = found.plans[0]
        margins = PlanMargins.of(oracle, plan.states, demands, also=kind)
        weakest = margins.weakest(kind)
        plan = replace(plan, margins=replace(margins, maximised=kind))
        strength = np.inf if weakest is None else _strength(assembly, kind, weakest[1])
        return replace(found, plans=(plan,)), strength

    best, reached = search(None)
    if not best.found or (stop is not None and stop()):
        return best
    ends = DemandingStability(assembly, stability).margins(np.stack([task.start, task.target]), (kind,))
    values = [getattr(margins, kind).value for margins in ends]
    bound = min((_strength(assembly, kind, value) for value in values if value is not None), default=np.inf)
    missed, seconds = bound, best.result.seconds
    for _ in range(_TRIALS):
        if missed <= reached * _CLOSE or (stop is not None and stop()):
            break
        level = _FIRST * reached if np.isinf(missed) else float(np.sqrt(max(reached, missed / 64) * missed))
        found, strength = search(level)
        seconds += found.result.seconds
        if found.result.interrupted:
            break
        if found.found and strength > reached:
            best, reached = found, strength
        else:
            missed = level
            if found.result.outcome is Outcome.PROVED_IMPOSSIBLE:
                bound = min(bound, level)
    return _bounded(best, None if np.isinf(bound) else _value(assembly, kind, bound), seconds)


def _bounded(planning: Planning, bound: float | None, seconds: float) -> Planning:
    """Return a planning whose plan records the bound, with the total time."""
    plan: Plan = planning.plans[0]
    assert plan.margins is not None
    plan = replace(plan, margins=replace(plan.margins, bound=bound))
    return replace(planning, plans=(plan,), result=replace(planning.result, seconds=seconds))


def _strength(assembly: Assembly, kind: Maximised, value: float) -> float:
    """Return a margin as a number that is larger the stronger the step: of friction, the factor of safety."""
    if kind != "friction":
        return value
    return np.inf if value == 0.0 else assembly.friction / value


def _value(assembly: Assembly, kind: Maximised, strength: float) -> float:
    return assembly.friction / strength if kind == "friction" else strength


def _demand(kind: Maximised, strength: float) -> float:
    return max(strength, 1.0) if kind == "friction" else strength

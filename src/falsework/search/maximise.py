"""Plans with the largest margin of the weakest step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from msgspec import structs

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.search.find import find_plans
from falsework.search.margins.demands import Demands, MarginOracle
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.planner import Planner
from falsework.search.planning import Planning
from falsework.search.plans.alternatives import Alternatives
from falsework.search.plans.proofs import prove_route
from falsework.search.problem.guide import SupportGuide
from falsework.search.problem.result import Outcome, Progress, SearchResult, Stop
from falsework.search.problem.task import Task
from falsework.search.settings import PlannerSettings
from falsework.stability.margins.brackets import ACCURACY
from falsework.stability.settings import StabilitySettings

Maximised = Literal["friction", "tilt", "push"]

_EFFORT = 500
"""Verdicts that the longest search counts for at least."""
_CLOSE = 5 * ACCURACY
"""The search ends when no plan was found for this share more than the weakest step keeps."""
_ASIDE = ACCURACY / 2
"""The bound itself is tried, less this share: both ends of the plan are barely stable at it. The search ends when the
weakest step is within four times this share of it, which margins cannot tell apart."""
_TWICE = 2
"""Factor from the margin reached to the next demand where no bound is known; a bound nearer than that is tried. The
search for a stronger plan ends after so many times the verdicts of the longest search that found a plan."""


def maximise_margin(
    assembly: AnyStructure,
    task: Task,
    kind: Maximised,
    *,
    stability: StabilitySettings = StabilitySettings(),
    demands: Demands = Demands(),
    settings: PlannerSettings = PlannerSettings(),
    progress: Progress | None = None,
    stop: Stop | None = None,
    forces: bool = True,
) -> Planning:
    """Find the plan with the largest margin of its weakest step, by searches under requirements raised by bisection.

    The bound limits the weakest step of any plan: both ends belong to every plan, and no plan can meet a requirement
    under which an exhaustive search found none and proved every rejection. A search that merely finds nothing gives no
    bound; it ends after about twice the verdicts of the searches that found plans.

    Args:
        assembly: the structure, or its name or path.
        stability: criterion and solver.
        demands: other margins that every state must keep.
        progress: called after every level of every attempt.
        stop: called before every level; true ends it with the best plan so far.
        forces: keep the proofs of the states in the plan.

    Returns:
        The best plan, with its margins of this kind and the bound in `Plan.margins`; the result of the first search if
        there is none. The result is interrupted if a search for a stronger plan was.
    """
    assembly, over = as_assembly(assembly), stop or (lambda: False)
    oracle = MarginOracle(assembly, stability, demands)
    first = find_plans(assembly, task, oracle=oracle, settings=settings, progress=progress, stop=stop, forces=forces)
    if not first.found:
        return first
    seconds, effort = first.result.seconds, first.result.counters.asked
    ends = bound = missed = _least(oracle, kind, np.stack([task.start, task.target]))
    reached = getattr(demands, kind) or (1.0 if kind == "friction" else 0.0)
    if np.isinf(bound):
        reached = _least(oracle, kind, first.plans[0].states)
    stronger: list[_Stronger] = []
    cut, refused = False, settings.judge and not first.accepted  # what the judge refuses with smaller margins too
    while not refused and missed > reached * (1 + _CLOSE) and bound > reached * (1 + 4 * _ASIDE):
        cut = over()
        if cut:
            break
        level = _next(reached, missed, ends)
        trial = MarginOracle(assembly, stability, structs.replace(demands, **{kind: level}))
        planner = Planner(task, trial, settings, guide=SupportGuide(assembly))
        most = _TWICE * max(effort, _EFFORT)
        found = planner.run(progress=progress, stop=lambda search=planner, most=most: search.asked > most or over())
        seconds += found.seconds
        if planner.routes:
            # Tilts are demanded in fewer directions and further out than they are measured, so plans keep more.
            known = kind != "tilt" and np.isfinite(bound)
            reached = level if known else max(reached, _least(oracle, kind, found.routes[0].states))
            stronger.append(_Stronger(level, trial, planner, found))
            effort = max(effort, found.counters.asked)
        elif found.interrupted and planner.asked <= most:
            cut = True
            break
        else:
            missed = level
            if found.outcome is Outcome.PROVED_IMPOSSIBLE:
                bound = min(bound, level)
    limit = None if np.isinf(bound) else _value(assembly, kind, bound)
    best: Planning | None = None
    strongest = -np.inf
    while stronger:
        candidate = stronger.pop()
        planning = candidate.prove(assembly, task, forces=forces)
        strength = _weakest(assembly, planning.plans[0].margins, kind)
        if strength > strongest:
            best, strongest = planning, strength
        if strength * (1 + _ASIDE) >= candidate.level:
            break
    else:
        # A state that rests only beside others of its plan has no margin of its own; then the first plan may be better.
        plan = first.plans[0]
        margins = PlanMargins.from_oracle(oracle, plan.states, demands, also=kind)
        if best is None or _weakest(assembly, margins, kind) > strongest:
            best = replace(first, plans=(replace(plan, margins=margins),))
    assert best is not None
    plan = best.plans[0]
    assert plan.margins is not None
    plan = replace(plan, margins=replace(plan.margins, demands=demands, maximised=kind, bound=limit))
    interrupted = cut or first.result.interrupted
    return replace(best, plans=(plan,), result=replace(best.result, seconds=seconds, interrupted=interrupted))


@dataclass(frozen=True)
class _Stronger:
    """Plan found under a demand, not yet proved."""

    level: float
    oracle: MarginOracle
    planner: Planner
    result: SearchResult

    def prove(self, assembly: Assembly, task: Task, *, forces: bool) -> Planning:
        """Prove the states of the plan, and measure their margins."""
        route = self.result.routes[0]
        replay = self.planner.tests.replays.get(route.states.tobytes())
        plan = prove_route(route, assembly, task, self.oracle, forces=forces, replay=replay)
        return Planning(self.result, (plan,), Alternatives.from_routes([route]))


def _next(reached: float, missed: float, ends: float) -> float:
    """Return the next demand: what both ends bear where it is near and not yet tried, else the middle of logarithms."""
    if np.isinf(missed):
        return _TWICE * reached
    if missed == ends <= _TWICE * reached:
        return ends / (1 + _ASIDE)
    return float(np.sqrt(max(reached, missed / 64) * missed))


def _least(oracle: MarginOracle, kind: Maximised, states: States) -> float:
    """Return the least strength of states; the margin is measured of those alone that do not keep the least so far."""
    least = np.inf
    while len(states):
        bound = getattr(oracle.margins(states[:1], (kind,))[0], kind)
        if bound is not None and bound.value is not None:
            least = min(least, _strength(oracle.assembly, kind, bound.value))
        states = states[1:]
        if len(states) and np.isfinite(least) and least > (kind == "friction"):
            asked = MarginOracle(oracle.assembly, oracle.settings, Demands(**{kind: least}))
            states = states[~asked.keeps(states)]
    return least


def _weakest(assembly: Assembly, margins: PlanMargins | None, kind: Maximised) -> float:
    """Return the strength of the weakest step of a plan whose margins were measured."""
    assert margins is not None
    weakest = margins.weakest(kind)
    return np.inf if weakest is None else _strength(assembly, kind, weakest[1])


def _strength(assembly: Assembly, kind: Maximised, value: float) -> float:
    """Return a margin as a number that is larger the stronger the step: of friction, the factor of safety."""
    if kind != "friction":
        return value
    return np.inf if value == 0.0 else assembly.friction / value


def _value(assembly: Assembly, kind: Maximised, strength: float) -> float:
    return assembly.friction / strength if kind == "friction" else strength

"""Plan check: the rules, and the stability of every state."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, States, action_mask, apply_actions, held_count, undo_actions, undo_mask
from falsework.errors import InputError, PlanError
from falsework.search.margins.demands import DemandingStability, Demands
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.search.problem.support_moves import SupportMoves
from falsework.search.problem.task import Direction, Task
from falsework.stability.certificate import (
    StabilityCriterion,
    chunks,
    residual_of_displacement,
    residuals_in_order,
    verify_certificates,
)
from falsework.stability.oracle import Stability
from falsework.stability.reference.clarabel import ExactSolver
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Verdict, Verdicts


@dataclass(frozen=True, eq=False)
class PlanReport:
    """Result of a plan check."""

    states: int
    """States of the plan."""
    checked: int
    """States found good, from the first on."""
    reason: str = ""
    """Error of the first bad state; empty if all are good."""
    residual: float = 0.0
    """Largest residual of a good state, a share of gravity."""
    claim: StabilityCriterion = field(default_factory=StabilityCriterion)
    """Stability criterion of the check: the caller's criterion, cone, gravity, tolerance and force bound."""
    verdict: Verdicts | None = None
    """Verdict on the first bad state, with the velocity that proves it unstable; None if it broke a rule."""
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        """Whether every step keeps the rules and every state is stable."""
        return not self.reason

    @property
    def bad_step(self) -> int | None:
        """Action that leads to the first bad state, counted from 0; -1 if the first state is bad, None if none is."""
        return None if self.good else self.checked - 1


def check_identity(plan: Plan, assembly: Assembly) -> None:
    """Raise unless the plan is for this structure.

    Raises:
        PlanError: parts, geometry, boundary, density or friction differ.
    """
    if len(plan.boundary) != assembly.part_count:
        raise PlanError(
            f"the plan is for {plan.name} with {len(plan.boundary)} parts, "
            f"but {assembly.name} has {assembly.part_count}; give the structure it was made for"
        )
    if plan.identity != assembly.identity:
        raise PlanError(
            f"the plan is for another structure: its hash {plan.identity[:12]} of {plan.name} differs from "
            f"{assembly.identity[:12]} of {assembly.name}; geometry, boundary, density or friction changed"
        )


def broken_rule(plan: Plan, assembly: Assembly | None = None) -> tuple[int, str] | None:
    """Return the first state that the rules do not allow, and why; None if all are allowed.

    Args:
        plan: plan to check.
        assembly: needed to check that removed parts have a way out; that is left out without it.
    """
    states, parts, boundary = plan.states, len(plan.boundary), plan.boundary
    held = int(held_count(states[:1], plan.immovable)[0])
    if held > plan.robots:
        return 0, f"{held} parts are held at first, with {plan.robots} robots"
    if plan.support:
        allowed = SupportMoves(_task_of(plan)).legal(states[:-1], plan.direction)
    else:
        legal = action_mask if plan.direction is Direction.DISASSEMBLY else undo_mask
        allowed = legal(states[:-1], boundary, plan.robots)
    kept = np.isin(plan.actions % parts, plan.fixed)
    for step, action in enumerate(plan.actions.tolist()):
        if not allowed[step, action]:
            return step + 1, f"step {step + 1} ({plan.describe(step)}) is against the rules: {_why(plan, step)}"
        if kept[step]:
            return step + 1, f"step {step + 1} ({plan.describe(step)}) touches a fixed part"
    if not np.array_equal(_follow(plan), states[1:]):
        return 1, "the actions do not lead through the states of the plan"
    if plan.removable_only_if_clear and assembly is not None:
        # A part is removed from the state in which it is still there.
        route = plan.route
        removals = np.flatnonzero(route.actions >= parts)
        clear = assembly.clearance.can_leave(route.states[removals])
        blocked = removals[~clear[np.arange(len(removals)), route.actions[removals] - parts]]
        if len(blocked):
            disassembly = plan.direction is Direction.DISASSEMBLY
            step = int(blocked[0]) if disassembly else len(plan) - 1 - int(blocked[-1])
            return step + 1, f"step {step + 1} ({plan.describe(step)}) finds no straight way past the other parts"
    return None


def weaker_claim(claimed: StabilityCriterion, asked: StabilityCriterion) -> str:
    """Return why the claim of a plan is weaker than required; empty if it is not.

    Args:
        claimed: criterion that the plan claims.
        asked: criterion of the caller.
    """
    if claimed.criterion != asked.criterion and asked.criterion == "contact":
        return "the plan claims equilibrium only; plan again, or check it with --criterion equilibrium"
    for name, unit in (("tolerance", ""), ("force_bound", " weights")):
        if getattr(claimed, name) > getattr(asked, name) * (1 + 1e-12):
            return f"the plan claims a {name} of {getattr(claimed, name):g}{unit}; {getattr(asked, name):g} is asked"
    if not math.isclose(claimed.gravity, asked.gravity, rel_tol=1e-9):
        return f"the plan is for a gravity of {claimed.gravity:g} m/s2; {asked.gravity:g} is asked"
    return ""


def validate_plan(
    plan: Plan,
    assembly: AnyStructure,
    settings: StabilitySettings = StabilitySettings(),
    *,
    demands: Demands | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PlanReport:
    """Check the rules and the stability of a plan by a solver, state by state up to the first bad one.

    The caller sets the stability criterion. Tolerance, gravity, force bound and criterion in the plan are claims: a
    plan that claims less than the caller requires is refused.

    Under `equilibrium` the exact solver decides. Under `contact` a displacement is computed anew, from rest and without
    a parent, and verified by the certificate checker, which shares no code with the solvers.

    Args:
        plan: plan to check.
        assembly: the structure, with the props of the plan; or its name or path, to which they are added.
        settings: stability criterion.
        demands: margins that every state must keep; those that the plan was made to keep if not given.
        progress: called with the number of states checked and of all states.

    Raises:
        PlanError: the plan is for another structure.
        InputError: something other than a plan.
    """
    if not isinstance(plan, Plan):
        raise InputError(f"validate_plan checks a Plan, not {type(plan).__name__}; results have theirs in plans")
    if not isinstance(assembly, Assembly):
        assembly = structure_of_plan(plan, structure=as_assembly(assembly))
    check_identity(plan, assembly)
    begun, count, claim = time.perf_counter(), len(plan.states), settings.claim
    weaker = weaker_claim(plan.claim, claim)
    if weaker:
        return PlanReport(count, 0, weaker, claim=claim)
    broken = broken_rule(plan, assembly)
    solver = Stability(assembly, settings) if settings.criterion == "contact" else ExactSolver(assembly, settings)
    largest, before = 0.0, None
    for row in range(count if broken is None else broken[0]):
        if isinstance(solver, ExactSolver):
            verdict = solver.check(plan.states[row : row + 1])
        else:
            verdict = solver.check_beside(plan.states[row], plan.states[max(row - 1, 0) : row + 2])
            if not verdict.stable[0] and before is not None:
                verdict = solver.check_next(plan.states[row : row + 1], plan.states[row - 1 : row], before)
        before = verdict
        if not (verdict.stable[0] and verify_certificates(assembly, plan.states[row : row + 1], verdict, claim)[0]):
            seconds = time.perf_counter() - begun
            return PlanReport(count, row, _unstable(plan, row, verdict), largest, claim, verdict, seconds)
        largest = max(largest, float(verdict.residual[0]))
        if progress is not None:
            progress(row + 1, count)
    weak = _weak(plan, assembly, settings, demands) if broken is None else None
    if weak is not None:
        reason = f"{weak[1]} {_place(plan, weak[0])}"
        return PlanReport(count, weak[0], reason, largest, claim, None, time.perf_counter() - begun)
    return _end(plan, broken, largest, claim, time.perf_counter() - begun)


def _weak(
    plan: Plan, assembly: Assembly, settings: StabilitySettings, demands: Demands | None
) -> tuple[int, str] | None:
    """Return the first state that does not keep the required or recorded margins, and the reason."""
    if demands is None and plan.margins is not None:
        demands = plan.margins.demands
    if plan.margins is None and not demands:
        return None
    oracle = DemandingStability(assembly, settings, demands or Demands())
    lost = np.flatnonzero(~oracle.keeps(plan.states)) if demands else []
    if len(lost):
        row = int(lost[0])
        return row, f"the structure does not keep {oracle.broken(plan.states[row])}"
    found = None if plan.margins is None else plan.margins.overstated(oracle, plan.states)
    return None if found is None else (found[0], f"the structure {found[1]}")


def validate_proofs(plan: Plan, assembly: Assembly, settings: StabilitySettings = StabilitySettings()) -> PlanReport:
    """Check the rules and, by the displacements or forces in the plan, the stability; needs no solver.

    Args:
        plan: plan to check.
        assembly: the structure.
        settings: stability criterion.

    Raises:
        PlanError: the plan is for another structure, carries no proofs, or not one for each part or contact point.
    """
    check_identity(plan, assembly)
    begun, claim = time.perf_counter(), settings.claim
    contact = claim.criterion == "contact"
    name, proofs = ("displacements", plan.displacement) if contact else ("contact forces", plan.forces)
    wanted = (len(plan.states), *((assembly.part_count, 6) if contact else (len(assembly.contacts.points), 3)))
    weaker = weaker_claim(plan.claim, claim)
    if weaker:
        return PlanReport(len(plan.states), 0, weaker, claim=claim)
    if proofs is None:
        raise PlanError(f"the plan carries no {name}; check it with the solver, or plan again with proofs")
    if proofs.shape != wanted:
        raise PlanError(f"the plan has {name} of shape {proofs.shape}; expected {wanted}; plan again")
    broken = broken_rule(plan, assembly)
    if contact:
        rows = chunks(np.arange(len(plan.states)), len(assembly.contacts.points))
        found = [residual_of_displacement(assembly, plan.states[some], proofs[some], claim) for some in rows]
        residual = np.concatenate(found)
    else:
        residual = residuals_in_order(assembly, plan.states, proofs, claim)
    bad = np.flatnonzero(~(residual <= claim.tolerance))
    if len(bad) and (broken is None or bad[0] < broken[0]):
        row = int(bad[0])
        reason = f"the {name} of {_place(plan, row)} leave {residual[row]:.3g} of gravity, above {claim.tolerance:g}"
        return PlanReport(len(plan.states), row, reason, claim=claim, seconds=time.perf_counter() - begun)
    return _end(plan, broken, float(residual.max(initial=0.0)), claim, time.perf_counter() - begun)


def _end(
    plan: Plan, broken: tuple[int, str] | None, residual: float, claim: StabilityCriterion, seconds: float
) -> PlanReport:
    if broken is None:
        return PlanReport(len(plan.states), len(plan.states), "", residual, claim, None, seconds)
    return PlanReport(len(plan.states), broken[0], broken[1], residual, claim, None, seconds)


def _unstable(plan: Plan, row: int, verdict: Verdicts) -> str:
    hangs = ", which depends on the tolerance" if verdict.on_tolerance[0] else ""
    return f"the structure {Verdict(verdict.verdict[0]).words} {_place(plan, row)}{hangs}"


def _place(plan: Plan, row: int) -> str:
    return f"after step {row} ({plan.describe(row - 1)})" if row else "at the beginning"


def _follow(plan: Plan) -> States:
    """Return the states that the actions of a plan lead to, each from the state before."""
    if plan.support:
        return SupportMoves(_task_of(plan)).follow(plan.states[:-1], plan.actions)
    step = apply_actions if plan.direction is Direction.DISASSEMBLY else undo_actions
    return step(plan.states[:-1], plan.actions)


def _task_of(plan: Plan) -> Task:
    """Return the task of a plan with repeated holds, without a rule on exits."""
    start, target = plan.states[[0, -1]] if plan.direction is Direction.DISASSEMBLY else plan.states[[-1, 0]]
    return Task.create(
        plan.boundary,
        plan.robots,
        start=start,
        target=target,
        fixed=plan.fixed,
        support=True,
        props=[prop.part for prop in plan.props],
        prop_limit=plan.prop_limit,
    )


def _why(plan: Plan, step: int) -> str:
    action, parts = int(plan.actions[step]), len(plan.boundary)
    part, state = action % parts, plan.states[step]
    if plan.boundary[part]:
        return "it is boundary"
    held = int(held_count(state[None], plan.immovable)[0])
    if part >= parts - len(plan.props):
        return f"{plan.prop_limit} props may stand at a time, each under a part that is there"
    if action >= parts and any(prop.part == part and state[k - len(plan.props)] for k, prop in enumerate(plan.props)):
        return "a prop stands under it"
    takes_robot = plan.support or (action < parts) is (plan.direction is Direction.DISASSEMBLY)
    if takes_robot and held >= plan.robots and state[part] != HELD:
        return f"all {plan.robots} robots are holding"
    return f"the part is {('removed', 'installed', 'held')[int(state[part])]}"

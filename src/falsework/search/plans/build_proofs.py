"""Plans whose states are proved in the order in which they are built, under `contact`, and their check."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.plans.plan_report import PlanReport, describe_unstable
from falsework.search.problem.result import Route
from falsework.search.problem.task import Task
from falsework.stability.contact.build_verifier import BuildVerifier, StepCertificate
from falsework.stability.contact.history import Presses
from falsework.stability.contact.hold_loads import CLOSE, Loads, larger_loads, largest_load, loads_in
from falsework.stability.contact.replay import Replayer
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Proof, Solver, Verdict, Verdicts
from falsework.utils.quantity import format_quantity


def prove_build(
    route: Route, assembly: Assembly, task: Task, replayer: Replayer, known: PlanReplay | None, *, forces: bool
) -> Plan:
    """Return the plan along a route, each state proved as it is reached; up to where its replay fails, if it does.

    Args:
        route: states and actions.
        assembly: the structure.
        task: task of the route.
        replayer: of the structure.
        known: replay of the route, where there was one.
        forces: keep the certificates and contact forces in the plan.

    Raises:
        PlanError: a state at rest whose certificate the verifier refuses.
    """
    claim, states = replayer.settings.claim, route.states[::-1]
    claim = replace(claim, holds=claim.holds.resolved(assembly, claim.gravity))
    if known is None or (known.stands and not known.presses):
        known = PlanReplay.from_replay(replayer.replay(states))
    presses = (*known.presses, *[()] * (len(states) - len(known.presses)))
    verifier = BuildVerifier(assembly, claim)
    verdicts = Verdicts.all_undecided(len(states), points=replayer.problem.points if forces else None)
    steps, loads = [], []
    for row, certificate in enumerate(known.steps or replayer.certificates(states, presses)):
        proof = verifier.step(states[row], certificate)
        if not proof.residual <= claim.tolerance:
            why = proof.reason or f"its forces leave {format_quantity(proof.residual, 'share')} of gravity"
            raise PlanError(f"state {row} of the build is not proven: {why}; plan again")
        verdicts.verdict[row], verdicts.residual[row] = Verdict.STABLE, proof.residual
        verdicts.proof[row], verdicts.decided_by[row] = Proof.HISTORY, Solver.CPU
        loads.append(loads_in(assembly, states[row], proof.wrenches))
        if verdicts.forces is not None:
            verdicts.forces[row] = proof.forces
            steps.append(certificate)
    make = Plan.from_route if known.stands else Plan.from_unproven_route
    plan = replace(make(route, assembly, task, verdicts, claim), replay=replace(known, steps=()), presses=presses[1:])
    if len(loads) == len(states) and known.stands:
        borne = larger_loads(tuple(loads), known.loads or _true_loads(replayer, states, presses, tuple(loads)))
        plan = replace(plan, loads=borne)
    if forces and len(steps) == len(states):
        displacement, torn = (np.array([getattr(step, name) for step in steps]) for name in ("displacement", "torn"))
        plan = replace(plan, displacement=displacement, torn=torn)
    return plan


def check_build(
    report: PlanReport,
    plan: Plan,
    assembly: Assembly,
    settings: StabilitySettings,
    carried: bool,
    progress: Callable[[int, int], None] | None,
) -> PlanReport:
    """Check under `contact` the stability of states as they are reached in assembly, up to the first bad one.

    Args:
        report: report so far.
        plan, assembly, settings: as for `validate_plan`, with the reserve and the robots of the plan.
        carried: the plan carries a certificate for each of its states.
        progress: as for `validate_plan`.
    """
    states, presses = plan.states, plan.presses_before
    largest, cases = 0.0, [settings] if settings.reserve == 1.0 else [settings, replace(settings, reserve=1.0)]
    loads: list[Loads] = []
    for number, case in enumerate(cases):
        verifier, row, wrong = BuildVerifier(assembly, case.claim), -1, ""
        under = f" with friction divided by {case.reserve:g}" if case.reserve != 1.0 else ""
        own, borne = carried and number == 0, []
        # Without limits, so that the verifier names what a robot bears beyond them.
        strong = replace(case, holds=replace(case.holds, force=np.inf, moment=np.inf))
        steps = carried_steps(plan) if own else Replayer(assembly, strong).certificates(states, presses)
        with np.errstate(over="ignore", invalid="ignore"):
            for row, certificate in enumerate(steps):
                proof = verifier.step(states[row], certificate)
                if not proof.residual <= case.tolerance:
                    why = proof.reason or f"its forces leave {format_quantity(proof.residual, 'share')} of gravity"
                    carries = "the displacements in the plan prove nothing: " * own
                    wrong = f"{_built(plan, row)} is not proven{under}: {carries}{why}"
                    break
                largest = max(largest, proof.residual)
                borne.append(loads_in(assembly, states[row], proof.wrenches))
                if progress is not None and number == 0:
                    progress(row + 1, len(states))
        if not wrong and row + 1 < len(states):
            row, wrong = row + 1, f"the structure does not come to rest{under} at {_built(plan, row + 1)}"
        if wrong:
            verdict = StabilityOracle(assembly, replace(case, reserve=1.0)).verdicts(
                states[row], require_certificate=True
            )
            if verdict.unstable[0]:
                wrong = describe_unstable(plan, row, verdict)
            return replace(report, reason=wrong, checked=row, residual=largest, verdict=verdict)
        loads.append(tuple(borne))
    count, found = len(states), loads[0] if len(loads) == 1 else larger_loads(*loads)
    denied = _denied_load(plan, found)
    if denied is not None:
        return replace(report, reason=denied[1], checked=denied[0], residual=largest)
    return replace(report, checked=count, residual=largest, certified=count * carried, loads=found)


def _denied_load(plan: Plan, found: Loads) -> tuple[int, str] | None:
    """Return the first state for which a plan says too little of what robots bear, and how.

    Args:
        plan: the plan; one that says nothing denies nothing.
        found: what robots bear in its states.
    """
    largest = dict(zip(("force", "moment"), largest_load(found), strict=True))
    for row, (said, true) in enumerate(zip(plan.loads, found, strict=True) if plan.loads else ()):
        by_part = {load.part: load for load in said}
        for load in true:
            name, known = plan.part_names[load.part], by_part.pop(load.part, None)
            if known is None:
                return row, f"the plan does not say what the robot bears that holds {name} at {_built(plan, row)}"
            for kind in ("force", "moment"):
                says, is_so = getattr(known, kind), getattr(load, kind)
                if says < is_so * (1 - CLOSE) - CLOSE**2 * largest[kind]:
                    return row, (
                        f"the plan says that the robot that holds {name} bears {format_quantity(says, kind, 4)} at "
                        f"{_built(plan, row)}; it bears {format_quantity(is_so, kind, 4)}"
                    )
        if by_part:
            name = plan.part_names[next(iter(by_part))]
            return row, f"the plan says what a robot bears for {name} at {_built(plan, row)}, but none holds it"
    return None


def _true_loads(replayer: Replayer, states: States, presses: Presses, loads: Loads) -> Loads:
    """Return what robots bear under the true friction: `loads` where these were found under it."""
    if replayer.settings.reserve == 1.0:
        return loads
    true = replayer.vary(replace(replayer.settings, reserve=1.0))
    histories = true.replay(states, presses=presses).histories
    found = true.loads(states[: len(histories)], histories)
    return (*found, *loads[len(found) :])


def carried_steps(plan: Plan) -> Iterator[StepCertificate]:
    """Yield the certificates that a plan carries."""
    assert plan.displacement is not None
    for row, presses in enumerate(plan.presses_before):
        torn = np.zeros(0, dtype=bool) if plan.torn is None else plan.torn[row]
        yield StepCertificate(plan.displacement[row], torn, presses)


def _built(plan: Plan, row: int) -> str:
    """Name a state by the step that leads to it."""
    return f"step {row} ({plan.words(row)})" if row else "the beginning"

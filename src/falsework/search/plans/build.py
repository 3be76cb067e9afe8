"""Plans whose states are proved in the order in which they are built, under `contact`, and their check."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.plans.plan_report import PlanReport, unstable_in_words
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task
from falsework.stability.contact.build_verifier import BuildVerifier, StepCertificate
from falsework.stability.contact.replay import Replayer
from falsework.stability.oracle import Stability
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Proof, Solver, Verdict, Verdicts


def plan_of_build(
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
        known = PlanReplay.of(replayer.replay(states))
    presses = (*known.presses, *[()] * (len(states) - len(known.presses)))
    verifier = BuildVerifier(assembly, claim)
    verdicts = Verdicts.blank(len(states), points=replayer.problem.points if forces else None)
    steps = []
    for row, certificate in enumerate(replayer.certificates(states, presses)):
        proof = verifier.step(states[row], certificate)
        if not proof.residual <= claim.tolerance:
            why = proof.reason or f"its forces leave {proof.residual:.3g} of gravity"
            raise PlanError(f"state {row} of the build is not proven: {why}; plan again")
        verdicts.verdict[row], verdicts.residual[row] = Verdict.STABLE, proof.residual
        verdicts.proof[row], verdicts.decided_by[row] = Proof.HISTORY, Solver.CPU
        if verdicts.forces is not None:
            verdicts.forces[row] = proof.forces
            steps.append(certificate)
    backwards = verdicts[np.arange(len(states))[::-1]]
    if known.stands:
        plan = Plan.of(route, assembly, task, backwards, claim)
    else:
        plan = Plan.unproven(route, assembly, task, backwards, claim)
    plan = replace(plan, replay=known, presses=presses[:0:-1])
    if forces and len(steps) == len(states):
        displacement = np.array([step.displacement for step in steps])[::-1].copy()
        torn = np.array([step.torn for step in steps])[::-1].copy()
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
    states, presses = plan.assembly_states, plan.assembly_presses
    largest, cases = 0.0, [settings] if settings.reserve == 1.0 else [settings, replace(settings, reserve=1.0)]
    for number, case in enumerate(cases):
        verifier, row, wrong = BuildVerifier(assembly, case.claim), -1, ""
        under = f" with friction divided by {case.reserve:g}" if case.reserve != 1.0 else ""
        own = carried and number == 0
        steps = carried_steps(plan) if own else Replayer(assembly, case).certificates(states, presses)
        with np.errstate(over="ignore", invalid="ignore"):
            for row, certificate in enumerate(steps):
                proof = verifier.step(states[row], certificate)
                if not proof.residual <= case.tolerance:
                    why = proof.reason or f"its forces leave {proof.residual:.3g} of gravity"
                    carries = "the displacements in the plan prove nothing: " * own
                    wrong = f"{_built(plan, row)} is not proven{under}: {carries}{why}"
                    break
                largest = max(largest, proof.residual)
                if progress is not None and number == 0:
                    progress(row + 1, len(states))
        if not wrong and row + 1 < len(states):
            row, wrong = row + 1, f"the structure does not come to rest{under} at {_built(plan, row + 1)}"
        if wrong:
            bad = row_of_build(plan, row)
            verdict = Stability(assembly, replace(case, reserve=1.0)).verdicts(
                plan.states[bad], require_certificate=True
            )
            if verdict.unstable[0]:
                wrong = unstable_in_words(plan, bad, verdict)
            return replace(report, reason=wrong, checked=bad, residual=largest, verdict=verdict)
    count = len(states)
    return replace(report, checked=count, residual=largest, certified=count * carried)


def carried_steps(plan: Plan) -> Iterator[StepCertificate]:
    """Yield the certificates that a plan carries, in the order of assembly."""
    forward = plan if plan.direction is Direction.ASSEMBLY else plan.reverse()
    assert forward.displacement is not None
    for row, presses in enumerate(forward.assembly_presses):
        torn = np.zeros(0, dtype=bool) if forward.torn is None else forward.torn[row]
        yield StepCertificate(forward.displacement[row], torn, presses)


def row_of_build(plan: Plan, row: int) -> int:
    """Return the row in the plan of a state counted in the order of assembly."""
    return row if plan.direction is Direction.ASSEMBLY else len(plan.states) - 1 - row


def _built(plan: Plan, row: int) -> str:
    """Name a state by the assembly step that leads to it."""
    forward = plan if plan.direction is Direction.ASSEMBLY else plan.reverse()
    return f"assembly step {row} ({forward.describe(row - 1)})" if row else "the beginning of assembly"

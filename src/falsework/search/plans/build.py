"""Plans whose states are proved in the order in which they are built, under the criterion `contact`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.problem.result import Route
from falsework.search.problem.task import Task
from falsework.stability.contact.replay import Replayer
from falsework.stability.history import BuildVerifier
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

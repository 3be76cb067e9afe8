"""Proofs of the states of a route, each accepted by the certificate checker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.props import keep_props
from falsework.assembly.state import REMOVED, States
from falsework.errors import PlanError
from falsework.search.margins.demands import MarginOracle
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.plans.plan import Plan
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.result import Route
from falsework.search.problem.task import Task
from falsework.stability.certificate import chunks
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.history import Presses, of_all
from falsework.stability.contact.hold_loads import Loads, larger_loads, loads_in
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.varied_replay import TRUE_FRICTION
from falsework.stability.cpu.solver import TASK
from falsework.stability.oracle import StabilityOracle
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Proof, Solver, Verdict, Verdicts
from falsework.utils.quantity import format_quantity


def prove(states: States, oracle: StabilityOracle, *, forces: bool) -> tuple[Verdicts, StateArrays | None]:
    """Prove the states of a route: from what the search found them stable by, else from states before and after.

    Args:
        states: shape (states, parts).
        oracle: proves them, under a criterion without history.
        forces: keep the proofs.

    Returns:
        Verdicts, and the forces that prove them.
    """
    verdicts = Verdicts.all_undecided(len(states))
    kept = StateArrays(len(states), oracle.problem.points, 3) if forces else None
    for beside in (-1, 1):
        for rows in chunks(np.flatnonzero(~verdicts.stable), oracle.problem.points, TASK):
            near = states[np.clip(rows + beside, 0, len(states) - 1)]
            found = oracle.verdicts(states[rows], near=near, require_certificate=True)
            verdicts.put(rows, found)
            if kept is not None and found.forces is not None:
                kept[rows[found.stable]] = found.forces[found.stable]
    return verdicts, kept


def prove_build(
    route: Route, assembly: Assembly, task: Task, replayer: Replayer, known: PlanReplay | None, *, forces: bool
) -> Plan:
    """Return the plan along a route, each state proved as built; up to where its replay fails, if it does.

    Args:
        known: replay of the route, where there was one.
        forces: keep the certificates and contact forces in the plan.

    Raises:
        PlanError: a state at rest whose certificate the verifier refuses.
    """
    claim, states = replayer.settings.claim, route.states[::-1]
    claim = replace(claim, holds=claim.holds.resolved(assembly, claim.gravity))
    if known is None or (known.stands and not known.presses):
        known = PlanReplay.from_replay(replayer.replay(states))
    presses = of_all(known.presses, len(states))
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
    plan = Plan.from_route(route, assembly, task, verdicts, claim, proven=known.stands)
    plan = replace(plan, replay=replace(known, steps=()), presses=presses[1:])
    if len(loads) == len(states) and known.stands:
        borne = larger_loads(tuple(loads), known.loads or _true_loads(replayer, states, presses, tuple(loads)))
        plan = replace(plan, loads=borne)
    if forces and len(steps) == len(states):
        displacement, torn = (np.array([getattr(step, name) for step in steps]) for name in ("displacement", "torn"))
        plan = replace(plan, displacement=displacement, torn=torn)
    return plan


def _true_loads(replayer: Replayer, states: States, presses: Presses, loads: Loads) -> Loads:
    """Return what robots bear under the true friction: `loads` where these were found under it."""
    if replayer.settings.reserve == 1.0:
        return loads
    true = replayer.vary(TRUE_FRICTION)
    histories = true.replay(states, presses=presses).histories
    found = true.loads(states[: len(histories)], histories)
    return (*found, *loads[len(found) :])


def prove_route(
    route: Route,
    assembly: Assembly,
    task: Task,
    oracle: StabilityOracle,
    *,
    forces: bool = True,
    replay: PlanReplay | None = None,
    all_props: bool = False,
) -> Plan:
    """Plan along a route, each state proved stable anew with a proof that the certificate checker accepts.

    Under the criterion `contact` states are proved in the order in which they are built; the result of that replay is
    in `Plan.replay`.

    Args:
        forces: keep the forces in the plan, under `contact` the displacements too.
        replay: of the route by the oracle's replayer, where it is known already.
        all_props: keep the places for props that the route does not use.

    Raises:
        PlanError: a state that cannot be proved stable.
    """
    task = task.judged_by(oracle)
    if assembly.props and not all_props:
        bare = assembly.part_count - len(assembly.props)
        used = np.flatnonzero((route.states[:, bare:] != REMOVED).any(axis=0))
        if len(used) < len(assembly.props):
            states = np.ascontiguousarray(route.states[:, np.concatenate([np.arange(bare), bare + used])])
            assembly = keep_props(assembly, used.tolist())
            route, replay = Route.from_states(states), replay and replace(replay, steps=())
            if isinstance(oracle, MarginOracle):
                oracle = MarginOracle(assembly, oracle.settings, oracle.demands)
            else:
                oracle = StabilityOracle(assembly, oracle.settings)
    if oracle.replayer is None:
        verdicts, arrays = prove(route.states, oracle, forces=forces)
        plan = Plan.from_route(route, assembly, task, verdicts[::-1], oracle.settings.claim)
        plan = replace(plan, forces=arrays and arrays[::-1])
    else:
        plan = prove_build(route, assembly, task, oracle.replayer, replay, forces=forces)
    if isinstance(oracle, MarginOracle):
        plan = replace(plan, margins=PlanMargins.from_oracle(oracle, plan.states, oracle.demands))
    return plan

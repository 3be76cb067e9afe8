"""Proofs of the states of a route within the time that is left."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.props import whole_state
from falsework.assembly.state import HELD
from falsework.replanning.request_replayer import Replayed, RequestReplayer
from falsework.search.plans.plan import Plan
from falsework.search.plans.proofs import prove_route
from falsework.search.problem.result import Route
from falsework.search.problem.task import Task
from falsework.stability.contact.history import of_all
from falsework.stability.oracle import StabilityOracle
from falsework.stability.verdict import Proof, Solver, Verdict, Verdicts

_PRACTICE = 8
"""States from which the time of a proof is measured at first."""


class Prover:
    """Converter of routes into plans whose every state is proven."""

    def __init__(self, assembly: Assembly, oracle: StabilityOracle) -> None:
        """Prove with `oracle`, which must be one of `assembly`."""
        self.assembly = assembly
        self.oracle = oracle
        self._per_state = 1e-3

    def seconds_for(self, states: int) -> float:
        """Estimate the time to prove a number of states from the proofs so far, s."""
        return states * self._per_state

    def warm_up(self) -> None:
        """Measure how long a proof takes, on the complete structure with one part held in turn."""
        movable = np.flatnonzero(~self.assembly.immovable)[:_PRACTICE]
        states = np.repeat(whole_state(self.assembly)[None], len(movable), axis=0)
        states[np.arange(len(movable)), movable] = HELD
        begun = time.perf_counter()
        self.oracle.verdicts(states, require_certificate=True)
        self._per_state = (time.perf_counter() - begun) / max(len(movable), 1)

    def plan(
        self,
        route: Route,
        task: Task,
        replayer: RequestReplayer | None = None,
        *,
        built: int = 0,
        forces: bool = False,
        seconds: float = np.inf,
    ) -> Plan:
        """Return a plan for disassembly along a route.

        Args:
            replayer: has replayed the route as far as time allowed; None without contact history.
            built: steps of the route, in assembly order, that `replayer` takes as built.
            forces: keep the certificates in the plan.
            seconds: time that is left. Where it is too short to replay all states or to verify them, the plan rests on
                the replay as far as it came, and after that on verdicts from rest.
        """
        replayed = None if replayer is None else replayer.replay_in_time(route.states[::-1][built:])
        whole = replayed is None or replayed.stands is True
        if forces or (whole and self.seconds_for(len(route.states)) <= seconds):
            known, begun = None if replayed is None or not whole else replayed.summary, time.perf_counter()
            # A plan that goes on keeps the numbers of its parts.
            plan = prove_route(route, self.assembly, task, self.oracle, forces=forces, replay=known, all_props=True)
            taken = (time.perf_counter() - begun) / len(route.states)
            self._per_state = max(taken, 0.8 * self._per_state + 0.2 * taken)
            return plan
        return self._as_found(route, task, replayed)

    def _as_found(self, route: Route, task: Task, replayed: Replayed | None) -> Plan:
        """Return a plan that rests on its replay as far as that came, and else on verdicts from rest."""
        claim, states = self.oracle.settings.claim, route.states[::-1]
        if replayed is None:
            return Plan.from_route(route, self.assembly, task, self.oracle.verdicts(states), claim)
        claim = replace(claim, holds=claim.holds.resolved(self.assembly, claim.gravity))
        done, verdicts = len(replayed.residuals), Verdicts.all_undecided(len(states))
        if done < len(states):
            verdicts.put(np.arange(done, len(states)), self.oracle.verdicts(states[done:]))
        verdicts.verdict[:done], verdicts.proof[:done] = Verdict.STABLE, Proof.HISTORY
        verdicts.residual[:done], verdicts.decided_by[:done] = replayed.residuals, Solver.CPU
        known = None if replayed.stands is None else replayed.summary
        presses = of_all(replayed.presses, len(states))[1:]
        return replace(Plan.from_route(route, self.assembly, task, verdicts, claim), presses=presses, replay=known)

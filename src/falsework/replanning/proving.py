"""Certificates for the states of a route; each state is proven once in the life of a replanner."""

from __future__ import annotations

import time
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, Mask, States, complete_state
from falsework.search.find import plan_of
from falsework.search.plans.plan import Plan
from falsework.search.problem.result import Route
from falsework.search.problem.task import Task
from falsework.stability.oracle import Stability
from falsework.stability.verdict import Solver, Verdict, Verdicts, proof_of

_REMEMBERED = 200_000
"""Number of states whose proofs are cached; less than a hundred megabytes."""
_PRACTICE = 8
"""States from which the time of a proof is measured, at least: fewer would not use all cores."""
_PIECE = 64
"""States proved at once: their contact forces are in memory together."""


class Prover:
    """Converter of routes into plans whose every state has a certificate that the checker accepts."""

    def __init__(self, assembly: Assembly, oracle: Stability) -> None:
        """Prove with `oracle`, which must be one of `assembly`."""
        self.assembly = assembly
        self.oracle = oracle
        self._residual: OrderedDict[bytes, float] = OrderedDict()
        self._per_state = 1e-3

    def states_to_prove(self, steps: int) -> int:
        """Return states of a plan of so many steps that need a proof of their own."""
        return steps // 2 + 2 if self.oracle.holds_keep_stable else steps + 1

    def seconds_for(self, states: int) -> float:
        """Estimate the time to prove a number of states from the proofs so far, s."""
        return states * self._per_state

    def warm_up(self) -> None:
        """Measure how long a proof takes, on the complete structure with one part held in turn."""
        boundary = self.assembly.boundary
        movable = np.flatnonzero(~boundary)[:_PRACTICE]
        states = np.repeat(complete_state(boundary)[None], len(movable), axis=0)
        states[np.arange(len(movable)), movable] = HELD
        begun = time.perf_counter()
        self.oracle.check(states)
        self._per_state = (time.perf_counter() - begun) / max(len(movable), 1)

    def plan(self, route: Route, task: Task, *, forces: bool = False, seconds: float = np.inf) -> Plan:
        """Return a plan for disassembly along a route.

        Args:
            route: states and actions.
            task: task of the route.
            forces: keep the contact forces that prove the states in the plan.
            seconds: time that is left. Where it is too short to solve the states again for the checker, the plan rests
                on the proofs that the solver itself found and checked during the search.

        Raises:
            PlanError: a state that cannot be proved stable.
        """
        if forces:
            return plan_of(route, self.assembly, task, self.oracle)
        if self.seconds_for(self._unproven(route)) > seconds:
            verdicts = self.oracle.judge(route.states)
        else:
            verdicts = self.prove(route.states, route.actions)
        return Plan.of(route, self.assembly, task, verdicts, self.oracle.settings.claim)

    def _unproven(self, route: Route) -> int:
        """Return states of a route that need a proof and have none yet."""
        needed = self._needed(route.actions, route.states.shape[1])
        return sum(state.tobytes() not in self._residual for state in route.states[needed])

    def _needed(self, actions: NDArray[np.int64], parts: int) -> Mask:
        """Return whether each state of a route needs its own proof, shape (steps + 1,)."""
        return np.concatenate([[True], (actions >= parts) | (not self.oracle.holds_keep_stable)])

    def prove(self, states: States, actions: NDArray[np.int64]) -> Verdicts:
        """Prove consecutive states; the verdicts have no certificates.

        Forces that balance a state balance it too once a part is held: under `equilibrium` a hold takes over the proof
        of the state before, whose residual bounds its own. Under `contact` every state has a displacement of its own.

        Args:
            states: in disassembly order, shape (steps + 1, parts).
            actions: between them, shape (steps,).
        """
        verdicts = Verdicts.blank(len(states))
        keys = [state.tobytes() for state in states]
        needed = self._needed(actions, states.shape[1])
        for row in np.flatnonzero(needed):
            if keys[row] in self._residual:
                self._residual.move_to_end(keys[row])
        rows = np.array([row for row in np.flatnonzero(needed) if keys[row] not in self._residual], dtype=np.int64)
        for begin in range(0, len(rows), _PIECE):
            piece = rows[begin : begin + _PIECE]
            begun = time.perf_counter()
            found = self.oracle.check(states[piece]).without_certificates()
            if len(piece) >= _PRACTICE:
                taken = (time.perf_counter() - begun) / len(piece)
                self._per_state = max(taken, 0.8 * self._per_state + 0.2 * taken)
            verdicts.put(piece, found)
            for row in piece[found.stable]:
                self._residual[keys[row]] = float(verdicts.residual[row])
        last = np.maximum.accumulate(np.where(needed, np.arange(len(states)), 0))
        for row in range(len(states)):
            residual = self._residual.get(keys[last[row]])
            if residual is not None:
                verdicts.verdict[row] = Verdict.STABLE
                verdicts.residual[row] = residual
                verdicts.decided_by[row] = Solver.RULE if verdicts.decided_by[row] == 0 else verdicts.decided_by[row]
        verdicts.proof[:] = proof_of(verdicts.verdict, self.oracle.settings.criterion)
        while len(self._residual) > _REMEMBERED:
            self._residual.popitem(last=False)
        return verdicts

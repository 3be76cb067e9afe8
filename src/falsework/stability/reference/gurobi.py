"""Exact solver with Gurobi instead of Clarabel (extra `gurobi`)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.errors import DependencyError, InputError
from falsework.stability.problem import Problem
from falsework.stability.reference.clarabel import ExactSolver
from falsework.stability.reference.conic_program import Program, least_acceleration
from falsework.stability.settings import EQUILIBRIUM, StabilitySettings
from falsework.stability.verdict import Solver

Array = NDArray[np.float64]

_TOLERANCE = 1e-9  # the smallest that Gurobi takes


class GurobiSolver(ExactSolver):
    """Exact solver with Gurobi, one state at a time.

    It minimises the residual directly, which settles every state; with the octagon that is
    a linear program, for which the licence that comes with `pip install gurobipy` allows up to 2,000 rows.
    """

    _programs = (least_acceleration,)
    _name = Solver.GUROBI

    def __init__(
        self,
        assembly: Assembly,
        settings: StabilitySettings = EQUILIBRIUM,
        problem: Problem | None = None,
    ) -> None:
        """Start Gurobi.

        Raises:
            DependencyError: gurobipy is not installed.
            InputError: there is no valid licence.
        """
        super().__init__(assembly, settings, problem)
        try:
            self._gurobi: Any = import_module("gurobipy")
        except ImportError:
            raise DependencyError("Gurobi is not installed; run: pip install falsework[gurobi]") from None
        try:
            self._environment = self._gurobi.Env(params={"OutputFlag": 0})
        except self._gurobi.GurobiError as error:
            raise InputError(f"Gurobi does not start: {error}; check its licence or use the solver exact") from None

    def _solve(self, program: Program) -> tuple[Array, Array, int]:
        gurobi = self._gurobi
        with gurobi.Model(env=self._environment) as model:
            model.setParam("FeasibilityTol", _TOLERANCE)
            model.setParam("OptimalityTol", _TOLERANCE)
            model.setParam("BarConvTol", _TOLERANCE)
            model.setParam("BarQCPConvTol", _TOLERANCE)
            model.setParam("QCPDual", 1)
            x = model.addMVar(len(program.cost), lb=-gurobi.GRB.INFINITY)
            model.setObjective(0.5 * (x * program.curvature) @ x + program.cost @ x)
            first, last = program.equalities, program.equalities + program.inequalities
            rows, bound = program.rows.tocsr(), program.bound
            linear = [
                model.addConstr(rows[:first] @ x == bound[:first]),
                model.addConstr(rows[first:last] @ x <= bound[first:last]),
            ]
            if program.cones:
                # Cones have variables of their own: only then does Gurobi recognise their quadratic rows as cones.
                slack = model.addMVar((program.cones, 3), lb=-gurobi.GRB.INFINITY)
                slack[:, 0].setAttr("LB", 0.0)
                linear.append(model.addConstr(slack.reshape(-1) == bound[last:] - rows[last:] @ x))
                for cone in slack.tolist():
                    model.addConstr(cone[1] * cone[1] + cone[2] * cone[2] <= cone[0] * cone[0])
            try:
                model.optimize()
                return x.X, -np.concatenate([row.Pi for row in linear]), int(model.IterCount + model.BarIterCount)
            except gurobi.GurobiError as error:
                if error.errno == gurobi.GRB.Error.SIZE_LIMIT_EXCEEDED:
                    raise InputError(
                        f"Gurobi's licence is too small for {len(bound)} rows and {len(program.cost)} variables; "
                        "install a full licence or use the solver exact"
                    ) from None
                # Without a solution nothing is proven: zeros leave the state undecided.
                return np.zeros(len(program.cost)), np.zeros(len(bound)), 0

"""Gurobi in place of Clarabel: same programs, same verdicts, and clear messages where it is unavailable."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from falsework import StabilityOracle, StabilitySettings, verify_certificates
from falsework.assembly import complete_state, library
from falsework.errors import DependencyError, InputError
from falsework.stability import ExactSolver
from falsework.stability.reference.gurobi import GurobiSolver
from falsework.stability.verdict import Solver


@pytest.fixture
def gurobi() -> None:
    """Skips where Gurobi is not installed or has no licence at all."""
    gurobipy = pytest.importorskip("gurobipy", reason="gurobipy is not installed")
    try:
        gurobipy.Env(params={"OutputFlag": 0}).close()
    except gurobipy.GurobiError as error:
        pytest.skip(f"Gurobi does not start: {error}")


@pytest.mark.usefixtures("gurobi")
@pytest.mark.parametrize(
    ("structure", "cone"), [("arch:blocks=5", "octagon"), ("stack:blocks=5", "quadratic"), ("stack", "octagon")]
)
def test_it_agrees_with_clarabel(scenes: Any, structure: str, cone: str) -> None:
    assembly = library.build(structure)
    settings = StabilitySettings(criterion="equilibrium", cone=cone, solver="gurobi")  # type: ignore[arg-type]
    states = np.unique(scenes.few_changes(assembly, 12, seed=31), axis=0)
    stability = StabilityOracle(assembly, settings)
    verdicts = stability.verdicts(states, require_certificate=True)
    np.testing.assert_array_equal(verdicts.verdict, ExactSolver(assembly, settings).check(states).verdict)
    assert verify_certificates(assembly, states, verdicts, settings.claim).all()
    assert (verdicts.decided_by == Solver.GUROBI).all()
    assert stability.counters.exact == len(states)


@pytest.mark.usefixtures("gurobi")
@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
def test_a_licence_that_is_too_small_is_named(cone: str) -> None:
    """The licence that comes with the package stops at 2,000 rows; a full one solves this structure."""
    vault = library.build("vault")
    solver = GurobiSolver(vault, StabilitySettings(criterion="equilibrium", cone=cone))  # type: ignore[arg-type]
    message = ""
    try:
        assert solver.check(complete_state(vault.boundary)).stable[0]
    except InputError as error:
        message = str(error)
    if message:
        assert "licence is too small" in message
        assert "the solver exact" in message
        assert "\n" not in message


def test_a_missing_package_is_named(scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gurobipy", None)
    with pytest.raises(DependencyError, match=r"pip install falsework\[gurobi\]"):
        StabilityOracle(scenes.tower(1), StabilitySettings(criterion="equilibrium", solver="gurobi"))

"""Verdicts near the tolerance: structures just beyond their limit are not stable, and verdicts say how close it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, find_plans, verify_certificates
from falsework.assembly import complete_state, library
from falsework.errors import InputError
from falsework.search.plans.plan_check import validate_plan
from falsework.stability import Verdicts
from falsework.stability.certificate import residual_of_forces
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.verdict import Solver

CRITERIA = ("equilibrium", "contact")
SETTINGS = StabilitySettings()


def arch(thickness: float) -> Assembly:
    return library.build(f"arch:blocks=40,thickness={thickness},radius=1")


def checked(assembly: Assembly, criterion: Any, **settings: Any) -> Verdicts:
    """Verdict of the complete structure, whose certificate the checker accepts."""
    chosen = StabilitySettings(criterion=criterion, **settings)
    states = complete_state(assembly.boundary)[None]
    verdicts = StabilityOracle(assembly, chosen).verdicts(states, require_certificate=True)
    assert verify_certificates(assembly, states, verdicts, chosen.claim).all()
    return verdicts


def critical_thickness(simplex: Any) -> float:
    """Thickness at which the least residual of the arch vanishes, by the simplex method: it falls linearly."""
    thin, thinner = 0.1073, 0.1072
    rest = [simplex(arch(t), complete_state(arch(t).boundary)) for t in (thin, thinner)]
    return thin + rest[0] * (thin - thinner) / (rest[1] - rest[0])


@pytest.mark.parametrize("criterion", CRITERIA)
def test_an_arch_just_thinner_than_its_limit_is_not_stable(simplex: Any, criterion: str) -> None:
    """Its forces leave less than the tolerance, so that it would be stable by that alone."""
    critical = critical_thickness(simplex)
    thin = checked(arch(critical - 1e-5), criterion)
    least = simplex(arch(critical - 1e-5), complete_state(arch(0.1).boundary))
    assert SETTINGS.resolution < least < SETTINGS.tolerance
    assert thin.unstable[0]
    assert thin.on_tolerance[0]
    np.testing.assert_allclose(thin.residual, least, rtol=1e-2)
    thinner = checked(arch(critical - 1e-4), criterion)
    assert thinner.unstable[0]
    assert not thinner.on_tolerance[0]
    thick = checked(arch(critical + 1e-5), criterion)
    assert thick.stable[0]
    assert not thick.on_tolerance[0]
    assert thick.residual[0] <= SETTINGS.resolution


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("past", [1e-6, 1e-5, 5e-5])
def test_a_block_just_steeper_than_friction_allows_slips(scenes: Any, criterion: str, past: float) -> None:
    """It accelerates by `sin(a) - mu cos(a)`, below the tolerance."""
    angle = np.arctan(0.5) + past
    verdicts = checked(scenes.slope(angle, friction=0.5), criterion, cone="quadratic")
    assert verdicts.unstable[0]
    assert verdicts.on_tolerance[0]
    flatter = checked(scenes.slope(np.arctan(0.5) - past, friction=0.5), criterion, cone="quadratic")
    assert flatter.stable[0]
    assert not flatter.on_tolerance[0]


def test_searches_do_not_take_what_is_close_for_stable(simplex: Any) -> None:
    """Of what has a residual above a tenth of the tolerance, the interior point method proves that it is not stable."""
    assembly = arch(critical_thickness(simplex) - 2e-5)
    for criterion in CRITERIA:
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))  # type: ignore[arg-type]
        verdicts = oracle.verdicts(complete_state(assembly.boundary))
        assert verdicts.unstable[0]
        assert verdicts.on_tolerance[0]
        assert oracle.counters.cpu == 1
        assert oracle.verdicts(complete_state(assembly.boundary)).on_tolerance[0]  # from the cache
    assert not find_plans(assembly, robots=2).plans


@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_gpu_is_no_exception(on_host: Any, simplex: Any, monkeypatch: pytest.MonkeyPatch, criterion: Any) -> None:
    def driven(assembly: Assembly, problem: Any, settings: StabilitySettings) -> GpuSolver:
        return on_host(assembly, settings)

    monkeypatch.setattr("falsework.stability.gpu.solver.GpuSolver", driven)
    critical = critical_thickness(simplex)
    for thickness, verdict in ((critical - 2e-5, Verdict.UNSTABLE), (critical + 1e-3, Verdict.STABLE)):
        verdicts = checked(arch(thickness), criterion, solver="gpu")
        assert verdicts.verdict[0] == verdict
        assert verdicts.on_tolerance[0] == (verdict == Verdict.UNSTABLE)
        assert verdicts.residual[0] <= SETTINGS.tolerance


def test_the_checker_takes_a_close_proof_only_from_a_verdict_that_says_so(simplex: Any) -> None:
    assembly = arch(critical_thickness(simplex) - 1e-5)
    states = complete_state(assembly.boundary)[None]
    verdicts = StabilityOracle(assembly, EQUILIBRIUM).verdicts(states, require_certificate=True)
    assert verify_certificates(assembly, states, verdicts)[0]
    verdicts.on_tolerance[:] = False
    assert not verify_certificates(assembly, states, verdicts)[0]


def test_a_plan_with_a_close_state_is_refused_with_the_reason(simplex: Any) -> None:
    good = arch(0.12)
    plan = find_plans(good, robots=3, oracle=StabilityOracle(good, EQUILIBRIUM)).plans[0]
    thin = arch(critical_thickness(simplex) - 1e-5)
    end = {name: getattr(plan, name)[-2:] for name in ("states", "verdicts", "proofs", "residuals")}
    complete = replace(plan, **end, actions=plan.actions[-1:], forces=None)
    assert validate_plan(complete, good, EQUILIBRIUM).good
    report = validate_plan(replace(complete, identity=thin.identity, boundary=thin.boundary), thin, EQUILIBRIUM)
    assert not report.good
    assert report.reason.startswith("the structure is unstable after step 1 (release ")
    assert report.reason.endswith(", which depends on the tolerance")


def test_ordinary_verdicts_stay_with_the_fast_solver(scenes: Any) -> None:
    for name in ("dome", "vault", "wall"):
        assembly = library.build(name)
        states = scenes.few_changes(assembly, 20, seed=5)
        for criterion in CRITERIA:
            oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))  # type: ignore[arg-type]
            verdicts = oracle.verdicts(states)
            assert not verdicts.on_tolerance.any()
            assert (verdicts.decided_by[verdicts.stable] != Solver.EXACT).mean() >= 0.9


def test_forces_of_a_verdict_leave_as_much_as_it_says() -> None:
    assembly = library.build("dome")
    states = complete_state(assembly.boundary)[None]
    verdicts = StabilityOracle(assembly, EQUILIBRIUM).verdicts(states, require_certificate=True)
    assert verdicts.forces is not None
    assert residual_of_forces(assembly, states, verdicts.forces)[0] <= EQUILIBRIUM.resolution


@pytest.mark.parametrize("tolerance", [1.0, 1e300, 0.0, np.nan, "small"])
def test_a_tolerance_under_which_parts_may_fall_freely_is_refused(tolerance: Any) -> None:
    with pytest.raises(InputError, match="tolerance is "):
        StabilitySettings(tolerance=tolerance)

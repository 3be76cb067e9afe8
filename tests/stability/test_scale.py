"""Size, density and gravity change no verdict: the residual is a share of gravity."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilitySettings, Verdict, verify_certificates
from falsework.assembly import library
from falsework.geometry import TriangleMesh
from falsework.stability import ExactSolver, NumericalSettings, Verdicts
from falsework.stability.certificate import StabilityCriterion, residual_bound_of_velocity, residual_of_forces
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.criterion import Cone
from falsework.stability.problem import build_problem
from falsework.stability.verdict import Solver

CONES = ("octagon", "quadratic")
SCALES = (1e-3, 1.0, 1e3)
EARTH = 9.81


@pytest.fixture(params=["cpu", "exact", "gpu"])
def solver(request: pytest.FixtureRequest) -> Callable[[Assembly, StabilitySettings], Any]:
    """Makes a solver for a structure; `gpu` is its kernel as plain C++."""
    if request.param == "gpu":
        return request.getfixturevalue("on_host")
    if request.param == "exact":
        return ExactSolver
    return cpu_solver


def cpu_solver(assembly: Assembly, settings: StabilitySettings) -> CpuSolver:
    return CpuSolver(build_problem(assembly, cone=settings.friction_cone, gravity=settings.gravity), settings)


def solve(
    solver: Callable[..., Any], assembly: Assembly, states: NDArray[np.uint8], settings: StabilitySettings
) -> Verdicts:
    """Verdicts of one solver without the help of another, each proof accepted by the checker.

    The fast solvers leave open where forces in balance lie on the boundary of the admissible ones.
    """
    verdicts = solver(assembly, settings).check(states)
    accepted = verify_certificates(assembly, states, verdicts, settings.claim)
    np.testing.assert_array_equal(accepted, ~verdicts.undecided)
    assert solver is not ExactSolver or accepted.all()
    assert len(states) == 1 or accepted.mean() > 0.9
    return verdicts


def settings_of(cone: Cone, gravity: float = EARTH) -> StabilitySettings:
    return StabilitySettings(criterion="equilibrium", cone=cone, gravity=gravity, numerics=NumericalSettings(threads=1))  # type: ignore[arg-type]


@lru_cache
def structure(name: str, size: float = 1.0, density: float = 1.0) -> Assembly:
    """A built-in structure whose lengths and densities are multiplied."""
    base = library.build(name)
    return Assembly.from_meshes(
        [TriangleMesh.from_arrays(mesh.name, size * mesh.vertices, mesh.faces) for mesh in base.meshes],
        boundary=np.flatnonzero(base.boundary).tolist(),
        friction=base.friction,
        density=density * base.mass.mass / base.mass.volume,
    )


def some_states(scenes: Any, assembly: Assembly) -> NDArray[np.uint8]:
    near = scenes.few_changes(assembly, 10, seed=31)
    far = scenes.random_states(assembly, 10, seed=31, shares=(0.35, 0.5, 0.15))
    return np.unique(np.concatenate([near, far]), axis=0)


def overhang(scenes: Any, past: float, size: float) -> Assembly:
    """A cube on the edge of a fixed block, its centre of mass past the edge by a share of its width."""
    top = scenes.box([(past - 0.5) * size, 0, 0], [(past + 0.5) * size, size, size], "cube")
    return scenes.make([top, scenes.box([-size, 0, -0.5 * size], [0, size, 0], "ledge")], [1])


@pytest.mark.parametrize("size", SCALES)
def test_a_cube_past_an_edge_tips_at_every_size(scenes: Any, solver: Any, size: float) -> None:
    """Its least residual has a closed form, so it is known past which offset the tolerance is exceeded.

    Below it the cube tips all the same: solvers in float64 prove that, and say that the verdict depends on the
    tolerance; the one for GPUs leaves it open. At the edge of a cube of width `w` act a normal force `1 - r` and
    friction `r`, in weights: they leave `r` of gravity along both axes, and turn it by
    `((1 - r) past w - r w / 2) / (w^2 / 6)`, which times `w / sqrt 6` is `r`.
    """
    tolerance = settings_of("octagon").tolerance
    critical = tolerance * (1 / np.sqrt(6) + 1 / 2) / (1 - tolerance)
    double = solver in (ExactSolver, cpu_solver)
    near, below = (0.02, Verdict.UNSTABLE) if double else (0.5, Verdict.UNDECIDED)
    for past, expected, close in (
        (-1e-2, Verdict.STABLE, False),
        (-1e-3, Verdict.STABLE, False),
        ((1 - near) * critical, below, double),
        ((1 + near) * critical, Verdict.UNSTABLE, False),
        (1e-3, Verdict.UNSTABLE, False),
        (1e-2, Verdict.UNSTABLE, False),
    ):
        for cone in CONES:
            verdicts = solve(solver, overhang(scenes, past, size), np.array([[1, 2]], np.uint8), settings_of(cone))
            assert verdicts.verdict[0] == expected, (past, cone)
            assert verdicts.on_tolerance[0] == close


@pytest.mark.parametrize("cone", CONES)
def test_certificates_carry_over(scenes: Any, cone: Cone) -> None:
    """Forces in weights and velocities in widths prove the same number at every size, density and gravity."""
    name = "arch:blocks=7,thickness=0.25"
    base = structure(name)
    states = some_states(scenes, base)
    found = solve(ExactSolver, base, states, settings_of(cone))
    assert found.forces is not None
    assert found.velocity is not None
    above = residual_of_forces(base, states, found.forces, StabilityCriterion(cone=cone))
    below = residual_bound_of_velocity(base, states, found.velocity, StabilityCriterion(cone=cone))
    for size, density, gravity in ((1e-3, 1.0, EARTH), (1e3, 1e-3, EARTH), (0.3, 7.0, 1.62)):
        other = structure(name, size, density)
        heavier = size**3 * density * gravity / EARTH
        turned = found.velocity * np.repeat([1.0, 1 / size], 3)
        claim = StabilityCriterion(cone=cone, gravity=gravity)
        forces = residual_of_forces(other, states, heavier * found.forces, claim)
        np.testing.assert_allclose(forces, above, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(residual_bound_of_velocity(other, states, turned, claim), below, rtol=1e-6)


@pytest.mark.parametrize("name", ["wall:bricks=3,courses=3", "bottle"])
@pytest.mark.parametrize("cone", CONES)
def test_units_that_are_powers_of_four_change_no_digit(scenes: Any, solver: Any, cone: Cone, name: str) -> None:
    """Such factors (and their roots) shift the exponents of all numbers, so whatever residual is found first stays."""
    base = structure(name)
    states = some_states(scenes, base)
    expected = solve(solver, base, states, settings_of(cone))
    assert {Verdict.STABLE, Verdict.UNSTABLE} <= set(expected.verdict.tolist())
    for size, density, gravity in ((4.0**-5, 1.0, 1.0), (4.0**5, 4.0**-7, 1.0), (1.0, 4.0**6, 4.0**-2)):
        other = structure(name, size, density)
        verdicts = solve(solver, other, states, settings_of(cone, gravity * EARTH))
        np.testing.assert_array_equal(verdicts.verdict, expected.verdict)
        np.testing.assert_allclose(verdicts.residual, expected.residual, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", ["arch:blocks=7", "bottle"])
@pytest.mark.parametrize("cone", CONES)
def test_any_units_give_the_same_verdicts(scenes: Any, solver: Any, cone: Cone, name: str) -> None:
    base = structure(name)
    states = some_states(scenes, base)
    expected = solve(solver, base, states, settings_of(cone))
    for size, density, gravity in ((1e-3, 1.0, EARTH), (1e3, 1e-3, EARTH), (1.0, 1e4, 1.62), (0.37, 1e-2, 30.0)):
        verdicts = solve(solver, structure(name, size, density), states, settings_of(cone, gravity))
        both = ~(verdicts.undecided | expected.undecided)  # what lies on the boundary may be open in some units
        np.testing.assert_array_equal(verdicts.verdict[both], expected.verdict[both])
        assert np.mean(both) > 0.8
        if Solver.GPU not in verdicts.decided_by and name != "bottle":  # not float32, not degenerate
            decided = both & ~expected.on_tolerance  # there, how far a bound gets depends on rounding
            within = settings_of(cone).tolerance  # a stable state's residual is where the iterations stopped below it
            np.testing.assert_allclose(verdicts.residual[decided], expected.residual[decided], rtol=1e-6, atol=within)

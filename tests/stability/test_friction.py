"""Friction from zero to more than any material has: every state is decided, and no contact is in tension."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, verify_certificates
from falsework.assembly import library
from falsework.stability import ExactSolver, NumericalSettings
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.criterion import Cone
from falsework.stability.problem import build_problem
from falsework.stability.second_order.springs import into_cone
from falsework.stability.strength import Strength

Decided = Callable[[str, float, Cone], NDArray[np.int8]]
CONES: tuple[Cone, ...] = ("octagon", "quadratic")


def decided(assembly: Assembly, states: NDArray[np.uint8], cone: Cone) -> NDArray[np.int8]:
    """Verdicts on which the processor, with the exact solver's help, and the exact solver alone agree; all proven."""
    settings = StabilitySettings(criterion="equilibrium", cone=cone)
    both, alone = (
        StabilityOracle(assembly, settings).verdicts(states, require_certificate=True),
        ExactSolver(assembly, settings).check(states),
    )
    for verdicts in (both, alone):
        assert verify_certificates(assembly, states, verdicts, settings.claim).all()
    np.testing.assert_array_equal(both.verdict, alone.verdict)
    return both.verdict


def some_states(scenes: Any, assembly: Assembly) -> NDArray[np.uint8]:
    return np.unique(scenes.random_states(assembly, 8, seed=51, shares=(0.25, 0.6, 0.15)), axis=0)


@pytest.fixture(scope="module")
def decided_with(scenes: Any) -> Decided:
    """As `decided`, on a few states of a built-in structure with another friction; several tests compare with it."""

    built = cache(library.build)

    @cache
    def verdicts(name: str, friction: float, cone: Cone) -> NDArray[np.int8]:
        assembly = built(name).replace(friction=friction)
        return decided(assembly, some_states(scenes, assembly), cone)

    return verdicts


def under_a_ceiling(scenes: Any, friction: float) -> Assembly:
    """A cube that touches nothing but a fixed block above it."""
    cube, ceiling = scenes.box([0, 0, 0], [1, 1, 1], "cube"), scenes.box([-1, -1, 1], [2, 2, 2], "ceiling")
    return scenes.make([cube, ceiling], [1], friction=friction)


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [0.0, 1e-8, 0.5])
def test_contacts_do_not_pull(scenes: Any, cone: Cone, friction: float) -> None:
    """A cube under a fixed ceiling falls, with all of gravity, although pulling contacts could hold it."""
    assembly = under_a_ceiling(scenes, friction)
    assert len(assembly.contacts.points) == 4
    state, settings = np.array([[1, 2]], np.uint8), StabilitySettings(criterion="equilibrium", cone=cone)
    verdicts = ExactSolver(assembly, settings).check(state)
    assert verdicts.verdict[0] == Verdict.UNSTABLE
    assert verdicts.residual[0] == pytest.approx(1, abs=1e-6)
    assert verdicts.forces is not None
    assert (verdicts.forces[0, :, 0] >= 0).all()
    assert StabilityOracle(assembly, settings).verdicts(state, require_certificate=True).verdict[0] == Verdict.UNSTABLE


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [0.0, 1e-8, 0.5])
def test_forces_of_the_exact_solver_end_in_the_cone(cone: Cone, friction: float) -> None:
    """A pull of a solver's last digits becomes no force at all; forces in the cone stay as they are."""
    dry = Strength(np.array(friction), np.zeros(()), np.zeros(()), np.array(True), np.array(False))
    pull, slip, within = [-1e-9, 1e-9, 0.0], [2.0, 3.0, -4.0], [2.0, friction, 0.0]
    pulled, slipped, kept = into_cone(np.array([pull, slip, within]), dry, cone)[0]
    assert not pulled.any()
    assert slipped[0] == 2.0
    np.testing.assert_allclose(slipped[1] * -4.0, slipped[2] * 3.0)
    low, high = np.sort(np.abs(slipped[1:]))
    size = np.hypot(low, high) if cone == "quadratic" else high + (2**0.5 - 1) * low
    assert size == pytest.approx(2.0 * friction, abs=1e-15)
    np.testing.assert_array_equal(kept, within)


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [0.0, 1e-8, 0.5])
def test_contacts_do_not_pull_on_a_gpu(scenes: Any, on_host: Callable[..., Any], cone: Cone, friction: float) -> None:
    solver = on_host(under_a_ceiling(scenes, friction), StabilitySettings(criterion="equilibrium", cone=cone))
    assert solver.check(np.array([[1, 2]], np.uint8)).verdict[0] == Verdict.UNSTABLE


@pytest.mark.parametrize("name", ["polycube", "bottle", "wall:bricks=3,courses=3", "corbel"])
def test_without_friction_both_cones_are_the_same_ray(
    scenes: Any, simplex: Callable[..., float], decided_with: Decided, name: str
) -> None:
    assembly = library.build(name).replace(friction=0.0)
    states = some_states(scenes, assembly)
    octagon, quadratic = (decided_with(name, 0.0, cone) for cone in CONES)
    assert {Verdict.STABLE, Verdict.UNSTABLE} == set(octagon.tolist())
    np.testing.assert_array_equal(octagon, quadratic)
    least = np.array([simplex(assembly, state, directions=1) for state in states])
    np.testing.assert_array_equal(
        octagon == Verdict.STABLE, least <= StabilitySettings(criterion="equilibrium").tolerance
    )


@pytest.mark.parametrize("make", ["cpu", "gpu"])
def test_the_interior_point_method_needs_no_friction(scenes: Any, request: pytest.FixtureRequest, make: str) -> None:
    """With hardly any ADMM before it, it decides as much with one cone as with the other."""
    assembly = library.build("wall:bricks=3,courses=3").replace(friction=0.0)
    states = scenes.few_changes(assembly, 12, seed=52)
    verdict = []
    for cone in CONES:
        settings = StabilitySettings(
            criterion="equilibrium", cone=cone, numerics=NumericalSettings(iterations=1, threads=1)
        )
        if make == "gpu":
            solver = request.getfixturevalue("on_host")(assembly, settings)
        else:
            solver = CpuSolver(build_problem(assembly, cone=cone), settings)
        verdict.append(solver.check(states).verdict)
    assert (verdict[0] != Verdict.UNDECIDED).mean() > 0.8
    np.testing.assert_array_equal(verdict[0], verdict[1])


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [1e-12, 2e-9, 1e-5])
@pytest.mark.parametrize("name", ["polycube", "bottle"])
def test_next_to_no_friction_is_decided(decided_with: Decided, name: str, friction: float, cone: Cone) -> None:
    """What stands without friction stands with a little, and what falls with more falls with a little."""
    verdict, without, more = (decided_with(name, value, cone) for value in (friction, 0.0, 1e-3))
    assert (verdict[without == Verdict.STABLE] == Verdict.STABLE).all()
    assert (verdict[more == Verdict.UNSTABLE] == Verdict.UNSTABLE).all()


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [1e4, 1e8])
@pytest.mark.parametrize("name", ["bottle", "wall", "stack"])
def test_more_friction_than_anything_has_is_decided(
    decided_with: Decided, name: str, friction: float, cone: Cone
) -> None:
    verdict, less = (decided_with(name, value, cone) for value in (friction, 10.0))
    assert {Verdict.STABLE, Verdict.UNSTABLE} == set(verdict.tolist())
    assert (verdict[less == Verdict.STABLE] == Verdict.STABLE).all()

"""The fast solver, the exact solver and a linear program written from scratch agree."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, load_structure, verify_certificates
from falsework.assembly import library
from falsework.stability import ExactSolver

TOLERANCE = 1e-4
SMALL = ("arch:blocks=7", "wall:bricks=3,courses=3", "corbel", "bottle", "polycube")
REAL = ("bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72")


def compare(assembly: Assembly, states: NDArray[np.uint8], cone: str, *, exact: bool = True) -> NDArray[np.int8]:
    """Check that the fast solver decides every state with a proof, as the exact solver does; return the verdicts."""
    settings = StabilitySettings(criterion="equilibrium", cone=cone)  # type: ignore[arg-type]
    stability = StabilityOracle(assembly, settings)
    verdicts = stability.verdicts(states, require_certificate=True)
    assert not verdicts.undecided.any()
    assert stability.counters.rejected == 0
    assert verify_certificates(assembly, states, verdicts, settings.claim).all()
    if exact:
        slow = ExactSolver(assembly, settings).check(states)
        np.testing.assert_array_equal(verdicts.verdict, slow.verdict)
        assert verify_certificates(assembly, states, slow, settings.claim).all()
    return verdicts.verdict


def mixed_states(scenes: Any, assembly: Assembly, count: int, seed: int) -> NDArray[np.uint8]:
    """A few changes to the complete structure, and states with many parts gone."""
    near = scenes.few_changes(assembly, count, seed=seed)
    far = scenes.random_states(assembly, count, seed=seed, shares=(0.35, 0.5, 0.15))
    return np.unique(np.concatenate([near, far]), axis=0)


@pytest.mark.parametrize("structure", SMALL)
def test_three_methods_agree(scenes: Any, simplex: Callable[..., float], structure: str) -> None:
    """The residual that proves a verdict lies on the right side of the least one, which the simplex method finds."""
    assembly = library.build(structure)
    states = mixed_states(scenes, assembly, 8, seed=11)
    verdict = compare(assembly, states, "octagon")
    assert {Verdict.STABLE, Verdict.UNSTABLE} == set(verdict.tolist())
    residual = (
        StabilityOracle(assembly, StabilitySettings(criterion="equilibrium"))
        .verdicts(states, require_certificate=True)
        .residual
    )
    for state, value, proven in zip(states, verdict, residual, strict=True):
        least = simplex(assembly, state)
        assert value == (Verdict.STABLE if least <= TOLERANCE else Verdict.UNSTABLE)
        assert proven >= least - 1e-6 if value == Verdict.STABLE else proven <= least + 1e-6


@pytest.mark.parametrize("structure", SMALL)
def test_the_quadratic_cone_lies_between_two_polygons(
    scenes: Any, simplex: Callable[..., float], structure: str
) -> None:
    """Coulomb's cone holds all that a polygon inside it holds, and nothing that one around it does not."""
    assembly = library.build(structure).replace(friction=0.4)
    states = mixed_states(scenes, assembly, 3, seed=12)
    verdict = compare(assembly, states, "quadratic")
    assert {Verdict.STABLE, Verdict.UNSTABLE} == set(verdict.tolist())
    sides, settled = 16, 0
    for state, value in zip(states, verdict, strict=True):
        inside = simplex(assembly, state, directions=sides)
        around = simplex(assembly, state, directions=sides, widen=1 / np.cos(np.pi / sides))
        if inside <= TOLERANCE:
            assert value == Verdict.STABLE
        elif around > TOLERANCE:
            assert value == Verdict.UNSTABLE
        settled += (inside <= TOLERANCE) == (around <= TOLERANCE)
    assert settled >= 0.8 * len(states)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.84, 2.0])
@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
def test_any_friction(scenes: Any, cone: str, friction: float) -> None:
    assembly = library.build("arch:blocks=7,thickness=0.3").replace(friction=friction)
    compare(assembly, mixed_states(scenes, assembly, 6, seed=13), cone)


@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
def test_parts_of_very_different_weight(scenes: Any, cone: str) -> None:
    """Densities over six orders of magnitude in one structure."""
    base = library.build("wall:bricks=3,courses=3")
    density = 10.0 ** np.random.default_rng(0).uniform(0, 6, base.part_count)
    assembly = base.replace(density=density)
    compare(assembly, mixed_states(scenes, assembly, 10, seed=14), cone)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-2])
def test_any_tolerance(scenes: Any, simplex: Callable[..., float], tolerance: float) -> None:
    assembly = library.build("stack:blocks=3,overhang=1.001")
    states = mixed_states(scenes, assembly, 8, seed=15)
    settings = StabilitySettings(criterion="equilibrium", tolerance=tolerance)
    verdicts = StabilityOracle(assembly, settings).verdicts(states, require_certificate=True)
    assert not verdicts.undecided.any()
    close = 0
    for state, verdict, on_tolerance in zip(states, verdicts.verdict, verdicts.on_tolerance, strict=True):
        least = simplex(assembly, state)
        assert verdict == (Verdict.STABLE if least <= settings.resolution else Verdict.UNSTABLE)
        assert on_tolerance == (settings.resolution < least <= tolerance)
        close += on_tolerance
    assert (close > 0) == (tolerance == 1e-2)


@pytest.mark.parametrize(("name", "cone"), list(zip(REAL, cycle(["octagon", "quadratic"]))))
def test_real_structures(scenes: Any, shared_assembly: Callable[[str], Path], name: str, cone: str) -> None:
    """With either cone in turn."""
    assembly = load_structure(shared_assembly(name))
    states = mixed_states(scenes, assembly, 3, seed=16)
    compare(assembly, states, cone)


@pytest.mark.parametrize("name", ["bottle-12", "cube-17", "dog-35"])
def test_real_structures_by_the_simplex_method(
    scenes: Any, shared_assembly: Callable[[str], Path], simplex: Callable[..., float], name: str
) -> None:
    assembly = load_structure(shared_assembly(name))
    states = mixed_states(scenes, assembly, 4, seed=17)
    verdict = compare(assembly, states, "octagon", exact=False)
    least = np.array([simplex(assembly, state) for state in states])
    np.testing.assert_array_equal(verdict == Verdict.STABLE, least <= TOLERANCE)

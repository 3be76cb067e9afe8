"""The GPU's kernels under the criterion `contact`, as plain C++ and on a GPU, agree with the CPU solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, load_structure, verify_certificates
from falsework.assembly import library
from falsework.search.device.oracle import DeviceOracle, without_fallback
from falsework.stability import NumericalSettings, Proof
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.problem import build_problem
from falsework.stability.settings import EQUILIBRIUM

CONTACT = StabilitySettings()


def states_of(scenes: Any, assembly: Assembly, count: int, seed: int) -> Any:
    near = scenes.few_changes(assembly, count, seed=seed)
    far = scenes.random_states(assembly, count, seed=seed, shares=(0.35, 0.5, 0.15))
    return np.concatenate([near, far])


@pytest.mark.parametrize("cone", ["quadratic", "octagon"])
@pytest.mark.parametrize("structure", ["arch:blocks=7", "dome", "corbel", "wall:bricks=3,courses=3"])
def test_agrees_with_the_processor(
    scenes: Any, structure: str, cone: Any, make_solver: Callable[..., GpuSolver]
) -> None:
    compare(scenes, library.build(structure), cone, make_solver)


@pytest.mark.parametrize("cone", ["quadratic", "octagon"])
def test_points_may_differ_in_friction(scenes: Any, cone: Any, make_solver: Callable[..., GpuSolver]) -> None:
    compare(scenes, scenes.leaning(library.build("wall:bricks=3,courses=3")), cone, make_solver)


def compare(scenes: Any, assembly: Assembly, cone: Any, make_solver: Callable[..., GpuSolver]) -> None:
    """Check that both solvers say the same and that every certificate is accepted."""
    settings = replace(CONTACT, cone=cone)
    states = states_of(scenes, assembly, 30, seed=11)
    solver = make_solver(assembly, settings)
    verdicts = solver.check(states)
    expected = ContactSolver(assembly, solver.problem, settings).check(states, certificates=False)
    assert verdicts.stable.any()
    both = ~verdicts.undecided & ~expected.undecided
    assert both.mean() > 0.98
    np.testing.assert_array_equal(verdicts.verdict[both], expected.verdict[both])
    np.testing.assert_array_equal(verify_certificates(assembly, states, verdicts, settings.claim), ~verdicts.undecided)
    assert (verdicts.proof[verdicts.stable] == Proof.DISPLACEMENT).all()
    assert verdicts.displacement is not None
    neither = ~verdicts.stable & ~verdicts.slides
    assert np.isnan(verdicts.displacement[neither]).all()
    assert np.isfinite(verdicts.displacement[~neither]).all()
    bare, residual = solver.check_tensor(solver.driver.put(states))
    np.testing.assert_array_equal(solver.driver.get(bare), verdicts.verdict)
    np.testing.assert_array_equal(solver.driver.get(residual)[verdicts.stable], verdicts.residual[verdicts.stable])


def test_as_many_iterations_as_on_the_processor(scenes: Any, make_solver: Callable[..., GpuSolver]) -> None:
    """The same method in other coordinates: stable states take the same steps but for rounding."""
    assembly = library.build("dome")
    states = states_of(scenes, assembly, 40, seed=4)
    alone = replace(CONTACT, numerics=NumericalSettings(iterations=0, interior_steps=0))
    solver = make_solver(assembly, alone)
    verdicts = solver.check(states, certificates=False)
    expected = ContactSolver(assembly, solver.problem, CONTACT).check(states, certificates=False)
    both = verdicts.stable & expected.stable
    assert both.sum() > 20
    assert (verdicts.iterations[both] == expected.iterations[both]).mean() > 0.9


@pytest.mark.parametrize("name", ["vault-62", "dome-72"])
def test_agrees_on_real_structures(
    scenes: Any, shared_assembly: Callable[[str], Path], name: str, make_solver: Callable[..., GpuSolver]
) -> None:
    assembly = load_structure(str(shared_assembly(name)))
    states = states_of(scenes, assembly, 10, seed=3)
    solver = make_solver(assembly, CONTACT)
    verdicts = solver.check(states)
    expected = ContactSolver(assembly, solver.problem, CONTACT).check(states, certificates=False)
    both = ~verdicts.undecided & ~expected.undecided
    np.testing.assert_array_equal(verdicts.verdict[both], expected.verdict[both])
    np.testing.assert_array_equal(verify_certificates(assembly, states, verdicts, CONTACT.claim), ~verdicts.undecided)


def test_a_clamped_cube_slides_though_forces_could_hold_it(scenes: Any, make_solver: Callable[..., GpuSolver]) -> None:
    """Walls that press could hold the cube by friction; without prestress nothing makes them press."""
    assembly = scenes.clamp(friction=0.6)
    state = np.array([[1, 2, 2]], np.uint8)
    verdicts = make_solver(assembly, CONTACT).check(state)
    assert verdicts.verdict[0] == Verdict.SLIDES
    assert verify_certificates(assembly, state, verdicts, CONTACT.claim).all()
    assert make_solver(assembly, EQUILIBRIUM).check(state).stable.all()
    one = replace(
        CONTACT, numerics=NumericalSettings(iterations=1, check_every=1)
    )  # then the interior point method decides
    assert make_solver(assembly, one).check(state).verdict[0] == Verdict.SLIDES


def test_slides_and_unstable_together_are_the_states_that_do_not_rest(
    scenes: Any, make_solver: Callable[..., GpuSolver]
) -> None:
    """A state at rest is in equilibrium, and every state in equilibrium rests, slides or stays open."""
    assembly = library.build("arch:blocks=7")
    states = states_of(scenes, assembly, 60, seed=9)
    verdicts = make_solver(assembly, CONTACT).check(states, certificates=False)
    problem = build_problem(assembly, cone="quadratic")
    balanced = CpuSolver(problem, EQUILIBRIUM).check(states, certificates=False)
    assert verdicts.unstable.any()
    np.testing.assert_array_equal(verdicts.unstable, balanced.unstable)


def test_states_too_large_for_the_chip_are_judged_in_memory(scenes: Any, on_host: Callable[..., GpuSolver]) -> None:
    assembly = library.build("arch:blocks=7")
    states = states_of(scenes, assembly, 30, seed=2)
    roomy = on_host(assembly, CONTACT)
    tight = on_host(assembly, CONTACT, shared_limit=4 * 1024 + roomy.layout.contact_bytes() // 2)
    first, second = roomy.check(states), tight.check(states)
    assert "contact_scratch" not in roomy.driver.launched  # type: ignore[attr-defined]
    assert "contact_scratch" in tight.driver.launched  # type: ignore[attr-defined]
    np.testing.assert_array_equal(first.verdict, second.verdict)
    np.testing.assert_array_equal(first.displacement, second.displacement)


def test_nothing_that_moves_rests(make_solver: Callable[..., GpuSolver]) -> None:
    assembly = library.build("arch:blocks=5")
    still = np.where(assembly.boundary, 2, 0).astype(np.uint8)
    held = np.full(assembly.part_count, 2, np.uint8)
    verdicts = make_solver(assembly, CONTACT).check(np.stack([still, held]))
    assert verdicts.stable.all()
    assert (verdicts.residual == 0).all()
    assert verdicts.displacement is not None
    assert (verdicts.displacement == 0).all()


def test_what_the_gpu_leaves_open_is_settled_on_the_processor(scenes: Any, on_host: Callable[..., GpuSolver]) -> None:
    """With one Newton iteration and no interior point method much stays open, or slides for want of iterations."""
    torch = pytest.importorskip("torch")
    assembly = library.build("arch:blocks=7")
    states = states_of(scenes, assembly, 30, seed=6)
    tired = replace(CONTACT, numerics=NumericalSettings(contact_steps=1))

    class OnTensors:
        def check_tensor(self, given: Any) -> Any:
            return tuple(torch.from_numpy(each) for each in on_host(assembly, tired).check_tensor(given.numpy()))

    oracle = DeviceOracle.__new__(DeviceOracle)
    oracle.solver, oracle.fallback = OnTensors(), StabilityOracle(assembly)  # type: ignore[assignment]
    given = torch.from_numpy(states)
    alone = without_fallback(oracle)(given, given).numpy()
    expected = StabilityOracle(assembly).verdicts(states, require_certificate=True).verdict
    assert (alone == Verdict.UNDECIDED).any()
    assert not (alone == Verdict.SLIDES).any()
    np.testing.assert_array_equal(oracle(given, given).numpy(), expected)
    decided = alone != Verdict.UNDECIDED
    np.testing.assert_array_equal(alone[decided], expected[decided])


def test_matrices_alone_may_be_in_memory(scenes: Any, on_host: Callable[..., GpuSolver]) -> None:
    """Between states that fit on chip and those that do not are those of which all but the matrices does."""
    assembly = library.build("dome")
    states = states_of(scenes, assembly, 20, seed=2)
    roomy = on_host(assembly, CONTACT)
    layout = roomy.layout
    between = (layout.contact_near_bytes() + layout.contact_bytes()) // 2
    half = on_host(assembly, CONTACT, shared_limit=between)
    first, second = roomy.check(states), half.check(states)
    launched = half.driver.launched  # type: ignore[attr-defined]
    assert "contact_shared" in launched
    assert "contact_scratch" in launched
    np.testing.assert_array_equal(first.verdict, second.verdict)
    np.testing.assert_array_equal(first.displacement, second.displacement)

"""The GPU's kernels for equilibrium, as plain C++ with one thread per block and on a GPU, agree with the CPU solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, load_structure, verify_certificates
from falsework.assembly import library
from falsework.errors import DependencyError, InputError
from falsework.stability import NumericalSettings
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.gpu.driver import KERNELS, CudaDriver, compile_kernel
from falsework.stability.gpu.layout import build_layout
from falsework.stability.gpu.solver import GpuSolver, MemoryWarning
from falsework.stability.problem import build_problem
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.verdict import Solver

SMALL = ("arch:blocks=7", "wall:bricks=3,courses=3", "corbel", "bottle", "polycube")


def mixed_states(scenes: Any, assembly: Assembly, count: int, seed: int) -> Any:
    near = scenes.few_changes(assembly, count, seed=seed)
    far = scenes.random_states(assembly, count, seed=seed, shares=(0.35, 0.5, 0.15))
    return np.concatenate([near, far])


def compare(make_solver: Callable[..., GpuSolver], assembly: Assembly, states: Any, settings: StabilitySettings) -> Any:
    """Check that both solvers say the same and that every certificate is accepted; return the verdicts."""
    solver = make_solver(assembly, settings)
    verdicts = solver.check(states)
    expected = CpuSolver(solver.problem, settings).check(states, certificates=False)
    both = ~verdicts.undecided & ~expected.undecided  # what either leaves open goes to the exact solver
    np.testing.assert_array_equal(verdicts.verdict[both], expected.verdict[both])
    assert both.mean() >= 0.95
    np.testing.assert_array_equal(verify_certificates(assembly, states, verdicts, settings.claim), ~verdicts.undecided)
    np.testing.assert_array_equal(verdicts.decided_by, np.where(verdicts.undecided, Solver.NONE, Solver.GPU))
    return verdicts


@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
@pytest.mark.parametrize("structure", SMALL)
def test_agrees_with_the_processor(
    scenes: Any, structure: str, cone: Any, make_solver: Callable[..., GpuSolver]
) -> None:
    assembly = library.build(structure)
    verdicts = compare(
        make_solver, assembly, mixed_states(scenes, assembly, 30, seed=5), replace(EQUILIBRIUM, cone=cone)
    )
    assert verdicts.stable.any()
    assert verdicts.unstable.any()


@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
def test_points_may_differ_in_friction(scenes: Any, cone: Any, make_solver: Callable[..., GpuSolver]) -> None:
    """Where faces lean, points have less; both methods, which share the states, take it from the same array."""
    assembly = scenes.leaning(library.build("wall:bricks=3,courses=3"))
    for options in (NumericalSettings(), NumericalSettings(iterations=1, check_every=1)):
        settings = replace(EQUILIBRIUM, cone=cone, numerics=options)
        verdicts = compare(make_solver, assembly, mixed_states(scenes, assembly, 30, seed=5), settings)
        assert verdicts.stable.any()
        assert verdicts.unstable.any()


def test_contacts_that_carry_nothing_are_left_to_the_processor(scenes: Any, on_host: Any) -> None:
    assembly = scenes.leaning(library.build("wall:bricks=3,courses=3")).at_friction(0.1)
    with pytest.raises(InputError, match="more than friction holds"):
        on_host(assembly)


@pytest.mark.parametrize("name", ["bottle-12", "dome-37", "vault-62"])
def test_agrees_on_real_structures(
    scenes: Any, shared_assembly: Callable[[str], Path], name: str, make_solver: Callable[..., GpuSolver]
) -> None:
    assembly = load_structure(str(shared_assembly(name)))
    compare(make_solver, assembly, mixed_states(scenes, assembly, 20, seed=3), EQUILIBRIUM)


def test_the_interior_point_method_agrees_from_the_first_step(
    scenes: Any, make_solver: Callable[..., GpuSolver]
) -> None:
    """With one iteration of ADMM nearly everything is left to the interior point method."""
    assembly = library.build("wall:bricks=3,courses=3")
    states = mixed_states(scenes, assembly, 30, seed=8)
    for cone in ("octagon", "quadratic"):
        settings = replace(EQUILIBRIUM, cone=cone, numerics=NumericalSettings(iterations=1, check_every=1))
        verdicts = compare(make_solver, assembly, states, settings)
        assert (verdicts.iterations > 1).mean() > 0.5


@pytest.mark.parametrize("settings", [EQUILIBRIUM, StabilitySettings()], ids=["equilibrium", "contact"])
@pytest.mark.parametrize("structure", ["dome", "wall:bricks=3,courses=3"])
def test_any_number_of_threads_finds_the_same(
    scenes: Any,
    structure: str,
    settings: StabilitySettings,
    on_host: Callable[..., GpuSolver],
    on_device: Callable[..., GpuSolver],
) -> None:
    """A block reduces within one warp, or across two or eight; one thread on the processor is the reference."""
    assembly = library.build(structure)
    states = mixed_states(scenes, assembly, 200, seed=12)
    alone = on_host(assembly, settings).check(states, certificates=False)
    for threads in (32, 64, 256):
        verdicts = on_device(assembly, settings, threads=threads).check(states)
        both = ~verdicts.undecided & ~alone.undecided
        assert both.mean() > 0.95
        np.testing.assert_array_equal(verdicts.verdict[both], alone.verdict[both])
        np.testing.assert_array_equal(
            verify_certificates(assembly, states, verdicts, settings.claim), ~verdicts.undecided
        )


def test_states_too_large_for_the_chip_are_judged_in_memory(scenes: Any, on_host: Callable[..., GpuSolver]) -> None:
    """With next to no shared memory every state takes the kernels that work in device memory, to the same end."""
    assembly = library.build("arch:blocks=7")
    states = mixed_states(scenes, assembly, 30, seed=2)
    settings = replace(EQUILIBRIUM, numerics=NumericalSettings(iterations=10))
    roomy, tight = on_host(assembly, settings), on_host(assembly, settings, shared_limit=8 * 1024)
    first, second = roomy.check(states), tight.check(states)
    assert "interior_scratch" not in roomy.driver.launched  # type: ignore[attr-defined]
    assert "interior_scratch" in tight.driver.launched  # type: ignore[attr-defined]
    assert not second.undecided.any()
    np.testing.assert_array_equal(first.verdict, second.verdict)
    np.testing.assert_array_equal(first.residual, second.residual)


def test_verdicts_alone_are_the_same(scenes: Any, make_solver: Callable[..., GpuSolver]) -> None:
    assembly = library.build("wall:bricks=3,courses=3")
    states = mixed_states(scenes, assembly, 20, seed=4)
    solver = make_solver(assembly, EQUILIBRIUM)
    whole, bare = solver.check(states), solver.check(states, certificates=False)
    assert bare.forces is None
    assert bare.velocity is None
    np.testing.assert_array_equal(whole.verdict, bare.verdict)
    verdict, residual = solver.check_tensor(solver.driver.put(states))
    np.testing.assert_array_equal(solver.driver.get(verdict), whole.verdict)
    np.testing.assert_array_equal(solver.driver.get(residual), whole.residual)


def test_found_forces_are_a_good_guess(scenes: Any, make_solver: Callable[..., GpuSolver]) -> None:
    """A stable state started from its own forces is proven at the first test, and hands forces back."""
    assembly = library.build("arch:blocks=7")
    states = np.unique(mixed_states(scenes, assembly, 40, seed=6), axis=0)
    solver = make_solver(assembly, EQUILIBRIUM)
    cold = solver.check(states)
    assert cold.forces is not None
    rows = np.flatnonzero(cold.stable & (cold.iterations > 10))
    assert len(rows)
    guess = cold.forces[rows].copy()
    warm = solver.check(states[rows], guess=guess)
    assert (warm.iterations <= cold.iterations[rows]).all()
    assert warm.iterations.mean() < 0.7 * cold.iterations[rows].mean()
    assert warm.forces is not None
    np.testing.assert_array_equal(warm.forces, guess)
    assert verify_certificates(assembly, states[rows], warm, EQUILIBRIUM.claim).all()


def test_the_batch_is_halved_when_memory_runs_out(scenes: Any, on_host: Callable[..., GpuSolver]) -> None:
    assembly = library.build("arch:blocks=7")
    states = mixed_states(scenes, assembly, 16, seed=7)
    expected = on_host(assembly, EQUILIBRIUM).check(states)
    each = build_problem(assembly).points * 24
    with pytest.warns(MemoryWarning, match="16 at a time"):
        small = on_host(assembly, EQUILIBRIUM, memory=20 * each).check(states)
    np.testing.assert_array_equal(small.verdict, expected.verdict)
    np.testing.assert_array_equal(small.forces, expected.forces)
    each = build_problem(assembly).points * 12
    with pytest.warns(MemoryWarning, match="16 at a time"):
        verdict, _ = on_host(assembly, EQUILIBRIUM, memory=20 * each).check_tensor(states)
    np.testing.assert_array_equal(verdict, expected.verdict)


def test_nothing_to_judge_and_nothing_that_moves(scenes: Any, make_solver: Callable[..., GpuSolver]) -> None:
    assembly = library.build("arch:blocks=5")
    solver = make_solver(assembly, EQUILIBRIUM)
    assert len(solver.check(np.zeros((0, assembly.part_count), np.uint8))) == 0
    still = np.where(assembly.boundary, 2, 0).astype(np.uint8)
    held = np.full(assembly.part_count, 2, np.uint8)
    verdicts = solver.check(np.stack([still, held]))
    assert (verdicts.verdict == Verdict.STABLE).all()
    assert (verdicts.residual == 0).all()


def test_without_friction_a_clamped_cube_falls(scenes: Any, make_solver: Callable[..., GpuSolver]) -> None:
    for cone in ("octagon", "quadratic"):
        assembly = scenes.clamp(friction=0.0)
        solver = make_solver(assembly, replace(EQUILIBRIUM, cone=cone))
        assert solver.check(np.array([[1, 2, 2]], np.uint8)).verdict[0] == Verdict.UNSTABLE


@pytest.mark.parametrize("structure", SMALL)
def test_positions_follow_the_elimination_tree(structure: str) -> None:
    """Rows of blocks come after their columns, a level apart; every contact point is in one group."""
    problem = build_problem(library.build(structure))
    layout = build_layout(problem)
    arrays = layout.arrays
    level = np.searchsorted(arrays["level_start"], np.arange(layout.sizes["positions"]), side="right")
    assert (level[arrays["block_row"]] > level[arrays["block_column"]]).all()
    assert sorted(arrays["position"][arrays["position"] >= 0]) == list(range(layout.sizes["positions"]))
    covered = [
        first + i
        for first, count in zip(arrays["group_first"], arrays["group_count"], strict=True)
        for i in range(count)
    ]
    assert sorted(covered) == list(range(problem.points))


def test_a_missing_device_is_said_in_one_line() -> None:
    if find_spec("torch") is not None:
        import torch

        if torch.cuda.is_available():
            pytest.skip("this machine has a GPU")
    with pytest.raises((DependencyError, InputError), match=r"pip install|solver='cpu'"):
        CudaDriver({}, "cuda")


@pytest.mark.slow
@pytest.mark.skipif(find_spec("cuda") is None or find_spec("cuda.bindings") is None, reason="no cuda-bindings")
@pytest.mark.parametrize("kernel", KERNELS)
def test_compiles_for_a_gpu(kernel: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiler needs no GPU; what it made is kept."""
    monkeypatch.setenv("FALSEWORK_CACHE", str(tmp_path))
    compile_kernel.cache_clear()  # on a machine with a GPU another test has compiled it
    try:
        code = compile_kernel(9, 0, (("GROUP", 4), ("PART", KERNELS.index(kernel)), ("QUADRATIC", 0)))
    except (OSError, RuntimeError) as error:
        pytest.skip(f"NVRTC is not there: {error}")
    assert kernel.encode() in code
    (kept,) = tmp_path.iterdir()
    assert kept.read_bytes().endswith(code)  # after its digest


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_oracle_sends_large_batches_to_the_gpu_and_small_ones_to_the_processor(monkeypatch, host_driver, criterion):
    assembly = library.build("arch:blocks=7")
    monkeypatch.setattr(
        "falsework.stability.gpu.solver.GpuSolver",
        lambda assembly, problem, settings: GpuSolver(
            assembly, problem, settings, make_driver=lambda defines, _: host_driver(defines)
        ),
    )
    rng = np.random.default_rng(3)
    states = rng.integers(0, 3, (60, assembly.part_count)).astype(np.uint8)
    states[:, assembly.boundary] = 2
    states = np.unique(states, axis=0)
    auto = StabilityOracle(assembly, StabilitySettings(criterion, solver="auto"))
    expected = StabilityOracle(assembly, StabilitySettings(criterion)).verdicts(states, require_certificate=True)
    np.testing.assert_array_equal(auto.verdicts(states).verdict, expected.verdict)
    assert auto.counters.gpu == len(states)
    fresh = StabilityOracle(assembly, StabilitySettings(criterion, solver="auto"))
    np.testing.assert_array_equal(fresh.verdicts(states[:2]).verdict, expected.verdict[:2])
    assert (fresh.counters.gpu, fresh.counters.cpu) == (0, 2)
    np.testing.assert_array_equal(fresh.verdicts(states, require_certificate=True).verdict, expected.verdict)
    parents = np.where(assembly.boundary, 2, 1).astype(np.uint8)[None].repeat(len(states), axis=0)
    only = StabilityOracle(assembly, StabilitySettings(criterion, solver="gpu"))
    np.testing.assert_array_equal(only.verdicts(states, near=parents).stable, expected.stable)
    assert only.counters.cpu == 0


def test_oracle_without_a_gpu_says_so_or_takes_the_processor(monkeypatch):
    def missing(assembly, problem, settings):
        raise DependencyError("no torch here; pip install 'falsework[gpu]'")

    monkeypatch.setattr("falsework.stability.gpu.solver.GpuSolver", missing)
    assembly = library.build("arch:blocks=5")
    state = np.where(assembly.boundary, 2, 1).astype(np.uint8)[None].repeat(9, axis=0)
    auto = StabilityOracle(assembly, StabilitySettings(solver="auto"))
    assert auto.verdicts(state).stable.all()
    assert auto.counters.gpu == 0
    with pytest.raises(DependencyError, match=r"falsework\[gpu\]"):
        StabilityOracle(assembly, StabilitySettings(solver="gpu"))

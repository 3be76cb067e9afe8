"""The GPU's kernel, compiled as plain C++ with one thread a block, agrees with the solver on the processor."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework.assembly import library, load_structure
from falsework.assembly.model import Assembly
from falsework.errors import DependencyError, InputError
from falsework.stability import Solver, Stability, StabilitySettings, Verdict, accept, build_problem, oracle
from falsework.stability.cpu import CpuSolver
from falsework.stability.gpu import GpuSolver, MemoryWarning
from falsework.stability.gpu_driver import KERNELS, CudaDriver, compile_kernel, kernel_source
from falsework.stability.gpu_layout import build_layout
from falsework.stability.settings import GpuSettings

COMPILER = shutil.which("g++") or shutil.which("clang++")
SMALL = ("arch:blocks=7", "wall:bricks=3,courses=3", "corbel", "bottle", "polycube")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler for the kernel")


@lru_cache
def library_of(defines: tuple[tuple[str, int], ...]) -> ctypes.CDLL:
    """The kernel as a shared library."""
    assert COMPILER is not None
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "kernel.cpp", Path(folder) / "kernel.so"
        source.write_text(kernel_source(), encoding="utf-8")
        constants = [f"-D{name}={value}" for name, value in defines]
        command = [COMPILER, "-std=c++17", "-O1", "-shared", "-fPIC", *constants, "-o", str(out), str(source)]
        subprocess.run(command, check=True, capture_output=True)
        return ctypes.CDLL(str(out))


class HostDriver:
    """A device whose blocks have one thread: the processor."""

    multiprocessors = 1
    most_threads = 1

    def __init__(self, defines: dict[str, int], shared_limit: int = 227 * 1024, memory: int | None = None) -> None:
        self.shared_limit = shared_limit
        self.memory = memory
        self.launched: list[str] = []
        self._library = library_of(tuple(sorted(defines.items())))

    def put(self, array: Any) -> Any:
        return np.array(array, order="C")

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Any:
        if self.memory is not None and np.prod(shape) * np.dtype(dtype).itemsize > self.memory:
            raise RuntimeError("CUDA out of memory")
        return np.full(shape, 77, dtype=dtype)  # what is read before it is written will not look right

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> Any:
        return np.zeros(shape, dtype=dtype)

    def get(self, array: Any) -> Any:
        return array

    def address(self, array: Any) -> int:
        return array.ctypes.data

    def blocks(self, kernel: str, threads: int, shared: int) -> int:
        return 1

    def launch(self, kernel: str, blocks: int, threads: int, shared: int, arguments: Any) -> None:
        assert blocks == threads == 1
        self.launched.append(kernel)
        function = getattr(self._library, kernel)
        function.argtypes = [type(argument) for argument in arguments]
        function.restype = None
        function(*arguments)


def on_host(assembly: Assembly, settings: StabilitySettings = StabilitySettings(), **limits: Any) -> GpuSolver:
    problem = build_problem(assembly, cone=settings.cone, gravity=settings.gravity)
    return GpuSolver(problem, settings, make_driver=lambda defines: HostDriver(defines, **limits))


def mixed_states(scenes: Any, assembly: Assembly, count: int, seed: int) -> Any:
    near = scenes.few_changes(assembly, count, seed=seed)
    far = scenes.random_states(assembly, count, seed=seed, shares=(0.35, 0.5, 0.15))
    return np.concatenate([near, far])


def compare(assembly: Assembly, states: Any, settings: StabilitySettings) -> Any:
    """Check that both solvers say the same and that every certificate is accepted; return the verdicts."""
    solver = on_host(assembly, settings)
    verdicts = solver.check(states)
    expected = CpuSolver(solver.problem, settings).check(states, certificates=False)
    both = ~verdicts.undecided & ~expected.undecided  # what either leaves open goes to the exact solver
    np.testing.assert_array_equal(verdicts.verdict[both], expected.verdict[both])
    assert both.mean() > 0.95
    np.testing.assert_array_equal(accept(assembly, states, verdicts, settings.claim), ~verdicts.undecided)
    np.testing.assert_array_equal(verdicts.decided_by, np.where(verdicts.undecided, Solver.NONE, Solver.GPU))
    return verdicts


@needs_compiler
@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
@pytest.mark.parametrize("structure", SMALL)
def test_agrees_with_the_processor(scenes: Any, structure: str, cone: Any) -> None:
    assembly = library.build(structure)
    verdicts = compare(assembly, mixed_states(scenes, assembly, 30, seed=5), StabilitySettings(cone=cone))
    assert verdicts.stable.any()
    assert verdicts.unstable.any()


@needs_compiler
@pytest.mark.parametrize("name", ["bottle-12", "dome-37", "vault-62"])
def test_agrees_on_real_structures(scenes: Any, shared_assembly: Callable[[str], Path], name: str) -> None:
    assembly = load_structure(str(shared_assembly(name)))
    compare(assembly, mixed_states(scenes, assembly, 20, seed=3), StabilitySettings())


@needs_compiler
def test_the_interior_point_method_agrees_from_the_first_step(scenes: Any) -> None:
    """With one iteration of ADMM nearly everything is left to the interior point method."""
    assembly = library.build("wall:bricks=3,courses=3")
    states = mixed_states(scenes, assembly, 30, seed=8)
    for cone in ("octagon", "quadratic"):
        settings = StabilitySettings(cone=cone, gpu=GpuSettings(iterations=1, first_check=1))  # type: ignore[arg-type]
        verdicts = compare(assembly, states, settings)
        assert (verdicts.iterations > 1).mean() > 0.5


@needs_compiler
def test_states_too_large_for_the_chip_are_judged_in_memory(scenes: Any) -> None:
    """With next to no shared memory every state takes the kernels that work in device memory, to the same end."""
    assembly = library.build("arch:blocks=7")
    states = mixed_states(scenes, assembly, 30, seed=2)
    settings = StabilitySettings(gpu=GpuSettings(iterations=10))
    roomy, tight = on_host(assembly, settings), on_host(assembly, settings, shared_limit=8 * 1024)
    first, second = roomy.check(states), tight.check(states)
    assert "interior_scratch" not in roomy.driver.launched  # type: ignore[attr-defined]
    assert "interior_scratch" in tight.driver.launched  # type: ignore[attr-defined]
    assert not second.undecided.any()
    np.testing.assert_array_equal(first.verdict, second.verdict)
    np.testing.assert_array_equal(first.residual, second.residual)


@needs_compiler
def test_verdicts_alone_are_the_same(scenes: Any) -> None:
    assembly = library.build("wall:bricks=3,courses=3")
    states = mixed_states(scenes, assembly, 20, seed=4)
    solver = on_host(assembly)
    whole, bare = solver.check(states), solver.check(states, certificates=False)
    assert bare.forces is None
    assert bare.velocity is None
    np.testing.assert_array_equal(whole.verdict, bare.verdict)
    verdict, residual = solver.check_tensor(states)
    np.testing.assert_array_equal(verdict, whole.verdict)
    np.testing.assert_array_equal(residual, whole.residual)


@needs_compiler
def test_found_forces_are_a_good_guess(scenes: Any) -> None:
    """A stable state started from its own forces is proven at the first test, and hands forces back."""
    assembly = library.build("arch:blocks=7")
    states = np.unique(mixed_states(scenes, assembly, 40, seed=6), axis=0)
    solver = on_host(assembly)
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
    assert accept(assembly, states[rows], warm).all()


@needs_compiler
def test_the_batch_is_halved_when_memory_runs_out(scenes: Any) -> None:
    assembly = library.build("arch:blocks=7")
    states = mixed_states(scenes, assembly, 16, seed=7)
    expected = on_host(assembly).check(states)
    each = build_problem(assembly).points * 24
    with pytest.warns(MemoryWarning, match="16 at a time"):
        small = on_host(assembly, memory=20 * each).check(states)
    np.testing.assert_array_equal(small.verdict, expected.verdict)
    np.testing.assert_array_equal(small.forces, expected.forces)
    each = build_problem(assembly).points * 12
    with pytest.warns(MemoryWarning, match="16 at a time"):
        verdict, _ = on_host(assembly, memory=20 * each).check_tensor(states)
    np.testing.assert_array_equal(verdict, expected.verdict)


@needs_compiler
def test_nothing_to_judge_and_nothing_that_moves(scenes: Any) -> None:
    assembly = library.build("arch:blocks=5")
    solver = on_host(assembly)
    assert len(solver.check(np.zeros((0, assembly.part_count), np.uint8))) == 0
    still = np.where(assembly.boundary, 2, 0).astype(np.uint8)
    held = np.full(assembly.part_count, 2, np.uint8)
    verdicts = solver.check(np.stack([still, held]))
    assert (verdicts.verdict == Verdict.STABLE).all()
    assert (verdicts.residual == 0).all()


@needs_compiler
def test_without_friction_a_clamped_cube_falls(scenes: Any) -> None:
    for cone in ("octagon", "quadratic"):
        assembly = scenes.clamp(friction=0.0)
        solver = on_host(assembly, StabilitySettings(cone=cone))
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
        CudaDriver("cuda", {})


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
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [code]


@needs_compiler
def test_oracle_sends_large_batches_to_the_gpu_and_small_ones_to_the_processor(monkeypatch):
    assembly = library.build("arch:blocks=7")
    monkeypatch.setattr(
        oracle, "GpuSolver", lambda problem, settings: GpuSolver(problem, settings, make_driver=HostDriver)
    )
    rng = np.random.default_rng(3)
    states = rng.integers(0, 3, (60, assembly.part_count)).astype(np.uint8)
    states[:, assembly.boundary] = 2
    states = np.unique(states, axis=0)
    auto = Stability(assembly, StabilitySettings(solver="auto"))
    expected = Stability(assembly).check(states)
    np.testing.assert_array_equal(auto.judge(states).verdict, expected.verdict)
    assert auto.counters.gpu == len(states)
    fresh = Stability(assembly, StabilitySettings(solver="auto"))
    np.testing.assert_array_equal(fresh.judge(states[:2]).verdict, expected.verdict[:2])
    assert (fresh.counters.gpu, fresh.counters.cpu) == (0, 2)
    np.testing.assert_array_equal(fresh.check(states).verdict, expected.verdict)
    parents = np.where(assembly.boundary, 2, 1).astype(np.uint8)[None].repeat(len(states), axis=0)
    only = Stability(assembly, StabilitySettings(solver="gpu"))
    np.testing.assert_array_equal(only.stable(states, parents=parents), expected.stable)
    assert only.counters.cpu == 0


def test_oracle_without_a_gpu_says_so_or_takes_the_processor(monkeypatch):
    def missing(problem, settings):
        raise DependencyError("no torch here; pip install 'falsework[gpu]'")

    monkeypatch.setattr(oracle, "GpuSolver", missing)
    assembly = library.build("arch:blocks=5")
    state = np.where(assembly.boundary, 2, 1).astype(np.uint8)[None].repeat(9, axis=0)
    auto = Stability(assembly, StabilitySettings(solver="auto"))
    assert auto.stable(state).all()
    assert auto.counters.gpu == 0
    with pytest.raises(DependencyError, match=r"falsework\[gpu\]"):
        Stability(assembly, StabilitySettings(solver="gpu"))

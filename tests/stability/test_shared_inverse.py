"""The paper's method: its iterates against a transcription in plain numpy, and its verdicts against the exact ones."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from baselines.shared_inverse import SharedInverse, SharedInverseSettings
from numpy.typing import NDArray

from falsework import Assembly, StabilitySettings, Verdict
from falsework.assembly import complete_state, library
from falsework.errors import DependencyError, InputError, StateError
from falsework.stability import ExactSolver, Proof
from falsework.stability.verdict import Solver


@pytest.fixture
def torch() -> Iterator[Any]:
    """Torch on one thread: the matrices of these structures are too small to share out."""
    module = pytest.importorskip("torch", reason="torch is not installed")
    threads = module.get_num_threads()
    module.set_num_threads(1)
    yield module
    module.set_num_threads(threads)


def transcription(assembly: Assembly, state: NDArray[np.uint8], iterations: int, penalty: float) -> float:
    """Residual after the paper's iterations on one state, all matrices dense and written from the geometry."""
    contacts, mass, mu, bound, sigma, alpha = assembly.contacts, assembly.mass, assembly.friction, 1e5, 1e-6, 1.6
    parts, owner = assembly.part_count, assembly.contacts.contact_of_point
    count = len(contacts.points)
    columns = np.zeros((6 * parts, 9 * count))
    for c, point in enumerate(contacts.points):
        normal, first, second = contacts.frames[owner[c]]
        rays = [normal, *(np.cos(k * np.pi / 4) * first + np.sin(k * np.pi / 4) * second for k in range(8))]
        for part, sign in zip(contacts.parts[owner[c]], (-1, 1), strict=True):
            for k, ray in enumerate(rays):
                wrench = np.concatenate([sign * ray, np.cross(point - mass.center[part], sign * ray)])
                columns[6 * part : 6 * part + 6, 9 * c + k] = wrench
    inverse_mass = np.zeros((6 * parts, 6 * parts))
    for part in range(parts):
        block = np.eye(6)
        if not assembly.boundary[part]:
            block[:3, :3] /= mass.mass[part]
            block[3:, 3:] = np.linalg.inv(mass.inertia[part])
        inverse_mass[6 * part : 6 * part + 6, 6 * part : 6 * part + 6] = block
    gravity = np.zeros(6 * parts)
    gravity[2::6] = -9.81 * mass.mass
    free = np.repeat(state == 1, 6).astype(float)
    a, b = state[contacts.parts[owner]].T
    active = np.repeat((a > 0) & (b > 0) & ((a == 1) | (b == 1)), 9).astype(float)
    whole = np.hstack([columns, -np.eye(6 * parts)])
    rows = np.zeros((count, whole.shape[1]))
    for c in range(count):
        rows[c, 9 * c] = mu
        rows[c, 9 * c + 1 : 9 * c + 9] = -1
    stacked = np.vstack([rows, np.eye(whole.shape[1])])
    matrix = whole.T @ inverse_mass @ whole + sigma * np.eye(whole.shape[1]) + penalty * stacked.T @ stacked
    inverse = np.linalg.inv(matrix)
    cost = whole.T @ inverse_mass @ (free * gravity)
    low = np.concatenate([np.zeros(count), 0 * active, -bound * (1 - free)])
    high = np.concatenate([np.full(count, mu * bound), bound * active, bound * (1 - free)])
    x, z, y = np.zeros(whole.shape[1]), np.zeros(len(low)), np.zeros(len(low))
    for _ in range(iterations):
        ahead = inverse @ (sigma * x - cost + stacked.T @ (penalty * z - y))
        mixed = alpha * (stacked @ ahead) + (1 - alpha) * z
        x = alpha * ahead + (1 - alpha) * x
        new = np.clip(mixed + y / penalty, low, high)
        y, z = y + penalty * (mixed - new), new
    forces = np.clip(x, low[count:], high[count:])[: 9 * count]
    length = np.sqrt(np.linalg.norm(mass.inertia, 2, axis=(1, 2)) / mass.mass)
    share = np.stack([np.ones(parts), length], axis=1).repeat(3) / 9.81
    return float(np.abs(share * free * (inverse_mass @ (columns @ forces + gravity))).max())


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("inverse", ["dense", "reduced"])
@pytest.mark.parametrize("iterations", [1, 7, 60])
def test_its_iterates_are_the_papers(scenes: Any, inverse: Any, iterations: int) -> None:
    assembly = library.build("arch:blocks=3")
    settings = StabilitySettings(criterion="equilibrium", tolerance=1e-12)  # never met, so that all iterations are done
    method = SharedInverseSettings(inverse=inverse, iterations=iterations, check_every=4, penalty=0.3)
    states = scenes.few_changes(assembly, 4, seed=41, most=2)
    states = states[(states == 1).any(axis=1)]
    verdicts = SharedInverse(assembly, settings, method).check(states)
    expected = [transcription(assembly, state, iterations, 0.3) for state in states]
    np.testing.assert_allclose(verdicts.residual, expected, rtol=1e-6, atol=1e-9)
    assert (verdicts.iterations == iterations).all()


@pytest.mark.usefixtures("torch")
@pytest.mark.parametrize("structure", ["arch:blocks=5", "stack:blocks=4", "stack:blocks=4,overhang=1.1"])
def test_it_agrees_with_the_exact_solver_on_small_structures(scenes: Any, structure: str) -> None:
    assembly = library.build(structure)
    states = np.unique(scenes.few_changes(assembly, 8, seed=42, most=2), axis=0)
    verdicts = SharedInverse(assembly).check(states)
    np.testing.assert_array_equal(
        verdicts.verdict, ExactSolver(assembly, StabilitySettings(criterion="equilibrium")).check(states).verdict
    )
    assert (verdicts.proof == Proof.NONE).all()
    assert (verdicts.decided_by == Solver.SHARED_INVERSE).all()
    assert (verdicts.residual[verdicts.stable] <= 1e-4).all()
    assert (verdicts.residual[verdicts.unstable] > 1e-4).all()
    assert (verdicts.iterations[verdicts.unstable] == 3000).all()


@pytest.mark.usefixtures("torch")
def test_single_precision_agrees_where_it_matters(scenes: Any) -> None:
    assembly = library.build("arch:blocks=5")
    states = np.unique(scenes.few_changes(assembly, 12, seed=43, most=2), axis=0)
    method = SharedInverseSettings(iterations=1000, penalty=10.0)
    double = SharedInverse(assembly, method=method).check(states)
    single = SharedInverse(
        assembly, method=SharedInverseSettings(iterations=1000, penalty=10.0, precision="float32")
    ).check(states)
    assert (double.verdict == single.verdict).mean() > 0.8
    assert not (single.stable & double.unstable).any()


@pytest.mark.usefixtures("torch")
def test_batches_do_not_mix(scenes: Any) -> None:
    assembly = library.build("arch:blocks=5")
    states = scenes.few_changes(assembly, 9, seed=44, most=2)
    whole, single = (
        SharedInverse(assembly, method=SharedInverseSettings(iterations=400, batch=batch)).check(states)
        for batch in (9, 2)
    )
    np.testing.assert_array_equal(whole.verdict, single.verdict)
    np.testing.assert_allclose(whole.residual, single.residual, rtol=1e-6, atol=1e-9)


@pytest.mark.usefixtures("torch")
def test_what_is_not_solved_is_what_the_settings_say(scenes: Any) -> None:
    """Too few iterations for a state that stands: unstable in the paper's words, undecided in ours."""
    assembly = library.build("arch")
    complete = complete_state(assembly.boundary)
    for unsolved, verdict, solver in (
        ("unstable", Verdict.UNSTABLE, Solver.SHARED_INVERSE),
        ("undecided", Verdict.UNDECIDED, Solver.NONE),
    ):
        method = SharedInverseSettings(iterations=5, check_every=5, unsolved=unsolved)  # type: ignore[arg-type]
        verdicts = SharedInverse(assembly, method=method).check(complete)
        assert verdicts.verdict[0] == verdict
        assert verdicts.decided_by[0] == solver
        assert verdicts.proof[0] == Proof.NONE


def test_the_precision_of_others_is_left_alone(torch: Any, scenes: Any) -> None:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        tower = scenes.tower(1)
        assert SharedInverse(tower).check([1, 2]).stable[0]
        assert torch.get_float32_matmul_precision() == "high"
    finally:
        torch.set_float32_matmul_precision(before)


@pytest.mark.usefixtures("torch")
def test_an_empty_batch(scenes: Any) -> None:
    tower = scenes.tower(1)
    assert len(SharedInverse(tower).check(np.zeros((0, 2)))) == 0


@pytest.mark.usefixtures("torch")
def test_bad_input_is_named(scenes: Any) -> None:
    tower = scenes.tower(1)
    with pytest.raises(StateError, match="one value for each part"):
        SharedInverse(tower).check([1])
    with pytest.raises(InputError, match="octagon"):
        SharedInverse(tower, StabilitySettings(criterion="equilibrium", cone="quadratic"))
    with pytest.raises(InputError, match="compute on abacus"):
        SharedInverse(tower, method=SharedInverseSettings(device="abacus"))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("penalty", 0.0),
        ("force_bound", np.nan),
        ("iterations", 0),
        ("relaxation", 2.0),
        ("inverse", "sparse"),
        ("unsolved", "stable"),
        ("precision", "float16"),
    ],
)
def test_bad_settings_are_named(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=name):
        SharedInverseSettings(**{name: value})


def test_a_missing_package_is_named(scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(DependencyError, match=r"pip install falsework\[gpu\]"):
        SharedInverse(scenes.tower(1))

"""Plans where a GPU answers the verdicts: the one search, with wide beams, whose batches go to another solver."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Direction, PlannerSettings, StabilityOracle, StabilitySettings, find_plans
from falsework.assembly.library.blocks import box, gather
from falsework.errors import InputError
from falsework.search import Demands
from falsework.search.margins.demands import MarginOracle
from falsework.search.plans.plan_check import validate_plan
from falsework.stability import PressOracle, Proof
from falsework.stability import oracle as oracle_module
from falsework.stability.criteria import CRITERIA
from falsework.stability.verdict import Solver

SETTINGS = (StabilitySettings(criterion="equilibrium"), StabilitySettings(reserve=1.1))


class StandIn:
    """Solver on the processor in the place of that on a GPU, which leaves every seventh state undecided."""

    starts_from_guesses = False

    def __init__(self, assembly: Assembly, settings: StabilitySettings, problem: Any) -> None:
        self.batches: list[int] = []
        self._solver = CRITERIA[settings.criterion](assembly, problem, settings)

    def check(self, states: Any, *, certificates: bool = True, parents: Any = None, guess: Any = None) -> Any:
        self.batches.append(len(states))
        found = self._solver.check(states, certificates=certificates)
        found.verdict[::7] = 0
        found.decided_by[:] = np.where(found.undecided, Solver.NONE, Solver.GPU)
        return found


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> list[StandIn]:
    """Solvers that take the place of one on a GPU, where one is asked for."""
    made: list[StandIn] = []

    def gpu_solver(assembly: Assembly, settings: StabilitySettings, problem: Any) -> StandIn | None:
        if settings.solver != "gpu":
            return None
        made.append(StandIn(assembly, settings, problem))
        return made[-1]

    monkeypatch.setattr(oracle_module, "gpu_solver", gpu_solver)
    return made


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("stability", SETTINGS, ids=lambda settings: settings.criterion)
def test_plans_are_found_and_good(
    small_arch: Assembly, stand_ins: list[StandIn], stability: StabilitySettings, direction: Direction
) -> None:
    settings = PlannerSettings(width=16, directions=(direction,))
    found = find_plans(small_arch, robots=2, stability=stability, settings=settings, backend="cuda")
    assert found.found
    assert validate_plan(found.plans[0], small_arch, StabilitySettings(criterion=stability.criterion)).good
    (stand_in,) = stand_ins
    replayed = stability.criterion == "contact" and direction is Direction.ASSEMBLY
    assert replayed or stand_in.batches
    assert all(size >= stability.numerics.gpu_states for size in stand_in.batches)


def test_robots_press_where_a_gpu_answers_the_rest(stand_ins: list[StandIn]) -> None:
    """What slides without presses in a batch may stand with them; they are chosen on the processor."""
    plates = [box("plate", [0.2 * k, 0, 0], [0.2 * k + 0.2, 1, 1]) for k in range(3)]
    blocks = gather([*plates, box("wall", [-1, -1, -1], [0, 2, 2], fixed=True)])
    beside_wall = Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary, friction=0.5)
    states = np.array([[*some, 2] for some in product(range(3), repeat=3)], np.uint8)
    ours, gpus = (StabilityOracle(beside_wall, StabilitySettings()) for _ in range(2))
    gpus.use_gpu()
    expected, found = (PressOracle(oracle).verdicts(states) for oracle in (ours, gpus))
    np.testing.assert_array_equal(found.stable, expected.stable)
    assert (found.proof == Proof.HISTORY).any()
    assert stand_ins[0].batches == [len(states)]


@pytest.mark.usefixtures("stand_ins")
def test_what_the_search_knows_it_knows_with_a_gpu(small_arch: Assembly, tmp_path: Path) -> None:
    """Alternatives, missing parts, repeated holds, margins and checkpoints are of the one search."""
    options: dict[str, Any] = {"robots": 2, "stability": SETTINGS[0], "backend": "cuda"}
    settings = PlannerSettings(width=4, alternatives=3)
    found = find_plans(small_arch, settings=settings, checkpoint=tmp_path / "search.npz", **options)
    assert len({plan.states.tobytes() for plan in found.plans}) == 3
    late = find_plans(small_arch, missing=[4], **options).plans[0].needs[0].after_steps
    early = find_plans(small_arch, **options).plans[0]
    assert late >= int(np.argmax(early.states[:, 4] != 0)) - 1
    assert find_plans(small_arch, allow_regrasp=True, **options).found
    demanding = MarginOracle(small_arch, SETTINGS[0], Demands(friction=1.1))
    assert find_plans(small_arch, oracle=demanding, backend="cuda").found


def test_without_a_gpu_the_backend_says_so(small_arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match=r"0 CUDA devices|no CUDA device|needs cuda-bindings"):
        find_plans(small_arch, oracle=StabilityOracle(small_arch, SETTINGS[0]), backend="cuda")
    with pytest.raises(InputError, match="there is no backend 'abacus'; give cpu or cuda"):
        find_plans(small_arch, backend="abacus")  # type: ignore[arg-type]


@pytest.mark.parametrize("stability", SETTINGS, ids=lambda settings: settings.criterion)
def test_a_gpu_answers_the_verdicts_of_a_plan(small_arch: Assembly, stability: StabilitySettings) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")
    pytest.importorskip("cuda.bindings", reason="cuda-bindings is not installed: pip install 'falsework[gpu]'")
    if not torch.cuda.is_available():
        pytest.skip("this machine has no GPU")
    oracle = StabilityOracle(small_arch, stability)
    settings = PlannerSettings(width=16, directions=(Direction.DISASSEMBLY,))
    found = find_plans(small_arch, robots=2, oracle=oracle, settings=settings, backend="cuda")
    assert found.found
    assert oracle.counters.gpu > 0

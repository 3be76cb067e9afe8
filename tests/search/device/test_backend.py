"""Planners whose beams are on tensors: the same task, acceptance and result, and what they do not know is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework import (
    Assembly,
    Direction,
    Outcome,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    Task,
    find_plans,
)
from falsework.errors import InputError
from falsework.search import BeamSettings, Demands, ExhaustiveSearch
from falsework.search.backend import beams_on
from falsework.search.margins.demands import MarginOracle
from falsework.search.planner import Planner
from falsework.search.plans.plan_check import validate_plan
from falsework.stability import HoldSettings
from falsework.stability.holds import HoldMode

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")

from falsework.search.device.beam import DeviceBeam  # noqa: E402
from falsework.search.device.oracle import HostOracle  # noqa: E402

LOCKED = HoldSettings(mode=HoldMode.LOCKED)
SETTINGS = (StabilitySettings(criterion="equilibrium"), StabilitySettings(reserve=1.1, holds=LOCKED))
"""Criteria and robots that beams on tensors know."""


def on_tensors(task: Task, oracle: Any, settings: BeamSettings = BeamSettings(), *, guide: Any = None) -> DeviceBeam:
    return DeviceBeam(task, HostOracle(oracle), settings, guide=guide)


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("stability", SETTINGS, ids=lambda settings: settings.criterion)
def test_plans_are_found_and_good(small_arch: Assembly, stability: StabilitySettings, direction: Direction) -> None:
    settings = PlannerSettings(width=4, directions=(direction,))
    found = find_plans(small_arch, robots=2, stability=stability, settings=settings, backend="torch")
    assert found.found
    assert found.result.counters.asked > 0
    assert validate_plan(found.plans[0], small_arch, StabilitySettings(criterion=stability.criterion)).good
    assert (found.plans[0].replay is None) == (stability.criterion == "equilibrium")


def test_several_plans_and_missing_parts(small_arch: Assembly) -> None:
    options: dict[str, Any] = {"robots": 2, "stability": SETTINGS[0], "backend": "torch"}
    found = find_plans(small_arch, settings=PlannerSettings(width=4, alternatives=3), **options)
    assert len({plan.states.tobytes() for plan in found.plans}) == 3
    late = find_plans(small_arch, missing=[4], **options).plans[0].needs[0].after_steps
    early = find_plans(small_arch, **options).plans[0]
    assert late >= int(np.argmax(early.states[:, 4] != 0)) - 1


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("seed", range(12))
def test_as_complete_as_an_exhaustive_search(rules: Any, seed: int, direction: Direction) -> None:
    """A beam that keeps everything finds a plan if and only if there is one, and else proves that there is none."""
    oracle, _ = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), 1 + seed % 3)
    expected = ExhaustiveSearch(task, oracle).run().result
    settings = BeamSettings(width=5000, direction=direction, diversity="none", lookahead=5000)
    result = on_tensors(task, oracle, settings).run()
    assert result.outcome is expected.outcome
    narrow = Planner(task, oracle, PlannerSettings(width=2), beams=on_tensors).run()
    assert narrow.outcome in (expected.outcome, Outcome.NOT_FOUND)
    assert all(np.array_equal(route.states[[0, -1]], [task.start, task.target]) for route in narrow.routes)


@pytest.mark.parametrize("seed", range(8))
def test_states_ruled_out_are_on_no_way(rules: Any, seed: int) -> None:
    """Excluded one after the other, the states of plans are avoided, until what is left has no plan."""
    oracle, _ = rules.random(seed, 5)
    task = Task.from_rules(rules.ground(5), 2)
    settings = BeamSettings(width=5000, diversity="none", lookahead=5000)
    search, barred, plans = on_tensors(task, oracle, settings), np.empty((0, 5), np.uint8), 0
    while (result := search.run()).found:
        states = result.routes[0].states
        assert not any((states == state).all(axis=1).any() for state in barred)
        if task.steps < 2:
            break
        plans, barred = plans + 1, np.concatenate([barred, states[1:2]])
        search.forbid(states[1:2])
    assert result.outcome is not Outcome.PROVED_IMPOSSIBLE or not plans


def test_what_beams_on_tensors_do_not_know_is_refused(small_arch: Assembly) -> None:
    equilibrium: dict[str, Any] = {"stability": SETTINGS[0], "backend": "torch"}
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"backend": "torch"}, "knows no robots that press"),
        ({**equilibrium, "allow_regrasp": True}, "knows no repeated holds"),
        ({**equilibrium, "parts_at_once": 2}, "knows no steps of several parts"),
        ({**equilibrium, "checkpoint": "search.npz"}, "cannot be saved; leave out the checkpoint"),
        ({**equilibrium, "backend": "abacus"}, "there is no backend 'abacus'; give cpu, torch, cuda"),
    )
    for options, message in cases:
        with pytest.raises(InputError, match=message):
            find_plans(small_arch, robots=2, **options)
    demanding = MarginOracle(small_arch, SETTINGS[0], Demands(friction=1.1))
    with pytest.raises(InputError, match="knows no margins"):
        find_plans(small_arch, oracle=demanding, backend="torch")


def test_without_a_gpu_the_backend_says_so(small_arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="0 CUDA devices"):
        beams_on("cuda", Task.from_rules(small_arch.boundary), StabilityOracle(small_arch, SETTINGS[0]))


def test_a_search_on_tensors_is_not_saved(rules: Any, tmp_path: Any) -> None:
    planner = Planner(Task.from_rules(rules.ground(4), 1), rules.blocks(4), beams=on_tensors)
    with pytest.raises(InputError, match="a search with beams on tensors cannot be saved"):
        planner.save(tmp_path / "search.npz")


def test_a_guide_is_of_no_use_where_whole_levels_are_judged(rules: Any) -> None:
    with pytest.raises(InputError, match="no use for a guide"):
        on_tensors(Task.from_rules(rules.ground(4), 1), rules.blocks(4), guide=lambda states, legal, direction: legal)

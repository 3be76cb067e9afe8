"""Fewest robots: agreement with an exhaustive search, and answers that end in time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import (
    Assembly,
    Outcome,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    Task,
    find_plans,
    load_structure,
    make_task,
    min_robots,
)
from falsework.cli.failure import explain
from falsework.errors import InputError
from falsework.search import BeamSearch, ExhaustiveSearch
from falsework.search.min_robots import unremovable_parts
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.hold_bound import HoldBound
from falsework.stability.settings import EQUILIBRIUM


def test_an_arch_needs_two(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """One robot has nothing left to hold while it places a part, and no stone of the arch stands alone."""
    answer = min_robots(small_arch, oracle=arch_oracle)
    assert (answer.value, answer.bound, answer.proven) == (2, 2, True)
    assert answer.plan is not None
    assert answer.plan.robots == 2
    assert validate_plan(answer.plan, small_arch, arch_oracle.settings).good
    assert answer.barrier is not None
    assert answer.barrier.robots == 1
    assert set(answer.barrier.core) <= set(np.flatnonzero(~small_arch.boundary).tolist())
    assert small_arch.names[answer.barrier.core[0]] in answer.barrier.text
    census = ExhaustiveSearch(make_task(small_arch, 1), StabilityOracle(small_arch, EQUILIBRIUM)).run()
    assert census.result.outcome is Outcome.PROVED_IMPOSSIBLE


@pytest.mark.parametrize("structure", ["arch:blocks=5", "arch:blocks=7", "house", "bottle", "dome:rings=2,blocks=5"])
def test_a_core_is_only_found_where_no_plan_exists(structure: str) -> None:
    """One robot: no part of an arch stands before another is there; with enough robots no core is left."""
    assembly = load_structure(structure)
    oracle = StabilityOracle(assembly, EQUILIBRIUM)
    for robots in (1, 2, 3):
        task = make_task(assembly, robots)
        core = HoldBound(assembly, task, oracle.settings, Deadline()).core(robots)
        if core:
            assert len(core) > robots
            assert not find_plans(assembly, task, oracle=oracle).found
        else:
            assert robots > 1 or not structure.startswith("arch")


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_two_robots_cannot_close_the_top_ring(public_structure_path: Callable[[str], Path]) -> None:
    """Of the ten stones of the top ring of this dome, each falls beside another that is held, on rings that are held.

    The certificate of one such pair proves the same with any set of the stones below.
    """
    assembly = load_structure(public_structure_path("dome-90"))
    oracle = StabilityOracle(assembly)
    barrier = HoldBound(assembly, make_task(assembly), oracle.settings, Deadline()).barrier(2)
    assert barrier is not None
    assert (barrier.robots, barrier.core) == (2, tuple(range(80, 90)))
    assert barrier.to_dict()["core"] == list(barrier.core)
    assert "of the 10 parts 80, 81, 82, 83, 84 and 5 more" in barrier.text
    rng = np.random.default_rng(0)
    for _ in range(5):
        state = np.where(assembly.boundary, 2, rng.integers(0, 2, 90)).astype(np.uint8)
        state[80:] = 0
        state[rng.choice(np.arange(80, 90), 2, replace=False)] = 1, 2
        assert oracle.verdicts(state).unstable.all()


def test_a_start_in_which_parts_are_held(small_arch: Assembly) -> None:
    start = np.where(small_arch.boundary, 2, 1).astype(np.uint8)
    start[np.flatnonzero(~small_arch.boundary)[:2]] = 2
    answer = min_robots(small_arch, start=start)
    assert answer.value is not None
    assert answer.bound >= 2
    assert answer.reasons[0] == "the start or the target has more parts held"


def test_parts_that_cannot_leave_are_named_at_once(rules: Any) -> None:
    """Parts 2 and 3 block each other, and part 4 is blocked by both; part 1 leaves once 5 is gone."""
    clearance = rules.clearance([[[]], [[5]], [[3]], [[2]], [[2, 3]], [[]]])
    task = Task.from_rules(rules.ground(6), 6, clearance=clearance)
    assert unremovable_parts(task).tolist() == [2, 3, 4]
    free = Task.from_rules(rules.ground(6), 6, clearance=rules.clearance([[[]], [[5]], [[3]], [[]], [[2, 3]], [[]]]))
    assert not len(unremovable_parts(free))


def test_a_start_that_falls_has_no_number(small_arch: Assembly) -> None:
    start = np.where(small_arch.boundary, 2, 1).astype(np.uint8)
    start[np.flatnonzero(~small_arch.boundary)[1]] = 0
    answer = min_robots(small_arch, start=start)
    assert answer.value is None
    assert answer.impossible == "the start state is unstable"
    assert answer.proven
    thin = load_structure("arch:thickness=0.08")
    assert min_robots(thin).impossible == "the complete structure is unstable"


@pytest.fixture
def processor_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure deadlines by the time of the processor, so that a busy machine changes nothing."""
    monkeypatch.setattr(time, "perf_counter", time.process_time)


@pytest.mark.usefixtures("processor_time")
def test_the_deadline_ends_the_choice_among_many_plans() -> None:
    blocks = load_structure("wall:bricks=3,courses=3")
    begun = time.process_time()
    planning = find_plans(blocks, settings=PlannerSettings(alternatives=100_000), deadline=1.0)
    assert planning.deadline_passed
    assert planning.plans
    assert time.process_time() - begun < 6


@pytest.mark.parametrize("deadline", [0, -1, float("nan")])
def test_no_time(deadline: float, small_arch: Assembly) -> None:
    for ask in (min_robots, find_plans):
        with pytest.raises(InputError, match="leaves no time"):
            ask(small_arch, deadline=deadline)


def test_a_busy_machine_changes_nothing(small_arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a deadline no share of the search is measured by the clock; this one goes ten thousand times faster."""
    quiet, clock = min_robots(small_arch), time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 1e4 * clock())
    busy = min_robots(small_arch)
    assert (busy.value, busy.bound, busy.proven, busy.deadline_passed) == (2, 2, True, False)
    assert quiet.plan is not None
    assert busy.plan is not None
    np.testing.assert_array_equal(busy.plan.actions, quiet.plan.actions)


def test_the_deadline_ends_every_search() -> None:
    assembly = load_structure("vault")
    answer = min_robots(assembly, deadline=0.05)
    assert answer.deadline_passed
    assert not answer.interrupted
    assert answer.value is None
    planning = find_plans(assembly, deadline=0.05)
    assert planning.deadline_passed
    assert planning.result.interrupted
    assert not planning.plans
    with pytest.raises(DeadlineExceeded):
        HoldBound(assembly, make_task(assembly), StabilitySettings(), Deadline(1e-9)).barrier(1)


def test_an_interruption_leaves_the_best_so_far(small_arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(search: BeamSearch) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(BeamSearch, "step", interrupted)
    answer = min_robots(small_arch)
    assert answer.interrupted
    assert not answer.deadline_passed
    assert (answer.value, answer.bound) == (None, 2)  # the bound comes before the search
    assert answer.to_dict()["interrupted"]


@pytest.mark.usefixtures("processor_time")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_plan_with_too_few_robots_ends_with_the_proof(
    public_structure_path: Callable[[str], Path],
) -> None:
    """The search alone finds nothing in minutes; what the core proves ends it, and is said."""
    assembly = load_structure(public_structure_path("dome-90"))
    oracle = StabilityOracle(assembly)
    planning = find_plans(assembly, robots=2, oracle=oracle, deadline=60, settings=PlannerSettings(bound_after=0.5))
    assert planning.result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert not planning.result.interrupted
    assert not planning.deadline_passed
    assert "of the 10 parts 80, 81, 82, 83, 84 and 5 more" in planning.result.notes[0]
    failure = explain(assembly, oracle, planning.result)
    assert failure.proven
    assert planning.result.notes[0] in failure.text
    # A bound that has no time left leaves the search as it was.
    unproven = find_plans(assembly, robots=2, oracle=oracle, deadline=1, settings=PlannerSettings(bound_after=1e-9))
    assert unproven.result.outcome is Outcome.NOT_FOUND
    assert unproven.deadline_passed


def test_a_search_that_pauses_for_the_bound_finds_the_same_plan(
    small_arch: Assembly, monkeypatch: pytest.MonkeyPatch
) -> None:
    barrier, asked = HoldBound.barrier, list[int]()

    def counted(bound: HoldBound, robots: int) -> Any:
        asked.append(robots)
        return barrier(bound, robots)

    monkeypatch.setattr(HoldBound, "barrier", counted)
    usual = find_plans(small_arch)
    assert asked == []
    paused = find_plans(small_arch, settings=PlannerSettings(bound_after=0.0))
    assert asked == [2]
    assert np.array_equal(paused.plans[0].states, usual.plans[0].states)


def test_an_interruption_in_the_bound(small_arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(bound: HoldBound, robots: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(HoldBound, "barrier", interrupted)
    planning = find_plans(small_arch, settings=PlannerSettings(bound_after=0.0))
    assert planning.result.interrupted
    assert not planning.found

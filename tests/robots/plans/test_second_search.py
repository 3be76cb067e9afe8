"""A second plan from another process, and what becomes of the process."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from multiprocessing.connection import wait
from typing import Any

import pytest

pytest.importorskip("ortools", reason="schedules need OR-Tools; pip install 'falsework[schedule]'")

from falsework.assembly.model import Assembly
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.model.cell import Cell
from falsework.robots.planning.hybrid_result import HybridSettings
from falsework.robots.planning.plan_together import plan_together, second_plan
from falsework.robots.planning.second_search import SecondSearch
from falsework.search.problem.task import Direction
from falsework.stability.settings import StabilitySettings

FOR_EVER: dict[str, Any] = {"object_list": [], "timeout": 600.0}
"""Arguments with which `wait` does not return."""


@pytest.fixture(scope="module")
def row(make_boxes: Callable[..., Assembly]) -> Assembly:
    """Four cubes in a row between two arms."""
    return make_boxes((-0.45, -0.1, 0.0), (-0.2, -0.1, 0.0), (0.05, -0.1, 0.0), (0.3, -0.1, 0.0))


@pytest.fixture(scope="module")
def three(cell_of: Callable[..., Cell]) -> Cell:
    """Three arms around it."""
    return cell_of(3, 1.3)


def test_the_other_process_finds_the_plan_that_this_one_would(row: Assembly, three: Cell) -> None:
    given: dict[str, Any] = {
        "assembly": row,
        "cell": three,
        "stability": StabilitySettings(),
        "settings": HybridSettings(Direction.DISASSEMBLY, seed=7, together=True),
    }
    with SecondSearch(second_plan, given) as beside:
        here, there = second_plan(**given), beside.plan(120.0)
    assert here is not None
    assert there is not None
    assert there.makespan == here.makespan
    assert there.actions.tolist() == here.actions.tolist()


def test_the_shorter_plan_is_taken(row: Assembly, three: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = HybridSettings(Direction.DISASSEMBLY, seed=1)
    both = plan_together(row, three, settings=settings).plan
    monkeypatch.setattr(sys, "executable", "/no/such/interpreter")
    alone = plan_together(row, three, settings=settings).plan
    assert both is not None
    assert alone is not None
    assert (both.statistics["second_plan"], alone.statistics["second_plan"]) == (True, False)
    assert both.statistics["seed"] == alone.statistics["seed"] == 1
    assert both.makespan <= alone.makespan
    assert check_robot_plan(both, row, three).good


def test_a_second_plan_is_taken_where_the_first_search_finds_none(
    row: Assembly, three: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    from falsework.robots.planning.hybrid_planner import plan_robots
    from falsework.robots.planning.hybrid_result import HybridResult

    def search(*given: Any, settings: HybridSettings, **more: Any) -> HybridResult:
        limit = 1e-9 if settings.seed == 2 else settings.deadline
        return plan_robots(
            *given, settings=HybridSettings(Direction.DISASSEMBLY, seed=settings.seed, deadline=limit), **more
        )

    monkeypatch.setattr("falsework.robots.planning.plan_together.plan_robots", search)
    found = plan_together(row, three, settings=HybridSettings(Direction.DISASSEMBLY, seed=2))
    assert found.plan is not None
    assert found.plan.statistics["second_plan"]
    assert found.plan.schedule is not None


def test_a_search_that_fails_is_no_plan() -> None:
    with SecondSearch(math.sqrt, {"no": "number"}) as beside:  # type: ignore[arg-type]
        assert beside.plan(60.0) is None


def test_what_is_printed_stays_out_of_the_answer() -> None:
    with SecondSearch(os.system, {"command": "echo noise"}) as beside:  # type: ignore[arg-type]
        assert beside.plan(60) == 0


def test_the_process_ends_with_the_search_that_it_is_beside() -> None:
    beside = SecondSearch(wait, FOR_EVER)  # type: ignore[arg-type]

    def interrupted() -> None:
        with beside:
            assert beside.plan(0.0) is None
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert beside._process is not None
    assert beside._process.returncode is not None


def test_the_process_ends_where_nobody_waits_any_more() -> None:
    with SecondSearch(wait, FOR_EVER) as beside:  # type: ignore[arg-type]
        process = beside._process
        assert process is not None
        assert process.stdin is not None
        assert beside.plan(0.5) is None
        process.stdin.close()
        assert process.wait(60.0) == 1

"""Plans under clear ways: what a search may call impossible, and what it may not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from baselines.depth_first import DepthFirstSearch

from falsework import Assembly, Direction, Outcome, Task, find_plans
from falsework.geometry import TriangleMesh
from falsework.search import BeamSearch, BeamSettings, ExhaustiveSearch
from falsework.search.planner import Planner
from falsework.search.plans.plan_check import validate_plan

AXIS = np.array([0.237, 0.171, 1.0])
FACES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
         (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]  # fmt: skip


def leaning(name: str, low: tuple[float, float], high: tuple[float, float], bottom: float, top: float) -> TriangleMesh:
    """Prism over a rectangle at height zero, along the axis."""
    corners = [(x, y, 0.0) + AXIS * z for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (bottom, top)]
    return TriangleMesh.from_arrays(name, np.array(corners), FACES)


def chimney(gap: float, lid: bool = False) -> Assembly:
    """A block in a chimney that leans: seen along the axis the two do not overlap, seen from anywhere else they do."""
    inside, outside, height = 0.5 + gap, 1.0 + gap, 8.0
    meshes = [
        leaning("block", (-0.5, -0.5), (0.5, 0.5), 0.0, 1.0),
        leaning("west", (-outside, -outside), (-inside, outside), 0.0, height),
        leaning("east", (inside, -outside), (outside, outside), 0.0, height),
        leaning("south", (-inside, -outside), (inside, -inside), 0.0, height),
        leaning("north", (-inside, inside), (inside, outside), 0.0, height),
        leaning("floor", (-3, -3), (3, 3), -0.5, 0.0),
        *([leaning("lid", (-3, -3), (3, 3), height, height + 0.5)] if lid else []),
    ]
    return Assembly.from_meshes(meshes, boundary=range(1, len(meshes)), name="chimney")


def clear_task(assembly: Assembly) -> Task:
    return Task.from_rules(assembly.boundary, 1, clearance=assembly.clearance, identity=assembly.identity)


@pytest.mark.parametrize("gap", [0.0, 0.01])
def test_a_block_is_drawn_out_along_the_axis_of_its_chimney(gap: float) -> None:
    assembly = chimney(gap)
    way = assembly.clearance.exit_direction(np.ones(6, np.uint8), 0)
    assert way is not None
    assert way @ AXIS / np.linalg.norm(AXIS) > np.cos(np.radians(0.5))
    planning = find_plans(assembly, clear_task(assembly))
    assert planning.found
    assert validate_plan(planning.plans[0], assembly).good


@pytest.mark.parametrize("gap", [0.0, 0.01])
def test_under_a_lid_there_is_no_plan(gap: float) -> None:
    assembly = chimney(gap, lid=True)
    assert assembly.clearance.exact[0]
    result = find_plans(assembly, clear_task(assembly)).result
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.limit == ""


def test_what_was_only_sampled_proves_nothing(rules: Any) -> None:
    """Blocks that the known exits lock in: impossible if those are all exits, and not found if there may be more."""
    parts = 4
    oracle, locked = rules.blocks(parts), [[frozenset({0})] for _ in range(parts)]
    for complete in (True, False):
        clearance = rules.clearance(locked, complete)
        task = Task.from_rules(rules.ground(parts), 2, clearance=clearance)
        results = [
            ExhaustiveSearch(task, oracle).run().result,
            DepthFirstSearch(task, oracle).run(),
            Planner(task, oracle).run(),
            *(BeamSearch(task, oracle, BeamSettings(100, way)).run() for way in Direction),
        ]
        for result in results:
            assert result.outcome is (Outcome.PROVED_IMPOSSIBLE if complete else Outcome.NOT_FOUND)
            assert result.limit == ("" if complete else "exits may be missing")


def test_parts_that_stay_raise_no_doubt(rules: Any) -> None:
    assert Task.from_rules(rules.ground(3), 2).caveat == ""
    clearance = rules.clearance([[], [], []], False)
    assert Task.from_rules(rules.ground(3), 2, clearance=clearance).caveat == "exits may be missing"
    assert Task.from_rules(rules.ground(3), 2, fixed=(1, 2), clearance=clearance).caveat == ""

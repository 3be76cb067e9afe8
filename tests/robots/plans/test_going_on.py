"""Plans that go on from any instant: nothing is left half way, and rules and holds stay those of the plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, Direction, check, make_task, plan_robots
from falsework.assembly import HELD
from falsework.robots import Cell, HybridSettings, RobotPlan
from falsework.robots.exports.bag_view import PlacedParts
from falsework.robots.exports.mcap_bag import write_bag
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.plans.continued import continued
from falsework.robots.plans.robot_plan_file import robot_plan_from_dict, robot_plan_to_dict
from falsework.robots.plans.timeline import Interruption, interruption, schedule_of
from tests.robots.plans.bag_reading import messages
from tests.robots.plans.conftest import make_cell
from tests.robots.plans.orders import APART
from tests.robots.plans.roofed_slab import make_task as slab_task
from tests.robots.plans.roofed_slab import slab, tabled
from tests.robots.plans.test_waiting import pit
from tests.robots.plans.test_waiting import planned as planned_lid
from tests.robots.plans.test_ways import opened, tray, value


@pytest.fixture(scope="module")
def cell() -> Cell:
    return make_cell(payload=20.0)


@pytest.fixture(scope="module")
def bent(cell: Cell) -> RobotPlan:
    """A bar that comes in down and then under a lip."""
    return value(opened(tray(), cell, concurrent=False, moves=2))


def instants(plan: RobotPlan) -> list[Interruption]:
    """Where a plan stands if it is interrupted while each of its motions is under way."""
    graph = schedule_of(plan)
    times = graph.starts() + graph.durations / 2
    return [interruption(plan, float(time)) for time in times]


def gone_on(assembly: Assembly, cell: Cell, plan: RobotPlan, now: Interruption, **rules: Any) -> RobotPlan:
    """The plan from there on, as a file has it."""
    builds = plan.direction is Direction.ASSEMBLY
    start, target = (plan.states[-1], now.state) if builds else (now.state, plan.states[-1])
    task = make_task(assembly, cell.robot_count, start=start, target=target, removable_only_if_clear=True, **rules)
    settings = HybridSettings(plan.direction, attempts=4)
    now_arms = {"configurations": now.configurations, "held": now.held, "gripped": now.gripped}
    rest = value(plan_robots(assembly, cell, task=task, settings=settings, **now_arms))
    whole, falls_at = continued(rest, plan, now.done, assembly)
    assert falls_at is None
    return robot_plan_from_dict(json.loads(json.dumps(robot_plan_to_dict(whole))))


@pytest.mark.parametrize("apart", [False, True], ids=["assembly", "disassembly"])
def test_a_part_makes_all_moves_of_its_way_before_its_arm_stops(bent: RobotPlan, cell: Cell, apart: bool) -> None:
    """Between two moves it touches what it leaves, so that no other motion may begin there."""
    plan = bent.reverse() if apart else bent
    legs = [leg for _, _, leg in plan.moves()]
    lines = [leg for leg in legs if leg.kind == "line" and leg.part is not None]
    assert len(lines) == 2
    stops = [one.configurations[plan.steps[0].robot] for one in instants(plan)]
    assert not any(np.array_equal(stop, lines[0].positions[-1]) for stop in stops)
    assert any(np.array_equal(stop, lines[1].positions[-1]) for stop in stops)
    middle = next(k for k, leg in enumerate(legs) if leg is lines[0])
    whole = gone_on(tray(), cell, plan, instants(plan)[middle], moves=2)
    report = check(tray(), whole, cell)
    assert report.good or not len(whole), report.problems


@pytest.mark.parametrize("apart", [False, True], ids=["assembly", "disassembly"])
def test_a_part_that_is_put_down_is_brought_to_its_end(apart: bool) -> None:
    assembly, one = slab(), tabled(make_cell(1))
    task = slab_task(assembly, one, allow_regrasp=True)
    plan = value(plan_robots(assembly, one, task=task, settings=HybridSettings(Direction.DISASSEMBLY, attempts=3)))
    plan = plan if apart else plan.reverse()
    step = next(k for k, entry in enumerate(plan.steps) if entry.put_down is not None)
    inside = [leg.positions[-1] for leg in plan.steps[step].trajectories[:-1]]
    for now in instants(plan):
        assert not any(np.array_equal(now.configurations[0], stop) for stop in inside)
        assert now.gripped == (None,)
        assert all(part is None or now.state[part] == HELD for part in now.held)


def test_a_plan_in_which_parts_waited_goes_on_and_keeps_that_rule(cell: Cell) -> None:
    assembly = pit()
    plan = planned_lid(assembly, cell, 0)
    assert plan.plan.waiting
    now = next(one for one in instants(plan) if one.done)
    whole = gone_on(assembly, cell, plan, now)
    assert whole.plan.waiting
    report = check(assembly, whole, cell)
    assert report.states is not None
    assert report.good, (report.problems, report.states.reason)


def test_a_delivered_part_has_no_frame_at_its_place_any_more(column: Assembly, cell: Cell, tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="bags need mcap; pip install 'falsework[schedule]'")
    plan, shapes = value(plan_robots(column, cell, settings=APART)), place_parts(column, cell.placement)
    write_bag(plan, tmp_path / "plan.mcap", PlacedParts(shapes, cell))
    middles = {f"part_{mesh.name}": mesh.bounds.mean(axis=0) for mesh in shapes.meshes}
    frames = [sent for _, _, found in messages(tmp_path / "plan.mcap", "/tf") for sent in found.transforms]
    last = {sent.child_frame_id: sent.transform.translation for sent in frames}
    gone = [f"part_{column.names[part]}" for part in np.flatnonzero(plan.states[0] != plan.states[-1])]
    assert len(gone) == 3
    for name in gone:
        assert np.linalg.norm([last[name].x, last[name].y, last[name].z] - middles[name]) > 0.3

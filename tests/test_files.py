"""One function that reads every file of this package, and one that writes them."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

import falsework as fw
from falsework import make_task
from falsework.errors import InputError, PlanError
from falsework.robots import Cell, RobotPlan

CELL = resources.files("falsework.robots.cells").joinpath("bottle-12.toml")


@pytest.fixture(scope="module")
def arch() -> fw.Assembly:
    return fw.load_structure("arch:blocks=5")


@pytest.fixture(scope="module")
def plan(arch: fw.Assembly) -> fw.Plan:
    return fw.find_plans(arch, robots=2).plans[0]


def test_what_is_saved_is_loaded(arch: fw.Assembly, plan: fw.Plan, tmp_path: Path) -> None:
    fw.save(arch, tmp_path / "arch")
    again = fw.load(tmp_path / "arch", friction=0.7)
    assert isinstance(again, fw.Assembly)
    assert again.friction == 0.7
    for proofs in (False, True):
        fw.save(plan, tmp_path / "plan.json", proofs=proofs)
        read = fw.load(tmp_path / "plan.json")
        assert isinstance(read, fw.Plan)
        np.testing.assert_array_equal(read.states, plan.states)
        assert (read.displacement is not None) == proofs
    graph = fw.StateGraph.from_states(make_task(arch), plan.states, name="arch:blocks=5")
    fw.save(graph, tmp_path / "graph.npz")
    found = fw.load(tmp_path / "graph.npz")
    assert isinstance(found, fw.StateGraph)
    assert len(found) == len(graph)
    assert isinstance(fw.load("arch:blocks=5"), fw.Assembly)


def test_a_robot_plan_and_its_cell(tmp_path: Path) -> None:
    cell = fw.load_cell("bottle-12", check=False)
    stack = fw.load_structure("stack:blocks=2")
    done = fw.find_plans(stack, robots=1).plans[0]
    from falsework.robots import Keyframe, RobotStep, Trajectory
    from falsework.robots.model.cell import cell_identity
    from falsework.robots.plans.robot_plan import records_of

    frames = [Keyframe(cell.homes, (None, None))] * (len(done) + 1)
    still = np.stack([cell.homes[0]] * 2)
    motion = Trajectory("free", np.array([0.0, 1.0]), still, np.zeros_like(still), None)
    steps = [RobotStep(0, (motion,))] * len(done)
    made = RobotPlan(done, tuple(frames), tuple(steps), records_of(cell), cell.name, cell_identity(cell))
    fw.save(made, tmp_path / "robot_plan.json")
    read = fw.load(tmp_path / "robot_plan.json")
    assert isinstance(read, RobotPlan)
    assert read.direction is fw.Direction.ASSEMBLY
    (tmp_path / "cell.toml").write_text(CELL.read_text(encoding="utf-8"))
    assert isinstance(fw.load(tmp_path / "cell.toml"), Cell)


def test_what_cannot_be_saved_or_loaded(arch: fw.Assembly, plan: fw.Plan, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"SearchResult has no file; .* results of searches have theirs in plans"):
        fw.save(fw.find_plans(arch, robots=2).result, tmp_path / "plan.json")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="Assembly is saved without a choice of proofs"):
        fw.save(arch, tmp_path / "copy", proofs=True)
    bare = fw.find_plans(arch, robots=2, forces=False).plans[0]
    with pytest.raises(PlanError, match="carries no displacements"):
        fw.save(bare, tmp_path / "plan.json", proofs=True)
    with pytest.raises(InputError, match=r"has the ending of glb; a plan is a .json file"):
        fw.save(plan, tmp_path / "plan.glb")
    fw.save(plan, tmp_path / "plan.json")
    with pytest.raises(InputError, match="is no structure, and takes no density, friction"):
        fw.load(tmp_path / "plan.json", friction=0.5, density=3.0)
    with pytest.raises(InputError, match=r"no folder, file or built-in structure 'nowhere\.json'"):
        fw.load("nowhere.json")
    (tmp_path / "other.json").write_text(json.dumps({"format": "falsework.search/1"}))
    with pytest.raises(InputError, match=r"has format 'falsework\.search/1', which cannot be shown or read here"):
        fw.load(tmp_path / "other.json")
    (tmp_path / "half.json").write_text("{")
    with pytest.raises(PlanError, match="not valid JSON"):
        fw.load(tmp_path / "half.json")

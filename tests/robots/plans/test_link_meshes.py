"""The independent check uses the meshes of links, not the planner's convex pieces of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
pytest.importorskip("yourdfpy", reason="reading URDF files needs yourdfpy; pip install 'falsework[robots]'")

from falsework import Assembly
from falsework.robots import Cell, CellRobot, Gripper, Obstacle, RobotModel, RobotPlan, load_urdf
from falsework.robots.cells.urdf_meshes import hull_mesh
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.checks.pinocchio_checker import PinocchioCollisionChecker
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import block, cylinder

pytestmark = pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")

URDF = """<robot name="fork">
  <link name="base"><collision><origin xyz="0 0 0.05"/><geometry><cylinder radius="0.05" length="0.1"/></geometry>
  </collision></link>
  <link name="arm"><collision><origin xyz="0 0 0.2" rpy="0 0 1.5707963267948966"/>
    <geometry><mesh filename="fork.obj" scale="0.001 0.001 0.001"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
</robot>"""


def write_fork(folder: Path) -> Path:
    """An arm of one link, a U of 1 m by 1 m with prongs of 0.1 m, drawn in mm in the plane of x and y."""
    outline = [(0, -500), (1000, -500), (1000, -400), (100, -400), (100, 400), (1000, 400), (1000, 500), (0, 500)]
    lines = [f"v {x} {y} {z}" for z in (0, 100) for x, y in outline]
    lines += ["f " + " ".join(str(k) for k in range(8, 0, -1)), "f " + " ".join(str(k) for k in range(9, 17))]
    lines += [f"f {k + 1} {(k + 1) % 8 + 1} {(k + 1) % 8 + 9} {k + 9}" for k in range(8)]
    (folder / "fork.obj").write_text("\n".join(lines) + "\n")
    (folder / "fork.urdf").write_text(URDF)
    return folder / "fork.urdf"


@pytest.fixture
def fork(tmp_path: Path) -> RobotModel:
    return load_urdf(write_fork(tmp_path))


def meets(model: RobotModel, column: Assembly, low: tuple[float, ...], high: tuple[float, ...]) -> bool:
    """Whether an arm far from the structure meets a block, by the check."""
    base = np.eye(4)
    base[0, 3] = 20.0
    tip = np.eye(4)
    gripper = Gripper("none", "suction", (cylinder(0.01, 1.0, 1.01),), tip, 1.0, cup=0.01)
    robot = CellRobot("fork", model, base, gripper, model.home, np.zeros((0, 4, 4)))
    obstacle = Obstacle("block", (block(np.add(low, [20, 0, 0]), np.add(high, [20, 0, 0])),))
    cell = Cell("test", (robot,), (obstacle,), floor=None)
    judge = PinocchioCollisionChecker(cell, place_parts(column, cell.placement), 0.0005)
    return judge.prepare(0, [np.zeros(1)], np.zeros(column.part_count, bool)).hits(np.zeros(1)) is not None


def test_meshes_of_links_are_placed_and_scaled(fork: RobotModel) -> None:
    assert fork.meshes is not None
    (base,), (arm,) = fork.meshes
    np.testing.assert_allclose(arm.bounds, [[-0.5, 0, 0.2], [0.5, 1, 0.3]], atol=1e-12)
    assert arm.volume == pytest.approx(0.1 * (1.0 - 0.8 * 0.9))
    assert base.bounds[1, 2] == pytest.approx(0.1)
    assert base.volume == pytest.approx(np.pi * 0.05**2 * 0.1, rel=0.05)


def test_the_check_sees_between_the_prongs(fork: RobotModel, column: Assembly) -> None:
    between, prong = ((-0.2, 0.4, 0.22), (0.2, 0.8, 0.28)), ((0.42, 0.6, 0.22), (0.6, 0.7, 0.28))
    assert not meets(fork, column, *between)
    assert meets(fork, column, *prong)
    assert meets(replace(fork, meshes=None), column, *between), "the hull covers the gap"


def test_the_check_does_not_trust_the_pieces(fork: RobotModel, column: Assembly) -> None:
    """A planner whose pieces leave out a prong is found out."""
    wrong = replace(fork, pieces=(fork.pieces[0], (block((-0.5, 0, 0.2), (0.3, 1, 0.3)),)))
    assert meets(wrong, column, (0.42, 0.6, 0.22), (0.6, 0.7, 0.28))
    assert not meets(replace(wrong, meshes=None), column, (0.42, 0.6, 0.22), (0.6, 0.7, 0.28))


def test_meshes_do_not_change_the_identity_of_a_cell(cell: Cell, fork: RobotModel) -> None:
    robot = cell.robots[0]
    with_fork, without = (
        replace(cell, robots=(replace(robot, model=model),)) for model in (fork, replace(fork, meshes=None))
    )
    assert cell_identity(with_fork) == cell_identity(without)


def test_plans_are_checked_on_meshes(robot_plan: RobotPlan, column: Assembly, cell: Cell) -> None:
    """Meshes of the pieces' own shape find no more than they do; wrists six times as thick meet something."""

    def with_meshes(size: float) -> Cell:
        robots = []
        for robot in cell.robots:
            meshes = [[hull_mesh(piece) for piece in link] for link in robot.model.pieces]
            meshes[5] = [replace(mesh, vertices=size * mesh.vertices) for mesh in meshes[5]]
            robots.append(replace(robot, model=replace(robot.model, meshes=tuple(map(tuple, meshes)))))
        return replace(cell, robots=tuple(robots))

    as_pieces = check_robot_plan(robot_plan, column, cell)
    assert as_pieces.links == {"arm 1": "convex pieces", "arm 2": "convex pieces"}
    as_meshes = check_robot_plan(robot_plan, column, with_meshes(1.0))
    assert as_meshes.good, [str(problem) for problem in as_meshes.problems]
    assert as_meshes.links == {"arm 1": "meshes", "arm 2": "meshes"}
    assert as_meshes.samples == as_pieces.samples
    swollen = check_robot_plan(robot_plan, column, with_meshes(6.0))
    assert any("link_5" in problem.what for problem in swollen.problems)

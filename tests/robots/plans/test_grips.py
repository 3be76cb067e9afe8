"""Grips as the check measures them on surfaces: what the planner proposes is one, what misses the surface is none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")

from falsework import Assembly, load_structure, plan_robots
from falsework.assembly.library.blocks import box, gather
from falsework.robots import Cell, Gripper, Placement
from falsework.robots.checks.check import check_robot_plan
from falsework.robots.checks.grips import surface_fault
from falsework.robots.grasping.grasp import candidates
from falsework.robots.model.cell import cell_identity
from falsework.robots.model.part_shapes import PartShapes, place_parts
from falsework.robots.model.shapes import block, cylinder, pose
from tests.robots.plans.beam_in_turn import BEAM, bridge_with
from tests.robots.plans.orders import APART

CUBE = 0.2
TOOL = np.array(pose((0.0, 0.0, 0.1)))


def cup_of(radius: float) -> Gripper:
    return Gripper("cup", "suction", (cylinder(0.03, 0.0, 0.1),), TOOL, 50.0, cup=radius)


def jaws_of(opening: float) -> Gripper:
    fingers = tuple(block((x - 0.01, -0.01, 0.0), (x + 0.01, 0.01, 0.1)) for x in (-0.11, 0.11))
    return Gripper("jaw", "jaw", fingers, TOOL, 50.0, opening=opening, depth=0.03)


def cube() -> np.ndarray:
    """Return the triangles of a cube on the ground around the origin."""
    made = gather([box("cube", (-CUBE / 2, -CUBE / 2, 0.0), (CUBE / 2, CUBE / 2, CUBE))])
    return made.meshes[0].triangles


def from_above(x: float = 0.0, y: float = 0.0, z: float = CUBE, tilt: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """Return a tool frame that points down, tilted about x and turned about the vertical, degrees."""
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    made = np.array(pose((x, y, z), np.radians(turn)))
    made[:3, :3] = made[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ np.diag([1.0, -1.0, -1.0])
    return made


def thin_faces() -> Assembly:
    """Bars whose faces are hardly wider than a cup, a size at which buffers of outlines leave slivers."""
    size = 1 / 15
    solids = [box("bar", (-size, k * size, 0.0), (0.0, (k + 1) * size, 3 * size)) for k in range(-3, 3)]
    made = gather([*solids, box("ground", (-1.0, -1.0, -0.1), (1.0, 1.0, 0.0), fixed=True)])
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, density=500.0, name="bars")


def placed(name: str) -> tuple[Assembly, PartShapes]:
    """Return a structure in a size at which grippers fit its parts."""
    assembly = thin_faces() if name == "bars" else load_structure(name)
    size = float(np.median([np.ptp(mesh.vertices, axis=0).max() for mesh in assembly.meshes]))
    return assembly, place_parts(assembly, Placement(scale=CUBE / size), tolerance=1.0)


def test_a_plan_with_jaws_is_right(make_boxes: Callable[..., Assembly], cell_of: Callable[..., Cell]) -> None:
    """Fingers are drawn where they are open, 3.5 cm beside the part; narrower jaws do not hold it."""
    from dataclasses import replace

    assembly, plain = make_boxes((-0.1, -0.1, 0.0)), cell_of(1)
    fingers = tuple(block((x, -0.02, 0.08), (x + 0.02, 0.02, 0.179)) for x in (-0.155, 0.135))
    palm = block((-0.155, -0.03, 0.0), (0.155, 0.03, 0.08))
    tool = np.array(pose((0.0, 0.0, 0.18)))
    jaws = Gripper("jaws", "jaw", (palm, *fingers), tool, 10.0, mass=1.0, opening=0.27, depth=0.06)
    cell = replace(plain, robots=(replace(plain.robots[0], gripper=jaws),))
    plan = plan_robots(assembly, cell, settings=APART).value
    assert plan is not None
    assert check_robot_plan(plan, assembly, cell).good
    narrow = replace(cell, robots=(replace(cell.robots[0], gripper=replace(jaws, opening=0.19)),))
    said = check_robot_plan(replace(plan, cell_identity=cell_identity(narrow)), assembly, narrow).problems
    assert any("is 200.0 mm wide, the jaws open to 190.0 mm" in problem.what for problem in said)


@pytest.mark.parametrize("name", ["arch:blocks=7", "dome", "catenary", "bars"])
@pytest.mark.parametrize("gripper", [cup_of(0.01), cup_of(0.03), jaws_of(0.15)], ids=["small cup", "cup", "jaws"])
def test_what_the_planner_proposes_is_a_grip(name: str, gripper: Gripper) -> None:
    """On flat, curved and slanted faces, and near their edges."""
    assembly, parts = placed(name)
    tried = 0
    for part in np.flatnonzero(~parts.boundary).tolist()[:6]:
        for grasp in candidates(assembly, parts, part, gripper)[::16]:
            tried += 1
            assert surface_fault(gripper, grasp.tool, parts.meshes[part].triangles, "it") == ""
    assert tried > 3


def test_no_grasp_reaches_through_another_side_of_the_part(cell_of: Callable[..., Cell]) -> None:
    """Between the sides of a channel there is less room than the gripper is long."""
    assembly, gripper = bridge_with(), cell_of(1).robots[0].gripper
    found = candidates(assembly, place_parts(assembly), BEAM, gripper)
    sides = [abs(float(grasp.tool[1, 3])) for grasp in found if abs(grasp.approach[1]) > 0.9]
    assert sides
    assert min(sides) > 0.1


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ({}, ""),
        ({"z": CUBE + 0.004}, ""),
        ({"tilt": 10.0}, ""),
        ({"x": 0.079}, ""),
        ({"z": CUBE + 0.006}, "the cup is 6.0 mm away from it"),
        ({"z": CUBE - 0.002}, "the cup is 2.0 mm deep in it"),
        ({"tilt": 20.0}, "the cup is tilted by 20 degrees to the face of it"),
        ({"x": 0.081}, "the cup is not wholly on a face of it"),
        ({"x": 0.2}, "the cup is not wholly on a face of it"),
    ],
)
def test_a_cup_is_flat_on_a_face(where: dict[str, float], message: str) -> None:
    """Of 2 cm radius on a cube of 20 cm, whose face ends 10 cm from its middle."""
    assert surface_fault(cup_of(0.02), from_above(**where), cube(), "it") == message


def test_a_cup_over_a_groove_is_not_on_a_face() -> None:
    across = ((-0.1, -0.005, CUBE), (-0.005, 0.005, CUBE - 0.012), (0.005, 0.1, CUBE))
    made = gather([box("it", (low, -0.1, 0.0), (high, 0.1, top)) for low, high, top in across])
    groove = np.concatenate([mesh.triangles for mesh in made.meshes])
    assert "the surface is uneven by" in surface_fault(cup_of(0.02), from_above(), groove, "it")


@pytest.mark.parametrize(
    ("opening", "where", "message"),
    [
        (0.21, {"z": CUBE - 0.03}, ""),
        (0.19, {"z": CUBE - 0.03}, "it is 200.0 mm wide, the jaws open to 190.0 mm"),
        (0.21, {"z": CUBE - 0.03, "x": 0.02}, "it is 200.0 mm wide, the jaws open to 210.0 mm"),
        (0.40, {"z": CUBE - 0.03, "turn": 20.0}, "the jaws do not close flat on it"),
        (0.21, {"z": CUBE + 0.001}, "it is not between the jaws"),
        (0.21, {"z": CUBE - 0.005}, "it is not between the jaws"),
    ],
)
def test_jaws_close_on_two_faces(opening: float, where: dict[str, float], message: str) -> None:
    """Along at least a third of their contact length of 3 cm, and not beside the middle by more than 5 mm."""
    assert surface_fault(jaws_of(opening), from_above(**where), cube(), "it") == message

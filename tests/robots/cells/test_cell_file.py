"""Cell files: the built-in cells load, and every wrong input is reported with its place."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from falsework import load_cell, load_structure
from falsework.errors import CellError, InputError
from falsework.robots import Cell, CellRobot, Gripper, builtin_cells, check_cell, load_urdf
from falsework.robots.cells import cell_file
from falsework.robots.cells.cell_file import parse_cell
from falsework.robots.cells.cell_model import cell_schema
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.model.shapes import block, pose
from tests.robots.cells.cell_texts import ONE_ARM as GOOD

pytestmark = pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")


def read(text: str) -> Cell:
    return parse_cell(text, "cell.toml", Path())


def test_a_cell_file_is_read() -> None:
    """Degrees become radians, places are seen from the base, eight turns each."""
    cell = read(GOOD)
    robot = cell.robots[0]
    np.testing.assert_allclose(robot.base, pose((0, 0, 0), np.pi / 2), atol=1e-12)
    np.testing.assert_allclose(robot.home, np.radians([0, -40, 30, 0, 60, 0]))
    np.testing.assert_allclose(robot.gripper.tool[:3, 0], [0, 1, 0], atol=1e-12)
    assert robot.places.shape == (8, 4, 4)
    np.testing.assert_allclose(robot.places[:, :3, 3], np.tile([0.9, 0.1, 0.5], (8, 1)), atol=1e-12)
    np.testing.assert_allclose(robot.places[:, :3, 2], np.tile([0, 0, -1], (8, 1)), atol=1e-12)
    assert robot.payload == 5.0
    assert (cell.placement.scale, cell.margins.free, cell.margins.line, cell.floor) == (0.5, 0.004, 0.001, 0.0)
    np.testing.assert_allclose(cell.obstacles[0].pieces[0].min(axis=0), [1.7, -0.3, 0.0])


@pytest.mark.parametrize("name", builtin_cells())
def test_built_in_cells_can_work(name: str, shared_assembly) -> None:
    """Also with their structure: nobody stands in a part, somebody carries every part."""
    cell = load_cell(name)
    structure = {"vault-62-a": "vault-62", "vault-62-b": "vault-62"}.get(name, name)
    assembly = load_structure(str(shared_assembly(structure)))
    parts = place_parts(assembly, cell.placement, tolerance=1.0)
    check_cell(cell, parts)
    assert cell.robot_count == {"dome-37": 2, "vault-62-a": 3, "vault-62-b": 3, "bottle-12": 2, "dome-72": 4}[name]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('model = "irb2600-12/1.65"', 'model = "kr16"'), r"robots\[0\]\.model is 'kr16'.*crb15000-5/0.95"),
        (('model = "irb2600-12/1.65"', 'model = "gone.urdf"'), r"robots\[0\]\.model: no robot description gone.urdf"),
        (('gripper = "cup"', 'gripper = "claw"'), r"robots\[0\]\.gripper is 'claw'.*there are: cup"),
        (('gripper = "cup"\n', ""), r"cell\.toml: robots\[0\]\.gripper is missing"),
        (("home = [0, -40, 30, 0, 60, 0]", "home = { joint_9 = 3 }"), r"home names joint 'joint_9'.*it has joint_1"),
        (
            ("home = [0, -40, 30, 0, 60, 0]", "home = [0, -40]"),
            r"\[0\]\.home has 2 values, but irb2600.* has 6 joints: joint_1,",
        ),
        (
            ("home = [0, -40, 30, 0, 60, 0]", "home = [0, 170, 0, 0, 0, 0]"),
            r"home cannot be reached: joint_2 is 170 degrees, outside its limits -95 to 155",
        ),
        (("cup = 0.02\n", ""), r"grippers\.cup\.cup is missing"),
        (("cup = 0.02\n", "cup = 1e300\n"), r"grippers\.cup\.cup is 1e\+300; give a number <= 100"),
        (("scale = 0.5", "scale = 1e300"), r"structure\.scale is 1e\+300; give a number <= 1000000"),
        (
            ('gripper = "cup"\n', 'gripper = "cup"\nacceleration = [1e-300, 1, 1, 1, 1, 1]\n'),
            r"robots\[0\]: the acceleration of joint_1 is 1e-300; give at least 0\.01, in degrees \(or m\) per s2",
        ),
        (('kind = "suction"', 'kind = "magnet"'), r"grippers\.cup\.kind is 'magnet'; give one of suction, jaw"),
        (
            ("payload = 5.0", "payload = -1"),
            r"grippers\.cup\.payload is -1; give a number >= 0 \(largest mass that it lifts, kg\)",
        ),
        (("payload = 5.0", "payload = 5.0\nmoment = 0"), r"grippers\.cup\.moment is 0; give a number > 0"),
        (("payload = 5.0", 'payload = "five"'), r"grippers\.cup\.payload is 'five'; give a number"),
        (("scale = 0.5", "scael = 0.5"), r"structure\.scael is not known; did you mean scale\?"),
        (("free = 0.004", "free = 0.0"), r"margins\.free is 0.0; give a number >= 0.0005"),
        (("high = [0.3, 0.3, 0.4]", "high = [0.3, -0.4, 0.4]"), r"obstacles\[0\]\.box\.high .*above that of low"),
        (
            ("position = [0.9, 0.0, 0.0]", "position = [0.9, 0.0]"),
            r"structure\.position is .*; give a list of length >= 3",
        ),
        (("falsework.cell/1", "falsework.cell/9"), r"format is 'falsework.cell/9'; this version reads"),
        (('name = "one arm"', "name = "), r"cell file cell\.toml is not valid TOML: .*line 3"),
    ],
)
def test_wrong_files_say_file_and_key(change: tuple[str, str], message: str) -> None:
    """One line each, with the file, the key and what to write instead."""
    assert change[0] in GOOD
    with pytest.raises(CellError, match=message) as caught:
        read(GOOD.replace(*change))
    assert "cell.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cell_needs_robots_and_names() -> None:
    """No robot at all; two of the same name; a name that is no cell; a file that is not there."""
    with pytest.raises(CellError, match=r"robots is missing; write each robot as \[\[robots\]\]"):
        read('name = "empty"')
    with pytest.raises(CellError, match=r"cell\.toml is not a cell: it has none of the entries format, name"):
        read("[project]")
    robot = GOOD[GOOD.index("[[robots]]") : GOOD.index("[[obstacles]]")]
    with pytest.raises(CellError, match="two robots are called 'arm'"):
        read(GOOD + robot)
    with pytest.raises(CellError, match="unknown cell dome; give a TOML file, or one of the built-in cells bottle-12"):
        load_cell("dome")
    with pytest.raises(InputError, match=r"there is no cell file nowhere\.toml; `falsework cell new` writes one"):
        load_cell("nowhere.toml")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("position = [2.0, 0.0, 0.0]", "position = [0.1, 0.0, 0.0]"), "base of robot arm is inside obstacle table"),
        (("base = { position = [0.0, 0.0, 0.0]", "base = { position = [0.0, 0.0, -0.2]"), "below the floor"),
        (
            ("radius = 0.03, low = 0.0", "radius = 0.4, low = -0.3"),
            "arm at home: its tool collides with its own arm",
        ),
        (("position = [2.0, 0.0, 0.0]", "position = [0.0, 0.9, 0.8]"), "robot arm at home is too near: .*table"),
    ],
)
def test_cells_that_cannot_work_are_refused(change: tuple[str, str], message: str) -> None:
    """Before any plan is tried."""
    assert change[0] in GOOD
    check_cell(read(GOOD))
    with pytest.raises(CellError, match=message):
        check_cell(read(GOOD.replace(*change)))


def test_parts_that_are_too_heavy_or_in_the_way_are_named() -> None:
    """With the payload, and what to change."""
    assembly = load_structure("arch")
    cell = read(GOOD.replace("scale = 0.5", "scale = 0.5\ndensity = 1e5"))
    with pytest.raises(CellError, match=r"weighs .* kg and the payload of arm is 5 kg; use a stronger arm"):
        check_cell(cell, place_parts(assembly, cell.placement))
    here = read(GOOD.replace("position = [0.9, 0.0, 0.0]", "position = [0.0, 0.0, 0.0]"))
    with pytest.raises(CellError, match=r"base of robot arm is inside part|at home is too near"):
        check_cell(here, place_parts(assembly, here.placement))


def test_the_weaker_of_arm_and_gripper_counts(cup: Gripper) -> None:
    """An arm of 12 kg that carries a gripper of 1 kg lifts 10 kg, if the gripper holds no more."""
    from falsework.robots.model.builtin_robots import builtin_robot

    model = builtin_robot("irb2600-12/1.65")
    assert CellRobot("a", model, np.eye(4), cup, model.home, np.zeros((0, 4, 4))).payload == 10.0
    strong = Gripper("g", "suction", (block((0, 0, 0), (1, 1, 1)),), np.eye(4), payload=50.0, mass=2.0)
    assert CellRobot("a", model, np.eye(4), strong, model.home, np.zeros((0, 4, 4))).payload == 10.0


URDF = """<robot name="two">
<link name="base"/>
<link name="one"><collision><geometry><box size="0.1 0.1 0.4"/></geometry><origin xyz="0 0 0.2"/></collision></link>
<link name="two"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="2" effort="1"/></joint>
<joint name="slide" type="prismatic"><parent link="one"/><child link="two"/><origin xyz="0 0 0.4"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.3" velocity="1" effort="1"/></joint>
</robot>"""


def test_sliding_joints_and_plain_shapes_are_read(tmp_path: Path) -> None:
    """A turning and a sliding joint; pieces cover box and ball; the links touch at the joint and are not checked."""
    pytest.importorskip("yourdfpy")
    file = tmp_path / "two.urdf"
    file.write_text(URDF)
    model = load_urdf(file)
    assert model.joint_names == ("turn", "slide")
    assert model.prismatic.tolist() == [False, True]
    assert (1, 2) in model.ignored
    from falsework.robots.kinematics.forward import flange_pose

    np.testing.assert_allclose(flange_pose(model, [np.pi / 2 * 0, 0.2])[:3, 3], [0, 0, 0.6], atol=1e-12)
    radius = np.linalg.norm(model.pieces[2][0], axis=1)
    assert 0.1 < radius.max() < 0.13


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((' velocity="2"', ""), "joint turn has no velocity limit"),
        (('lower="-1" upper="1"', 'lower="1" upper="1"'), "joint turn has no range"),
        (('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>'), "joint turn has axis"),
        (('type="prismatic"', 'type="planar"'), "joint slide is planar"),
        (("<robot", "<<robot"), "is not a readable URDF"),
        (('<box size="0.1 0.1 0.4"/>', '<mesh filename="gone.stl"/>'), "mesh gone.stl does not exist"),
    ],
)
def test_wrong_descriptions_name_file_and_joint(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    """One line, whatever the reader below says."""
    pytest.importorskip("yourdfpy")
    file = tmp_path / "two.urdf"
    assert change[0] in URDF
    file.write_text(URDF.replace(*change))
    with pytest.raises(CellError, match=message) as caught:
        load_urdf(file)
    assert "two.urdf" in str(caught.value)
    file.write_text(URDF)
    with pytest.raises(CellError, match="no link 'hand' for the tip; there are base, one, two"):
        load_urdf(file, tip="hand")


@pytest.mark.parametrize("name", builtin_cells())
def test_cells_follow_their_schema(name: str) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    text = (Path(cell_file.__file__).parent / f"{name}.toml").read_text()
    jsonschema.validate(tomllib.loads(text), cell_schema())
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(tomllib.loads(text.replace("payload", "paylaod")), cell_schema())


@pytest.mark.parametrize("rpy", [[0, 0, 40], [180, 0, 0], [0, 180, 30], [90, 0, 20], [10, -70, 30]])
def test_tools_point_down_at_places_however_an_arm_is_mounted(rpy: list[float]) -> None:
    """On a ceiling and on a wall, too; the place itself is in the frame of the base."""
    tilted = GOOD.replace(
        "base = { position = [0.0, 0.0, 0.0], yaw = 90 }", f"base = {{ position = [0, 0, 3], rpy = {rpy} }}"
    )
    (robot,) = read(tilted).robots
    np.testing.assert_allclose(robot.places[:, :3, 2], [[0, 0, -1]] * len(robot.places), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(robot.places[:, :3, :3]), 1.0)
    np.testing.assert_allclose(robot.places[:, :3, 3], [robot.base[:3] @ [0.1, -0.9, 0.5, 1.0]] * len(robot.places))
    angles = np.sort(np.arctan2(robot.places[:, 1, 0], robot.places[:, 0, 0]))
    np.testing.assert_allclose(np.diff(angles), 2 * np.pi / len(angles), atol=1e-9)

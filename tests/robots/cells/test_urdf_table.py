"""The table of what a URDF file can state: each row is used, named in a warning, or refused by name."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("yourdfpy", reason="reading URDF files needs yourdfpy; pip install 'falsework[robots]'")

from falsework.errors import CellError
from falsework.robots import CellWarning, RobotModel, load_urdf
from falsework.robots.cells.cell_file import parse_cell
from falsework.robots.cells.visuals import link_visuals
from falsework.robots.kinematics.forward import flange_pose
from tests.robots.cells.arm_description import urdf_text
from tests.robots.cells.cell_texts import TWO_JOINTS as CELL

PAGE = Path(__file__).resolve().parents[3] / "docs" / "cells.md"
TABLE = PAGE.read_text(encoding="utf-8").partition("## URDF files")[2]
ROWS = re.findall(r"^\| ([^|]+?) \| (uses|warns|refuses|does not need)[^|]*\|", TABLE, re.MULTILINE)

BOX = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
TURN = '<limit lower="-1" upper="1" velocity="2"/>'
MESH = '<sphere radius="0.05"/>'
END = "</robot>"
GREY = '<material name="grey"/>'


def finger(extra: str = "", shape: str = BOX) -> str:
    """Return a joint beside the arm with a link."""
    return (
        f'<link name="finger">{shape}</link><joint name="open" type="prismatic"><parent link="two"/>'
        f'<child link="finger"/><axis xyz="1 0 0"/><limit lower="0" upper="0.1" velocity="1"/>{extra}</joint>'
    )


@dataclass(frozen=True)
class Case:
    """A change of the description, and what becomes of it."""

    changes: tuple[tuple[str, str], ...] = ()
    said: str = ""
    """Pattern of the warning or the error."""
    holds: Callable[[RobotModel], bool] = lambda model: True
    """What is true of the arm that is read."""
    srdf: str = ""
    limits: str = ""


def changed(old: str, new: str, said: str = "", **more: object) -> Case:
    return Case(((old, new),), said, **more)  # type: ignore[arg-type]


def low_of(link: int) -> Callable[[RobotModel], np.ndarray]:
    return lambda model: model.meshes[link][0].bounds[0]  # type: ignore[index]


def write_meshes(folder: Path) -> None:
    """Write a wedge of 1, 2 and 3 m along x, y and z from the origin, as OBJ and as COLLADA in millimetres."""
    corners = [(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)]
    faces = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    text += "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces)
    (folder / "wedge.obj").write_text(text)
    (folder / "wedge.zip").write_bytes(b"PK\5\6" + bytes(18))
    (folder / "parts").mkdir(exist_ok=True)
    (folder / "parts" / "wedge.obj").write_text(text)
    flat = " ".join(str(1000 * value) for corner in corners for value in corner)
    (folder / "wedge.dae").write_text(
        '<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        '<asset><unit name="millimeter" meter="0.001"/><up_axis>Z_UP</up_axis></asset><library_geometries>'
        '<geometry id="g"><mesh><source id="p"><float_array id="a" count="12">'
        f'{flat}</float_array><technique_common><accessor source="#a" count="4" stride="3">'
        '<param name="X" type="float"/>'
        '<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>'
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="4">'
        f'<input semantic="VERTEX" source="#v" offset="0"/><p>{" ".join(str(k) for f in faces for k in f)}</p>'
        '</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">'
        '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def is_outward(model: RobotModel) -> bool:
    """Whether the mesh of the last link encloses a positive volume."""
    corners = model.meshes[2][0].triangles  # type: ignore[index]
    return bool(np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0)


CASES = {
    "fixed joint": Case(holds=lambda m: bool(np.allclose(flange_pose(m, [0, 0])[:3, 3], [0, 0, 0.45]))),
    "revolute joint": Case(
        holds=lambda m: bool(np.allclose(flange_pose(m, [1, 0])[:3, 3], 0.45 * np.array([np.sin(1), 0, np.cos(1)])))
    ),
    "prismatic joint": Case(
        holds=lambda m: (
            m.prismatic.tolist() == [False, True] and bool(np.allclose(flange_pose(m, [0, 0.2])[:3, 3], [0, 0, 0.65]))
        )
    ),
    "continuous joint": changed(
        'type="revolute"', 'type="continuous"', "continuous joints.*: turn", holds=lambda m: m.upper[0] > 6.28
    ),
    "planar joint in the arm": changed('type="revolute"', 'type="planar"', "joint turn is planar"),
    "floating joint in the arm": changed('type="revolute"', 'type="floating"', "joint turn is floating"),
    "mimic joint in the arm": changed(
        'velocity="1"/>', 'velocity="1"/><mimic joint="turn" multiplier="-1"/>', "joint slide follows joint turn"
    ),
    "fingers: links that move against each other with fewer joints than the arm has before them": Case(
        (
            ("tool0", "hand"),
            (
                END,
                (
                    finger()
                    + finger('<mimic joint="open"/>').replace('"finger"', '"thumb"').replace('"open" t', '"opposite" t')
                ).replace('link="two"', 'link="hand"')
                + END,
            ),
        ),
        r"fixed at zero: open, opposite",
        holds=lambda m: m.joint_names == ("turn", "slide") and len(m.pieces[2]) == 3,
    ),
    "mimic joint beside the arm that follows it, with shapes": changed(
        END, finger('<mimic joint="slide"/>') + END, "joint open beside the arm follows joint slide"
    ),
    "mimic joint beside the arm that follows it through another one": changed(
        END,
        finger('<mimic joint="slide"/>', "")
        + finger('<mimic joint="open"/>').replace('"finger"', '"thumb"').replace('name="open"', 'name="also"')
        + END,
        "joint also beside the arm follows joint slide of the arm",
    ),
    "mimic joint beside the arm with an offset, with shapes": changed(
        END,
        finger()
        + finger('<mimic joint="open" offset="0.1"/>')
        .replace('"finger"', '"thumb"')
        .replace('name="open"', 'name="also"')
        + END,
        r"joint also beside the arm follows joint open \(mimic\) with an offset of 0.1",
    ),
    "moving joint beside the arm": changed(END, finger() + END, "fixed at zero: open"),
    "limits missing": changed(TURN, "", "joint turn has no velocity limit"),
    "limits without velocity": changed(TURN, '<limit lower="-1" upper="1"/>', "joint turn has no velocity limit"),
    "limits reversed": changed(TURN, '<limit lower="1" upper="-1" velocity="2"/>', "joint turn has no range"),
    "limits that are not finite": changed(TURN, '<limit lower="-1" upper="inf" velocity="2"/>', "turn has no range"),
    "limits beyond two full turns": changed(
        TURN, '<limit lower="-180" upper="180" velocity="2"/>', "has radians: turn", holds=lambda m: m.upper[0] == 180
    ),
    "soft limits reversed": changed(
        TURN,
        TURN + '<safety_controller k_velocity="1" soft_lower_limit="0.7" soft_upper_limit="-0.5"/>',
        "soft limits of joint turn leave it no range",
    ),
    "one soft limit": changed(
        TURN,
        TURN + '<safety_controller k_velocity="1" soft_lower_limit="-0.5"/>',
        holds=lambda m: (m.lower[0], m.upper[0]) == (-0.5, 0.0),
    ),
    "soft limits of a safety controller": changed(
        TURN,
        TURN + '<safety_controller k_velocity="1" soft_lower_limit="-0.5" soft_upper_limit="0.7"/>',
        holds=lambda m: (m.lower[0], m.upper[0]) == (-0.5, 0.7),
    ),
    "soft limits outside the limits": changed(
        TURN,
        TURN + '<safety_controller k_velocity="1" soft_lower_limit="2" soft_upper_limit="3"/>',
        "soft limits of joint turn",
    ),
    "axis of length zero": changed('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "joint turn has axis"),
    "several collision shapes of a link": changed(
        MESH + "</geometry></collision>",
        MESH + "</geometry></collision>" + BOX,
        holds=lambda m: [len(pieces) for pieces in m.pieces] == [1, 1, 2],
    ),
    "box, cylinder, sphere and mesh": changed(
        MESH + "</geometry></collision>",
        MESH
        + "</geometry></collision>"
        + BOX
        + '<collision><geometry><cylinder radius="0.1" length="1"/></geometry></collision>'
        + '<collision><geometry><mesh filename="wedge.obj"/></geometry></collision>',
        holds=lambda m: len(m.pieces[2]) == 4 and np.allclose(m.pieces[2][3].max(axis=0), [1, 2, 3]),
    ),
    "other shape, such as a capsule": changed(MESH, '<capsule radius="0.1" length="1"/>', "of link two is capsule"),
    "collision without a shape": changed(MESH, "", "of link two is nothing"),
    "mesh with a scale": changed(
        MESH, '<mesh filename="wedge.obj" scale="0.1 0.1 0.2"/>', holds=lambda m: np.isclose(m.pieces[2][0].max(), 0.6)
    ),
    "mesh with a mirroring scale": changed(
        MESH,
        '<mesh filename="wedge.obj" scale="1 -1 1"/>',
        holds=lambda m: low_of(2)(m)[1] == -2 and is_outward(m),
    ),
    "mesh with a scale of zero": changed(MESH, '<mesh filename="wedge.obj" scale="1 0 1"/>', "has scale"),
    "mesh in another format, such as a packed one": changed(
        MESH, '<mesh filename="wedge.zip"/>', r"mesh wedge\.zip is no \.stl, \.obj"
    ),
    "COLLADA mesh with another unit": changed(
        MESH, '<mesh filename="wedge.dae"/>', holds=lambda m: np.allclose(m.pieces[2][0].max(axis=0), [1, 2, 3])
    ),
    "mesh that does not exist": changed(MESH, '<mesh filename="gone.stl"/>', "mesh gone.stl does not exist"),
    "mesh in a package": changed(
        MESH, '<mesh filename="package://arm/parts/wedge.obj"/>', holds=lambda m: m.pieces[2][0].max() == 3
    ),
    "link with visual shapes only": changed(
        '<link name="two"><collision>' + "<geometry>" + MESH + "</geometry></collision>",
        f'<link name="two"><visual><geometry>{MESH}</geometry></visual>',
        "visual shapes: two",
        holds=lambda m: len(m.pieces[2]) == 1,
    ),
    "link without shapes": changed(
        f'<link name="two"><collision><geometry>{MESH}</geometry></collision>',
        '<link name="two">',
        "links that have no shapes: two",
    ),
    "link above the base": changed(
        END,
        f'<link name="pedestal">{BOX}</link><joint name="stand" type="fixed"><parent link="pedestal"/>'
        f'<child link="base"/></joint>{END}',
        "not below base are left out: pedestal",
    ),
    "inertial": changed('<link name="two">', '<link name="two"><inertial/>', r"not used: inertial \(1\)"),
    "dynamics": changed(TURN, TURN + '<dynamics damping="1"/>', r"not used: dynamics \(1\)"),
    "calibration": changed(TURN, TURN + '<calibration rising="1"/>', r"not used: calibration \(1\)"),
    "effort": changed(TURN, TURN.replace("/>", ' effort="9"/>'), r"not used: effort \(1\)"),
    "transmission": changed(END, f'<transmission name="t"/>{END}', r"not used: transmission \(1\)"),
    "gazebo or other entry": changed(END, f"<gazebo/><sensor/>{END}", r"not used: gazebo \(1\), sensor \(1\)"),
    "xacro macros": changed(
        '<robot name="two">',
        '<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="a"/>',
        "has macros.*expand them first",
    ),
    "two links of one name": changed(END, f'<link name="two"/>{END}', "two links are called 'two'"),
    "two joints of one name": changed('name="slide"', 'name="turn"', "two joints are called 'turn'"),
    "link that is the child of two joints": changed(
        END,
        f'<joint name="again" type="fixed"><parent link="base"/><child link="two"/></joint>{END}',
        "link two is the child of joints slide and again",
    ),
    "joint between unknown links": changed('<parent link="one"/>', '<parent link="none"/>', "parent of joint slide"),
    "several links without a parent": changed(END, f'<link name="table"/>{END}', "base, table may be the base"),
    "links that are below each other": changed(
        END,
        '<link name="a"/><link name="b"/>'
        '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
        f'<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint>{END}',
        "links are below each other: a, b",
    ),
    "entry that a joint or a shape has twice": changed(TURN, TURN + TURN, "joint turn has two entries <limit>"),
    "places and sizes that are no numbers, or sizes not above zero": changed(
        MESH, '<sphere radius="-0.05"/>', "shape of link two has radius='-0.05' in <sphere>; give a number above zero"
    ),
    "no link called tool0 or flange": Case(
        (('<link name="tool0"/>', '<link name="hand"/>'), ('<child link="tool0"/>', '<child link="hand"/>')),
        "end of the longest chain before fingers: hand",
    ),
    "accelerations": Case((), "robot arm has no acceleration"),
    "pairs in an SRDF": Case(
        srdf='<robot><disable_collisions link1="base" link2="two"/></robot>', holds=lambda m: (0, 2) in m.ignored
    ),
    "pairs of unknown links in an SRDF": Case(
        (), "there are no links hand", srdf='<robot><disable_collisions link1="base" link2="hand"/></robot>'
    ),
    "pairs of some links of a body in an SRDF": Case(
        (('<link name="tool0"/>', f'<link name="tool0">{BOX}</link>'),),
        "they stay checked: base and two",
        holds=lambda m: (0, 2) not in m.ignored,
        srdf='<robot><disable_collisions link1="base" link2="two"/></robot>',
    ),
    "pairs that an SRDF excludes and enables again": Case(
        srdf='<robot><disable_collisions link1="base" link2="two"/>'
        '<enable_collisions link1="two" link2="base"/></robot>',
        holds=lambda m: (0, 2) not in m.ignored,
    ),
    "no SRDF": changed(
        "<collision><geometry>" + MESH,
        '<collision><origin xyz="0 0 -0.5"/><geometry><box size="1 1 1"/>',
        "not checked against each other: base and two",
    ),
    "visual shapes beside collision shapes": changed(
        '<link name="two">',
        '<link name="two"><visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual>',
        holds=lambda m: (
            np.allclose(np.ptp(link_visuals(m)[2][0].vertices, axis=0), [0.3, 0.2, 0.1]) and m.pieces[2][0].max() < 0.1
        ),
    ),
    "material": Case(
        (
            ('<link name="two">', f'<link name="two"><visual><geometry>{MESH}</geometry>{GREY}</visual>'),
            (END, f'<material name="grey"><color rgba="0.5 0.5 0.25 1"/></material>{END}'),
        ),
        holds=lambda m: link_visuals(m)[2][0].color == (0.5, 0.5, 0.25),
    ),
    "acceleration that Drake adds to limits": Case(
        (
            (TURN, TURN.replace("/>", ' drake:acceleration="3"/>')),
            (' velocity="1"', ' velocity="1" drake:acceleration="2"'),
        ),
        holds=lambda m: m.acceleration.tolist() == [3, 2] and m.assumed == (),
    ),
    "prefix that is not declared": changed(
        '<link name="one">', '<link name="one" drake:role="arm">', holds=lambda m: m.joints == 2
    ),
    "limits in a joint_limits.yaml": Case(
        limits="joint_limits: {turn: {has_acceleration_limits: true, max_acceleration: 3.0}}",
        holds=lambda m: m.acceleration[0] == 3.0,
    ),
    "other entries of a joint_limits.yaml": Case(
        said=r"not used: jerk limits, default_velocity_scaling_factor",
        limits="default_velocity_scaling_factor: 0.1\njoint_limits: {turn: {has_jerk_limits: true, max_jerk: 3.0}}",
    ),
    "state `home` in an SRDF": Case(
        srdf='<robot><group_state name="home" group="arm"><joint name="turn" value="0.5"/>'
        '<joint name="slide" value="0.1"/></group_state></robot>',
        holds=lambda m: m.home.tolist() == [0.5, 0.1],
    ),
    "state in an SRDF without a value for every joint": Case(
        said="state ready has no value for slide",
        srdf='<robot><group_state name="ready" group="arm"><joint name="turn" value="0.5"/></group_state></robot>',
    ),
}


def written(folder: Path, case: Case) -> Path:
    text = urdf_text()
    for old, new in case.changes:
        assert old in text
        text = text.replace(old, new)
    write_meshes(folder)
    file = folder / "arm.urdf"
    file.write_text(text)
    if case.srdf:
        file.with_suffix(".srdf").write_text(case.srdf)
    if case.limits:
        (folder / "joint_limits.yaml").write_text(case.limits)
    return file


def test_the_page_has_every_case() -> None:
    assert sorted(name for name, _ in ROWS) == sorted(CASES)


@pytest.mark.parametrize(("row", "does"), ROWS)
def test_a_row_of_the_table(tmp_path: Path, row: str, does: str) -> None:
    """One line each that names the file; what is used is used without a word, and by the check too."""
    case, base = CASES[row], "base" if row == "link above the base" else None
    file = written(tmp_path, case)
    if does == "refuses":
        with pytest.raises(CellError, match=case.said) as refused:
            load_urdf(file)
        assert "arm.urdf" in str(refused.value)
        assert "\n" not in str(refused.value)
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = load_urdf(file, base=base)
        if row == "accelerations":
            parse_cell(CELL, "cell.toml", tmp_path)
    said = [str(entry.message) for entry in caught if entry.category is CellWarning]
    assert all("\n" not in text for text in said)
    if does == "warns":
        assert any(re.search(case.said, text) for text in said), said
        assert all(re.search(r"arm\.(urdf|srdf)|cell\.toml|joint_limits\.yaml", text) for text in said)
    else:
        assert said == []
    assert case.holds(model)
    pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
    from falsework.robots.checks.descriptions import description_fault

    assert description_fault(model) == ""


def test_accelerations_of_a_cell(tmp_path: Path) -> None:
    """In degrees for turning joints, in metres for sliding ones; with them nothing is assumed, or warned of."""
    written(tmp_path, Case())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cell = parse_cell(CELL + "acceleration = [180, 2.0]\n", "cell.toml", tmp_path)
    np.testing.assert_allclose(cell.robots[0].model.acceleration, [np.pi, 2.0])
    for least in ("0.0", "-1", "1e-300"):
        with pytest.raises(CellError, match=r"robots\[0\]: the acceleration of slide is .*; give at least 0\.01"):
            parse_cell(CELL + f"acceleration = [180, {least}]\n", "cell.toml", tmp_path)
    arm = tmp_path / "arm.urdf"
    arm.write_text(arm.read_text().replace('velocity="1"', 'velocity="1e-300"'))
    with pytest.raises(CellError, match=r"robots\[0\]: the velocity of slide is 1e-300; give at least 0\.01"):
        parse_cell(CELL + "acceleration = [180, 2.0]\n", "cell.toml", tmp_path)


def test_what_a_cell_file_states_twice_or_for_nobody(tmp_path: Path) -> None:
    written(tmp_path, Case())
    given = CELL + "acceleration = [180, 2.0]\n"
    twice = given.replace("position = [0.0, 0.0, 0.1] }", "position = [0.0, 0.0, 0.1], rpy = [0, 0, 9], yaw = 9 }")
    with pytest.raises(CellError, match=r"grippers\.cup\.tool\.yaw is given beside rpy"):
        parse_cell(twice, "cell.toml", tmp_path)
    idle = given + given[given.index("[grippers.cup]") : given.index("[[robots]]")].replace("cup]", "spare]")
    with pytest.warns(CellWarning, match="no robot has the gripper spare"):
        parse_cell(idle, "cell.toml", tmp_path)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (MESH, '<box size="0 1 1"/>'),
        (MESH, '<box size="1 1"/>'),
        (MESH, '<cylinder radius="nan" length="1"/>'),
        (MESH, '<cylinder radius="1" length="0"/>'),
        (MESH, '<mesh filename="wedge.obj" scale="1 2"/>'),
        ('<origin xyz="0 0 0.4"/>', '<origin xyz="0 0 inf"/>'),
        ('<origin xyz="0 0 0.4"/>', '<origin xyz="0 0 0.4" rpy="0 x 0"/>'),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0"/>'),
    ],
)
def test_numbers_that_are_none(tmp_path: Path, old: str, new: str) -> None:
    assert old in urdf_text()
    with pytest.raises(CellError, match=r"(joint slide|a shape of link two) has \w+='.*' in <\w+>; give"):
        load_urdf(written(tmp_path, changed(old, new)))


def test_copies_of_meshes_do_not_fill_the_memory(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    name = scene.add_geometry(trimesh.creation.icosphere(subdivisions=6))
    for number in range(130):
        scene.graph.update(f"copy-{number}", geometry=scene.graph[name][1])
    file = written(tmp_path, changed(MESH, '<mesh filename="many.glb"/>'))
    scene.export(tmp_path / "many.glb")
    with pytest.raises(CellError, match=r"mesh many\.glb cannot be read: .* grows to \d+ corners and triangles"):
        load_urdf(file)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('type="prismatic"', 'type="revolute"', "is elsewhere|has the range"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 1 0"/>', "link two is elsewhere"),
        ('upper="1" velocity="2"', 'upper="0.5" velocity="2"', "joint turn has the range"),
        ('upper="1" velocity="2"', 'upper="1" velocity="1"', "joint turn is limited to 1"),
        ('velocity="1"/>', 'velocity="1"/><mimic joint="turn"/>', "joint slide follows another joint"),
        (
            '<origin xyz="0 0 0.05"/></joint>',
            '<origin xyz="0 0 0.06"/></joint>',
            "no link where the gripper is mounted",
        ),
        (MESH + "</geometry></collision>", MESH + "</geometry></collision>" + BOX, "link two has 2 shapes"),
        ('name="slide"', 'name="lift"', "has no moving joint slide"),
    ],
)
def test_the_check_has_its_own_reading(tmp_path: Path, old: str, new: str, message: str) -> None:
    """An arm that was read wrongly, as from another file, is found out by its description."""
    pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
    from falsework.robots.checks.descriptions import description_fault

    file = written(tmp_path, Case())
    model = load_urdf(file)
    assert description_fault(model) == ""
    assert old in urdf_text()
    file.write_text(urdf_text().replace(old, new))
    assert re.search(message, description_fault(model))
    file.unlink()
    assert "is gone" in description_fault(model)


@pytest.mark.parametrize("srdf", ["", '<robot><disable_collisions link1="base" link2="one"/></robot>'])
def test_the_check_knows_which_links_are_left_out(tmp_path: Path, srdf: str) -> None:
    """A pair that no SRDF excludes, and that does not always touch, must be checked."""
    pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
    from falsework.robots.checks.descriptions import description_fault

    model = load_urdf(written(tmp_path, Case(srdf=srdf)))
    assert description_fault(model) == ""
    blind = replace(model, ignored=model.ignored | {(0, 2)})
    assert "links base and two are not checked for collisions" in description_fault(blind)

"""Files of MoveIt beside a URDF: named configurations of an SRDF, and joint_limits.yaml."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("yourdfpy", reason="reading URDF files needs yourdfpy; pip install 'falsework[robots]'")
pytest.importorskip("yaml", reason="joint_limits.yaml needs PyYAML; pip install 'falsework[robots]'")

from falsework.errors import CellError
from falsework.robots import Cell, CellWarning, load_urdf
from falsework.robots.cells.cell_file import parse_cell
from falsework.robots.model.cell import cell_identity
from tests.robots.cells.arm_description import urdf_text
from tests.robots.cells.cell_texts import TWO_JOINTS

STATES = """<robot name="two"><group_state name="home" group="arm"><joint name="turn" value="0.5"/></group_state>
<group_state name="home" group="slider"><joint name="slide" value="0.1"/></group_state>
<group_state name="ready" group="arm"><joint name="turn" value="-0.5"/><joint name="slide" value="0.2"/></group_state>
<group_state name="open" group="hand"><joint name="finger" value="0.04"/></group_state>
<group_state name="half" group="arm"><joint name="turn" value="0.1"/></group_state></robot>"""
LIMITS = """
default_velocity_scaling_factor: 0.1
joint_limits:
  turn: {has_velocity_limits: true, max_velocity: !degrees 60, has_acceleration_limits: true, max_acceleration: 4.0,
         has_position_limits: true, min_position: !degrees -30, max_position: !degrees 45}
  slide: {has_velocity_limits: true, max_velocity: 7.5, has_acceleration_limits: false, max_acceleration: 9.0}
  finger: {has_velocity_limits: true, max_velocity: 0.1}
"""


def said(caught: list[warnings.WarningMessage]) -> str:
    return "\n".join(str(entry.message) for entry in caught if entry.category is CellWarning)


def cell_in(folder: Path, more: str = "") -> Cell:
    return parse_cell(TWO_JOINTS + more, "cell.toml", folder)


@pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")
def test_home_is_the_state_of_that_name_of_all_groups(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(urdf_text())
    (tmp_path / "arm.srdf").write_text(STATES)
    assert cell_in(tmp_path).robots[0].home.tolist() == [0.5, 0.1]
    assert cell_in(tmp_path, 'home = "ready"\n').robots[0].home.tolist() == [-0.5, 0.2]
    np.testing.assert_allclose(cell_in(tmp_path, "home = [9, 0.3]\n").robots[0].home, [np.radians(9), 0.3])
    with pytest.raises(
        CellError, match=r"robots\[0\]\.home is the state 'rest', but arm\.srdf has home, ready; name one"
    ):
        cell_in(tmp_path, 'home = "rest"\n')


@pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")
def test_an_srdf_elsewhere_is_named_in_the_cell(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(urdf_text())
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "moveit.srdf").write_text(
        STATES.replace("</robot>", '<disable_collisions link1="base" link2="two"/></robot>')
    )
    named = 'srdf = "config/moveit.srdf"\n'
    model = cell_in(tmp_path, named).robots[0].model
    assert (0, 2) in model.ignored
    assert cell_in(tmp_path, named).robots[0].home.tolist() == [0.5, 0.1]
    with pytest.raises(
        CellError, match=r"home is the state .home., but two has no SRDF; name one, or give joint values"
    ):
        cell_in(tmp_path, 'home = "home"\n')
    with pytest.raises(CellError, match=r"robots\[0\]\.model: .*no SRDF .*gone\.srdf; give a file, or leave it out"):
        cell_in(tmp_path, 'srdf = "gone.srdf"\n')
    pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
    from falsework.robots.checks.descriptions import description_fault

    assert description_fault(model) == ""


def test_states_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(urdf_text())
    (tmp_path / "arm.srdf").write_text(STATES)
    with pytest.warns(CellWarning, match=r"arm\.srdf: state half has no value for slide, so it is not used"):
        load_urdf(tmp_path / "arm.urdf")
    for text, message in (
        ('value="0.5"', r"state home has joint turn outside its limits; correct one"),
        ('value="wide"', r"state home has the value 'wide' for joint turn; give one number"),
    ):
        (tmp_path / "arm.srdf").write_text(STATES.replace('value="0.5"', text.replace("0.5", "1.5")))
        with pytest.raises(CellError, match=message):
            load_urdf(tmp_path / "arm.urdf")


@pytest.mark.parametrize("place", ["joint_limits.yaml", "config/limits.yaml"])
def test_joint_limits_narrow_those_of_the_urdf(tmp_path: Path, place: str) -> None:
    """Beside the URDF, or where the cell says; units of angles are known; what is not used is named."""
    (tmp_path / "arm.urdf").write_text(urdf_text())
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text(LIMITS)
    more = "" if place == "joint_limits.yaml" else f'joint_limits = "{place}"\n'
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cell = cell_in(tmp_path, more)
    model = cell.robots[0].model
    np.testing.assert_allclose(model.velocity, [np.radians(60), 1.0])
    np.testing.assert_allclose(model.acceleration, [4.0, 2.0])  # the second joint is taken to need half a second
    np.testing.assert_allclose((model.lower[0], model.upper[0]), np.radians([-30, 45]))
    assert "there are no joints finger" in said(caught)
    assert "not used: default_velocity_scaling_factor" in said(caught)
    assert "has no acceleration of slide" in said(caught)
    assert model.assumed == ("slide",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("joint_limits:", "limits:", r"has no joint_limits; give MoveIt's"),
        (
            "max_acceleration: 4.0",
            "max_acceleration: -4.0",
            r"joint turn has max_acceleration -4\.0; give a number above",
        ),
        ("max_velocity: !degrees 60", "max_velocity: fast", r"joint turn has max_velocity 'fast'; give a number above"),
        ("min_position: !degrees -30", "min_position: 2", r"joint turn has min_position 2 and max_position .*a range"),
        ("max_position: !degrees 45", "max_position: -0.6", r"joint turn has min_position|range"),
        (
            "min_position: !degrees -30, max_position: !degrees 45",
            "min_position: 2, max_position: 3",
            r"joint turn has no range within the limits of the URDF",
        ),
        ("!degrees 60", "!turns 60", r"joint limits .* cannot be read"),
        ("slide: {", "slide: 3 {", r"joint limits .* cannot be read"),
    ],
)
@pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")
def test_wrong_joint_limits_name_file_and_joint(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "arm.urdf").write_text(urdf_text())
    assert old in LIMITS
    (tmp_path / "joint_limits.yaml").write_text(LIMITS.replace(old, new))
    with pytest.raises(CellError, match=message) as caught:
        load_urdf(tmp_path / "arm.urdf")
    assert "joint_limits.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_attribute_without_a_declared_prefix_is_read_without_noise(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Drake's accelerations, in a file that does not declare the prefix; also in the check."""
    text = urdf_text().replace('velocity="2"', 'velocity="2" drake:acceleration="3.5"')
    (tmp_path / "arm.urdf").write_text(text.replace('velocity="1"', 'velocity="1" drake:acceleration="0.5"'))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cell = cell_in(tmp_path)
    assert cell.robots[0].model.acceleration.tolist() == [3.5, 0.5]
    assert capfd.readouterr() == ("", "")
    (tmp_path / "arm.urdf").write_text(text.replace("3.5", "quick"))
    with pytest.raises(CellError, match="joint turn has acceleration 'quick'; give a number above zero"):
        load_urdf(tmp_path / "arm.urdf")
    pytest.importorskip("pinocchio", reason="checks need Pinocchio; pip install 'falsework[robots]'")
    from falsework.robots.checks.descriptions import description_fault

    (tmp_path / "arm.urdf").write_text(text)
    assert description_fault(load_urdf(tmp_path / "arm.urdf")) == ""


@pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")
def test_the_number_of_joints_is_explained_by_names(tmp_path: Path) -> None:
    """A tip link that is a finger makes one joint too many: the message shows it."""
    finger = (
        '<link name="finger"/><joint name="open" type="prismatic"><parent link="two"/><child link="finger"/>'
        '<axis xyz="1 0 0"/><limit lower="0" upper="0.1" velocity="1"/></joint></robot>'
    )
    text = urdf_text().replace('<link name="tool0"/>', "").replace("</robot>", finger)
    text = text[: text.index('<joint name="mount"')] + text[text.index('<link name="finger"') :]
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.raises(
        CellError, match=r"has 2 values, but two has 3 joints: turn, slide, open; .* link finger, which tip"
    ):
        cell_in(tmp_path, "home = [0, 0.1]\n")


@pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")
def test_settings_of_exports_are_not_part_of_the_identity(tmp_path: Path) -> None:
    """Signals and loads can be corrected after planning."""
    (tmp_path / "arm.urdf").write_text(urdf_text())
    plain = cell_in(tmp_path)
    more = 'maker = "ABB"\nsignals = { grip = "do_cup", closed = 0, seconds = 1.5, address = "10.0.0.3" }\n'
    full = parse_cell(
        TWO_JOINTS.replace("cup = 0.02", "cup = 0.02\ncenter_of_mass = [0, 0.01, 0.05]\ninertia = [0.02, 0.02, 0.01]")
        + more,
        "cell.toml",
        tmp_path,
    )
    assert cell_identity(full) == cell_identity(plain)
    robot = full.robots[0]
    assert (robot.maker, robot.signals.grip, robot.signals.closed) == ("ABB", "do_cup", False)
    assert (robot.signals.seconds, robot.signals.address) == (1.5, "10.0.0.3")
    assert robot.gripper.inertia is not None
    np.testing.assert_allclose(np.diag(robot.gripper.inertia), [0.02, 0.02, 0.01])
    for wrong, message in (
        ("signals = { grip = 3 }\n", r"robots\[0\]\.signals\.grip is 3; give a text"),
        ("signals = { closed = 2 }\n", r"signals\.closed is 2; give one of 0, 1"),
        ("signals = { gripp = 'a' }\n", r"signals\.gripp is not known; did you mean grip\?"),
    ):
        with pytest.raises(CellError, match=message):
            cell_in(tmp_path, wrong)
    for wrong in ("[1, 1, 3]", "[-1, 1, 1]", "[1, 1]", "[1, 1, 1, 9, 0, 0]"):
        with pytest.raises(CellError, match=r"grippers\.cup\.inertia is "):
            parse_cell(TWO_JOINTS.replace("cup = 0.02", f"cup = 0.02\ninertia = {wrong}"), "cell.toml", tmp_path)

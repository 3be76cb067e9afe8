"""New cell files: whatever the arms, what is written is a valid cell, and says what to edit."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from falsework import load_cell
from falsework.cli.main import main
from falsework.cli.new_cell import NewCell
from falsework.robots import builtin_cells, check_cell
from falsework.robots.kinematics.inverse import inverse
from falsework.robots.model.builtin_robots import BUILTIN
from falsework.robots.model.part_shapes import place_parts

pytestmark = pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")


def write(tmp_path: Path, arms: str, *words: str) -> Path:
    out = tmp_path / "cell.toml"
    assert main(["cell", "new", arms, "--out", str(out), *words]) == 0
    return out


@pytest.mark.parametrize("gripper", ["suction", "jaw"])
@pytest.mark.parametrize("arms", [",".join(sorted(BUILTIN)), "ur10e,ur10e", "solo=crb15000-5/0.95"])
def test_a_new_cell_is_valid(tmp_path: Path, arms: str, gripper: str) -> None:
    """Arms face the middle, and reach the places beside them."""
    cell = load_cell(write(tmp_path, arms, "--gripper", gripper))
    assert [robot.model.name for robot in cell.robots] == [arm.rpartition("=")[2] for arm in arms.split(",")]
    for robot in cell.robots:
        ahead = robot.base[:3, 0]
        np.testing.assert_allclose(ahead, -robot.base[:3, 3] / np.linalg.norm(robot.base[:3, 3]), atol=2e-3)
        assert len(robot.places) == 16
        assert all(any(len(found) for found in inverse(robot, turns)) for turns in robot.places.reshape(2, 8, 4, 4))
        assert robot.gripper.kind == gripper


def test_a_new_cell_is_clear_of_the_structure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also of one that is longer than the arms reach."""
    from falsework import load_structure

    arch = load_structure("arch:radius=2", density=1.0)
    cell = load_cell(write(tmp_path, "ur10e,ur10e", "--structure", "arch:radius=2", "--density", "1"))
    check_cell(cell, place_parts(arch, cell.placement))
    heavy = ["cell", "new", "ur10e", "--structure", "arch:radius=2", "--out", str(tmp_path / "heavy.toml")]
    assert main(heavy) == 1
    assert "weighs 79.8 kg and the payload of arm 1 is 5 kg" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["franka_fer", "ur5e", "kuka_lbr_iiwa_14_r820", "abb_irb2600_12_165"])
def test_arms_of_urdf_files(tmp_path: Path, robot_file, name: str) -> None:
    """Homes are proposed, makers that are known from a name are written down, paths are relative to the file."""
    pytest.importorskip("yourdfpy")
    out = write(tmp_path, f"one={robot_file(name)},two={robot_file(name)}")
    cell, text = load_cell(out), out.read_text()
    assert [robot.name for robot in cell.robots] == ["one", "two"]
    assert f'"{robot_file(name)}"' not in text
    maker = {"ur5e": "Universal Robots", "abb_irb2600_12_165": "ABB"}.get(name)
    assert cell.robots[0].maker == maker
    assert "# acceleration = [" in text
    assert all(joint in text for joint in cell.robots[0].model.joint_names)
    assert re.search(r"home = \[[-\d., ]+\]", text)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("kr16", "--out", "a.toml"), r"is 'kr16'; give the path of a URDF file or one of crb15000-5/0.95"),
        (("gone.urdf", "--out", "a.toml"), r"no robot description gone\.urdf"),
        (("left=ur10e,left=ur10e", "--out", "a.toml"), r"ARMS: two arms are called 'left'"),
        (("ur10e,,ur10e", "--out", "a.toml"), r"ARMS: '' names no arm; give arms such as"),
        (("left=", "--out", "a.toml"), r"ARMS: 'left=' names no arm"),
        (("ur10e", "--out", "a.yaml"), r"--out a\.yaml: a cell is a TOML file"),
        (("ur10e", "--out", "there.toml"), r"--out there\.toml exists; choose another name, so that nothing is lost"),
    ],
)
def test_what_cannot_be_written(
    tmp_path: Path,
    words: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.toml").write_text("mine")
    assert main(["cell", "new", *words]) == 2
    err = capsys.readouterr().err
    assert re.search(message, err)
    assert err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["there.toml"]
    assert (tmp_path / "there.toml").read_text() == "mine"


def test_the_help_lists_the_built_in_arms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ", ".join(sorted(BUILTIN)) in " ".join((NewCell.__doc__ or "").split())
    assert main(["cell", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Write cells, which" in said
    assert f"Built-in cells: {', '.join(builtin_cells())}. Built-in arms: {', '.join(sorted(BUILTIN))}." in said
    assert main(["cell", "new", "ur10e", "--out", str(tmp_path / "a.toml"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["files"], answer["robots"], answer["faults"]) == ([str(tmp_path / "a.toml")], ["arm 1"], [])

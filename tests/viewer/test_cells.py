"""Cells as people look at them: valid or not, with near pairs in colour, reach, sliders, and files that change."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import load_cell
from falsework.cli.main import main
from falsework.errors import InputError
from falsework.robots.cells.visuals import PLAIN, link_visuals, seen_from_both_sides, thinned
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.builtin_robots import builtin_robot
from falsework.viewer import picture_cell
from falsework.viewer.cells.cell_model import COLLIDES, NEAR, build_cell_model, is_cell, marks_of
from falsework.viewer.palette import unit_rgb
from tests.robots.cells.arm_description import urdf_text
from tests.robots.cells.cell_texts import ONE_ARM, TWO_JOINTS
from tests.viewer.conftest import CHROMIUM_FLAGS, chromium

pytestmark = pytest.mark.filterwarnings("ignore::falsework.robots.cells.urdf_review.CellWarning")

INTO_TABLE = ONE_ARM.replace("home = [0, -40, 30, 0, 60, 0]", "home = [0, 95, 0, 0, 0, 0]")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The file of a valid cell."""
    path = tmp_path / "cell.toml"
    path.write_text(ONE_ARM)
    return path


def test_a_cell_is_known_by_its_file_or_name(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_cell(str(file))
    assert is_cell("bottle-12")
    assert is_cell(load_cell("bottle-12"))
    assert not is_cell("vault")
    assert not is_cell(3)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bottle-12").mkdir()  # a structure of that name is no cell
    assert not is_cell("bottle-12")


@pytest.mark.parametrize(
    ("old", "new", "message", "robots"),
    [
        ("home = [0, -40, 30, 0, 60, 0]", "home = [0, 95, 0, 0, 0, 0]", "robot arm at home is too near", 1),
        ("home = [0, -40, 30, 0, 60, 0]", "home = [0, -40]", "robots[0].home has 2 values", 1),
        ("home = [0, -40, 30, 0, 60, 0]", "home = [0, 170, 0, 0, 0, 0]", "joint_2 is 170 degrees, outside", 1),
        ("payload = 5.0", "payload = -1", "grippers.cup.payload is -1", 1),
        ("high = [0.3, 0.3, 0.4]", "high = [0.3, -0.4, 0.4]", "obstacles[0].box.high", 1),
        ("radius = 0.03, low = 0.0", "radius = 0.03, low = 0.2", "grippers.cup.shapes[0].cylinder.high is 0.099", 1),
        (
            "low = [-0.3, -0.3, 0.0], high",
            "low = [0.2999999999999999, -0.3, 0.0], high",
            "cell.toml: obstacles[0].box: a box from",
            1,
        ),
        ('model = "irb2600-12/1.65"', 'model = "gone.urdf"', "no robot description", 0),
        ('name = "one arm"', "name = ", "is not valid TOML", 0),
    ],
)
def test_a_wrong_cell_is_shown_with_its_faults(file: Path, old: str, new: str, message: str, robots: int) -> None:
    """As much of it as can be read, and every fault in one line."""
    assert old in ONE_ARM
    file.write_text(ONE_ARM.replace(old, new))
    sight = build_cell_model(file)
    assert any(message in fault for fault in sight.faults)
    assert all("\n" not in fault for fault in sight.faults)
    assert (0 if sight.cell is None else sight.cell.robot_count) == robots
    if robots:
        assert sight.links
        assert sight.solids(sight.cell.homes, sight.pairs(sight.cell.homes))  # type: ignore[union-attr]


def test_faults_with_the_structure_are_found_too(file: Path) -> None:
    file.write_text(ONE_ARM.replace("position = [0.9, 0.0, 0.0]", "position = [0.0, 0.0, 0.0]"))
    assert build_cell_model(file).faults == ()
    assert any("part" in fault for fault in build_cell_model(file, "arch").faults)


def test_bodies_that_are_too_near_have_their_colour(file: Path) -> None:
    """Both bodies of each pair, and no others; a slider value brings them into colour and out of it."""
    sight = build_cell_model(file)
    assert sight.cell is not None
    home = sight.cell.homes[0]
    assert sight.pairs([home]) == []
    down = np.radians([0, 95, 0, 0, 0, 0])
    pairs = sight.pairs([down])
    assert any(pair.second == "floor" and pair.collides for pair in pairs)
    marks = marks_of(pairs)
    assert set(marks.values()) <= {COLLIDES, NEAR}
    colored = [solid for solid in sight.solids([down], pairs) if tuple(solid.color) == unit_rgb(COLLIDES)]
    named = {sight.link_name(link) for link in sight.links} | {body.name for body in sight.bodies}
    assert len(colored) == len([name for name in named if marks.get(name) == COLLIDES]) > 0


def test_no_tool_leaves_the_reach(file: Path) -> None:
    sight = build_cell_model(file)
    assert sight.cell is not None
    (robot,), (reach,) = sight.cell.robots, sight.reaches
    rng = np.random.default_rng(5)
    tools = tool_pose(robot, rng.uniform(robot.model.lower, robot.model.upper, (500, 6)))[:, :3, 3]
    away = np.linalg.norm(tools - reach.center, axis=1)
    assert away.max() <= 1.02 * reach.radius
    assert away.max() >= 0.9 * reach.radius


def colored_arm(folder: Path) -> Path:
    """Write a description with visual shapes: one with a colour, one of a named material, one that is missing."""
    text = urdf_text()
    red = '<material name=""><color rgba="1 0 0 1"/></material>'
    box = '<geometry><box size="0.02 0.02 0.3"/></geometry>'
    text = text.replace('<link name="base">', f'<link name="base"><visual>{box}{red}</visual>')
    text = text.replace('<link name="one">', f'<link name="one"><visual>{box}<material name="sea"/></visual>')
    text = text.replace(
        '<link name="two">', '<link name="two"><visual><geometry><mesh filename="gone.stl"/></geometry></visual>'
    )
    text = text.replace("</robot>", '<material name="sea"><color rgba="0 0 1 1"/></material></robot>')
    (folder / "arm.urdf").write_text(text)
    (folder / "cell.toml").write_text(TWO_JOINTS)
    return folder / "cell.toml"


def test_links_look_like_their_visual_shapes(tmp_path: Path) -> None:
    """In their colours; a mesh that is not there is named, and collision shapes stand in."""
    pytest.importorskip("yourdfpy", reason="reading URDF files needs yourdfpy; pip install 'falsework[robots]'")
    model = load_cell(colored_arm(tmp_path), check=False).robots[0].model
    from falsework.robots import CellWarning

    with pytest.warns(CellWarning, match=r"link two is drawn by its collision shapes: .*mesh gone\.stl does not exist"):
        looks = link_visuals(model)
    assert [[shape.color for shape in link] for link in looks] == [[(1, 0, 0)], [(0, 0, 1)], [PLAIN]]
    np.testing.assert_allclose(np.ptp(looks[0][0].vertices, axis=0), [0.02, 0.02, 0.3])
    assert [shape.color for link in link_visuals(builtin_robot("ur10e")) for shape in link] == [PLAIN] * 7


def test_surfaces_with_gaps_are_seen_from_both_sides() -> None:
    closed = closed_faces()
    assert len(seen_from_both_sides(closed)) == 4
    assert len(seen_from_both_sides(closed[:3])) == 6
    turned = closed.copy()
    turned[0] = turned[0, ::-1]
    assert len(seen_from_both_sides(turned)) == 8


def test_fine_meshes_are_thinned_out() -> None:
    """As far as it takes, and no point by more than a cube; coarse ones stay as they are."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=6)
    vertices, faces = thinned(ball.vertices, ball.faces)
    assert len(ball.faces) > 80_000
    assert 6_000 < len(faces) <= 12_000
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.03
    assert (np.linalg.norm(vertices[faces].mean(axis=1), axis=1) > 0.95).all()
    same, kept = thinned(ball.vertices[:4], closed_faces())
    assert len(kept) == len(closed_faces())
    np.testing.assert_array_equal(same, ball.vertices[:4])


def closed_faces() -> np.ndarray:
    return np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def test_colours_of_a_mesh_file_count_where_the_urdf_has_none(tmp_path: Path) -> None:
    pytest.importorskip("yourdfpy", reason="reading URDF files needs yourdfpy; pip install 'falsework[robots]'")
    import trimesh

    green = trimesh.creation.box((0.1, 0.1, 0.1))
    green.visual = trimesh.visual.ColorVisuals(green, face_colors=[0, 255, 0, 255])
    green.export(tmp_path / "green.glb")
    shape = '<visual><geometry><mesh filename="green.glb"/></geometry></visual>'
    (tmp_path / "arm.urdf").write_text(urdf_text().replace('<link name="base">', f'<link name="base">{shape}'))
    (tmp_path / "cell.toml").write_text(TWO_JOINTS)
    model = load_cell(tmp_path / "cell.toml", check=False).robots[0].model
    np.testing.assert_allclose(link_visuals(model)[0][0].color, (0, 1, 0), atol=0.01)


def test_a_picture_has_faults_in_words_and_colour(file: Path, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="pictures need Pillow")
    drawn = picture_cell(file, tmp_path / "good.png", width=240)
    assert (drawn.faults, drawn.pairs) == ((), ())
    file.write_text(INTO_TABLE)
    drawn = picture_cell(file, tmp_path / "bad.png", width=240)
    assert "home is too near" in drawn.faults[0]
    assert any("floor" in words for words in drawn.pairs)
    reds = []
    for name in ("good", "bad"):
        pixels = np.asarray(image.open(tmp_path / f"{name}.png").convert("RGB"), dtype=int)[:170]
        reds.append(int(((pixels[..., 0] > 80) & (pixels[..., 0] > 3 * pixels[..., 1])).sum()))
    assert reds[0] == 0
    assert reds[1] > 50
    file.write_text("name = ")
    with pytest.raises(InputError, match="is not valid TOML"):
        picture_cell(file, tmp_path / "none.png")
    with pytest.raises(InputError, match=r"there is no cell file .*gone\.toml; `falsework cell new` writes one"):
        picture_cell(tmp_path / "gone.toml", tmp_path / "none.png")


def test_on_the_command_line(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("PIL", reason="pictures need Pillow")
    file.write_text(INTO_TABLE)
    out = tmp_path / "cell.png"
    assert main(["picture", str(file), "--width", "160", "--out", str(out), "--json"]) == 0
    said, err = capsys.readouterr()
    record = json.loads(said)
    assert record["kind"] == "cell"
    assert "home is too near" in record["faults"][0]
    assert err.count("\n") == 1
    assert main(["picture", str(file), "--step", "2", "--forces", "--out", str(out)]) == 2
    assert "a picture of a cell has no --step and --forces; leave them out" in capsys.readouterr().err
    assert main(["picture", str(file), "--out", str(tmp_path / "cell.gif")]) == 2
    assert "cell.toml is a cell, which has no steps; falsework view and" in capsys.readouterr().err


def test_the_page_moves_arms_and_reads_the_file_again(file: Path) -> None:
    """Joint values stay when the file changes; a file that is wrong meanwhile is said, and nothing is lost."""
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    from falsework.viewer import view_cell
    from falsework.viewer.cells.cell_page import CellPage

    page = view_cell(file, port=8391)
    try:
        (sliders,) = page.sliders
        assert [slider.label for slider in sliders][:2] == ["joint_1, °", "joint_2, °"]
        page.set_configuration(0, np.radians([10, 95, 0, 0, 0, 0]))
        assert "floor" in page.said.content
        assert [round(slider.value, 3) for slider in sliders][:2] == [10, 95]
        assert COLLIDES in marks_of(page.sight.pairs(page.configurations)).values()
        sliders[1].value = 20.0  # as a browser sets it
        page.moved(0)
        assert np.degrees(page.configurations[0])[:2].round(6).tolist() == [10, 20]
        page.set_configuration(0, np.radians([10, 95, 0, 0, 0, 0]))
        page.propose(0)
        assert "nothing is too near" in page.said.content
        assert "home = [" in page.texts[0].content
        page.set_configuration(0, np.radians([10, 20, 0, 0, 0, 0]))
        changed(file, ONE_ARM.replace("payload = 5.0", "payload = -5.0"))
        wait_for(lambda: "payload is -5" in page.said.content)
        assert np.degrees(page.configurations[0])[:2].round(6).tolist() == [10, 20]
        changed(file, "name = ")
        wait_for(lambda: "is not valid TOML" in page.said.content)
        assert page.configurations == []
        changed(file, INTO_TABLE)
        wait_for(lambda: "home is too near" in page.said.content)
        assert np.degrees(page.configurations[0]).round(6).tolist() == [0, 95, 0, 0, 0, 0]
        file.unlink()
        wait_for(lambda: "not read again" in page.said.content)
        assert len(page.configurations) == 1
        assert isinstance(page, CellPage)
    finally:
        page.close()


def changed(file: Path, text: str) -> None:
    """Write a file, later than before whatever the clock of the file system resolves."""
    import os

    before = file.stat().st_mtime_ns
    file.write_text(text)
    os.utime(file, ns=(before + 10_000_000, before + 10_000_000))


def wait_for(true: Any) -> None:
    end = time.monotonic() + 8
    while not true():
        assert time.monotonic() < end, "nothing has changed"
        time.sleep(0.05)


@pytest.mark.slow
def test_in_a_browser(file: Path, tmp_path: Path) -> None:
    """The fault is on the page, a click brings the arm to a proposed home, and the arm is drawn."""
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright to steer a browser")
    image = pytest.importorskip("PIL.Image", reason="pictures need Pillow")
    path = chromium()
    from falsework.viewer import view_cell

    file.write_text(INTO_TABLE)
    page = view_cell(file, port=8392)
    try:
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=path, args=CHROMIUM_FLAGS)
            tab = browser.new_page(viewport={"width": 700, "height": 480})
            tab.goto(page.address)
            tab.get_by_text("home is too near").first.wait_for(timeout=30_000)
            tab.get_by_text("Propose a home from here").click()
            tab.get_by_text("nothing is too near").wait_for(timeout=10_000)
            assert tab.get_by_text("joint_6").count() == 1
            tab.wait_for_timeout(1000)
            tab.screenshot(path=str(tmp_path / "page.png"))
            browser.close()
        assert not page.sight.pairs(page.configurations)
        pixels = np.asarray(image.open(tmp_path / "page.png").convert("RGB"), dtype=int)[:, :300]
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 200
    finally:
        page.close()

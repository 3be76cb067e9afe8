"""Display of sliding states: forces in balance exist, but the contacts do not bring them about."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falsework import Assembly, Plan, StabilityOracle, StabilitySettings, find_plans
from falsework.assembly import complete_state
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.store import save_assembly
from falsework.cli.main import main
from falsework.search.plans.plan_file import save_plan
from falsework.viewer import Camera, Timeline
from falsework.viewer.page.page_text import legend_text, where_text
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import SLIDING, rgb
from falsework.viewer.pictures.video import frames_of
from falsework.viewer.proof import proof_of_state, proofs_of_states

CUBE, IDLER = 0, 1
EQUILIBRIUM = StabilitySettings(criterion="equilibrium")


@pytest.fixture(scope="module")
def clamp() -> Assembly:
    """A cube between two fixed walls with nothing below it, and one that lies on top of the right wall."""
    made = gather(
        [
            box("cube", (0, 0, 0), (1, 1, 1)),
            box("idler", (1, 0, 2), (2, 1, 3)),
            box("left", (-1, 0, -1), (0, 1, 2), fixed=True),
            box("right", (1, 0, -1), (2, 1, 2), fixed=True),
        ]
    )
    return Assembly.from_meshes(made.meshes, boundary=made.boundary, name="clamp")


@pytest.fixture(scope="module")
def plan(clamp: Assembly) -> Plan:
    """A plan of the paper's criterion, which takes the walls to press as hard as they like."""
    return find_plans(clamp, oracle=StabilityOracle(clamp, EQUILIBRIUM)).plans[0]


@pytest.fixture
def plan_file(clamp: Assembly, plan: Plan, tmp_path: Path) -> Path:
    save_assembly(clamp, tmp_path / "clamp")
    path = tmp_path / "plan.json"
    save_plan(replace(plan, source={"path": "clamp"}), path)
    return path


def test_the_cube_slides_down_and_the_other_one_does_not(clamp: Assembly) -> None:
    proof = proof_of_state(StabilityOracle(clamp), complete_state(clamp.boundary))
    assert proof.slides
    assert proof.decided
    assert not proof.stable
    assert proof.words.startswith("slides: cube-0 would slide;")
    assert proof.marks == {CUBE: SLIDING}
    (way,) = np.diff(proof.arrows["sliding"].ends, axis=1)[:, 0]
    np.testing.assert_allclose(way / np.linalg.norm(way), [0, 0, -1], atol=1e-6)
    (pressed,) = proof.arrows["gravity"].ends[:, 0]  # only that of the other one, which could not hide the way
    np.testing.assert_allclose(pressed, clamp.mass.center[IDLER])
    assert (proof.moved[CUBE][:, 2] < clamp.meshes[CUBE].vertices[:, 2]).all()


def test_under_equilibrium_the_walls_hold_it(clamp: Assembly) -> None:
    proof = proof_of_state(StabilityOracle(clamp, EQUILIBRIUM), complete_state(clamp.boundary))
    assert proof.stable
    assert not proof.slides
    assert proof.marks == {}
    assert len(proof.arrows["friction"])


def test_a_stable_state_shows_forces_under_both_criteria(clamp: Assembly) -> None:
    """Without the cube, what lies on the wall presses on it with its weight."""
    state = complete_state(clamp.boundary)
    state[CUBE] = 0
    for settings in (StabilitySettings(), EQUILIBRIUM):
        proof = proof_of_state(StabilityOracle(clamp, settings), state)
        assert proof.stable
        pressure, weight = (
            (arrows.ends[:, 1] - arrows.ends[:, 0]).sum(axis=0)
            for arrows in (proof.arrows["contact forces"], proof.arrows["gravity"])
        )
        np.testing.assert_allclose(pressure, -weight, atol=1e-3 * float(np.linalg.norm(weight)))


def test_many_states_at_once_are_as_each_by_itself(clamp: Assembly, plan: Plan) -> None:
    oracle = StabilityOracle(clamp)
    together = proofs_of_states(oracle, plan.states)
    alone = [proof_of_state(oracle, state) for state in plan.states]
    assert [proof.words for proof in together] == [proof.words for proof in alone]
    cube = plan.states[:, CUBE]
    assert [proof.slides for proof in together] == (cube == 1).tolist()


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_the_page_marks_it_once_it_was_asked_about(criterion: str, clamp: Assembly, plan: Plan) -> None:
    model = ViewerState(Timeline.from_plan(plan, clamp), plan=plan, criterion=criterion)  # type: ignore[arg-type]
    model.go_to(len(plan))
    assert model.appearance().color[CUBE].tolist() != list(rgb(SLIDING))
    slides = criterion == "contact"
    assert ("slides: cube-0" in where_text(model, ask=True)) == slides
    assert (model.appearance().color[CUBE].tolist() == list(rgb(SLIDING))) == slides
    assert model.appearance().color[IDLER].tolist() != list(rgb(SLIDING))
    assert ("would slide" in legend_text(model, {})) == slides
    model.go_to(0)
    assert "slides" not in where_text(model, ask=True)
    assert "would slide" not in legend_text(model, {})


def colors_of(path: Path) -> set[tuple[int, int, int]]:
    pil = pytest.importorskip("PIL.Image", reason="pictures need Pillow; pip install 'falsework[picture]'")
    pixels = np.asarray(pil.open(path).convert("RGB")).reshape(-1, 3)
    return {(int(red), int(green), int(blue)) for red, green, blue in np.unique(pixels, axis=0)}


@pytest.mark.parametrize("options", [("--step", "4", "--forces"), ("--step", "4", "--verdicts"), ("--verdicts",)])
@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_pictures_mark_it(
    criterion: str, options: tuple[str, ...], plan_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "picture.png"
    words = ["picture", str(plan_file), "--order", "disassembly", "--width", "300", "--out", str(out), "--json"]
    assert main([*words, *options, "--criterion", criterion]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["criterion"] == criterion
    assert (4 in record["not_standing"]) == (criterion == "contact")
    assert (rgb(SLIDING) in colors_of(out)) == (criterion == "contact")


def test_without_being_asked_a_picture_says_nothing_of_verdicts(
    plan_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sheet.png"
    assert main(["picture", str(plan_file), "--width", "200", "--out", str(out), "--json"]) == 0
    assert "not_standing" not in json.loads(capsys.readouterr().out)
    assert rgb(SLIDING) not in colors_of(out)


def test_line_drawings_name_and_mark_it(plan_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "sheet.svg"
    words = ["picture", str(plan_file), "--order", "disassembly", "--out", str(out)]
    assert main([*words, "--verdicts"]) == 0
    marked = [line for line in out.read_text().splitlines() if f'fill="{SLIDING}"' in line and "<path" in line]
    assert marked
    assert all("cube-0" in line for line in marked)
    assert "(slides)" in out.read_text()
    assert main(words) == 0
    assert SLIDING not in out.read_text()


def test_films_mark_it(clamp: Assembly, plan: Plan) -> None:
    """The legend has the colour in every picture, and the cube has it where it slides."""
    timeline = Timeline.from_plan(plan, clamp)
    proofs = dict(enumerate(proofs_of_states(StabilityOracle(clamp), timeline.states)))
    options = {"seconds": 0.5, "rate": 2.0, "camera": Camera(width=240, height=160, samples=2)}
    plain, marked = list(frames_of(timeline, **options)), list(frames_of(timeline, proofs=proofs, **options))
    for one, other in zip(plain, marked, strict=True):
        assert not (one == rgb(SLIDING)).all(axis=2).any()
        assert (other == rgb(SLIDING)).all(axis=2).any()
    assert proofs[len(timeline)].slides
    assert proofs[0].stable

    def blue(frame: np.ndarray) -> int:
        """Pixels in any shade of the colour, without the legend."""
        red, green, blue = (frame[:170, :, channel].astype(int) for channel in range(3))
        return int(((blue > red + 60) & (green > red + 40)).sum())

    assert blue(marked[-1]) > 100 > blue(plain[-1])
    assert blue(marked[0]) == blue(plain[0])


def test_the_command_names_the_states(plan_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "plan.gif"
    words = [
        "picture",
        str(plan_file),
        "--width",
        "80",
        "--rate",
        "4",
        "--step-seconds",
        "0.25",
        "--out",
        str(out),
        "--json",
    ]
    assert main([*words, "--verdicts"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["criterion"] == "contact"
    assert record["not_standing"][-1] == record["steps"][-1]  # the end of assembly
    assert main([*words, "--verdicts", "--criterion", "equilibrium"]) == 0
    assert json.loads(capsys.readouterr().out)["not_standing"] == []
    assert main(words) == 0
    assert "criterion" not in json.loads(capsys.readouterr().out)


def test_the_scene_of_the_page_has_the_part_and_its_way(clamp: Assembly) -> None:
    pytest.importorskip("viser", reason="the page needs viser; pip install 'falsework[viewer]'")
    from falsework.viewer.page.page import Page

    page = Page(ViewerState(Timeline.from_state(clamp, complete_state(clamp.boundary))), port=0)
    try:
        page.refresh()
        shown = set(page.scene.shown)
        assert f"/parts/colour/{SLIDING[1:]}" in shown  # at once: no plan has said that this state stands
        assert {"/motion", "/arrows/sliding"} <= shown  # without being asked for
        assert page.scene.nodes["/motion"][1][0].color == rgb(SLIDING)
        assert page.look.motion.visible
        page.look.motion.value = False
        page.refresh()
        assert not {"/motion", "/arrows/sliding"} & set(page.scene.shown)
    finally:
        page.close()

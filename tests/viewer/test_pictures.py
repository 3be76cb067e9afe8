"""Contact sheets, line drawings, videos and state graphs as files, and every wrong input in one line."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from falsework import StateGraph, load_structure, picture
from falsework.assembly.store import save_assembly
from falsework.cli.main import main
from falsework.search.plans.plan_file import load_plan, save_plan
from falsework.search.problem.state_graph import save_state_graph
from falsework.utils.archive import read_archive, write_archive
from falsework.viewer import Timeline
from falsework.viewer.appearance import appearance_at, bounds_of
from falsework.viewer.palette import BOUNDARY, FORCE, GRAVITY, INSTALLED, RAMP, ROBOTS, SELECTED
from falsework.viewer.pictures.contact_sheet import CELL, contact_sheet, draw, outline_of
from falsework.viewer.pictures.drawing import drawing, flat_axis, outlines
from falsework.viewer.pictures.graph_picture import covered, graph_figure, places_of
from falsework.viewer.pictures.video import frame_places
from falsework.viewer.viewable import open_file

pil = pytest.importorskip("PIL.Image", reason="pictures need Pillow; pip install 'falsework[picture]'")
pytest.importorskip("matplotlib", reason="pictures need Matplotlib; pip install 'falsework[picture]'")

Run = Callable[..., tuple[int, str]]


@pytest.fixture
def plan_file(arch, tmp_path: Path) -> Path:
    """A plan of the arch as `falsework plan` writes it."""
    path = tmp_path / "plan.json"
    save_plan(replace(arch[1], source={"built_in": "arch:blocks=5"}), path)
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command; exit code and what went to the error stream."""

    def call(*words: Any) -> tuple[int, str]:
        capsys.readouterr()
        code = main([str(word) for word in words])
        return code, capsys.readouterr().err

    return call


def pixels(path: Path) -> np.ndarray:
    return np.asarray(pil.open(path).convert("RGB"))


def has(picture: np.ndarray, color: str) -> bool:
    """Whether a legend in this very colour is in a picture."""
    value = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return int((picture == value).all(axis=2).sum()) > 100


@pytest.mark.usefixtures("without_numba")
def test_pictures_need_no_numba(plan_file: Path) -> None:
    """Arguments of the kernels have the types of the portable code, with parts that show through and without."""
    assert main(["picture", str(plan_file), "--out", str(plan_file.with_name("plan.png"))]) == 0


def test_contact_sheet(plan_file: Path, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    assert run("picture", plan_file, "--out", out, "--frames", 6, "--columns", 3, "--width", 160) == (0, "")
    picture = pixels(out)
    assert picture.shape[1] == 3 * 160
    assert has(picture, BOUNDARY)
    assert has(picture, ROBOTS[0])
    assert not has(picture, SELECTED)


def test_the_first_picture_shows_where_everything_comes(arch: Any) -> None:
    """All that is not white in a picture of the whole is not white at the beginning; its parts alone cover less."""
    timeline = Timeline.from_plan(arch[1], arch[0])

    def covered_at(place: int) -> np.ndarray:
        return np.any(contact_sheet(timeline, [place])[26:326] < 255, axis=2)

    whole = outline_of(timeline, CELL, bounds_of(arch[0]))
    outline = (np.rint(whole * 255) < 255).any(axis=2)
    assert covered_at(0)[outline].all()
    first, camera = appearance_at(timeline, 0, travelling=False), replace(CELL)
    alone = (draw(arch[0], first, camera) < 0.999).any(axis=2)
    assert alone.mean() < 0.5 * covered_at(0).mean()
    complete = draw(arch[0], appearance_at(timeline, len(timeline), travelling=False), camera)
    np.testing.assert_array_equal(np.minimum(complete, whole), complete)  # what is installed hides its outline


def test_one_step_and_its_forces(plan_file: Path, run: Run, tmp_path: Path) -> None:
    plain, forces = tmp_path / "plain.png", tmp_path / "forces.png"
    last = len(load_plan(plan_file))
    assert run("picture", plan_file, "--step", last, "--width", 300, "--out", plain) == (0, "")
    assert run("picture", plan_file, "--step", last, "--width", 300, "--forces", "--out", forces) == (0, "")
    assert pixels(plain).shape[0] < pixels(forces).shape[0]  # its legend has more colours


def test_the_legend_of_one_state_has_its_colours_alone_and_the_longest_force_of_each_kind(
    plan_file: Path, tmp_path: Path
) -> None:
    picture(plan_file, tmp_path / "last.svg", step=len(load_plan(plan_file)), forces=True)
    lines = (tmp_path / "last.svg").read_text()
    assert "held by" not in lines
    assert re.search(r">contact forces, up to [\d.]+ k?N<", lines)
    assert ">boundary<" in lines


def test_words_fit_into_narrow_pictures(plan_file: Path, run: Run, tmp_path: Path) -> None:
    """Legends take several rows and captions smaller letters; a line drawing is as wide as it was asked to be."""
    step = next(step.number for step in load_plan(plan_file) if step.number > 4 and step.action == "insert")
    for form in ("png", "svg"):
        out = tmp_path / f"step.{form}"
        words = ("--step", step, "--forces", "--width", 260, "--out", out)
        assert run("picture", plan_file, *words) == (0, "")
    picture = pixels(tmp_path / "step.png")
    assert (picture[-60:, [0, -1]] == 255).all()
    assert (picture[:40, [0, -1]] == 255).all()
    assert picture.shape[1] == 260
    assert all(has(picture, color) for color in (BOUNDARY, INSTALLED, FORCE, GRAVITY))
    assert 'width="260"' in (tmp_path / "step.svg").read_text()


def test_a_contact_sheet_names_only_what_it_shows(plan_file: Path, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "ends.png"
    assert run("picture", plan_file, "--frames", 2, "--width", 160, "--out", out) == (0, "")
    assert has(pixels(out), BOUNDARY)
    assert not has(pixels(out), ROBOTS[0])


def test_same_plan_same_picture(plan_file: Path, run: Run, tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        assert run("picture", plan_file, "--step", 2, "--width", 200, "--out", tmp_path / name)[0] == 0
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_line_drawing_covers_what_the_parts_do() -> None:
    """The outlines of a part seen from the front enclose its volume divided by its depth."""
    arch = load_structure("arch:blocks=7,depth=0.5")
    assert flat_axis(arch) == 1
    for part, lines in enumerate(outlines(arch, 1)):
        depth = np.ptp(arch.meshes[part].vertices[:, 1])
        area = 0.0
        for line in lines:
            area += abs(np.sum(line[:, 0] * np.roll(line[:, 1], -1) - line[:, 1] * np.roll(line[:, 0], -1)) / 2)
        assert area == pytest.approx(arch.mass.volume[part] / depth, rel=1e-6)


def test_line_drawing_as_svg(plan_file: Path, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "arch.svg"
    assert run("picture", plan_file, "--out", out) == (0, "")
    tree = ElementTree.fromstring(out.read_text())
    titles = [node.text for node in tree.iter("{http://www.w3.org/2000/svg}title")]
    assert set(titles) == set(load_structure("arch:blocks=5").names)
    numbers = [float(n) for d in re.findall(r'd="(M[^"]+Z)"', out.read_text()) for n in re.findall(r"[\d.]+", d)]
    width = float(tree.get("width", "0"))
    assert numbers
    assert max(numbers) <= max(width, float(tree.get("height", "0")))


def test_a_round_structure_has_no_line_drawing(run: Run, tmp_path: Path) -> None:
    assert flat_axis(load_structure("dome:rings=2,blocks=6")) is None
    code, error = run("picture", "dome:rings=2,blocks=6", "--out", tmp_path / "dome.svg")
    assert code == 2
    assert "is not two-dimensional, so it has no line drawing; write a .png" in error
    assert not (tmp_path / "dome.svg").exists()


def test_a_name_that_promises_another_format(plan_file: Path, run: Run, tmp_path: Path) -> None:
    code, error = run("picture", plan_file, "--out", tmp_path / "plan.jpg")
    assert code == 2
    assert "pictures are written as .png or .svg" in error
    assert not (tmp_path / "plan.jpg").exists()


def test_names_are_escaped(arch) -> None:
    assembly = arch[0]
    odd = replace(assembly, meshes=tuple(replace(mesh, name=f"<{mesh.name}>") for mesh in assembly.meshes))
    still = Timeline.from_state(odd, arch[1].states[-1])
    drawn = ElementTree.fromstring(drawing(still, [0]))
    assert {title.text for title in drawn.iter("{http://www.w3.org/2000/svg}title")} == set(odd.names)


def test_films(plan_file: Path, run: Run, tmp_path: Path) -> None:
    gif, mp4 = tmp_path / "plan.gif", tmp_path / "plan.mp4"
    options = ("--width", 120, "--rate", 4, "--step-seconds", 0.25)
    steps = len(load_plan(plan_file))
    assert run("picture", plan_file, "--out", gif, *options) == (0, "")
    video = pil.open(gif)
    assert video.n_frames == steps + 1
    assert video.size[0] == 120
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="MP4 needs imageio-ffmpeg")
    assert run("picture", plan_file, "--out", mp4, *options) == (0, "")
    frames = imageio_ffmpeg.read_frames(str(mp4))
    about = next(frames)
    assert about["size"][0] == 120
    assert sum(1 for _ in frames) == steps + 1 + 2 * 3  # first and last stay for a second


def test_frames_pass_every_state_and_end_at_the_end() -> None:
    places = frame_places(5, 0.5, 6.0)
    assert places[0] == 0.0
    assert places[-1] == 5.0
    assert set(range(6)) <= set(places)
    assert frame_places(0, 0.5, 6.0) == [0.0]


@pytest.fixture(scope="module")
def graph() -> StateGraph:
    """All states of an arch of four blocks."""
    from falsework import StabilityOracle, Task
    from falsework.search import ExhaustiveSearch

    arch = load_structure("arch:blocks=4,thickness=0.3")
    task = Task.from_rules(arch.boundary, 2, identity=arch.identity)
    found = ExhaustiveSearch(task, StabilityOracle(arch)).run().graph
    return StateGraph.from_states(task, found.states, name=arch.name)


def test_a_graph_has_a_column_a_level_and_no_two_states_in_one_place(graph: StateGraph) -> None:
    place = places_of(graph)
    assert len(np.unique(place, axis=0)) == len(graph)
    np.testing.assert_array_equal(place[:, 0], graph.task.steps - graph.level)
    assert (place[graph.source, 0] == place[graph.target, 0] + 1).all()


def test_sorting_rows_crosses_less(graph: StateGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    def crossings(place: np.ndarray) -> int:
        count = 0
        ends = np.stack([place[graph.source], place[graph.target]], axis=1)
        for k in range(len(ends)):
            same = ends[k + 1 :][ends[k + 1 :, 0, 0] == ends[k, 0, 0]]
            count += int((((same[:, 0, 1] - ends[k, 0, 1]) * (same[:, 1, 1] - ends[k, 1, 1])) < 0).sum())
        return count

    assert crossings(places_of(graph)) < crossings(places_of(graph, sweeps=0))


def test_coverage_counts_states_of_the_graph_alone(graph: StateGraph) -> None:
    foreign = np.full((1, graph.states.shape[1]), 2, dtype=np.uint8)
    seen = covered(graph, np.concatenate([graph.states[[0, 3, 3]], foreign]))
    assert np.flatnonzero(seen).tolist() == sorted(
        {0, 3} | set(np.flatnonzero((graph.states == 2).all(axis=1)).tolist())
    )


def test_picture_of_a_graph(graph: StateGraph, run: Run, tmp_path: Path) -> None:
    save_state_graph(graph, tmp_path / "graph.npz")
    for name in ("graph.png", "graph.svg"):
        assert run("picture", tmp_path / "graph.npz", "--out", tmp_path / name) == (0, "")
        assert (tmp_path / name).stat().st_size > 1000
    assert graph_figure(graph, visited=graph.states[:5]).axes


def test_texts_count_one_and_name_what_has_no_steps(plan_file: Path, tmp_path: Path) -> None:
    """One part is no parts, and a structure without a plan has no steps that are done."""
    words = {picture(plan_file, step=step, verdicts=True).shows for step in (1, 2, len(load_plan(plan_file)))}
    assert any("balance 1 free part" in text for text in words)
    assert not any("1 free parts" in text for text in words)
    arch = load_structure("arch:blocks=3")
    assert picture(arch.boundary.astype(int) + 1, structure=arch).shows.startswith("arch")


def test_a_graph_names_its_structure_and_the_options_of_it(run: Run, tmp_path: Path) -> None:
    save_assembly(load_structure("arch:blocks=3"), tmp_path / "bricks")
    out = tmp_path / "graphs" / "graph.npz"
    out.parent.mkdir()
    assert run("graph", tmp_path / "bricks", "--friction", 0.8, "--width", 8, "--out", out)[0] == 0
    assert run("picture", out, "--out", tmp_path / "graph.png") == (0, "")
    shown = open_file(out)
    assert shown.assembly.friction == 0.8
    assert shown.graph is not None
    both = {"path": "x", "built_in": "y"}
    for origin, hint in (({"path": "../gone"}, "is gone"), ([], "origin is []"), (both, "origin must have either")):
        save_state_graph(replace(shown.graph, origin=None), out)
        header, arrays = read_archive(out, "falsework.graph/1")
        write_archive(out, "falsework.graph/1", {**header, "origin": origin}, arrays)
        code, error = run("picture", out, "--out", tmp_path / "graph.png")
        assert code == 2
        assert hint in error


def test_what_a_policy_thinks_and_covers(
    graph: StateGraph, plan_file: Path, policy: Any, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from types import SimpleNamespace

    from falsework.learn import PolicySettings, make_policy

    def load(folder: str, assembly: Any = None) -> SimpleNamespace:
        fits = policy if assembly.part_count == 7 else make_policy(assembly, PolicySettings(), "cpu", seed=0)
        return SimpleNamespace(policy=fits)

    monkeypatch.setattr("falsework.learn.training.checkpoint.load_run", load)
    out = tmp_path / "chances.png"
    assert run("picture", plan_file, "--step", 10, "--policy", "some-run", "--width", 400, "--out", out) == (0, "")
    assert has(pixels(out), RAMP[-1])
    assert not has(pixels(out), ROBOTS[0])
    save_state_graph(graph, tmp_path / "graph.npz")
    plain, visited = tmp_path / "plain.png", tmp_path / "visited.png"
    assert run("picture", tmp_path / "graph.npz", "--out", plain) == (0, "")
    assert run("picture", tmp_path / "graph.npz", "--policy", "some-run", "--out", visited) == (0, "")
    assert plain.read_bytes() != visited.read_bytes()


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("picture", "PLAN", "--step", "99"), "step 99 does not exist"),
        (("picture", "PLAN", "--step", "-1"), "step -1 does not exist"),
        (("picture", "PLAN", "--frames", "0"), "at least 1"),
        (("picture", "PLAN", "--columns", "0"), "at least 1"),
        (("picture", "PLAN", "--width", "5"), "80 to 8000"),
        (("picture", "PLAN", "--forces"), "--step"),
        (("picture", "PLAN", "--rate", "5"), "a picture such as picture.png has no --rate; leave it out"),
        (("picture", "PLAN", "--step", "1", "--title", "A", "--out", "x.mp4"), "video such as x.mp4 has no --step and"),
        (("picture", "nowhere.json"), "nowhere"),
        (("picture", "BROKEN"), "JSON"),
        (("picture", "PLAN", "--cell", "dome-37"), "the cell dome-37 is of a robot plan, which this is not"),
        (("picture", "OTHER"), "cannot be shown"),
        (("picture", "PLAN", "--structure", "arch:blocks=6"), "parts"),
        (("picture", "arch:blocks=5", "--structure", "arch"), "leave --structure out"),
        (("picture", "PLAN", "--out", "no/such/folder/x.png"), "folder"),
        (("picture", "PLAN", "--out", "x.avi"), ".mp4 or .gif"),
        (("picture", "PLAN", "--step-seconds", "0", "--out", "x.mp4"), "give 0.001 to 1000"),
        (("picture", "PLAN", "--step-seconds", "1e9", "--out", "x.mp4"), "give 0.001 to 1000"),
        (("picture", "PLAN", "--speed", "0", "--out", "x.mp4"), "above zero"),
        (("picture", "PLAN", "--rate", "0", "--out", "x.mp4"), "pictures a second"),
        (("picture", "PLAN", "--width", "9", "--out", "x.mp4"), "80 to 4000"),
        (("picture", "arch:blocks=5", "--out", "x.mp4"), "no steps to animate"),
        (("view", "PLAN", "--port", "70000"), "no port"),
        (("view", "PLAN", "--robots", "0"), "robots"),
        (("view", "PLAN", "--deadline", "0"), "deadline"),
        (("view", "PLAN", "--host", ""), "--host"),
        (("view", "PLAN", "--policy", "no-run"), "no-run"),
        (("picture", "PLAN", "--step", "1", "--policy", "no-run"), "no-run"),
        (("view", "nowhere.npz"), "nowhere"),
        (("view", "EMPTY"), "mesh"),
    ],
)  # fmt: skip
def test_wrong_input_gets_one_line(
    words: tuple[str, ...], hint: str, plan_file: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.json").write_text('{"format": ')
    (tmp_path / "other.json").write_text('{"format": "falsework.census/1"}')
    (tmp_path / "empty").mkdir()
    places = {"PLAN": plan_file, "BROKEN": "broken.json", "OTHER": "other.json", "EMPTY": "empty"}
    before = sorted(tmp_path.rglob("*"))
    code, error = run(*(places.get(word, word) for word in words))
    assert code == 2, error
    assert error.count("\n") == 1, error
    assert hint in error, error
    assert sorted(tmp_path.rglob("*")) == before


def test_a_graph_of_another_structure_is_refused(graph: StateGraph, run: Run, tmp_path: Path) -> None:
    save_state_graph(graph, tmp_path / "graph.npz")
    code, error = run("view", tmp_path / "graph.npz", "--structure", "arch:blocks=5")
    assert code == 2
    assert "another structure" in error


@pytest.mark.parametrize(
    ("module", "command", "extra"),
    [
        ("viser", ("view", "arch:blocks=5"), "falsework[viewer]"),
        ("PIL", ("picture", "arch:blocks=5"), "falsework[picture]"),
        ("imageio_ffmpeg", ("picture", "PLAN", "--width", "80", "--rate", "1", "--out", "x.mp4"), "falsework[picture]"),
    ],
)
def test_a_missing_package_names_its_extra(
    module: str,
    command: tuple[str, ...],
    extra: str,
    plan_file: Path,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    code, error = run(*(plan_file if word == "PLAN" else word for word in command))
    assert code == 2, error
    assert error.count("\n") == 1, error
    assert extra in error

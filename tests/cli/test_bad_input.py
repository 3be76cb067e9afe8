"""Every kind of wrong input gets one clear line and a non-zero exit, and leaves nothing half-written behind."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

Run = Callable[..., Any]
Write = Callable[..., Path]

BOTTOM = ((0, 0, 0), (2, 1, 1))
MIDDLE = ((0, 0, 1), (2, 1, 2))
TOP = ((0.5, 0, 2), (1.5, 1, 3))
CUBE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"


def expect(finished: Any, code: int, *hints: str) -> None:
    """One line for a person, which contains every hint; nothing for a machine."""
    assert finished.code == code, finished.error
    assert finished.error.startswith("falsework: "), finished.error
    assert finished.error.count("\n") == 1, finished.error
    assert "Traceback" not in finished.error
    assert finished.out == ""
    for hint in hints:
        assert hint in finished.error, finished.error


@pytest.fixture
def refused(falsework: Run, tmp_path: Path) -> Callable[..., None]:
    """Plan with wrong input; the folder must look afterwards as it did before."""

    def check(hints: str | tuple[str, ...], *arguments: Any, code: int = 2) -> None:
        before = sorted(tmp_path.rglob("*"))
        finished = falsework("plan", *arguments, "--out", tmp_path / "plan.json")
        expect(finished, code, *([hints] if isinstance(hints, str) else hints))
        assert sorted(tmp_path.rglob("*")) == before

    return check


def test_no_such_folder(refused: Callable[..., None], tmp_path: Path) -> None:
    refused(("there is no ", "nowhere; give a folder of meshes or a file"), tmp_path / "nowhere")


def test_no_name_at_all(refused: Callable[..., None]) -> None:
    refused("the structure has no name", "")


def test_an_empty_path_is_not_the_present_folder(falsework: Run) -> None:
    expect(falsework("doctor", ""), 2, "PATH is empty; name a file or folder")
    expect(falsework("plan", ".", "--out", ""), 2, "--out is empty; name a file or folder")
    expect(falsework("plan", ".", "--out="), 2, "--out is empty; name a file or folder")


def test_no_such_built_in(refused: Callable[..., None]) -> None:
    refused("built-in structure 'arhc:blocks=7'; built in are arch, ", "arhc:blocks=7")


@pytest.mark.parametrize(
    ("spec", "hint"),
    [
        ("arch:bloks=7", "arch has no parameter 'bloks'; it has blocks, radius"),
        ("arch:blocks=many", "blocks is many; give a whole number from 3 to 1000 (voussoirs)"),
        ("arch:blocks", "'blocks' is not name=value, such as blocks=15"),
        ("arch:blocks=-3", "blocks is -3; give a whole number from 3 to 1000 (voussoirs)"),
    ],
)
def test_wrong_parameters_of_a_built_in(spec: str, hint: str, refused: Callable[..., None]) -> None:
    refused(hint, spec)


def test_a_negative_seed(refused: Callable[..., None]) -> None:
    refused("a seed is not negative", "arch:blocks=7", "--seed", "-1")


def test_folder_without_meshes(refused: Callable[..., None], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    refused(("no mesh in ", "empty; put one file per part there"), tmp_path / "empty")


def test_damaged_description(refused: Callable[..., None], stack: Path) -> None:
    (stack / "assembly.json").write_text('{"boundary": [0')
    refused(("cannot read ", "assembly.json: ", "line 1, column 16", "write it again"), stack)


def test_mesh_not_closed(refused: Callable[..., None], stack: Path) -> None:
    # Only the lower half of a cube: there is no single way to close it.
    (stack / "1.obj").write_text(CUBE + "f 1 3 2\nf 1 4 3\nf 1 2 6\nf 1 6 5\n")
    refused("part 1 is not closed: 6 edges have a face on one side only; close it", stack)


def test_mesh_that_is_safe_to_repair_is_repaired_with_a_warning(
    falsework: Run, write_structure: Write, tmp_path: Path
) -> None:
    folder = write_structure(tmp_path / "turned")
    text = (folder / "1.obj").read_text().splitlines()
    turned = [line if line[0] == "v" else "f " + " ".join(reversed(line.split()[1:])) for line in text]
    (folder / "1.obj").write_text("\n".join(turned))  # every face looks inwards
    finished = falsework("export", folder, "--out", tmp_path / "out")
    assert finished.code == 0
    assert finished.error.startswith("falsework: warning: ")
    assert finished.error.count("\n") == 1
    assert "part 1 was repaired: " in finished.error


def test_zero_volume(refused: Callable[..., None], stack: Path) -> None:
    (stack / "2.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 3 2\n")
    refused("part 2 has no volume; export it as a solid", stack)


def test_interpenetration_names_both_parts_and_the_depth(
    refused: Callable[..., None], write_structure: Write, tmp_path: Path
) -> None:
    folder = write_structure(tmp_path / "deep", [BOTTOM, ((0, 0, 0.5), (2, 1, 2)), TOP])
    refused("parts 0 and 1 pass through each other by 500 mm", folder)


def test_parts_missing(refused: Callable[..., None], write_structure: Write, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "gone", parts=4)
    refused("gone has 3 meshes, but assembly.json says 4 parts", folder)


def test_ids_doubled(refused: Callable[..., None], write_structure: Write, tmp_path: Path) -> None:
    refused("boundary names part 0 twice; give every id once", write_structure(tmp_path / "twice", boundary=[0, 0]))


def test_boundary_out_of_range(refused: Callable[..., None], stack: Path) -> None:
    refused("boundary is part 3, which does not exist; give an id from 0 to 2", stack, "--boundary", "0,3")


def test_boundary_is_no_list_of_parts(refused: Callable[..., None], stack: Path) -> None:
    refused("boundary is part 'none'", stack, "--boundary", "none")


def test_no_boundary_offers_the_ground(
    refused: Callable[..., None], falsework: Run, write_structure: Write, tmp_path: Path
) -> None:
    folder = write_structure(tmp_path / "loose", boundary=[])
    refused("--ground", folder)
    finished = falsework("export", folder, "--out", tmp_path / "grounded", "--ground", "--json")
    assert finished.code == 0
    assert finished.answer["parts"] == 4


def test_part_that_touches_nothing(refused: Callable[..., None], write_structure: Write, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "apart", [BOTTOM, MIDDLE, ((9, 9, 9), (10, 10, 10))])
    refused(("2", "touches"), folder)


def test_units_that_make_parts_too_large(refused: Callable[..., None], write_structure: Write, tmp_path: Path) -> None:
    boxes = [(tuple(2000 * x for x in low), tuple(2000 * x for x in high)) for low, high in (BOTTOM, MIDDLE, TOP)]
    refused("unit", write_structure(tmp_path / "large", boxes))


def test_units_that_make_parts_too_small(refused: Callable[..., None], write_structure: Write, tmp_path: Path) -> None:
    boxes = [(tuple(0.02 * x for x in low), tuple(0.02 * x for x in high)) for low, high in (BOTTOM, MIDDLE, TOP)]
    refused("unit", write_structure(tmp_path / "small", boxes), "--unit", "mm")


def test_unknown_unit(refused: Callable[..., None], stack: Path) -> None:
    refused(("furlong", "mm"), stack, "--unit", "furlong")


@pytest.mark.parametrize("value", ["-0.1", "nan", "inf"])
def test_wrong_friction(value: str, refused: Callable[..., None], stack: Path) -> None:
    refused("friction", stack, "--friction", value)


@pytest.mark.parametrize("value", ["0", "-5", "nan"])
def test_wrong_density(value: str, refused: Callable[..., None], stack: Path) -> None:
    refused("density", stack, "--density", value)


def test_nan_in_a_mesh(refused: Callable[..., None], stack: Path) -> None:
    (stack / "2.obj").write_text((stack / "2.obj").read_text().replace("v 0.5", "v nan", 1))
    refused("part 2: vertex 0 is NaN or infinite; export the mesh again", stack)


@pytest.mark.parametrize(
    ("states", "hint"),
    [
        ([[2, 1]], "states have shape (1, 2); expected (batch, 3), one value for each part"),
        ([[2, 1, 3]], "state 0 has value 3 at part 2; use 0 (removed), 1 (installed) or 2 (held)"),
        ([[1, 1, 1]], "state 0 has boundary part 0 as 1; boundary parts are always 2"),
        ([[2, 1, 1], [2, 1]], "states have different lengths; each needs 3 values"),
        ("text", "contains no list; give a JSON list of states"),
    ],
)
def test_wrong_states(states: object, hint: str, falsework: Run, stack: Path, tmp_path: Path) -> None:
    file = tmp_path / "states.json"
    file.write_text(json.dumps(states))
    expect(falsework("stability", stack, "--states", file), 2, hint)


def test_wrong_array_of_states(falsework: Run, stack: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "states.npy", np.ones((2, 7)))
    expect(falsework("stability", stack, "--states", tmp_path / "states.npy"), 2, "shape (2, 7); expected (batch, 3)")


def test_no_file_of_states(falsework: Run, stack: Path, tmp_path: Path) -> None:
    expect(falsework("stability", stack, "--states", tmp_path / "none.npy"), 2, "there is no file", "none.npy")


@pytest.mark.parametrize("robots", ["0", "-1"])
def test_fewer_than_one_robot(robots: str, refused: Callable[..., None], stack: Path) -> None:
    refused(f"{robots} robots cannot hold anything; give at least 1", stack, "--robots", robots)


def test_robots_that_no_plan_file_could_hold(refused: Callable[..., None], stack: Path) -> None:
    refused(("robots are too many", "1000000"), stack, "--robots", str(2**64))


def test_a_plan_in_place_of_a_structure(refused: Callable[..., None], tmp_path: Path) -> None:
    (tmp_path / "old.json").write_text('{"format": "falsework.plan/2"}')
    refused(("old.json", "falsework.plan/2, not a structure"), tmp_path / "old.json")
    (tmp_path / "list.json").write_text("[]")
    refused(("list.json", "a structure is a folder"), tmp_path / "list.json")


def test_the_description_stands_for_its_folder(falsework: Run, stack: Path) -> None:
    finished = falsework("stability", stack / "assembly.json")
    assert finished.code == 0, finished.error


@pytest.mark.parametrize(("name", "hint"), [("folder", "is a folder, not a plan"), ("picture.png", "it is no text")])
def test_no_plan(name: str, hint: str, falsework: Run, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\xff")
    expect(falsework("check", tmp_path / name), 2, name, hint, "name another file")


@pytest.mark.parametrize(
    ("option", "value", "hint"),
    [
        ("--missing", "0", "missing part 0 is boundary, which is always there; leave it out"),
        ("--missing", "9", "missing part 9 does not exist; parts are numbered 0 to 2"),
        ("--missing", "lid", "--missing lid: 'lid' is not a part; give numbers such as 3,4"),
        ("--fixed", "1,1", "fixed part 1 is listed twice; list it once"),
        ("--end", "211111", "--end 211111: a state of 6 values does not fit 3 parts"),
        ("--begin", "somewhere", "--begin somewhere: 'somewhere' is neither a part nor a file; give complete, empty"),
        ("--alternatives", "0", "alternatives is 0; give at least 1"),
    ],
)
def test_wrong_task(option: str, value: str, hint: str, refused: Callable[..., None], stack: Path) -> None:
    refused(hint, stack, option, value)


def test_complete_structure_unstable(refused: Callable[..., None], write_structure: Write, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "leaning", [BOTTOM, ((1.2, 0, 1), (4.2, 1, 2))])
    # The question is understood and there is no plan: the answer is no, and the line says which part falls.
    refused(("complete structure is unstable", "part 1"), folder, code=1)


def test_place_that_cannot_be_written(falsework: Run, stack: Path, tmp_path: Path) -> None:
    finished = falsework("plan", stack, "--out", tmp_path / "no" / "plan.json")
    expect(finished, 2, "cannot write ", "plan.json: there is no folder ", "make it first")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a file system that refuses files")
def test_places_are_tried_before_the_work(falsework: Run, write_structure: Write, stack: Path, tmp_path: Path) -> None:
    """A structure that leans has no plan, which a command would say with another exit code if it searched first."""
    leaning = write_structure(tmp_path / "leaning", [BOTTOM, ((1.2, 0, 1), (4.2, 1, 2))])
    for command, name in (("plan", "plan.json"), ("graph", "graph.npz")):
        for place in (f"/proc/{name}", f"/sys/{name}"):
            expect(falsework(command, leaning, "--out", place), 2, f"cannot write {place}: ")
    expect(falsework("export", stack, "--out", "/proc/parts"), 2, "cannot write into /proc/parts: ")
    expect(falsework("picture", stack, "--out", "/proc/picture.png"), 2, "cannot write /proc/picture.png: ")


@pytest.mark.parametrize("options", [(), ("--sets", "64,128")])
def test_archives_are_not_written_under_names_of_other_files(
    options: tuple[str, ...], falsework: Run, tmp_path: Path
) -> None:
    """They could not be read again by that name."""
    name = tmp_path / "out.json"
    expect(
        falsework("graph", "arch:blocks=3", *options, "--out", name), 2, "out.json is written as .npz; name such a file"
    )


def test_a_run_or_a_cell_is_no_structure(falsework: Run, tmp_path: Path) -> None:
    (tmp_path / "cell.toml").write_text("")
    expect(falsework("plan", tmp_path / "cell.toml"), 2, "cell.toml is no structure; a cell is given by --cell")
    (tmp_path / "run.json").write_text("{}")
    expect(falsework("stability", tmp_path), 2, "is a run of falsework train, and no structure; name the one")


def test_export_does_not_replace_what_is_there(falsework: Run, stack: Path) -> None:
    before = {path: path.read_bytes() for path in stack.iterdir()}
    expect(falsework("export", stack, "--out", stack), 2, "exists and is not empty; choose a new folder")
    assert {path: path.read_bytes() for path in stack.iterdir()} == before

"""`falsework stability`, `structures` and `export` on structures whose answers are known."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, find_plans, load_structure
from falsework.assembly.store import save_assembly
from falsework.search.find import PLANS
from falsework.search.plans.plan_file import save_plan

Run = Callable[..., Any]
Write = Callable[..., Path]


def turned(folder: Path, boxes: Any, write_structure: Write, *turns: tuple[str, float], **description: Any) -> Path:
    """Boxes, turned together about axes by degrees, one turn after the other."""
    write_structure(folder, boxes, **description)
    matrix = np.eye(3)
    for axis, degrees in turns:
        matrix = rotation(axis, math.radians(degrees)) @ matrix
    for file in folder.glob("*.obj"):
        lines = []
        for line in file.read_text().splitlines():
            if line.startswith("v "):
                line = "v {!r} {!r} {!r}".format(*(matrix @ [float(value) for value in line.split()[1:]]).tolist())
            lines.append(line)
        file.write_text("\n".join(lines) + "\n")
    return folder


def rotation(axis: str, angle: float) -> np.ndarray:
    """Right-handed rotation about a coordinate axis, radians."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[[first, second], [first, second]] = math.cos(angle)
    matrix[second, first], matrix[first, second] = math.sin(angle), -math.sin(angle)
    return matrix


def slope(folder: Path, degrees: float, write_structure: Write) -> Path:
    """A block on a slope that goes down towards +x."""
    boxes = [((-2, -1, -1), (2, 1, 0)), ((-0.5, -0.5, 0), (0.5, 0.5, 0.4))]
    return turned(folder, boxes, write_structure, ("y", degrees))


def test_a_beam_on_a_ridge_is_judged_with_a_warning(falsework: Run, beam_on_ridge: Assembly, tmp_path: Path) -> None:
    folder = save_assembly(beam_on_ridge, tmp_path / "beam")
    finished = falsework("stability", folder)
    assert finished.code == 0
    line = "falsework: warning: parts roof and beam touch along a line only: verdicts may depend on it\n"
    assert finished.error == line


def test_a_block_slips_past_the_angle_of_friction(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    folder = slope(tmp_path / "slope", 20.0, write_structure)
    limit = math.tan(math.radians(20.0))
    stable = falsework("stability", folder, "--friction", limit * 1.02, "--json")
    assert stable.code == 0
    assert stable.answer["states"][0]["verdict"] == "stable"
    assert (stable.answer["states"][0]["proof"], stable.answer["states"][0]["criterion"]) == ("displacement", "contact")
    assert stable.answer["states"][0]["residual"] <= 1e-4
    assert stable.answer["states"][0]["moving"] == []
    slips = falsework("stability", folder, "--friction", limit * 0.98, "--json")
    assert slips.code == 1
    (record,) = slips.answer["states"]
    assert (record["verdict"], record["proof"]) == ("unstable", "velocity")
    assert [motion["part"] for motion in record["moving"]] == [1]
    # Down the slope: towards +x, and not turning.
    assert record["moving"][0]["words"] == "slides towards +x"
    assert record["moving"][0]["translation"][2] < 0


def test_people_are_told_which_part_moves_and_how(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    folder = slope(tmp_path / "slope", 60.0, write_structure)
    finished = falsework("stability", folder)
    assert finished.code == 1
    assert finished.out.count("\n") == 1
    assert "unstable" in finished.out
    assert "part 1 slides down and towards +x" in finished.out


@pytest.mark.parametrize(("text", "code", "words"), [("1", 0, "stable"), ("2", 1, "falls"), ("2100", 2, "4 values")])
def test_a_number_alone_is_a_part_and_not_the_digits_of_a_state(
    falsework: Run, stack: Path, text: str, code: int, words: str
) -> None:
    finished = falsework("stability", stack, "--states", text)
    assert finished.code == code
    assert words in finished.out + finished.error


def test_states_from_a_file_get_one_record_each(falsework: Run, stack: Path, tmp_path: Path) -> None:
    states = [[2, 1, 1], [2, 0, 1], [2, 0, 2], [2, 0, 0], [2, 2, 1]]
    verdicts = ["stable", "unstable", "stable", "stable", "stable"]
    (tmp_path / "states.json").write_text(json.dumps(states))
    np.save(tmp_path / "states.npy", np.array(states, dtype=np.int64))
    for name in ("states.json", "states.npy"):
        finished = falsework("stability", stack, "--states", tmp_path / name, "--json")
        assert finished.code == 1
        assert [record["verdict"] for record in finished.answer["states"]] == verdicts
        assert [record["state"] for record in finished.answer["states"]] == [0, 1, 2, 3, 4]
        assert finished.error == ""
    falling = finished.answer["states"][1]["moving"][0]
    assert (falling["part"], falling["words"]) == (2, "falls")


def test_the_octagon_lies_inside_the_round_cone(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    # A bar in a sloping V-shaped trough slips along neither tangent of its contacts, where the octagon is narrower.
    boxes = [((-1, 0, -1), (1, 1, 0)), ((-1, -1, 0), (1, 0, 1)), ((-0.5, 0, 0), (0.5, 1, 1))]
    folder = turned(tmp_path / "trough", boxes, write_structure, ("x", 45), ("y", 16), boundary=[0, 1])
    codes = {
        cone: [
            falsework("stability", folder, "--friction", mu, "--cone", cone).code for mu in np.arange(0.15, 0.26, 0.01)
        ]
        for cone in ("octagon", "quadratic")
    }
    for octagon, quadratic in zip(codes["octagon"], codes["quadratic"], strict=True):
        assert quadratic <= octagon  # what the octagon holds, the round cone holds
    assert sum(codes["octagon"]) > sum(codes["quadratic"]) > 0


def test_ground_makes_a_loose_stack_stand(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    folder = write_structure(tmp_path / "loose", boundary=[])
    assert falsework("stability", folder, "--ground").code == 0


def test_units_do_not_change_the_answer(falsework: Run, stack: Path) -> None:
    metres, millimetres = (falsework("stability", stack, "--unit", unit, "--json") for unit in ("m", "cm"))
    assert metres.code == millimetres.code == 0


def test_structures_lists_what_can_be_built(falsework: Run) -> None:
    machine, people = falsework("structures", "--json"), falsework("structures")
    assert machine.code == people.code == 0
    assert {"arch", "vault", "dome", "bottle"} <= {record["name"] for record in machine.answer["structures"]}
    for record in machine.answer["structures"]:
        assert record["name"] in people.out
        defaults = ",".join(f"{parameter['name']}={parameter['default']}" for parameter in record["parameters"])
        assert load_structure(f"{record['name']}:{defaults}").part_count > 1


def test_export_writes_what_was_built(falsework: Run, tmp_path: Path) -> None:
    finished = falsework("export", "arch:blocks=5", "--out", tmp_path / "arch", "--json")
    assert finished.code == 0
    assert finished.answer["identity"] == load_structure(tmp_path / "arch").identity
    assert falsework("stability", tmp_path / "arch").code == 0


@pytest.mark.slow
def test_real_structures_stand(falsework: Run, shared_assembly: Callable[[str], Path]) -> None:
    for name in ("bottle-12", "dome-37", "vault-62"):
        assert falsework("stability", shared_assembly(name)).code == 0


@pytest.mark.parametrize(
    ("structure", "words"),
    [
        ("arch", "arch: stable; contact forces balance every part (left over: "),
        ("arch:thickness=0.05", "unstable; whatever the contact forces, a part accelerates (by at least "),
    ],
)
def test_a_verdict_comes_with_what_its_proof_shows(falsework: Run, structure: str, words: str) -> None:
    assert words in falsework("stability", structure).out


@pytest.mark.parametrize("solver", ["cpu", "exact"])
def test_solvers_agree_on_an_arch(falsework: Run, solver: str) -> None:
    assert falsework("stability", "arch", "--solver", solver).code == 0
    assert falsework("stability", "arch:thickness=0.05", "--solver", solver).code == 1


def test_a_gpu_that_is_not_there_gets_one_line(falsework: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from falsework.errors import DependencyError

    def missing(*_: Any) -> None:
        raise DependencyError("no GPU here")

    monkeypatch.setattr("falsework.stability.gpu.solver.GpuSolver", missing)
    result = falsework("stability", "arch", "--solver", "gpu")
    assert result.code == 2
    assert "no GPU here" in result.error
    assert falsework("stability", "arch", "--solver", "auto").code == 0


def test_a_block_between_two_walls_slides(falsework: Run, write_structure: Write, tmp_path: Path) -> None:
    """Forces in equilibrium exist, since walls may press as hard as they like, and nothing makes them press."""
    boxes = {"wall-1": ((0, 0, 0), (1, 1, 1)), "block": ((1, 0, 0.2), (2, 1, 0.8)), "wall-2": ((2, 0, 0), (3, 1, 1))}
    folder = tmp_path / "clamp"
    folder.mkdir()
    for number, (low, high) in enumerate(boxes.values()):
        corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
        (folder / f"{number}.obj").write_text("\n".join(lines) + "\n")
    (folder / "assembly.json").write_text('{"boundary": [0, 2]}')
    found = falsework("stability", folder, "--json")
    assert found.code == 1
    (record,) = found.answer["states"]
    assert (record["verdict"], record["proof"], record["criterion"]) == ("slides", "forces", "contact")
    said = falsework("stability", folder).out
    assert "clamp: slides; forces in balance exist (left over: " in said
    assert "but parts slide before contacts build them up; part 1 falls" in said
    paper = falsework("stability", folder, "--criterion", "equilibrium", "--json")
    assert paper.code == 0
    assert paper.answer["states"][0]["verdict"] == "stable"


@pytest.mark.parametrize("command", ["stability", "plan"])
@pytest.mark.parametrize(
    ("options", "doubt"),
    [
        (("--density", 2.4), "the density is 2.4 kg/m3, which no building material has"),
        (("--friction", 35), "a coefficient of friction is 35; it is the tangent of an angle"),
    ],
)
def test_nonsense_is_not_certified_in_silence(
    command: str, options: tuple[str, float], doubt: str, falsework: Run, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "plan.json") if command == "plan" else ()
    done = falsework(command, "arch:blocks=3", *options, *out, "--json")
    assert doubt in done.error
    assert any(doubt in note for note in done.answer["notes"])


def test_states_of_a_plan_are_judged_under_its_gravity(falsework: Run, tmp_path: Path) -> None:
    """A block is pulled up by one and a half times its weight on the earth: it lies where it weighs twice as much."""
    source = {"built_in": "stack:blocks=1,overhang=0.2"}
    weight = float(load_structure(source["built_in"]).applied_wrench()[0, 2])
    loads = {"loads": [{"part": 0, "force": [0, 0, -1.5 * weight]}]}
    stack, file = load_structure(source["built_in"], **loads), tmp_path / "plan.json"
    plan = find_plans(stack, robots=1, stability=replace(PLANS, gravity=2 * 9.81)).unwrap()
    save_plan(replace(plan, source=source | loads), file)
    for command in ("stability", "margins"):
        assert falsework(command, file).code == 0


def test_a_plan_without_steps_has_a_state(falsework: Run, tmp_path: Path) -> None:
    slab, file = load_structure("stack:blocks=1", boundary=[0, 1]), tmp_path / "plan.json"
    plan = find_plans(slab, robots=1).unwrap()
    save_plan(replace(plan, source={"built_in": "stack:blocks=1", "boundary": [0, 1]}), file)
    for command in ("stability", "margins"):
        assert falsework(command, file).code == 0


def test_states_of_a_plan_are_judged_as_built_too(falsework: Run, tmp_path: Path) -> None:
    """A plan that `plan` and `check` accept is accepted here; where its states slide from rest, both are said."""
    plan = tmp_path / "plan.json"
    assert falsework("plan", "vault", "--out", plan).code == 0
    done = falsework("stability", plan, "--json")
    assert done.code == 0
    states = done.answer["states"]
    assert {record["as_built"] for record in states} == {"stable"}
    both = [record["state"] for record in states if record["verdict"] == "slides"]
    assert both, "no state of this plan slides from rest; take another structure"
    text = falsework("stability", "vault", "--states", f"{plan}:{both[0]}")
    assert text.code == 0
    assert text.out.startswith(f"{both[0]} ")
    assert "stable as built, slides from rest; forces in balance exist" in text.out
    assert "stable as built, stable from rest" in falsework("stability", plan, "--states", f"{plan}:0").out
    margins = falsework("margins", "vault", "--states", f"{plan}:{both[0]}", "--json")
    assert margins.code == 0
    assert (margins.answer["states"][0]["state"], margins.answer["states"][0]["stands"]) == (both[0], True)
    equilibrium = falsework("stability", plan, "--states", f"{plan}:0", "--criterion", "equilibrium", "--json")
    assert equilibrium.answer["states"][0]["as_built"] is None

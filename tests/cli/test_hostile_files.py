"""Files that are nested without end, or claim numbers and sizes that no machine holds, get one clear line."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import find_plans, load_cell, make_task
from falsework.errors import CellError, InputError, PlanError
from falsework.interop.compas_read import READER as COMPAS
from falsework.robots.plans.robot_plan_file import load_robot_plan
from falsework.search.plans.plan_file import load_plan
from falsework.search.problem.state_graph import load_state_graph
from falsework.utils.archive import read_archive
from falsework.utils.json_text import LEVELS, parse_json

Run = Callable[..., Any]

NESTED = {"just too deep": "[" * (LEVELS + 1) + "]" * (LEVELS + 1), "far too deep": "[" * 200_000}
HUGE = {"30 digits": "1" + "0" * 30, "400 digits": "1" + "0" * 400, "5000 digits": "1" + "0" * 5000}
VALUES = {**NESTED, **HUGE, "infinite": "1e999", "not a number": "NaN"}


def refused(finished: Any, *hints: str) -> None:
    assert finished.code == 2, finished.error
    assert finished.error.startswith("falsework: "), finished.error
    assert finished.error.count("\n") == 1
    assert "defect" not in finished.error
    assert finished.out == ""
    for hint in hints:
        assert hint in finished.error, finished.error


def npy(shape: tuple[int, ...]) -> bytes:
    """A `.npy` file of a few bytes that claims a shape."""
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return out.getvalue() + b"\0" * 64


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
@pytest.mark.parametrize("key", ["friction", "density", "boundary", "names", "parts", "contact", "name", "other"])
def test_assembly_json(falsework: Run, stack: Path, tmp_path: Path, key: str, value: str) -> None:
    (stack / "assembly.json").write_text(f'{{"boundary": [0], "{key}": {value}}}')
    finished = falsework("plan", stack, "--out", tmp_path / "plan.json")
    if key == "other" and value in ("1e999", "NaN"):
        assert finished.code == 0  # entries that are not known are passed over
    else:
        refused(finished, "assembly.json" if value in (*NESTED.values(), *HUGE.values()) else "")


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_contact_tolerances(falsework: Run, stack: Path, tmp_path: Path, value: str) -> None:
    (stack / "assembly.json").write_text(f'{{"boundary": [0], "contact": {{"gap": {value}}}}}')
    refused(falsework("plan", stack, "--out", tmp_path / "plan.json"))


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_states(falsework: Run, stack: Path, tmp_path: Path, value: str) -> None:
    file = tmp_path / "states.json"
    for text in (value, f"[[2, 1, {value}]]"):
        file.write_text(text)
        refused(falsework("stability", stack, "--states", file))
    refused(falsework("plan", stack, "--end", f"[2, 1, {value[:3000]}]", "--out", tmp_path / "plan.json"))


@pytest.mark.parametrize("shape", [(10**30,), (10**10, 10**10, 10**10), (2**62,), (10**15, 3)])
def test_arrays_that_claim_too_much(falsework: Run, stack: Path, tmp_path: Path, shape: tuple[int, ...]) -> None:
    file = tmp_path / "states.npy"
    file.write_bytes(npy(shape))
    refused(falsework("stability", stack, "--states", file), "states.npy")
    archive = tmp_path / "graph.npz"
    with zipfile.ZipFile(archive, "w") as out:
        out.writestr("states.npy", npy(shape))
    refused(falsework("view", archive), "graph.npz")
    with pytest.raises(InputError, match="damaged"):
        load_state_graph(archive)


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_headers_of_archives(tmp_path: Path, value: str) -> None:
    np.savez(tmp_path / "some.npz", header=np.array(value))
    with pytest.raises(InputError, match=r"some\.npz"):
        read_archive(tmp_path / "some.npz", "falsework.graph/1")


def test_archives_with_damaged_bytes(tmp_path: Path) -> None:
    """Wherever a byte of an archive is wrong, it is the archive that is said to be damaged, or nothing was lost."""
    file = tmp_path / "some.npz"
    np.savez_compressed(file, header=np.array(json.dumps({"format": "some/1"})), values=np.arange(200.0))
    good = file.read_bytes()
    refusals = []
    for place in range(0, len(good), 7):
        file.write_bytes(good[:place] + bytes([good[place] ^ 0xFF]) + good[place + 1 :])
        try:
            read_archive(file, "some/1")
        except InputError as error:
            refusals.append(str(error))
    assert len(refusals) > 10
    assert all(text.startswith(str(file)) for text in refusals)


def leaves(data: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to values in JSON data that are no list or object; of every list, to those in its last entry."""
    if isinstance(data, dict):
        return [leaf for key, value in data.items() for leaf in leaves(value, (*path, key))]
    if isinstance(data, list) and data:
        return leaves(data[-1], (*path, len(data) - 1))
    return [path]


def replaced(data: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    copy = data.copy()
    copy[path[0]] = replaced(data[path[0]], path[1:], value)
    return copy


@pytest.fixture(scope="module")
def plan_data() -> dict[str, Any]:
    """A small plan as JSON values."""
    from falsework import load_structure
    from falsework.search.plans.plan_file import plan_to_dict

    assembly = load_structure("arch:blocks=3")
    return plan_to_dict(find_plans(assembly, make_task(assembly, 2)).plans[0], proofs=True)


def test_plans(falsework: Run, tmp_path: Path, plan_data: dict[str, Any]) -> None:
    """Any value of a plan may be replaced by a hostile one."""
    file = tmp_path / "plan.json"
    for value in VALUES.values():
        file.write_text(value)
        refused(falsework("check", file), "plan.json")
    for path in leaves(plan_data):
        for value in (10**30, 10**400, float("inf"), float("nan"), -(2**63)):
            file.write_text(json.dumps(replaced(plan_data, path, value)))
            with pytest.raises(PlanError, match=r"plan\.json"):
                load_plan(file)
        file.write_text(json.dumps(replaced(plan_data, path, 2**63 - 1)))  # a fine number of robots
        assert "defect" not in falsework("check", file, "--structure", "arch:blocks=3").error, path


def test_robot_plans(falsework: Run, tmp_path: Path, plan_data: dict[str, Any]) -> None:
    pose, still = np.eye(4).tolist(), [0.0, 0.0]
    robot = {"name": "arm", "model": "m", "joints": ["a", "b"], "base": pose, "gripper": "cup", "tool": pose}
    frame = {"configurations": [still], "held": [None]}
    motion = {
        "kind": "free", "part": None, "touches": None, "times": [0, 1], "positions": [still, still],
        "velocities": [still, still],
    }  # fmt: skip
    steps = len(plan_data["steps"])
    data = {
        "format": "falsework.robot-plan/3",
        "direction": "disassembly",
        "cell": {"name": "cell", "identity": "0", "robots": [robot]},
        "plan": plan_data,
        "keyframes": [frame] * (steps + 1),
        "steps": [{"do": "", "robot": 0, "trajectories": [motion]}] * steps,
        "schedule": None,
        "statistics": {},
    }
    file = tmp_path / "robot_plan.json"
    file.write_text(json.dumps(data))
    load_robot_plan(file)
    for value in VALUES.values():
        file.write_text(value)
        refused(falsework("robots", "check", file, "--cell", "dome-37"), "robot_plan.json")
    for path in leaves({key: data[key] for key in ("cell", "keyframes", "steps")}):
        for value in (10**30, 10**400, float("inf")):
            file.write_text(json.dumps(replaced(data, path, value)))
            if path[-1] != "do":
                with pytest.raises(PlanError, match=r"robot_plan\.json"):
                    load_robot_plan(file)


@pytest.mark.parametrize("value", [*NESTED.values(), *HUGE.values(), "inf", "nan"], ids=[*NESTED, *HUGE, "inf", "nan"])
def test_cells(tmp_path: Path, value: str) -> None:
    file = tmp_path / "cell.toml"
    for text in (f"floor = {value}\n", f"[placement]\nposition = [0, 0, {value}]\n"):
        file.write_text(f'format = "falsework.cell/1"\nname = "cell"\n{text}')
        with pytest.raises(CellError, match=r"cell\.toml"):
            load_cell(file)


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_compas_data(tmp_path: Path, value: str) -> None:
    mesh = {"vertex": {"0": {"x": 0, "y": 0, "z": 0}}, "face": {"0": [0, 1, 2]}}
    text = json.dumps({"dtype": "compas.datastructures/Mesh", "data": mesh})
    file = tmp_path / "blocks.json"
    for written in (value, text.replace('"x": 0', f'"x": {value}'), text.replace("[0, 1, 2]", f"[0, 1, {value}]")):
        file.write_text(written)
        with pytest.raises(InputError) as error:
            COMPAS.read(file)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_runs(falsework: Run, tmp_path: Path, value: str) -> None:
    pytest.importorskip("torch", reason="runs need torch; pip install 'falsework[learn]'")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text(value)
    refused(falsework("evaluate", tmp_path / "run"), "run.json")


def test_checkpoints(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="runs need torch; pip install 'falsework[learn]'")
    from safetensors.torch import save

    from falsework.learn.training.checkpoint import CHECKPOINT_FORMAT, CheckpointFile

    checkpoint = CheckpointFile(tmp_path)
    checkpoint.save({"weights": torch.zeros(2)}, {"generator": 2**100})  # states of generators have 128 bits
    assert checkpoint.load()[1] == {"generator": 2**100}
    for state in NESTED.values():
        header = {"format": CHECKPOINT_FORMAT, "state": "[" * 200_000 + state}
        checkpoint.path.write_bytes(save({"weights": torch.zeros(2)}, header))
        with pytest.raises(InputError, match="damaged"):
            checkpoint.load()
    claim = json.dumps({"weights": {"dtype": "F32", "shape": [10**30], "data_offsets": [0, 8]}}).encode()
    checkpoint.path.write_bytes(len(claim).to_bytes(8, "little") + claim + b"\0" * 8)
    with pytest.raises(InputError, match="damaged"):
        checkpoint.load()


def test_meshes_with_hostile_numbers(falsework: Run, stack: Path, tmp_path: Path) -> None:
    text = (stack / "1.obj").read_text()
    for line in (*(f"v {value} 0 0" for value in VALUES.values()), *(f"f 1 2 {value}" for value in HUGE.values())):
        (stack / "1.obj").write_text(f"{text}{line}\nf 1 2 9\n")
        refused(falsework("plan", stack, "--out", tmp_path / "plan.json"))


def test_json_within_the_limits_is_read() -> None:
    deep = "[" * LEVELS + "]" * LEVELS
    assert json.dumps(parse_json(deep)) == deep
    assert parse_json(f"[{2**63 - 1}, {-(2**63)}, 1.5]") == [2**63 - 1, -(2**63), 1.5]
    assert parse_json("7") == 7

"""Mutation fuzzer of all readers: files with random damage must be read, or refused in one line.

    make fuzz                                        ten minutes, each input in a process of its own
    python benchmarks/fuzz_readers.py --seed 3 --minutes 1 --kinds plan glb

A finding is any other exception, a message in the words of one, a crash, more than 30 seconds or 2 GiB, a file written
outside the folder of the input, or code that a file brings along. Findings are kept in a folder and printed as JSON,
one a line; the exit code is then 1. The tests read a fixed corpus of the same mutations.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from falsework import Assembly, Plan, StabilityOracle, StateGraph, export, find_plans, load_structure, make_task
from falsework.assembly.load import read_draft
from falsework.assembly.store import save_assembly
from falsework.cli.arguments import read_states
from falsework.errors import FalseworkError
from falsework.interop import to_compas
from falsework.search.plans.plan_file import load_plan, save_plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.search.problem.state_graph import load_state_graph, save_state_graph

SECONDS = 30
"""Longest time for an input."""
MEMORY = 2 << 30
"""Address space that an input may take beyond that of this process, bytes."""

CELL = """
format = "falsework.cell/1"
name = "one arm"
[structure]
position = [0.9, 0.0, 0.0]
scale = 0.5
[margins]
free = 0.004
[grippers.cup]
kind = "suction"
payload = 5.0
mass = 1.0
cup = 0.02
tool = { position = [0.0, 0.0, 0.1], rpy = [0, 0, 90] }
shapes = [{ cylinder = { radius = 0.03, low = 0.0, high = 0.099 } }]
[[robots]]
name = "arm"
model = "irb2600-12/1.65"
gripper = "cup"
base = { position = [0.0, 0.0, 0.0], yaw = 90 }
home = [0, -40, 30, 0, 60, 0]
places = [{ position = [0.1, -0.9, 0.5] }]
[[obstacles]]
name = "table"
box = { low = [-0.3, -0.3, 0.0], high = [0.3, 0.3, 0.4] }
position = [2.0, 0.0, 0.0]
"""
URDF = """<robot name="two">
<link name="base"><collision><origin xyz="0 0 -0.1"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision></link>
<link name="one"><collision><geometry><mesh filename="arm.obj" scale="1 1 -1"/></geometry></collision></link>
<link name="two"><collision><geometry><cylinder radius="0.05" length="0.1"/></geometry></collision></link>
<link name="finger"><visual><geometry><sphere radius="0.05"/></geometry></visual></link>
<link name="tool0"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="2"/><safety_controller soft_lower_limit="-0.5" soft_upper_limit="0.7"/></joint>
<joint name="slide" type="prismatic"><parent link="one"/><child link="two"/><origin xyz="0 0 0.4" rpy="0 0.1 0"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.3" velocity="1" effort="9"/></joint>
<joint name="open" type="prismatic"><parent link="two"/><child link="finger"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.1" velocity="1"/></joint>
<joint name="mount" type="fixed"><parent link="two"/><child link="tool0"/><origin xyz="0 0 0.05"/></joint>
</robot>"""
SRDF = """<robot name="two"><group name="arm"><chain base_link="base" tip_link="tool0"/></group>
<disable_collisions link1="base" link2="two" reason="Never"/><enable_collisions link1="one" link2="two"/></robot>"""
WEDGE = "v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
PYTHON = re.compile(r"\b[A-Z][a-z]\w*(Error|Exception)\b|NoneType|has no attribute|not subscriptable")
"""Words of exceptions, which say nothing about a file."""
FRAME = {"point": [0, 0, 0.5], "xaxis": [1, 0, 0], "yaxis": [0, 1, 0]}
SHAPES = [
    {"dtype": "compas.geometry/Box", "data": {"frame": FRAME, "xsize": 1, "ysize": 1, "zsize": 1}},
    {
        "dtype": "compas.geometry/Cylinder",
        "data": {"frame": {"data": FRAME | {"point": [9, 0, 0.5]}}, "radius": 1, "height": 1},
    },
    {
        "dtype": "compas.geometry/Torus",
        "data": {"frame": FRAME | {"point": [5, 0, 0]}, "radius_axis": 1, "radius_pipe": 0.5},
    },
    {
        "dtype": "compas.geometry/Polyhedron",
        "data": {
            "vertices": [[0, 5, 0], [1, 5, 0], [0, 6, 0], [0, 5, 1]],
            "faces": [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
        },
    },
]
CONDITIONS = {
    "displacements": [{"block_index": 3, "translation": [0, 0, 0]}],
    "point_loads": [{"block_index": 1, "force": [1.0, 0, 0], "point": [0.0, 0, 1]}],
    "body_forces": [{"acceleration": [0, 0, 0.1]}],
}
BRICKS = "2x4 (0,0,0)\n2x4 (2,0,0)\n2x4 (1,0,1)\n1x2 (1,0,2)\n"
LDRAW = "0 FILE main.ldr\n1 4 0 -24 0 1 0 0 0 1 0 0 0 1 3001.dat\n1 4 0 -48 0 1 0 0 0 1 0 0 0 1 3003.dat\n"


@dataclass(frozen=True)
class Kind:
    """Kind of file: an intact example, and the reader."""

    content: bytes
    name: str
    read: Callable[[Path], object]
    beside: dict[str, bytes]
    """Further files of its folder, which stay intact."""


def kinds(scratch: Path) -> dict[str, Kind]:
    """Make an intact file of every kind whose packages are installed."""
    assembly = load_structure("arch:blocks=3")
    task = make_task(assembly, 2)
    plan = find_plans(assembly, task).plans[0]
    found = dict(_structures(assembly, scratch))
    save_plan(replace(plan, source={"built_in": "arch:blocks=3"}), scratch / "plan.json", proofs=True)
    found["plan"] = _kind(scratch / "plan.json", _read_plan)
    oracle = StabilityOracle(assembly)
    graph = StateGraph.from_states(task.judged_by(oracle), plan.states, name=assembly.name)
    save_state_graph(graph, scratch / "graph.npz")
    found["graph"] = _kind(scratch / "graph.npz", load_state_graph)
    np.save(scratch / "states.npy", plan.states)
    found["npy states"] = _kind(scratch / "states.npy", read_states)
    found["json states"] = Kind(json.dumps(plan.states.tolist()).encode(), "states.json", read_states, {})
    found |= dict(_robots(plan, assembly, scratch))
    found |= dict(_learning(assembly, plan, scratch))
    return found


def _kind(path: Path, read: Callable[[Path], object]) -> Kind:
    return Kind(path.read_bytes(), path.name, read, {})


def _read_plan(path: Path) -> object:
    return structure_of_plan(load_plan(path), path)


def _read_structure(path: Path) -> object:
    read_draft(path)
    return load_structure(path)


def _read_folder(path: Path) -> object:
    return load_structure(path.parent)


def _structures(assembly: Assembly, scratch: Path) -> Iterator[tuple[str, Kind]]:
    import trimesh

    folder = save_assembly(assembly, scratch / "folder")
    files = {entry.name: entry.read_bytes() for entry in folder.iterdir()}
    for name in ("assembly.json", "1.obj"):
        beside = {key: content for key, content in files.items() if key != name}
        yield name, Kind(files[name], name, _read_folder, beside)
    whole = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in assembly.meshes])
    for suffix in ("stl", "ply", "stl_ascii"):
        written = whole.export(None, file_type=suffix)
        yield (
            suffix,
            Kind(
                written if isinstance(written, bytes) else str(written).encode(), f"a.{suffix[:3]}", _read_structure, {}
            ),
        )
    export(assembly, scratch / "a.glb")
    yield "glb", _kind(scratch / "a.glb", _read_structure)
    for number, form in enumerate(("compas", "compas-assembly", "compas-dem")):
        path = scratch / f"compas-{number}.json"
        export(assembly, path, format=form)
        yield form, _kind(path, _read_structure)
        if form != "compas":
            yield f"interfaces of {form}", _kind(path, partial(load_structure, interfaces="compare"))
    law = {"dtype": "x/Law", "data": {"mu": 0.6, "c": 1e3, "t_c": 0.0}}
    problem = {
        "model": to_compas(assembly, "dem"), "contact_properties": {"data": {"contact_model": law}},
        "boundary_conditions": [{"data": CONDITIONS}],
    }  # fmt: skip
    for name, content in (
        ("compas problem", {"dtype": "compas_dem.problem/Problem", "data": problem}),
        ("compas shapes", SHAPES),
    ):
        yield name, Kind(json.dumps(content).encode(), "a.json", _read_structure, {})
    yield "bricks", Kind(BRICKS.encode(), "a.txt", _read_structure, {})
    yield "ldraw", Kind(LDRAW.encode(), "a.ldr", _read_structure, {})


def kinds_apart(assembly: Assembly, scratch: Path) -> Iterator[tuple[str, Kind]]:
    """Make files of the kinds that are read in processes of their own, which takes a second each."""
    try:
        import rhino3dm
    except ImportError:
        pass
    else:
        model = rhino3dm.File3dm()
        settings: Any = model.Settings  # the stubs of rhino3dm lag behind it
        settings.ModelUnitSystem = rhino3dm.UnitSystem.Meters
        for part in assembly.meshes:
            mesh = rhino3dm.Mesh()
            for corner in part.vertices.tolist():
                mesh.Vertices.Add(*corner)
            for face in part.faces.tolist():
                mesh.Faces.AddFace(*face)
            model.Objects.AddMesh(mesh)
        model.Write(str(scratch / "a.3dm"), 7)
        yield "rhino", _kind(scratch / "a.3dm", read_draft)
    try:
        from OCP.BRepPrimAPI import BRepPrimAPI_MakeBox
        from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer
    except ImportError:
        return
    writer = STEPControl_Writer()
    writer.Transfer(BRepPrimAPI_MakeBox(100, 100, 100).Shape(), STEPControl_StepModelType.STEPControl_AsIs)
    writer.Write(str(scratch / "a.step"))
    yield "step", _kind(scratch / "a.step", read_draft)


def _robots(plan: Plan, assembly: Assembly, scratch: Path) -> Iterator[tuple[str, Kind]]:
    from falsework import load_cell
    from falsework.robots import Keyframe, RobotPlan, RobotStep, Trajectory
    from falsework.robots.cells.cell_file import parse_cell
    from falsework.robots.model.cell import cell_identity
    from falsework.robots.plans.robot_plan import records_of
    from falsework.robots.plans.robot_plan_file import load_robot_plan, save_robot_plan

    yield "cell", Kind(CELL.encode(), "cell.toml", partial(load_cell, check=False), {})
    yield from _descriptions()
    cell = parse_cell(CELL, "cell.toml", Path())
    home = cell.robots[0].home
    still = np.stack([home, home])
    motion = Trajectory("free", np.array([0.0, 1.0]), still, np.zeros_like(still), None)
    frames = tuple(Keyframe((home,), (None,)) for _ in range(len(plan) + 1))
    made = RobotPlan(
        plan, frames, tuple(RobotStep(0, (motion,)) for _ in range(len(plan))), records_of(cell), cell.name,
        cell_identity(cell),
    )  # fmt: skip
    save_robot_plan(made, scratch / "robot-plan.json")
    yield "robot plan", _kind(scratch / "robot-plan.json", load_robot_plan)


def _descriptions() -> Iterator[tuple[str, Kind]]:
    """Yield the files of an arm, each read with the others intact."""
    try:
        import yourdfpy  # noqa: F401 - reads them
    except ImportError:
        return
    from falsework.robots import load_urdf

    files = {"arm.urdf": URDF.encode(), "arm.srdf": SRDF.encode(), "arm.obj": WEDGE.encode()}
    for name, content in files.items():
        beside = {key: other for key, other in files.items() if key != name}
        yield f"arm: {name}", Kind(content, name, lambda path: load_urdf(path.with_suffix(".urdf")), beside)


def _learning(assembly: Assembly, plan: Plan, scratch: Path) -> Iterator[tuple[str, Kind]]:
    try:
        import safetensors  # noqa: F401 - runs are kept in its format
        import torch  # noqa: F401
    except ImportError:
        return
    from falsework.learn import PolicySettings, TrainSettings, load_run, make_policy
    from falsework.learn.data.dataset import Dataset, load_dataset, save_dataset, training_task
    from falsework.learn.networks.factory import describe
    from falsework.learn.training.checkpoint import FILE, WEIGHTS, describe_structure, save_run

    states = plan.states
    data = Dataset(
        states[:2], states[2:3], states[3:4], states[4:], task=training_task(assembly, 2), name=assembly.name
    )
    save_dataset(data, scratch / "data.npz")
    yield "data set", _kind(scratch / "data.npz", partial(load_dataset, assembly=assembly))
    settings = TrainSettings(policy=PolicySettings("resmlp", channels=8, layers=1)).resolved(assembly.part_count, "cpu")
    policy = make_policy(assembly, settings.policy, "cpu", 0)
    metadata = {
        "structure": describe_structure(assembly, {"built_in": "arch:blocks=3"}),
        "settings": asdict(settings),
        "policy": describe(policy, settings.policy),
        "results": {},
        "versions": {},
    }
    save_run(scratch / "run", policy, metadata)
    files = {name: (scratch / "run" / name).read_bytes() for name in (FILE, WEIGHTS)}
    for name, other in ((FILE, WEIGHTS), (WEIGHTS, FILE)):
        yield f"run: {name}", Kind(files[name], name, lambda path: load_run(path.parent), {other: files[other]})


# Mutations.

VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 3.5, -0.0, 1e308, -1e308, 5e-324, 2**31, 2**63 - 1, -(2**63), 2**70, "", "0", "x",
    "\x1b[2J\n", "\ud800", "../../etc/passwd", [], {}, [[]], [None], [1, [2]], {"a": 1}, float("nan"), float("inf"),
    [0.0] * 3, "9" * 400, [[1, 2], [3]],
)  # fmt: skip
WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e400",
    "99999999999",
    "-0",
    "",
    "%s",
    "\x1b[2J",
    "\0",
    "é",
    "../a",
    "1.5.5",
    "(",
    "{",
)
BYTES = (b"\0", b"\xff", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\0\x80", b"\n", b'"', b"{" * 300, b"PK\3\4")


def mutate(kind: Kind, rng: random.Random) -> bytes:
    """Return the content of a kind with random damage that fits it: of values, of words, of arrays or of bytes."""
    content, suffix = kind.content, Path(kind.name).suffix
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        ways: list[Callable[[bytes, random.Random], bytes]] = [_bytes]
        if suffix == ".json":
            ways = [_json, _json, _json, _bytes]
        elif suffix in (".obj", ".txt", ".ldr", ".toml", ".step", ".urdf", ".srdf") or kind.content.startswith(
            (b"solid", b"ply")
        ):
            ways = [_words, _words, _lines, _bytes]
        elif suffix == ".npz":
            ways = [_archive, _archive, _archive, _bytes]
        elif suffix == ".glb":
            ways = [_glb, _bytes]
        content = rng.choice(ways)(content, rng)
    return content


def _bytes(content: bytes, rng: random.Random) -> bytes:
    at, length = rng.randrange(len(content) + 1), rng.choice((1, 1, 2, 4, 16, 200))
    match rng.randrange(6):
        case 0:
            return content[:at] + rng.choice(BYTES) + content[at + 1 :]
        case 1:
            return content[:at] + content[at + length :]
        case 2:
            return content[:at] + rng.choice(BYTES) + content[at:]
        case 3:
            return content[:at] + content[max(at - length, 0) : at] + content[at:]
        case 4:
            return content[: at + length]
    flipped = bytearray(content)
    for _ in range(length if flipped else 0):
        flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


def _words(content: bytes, rng: random.Random) -> bytes:
    found = list(re.finditer(rb"[^\s,\[\]{}=/<>\"]+", content))
    if not found:
        return _bytes(content, rng)
    chosen = rng.choice(found)
    word = rng.choice((*WORDS, rng.choice(found)[0].decode("utf-8", "replace"))).encode()
    return content[: chosen.start()] + word + content[chosen.end() :]


def _lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(3):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, rng.choice(lines))
        case _:
            lines[at], lines[-1] = lines[-1], lines[at]
    return b"\n".join(lines)


def _json(content: bytes, rng: random.Random) -> bytes:
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        return _bytes(content, rng)
    places = list(_places(data))
    if not places:
        return json.dumps(rng.choice(VALUES)).encode()
    holder, key = rng.choice(places)
    match rng.randrange(6):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, list):
            holder.insert(key, holder[key])
        case 1:
            holder[f"{key}x"] = holder[key]
        case 2:
            other, at = rng.choice(places)
            holder[key] = json.loads(json.dumps(other[at]))
        case 3:
            holder[key] = [holder[key]]
        case _:
            holder[key] = rng.choice(VALUES)
    return json.dumps(data).encode()


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every list or object in JSON values with each of its keys."""
    keys = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in keys:
        yield data, key
        yield from _places(data[key])


def _glb(content: bytes, rng: random.Random) -> bytes:
    length = int.from_bytes(content[12:16], "little")
    text = _json(content[20 : 20 + length], rng)
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    head = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text) + len(rest)).to_bytes(4, "little")
    return head + len(text).to_bytes(4, "little") + b"JSON" + text + rest


def _archive(content: bytes, rng: random.Random) -> bytes:
    """Change an array of a `.npz`, its header, or the entries."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # damaged already
        return _bytes(content, rng)
    if not entries:
        return _bytes(content, rng)
    name = rng.choice(list(entries))
    try:
        array = np.load(io.BytesIO(entries[name]), allow_pickle=False)
    except Exception:  # damaged already
        array = np.zeros(3)
    match rng.randrange(5):
        case 0:
            entries[name] = _bytes(entries[name], rng)
        case 1:
            del entries[name]
        case 2 if array.ndim == 0 and array.dtype.kind == "U":
            entries[name] = _npy(np.array(_json(str(array).encode(), rng).decode("utf-8", "replace")))
        case 2 | 3:
            others = (array[..., None], array.ravel()[:-1], np.array(5), np.zeros((0, 3)))
            entries[name] = _npy(rng.choice(others))
        case _:
            types = (np.float64, np.int8, np.uint8, np.int64, "U3", np.complex128)
            try:
                entries[name] = _npy(array.astype(rng.choice(types)))
            except ValueError:
                entries[name] = b""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for entry, data in entries.items():
            archive.writestr(entry, data)
    return out.getvalue()


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


# Inputs and outcomes.


def place(kind: Kind, content: bytes, folder: Path) -> Path:
    """Write an input with what belongs beside it, and return its path."""
    for name, other in kind.beside.items():
        (folder / name).write_bytes(other)
    (folder / kind.name).write_bytes(content)
    return folder / kind.name


def examine(kind: Kind, path: Path) -> str:
    """Read an input; return what is wrong with how that ended, empty if it was read or refused in one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(path)
    except FalseworkError as error:
        text = str(error)
        wrong = "in the words of Python" if PYTHON.search(text) else "" if text and "\n" not in text else "not one line"
        return f"{wrong}: {text!r}" if wrong else ""
    except MemoryError:
        return "MemoryError"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def inputs(found: dict[str, Kind], seed: int) -> Iterator[tuple[str, int, bytes]]:
    """Yield kinds in turn with the numbers of their inputs and damaged content, without end; a seed gives the same."""
    number = 0
    while True:
        for name, kind in found.items():
            yield name, number, mutate(kind, random.Random(f"{seed} {name} {number}"))
        number += 1


def in_process_of_its_own(kind: Kind, path: Path) -> str:
    """Examine an input in a fork with limits on time, memory and what it may do."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receive)
        try:
            with open(f"/proc/{os.getpid()}/statm") as file:
                taken = int(file.read().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY,) * 2)
            faulthandler.disable()  # what it would print is no finding
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(SECONDS)
            folder, apart = str(path.parent), kind.name in ("a.3dm", "a.step")  # these answer by pickles of their own

            def watch(event: str, arguments: tuple[Any, ...]) -> None:
                harm = event in ("os.system", "socket.connect", "pickle.find_class") and not apart
                if (
                    event == "open"
                    and isinstance(arguments[0], str)
                    and isinstance(arguments[1], str)
                    and set(arguments[1]) & set("wax+")
                ):
                    harm = not arguments[0].startswith((folder, "/dev/null"))
                if harm:
                    os.write(send, f"forbidden: {event} {arguments}"[:300].encode())
                    os._exit(0)

            sys.addaudithook(watch)
            os.write(send, examine(kind, path)[:300].encode("utf-8", "backslashreplace"))
        finally:
            os._exit(0)
    os.close(send)
    with os.fdopen(receive, "rb") as pipe:
        said = pipe.read().decode("utf-8", "replace")
    status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return f"{signal.Signals(os.WTERMSIG(status)).name}"
    return said


def main() -> int:
    """Fuzz for some minutes, and return whether there were findings."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", default=[])
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    options = parser.parse_args()
    end, findings, count = time.monotonic() + 60 * options.minutes, 0, 0
    with tempfile.TemporaryDirectory() as scratch:
        found = kinds(Path(scratch)) | dict(kinds_apart(load_structure("arch:blocks=3"), Path(scratch)))
        chosen = {name: kind for name, kind in found.items() if not options.kinds or name in options.kinds}
        for name, kind in chosen.items():  # reads once what forks would each import and compile
            with tempfile.TemporaryDirectory() as folder:
                wrong = examine(kind, place(kind, kind.content, Path(folder)))
                assert not wrong, f"{name} is not read intact: {wrong}"
        for name, number, content in inputs(chosen, options.seed):
            if time.monotonic() > end:
                break
            count += 1
            with tempfile.TemporaryDirectory() as folder:
                wrong = in_process_of_its_own(chosen[name], place(chosen[name], content, Path(folder)))
            if wrong:
                findings += 1
                kept = options.out / f"{name} {number}"
                kept.mkdir(parents=True, exist_ok=True)
                place(chosen[name], content, kept)
                record = {"kind": name, "number": number, "seed": options.seed, "wrong": wrong, "kept": str(kept)}
                print(json.dumps(record), flush=True)
    print(json.dumps({"inputs": count, "kinds": len(chosen), "findings": findings}))
    return int(findings > 0)


if __name__ == "__main__":
    sys.exit(main())

"""Files that are damaged or made to harm: every reader says in one line what is wrong, and nothing else happens."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from falsework import Assembly, Plan, load_structure
from falsework.errors import InputError
from falsework.geometry.mesh.obj import obj_text
from falsework.interop import to_compas
from falsework.interop.compas_read import READER as COMPAS
from falsework.interop.gltf import to_gltf
from falsework.search.plans.plan_file import load_plan, plan_from_dict, plan_to_dict

MANY = settings(
    max_examples=120,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
HOW = st.sampled_from(["set", "cut", "copy", "insert"])
EDITS = st.lists(
    st.tuples(st.integers(0, 10**9), HOW, st.binary(min_size=1, max_size=6)),
    min_size=1,
    max_size=4,
)
NUMBERS = st.integers(-3, 2**70) | st.floats()
VALUES = st.none() | st.booleans() | NUMBERS | st.text(max_size=5) | st.just([]) | st.just({})


def damage(content: bytes, edits: list[tuple[int, str, bytes]]) -> bytes:
    """A file with some bytes other than they were."""
    data = bytearray(content)
    for place, kind, some in edits:
        at = place % max(len(data), 1)
        if kind == "set":
            data[at : at + len(some)] = some
        elif kind == "cut":
            del data[at : at + 40 * len(some)]
        elif kind == "copy":
            data[at:at] = data[max(at - 50, 0) : at]
        else:
            data[at:at] = some
    return bytes(data)


def only_one_line(read: Callable[[], Any], path: Path, makes: type, again: Callable[[Any], Any]) -> str | None:
    """Read: what comes of it is whole, or there is one line for people; either way nothing is left behind.

    Args:
        read: the file.
        path: of it.
        makes: class of what is read.
        again: writes and reads what was read once more.

    Returns:
        The message, if there is one.
    """
    before = sorted(path.parent.iterdir())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = read()
            assert isinstance(found, makes)
            assert isinstance(again(found), makes)
    except InputError as error:
        text = str(error)
        assert text
        assert "\n" not in text
    except MemoryError:
        pytest.fail("a small file made the reader ask for all memory")
    else:
        text = None
    assert sorted(path.parent.iterdir()) == before
    return text


def plan_again(plan: Plan) -> Plan:
    """What a plan file of a plan holds."""
    return plan_from_dict(json.loads(json.dumps(plan_to_dict(plan))))


def same_parts(assembly: Assembly) -> Assembly:
    """The same structure from its parts, checked anew."""
    return Assembly.from_meshes(assembly.meshes, boundary=assembly.boundary, contacts=assembly.contacts)


@pytest.fixture(scope="module")
def small() -> Assembly:
    """Three blocks between two springers."""
    return load_structure("arch:blocks=3")


@MANY
@given(edits=EDITS)
def test_damaged_plans(edits: Any, plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_bytes(damage(json.dumps(plan_to_dict(plan)).encode(), edits))
    only_one_line(lambda: load_plan(path), path, Plan, plan_again)


@MANY
@given(data=st.data())
def test_plans_with_wrong_values(data: st.DataObject, plan: Plan, tmp_path: Path) -> None:
    """JSON that is well formed, with one value exchanged somewhere."""
    content: Any = json.loads(json.dumps(plan_to_dict(plan)))
    place = content
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        inner = place[key]
        if isinstance(inner, (dict, list)) and inner and data.draw(st.integers(0, 3)):
            place = inner
            continue
        place[key] = data.draw(VALUES)
        break
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(content))
    only_one_line(lambda: load_plan(path), path, Plan, plan_again)


@MANY
@given(edits=EDITS, kind=st.sampled_from(["obj", "stl", "ply", "glb", "gltf"]))
def test_damaged_meshes(edits: Any, kind: Any, small: Assembly, tmp_path: Path) -> None:
    import trimesh

    mesh = small.meshes[0]
    if kind == "obj":
        content = "".join(obj_text(one) for one in small.meshes[:1]).encode()
    elif kind in ("glb", "gltf"):
        content = to_gltf(small, kind=kind)
    else:
        written = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type=kind)
        content = written if isinstance(written, bytes) else str(written).encode()
    path = tmp_path / f"0.{kind}"
    path.write_bytes(damage(content, edits))
    only_one_line(lambda: load_structure(path, boundary=[0]), path, Assembly, same_parts)


@MANY
@given(edits=EDITS, kind=st.sampled_from(["meshes", "assembly", "dem"]))
def test_damaged_compas_data(edits: Any, kind: Any, small: Assembly, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_bytes(damage(json.dumps(to_compas(small, kind)).encode(), edits))
    only_one_line(lambda: COMPAS.read(path), path, Assembly, same_parts)


@MANY
@given(content=st.binary(max_size=300), suffix=st.sampled_from([".obj", ".stl", ".ply", ".glb", ".gltf"]))
def test_anything_at_all_as_a_mesh(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"0{suffix}"
    path.write_bytes(content)
    only_one_line(lambda: load_structure(path, boundary=[0]), path, Assembly, same_parts)


def test_what_is_whole_is_read_and_what_is_cut_is_refused(plan: Plan, small: Assembly, tmp_path: Path) -> None:
    """The two ends of the damage above, by their messages: none, and one that says which file is wrong and how."""
    path = tmp_path / "plan.json"
    text = json.dumps(plan_to_dict(plan))
    path.write_text(text)
    assert only_one_line(lambda: load_plan(path), path, Plan, plan_again) is None
    path.write_text(text[: len(text) // 2])
    message = only_one_line(lambda: load_plan(path), path, Plan, plan_again)
    assert message is not None
    assert message.startswith(f"{path} cannot be read: it is not valid JSON at line 1, column")
    model = tmp_path / "model.json"
    model.write_text(json.dumps(to_compas(small)))
    assert only_one_line(lambda: COMPAS.read(model), model, Assembly, same_parts) is None
    model.write_text(json.dumps(to_compas(small)).replace("vertex", "corner"))
    message = only_one_line(lambda: COMPAS.read(model), model, Assembly, same_parts)
    assert message is not None
    assert message.startswith(f"{model} cannot be read as COMPAS data")
    mesh = tmp_path / "0.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n")
    message = only_one_line(lambda: load_structure(mesh, boundary=[0]), mesh, Assembly, same_parts)
    assert message is not None
    assert str(mesh) in message

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
from falsework.errors import FalseworkError
from falsework.geometry.mesh.obj import obj_text
from falsework.interop import to_compas
from falsework.interop.compas_read import load_compas
from falsework.interop.gltf import to_gltf
from falsework.search.plans.plan_file import load_plan, plan_to_dict

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


def only_one_line(read: Callable[[], Any]) -> None:
    """Read; if that fails, then with a message for people."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read()
    except FalseworkError as error:
        text = str(error)
    except MemoryError:
        pytest.fail("a small file made the reader ask for all memory")
    else:
        return
    assert text
    assert "\n" not in text


@pytest.fixture(scope="module")
def small() -> Assembly:
    """Three blocks between two springers."""
    return load_structure("arch:blocks=3")


@MANY
@given(edits=EDITS)
def test_damaged_plans(edits: Any, plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_bytes(damage(json.dumps(plan_to_dict(plan)).encode(), edits))
    only_one_line(lambda: load_plan(path))


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
    only_one_line(lambda: load_plan(path))


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
    only_one_line(lambda: load_structure(path, boundary=[0]))


@MANY
@given(edits=EDITS, kind=st.sampled_from(["meshes", "assembly", "dem"]))
def test_damaged_compas_data(edits: Any, kind: Any, small: Assembly, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_bytes(damage(json.dumps(to_compas(small, kind)).encode(), edits))
    only_one_line(lambda: load_compas(path))


@MANY
@given(content=st.binary(max_size=300), suffix=st.sampled_from([".obj", ".stl", ".ply", ".glb", ".gltf"]))
def test_anything_at_all_as_a_mesh(content: bytes, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"0{suffix}"
    path.write_bytes(content)
    only_one_line(lambda: load_structure(path, boundary=[0]))

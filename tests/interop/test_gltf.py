"""glTF: valid by the validator of its makers, read back as the same structure, and moving as the plan says."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Plan, export, load_structure
from falsework.errors import InputError, MeshError, PlanError
from falsework.interop.gltf import to_gltf

Validate = Callable[[bytes], dict[str, Any]]


class Scene:
    """A glTF file read by the letter of its standard."""

    def __init__(self, content: bytes) -> None:
        if content[:4] == b"glTF":
            magic, version, size = struct.unpack_from("<4sII", content)
            length, kind = struct.unpack_from("<I4s", content, 12)
            assert (magic, version, size, kind) == (b"glTF", 2, len(content), b"JSON")
            self.json = json.loads(content[20 : 20 + length])
            self.buffer = content[28 + length :]
        else:
            self.json = json.loads(content)
            self.buffer = base64.b64decode(self.json["buffers"][0]["uri"].partition(",")[2])
        self.nodes = self.json["nodes"]

    def values(self, accessor: int) -> np.ndarray:
        """Numbers of an accessor, shape (count,) or (count, 3)."""
        entry = self.json["accessors"][accessor]
        view = self.json["bufferViews"][entry["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[entry["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3}[entry["type"]]
        values = np.frombuffer(self.buffer, kind, entry["count"] * width, view["byteOffset"])
        return values.reshape(-1, 3) if width == 3 else values

    def at(self, node: int, path: str, time: float) -> np.ndarray:
        """Translation or scale of a node at a time."""
        for channel in self.json["animations"][0]["channels"] if "animations" in self.json else ():
            if channel["target"] == {"node": node, "path": path}:
                sampler = self.json["animations"][0]["samplers"][channel["sampler"]]
                times, values = self.values(sampler["input"]), self.values(sampler["output"])
                if sampler["interpolation"] == "STEP":
                    return values[max(int(np.searchsorted(times, time + 1e-6, "right")) - 1, 0)]
                return np.array([np.interp(time, times, values[:, axis]) for axis in range(3)])
        return np.array(self.nodes[node].get(path, (1, 1, 1) if path == "scale" else (0, 0, 0)), dtype=float)

    def seen(self, time: float) -> dict[int, tuple[str, np.ndarray]]:
        """Material and place of every part that is to be seen, z up."""
        found: dict[int, tuple[str, np.ndarray]] = {}
        for number in self.json["scenes"][0]["nodes"]:
            node, place = self.nodes[number], self.at(number, "translation", time)
            for look in [number, *node.get("children", [])]:
                if "mesh" in self.nodes[look] and self.at(look, "scale", time).all():
                    part = node["extras"]["part"]
                    assert part not in found, "a part is seen twice at one time"
                    mesh = self.json["meshes"][self.nodes[look]["mesh"]]
                    material = self.json["materials"][mesh["primitives"][0]["material"]]["name"]
                    found[part] = (material, place[[0, 2, 1]] * (1, -1, 1))
        return found


@pytest.mark.parametrize("kind", ["glb", "gltf"])
@pytest.mark.parametrize("what", ["structure", "plan"])
def test_the_validator_has_nothing_to_say(
    kind: Any, what: str, arch: Assembly, plan: Plan, validate_gltf: Validate
) -> None:
    shown = {"structure": None, "plan": plan}[what]
    report = validate_gltf(to_gltf(arch, shown, kind=kind))
    assert report["issues"]["messages"] == []
    assert report["info"]["animationCount"] == (shown is not None)


def test_the_validator_looks(arch: Assembly, validate_gltf: Validate) -> None:
    text = to_gltf(arch, kind="gltf").replace(b'"VEC3"', b'"VEC2"', 1)
    assert validate_gltf(text)["issues"]["numErrors"] > 0


@pytest.mark.parametrize("spec", ["arch:blocks=7", "vault", "bottle"])
def test_a_structure_reads_back(spec: str, tmp_path: Path) -> None:
    assembly = load_structure(spec)
    export(assembly, tmp_path / "out.glb")
    again = load_structure(
        tmp_path / "out.glb",
        boundary=np.flatnonzero(assembly.boundary),
        density=assembly.density,
        friction=assembly.friction,
    )
    assert sorted(again.names) == sorted(assembly.names)
    order = [again.names.index(name) for name in assembly.names]
    assert again.mass.mass[order] == pytest.approx(assembly.mass.mass, rel=1e-4)
    assert np.allclose(again.mass.center[order], assembly.mass.center, atol=1e-5)
    assert len(again.contacts) == len(assembly.contacts)


def test_far_from_the_origin_nothing_is_lost(arch: Assembly, tmp_path: Path) -> None:
    """As surveyors model: hundreds of kilometres from the origin, where single precision knows centimetres only."""
    from falsework.geometry import TriangleMesh

    away = np.array([4.0e5, 5.0e6, 300.0])
    meshes = [TriangleMesh.from_arrays(mesh.name, mesh.vertices + away, mesh.faces) for mesh in arch.meshes]
    export(Assembly.from_meshes(meshes, boundary=arch.boundary), tmp_path / "far.glb")
    scene = Scene((tmp_path / "far.glb").read_bytes())
    for part, (_, place) in scene.seen(0.0).items():
        assert np.abs(place - away - arch.mass.center[part]).max() < 1e-6


def test_the_name_of_a_structure_comes_back(arch: Assembly, tmp_path: Path) -> None:
    named = arch.replace(name="north arch")
    export(named, tmp_path / "out.glb")
    assert load_structure(tmp_path / "out.glb").name == "north arch"
    (tmp_path / "assembly.json").write_text('{"name": "ours"}')
    assert load_structure(tmp_path / "out.glb").name == "ours"  # what is said beside it comes first
    (tmp_path / "assembly.json").unlink()
    document = Scene((tmp_path / "out.glb").read_bytes())
    document.json["asset"]["extras"]["structure"] = " "
    document.json["buffers"][0]["uri"] = "data:," + base64.b64encode(document.buffer).decode()
    (tmp_path / "blank.gltf").write_text(json.dumps(document.json))
    assert load_structure(tmp_path / "blank.gltf").name == "blank"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.pop("asset"), "asset is missing; it may be damaged; export it again"),
        (lambda file: file.update(nodes={}), "nodes is {}; give a list"),
        (
            lambda file: file["nodes"][1].update(mesh=True),
            "nodes[1].mesh is True; give a whole number (number of a mesh)",
        ),
        (lambda file: file["nodes"][1].update(mesh=-1), "nodes[1].mesh is -1; give a whole number >= 0"),
        (lambda file: file["nodes"][1].update(mesh=99), "nodes[1].mesh is 99, and the file has 9 meshes"),
        (
            lambda file: file["nodes"][1].update(translation=[0, None, 0]),
            "nodes[1].translation[1] is None; give a number",
        ),
        (lambda file: file["nodes"][1].update(scale=[1, 1]), "nodes[1].scale is [1, 1]; give a list of length 3"),
        (lambda file: file["nodes"][1].update(rotation=[0, 0, 0, float("inf")]), "nodes[1].rotation[3] is not finite"),
        (lambda file: file["nodes"][1].update(name=["a"]), "nodes[1].name is ['a']; give a text"),
        (lambda file: file["nodes"][1].update(extensions={"A": 1}), "nodes[1].extensions.A is 1; give an object"),
        (lambda file: file["meshes"][0].pop("primitives"), "meshes[0].primitives is missing"),
        (lambda file: file["scenes"][0]["nodes"].append("1"), "scenes[0].nodes[9] is '1'; give a whole number"),
        (lambda file: file["accessors"][0].update(count=1.5), "accessors[0].count is 1.5; give a whole number"),
        (lambda file: file["accessors"][0].update(count=2**62), "grows to 4611686018427388"),
        (lambda file: file["accessors"][0].update(type=None), "accessors[0].type is None; give a text"),
        (
            lambda file: file["accessors"][0].update(componentType=5),
            "accessors[0].componentType is 5; give one of 5120,",
        ),
        (lambda file: file["accessors"][1].update(componentType=5126), "accessors[1].componentType of corners is 5126"),
        (lambda file: file["accessors"][1].update(count=35), "primitives[0] has 35 corners, which make no triangles"),
        (lambda file: file["bufferViews"][0].update(byteLength="8"), "bufferViews[0].byteLength is '8'; give a whole"),
        (lambda file: file["buffers"][0].update(uri="data:,$"), "the data in buffers[0].uri are not in base64"),
        (
            lambda file: file["buffers"][0].update(uri="data:,AAAA"),
            "accessors[0] go beyond the end of their view or of",
        ),
    ],
)
def test_what_is_damaged_is_named(change: Callable[[Any], Any], message: str, arch: Assembly, tmp_path: Path) -> None:
    document = json.loads(to_gltf(arch, kind="gltf"))
    change(document)
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(MeshError) as caught:
        load_structure(tmp_path / "a.gltf")
    assert message in str(caught.value)
    assert "a.gltf" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"glTF\2\0\0\0", "it ends within its header"),
        (b"glTF\2\0\0\0\0\0\0\0", "it has no JSON"),
        (b"glTF\2\0\0\0\0\0\0\0\7\0\0\0JSON{", "it ends 6 bytes too soon"),
        (b"glTF\3\0\0\0\0\0\0\0", "its version of glTF is 3, not 2"),
        (b"{", "it is not valid JSON at line 1, column 2; it may be truncated"),
        (b"\xff", "it is neither a binary glTF file nor text in UTF-8"),
        (b"[]", "the content is []; give an object"),
    ],
)
def test_what_is_no_gltf_is_named(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(MeshError) as caught:
        load_structure(tmp_path / "a.glb")
    assert str(caught.value).startswith(f"cannot read {tmp_path / 'a.glb'}: {message}")


@pytest.mark.parametrize("kind", ["glb", "gltf"])
def test_between_two_steps_the_scene_is_the_state(kind: Any, arch: Assembly, plan: Plan) -> None:
    scene = Scene(to_gltf(arch, plan, kind=kind, step_seconds=2.0))
    assert scene.json["asset"]["extras"]["identity"] == arch.identity
    robots: dict[int, str] = {}
    for step, state in enumerate(plan.states):
        if step == 0:
            continue  # at the very start the first step has begun
        seen = scene.seen(2.0 * step - 0.01)
        assert set(seen) == set(np.flatnonzero(state).tolist())
        for part, (material, place) in seen.items():
            assert np.allclose(place, arch.mass.center[part], atol=1e-5)
            held = state[part] == 2 and not arch.boundary[part]
            if arch.boundary[part]:
                assert material == "boundary"
            else:
                assert material.startswith("robot ") == held
                if held:
                    assert robots.setdefault(part, material) == material, "a part changes hands"
            if not held:
                robots.pop(part, None)


def test_presses_are_extras_in_the_axes_of_the_file(
    arch: Assembly, plan: Plan, press_once: Callable[..., tuple[Plan, int, int]]
) -> None:
    pressed, step, part = press_once(plan, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    wrench = [1.0, 3.0, -2.0, 4.0, 6.0, -5.0]
    about = Scene(to_gltf(arch, pressed)).json["extras"]["plan"]
    assert about["presses"] == [{"step": step, "part": part, "wrench": wrench}]
    assert "presses" not in Scene(to_gltf(arch, plan)).json["extras"]["plan"]


def test_parts_leave_without_passing_through_others(arch: Assembly, plan: Plan) -> None:
    """Halfway out, a part is where its clearance says that nothing is: along a direction that nobody blocks."""
    scene = Scene(to_gltf(arch, plan))
    for step, action in enumerate(plan.actions):
        if action < arch.part_count:
            continue
        part = int(action) - arch.part_count
        _, place = scene.seen(step + 0.45)[part]
        way = place - arch.mass.center[part]
        direction = arch.clearance.exit_direction(plan.states[step], part)
        assert direction is not None
        assert np.linalg.norm(way) > 0.3
        assert np.allclose(way / np.linalg.norm(way), direction, atol=1e-4)


def test_what_cannot_be_written(arch: Assembly, plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match="the structure that it was made for: arch:blocks=7"):
        to_gltf(load_structure("arch:blocks=9"), plan)
    with pytest.raises(InputError, match="0 seconds"):
        to_gltf(arch, plan, step_seconds=0)
    with pytest.raises(InputError, match="choose glb or gltf"):
        to_gltf(arch, kind="obj")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="nowhere"):
        export(arch, tmp_path / "nowhere" / "out.glb")

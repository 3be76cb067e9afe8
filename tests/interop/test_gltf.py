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
from falsework.errors import InputError, PlanError
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

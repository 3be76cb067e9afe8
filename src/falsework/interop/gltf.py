"""glTF 2.0 export: a structure, and a plan as an animation with one node per part.

`geometry.mesh.gltf` reads structures back.

glTF has metres and y up, as the standard demands; readers convert to their own axes. Each part is a node that
sits at its centre of mass, so that positions keep their digits however far from the origin the structure is modelled.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework import __version__
from falsework.errors import InputError
from falsework.interop.tracks import Track, Tracks, tracks_of
from falsework.search.plans.steps import NO_ROBOT
from falsework.stability.holds import robot_number
from falsework.utils.files.formats import Exporter, writer_of
from falsework.viewer.palette import BOUNDARY, INSTALLED, linear_rgb, robot_color, unit_rgb

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.geometry.mesh.mesh import TriangleMesh
    from falsework.search.plans.plan import Plan

Kind = Literal["glb", "gltf"]

_FLOAT, _SHORT, _INT = 5126, 5123, 5125
_VERTICES, _FACES = 34962, 34963
_GLB = (b"glTF", 2)
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def to_gltf(assembly: Assembly, plan: Plan | None = None, *, kind: Kind = "glb", step_seconds: float = 1.0) -> bytes:
    """Return a self-contained glTF file.

    Without a plan every part is a node with its mesh. With a plan there is an animation besides: each part is a node
    that moves in or out along a straight path; it carries one mesh for the free part and one for each robot that holds
    it, in the robot's colour, of which one is visible at a time. The presses of robots are extras of the file: step,
    part, and wrench in N and N m about the part's node, in the axes of the file.

    Args:
        kind: `glb`, one binary file, or `gltf`, the same as text with its data inside.
    """
    if kind not in ("glb", "gltf"):
        raise InputError(f"{kind!r} is not a kind of glTF; choose glb or gltf")
    document = _Document(assembly)
    if plan is None:
        for part in range(assembly.part_count):
            document.still(part)
    else:
        document.animate(plan, tracks_of(plan, assembly, step_seconds))
    return document.packed(kind)


class _Document:
    """glTF document under construction: its JSON and its buffer."""

    def __init__(self, assembly: Assembly) -> None:
        self._assembly = assembly
        self._buffer = bytearray()
        self._json: dict[str, Any] = {
            "asset": {
                "version": "2.0",
                "generator": f"falsework {__version__}",
                "extras": {
                    "structure": assembly.name,
                    "identity": assembly.identity,
                    "friction": assembly.friction,
                },
            },
            "scene": 0,
            "scenes": [{"name": assembly.name, "nodes": []}],
        }
        self._materials: dict[int | str, int] = {}
        self._geometry: dict[int, dict[str, int]] = {}

    def still(self, part: int) -> int:
        """Return a node with the part's mesh, in the scene."""
        material = "boundary" if self._assembly.boundary[part] else NO_ROBOT
        node = self._part_node(part)
        self._json["nodes"][node]["mesh"] = self._mesh(part, material, self._assembly.names[part])
        return node

    def animate(self, plan: Plan, times: Tracks) -> None:
        """Add all parts and their animation."""
        about: dict[str, Any] = {"steps": len(plan), "robots": plan.robots}
        presses = [(step, press) for step, some in enumerate(plan.presses, 1) for press in some]
        if presses:
            about["presses"] = [
                {"step": step, "part": press.part, "wrench": _y_up(np.reshape(press.wrench, (2, 3))).ravel().tolist()}
                for step, press in presses
            ]
        self._json["extras"] = {"plan": about}
        animation: dict[str, Any] = {"name": "assembly", "channels": [], "samplers": []}
        for part, track in enumerate(times.tracks):
            if track.path or track.is_held or (track.appears and track.at_first):
                self._moving(part, track, times.seconds, animation)
            elif track.at_first:
                self.still(part)
        if animation["channels"]:
            self._json["animations"] = [animation]

    def _moving(self, part: int, track: Track, seconds: float, animation: dict[str, Any]) -> None:
        """Add a part that moves, disappears or is held: a moving node with one child for each appearance."""
        parent = self._part_node(part)
        looks = sorted({robot for _, robot in track.holder})
        children = []
        for robot in looks:
            how = "by itself" if robot == NO_ROBOT else f"held by {robot_number(robot)}"
            name = f"{self._assembly.names[part]} {how}"
            child = self._add("nodes", {"name": name, "mesh": self._mesh(part, robot, name)})
            children.append(child)
            keys = _visible(track, robot)
            self._json["nodes"][child]["scale"] = [keys[0][1]] * 3
            if len(keys) > 1:
                self._channel(animation, child, "scale", keys, "STEP", [[value] * 3 for _, value in keys])
        self._json["nodes"][parent]["children"] = children
        if track.path:
            base = np.array(self._json["nodes"][parent]["translation"])
            places = [(base + _y_up(offset)).tolist() for _, offset in track.path]
            keys = list(track.path)
            if keys[0][0] > 0:
                keys, places = [(0.0, keys[0][1]), *keys], [places[0], *places]
            if keys[-1][0] < seconds:
                keys, places = [*keys, (seconds, keys[-1][1])], [*places, places[-1]]
            self._json["nodes"][parent]["translation"] = places[0]
            self._channel(animation, parent, "translation", keys, "LINEAR", places)

    def _part_node(self, part: int) -> int:
        assembly = self._assembly
        node = self._add(
            "nodes",
            {
                "name": assembly.names[part],
                "translation": _y_up(assembly.mass.center[part]).tolist(),
                "extras": {
                    "part": part,
                    "boundary": bool(assembly.boundary[part]),
                    "mass": round(float(assembly.mass.mass[part]), 6),
                    "density": float(assembly.density[part]),
                },
            },
        )
        self._json["scenes"][0]["nodes"].append(node)
        return node

    def _mesh(self, part: int, look: int | str, name: str) -> int:
        if part not in self._geometry:
            mesh = self._assembly.meshes[part]
            places = _y_up(mesh.vertices - self._assembly.mass.center[part]).astype("<f4")
            self._geometry[part] = {
                "position": self._accessor(places, "VEC3", _VERTICES),
                "faces": self._accessor(_indices(mesh), "SCALAR", _FACES),
            }
        geometry = self._geometry[part]
        primitive = {
            "attributes": {"POSITION": geometry["position"]},
            "indices": geometry["faces"],
            "material": self._material(look),
        }
        return self._add("meshes", {"name": name, "primitives": [primitive]})

    def _material(self, look: int | str) -> int:
        if look not in self._materials:
            if isinstance(look, str):
                name, color = look, BOUNDARY
            else:
                name, color = ("part", INSTALLED) if look == NO_ROBOT else (f"robot {look + 1}", robot_color(look))
            surface = {
                "baseColorFactor": [*linear_rgb(unit_rgb(color)).round(4).tolist(), 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": 0.9,
            }
            self._materials[look] = self._add("materials", {"name": name, "pbrMetallicRoughness": surface})
        return self._materials[look]

    def _channel(
        self,
        animation: dict[str, Any],
        node: int,
        path: str,
        keys: Sequence[tuple[float, Any]],
        interpolation: str,
        values: ArrayLike,
    ) -> None:
        times = np.array([time for time, _ in keys], dtype="<f4")
        animation["samplers"].append(
            {
                "input": self._accessor(times, "SCALAR"),
                "output": self._accessor(np.array(values, dtype="<f4"), "VEC3"),
                "interpolation": interpolation,
            }
        )
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})

    def _accessor(self, values: NDArray, kind: str, target: int | None = None) -> int:
        self._buffer += b"\0" * (-len(self._buffer) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._buffer), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        self._buffer += values.tobytes()
        component = {"f": _FLOAT, "u": _SHORT if values.itemsize == 2 else _INT}[values.dtype.kind]
        rows = values.reshape(len(values), -1)
        accessor = {
            "bufferView": self._add("bufferViews", view),
            "componentType": component,
            "count": len(values),
            "type": kind,
        }
        if component == _FLOAT:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._add("accessors", accessor)

    def _add(self, kind: str, entry: dict[str, Any]) -> int:
        entries = self._json.setdefault(kind, [])
        entries.append(entry)
        return len(entries) - 1

    def packed(self, kind: Kind) -> bytes:
        """Return the document with its buffer as the bytes of a file."""
        buffer: dict[str, Any] = {"byteLength": len(self._buffer)}
        if kind == "gltf":
            buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(self._buffer).decode()
        text = json.dumps({**self._json, "buffers": [buffer]}, ensure_ascii=False, allow_nan=False).encode(
            "utf-8", "backslashreplace"
        )
        if kind == "gltf":
            return text + b"\n"
        text += b" " * (-len(text) % 4)
        data = bytes(self._buffer) + b"\0" * (-len(self._buffer) % 4)
        size = 12 + 8 + len(text) + 8 + len(data)
        header = struct.pack("<4sII", *_GLB, size) + struct.pack("<II", len(text), _JSON_CHUNK)
        return header + text + struct.pack("<II", len(data), _BINARY_CHUNK) + data


def _visible(track: Track, robot: int) -> list[tuple[float, float]]:
    """Return times and scales at which a part is shown as held: seconds, and 1 for shown or 0 for hidden."""
    times = sorted({time for time, _ in (*track.shown, *track.holder)})
    keys: list[tuple[float, float]] = []
    for time in times:
        seen = float(_at(track.shown, time) and _at(track.holder, time) == robot)
        if not keys or keys[-1][1] != seen:
            keys.append((time, seen))
    return keys


def _at(keys: Sequence[tuple[float, Any]], time: float) -> Any:
    """Return the value that holds at a time."""
    return [value for when, value in keys if when <= time][-1]


def _indices(mesh: TriangleMesh) -> NDArray:
    """Return corners of all faces, in the smallest type that holds them; the largest value of a type is reserved."""
    small = len(mesh.vertices) < 65535
    return mesh.faces.ravel().astype("<u2" if small else "<u4")


def _y_up(points: ArrayLike) -> NDArray[np.float64]:
    """Return points of a world with z up in one with y up; shape (..., 3)."""
    points = np.asarray(points, dtype=np.float64)
    return points[..., [0, 2, 1]] * (1.0, 1.0, -1.0)


GLB = Exporter(writer_of(to_gltf), (".glb",), ("Assembly", "Plan"), ("step_seconds",))
GLTF = Exporter(writer_of(partial(to_gltf, kind="gltf")), (".gltf",), ("Assembly", "Plan"), ("step_seconds",))

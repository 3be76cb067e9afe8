"""Model of the JSON of glTF 2.0, as far as it says which shapes are where."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from msgspec import Meta, field

from falsework.utils.models import ForeignModel

TRIANGLES, STRIP, FAN = 4, 5, 6
"""Modes of primitives that are surfaces; lower ones are points and lines."""

Natural = Annotated[int, Meta(ge=0)]
Components = Literal[5120, 5121, 5122, 5123, 5125, 5126]


class _Entry(ForeignModel, kw_only=True, rename="camel", frozen=True):
    """Base of the objects in a file."""

    extensions: dict[str, dict[str, Any]] | None = None
    """Objects by the names of their extensions."""
    extras: Any = None


class GltfAsset(_Entry, frozen=True):
    """What wrote the file, and for which version."""

    version: str | float
    min_version: str | float = "2.0"


class GltfScene(_Entry, frozen=True):
    """Nodes that are shown together."""

    nodes: list[Natural] = []
    """Numbers of nodes."""


class GltfNode(_Entry, frozen=True):
    """Place of a mesh and of further nodes."""

    name: str = ""
    mesh: Natural | None = None
    """Number of a mesh."""
    children: list[Natural] = []
    """Numbers of nodes."""
    matrix: Annotated[list[float], Meta(min_length=16, max_length=16)] | None = None
    """16 numbers, by columns."""
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Quaternion x, y, z, w."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    skin: Natural | None = None
    weights: list[float] = []


class GltfAttributes(ForeignModel, frozen=True):
    """Accessors of the properties of vertices."""

    position: Natural = field(name="POSITION")
    """Number of an accessor."""


class GltfPrimitive(_Entry, frozen=True):
    """Triangles, lines or points of one material."""

    attributes: GltfAttributes
    indices: Natural | None = None
    """Number of an accessor."""
    mode: Annotated[int, Meta(ge=0, le=FAN)] = TRIANGLES


class GltfMesh(_Entry, frozen=True):
    """Primitives that nodes place together."""

    primitives: list[GltfPrimitive]
    name: str = ""
    weights: list[float] = []


class GltfAccessor(_Entry, frozen=True):
    """Numbers in a view."""

    component_type: Components
    count: Natural
    type: str
    buffer_view: Natural | None = None
    """Number of a view."""
    byte_offset: Natural = 0
    normalized: bool = False
    sparse: Any = None


class GltfView(_Entry, frozen=True):
    """Bytes in a buffer."""

    buffer: Natural
    """Number of a buffer."""
    byte_length: Natural
    byte_offset: Natural = 0
    byte_stride: Natural = 0


class GltfBuffer(_Entry, frozen=True):
    """Bytes in the file, in its text, or in a file beside it."""

    uri: str | None = None


class GltfFile(_Entry, frozen=True):
    """JSON of a glTF file."""

    asset: GltfAsset
    scene: Natural = 0
    """Number of a scene."""
    scenes: list[GltfScene] = []
    nodes: list[GltfNode] = []
    meshes: list[GltfMesh] = []
    accessors: list[GltfAccessor] = []
    buffer_views: list[GltfView] = []
    buffers: list[GltfBuffer] = []
    animations: list[Any] = []
    extensions_used: list[str] = []
    extensions_required: list[str] = []

    def shaped(self) -> Iterator[_Entry]:
        """Yield the objects of which shapes consist."""
        for entries in (self.scenes, self.nodes, self.meshes, self.accessors, self.buffer_views, self.buffers):
            yield from entries
        for mesh in self.meshes:
            yield from mesh.primitives

    def dangling(self) -> str:
        """Return the path of the first number of an object that does not exist, with both; empty if there is none."""
        counts = {
            "scenes": len(self.scenes), "nodes": len(self.nodes), "meshes": len(self.meshes),
            "accessors": len(self.accessors), "bufferViews": len(self.buffer_views), "buffers": len(self.buffers),
        }  # fmt: skip
        for place, kind, number in self._references():
            if number is not None and number >= counts[kind]:
                return f"{place} is {number}, and the file has {counts[kind]} {kind}"
        return ""

    def _references(self) -> Iterator[tuple[str, str, int | None]]:
        """Yield the path of every number of an object, the list that has these, and the number."""
        if self.scenes:
            yield "scene", "scenes", self.scene
        for at, scene in enumerate(self.scenes):
            for place, child in enumerate(scene.nodes):
                yield f"scenes[{at}].nodes[{place}]", "nodes", child
        for at, node in enumerate(self.nodes):
            yield f"nodes[{at}].mesh", "meshes", node.mesh
            for place, child in enumerate(node.children):
                yield f"nodes[{at}].children[{place}]", "nodes", child
        for at, mesh in enumerate(self.meshes):
            for place, primitive in enumerate(mesh.primitives):
                where = f"meshes[{at}].primitives[{place}]"
                yield f"{where}.attributes.POSITION", "accessors", primitive.attributes.position
                yield f"{where}.indices", "accessors", primitive.indices
        for at, accessor in enumerate(self.accessors):
            yield f"accessors[{at}].bufferView", "bufferViews", accessor.buffer_view
        for at, view in enumerate(self.buffer_views):
            yield f"bufferViews[{at}].buffer", "buffers", view.buffer

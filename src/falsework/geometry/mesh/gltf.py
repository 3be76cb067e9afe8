"""Reader of the shapes in glTF 2.0 files, one binary file (.glb) or text (.gltf)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.gltf.document import GltfDocument
from falsework.geometry.gltf.gltf_model import FAN, STRIP, TRIANGLES, GltfNode, GltfPrimitive
from falsework.geometry.mesh.bounds import check_growth
from falsework.geometry.mesh.surface import PartSurface, content_of, joined, warn_of
from falsework.utils.quantity import is_number, listed

Array = NDArray[np.float64]

_HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_lights_",
    "EXT_texture_",
    "EXT_lights_",
    "KHR_xmp_",
    "KHR_animation_",
)
"""Beginnings of the names of extensions that say nothing about the shape."""
_KNOWN = {"KHR_mesh_quantization", "KHR_node_visibility", "MSFT_texture_dds", "ADOBE_materials_clearcoat_specular"}
_UNIT = 0.01
"""Difference from one up to which the length of a rotation counts as rounded."""
_LEVELS = 64
"""Nodes that may contain each other."""
_NODES = 100_000
"""Nodes that a scene may have; one that is used often, within others that are, must not fill the memory."""


def read_gltf(file: Path) -> list[PartSurface]:
    """Read the nodes with meshes in the scene of a glTF file, in the order of the file, turned to z up.

    A part is a node; the primitives of its mesh, one for each material, are one surface. The entries `part`,
    `boundary` and `density` in the `extras` of a node, which falsework writes, are its number, whether it is fixed,
    and its density; in those of `asset`, `structure` is the name of the whole and `friction` the coefficient of all
    contacts. Hidden nodes, points and lines, other scenes and animations are left out with a warning.

    Raises:
        MeshError: a file that is damaged, that has too many copies of its meshes (see `check_growth`), or whose shape
            depends on what is not read: skins, morph targets, compression, instancing.
    """
    return _Reader(GltfDocument(file, content_of(file))).read()


class _Reader:
    """Reader of the scene of a document."""

    def __init__(self, document: GltfDocument) -> None:
        self._document, self._file, self._json = document, document.file, document.json
        self._fail = document.fail
        self._meshes: dict[int, PartSurface | None] = {}
        self._hidden: list[str] = []
        self._flat: list[str] = []
        self._lacking: list[str] = []
        self._lines = 0
        self._count = 0

    def read(self) -> list[PartSurface]:
        asset = self._json.asset
        if not str(asset.version).startswith("2") or str(asset.min_version) != "2.0":
            version = asset.version if str(asset.min_version) == "2.0" else asset.min_version
            self._fail(f"its version of glTF is {version}, not 2.0", "export it as glTF 2.0")
        if "plan" in _entries(self._json.extras):
            self._fail("it shows a plan in motion", "give the structure of the plan")
        shaping = [name for name in self._extensions() if name not in _KNOWN and not name.startswith(_HARMLESS)]
        if shaping:
            self._fail(f"it uses {listed(shaping)}, which may change its shapes", "export it without extensions")
        uses = [use for root in self._roots() for use in self._uses(root, np.eye(4), 0, False)]
        self._check_growth(uses)
        surfaces = [surface for use in uses if (surface := self._part(*use)) is not None]
        self._report()
        stated = [surface.number for surface in surfaces if surface.number is not None]
        if sorted(stated) == list(range(len(surfaces))):
            return sorted(surfaces, key=lambda surface: surface.number or 0)
        if stated:
            said = listed([f"{surface.name} {surface.number}" for surface in surfaces if surface.number is not None])
            warn_of(
                self._file, f"nodes state numbers that are not 0 to {len(surfaces) - 1}, so these are left out: {said}"
            )
        return [replace(surface, number=None) for surface in surfaces]

    def _extensions(self) -> list[str]:
        """Return the extensions that the file declares, or uses where shapes are without declaring them."""
        found = [*self._json.extensions_used, *self._json.extensions_required]
        for holder in self._json.shaped():
            found += holder.extensions or {}
        return list(dict.fromkeys(found))

    def _roots(self) -> list[int]:
        """Return the root nodes of the scene."""
        nodes, scenes = self._json.nodes, self._json.scenes
        below = {child for node in nodes for child in node.children}
        if not scenes:
            return [number for number in range(len(nodes)) if number not in below]
        chosen = self._json.scene
        roots = scenes[chosen].nodes
        reached, todo = set(roots), list(roots)
        while todo:
            fresh = set(nodes[todo.pop()].children) - reached
            reached |= fresh
            todo += fresh
        lost = [n for n, node in enumerate(nodes) if node.mesh is not None and n not in reached]
        if lost:
            names = listed([_name(nodes[number], number) for number in lost])
            warn_of(self._file, f"nodes that are not in scene {chosen} were left out: {names}")
        return roots

    def _uses(self, number: int, above: Array, level: int, hidden: bool) -> Iterator[tuple[int, int, Array, bool]]:
        """Yield a node and those below it that have a mesh: both numbers, place, and whether it is hidden."""
        self._count += 1
        if level > _LEVELS or self._count > _NODES:
            self._fail("its nodes contain themselves, or are too many", "export it again")
        node = self._json.nodes[number]
        place = above @ self._transform(node, number)
        hidden = hidden or (node.extensions or {}).get("KHR_node_visibility", {}).get("visible") is False
        if node.mesh is not None:
            yield number, node.mesh, place, hidden
        for child in node.children:
            yield from self._uses(child, place, level + 1, hidden)

    def _check_growth(self, uses: Sequence[tuple[int, int, Array, bool]]) -> None:
        """Refuse copies of meshes and claims of arrays beyond the size of the files, before any is read."""
        accessors = self._json.accessors
        sizes = [
            sum(
                accessors[index].count
                for primitive in mesh.primitives
                for index in (primitive.attributes.position, primitive.indices)
                if index is not None
            )
            for mesh in self._json.meshes
        ]
        count = sum(sizes[mesh] for _, mesh, _, _ in uses)
        check_growth(self._file, count, beside=self._document.size_beside())

    def _part(self, number: int, mesh: int, place: Array, hidden: bool) -> PartSurface | None:
        """Return the surface of a node in its place; None if it is left out."""
        node = self._json.nodes[number]
        name = _name(node, number)
        if node.skin is not None:
            self._fail(f"node {name} is deformed by a skin", "apply it and export plain meshes")
        if any(node.weights or self._json.meshes[mesh].weights):
            self._fail(f"node {name} is deformed by morph targets", "apply them and export plain meshes")
        surface = self._surface(mesh)
        if hidden:
            self._hidden.append(name)
        elif surface is not None and not np.linalg.det(place[:3, :3]):
            self._flat.append(name)
        elif surface is not None:
            return self._placed(surface, number, mesh, place)
        return None

    def _placed(self, surface: PartSurface, index: int, mesh: int, place: Array) -> PartSurface:
        node = self._json.nodes[index]
        points = surface.vertices @ place[:3, :3].T + place[:3, 3]
        faces = surface.faces if np.linalg.det(place[:3, :3]) > 0 else surface.faces[:, ::-1]
        extras, about = _entries(node.extras), _entries(self._json.asset.extras)
        number, density, friction = extras.get("part"), extras.get("density"), about.get("friction")
        own = isinstance(number, int) and not isinstance(number, bool)
        if not own and extras.keys() & {"boundary", "density"}:
            self._lacking.append(_name(node, index))
        return PartSurface(
            node.name or self._json.meshes[mesh].name,
            points[:, [0, 2, 1]] * (1.0, -1.0, 1.0),
            faces,
            support=own and extras.get("boundary") is True,
            number=number if own else None,
            density=float(density) if own and is_number(density) else None,
            friction=float(friction) if own and is_number(friction) else None,
            structure=structure if own and isinstance(structure := about.get("structure"), str) else "",
            whole=own,
        )

    def _surface(self, index: int) -> PartSurface | None:
        """Return the surface of a mesh, all primitives together; None if it has no triangles."""
        if index not in self._meshes:
            pieces = []
            for number, primitive in enumerate(self._json.meshes[index].primitives):
                if primitive.mode < TRIANGLES:
                    self._lines += 1
                    continue
                points = self._document.numbers(primitive.attributes.position, "VEC3")
                faces = self._faces(primitive, len(points), f"meshes[{index}].primitives[{number}]")
                pieces.append(PartSurface("", points, faces))
            self._meshes[index] = joined("", pieces) if pieces else None
        return self._meshes[index]

    def _faces(self, primitive: GltfPrimitive, count: int, where: str) -> NDArray[np.int64]:
        corners = np.arange(count)
        if primitive.indices is not None:
            corners = self._document.numbers(primitive.indices, "SCALAR").ravel().astype(np.int64)
        if primitive.mode == STRIP:
            faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
            faces[1::2] = faces[1::2][:, [1, 0, 2]]
        elif primitive.mode == FAN:
            first = np.broadcast_to(corners[:1], max(len(corners) - 2, 0))
            faces = np.stack([first, corners[1:-1], corners[2:]], axis=1)
        elif len(corners) % 3:
            self._fail(f"{where} has {len(corners)} corners, which make no triangles", "export it again")
        else:
            faces = corners.reshape(-1, 3)
        if len(faces) and faces.max() >= count:
            self._fail(f"a face of {where} uses a vertex that does not exist", "export it again")
        return faces

    def _transform(self, node: GltfNode, number: int) -> Array:
        """Return the matrix of a node, shape (4, 4)."""
        if node.matrix is not None:
            matrix = np.array(node.matrix).reshape(4, 4).T
            if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0)):
                self._fail(f"nodes[{number}].matrix is not affine", "export it again")
            return matrix
        x, y, z, w = node.rotation
        if not abs(x * x + y * y + z * z + w * w - 1) <= _UNIT:
            self._fail(f"nodes[{number}].rotation is no unit quaternion", "export it again")
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        matrix = np.eye(4)
        matrix[:3, :3] = turn * np.array(node.scale)
        matrix[:3, 3] = node.translation
        return matrix

    def _report(self) -> None:
        """Warn of what was left out."""
        for names, what in ((self._hidden, "hidden nodes"), (self._flat, "nodes that are scaled to nothing")):
            if names:
                warn_of(self._file, f"{what} were left out: {listed(names)}")
        if self._lacking:
            said = listed(self._lacking)
            warn_of(
                self._file, f"boundary and density count only beside the number of a part, and were left out: {said}"
            )
        if self._lines:
            warn_of(self._file, f"points and lines were left out: {self._lines} primitives")
        if self._json.animations:
            warn_of(self._file, f"animations were left out: {len(self._json.animations)}; parts are read at rest")


def _name(node: GltfNode, number: int) -> str:
    return node.name or f"number {number}"


def _entries(extras: Any) -> dict[str, Any]:
    """Return the entries of extras, which may be of any kind."""
    return extras if isinstance(extras, dict) else {}

"""Reader of COMPAS data: lists of meshes, assemblies of compas_assembly, models of compas_dem.

COMPAS writes every object as JSON with the name of its class, `{"dtype": "compas.datastructures/Mesh", "data": ...}`.
The classes that hold blocks are few and plain, so they are read here without COMPAS; `model.json` from an architect
needs nothing but this package.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import DENSITY, FRICTION, Assembly
from falsework.errors import AssemblyError, InputError, MeshError
from falsework.geometry.contact.interfaces import ContactSettings
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.polygon import triangulate
from falsework.geometry.mesh.read import unit_length
from falsework.geometry.mesh.repair import check_mesh
from falsework.utils.json_text import parse_json

LARGEST_FILE = 512 * 1024 * 1024
"""Bytes; a file beyond that is refused rather than read into memory."""

_IDENTITY = np.eye(4)
_MESHES = {"compas.datastructures/Mesh", "compas_assembly.datastructures/Block"}
_BOX_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


@dataclass(frozen=True, eq=False)
class _Block:
    """Data of one part in a COMPAS file."""

    name: str
    vertices: NDArray[np.float64]
    faces: list[list[int]]
    support: bool = False
    said: Mapping[str, Any] = field(default_factory=dict)
    """Its attributes."""


def is_compas(path: Path | str) -> bool:
    """Return whether a path is a file that looks like COMPAS data: JSON that names the class of an object."""
    path = Path(path)
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    with path.open("rb") as file:
        return b'"dtype"' in file.read(65536)


def load_compas(
    path: Path | str,
    *,
    unit: str | None = None,
    density: ArrayLike | None = None,
    friction: float | None = None,
    boundary: ArrayLike | None = None,
    ground: bool = False,
    contact_settings: ContactSettings | None = None,
) -> Assembly:
    """Read an assembly from a file of COMPAS data.

    Blocks are meshes in a list or a dictionary, the blocks of a compas_assembly `Assembly`, or the elements of a
    compas_dem `BlockModel` with their transformations. Supports (`is_support`) are boundary. Attributes `density` and
    `friction`, which `write_compas` adds, are read too. COMPAS data have no unit.

    Args:
        path: file that `compas.json_dump` wrote.
        unit: unit of the coordinates; metres if not given.
        density: kg/m3.
        friction: coefficient of friction of every contact.
        boundary: ids of the parts that are fixed for ever; the supports if not given.
        ground: add a fixed slab under the lowest point, as the last part.
        contact_settings: tolerances.

    Raises:
        InputError: no such file, not COMPAS data, or no block in it.
        MeshError: a block that does not bound a solid.
        AssemblyError: the blocks make no assembly.
    """
    path, scale = Path(path), unit_length(unit or "m")
    blocks = _Reader(path).blocks()
    meshes = tuple(_solid(block, scale) for block in _named(blocks))
    numbers = [float(block.said["density"]) for block in blocks if _is_number(block.said.get("density"))]
    said_friction = {block.said["friction"] for block in blocks if _is_number(block.said.get("friction"))}
    if friction is None and len(said_friction) > 1:
        raise AssemblyError(f"{path} has blocks of different friction; give one for all with --friction")
    if boundary is None:
        boundary = [number for number, block in enumerate(blocks) if block.support]
    return Assembly.from_meshes(
        meshes,
        boundary=boundary,
        density=density if density is not None else numbers if len(numbers) == len(blocks) else DENSITY,
        friction=next(iter(said_friction), FRICTION) if friction is None else friction,
        name=path.stem,
        ground=ground,
        contact_settings=contact_settings or ContactSettings(),
    )


class _Reader:
    """Reader of the blocks in COMPAS data, with precise errors."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def blocks(self) -> list[_Block]:
        if not self._path.is_file():
            raise InputError(f"there is no file {self._path}; give one that compas.json_dump wrote")
        if self._path.stat().st_size > LARGEST_FILE:
            self._fail(f"it is larger than {LARGEST_FILE // 2**20} MiB", "write fewer or coarser meshes")
        try:
            data = parse_json(self._path.read_text(encoding="utf-8"))
            found = list(self._find(data))
        except UnicodeDecodeError:
            self._fail("it is no text")
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            self._fail(f"something in it is not as COMPAS writes it ({type(error).__name__})")
        except RecursionError:
            self._fail("it is nested too deeply")
        if not found:
            self._fail("there is no block in it", "give a list of meshes, an Assembly or a BlockModel")
        return found

    def _find(self, data: Any) -> Iterator[_Block]:
        """Yield all blocks in a value, in their order."""
        if isinstance(data, list):
            for item in data:
                yield from self._find(item)
            return
        if not isinstance(data, dict):
            return
        kind = data.get("dtype")
        if kind is None:
            for item in data.values():
                yield from self._find(item)
            return
        kinds = {kind, *data.get("inheritance", [])}
        content: dict[str, Any] = _content(data)
        if kinds & _MESHES or kind in ("compas.geometry/Polyhedron", "compas.geometry/Box"):
            yield self._block(data, _IDENTITY)
        elif "compas_assembly.datastructures/Assembly" in kinds:
            yield from self._assembly(content)
        elif "compas_model.models/Model" in kinds:
            yield from self._model(content)
        elif str(kind).startswith(("compas.geometry/", "compas_model.", "compas_dem.")):
            return  # points, frames and the like have no volume
        else:
            yield from self._find(content)

    def _assembly(self, content: dict[str, Any]) -> Iterator[_Block]:
        """Yield blocks of a compas_assembly `Assembly`: the nodes of its graph."""
        graph = content["graph"]
        graph = graph.get("data", graph)
        default = graph.get("default_node_attributes") or {}
        common = {key: value for key, value in content.get("attributes", {}).items() if key == "friction"}
        for key, node in graph["node"].items():
            attributes = {**default, **node}
            if attributes.get("block"):
                block = self._block(attributes["block"], _IDENTITY, fallback=str(key))
                yield replace(
                    block, support=block.support or bool(attributes.get("is_support")), said={**common, **block.said}
                )

    def _model(self, content: dict[str, Any]) -> Iterator[_Block]:
        """Yield elements of a compas_model `Model`, such as a `BlockModel`, where their places in its tree put them."""
        elements = content["elements"]

        def walk(node: dict[str, Any], above: NDArray[np.float64]) -> Iterator[_Block]:
            for child in node.get("children") or []:
                guid = child.get("element")
                place = above
                if guid in elements:
                    element = elements[guid]
                    inside = element.get("data", element)
                    place = above @ _matrix(inside.get("transformation"))
                    geometry = inside.get("geometry")
                    if geometry:
                        name = element.get("name") or inside.get("name")
                        block = self._block(geometry, place)
                        support = bool(inside.get("is_support")) or block.support
                        yield replace(block, name=str(name or block.name), support=support)
                yield from walk(child, place)

        tree = content["tree"]
        root = tree.get("data", tree)["root"]
        yield from walk(root, _matrix(content.get("transformation")))

    def _block(self, data: dict[str, Any], place: NDArray[np.float64], fallback: str = "") -> _Block:
        """Return one mesh, polyhedron or box."""
        content: dict[str, Any] = _content(data)
        name = data.get("name") or (content.get("attributes") or {}).get("name") or fallback
        attributes = dict(content.get("attributes") or {})
        if "vertex" in content:
            default = {"x": 0.0, "y": 0.0, "z": 0.0, **(content.get("default_vertex_attributes") or {})}
            order = {str(key): row for row, key in enumerate(content["vertex"])}
            points = [[{**default, **vertex}[axis] for axis in "xyz"] for vertex in content["vertex"].values()]
            faces = [[order[str(corner)] for corner in face] for face in content["face"].values()]
        elif "vertices" in content:
            points, faces = content["vertices"], content["faces"]
        elif "xsize" in content:
            points, faces = _box(content), [list(face) for face in _BOX_FACES]
        else:
            self._fail(f"block {name or '?'} is a {data.get('dtype')}, not a mesh", "convert it to a mesh")
        vertices = np.array(points, dtype=np.float64).reshape(-1, 3)
        if not np.isfinite(vertices).all():
            self._fail(f"block {name or '?'} has a coordinate that is no number")
        vertices = vertices @ place[:3, :3].T + place[:3, 3]
        if np.linalg.det(place[:3, :3]) < 0:
            faces = [face[::-1] for face in faces]
        return _Block(str(name), vertices, faces, bool(attributes.get("is_support")), attributes)

    def _fail(self, what: str, remedy: str = "write it again with compas.json_dump") -> NoReturn:
        raise InputError(f"{self._path} cannot be read as COMPAS data: {what}; {remedy}")


def _named(blocks: list[_Block]) -> list[_Block]:
    """Return blocks with names that tell them apart: their own, or numbers if those do not."""
    names = [block.name for block in blocks]
    if all(names) and len(set(names)) == len(names):
        return blocks
    return [replace(block, name=str(number)) for number, block in enumerate(blocks)]


def _solid(block: _Block, scale: float) -> TriangleMesh:
    """Return a block as a checked mesh of triangles, in metres."""
    faces: list[list[int]] = []
    for face in block.faces:
        if len(face) < 3 or min(face) < 0 or max(face) >= len(block.vertices):
            raise MeshError(f"part {block.name}: a face uses a vertex that is not there; write the model again")
        corners = [[0, 1, 2]] if len(face) == 3 else triangulate(block.vertices[face])
        faces.extend([face[corner] for corner in triangle] for triangle in corners)
    if not faces:
        raise MeshError(f"part {block.name} has no faces; leave it out of the model")
    return check_mesh(block.name, block.vertices * scale, np.array(faces, dtype=np.int64))


def _box(content: dict[str, Any]) -> NDArray[np.float64]:
    """Return corners of a box, shape (8, 3)."""
    size = np.array([content["xsize"], content["ysize"], content["zsize"]], dtype=float) / 2
    frame = content["frame"]
    frame = frame.get("data", frame)
    x, y = (np.array(frame[axis], dtype=float) for axis in ("xaxis", "yaxis"))
    axes = np.stack([x, y, np.cross(x, y)])
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * size
    return corners @ axes + np.array(frame["point"], dtype=float)


def _matrix(transformation: Any) -> NDArray[np.float64]:
    """Return a COMPAS transformation as a matrix, shape (4, 4); the identity for none."""
    if not transformation:
        return _IDENTITY
    content = transformation.get("data", transformation)
    matrix = np.array(content["matrix"], dtype=float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("a transformation is a matrix of shape (4, 4)")
    return matrix


def _content(data: dict[str, Any]) -> Any:
    """Return the content of an object; the first version of COMPAS called it `value`."""
    return data["data"] if "data" in data else data["value"]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)

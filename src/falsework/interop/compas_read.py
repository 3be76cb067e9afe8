"""Reader of COMPAS data: lists of meshes, assemblies of compas_assembly, models of compas_dem.

COMPAS writes every object as JSON with the name of its class, `{"dtype": "compas.datastructures/Mesh", "data": ...}`.
The classes that hold blocks are few and plain, so they are read here without COMPAS.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.draft import Block, Draft
from falsework.errors import InputError
from falsework.geometry.arrays import apply, points_of
from falsework.geometry.mesh.read import unit_length
from falsework.geometry.mesh.surface import warn_of, warn_of_curves
from falsework.interop.compas_shapes import CURVED, inner, shape_mesh
from falsework.utils.files.formats import Reader
from falsework.utils.files.input_file import read_text
from falsework.utils.json_text import parse_json
from falsework.utils.quantity import is_number, listed

LARGEST_FILE = 512 * 1024 * 1024
"""Bytes; a file beyond that is refused rather than read into memory."""

_IDENTITY = np.eye(4)
_MESHES = {"compas.datastructures/Mesh", "compas_assembly.datastructures/Block"}
_SHAPES = {f"compas.geometry/{name}" for name in ("Polyhedron", "Box", *CURVED)}
_MODELS = {"compas_model.models/Model", "compas_dem.models/BlockModel"}
_ELEMENT = "compas_model.elements/Element"
_GROUP = "compas_model.elements/Group"
_NO_VOLUME = {
    f"compas.geometry/{name}"
    for name in (
        "Point", "Vector", "Line", "Polyline", "Polygon", "Plane", "Frame", "Pointcloud", "Quaternion", "Circle", "Arc",
        "Ellipse", "Hyperbola", "Parabola", "Bezier", "Curve", "NurbsCurve", "OCCCurve", "OCCNurbsCurve",
        "RhinoCurve", "RhinoNurbsCurve", "Surface", "NurbsSurface", "PlanarSurface", "Transformation", "Translation",
        "Rotation", "Scale", "Shear", "Reflection", "Projection",
    )
} | {
    "compas.datastructures/Graph", "compas.datastructures/Tree", "compas.colors/Color", "compas.tolerance/Tolerance"
}  # fmt: skip
"""Classes of objects that bound no solid."""
_LOAD_KEYS = (("force", "force"), ("moment", "moment"), ("at", "point"))
"""Entries of a load in `assembly.json`, and of a compas_dem `PointLoad`."""


def _is_compas(path: Path) -> bool:
    """Return whether a file looks like COMPAS data: JSON that names the class of an object."""
    with path.open("rb") as file:
        return b'"dtype"' in file.read(65536)


def read_compas(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read the parts and interfaces of a file of COMPAS data, unchecked.

    Blocks are meshes in a list or a dictionary, the blocks of a compas_assembly `Assembly`, or the elements of a
    compas_dem `BlockModel` with their transformations, of this version or an older one, alone or in a `Problem`.
    Supports (`is_support`) are boundary. Attributes `density` and `friction`, which `write_compas` adds, the densities
    of materials and the friction, cohesion and tension (Pa), point loads and body forces of a `Problem` are read too.
    COMPAS data have no unit.

    Args:
        unit: unit of the coordinates; metres if not given.
    """
    path, scale = Path(path), unit_length(unit or "m")
    return _Reader(path).draft(None, scale)


def draft_of(data: Any, name: str) -> Draft:
    """Return the parts and interfaces in COMPAS data, JSON values with coordinates in metres, as `read_compas`."""
    return _Reader(Path(name)).draft(data, 1.0)


class _Reader:
    """Reader of the blocks in COMPAS data, with precise errors."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.interfaces: list[dict[str, Any]] = []
        """Interfaces of the blocks that were read, as `Draft.from_blocks` takes them."""
        self._left_out: Counter[str] = Counter()
        self._curved: list[str] = []

    def draft(self, data: Any, scale: float) -> Draft:
        """Return the parts in data, of the file if none are given."""
        if data is None and not self._path.is_file():
            raise InputError(f"there is no file {self._path}; give one that compas.json_dump wrote")
        if data is None and self._path.stat().st_size > LARGEST_FILE:
            self._fail(f"it is larger than {LARGEST_FILE // 2**20} MiB", "write fewer or coarser meshes")
        try:
            found = list(self._find(parse_json(read_text(self._path)) if data is None else data))
        except UnicodeDecodeError:
            self._fail("it is not text")
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            self._fail(f"something in it is not as COMPAS writes it ({type(error).__name__})")
        except RecursionError:
            self._fail("it is nested too deeply")
        if not found:
            self._fail("there is no block in it", "give a list of meshes, an Assembly, a BlockModel or a Problem")
        if self._left_out:
            kinds = listed([f"{count} {kind}" for kind, count in self._left_out.items()])
            warn_of(self._path, f"what bounds no solid was left out: {kinds}")
        warn_of_curves(self._path, self._curved)
        return Draft.from_blocks(self._path, scale, found, self.interfaces)

    def _find(self, data: Any, key: str = "") -> Iterator[Block]:
        """Yield all blocks in a value, in their order; one without a name is called by its key in a dictionary."""
        if isinstance(data, list):
            for item in data:
                yield from self._find(item)
            return
        if not isinstance(data, dict):
            return
        kind = data.get("dtype")
        if kind is None:
            for name, item in data.items():
                yield from self._find(item, name)
            return
        kinds = {kind, *data.get("inheritance", [])}
        content: dict[str, Any] = _content(data)
        if kinds & _MESHES or kind in _SHAPES:
            yield self._block(data, _IDENTITY, fallback=key)
        elif "compas_assembly.datastructures/Assembly" in kinds or _is_assembly(content):
            yield from self._assembly(content)
        elif kinds & _MODELS:
            yield from self._model(content)
        elif kind == "compas_dem.problem/Problem":
            yield from self._problem(content)
        elif _ELEMENT in kinds:
            yield from self._element(data, _IDENTITY, {})
        elif kind in _NO_VOLUME:
            self._left_out[str(kind)] += 1
        else:
            # Keys in it are names of attributes, not of blocks.
            inner = list(self._find(list(content.values()) if isinstance(content, dict) else content))
            if not inner:
                self._fail(f"there is a {kind} in it, which is not known", "convert it to a mesh, or leave it out")
            warn_of(self._path, f"objects of class {kind} are not known; blocks in them were read as they are")
            yield from inner

    def _assembly(self, content: dict[str, Any]) -> Iterator[Block]:
        """Yield blocks of a compas_assembly `Assembly`: the nodes of its graph."""
        graph = inner(content["graph"])
        default = graph.get("default_node_attributes") or {}
        common = {key: value for key, value in content.get("attributes", {}).items() if key == "friction"}
        self._read_edges(graph, "interfaces", {key: (id(graph), key) for key in graph["node"]})
        for key, node in graph["node"].items():
            attributes = {**default, **node}
            if not attributes.get("block"):
                self._left_out["node without a block"] += 1
            else:
                block = self._block(attributes["block"], _IDENTITY, fallback=str(key))
                yield replace(
                    block,
                    support=block.support or self._flag(attributes.get("is_support"), block.name),
                    attributes={**common, **block.attributes},
                    key=(id(graph), key),
                )

    def _model(self, content: dict[str, Any]) -> Iterator[Block]:
        """Yield elements of a compas_model `Model`, such as a `BlockModel`, where their places in its tree put them."""
        elements = content["elements"]
        if isinstance(elements, list):  # before version 0.3 of compas_model
            elements = {element["guid"]: element for element in elements}
        materials = content.get("materials") or {}
        graph = inner(content.get("graph") or {"node": {}})
        self._read_edges(
            graph, "contacts", {key: (id(elements), node.get("element")) for key, node in graph["node"].items()}
        )

        placed = set()

        def walk(node: dict[str, Any], above: NDArray[np.float64]) -> Iterator[Block]:
            for child in node.get("children") or []:
                guid = child.get("element")
                place = above
                if guid in elements:
                    placed.add(guid)
                    place = above @ _matrix(inner(elements[guid]).get("transformation"))
                    for block in self._element(elements[guid], above, materials):
                        yield replace(block, key=(id(elements), guid))
                yield from walk(child, place)

        yield from walk(inner(content["tree"])["root"], _matrix(content.get("transformation")))
        if len(placed) < len(elements):
            self._left_out["element outside the tree of its model"] += len(elements) - len(placed)

    def _element(self, element: dict[str, Any], above: NDArray[np.float64], materials: Any) -> Iterator[Block]:
        """Yield the block of an element of a model; none for a group."""
        inside = inner(element)
        kinds = {element.get("dtype"), *element.get("inheritance", [])}
        name = _own_name(element, element.get("name") or inside.get("name"))
        geometry = inside.get("geometry") or inside.get("shape")
        if not geometry:
            if _GROUP not in kinds:
                self._fail(f"element {name or '?'} is a {element.get('dtype')} without its mesh", "give it a mesh")
            return
        if inside.get("features"):
            self._fail(f"element {name or '?'} has features that change its shape", "apply them and store the mesh")
        block = self._block(geometry, above @ _matrix(inside.get("transformation")))
        attributes = dict(block.attributes)
        material = inside.get("material")
        if isinstance(materials, dict) and material in materials:
            attributes.setdefault("density", inner(materials[material]).get("density"))
        support = self._flag(inside.get("is_support"), block.name) or block.support
        yield replace(block, name=str(name or block.name), support=support, attributes=attributes)

    def _problem(self, content: dict[str, Any]) -> Iterator[Block]:
        """Yield blocks of a compas_dem `Problem`: those of its model, with its contact law; held ones are supports."""
        if not content.get("model"):
            self._fail("its Problem names a model that is not in it", "write the BlockModel instead")
        properties = inner(content.get("contact_properties") or {})
        law = inner(properties.get("contact_model") or {})
        friction = math.tan(math.radians(law["phi"])) if law.get("phi") is not None else law.get("mu")
        groups = content.get("boundary_conditions") or []
        model = inner(content["model"])
        nodes = inner(model.get("graph") or {"node": {}})["node"]
        known = {str(key): node.get("element") for key, node in nodes.items()}
        held, loads, acceleration = self._conditions(groups if isinstance(groups, list) else [groups], known)
        for block in self._find(content["model"]):
            assert isinstance(block.key, tuple)
            attributes = dict(block.attributes)
            if friction is not None:
                attributes["friction"] = friction
            attributes |= {name: law[key] for name, key in (("cohesion", "c"), ("tension", "t_c")) if law.get(key)}
            attributes |= {"loads": loads.get(block.key[1], []), "acceleration": acceleration}
            yield replace(block, support=block.support or block.key[1] in held, attributes=attributes)

    def _conditions(
        self, groups: list[Any], known: Mapping[str, Any]
    ) -> tuple[set[Any], dict[Any, list[dict[str, Any]]], list[float]]:
        """Return the held blocks, the loads on blocks, and the acceleration of all, of boundary conditions."""
        held: set[Any] = set()
        loads: dict[Any, list[dict[str, Any]]] = {}
        acceleration = [0.0, 0.0, 0.0]
        for group in map(inner, groups):
            if group.get("surface_loads"):
                self._fail("it has a surface load", "give a point load instead")
            for entry in map(inner, group.get("displacements") or []):
                given = entry.get("translation") or entry.get("rotation") or []
                if any(component != 0 for component in given):
                    self._fail(
                        f"it moves block {entry['block_index']} or leaves it free in part",
                        "prescribe zero in all directions, or nothing",
                    )
                held.add(known.get(str(entry["block_index"])))
            for entry in map(inner, group.get("point_loads") or []):
                node = str(entry["block_index"])
                if node not in known:
                    self._fail(f"a load acts on block {node}, which does not exist", "leave the load out")
                load = {name: entry[key] for name, key in _LOAD_KEYS if entry.get(key) is not None}
                loads.setdefault(known[node], []).append(load)
            for entry in map(inner, group.get("body_forces") or []):
                acceleration = [a + float(b) for a, b in zip(acceleration, entry["acceleration"], strict=True)]
        return held - {None}, loads, acceleration

    def _read_edges(self, graph: dict[str, Any], name: str, keys: dict[str, Hashable]) -> None:
        """Keep the interfaces at the edges of a graph."""
        for one, others in (graph.get("edge") or {}).items():
            for two, attributes in (others or {}).items():
                found = (attributes or {}).get(name) or []
                for interface in found if isinstance(found, list) else [found]:
                    inside = inner(interface)
                    points = [inner(point) if isinstance(point, dict) else point for point in inside["points"]]
                    frame = inner(inside.get("frame") or {})
                    axes = frame.get("xaxis"), frame.get("yaxis")
                    normal = np.cross(*np.array(axes, dtype=float)) if None not in axes else np.array([0.0, 0.0, 1.0])
                    entry = {"keys": (keys.get(one), keys.get(two)), "points": points, "normal": normal}
                    self.interfaces.append(entry)

    def _block(self, data: dict[str, Any], place: NDArray[np.float64], fallback: str = "") -> Block:
        """Return one mesh, polyhedron or box."""
        content: dict[str, Any] = _content(data)
        if any("transformation" in entry and not _is_identity(entry["transformation"]) for entry in (data, content)):
            self._fail("a block has a transformation beside its shape", "apply it and store the shape")
        name = _own_name(data, data.get("name") or (content.get("attributes") or {}).get("name")) or fallback
        attributes = dict(content.get("attributes") or {})
        if "vertex" in content:
            default = {"x": 0.0, "y": 0.0, "z": 0.0, **(content.get("default_vertex_attributes") or {})}
            order = {str(key): row for row, key in enumerate(content["vertex"])}
            points = [[{**default, **vertex}[axis] for axis in "xyz"] for vertex in content["vertex"].values()]
            faces = [[order[str(corner)] for corner in face] for face in content["face"].values()]
        elif "vertices" in content:
            points, faces = content["vertices"], content["faces"]
        elif (shape := str(data.get("dtype")).removeprefix("compas.geometry/")) in ("Box", *CURVED):
            points, faces = shape_mesh(shape, content)
            self._curved += [f"{shape} {name}".rstrip()] * (shape in CURVED)
        else:
            self._fail(f"block {name or '?'} is a {data.get('dtype')}, not a mesh", "convert it to a mesh")
        try:
            vertices = apply(place, points_of(points))
        except (TypeError, ValueError):
            self._fail(f"block {name or '?'} has a corner that is not three numbers")
        if np.linalg.det(place[:3, :3]) < 0:
            faces = [face[::-1] for face in faces]
        for entry in ("density", "friction"):
            value = attributes.get(entry)
            if value is not None and not is_number(value):
                self._fail(f"the {entry} of block {name or '?'} is {value!r}", "give a number")
        return Block(str(name), vertices, faces, self._flag(attributes.get("is_support"), name), attributes)

    def _flag(self, value: Any, name: Any) -> bool:
        """Return whether a block is a support."""
        if value not in (None, False, True):
            self._fail(f"is_support of block {name or '?'} is {value!r}", "give true or false")
        return bool(value)

    def _fail(self, what: str, remedy: str = "write it again with compas.json_dump") -> NoReturn:
        raise InputError(f"{self._path} cannot be read as COMPAS data: {what}; {remedy}")


def _own_name(data: dict[str, Any], name: Any) -> str:
    """Return the name of an object; empty if it is that of a class, which COMPAS gives to objects without one."""
    classes = {str(kind).rpartition("/")[2] for kind in (data.get("dtype"), *_MESHES, *_SHAPES)}
    return "" if not name or name in classes else str(name)


def _matrix(transformation: Any) -> NDArray[np.float64]:
    """Return a COMPAS transformation as a matrix, shape (4, 4); the identity for none."""
    if not transformation:
        return _IDENTITY
    matrix = np.array(inner(transformation)["matrix"], dtype=float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("a transformation is a matrix of shape (4, 4)")
    return matrix


def _is_identity(transformation: Any) -> bool:
    return bool(np.allclose(_matrix(transformation), _IDENTITY, atol=1e-12))


def _is_assembly(content: Any) -> bool:
    """Return whether an object of any class, such as a `CRA_Assembly`, has blocks at the nodes of a graph."""
    graph = inner(content.get("graph") or {}) if isinstance(content, dict) else {}
    nodes = graph.get("node") if isinstance(graph, dict) else None
    return isinstance(nodes, dict) and any(isinstance(node, dict) and "block" in node for node in nodes.values())


def _content(data: dict[str, Any]) -> Any:
    """Return the content of an object; the first version of COMPAS called it `value`."""
    return data["data"] if "data" in data else data["value"]


READER = Reader((".json",), parts=read_compas, recognizes=_is_compas)

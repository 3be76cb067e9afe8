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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.draft import Block, Draft
from falsework.errors import InputError
from falsework.geometry.arrays import apply
from falsework.geometry.mesh.read import unit_length
from falsework.geometry.mesh.surface import warn_of, warn_of_curves
from falsework.interop.compas import compas_model as model
from falsework.interop.compas.compas_item import CompasItem
from falsework.interop.compas.shapes import SHAPES, mesh_of, shape_mesh
from falsework.utils.files.formats import Reader
from falsework.utils.files.input_file import read_text
from falsework.utils.json_text import parse_json
from falsework.utils.models import path_to
from falsework.utils.quantity import listed

LARGEST_FILE = 512 * 1024 * 1024
"""Bytes; a file beyond that is refused rather than read into memory."""

_IDENTITY = np.eye(4)
_MESHES = {"compas.datastructures/Mesh", "compas_assembly.datastructures/Block"}
_SHAPES = {f"compas.geometry/{name}" for name in ("Polyhedron", *SHAPES)}
_ASSEMBLY = "compas_assembly.datastructures/Assembly"
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
        self._names: list[str] = []
        self._left_out: Counter[str] = Counter()
        self._curved: list[str] = []

    def draft(self, data: Any, scale: float) -> Draft:
        """Return the parts in data, of the file if none are given."""
        if data is None and not self._path.is_file():
            raise InputError(f"there is no file {self._path}; give one that compas.json_dump wrote")
        content = CompasItem(data, f"{self._path} cannot be read as COMPAS data: ")
        if data is None and self._path.stat().st_size > LARGEST_FILE:
            content.fail(f"it is larger than {LARGEST_FILE // 2**20} MiB", "write fewer or coarser meshes")
        if data is None:
            try:
                content = replace(content, value=parse_json(read_text(self._path)))
            except UnicodeDecodeError:
                content.fail("it is not text in UTF-8")
            except ValueError as error:
                content.fail(str(error))
        found = list(self._find(content))
        if not found:
            content.fail("there is no block in it", "give a list of meshes, an Assembly, a BlockModel or a Problem")
        if self._left_out:
            kinds = listed([f"{count} {kind}" for kind, count in self._left_out.items()])
            warn_of(self._path, f"what bounds no solid was left out: {kinds}")
        warn_of_curves(self._path, self._curved)
        draft = Draft.from_blocks(self._path, scale, found, self.interfaces)
        return replace(draft, name=self._names[0] if len(self._names) == 1 else "")

    def _find(self, item: CompasItem, key: str = "") -> Iterator[Block]:
        """Yield all blocks in a value, in their order; one without a name is called by its key in a dictionary."""
        if item.get("dtype") is None:
            for step, entry in item.entries():
                yield from self._find(entry, step if isinstance(step, str) else "")
            return
        thing = item.read(model.CompasThing)
        content = _content(item)
        kinds = {thing.dtype, *thing.inheritance}
        if kinds & _MESHES or thing.dtype in _SHAPES:
            yield self._block(item, _IDENTITY, fallback=key)
        elif _ASSEMBLY in kinds or _is_assembly(content):
            yield from self._assembly(thing, content)
        elif kinds & _MODELS:
            yield from self._model(thing, content)
        elif thing.dtype == "compas_dem.problem/Problem":
            yield from self._problem(content)
        elif _ELEMENT in kinds:
            yield from self._element(item, _IDENTITY, None)
        elif thing.dtype in _NO_VOLUME:
            self._left_out[str(thing.dtype)] += 1
        else:
            # Keys in it are names of attributes, not of blocks.
            entries = [entry for _, entry in content.entries()]
            found = [block for entry in entries for block in self._find(entry)]
            if not found:
                item.fail(
                    f"there is a {thing.dtype} in it, which is not known", "convert it to a mesh, or leave it out"
                )
            warn_of(self._path, f"objects of class {thing.dtype} are not known; blocks in them were read as they are")
            yield from found

    def _assembly(self, thing: model.CompasThing, content: CompasItem) -> Iterator[Block]:
        """Yield blocks of a compas_assembly `Assembly`: the nodes of its graph."""
        attributes = content.read(model.CompasAssembly).attributes or model.CompasBlockAttributes()
        self._names.append(_own_name(thing, thing.name or attributes.name))
        common = {} if attributes.friction is None else {"friction": attributes.friction}
        item = content.at("graph").opened()
        graph = item.read(model.CompasGraph)
        default = graph.default_node_attributes or model.CompasGraphNode()
        mark = id(item.value)
        self._read_edges(item, graph, "interfaces", {key: (mark, key) for key in graph.node})
        for key, node in graph.node.items():
            holder = item.at("node", key)
            if not holder.get("block"):
                self._left_out["node without a block"] += 1
                continue
            block = self._block(holder.at("block"), _IDENTITY, fallback=key)
            support = default.is_support if node.is_support is None else node.is_support
            yield replace(
                block,
                support=block.support or bool(support),
                attributes={**common, **block.attributes},
                key=(mark, key),
            )

    def _model(self, thing: model.CompasThing, content: CompasItem) -> Iterator[Block]:
        """Yield elements of a compas_model `Model`, such as a `BlockModel`, where their places in its tree put them."""
        self._names.append(_own_name(thing, thing.name))
        elements: dict[str, CompasItem] = {}
        content.read(model.CompasModel)
        for step, element in content.at("elements").entries():
            elements[step if isinstance(step, str) else element.read(model.CompasKeyed).guid] = element
        mark = id(content.value)
        if content.get("graph"):
            item = content.at("graph").opened()
            graph = item.read(model.CompasGraph)
            self._read_edges(item, graph, "contacts", {key: (mark, node.element) for key, node in graph.node.items()})
        materials = content.at("materials") if isinstance(content.get("materials"), dict) else None
        placed = set()

        def walk(node: model.CompasTreeNode, above: NDArray[np.float64]) -> Iterator[Block]:
            for child in node.children or []:
                place = above
                if child.element in elements:
                    placed.add(child.element)
                    element = elements[child.element]
                    place = above @ _place(element.opened())
                    for block in self._element(element, above, materials):
                        yield replace(block, key=(mark, child.element))
                yield from walk(child, place)

        yield from walk(content.at("tree").opened().read(model.CompasTree).root, _place(content))
        if len(placed) < len(elements):
            self._left_out["element outside the tree of its model"] += len(elements) - len(placed)

    def _element(
        self, element: CompasItem, above: NDArray[np.float64], materials: CompasItem | None
    ) -> Iterator[Block]:
        """Yield the block of an element of a model; none for a group."""
        thing, inside = element.read(model.CompasThing), element.opened()
        data = inside.read(model.CompasElement)
        name = _own_name(thing, thing.name or data.name)
        shape = next((key for key in ("geometry", "shape") if inside.get(key)), None)
        if shape is None:
            if _GROUP not in {thing.dtype, *thing.inheritance}:
                element.fail(f"element {name or '?'} is a {thing.dtype} without its mesh", "give it a mesh")
            return
        if inside.get("features"):
            element.fail(f"element {name or '?'} has features that change its shape", "apply them and store the mesh")
        block = self._block(inside.at(shape), above @ _place(inside))
        attributes, material = dict(block.attributes), inside.get("material")
        if materials is not None and isinstance(material, str) and material in materials.value:
            density = materials.at(material).opened().read(model.CompasMaterial).density
            attributes.setdefault("density", density)
        support = bool(data.is_support) or block.support
        yield replace(block, name=name or block.name, support=support, attributes=attributes)

    def _problem(self, content: CompasItem) -> Iterator[Block]:
        """Yield blocks of a compas_dem `Problem`: those of its model, with its contact law; held ones are supports."""
        problem = content.read(model.CompasProblem)
        if not content.get("model"):
            content.fail("its Problem names a model that is not in it", "write the BlockModel instead")
        inside = content.at("model")
        kind = inside.read(model.CompasThing)
        if not {kind.dtype, *kind.inheritance} & _MODELS:
            inside.fail(f"{inside.where} is a {kind.dtype}, not a BlockModel")
        law = model.CompasContactLaw()
        if problem.contact_properties is not None:
            properties = content.at("contact_properties").opened()
            if properties.read(model.CompasContactProperties).contact_model is not None:
                law = properties.at("contact_model").opened().read(model.CompasContactLaw)
        friction = law.mu if law.phi is None else math.tan(math.radians(law.phi))
        inside = inside.opened()
        nodes: Mapping[str, model.CompasGraphNode] = {}
        if inside.get("graph"):
            nodes = inside.at("graph").opened().read(model.CompasGraph).node
        known = {key: node.element for key, node in nodes.items()}
        held, loads, acceleration = self._conditions(content, known)
        for block in self._model(kind, inside):
            assert isinstance(block.key, tuple)
            attributes = dict(block.attributes)
            given = {"friction": friction, "cohesion": law.c or None, "tension": law.t_c or None}
            attributes |= {name: value for name, value in given.items() if value is not None}
            attributes |= {"loads": loads.get(block.key[1], []), "acceleration": acceleration}
            yield replace(block, support=block.support or block.key[1] in held, attributes=attributes)

    def _conditions(
        self, problem: CompasItem, known: Mapping[str, str | None]
    ) -> tuple[set[str | None], dict[str | None, list[dict[str, Any]]], list[float]]:
        """Return the held blocks, the loads on blocks, and the acceleration of all, of boundary conditions."""
        held: set[str | None] = set()
        loads: dict[str | None, list[dict[str, Any]]] = {}
        acceleration = [0.0, 0.0, 0.0]
        for group in problem.several("boundary_conditions"):
            group.read(model.CompasConditions)
            if group.get("surface_loads"):
                group.fail("it has a surface load", "give a point load instead")
            for entry in group.several("displacements"):
                motion = entry.read(model.CompasDisplacement)
                if any(component != 0 for component in motion.translation or motion.rotation or []):
                    entry.fail(
                        f"it moves block {motion.block_index} or leaves it free in part",
                        "prescribe zero in all directions, or nothing",
                    )
                held.add(known.get(str(motion.block_index)))
            for entry in group.several("point_loads"):
                acting = entry.read(model.CompasPointLoad)
                node = str(acting.block_index)
                if node not in known:
                    entry.fail(f"a load acts on block {node}, which does not exist", "leave the load out")
                given = {name: getattr(acting, key) for name, key in _LOAD_KEYS}
                load = {name: list(value) for name, value in given.items() if value is not None}
                loads.setdefault(known[node], []).append(load)
            for entry in group.several("body_forces"):
                more = entry.read(model.CompasBodyForce).acceleration
                acceleration = [a + b for a, b in zip(acceleration, more, strict=True)]
        return held - {None}, loads, acceleration

    def _read_edges(self, item: CompasItem, graph: model.CompasGraph, name: str, keys: Mapping[str, Hashable]) -> None:
        """Keep the interfaces at the edges of a graph."""
        for one, others in (graph.edge or {}).items():
            for two, edge in (others or {}).items():
                if edge is None:
                    continue
                for inside in item.at("edge", one, two).several(name):
                    interface = inside.read(model.CompasInterface)
                    points = [point.opened().read(model.Vector) for _, point in inside.at("points").entries()]
                    axes = model.CompasAxes()
                    if interface.frame is not None:
                        axes = inside.at("frame").opened().read(model.CompasAxes)
                    normal = np.array([0.0, 0.0, 1.0])
                    if axes.xaxis is not None and axes.yaxis is not None:
                        normal = np.cross(axes.xaxis, axes.yaxis)
                    entry = {"keys": (keys.get(one), keys.get(two)), "points": points, "normal": normal}
                    self.interfaces.append(entry)

    def _block(self, item: CompasItem, place: NDArray[np.float64], fallback: str = "") -> Block:
        """Return one mesh, polyhedron or shape."""
        thing, content = item.read(model.CompasThing), _content(item)
        own = content.read(model.CompasAttributed).attributes or model.CompasBlockAttributes()
        if not all(np.allclose(_place(entry), _IDENTITY, atol=1e-12) for entry in (item, content)):
            item.fail("a block has a transformation beside its shape", "apply it and store the shape")
        name = _own_name(thing, thing.name or own.name) or fallback
        shape = str(thing.dtype).removeprefix("compas.geometry/")
        if "vertices" in content.value or shape == "Polyhedron":
            solid = content.read(model.CompasPolyhedron)
            points, faces = solid.vertices, solid.faces
        elif "vertex" in content.value or {thing.dtype, *thing.inheritance} & _MESHES:
            points, faces = mesh_of(content)
        elif shape in SHAPES:
            points, faces = shape_mesh(shape, content)
            self._curved += [f"{shape} {name}".rstrip()] * (shape != "Box")
        else:
            item.fail(f"block {name or '?'} is a {thing.dtype}, not a mesh", "convert it to a mesh")
        vertices = apply(place, np.array(points, dtype=np.float64).reshape(-1, 3))
        if not np.isfinite(vertices).all():
            item.fail(f"block {name or '?'} has corners that are no numbers", "write it again in a unit that fits")
        if np.linalg.det(place[:3, :3]) < 0:
            faces = [face[::-1] for face in faces]
        attributes = {name: value for name in ("density", "friction") if (value := getattr(own, name)) is not None}
        return Block(name, vertices, faces, bool(own.is_support), attributes)


def _own_name(thing: model.CompasThing, name: str | float | None) -> str:
    """Return the name of an object; empty if it is that of a class, which COMPAS gives to objects without one."""
    classes = {str(kind).rpartition("/")[2] for kind in (thing.dtype, *_MESHES, *_SHAPES, _ASSEMBLY)}
    return "" if not name or name in classes else str(name)


def _place(item: CompasItem) -> NDArray[np.float64]:
    """Return the transformation of an object as a matrix, shape (4, 4); the identity if it has none."""
    if not item.get("transformation"):
        return _IDENTITY
    return np.array(item.at("transformation").opened().read(model.CompasTransformation).matrix)


def _is_assembly(content: CompasItem) -> bool:
    """Return whether an object of any class, such as a `CRA_Assembly`, has blocks at the nodes of a graph."""
    nodes = content.at("graph").opened().get("node") if content.get("graph") else None
    return isinstance(nodes, dict) and any(isinstance(node, dict) and "block" in node for node in nodes.values())


def _content(item: CompasItem) -> CompasItem:
    """Return the content of an object with the name of its class."""
    content = item.opened()
    if content is item:
        item.fail(f"{path_to(item.where, 'data')} is missing")
    return content


READER = Reader((".json",), parts=read_compas, recognizes=_is_compas)

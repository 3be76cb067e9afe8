"""Writer of COMPAS data: a list of meshes, an assembly of compas_assembly, or a model of compas_dem."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from falsework.errors import InputError
from falsework.utils.files.formats import Exporter, writer_of

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

CompasKind = Literal["meshes", "assembly", "dem"]

_SPACE = uuid.UUID("6f0f1c0e-7d53-5c4e-9a3e-1b7a52f2d1aa")
"""Names in this space give the same structure the same guids each time it is written."""
_Guids = Callable[[str], str]
"""Guids of the objects of one structure, by name."""
_MESH, _BLOCK = "compas.datastructures/Mesh", "compas_assembly.datastructures/Block"
_XYZ = {"x": 0.0, "y": 0.0, "z": 0.0}


def to_compas(assembly: Assembly, kind: CompasKind = "meshes") -> Any:
    """Return a structure as JSON values that `compas.json_load` reads.

    Args:
        kind: `meshes`, a list of `compas.datastructures.Mesh` with the attributes `is_support`, `density` and
            `friction`, which plain COMPAS reads; `assembly`, a compas_assembly `Assembly` whose edges carry the
            contacts as `Interface`; `dem`, a compas_dem `BlockModel`.

    Raises:
        InputError: an unknown kind.
    """
    if kind not in get_args(CompasKind):
        raise InputError(f"{kind!r} is not a kind of COMPAS data; choose {', '.join(get_args(CompasKind))}")

    def guid(name: str) -> str:
        return str(uuid.uuid5(_SPACE, f"{assembly.identity}/{name}"))

    if kind == "meshes":
        return [_mesh(assembly, part, guid) for part in range(assembly.part_count)]
    return _assembly(assembly, guid) if kind == "assembly" else _model(assembly, guid)


def _data(dtype: str, content: Mapping[str, Any], guid: str, name: str = "", parents: tuple[str, ...] = ()) -> dict:
    """Return an object as COMPAS writes it."""
    return {
        "dtype": dtype,
        "data": dict(content),
        "inheritance": list(parents),
        **({"name": name} if name else {}),
        "guid": guid,
    }


def _attributes(assembly: Assembly, part: int) -> dict[str, Any]:
    return {
        "is_support": bool(assembly.boundary[part]),
        "density": float(assembly.density[part]),
        "friction": assembly.friction,
    }


def _mesh(assembly: Assembly, part: int, guid: _Guids, dtype: str = _MESH, role: str = "part") -> dict[str, Any]:
    mesh = assembly.meshes[part]
    vertices, faces = mesh.vertices.tolist(), mesh.faces.tolist()
    content = {
        "attributes": {**_attributes(assembly, part), **({"node": part} if dtype == _BLOCK else {})},
        "default_vertex_attributes": _XYZ,
        "default_edge_attributes": {},
        "default_face_attributes": {},
        "vertex": {str(row): dict(zip("xyz", point, strict=True)) for row, point in enumerate(vertices)},
        "face": {str(row): face for row, face in enumerate(faces)},
        "facedata": {},
        "edgedata": {},
        "max_vertex": len(vertices) - 1,
        "max_face": len(faces) - 1,
    }
    return _data(dtype, content, guid(f"{role} {part}"), assembly.names[part], (_MESH,) if dtype == _BLOCK else ())


def _assembly(assembly: Assembly, guid: _Guids) -> dict[str, Any]:
    """Return a compas_assembly `Assembly`: blocks at the nodes of a graph, interfaces at its edges."""
    centers = assembly.mass.center.tolist()
    nodes = {
        str(part): {
            **dict(zip("xyz", centers[part], strict=True)),
            "block": _mesh(assembly, part, guid, _BLOCK),
            "is_support": bool(assembly.boundary[part]),
        }
        for part in range(assembly.part_count)
    }
    edges: dict[str, dict[str, Any]] = {str(part): {} for part in range(assembly.part_count)}
    contacts = assembly.contacts
    for number, (a, b) in enumerate(contacts.parts.tolist()):
        points = contacts.points[contacts.start[number] : contacts.start[number + 1]]
        _, along, across = contacts.frames[number]
        interface = {
            "points": points.tolist(),
            "size": float(contacts.areas[number]),
            "frame": _frame(points.mean(axis=0), along, across),
            "forces": None,
            "mesh": None,
        }
        entry = _data("compas_assembly.datastructures/Interface", interface, guid(f"contact {number}"))
        edges[str(a)].setdefault(str(b), {"interfaces": []})["interfaces"].append(entry)
    graph = {
        "attributes": {},
        "default_node_attributes": {
            **_XYZ,
            "block": None,
            "is_support": False,
            "section": None,
            "mesh_size": None,
            "displacement": [0, 0, 0, 0, 0, 0],
        },
        "default_edge_attributes": {"interfaces": None},
        "node": nodes,
        "edge": edges,
        "max_node": assembly.part_count - 1,
    }
    content = {
        "attributes": {"name": assembly.name, "friction": assembly.friction},
        "graph": _data("compas.datastructures/Graph", graph, guid("graph")),
    }
    return _data("compas_assembly.datastructures/Assembly", content, guid("assembly"))


def _model(assembly: Assembly, guid: _Guids) -> dict[str, Any]:
    """Return a compas_dem `BlockModel`; it finds its contacts itself."""
    elements, children, nodes = {}, [], {}
    for part, name in enumerate(assembly.names):
        block = {
            "transformation": None,
            "features": [],
            "name": name,
            "material": None,
            "geometry": _mesh(assembly, part, guid, role="geometry"),
            "is_support": bool(assembly.boundary[part]),
        }
        key = guid(f"element {part}")
        elements[key] = _data("compas_dem.elements/Block", block, key, name, ("compas_model.elements/Element",))
        children.append({"name": "ElementNode", "element": key})
        nodes[str(part)] = {"element": key}
    content = {
        "transformation": None,
        "elements": elements,
        "materials": {},
        "tree": {"attributes": {}, "root": {"name": "root", "children": children}},
        "graph": {
            "attributes": {},
            "default_node_attributes": {**_XYZ, "element": None},
            "default_edge_attributes": {"modifiers": None, "contacts": None},
            "node": nodes,
            "edge": {key: {} for key in nodes},
            "max_node": assembly.part_count - 1,
        },
    }
    return _data("compas_dem.models/BlockModel", content, guid("model"), assembly.name, ("compas_model.models/Model",))


def _frame(origin: np.ndarray, xaxis: np.ndarray, yaxis: np.ndarray) -> dict[str, Any]:
    content = {"point": origin.tolist(), "xaxis": xaxis.tolist(), "yaxis": yaxis.tolist()}
    return {"dtype": "compas.geometry/Frame", "data": content, "inheritance": []}


def _exporter(kind: CompasKind) -> Exporter:
    def text(assembly: Assembly) -> str:
        return json.dumps(to_compas(assembly, kind), ensure_ascii=False, allow_nan=False) + "\n"

    return Exporter(writer_of(text), (".json",), contacts=kind == "assembly")


MESHES, ASSEMBLY, DEM = _exporter("meshes"), _exporter("assembly"), _exporter("dem")

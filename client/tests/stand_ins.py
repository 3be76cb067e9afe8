"""Stand-ins for the classes of Rhino and Grasshopper, with the members that the client uses."""

from __future__ import annotations

import types
from typing import Any

from tests.arch import CUBE, FACES


class Face:
    """`Rhino.Geometry.MeshFace`."""

    def __init__(self, *corners: int) -> None:
        self.A, self.B, self.C, self.D = (*corners, corners[2])[:4]
        self.IsQuad = len(corners) == 4


class Vertices:
    """`Rhino.Geometry.Collections.MeshVertexList`; iteration over it would give single precision."""

    def __init__(self, points: Any) -> None:
        self._points = list(points)

    def ToPoint3dArray(self) -> list[Any]:
        return [types.SimpleNamespace(X=x, Y=y, Z=z) for x, y, z in self._points]


class Mesh:
    def __init__(self, points: Any, faces: list[Face]) -> None:
        self.Vertices = Vertices(points)
        self.Faces = faces

    @staticmethod
    def CreateFromBrep(brep: Any, parameters: Any) -> Any:
        assert parameters == "render"
        return brep.meshes or None


class Brep:
    """A solid; it too has vertices and faces, but not those of a mesh."""

    Vertices = Faces = ()

    def __init__(self, meshes: list[Mesh]) -> None:
        self.meshes = meshes


class _MadeOfBrep:
    def __init__(self, brep: Brep | None) -> None:
        self._brep = brep

    def ToBrep(self) -> Brep | None:
        return self._brep


class Extrusion(_MadeOfBrep):
    pass


class Box(_MadeOfBrep):
    pass


class SubD(_MadeOfBrep):
    pass


class Circle:
    pass


class Component:
    """`ghenv.Component`."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, str]] = []

    def AddRuntimeMessage(self, level: str, text: str) -> None:
        self.messages.append((level, text))


def mesh_cube(size: float = 1.0, up: float = 0.0) -> Mesh:
    """A cube of quads."""
    points = [(size * x, size * y, size * z + up) for x, y, z in CUBE]
    return Mesh(points, [Face(*face) for face in FACES])


def brep_cube(size: float = 1.0, up: float = 0.0) -> Brep:
    """A cube, which Rhino meshes face by face."""
    points = [(size * x, size * y, size * z + up) for x, y, z in CUBE]
    return Brep([Mesh([points[corner] for corner in face], [Face(0, 1, 2, 3)]) for face in FACES])


RHINO: Any = types.ModuleType("Rhino")
RHINO.Geometry = types.ModuleType("Rhino.Geometry")
RHINO.Geometry.Mesh = Mesh
RHINO.Geometry.MeshingParameters = types.SimpleNamespace(QualityRenderMesh="render")
RHINO.RhinoDoc = types.SimpleNamespace(ActiveDoc=types.SimpleNamespace(ModelUnitSystem="Meters"))

GRASSHOPPER: Any = types.ModuleType("Grasshopper")
GRASSHOPPER.Kernel = types.SimpleNamespace(GH_RuntimeMessageLevel=types.SimpleNamespace(Error="error"))

"""Models of COMPAS data, as far as they are used; objects in them that have models of their own are read apart."""

from __future__ import annotations

from typing import Annotated

from msgspec import UNSET, Meta, UnsetType

from falsework.utils.models import ForeignModel

Length = Annotated[float, Meta(gt=0)]
Vector = tuple[float, float, float]
Row = tuple[float, float, float, float]


class CompasThing(ForeignModel, frozen=True):
    """Object with the name of its class."""

    dtype: str | None = None
    inheritance: list[str] = []
    """Classes that it derives from."""
    name: str | float | None = None


class CompasKeyed(ForeignModel, frozen=True):
    """Object in a list with a key."""

    guid: str


class CompasBlockAttributes(ForeignModel, frozen=True):
    """Attributes of a block or an assembly."""

    name: str | float | None = None
    density: float | None = None
    """kg/m3."""
    friction: float | None = None
    """Coefficient of friction of its contacts."""
    is_support: bool | None = None
    """Whether it is fixed."""


class CompasAttributed(ForeignModel, frozen=True):
    """Data of a block of any class."""

    attributes: CompasBlockAttributes | None = None


class CompasCorner(ForeignModel, frozen=True):
    """Coordinates of a vertex; the default ones are used where it has none."""

    x: float | UnsetType = UNSET
    y: float | UnsetType = UNSET
    z: float | UnsetType = UNSET


class CompasHalfEdgeMesh(ForeignModel, frozen=True):
    """Data of a `Mesh`."""

    vertex: dict[str, CompasCorner]
    """Vertices by their keys."""
    face: dict[str, list[int | str]]
    """Keys of the vertices of each face."""
    default_vertex_attributes: CompasCorner | None = None


class CompasPolyhedron(ForeignModel, frozen=True):
    """Data of a `Polyhedron`, or of a `Mesh` by lists."""

    vertices: list[Vector]
    faces: list[list[int]]
    """Numbers of the vertices of each face."""


class CompasShape(ForeignModel, frozen=True):
    """Data of a shape with a frame."""

    frame: ForeignModel


class CompasBox(CompasShape, frozen=True):
    """Data of a `Box`."""

    xsize: float
    ysize: float
    zsize: float


class CompasRound(CompasShape, frozen=True):
    """Data of a `Sphere`."""

    radius: Length


class CompasLong(CompasRound, frozen=True):
    """Data of a `Cylinder`, `Cone` or `Capsule`."""

    height: Length


class CompasTorus(CompasShape, frozen=True):
    """Data of a `Torus`."""

    radius_axis: Length
    radius_pipe: Length


class CompasFrame(ForeignModel, frozen=True):
    """Data of a `Frame`."""

    point: Vector
    xaxis: Vector
    yaxis: Vector


class CompasTransformation(ForeignModel, frozen=True):
    """Data of a `Transformation`."""

    matrix: tuple[Row, Row, Row, Row]


class CompasGraphNode(ForeignModel, frozen=True):
    """Node of a graph: of an assembly with its block, of a model with the key of its element."""

    element: str | None = None
    is_support: bool | None = None


class CompasGraphEdge(ForeignModel, frozen=True):
    """Edge of a graph, with the interfaces between two blocks, or one."""

    interfaces: list[ForeignModel] | ForeignModel | None = None
    contacts: list[ForeignModel] | ForeignModel | None = None


class CompasGraph(ForeignModel, frozen=True):
    """Data of a `Graph`."""

    node: dict[str, CompasGraphNode]
    edge: dict[str, dict[str, CompasGraphEdge | None] | None] | None = None
    default_node_attributes: CompasGraphNode | None = None


class CompasAssembly(CompasAttributed, kw_only=True, frozen=True):
    """Data of a compas_assembly `Assembly`."""

    graph: ForeignModel


class CompasInterface(ForeignModel, frozen=True):
    """Data of an interface; only the axes of its frame are used."""

    points: list[list[float] | ForeignModel]
    frame: ForeignModel | None = None


class CompasAxes(ForeignModel, frozen=True):
    """Axes of a frame."""

    xaxis: Vector | None = None
    yaxis: Vector | None = None


class CompasTreeNode(ForeignModel, frozen=True):
    """Node of the tree of a model."""

    element: str | None = None
    """Key of its element."""
    children: list[CompasTreeNode] | None = None


class CompasTree(ForeignModel, frozen=True):
    """Data of a `Tree`."""

    root: CompasTreeNode


class CompasModel(ForeignModel, frozen=True):
    """Data of a compas_model `Model`, such as a `BlockModel`."""

    elements: dict[str, ForeignModel] | list[ForeignModel]
    """By their keys; a list before version 0.3 of compas_model."""
    tree: ForeignModel
    graph: ForeignModel | None = None


class CompasElement(ForeignModel, frozen=True):
    """Data of an element of a model."""

    name: str | float | None = None
    is_support: bool | None = None
    geometry: ForeignModel | None = None
    shape: ForeignModel | None = None


class CompasMaterial(ForeignModel, frozen=True):
    """Data of a material."""

    density: float | None = None
    """kg/m3."""


class CompasProblem(ForeignModel, frozen=True):
    """Data of a compas_dem `Problem`."""

    model: ForeignModel | None = None
    contact_properties: ForeignModel | None = None
    boundary_conditions: list[ForeignModel] | ForeignModel | None = None


class CompasContactProperties(ForeignModel, frozen=True):
    """Data of the contacts of a problem."""

    contact_model: ForeignModel | None = None


class CompasContactLaw(ForeignModel, frozen=True):
    """Data of a contact law."""

    phi: float | None = None
    """Angle of friction, degrees."""
    mu: float | None = None
    """Coefficient of friction."""
    c: float | None = None
    """Cohesion, Pa."""
    t_c: float | None = None
    """Tension, Pa."""


class CompasConditions(ForeignModel, frozen=True):
    """Data of a group of boundary conditions."""

    displacements: list[ForeignModel] | None = None
    point_loads: list[ForeignModel] | None = None
    body_forces: list[ForeignModel] | None = None


class CompasDisplacement(ForeignModel, frozen=True):
    """Data of a motion that is prescribed."""

    block_index: int | str
    translation: list[float | None] | None = None
    rotation: list[float | None] | None = None


class CompasPointLoad(ForeignModel, frozen=True):
    """Data of a load."""

    block_index: int | str
    force: Vector | None = None
    """N."""
    moment: Vector | None = None
    """N m."""
    point: Vector | None = None


class CompasBodyForce(ForeignModel, frozen=True):
    """Data of an acceleration of all blocks."""

    acceleration: Vector
    """m/s2."""

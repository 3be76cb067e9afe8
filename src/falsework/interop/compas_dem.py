"""Solver for compas_dem: takes its `Problem`, returns its `Results`.

from falsework.interop import compas_dem
results = compas_dem.solve(problem)
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.loads import GRAVITY, Loads
from falsework.assembly.model import Assembly
from falsework.assembly.state import complete_state
from falsework.errors import InputError
from falsework.interop.compas_read import draft_of
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion, Proof, Verdict
from falsework.utils.lazy import importing

Array = NDArray[np.float64]


def solve(problem: Any, *, criterion: Criterion = "contact", gravity: float | None = None) -> Any:
    """Solve the complete structure of a compas_dem `Problem`, with the contact forces.

    Contacts are those of `model.compute_contacts()`, found from the meshes where it was not called. Density is that of
    the blocks' materials; friction, cohesion and tension (Pa) are those of the contact model. Supports are the model's,
    and blocks whose displacement is prescribed as zero. Point loads and body forces act; surface loads are refused.

    The results hold, as those of compas_dem's solvers do, for every edge `contact_data` (a `FrictionContact`,
    `EdgeContact` or `VertexContact`), `contact_points`, `contact_polygon`, `contact_frame` with z from the first to the
    second node of the edge, `force_normal`, `force_tangent1` and `force_tangent2` of each point in N,
    `resultant_local`, `resultant_global` (acting on the second node), `force_point` and `force_magnitude`; and for
    every node `transformation`. `metadata` holds `solver`, `verdict`, `proof`, `residual`, `mu` and `criterion`.
    Displacements are those that produce the forces under the law of the criterion `contact`, whose joints are stiff:
    their ratios are meaningful, their size is not. They are zero under `equilibrium`. A structure that is unstable has
    no forces: it has no edges, and `velocity` at each node is the collapse velocity `(linear, angular)`.

    Args:
        problem: `compas_dem.problem.Problem` with its model.
        gravity: m/s2 along -z; that of the problem if not given, 9.81 if it has none.

    Returns:
        `compas_dem.problem.Results`.

    Raises:
        DependencyError: compas_dem is not installed.
        InputError: surface loads, a load on a block that is not there, moved supports, or a contact model other than
            Coulomb's.
        MeshError: a block that does not bound a solid.
        AssemblyError: the blocks make no assembly, or their contacts do not fit them.
    """
    with importing("compas_dem is not installed; pip install compas_dem"):
        from compas.geometry import Transformation
        from compas_dem.problem import Results
    model = problem.model
    assembly, nodes = _assembly_and_nodes(problem)
    g = _gravity(problem) if gravity is None else gravity
    if assembly.loads is not None and g > 0:  # body forces are m/s2, and shares of 9.81 m/s2 in the assembly
        wrench, share = assembly.loads.wrench, assembly.loads.acceleration * GRAVITY / g
        assembly = assembly.replace(loads=Loads.from_arrays(assembly.part_count, wrench=wrench, acceleration=share))
    state = complete_state(assembly.boundary)
    verdicts = StabilityOracle(assembly, StabilitySettings(criterion=criterion, gravity=g)).verdicts(
        state, require_certificate=True
    )
    verdict = verdicts.kinds[0]
    assert verdicts.forces is not None
    assert verdicts.velocity is not None
    results = Results(model_id=str(model.guid), problem_id=str(problem.guid))
    residual = float(verdicts.residual[0])
    results.metadata |= {
        "solver": "falsework",
        "verdict": verdict.name.lower(),
        "proof": Proof(verdicts.proof[0]).name.lower(),
        "residual": residual if np.isfinite(residual) else None,
        "on_tolerance": bool(verdicts.on_tolerance[0]),
        "criterion": criterion,
        "mu": assembly.friction,
    }
    moved = np.zeros((len(nodes), 6))
    if verdict == Verdict.STABLE and verdicts.displacement is not None:
        moved = verdicts.displacement[0]
    for part, node in enumerate(nodes):
        place = _transformation(moved[part], assembly.mass.center[part])
        results.set_node(node, "transformation", Transformation(place.tolist()))
        if verdict == Verdict.UNSTABLE:
            results.set_node(node, "velocity", verdicts.velocity[0, part].tolist())
    if verdict in (Verdict.STABLE, Verdict.SLIDES, Verdict.TIPS):
        _set_edges(results, assembly, nodes, verdicts.forces[0])
    return results


def assembly_of(problem: Any) -> Assembly:
    """Return the assembly of a compas_dem `Problem` with its model."""
    return _assembly_and_nodes(problem)[0]


def _assembly_and_nodes(problem: Any) -> tuple[Assembly, list[Any]]:
    """Return the assembly of a problem, read as from a file, and the graph node of each part."""
    from compas.data import json_dumps

    model, law = problem.model, problem.contact_properties.contact_model
    friction = None if law is None else getattr(law, "mu", None)
    if law is not None and friction is None:
        raise InputError("contacts without friction cannot be solved; set a Mohr-Coulomb contact model with mu")
    data = json.loads(json_dumps(problem))
    data["data"]["model"] = json.loads(json_dumps(model))
    draft = draft_of(data, str(model.name or "model"))
    node_of = {str(element.guid): element.graphnode for element in model.elements()}
    nodes = [node_of[block.key[1]] for block in draft.blocks if isinstance(block.key, tuple)]
    return draft.assemble(friction=friction, interfaces="stored" if draft.interfaces else "found"), nodes


def _gravity(problem: Any) -> float:
    values = {float(group.g) for group in problem.boundary_conditions}
    if len(values) > 1:
        raise InputError("boundary conditions differ in gravity; give one (gravity=9.81)")
    return values.pop() if values else 9.81


def _transformation(moved: Array, center: Array) -> Array:
    """Return the rigid motion of a translation and a rotation about a centre, shape (4, 4)."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(moved[3:]).as_matrix()
    matrix[:3, 3] = moved[:3] + center - matrix[:3, :3] @ center
    return matrix


def _set_edges(results: Any, assembly: Assembly, nodes: list[Any], forces: Array) -> None:
    """Write the contacts of every pair of parts as one edge, as compas_dem has them.

    Args:
        forces: `(n, t1, t2)` in N, shape (points, 3).
    """
    from compas.geometry import Frame, Polygon, Vector
    from compas_dem.interactions import EdgeContact, FrictionContact, VertexContact

    contacts = assembly.contacts
    point_contact = contacts.contact_of_point
    vectors = np.einsum("pi,pij->pj", forces, contacts.point_frames)
    for a, b in np.unique(contacts.parts, axis=0).tolist():
        mine = np.flatnonzero((contacts.parts == (a, b)).all(axis=1))
        rows = np.flatnonzero(np.isin(point_contact, mine))
        axes = contacts.frames[mine[np.argmax(contacts.areas[mine])]]
        points = contacts.points[rows]
        local = vectors[rows] @ axes.T
        frame = Frame(points.mean(axis=0).tolist(), Vector(*axes[1].tolist()), Vector(*axes[2].tolist()))
        components = [{"c_np": max(n, 0.0), "c_nn": max(-n, 0.0), "c_u": u, "c_v": v} for n, u, v in local.tolist()]
        corners = points.tolist()
        edge = (nodes[a], nodes[b])
        total = vectors[rows].sum(axis=0)
        values: dict[str, Any] = {"face_contact": False, "edge_contact": False, "point_contact": False}
        if len(corners) > 2:
            values["face_contact"] = True
            values["contact_polygon"] = Polygon(corners)
            values["contact_data"] = FrictionContact(points=corners, frame=frame, forces=components)
        elif len(corners) == 2:
            values["edge_contact"] = True
            values["contact_data"] = EdgeContact(points=corners, frame=frame, forces=components)
        else:
            values["point_contact"] = True
            values["contact_data"] = VertexContact(point=corners[0], frame=frame, forces=components)
        pressing = np.maximum(local[:, 0], 0)
        weights = pressing if pressing.sum() > 0 else np.ones(len(points))
        values |= {
            "contact_points": corners,
            "contact_frame": frame,
            "force_normal": local[:, 0].tolist(),
            "force_tangent1": local[:, 1].tolist(),
            "force_tangent2": local[:, 2].tolist(),
            "force_vector": vectors[rows].tolist(),
            "nodal_force_magnitudes": np.linalg.norm(vectors[rows], axis=1).tolist(),
            "resultant_local": [*local[:, 1:].sum(axis=0).tolist(), float(local[:, 0].sum())],
            "resultant_global": total.tolist(),
            "force_magnitude": float(np.linalg.norm(total)),
            "force_point": (weights @ points / weights.sum()).tolist(),
        }
        for name, value in values.items():
            results.set_edge(edge, name, value)

"""The solver for compas_dem, with the package itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import load_structure
from falsework.errors import InputError
from falsework.interop import compas_dem

pytest.importorskip("compas_dem", reason="needs compas_dem, of the dependency group test")

BARREL = "formats/compas_dem_problem_barrel.json"


def problem_of(model: Any, friction: float) -> Any:
    """Problem of a model whose blocks weigh 2,000 kg/m3, with its contacts."""
    from compas_dem.material import Stone
    from compas_dem.problem import Problem

    stone = Stone(density=2000)
    model.add_material(stone)
    model.assign_material(stone, elements=list(model.elements()))
    model.compute_contacts(tolerance=1e-4, minimum_area=1e-4)
    problem = Problem(model)
    problem.set_contact_model("MohrCoulomb", mu=friction)
    return problem


def stack(friction: float = 0.5, tilt: float = 0.0) -> Any:
    """Three cubes of 1 m on a support, about y turned by some degrees."""
    from compas.geometry import Box, Frame, Rotation
    from compas_dem.models import BlockModel

    turn = Rotation.from_axis_and_angle([0, 1, 0], np.radians(tilt))
    boxes = [Box(1, 1, 1, Frame([0, 0, level + 0.5], [1, 0, 0], [0, 1, 0])).transformed(turn) for level in range(4)]
    model = BlockModel.from_boxes(boxes)
    next(iter(model.elements())).is_support = True
    return problem_of(model, friction)


def write_problem(problem: Any, path: Path) -> None:
    """Write a problem with its model inside, as compas_dem did before 0.6."""
    from compas import json_dumps

    data = json.loads(json_dumps(problem))
    data["data"]["model"] = json.loads(json_dumps(problem.model))
    path.write_text(json.dumps(data))


@pytest.fixture(scope="module")
def barrel(public_structure_path: Callable[[str], Path]) -> Any:
    """The barrel vault: 121 blocks, 26 of them supports, friction 0.5."""
    from compas.datastructures import Mesh
    from compas_dem.elements import Block
    from compas_dem.models import BlockModel

    data = json.loads(public_structure_path(BARREL).read_text())["data"]["model"]["data"]
    model = BlockModel()
    for node in data["graph"]["node"].values():
        element = data["elements"][node["element"]]["data"]
        block = Block.from_mesh(Mesh.__from_data__(element["geometry"]["data"]))
        block.is_support = element["is_support"]
        model.add_element(block)
    return problem_of(model, 0.5)


@pytest.fixture(scope="module")
def solved(barrel: Any) -> Any:
    return compas_dem.solve(barrel)


def reaction(problem: Any, results: Any) -> np.ndarray:
    """Total force of the supports on the blocks, N, shape (3,)."""
    supports = {element.graphnode for element in problem.model.supports()}
    total = np.zeros(3)
    for u, v in results.edges():
        if (u in supports) != (v in supports):
            total += np.array(results.resultant_global((u, v))) * (1 if u in supports else -1)
    return total


def test_a_stack_carries_its_weight() -> None:
    problem = stack()
    results = compas_dem.solve(problem)
    weight = 2000 * 9.81
    assert results.metadata["verdict"] == "stable"
    assert results.metadata["mu"] == 0.5
    assert list(results.edges()) == [(0, 1), (1, 2), (2, 3)]
    for above, edge in zip((3, 2, 1), results.edges(), strict=True):
        assert results.face_contact(edge)
        assert results.resultant_global(edge) == pytest.approx([0, 0, above * weight], rel=1e-3, abs=weight / 1000)
        assert sum(results.force_normal(edge)) == pytest.approx(above * weight, rel=1e-3)
        assert list(results.contact_frame(edge).zaxis) == pytest.approx([0, 0, 1])
        contact = results.contact_data(edge)
        assert sum(force["c_np"] for force in contact.forces) == pytest.approx(above * weight, rel=1e-3)
        assert contact.polygon.area == pytest.approx(1.0)
        assert list(contact.resultantpoint) == pytest.approx(results.edge_attribute(edge, "force_point"), abs=1e-3)
    sink = [results.displacement(node)[2] for node in range(4)]
    assert sink[0] == 0
    assert 0 > sink[1] > sink[2] > sink[3]


def test_gravity_is_that_of_the_problem() -> None:
    problem = stack()
    problem.add_boundary_condition("moon").add_gravity(1.62)
    assert reaction(problem, compas_dem.solve(problem))[2] == pytest.approx(3 * 2000 * 1.62, rel=1e-3)


def test_a_stack_that_slides_off_has_no_forces() -> None:
    results = compas_dem.solve(stack(friction=0.2, tilt=15.0))
    assert results.metadata["verdict"] == "unstable"
    assert not list(results.edges())
    assert results.node_attribute(3, "velocity")[0] > 0
    assert compas_dem.solve(stack(friction=0.5, tilt=15.0)).metadata["verdict"] == "stable"


def test_contacts_are_found_where_none_were_computed() -> None:
    problem = stack()
    for edge in list(problem.model.graph.edges()):
        problem.model.graph.delete_edge(edge)
    assert len(list(compas_dem.solve(problem).edges())) == 3


@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_mohr_coulomb_law_with_cohesion(share: float) -> None:
    """A stack turned by 15 degrees stays if `c A` is what `W sin a` exceeds `mu W cos a` by in the lowest joint."""
    problem, angle = stack(tilt=15.0), np.radians(15.0)
    weight = 3 * 2000 * 9.81
    cohesion = share * weight * (np.sin(angle) - 0.2 * np.cos(angle))
    problem.set_contact_model("MohrCoulomb", mu=0.2, c=cohesion, t_c=cohesion)
    assert (compas_dem.solve(problem, criterion="equilibrium").metadata["verdict"] == "stable") == (share > 1)


@pytest.mark.parametrize(("share", "stands"), [(0.45, True), (0.55, False)])
@pytest.mark.parametrize("kind", ["push", "acceleration"])
def test_point_loads_and_body_forces_act(kind: str, share: float, stands: bool, tmp_path: Path) -> None:
    """A cube on held ones slides under half of its weight, its friction; a file has the same loads."""
    problem = stack()
    held, live = problem.add_boundary_condition("held"), problem.add_boundary_condition("live")
    for block in (1, 2):
        held.add_displacement(block, dx=0.0, dy=0.0, dz=0.0)
    if kind == "push":
        live.add_point_load(3, [share * 2000 * 9.81, 0, 0], point=[0, 0, 3.0])
    else:
        for _ in range(2):
            live.add_global_body_force(share * 9.81 / 2, 0, 0)
    assert (compas_dem.solve(problem).metadata["verdict"] == "stable") == stands
    write_problem(problem, tmp_path / "problem.json")
    read, own = load_structure(tmp_path / "problem.json"), compas_dem.assembly_of(problem)
    assert read.loads is not None
    assert own.loads is not None
    np.testing.assert_allclose(read.loads.wrench, own.loads.wrench, atol=1e-6)
    np.testing.assert_allclose(read.loads.acceleration, own.loads.acceleration, atol=1e-12)
    also = load_structure(tmp_path / "problem.json", earthquake=[0.0, 0.1]).loads
    assert also is not None
    np.testing.assert_allclose(also.wrench, own.loads.wrench, atol=1e-6)  # of the file; the earthquake was replaced
    assert also.acceleration.tolist() == [0.0, 0.1, 0.0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda group: group.add_point_load(9, [0, 0, -1]), "a load acts on block 9, which does not exist"),
        (lambda group: group.add_surface_load(3, 0, [0, 0, -1]), "a surface load; give a point load"),
        (lambda group: group.add_displacement(2, dx=0.1, dy=0.0, dz=0.0), "moves block 2 or leaves it free"),
    ],
)
def test_conditions_in_a_file_that_cannot_act(change: Callable[[Any], Any], words: str, tmp_path: Path) -> None:
    problem = stack()
    change(problem.add_boundary_condition("live"))
    write_problem(problem, tmp_path / "problem.json")
    with pytest.raises(InputError, match=words):
        load_structure(tmp_path / "problem.json")


def test_what_cannot_act_is_refused() -> None:
    problem = stack()
    group = problem.add_boundary_condition("live")
    group.add_displacement(1, dx=0.0, dy=0.0, dz=0.0)
    assert reaction(problem, compas_dem.solve(problem))[2] == 0  # block 1 is held by itself
    group.add_displacement(2, dx=0.1, dy=0.0, dz=0.0)
    with pytest.raises(InputError, match="moves block 2"):
        compas_dem.solve(problem)
    problem = stack()
    problem.add_boundary_condition("nowhere").add_point_load(9, [0, 0, -1])
    with pytest.raises(InputError, match="a load acts on block 9, which does not exist"):
        compas_dem.solve(problem)
    problem = stack()
    problem.add_boundary_condition("wind").add_surface_load(3, 0, [0, 0, -1])
    with pytest.raises(InputError, match="it has a surface load; give a point load"):
        compas_dem.solve(problem)


def test_the_barrel_vault_is_in_equilibrium(barrel: Any, solved: Any) -> None:
    assert solved.metadata["verdict"] == "stable"
    assembly = compas_dem.assembly_of(barrel)
    weight = 9.81 * assembly.mass.mass[~assembly.boundary].sum()
    assert len(list(solved.edges())) == 320
    assert reaction(barrel, solved) == pytest.approx([0, 0, weight], abs=1e-4 * weight)
    for edge in solved.edges():
        across, along, pressing = solved.resultant_local(edge)
        assert np.hypot(across, along) <= 0.5 * pressing + 1e-6 * weight


@pytest.mark.slow
def test_forces_in_the_barrel_vault_are_those_of_lmgc90(
    barrel: Any, solved: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("compas_lmgc90", reason="needs LMGC90; pip install --no-deps compas_lmgc90")
    from compas_dem.analysis.lmgc90 import lmgc90_solve

    monkeypatch.chdir(tmp_path)
    # Steps as in the authors' analysis of this vault.
    other = lmgc90_solve(barrel, barrel.model, n_steps=100, dt=0.001, verbose=100)
    normal = np.array([[some.resultant_local(edge)[2] for some in (solved, other)] for edge in solved.edges()])
    ours, theirs = normal.T
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.02)
    assert np.corrcoef(ours, theirs)[0, 1] > 0.97
    assert np.median(np.abs(ours - theirs)) < 0.05 * theirs.max()

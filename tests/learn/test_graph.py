"""The force-torque graph of a structure, against what its contacts say."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from falsework import Assembly, load_structure
from falsework.geometry import TriangleMesh
from falsework.learn.networks.force_torque_graph import ForceTorqueGraph


def prism(name: str, rings: list[tuple[float, float]], facets: int, hollow: bool) -> TriangleMesh:
    """A closed surface of revolution about z, of facets; (radius, height) go around its section counter-clockwise."""
    turn = 2 * np.pi * np.arange(facets) / facets
    vertices = np.concatenate([np.stack([r * np.cos(turn), r * np.sin(turn), np.full(facets, z)], 1) for r, z in rings])
    faces = []
    around = [*range(len(rings)), 0] if hollow else list(range(len(rings)))
    for low, high in pairwise(around):
        for k in range(facets):
            n = (k + 1) % facets
            a, b, c, d = low * facets + k, low * facets + n, high * facets + n, high * facets + k
            faces += [(a, b, c), (a, c, d)]
    if not hollow:  # close the bottom and the top with fans
        faces += [(0, k + 1, k) for k in range(1, facets - 1)]
        top = (len(rings) - 1) * facets
        faces += [(top, top + k, top + k + 1) for k in range(1, facets - 1)]
    return TriangleMesh.from_arrays(name, vertices, faces)


@pytest.fixture(scope="module")
def peg() -> Assembly:
    """A cylinder of 72 facets in the bore of a fixed ring."""
    ring = prism("ring", [(0.05, 0.0), (0.1, 0.0), (0.1, 0.1), (0.05, 0.1)], 72, hollow=True)
    return Assembly.from_meshes([prism("peg", [(0.05, -0.02), (0.05, 0.12)], 72, hollow=False), ring], boundary=[1])


def test_a_cylinder_of_72_facets_is_a_handful_of_forces(peg: Assembly) -> None:
    graph = ForceTorqueGraph.from_assembly(peg)
    assert len(peg.contacts) >= 20
    assert 6 <= graph.force_count <= 12
    assert 2 * len(graph.point_force) <= 8 * graph.force_count
    assert np.abs(graph.normals[:, 2]).max() < 1e-6
    outwards = np.where(graph.force_parts[:, :1] == 0, 1, -1) * graph.normals
    assert np.linalg.norm(outwards.mean(axis=0)) < 0.2  # all around the peg
    side = (graph.force_parts[graph.point_force] == 1).argmin(axis=1)
    levers = graph.levers[np.arange(len(side)), side]  # from the centre of the peg
    assert (np.einsum("ij,ij->i", outwards[graph.point_force], levers) > 0).all()


@pytest.mark.parametrize("name", ["bottle", "polycube", "wall:bricks=4,courses=4"])
def test_flat_structures_have_a_force_for_each_normal_and_all_their_points(name: str) -> None:
    assembly = load_structure(name)
    graph = ForceTorqueGraph.from_assembly(assembly)
    contacts = assembly.contacts
    between = [contact for contact, pair in enumerate(contacts.parts) if not assembly.boundary[pair].all()]

    def described(pair: np.ndarray, normal: np.ndarray) -> tuple[float, ...]:
        flip = -1 if pair[0] > pair[1] else 1
        return (*sorted(pair.tolist()), *(np.round(flip * normal, 3) + 0.0).tolist())

    wanted = {described(contacts.parts[one], contacts.normals[one]) for one in between}
    found = {described(pair, normal) for pair, normal in zip(graph.force_parts, graph.normals, strict=True)}
    assert found == wanted
    assert graph.force_count == len(wanted)
    assert 2 * len(graph.point_force) == 2 * int(np.diff(contacts.start)[between].sum())


def test_the_bottle_is_small() -> None:
    """What is cut along squares has parallel contacts between the same two parts; they are one force."""
    bottle = load_structure("bottle")
    graph = ForceTorqueGraph.from_assembly(bottle)
    assert graph.force_count < len(bottle.contacts)
    assert graph.force_count <= 4 * len(np.unique(bottle.contacts.parts, axis=0))


def test_levers_lead_from_the_centres_to_the_points() -> None:
    arch = load_structure("arch:blocks=5")
    graph = ForceTorqueGraph.from_assembly(arch)
    a, b = arch.mass.center[graph.force_parts[graph.point_force]].swapaxes(0, 1)
    between = (graph.levers[:, 0] - graph.levers[:, 1]).astype(float)
    scale = np.linalg.norm(b - a, axis=1) / np.linalg.norm(between, axis=1)
    np.testing.assert_allclose(scale, scale[0], rtol=1e-5)  # the unit of length
    np.testing.assert_allclose(
        graph.levers[:, 0] * scale[:, None] + a, graph.levers[:, 1] * scale[:, None] + b, atol=1e-6
    )


def test_the_grid_holds_every_torque_once() -> None:
    graph = ForceTorqueGraph.from_assembly(load_structure("polycube"))
    grid = graph.grid()
    assert grid.taken.sum() == len(graph.point_force)
    for force in range(graph.force_count):
        rows = grid.force == force
        np.testing.assert_array_equal(
            grid.levers[rows].swapaxes(1, 2)[grid.taken[rows]], graph.levers[graph.point_force == force]
        )


def test_two_fixed_parts_exert_no_force_worth_knowing() -> None:
    wall = load_structure("wall:bricks=3,courses=2")
    everything = ForceTorqueGraph.from_assembly(wall.replace(boundary=np.ones(wall.part_count, dtype=bool)))
    assert (everything.force_count, len(everything.point_force)) == (0, 0)

"""Contact graph as networks read it: what it depends on, and what it does not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from falsework import Assembly, load_structure
from falsework.assembly import Joints
from falsework.geometry import TriangleMesh
from falsework.learn import PolicySettings, make_policy, transfer
from falsework.learn.networks.contact_graph import MOST_NEIGHBOURS, ContactGraph
from falsework.learn.networks.local_attention import GraphTensors, LocalAttentionPolicy


def turned(assembly: Assembly, angle: float) -> Assembly:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    meshes = [TriangleMesh.from_arrays(mesh.name, mesh.vertices @ turn.T, mesh.faces) for mesh in assembly.meshes]
    return Assembly.from_meshes(meshes, boundary=assembly.boundary, density=assembly.density)


def states_of(assembly: Assembly, count: int = 8) -> torch.Tensor:
    states = np.random.default_rng(0).integers(0, 3, (count, assembly.part_count), dtype=np.uint8)
    states[:, assembly.boundary] = 2
    return torch.from_numpy(states)


@pytest.mark.parametrize("name", ["arch:blocks=5", "polycube:pieces=8,size=3", "dome:rings=2,blocks=5", "house"])
def test_features_are_finite_and_of_moderate_size(name: str) -> None:
    graph = ContactGraph.from_assembly(load_structure(name))
    for array in (graph.part, graph.pair, graph.lever, graph.whole):
        assert np.isfinite(array).all()
        assert np.abs(array).max() < 10
    assert not graph.pair[~graph.taken].any()
    np.testing.assert_allclose(graph.pair[~graph.boundary, :, 0].sum(axis=1), 1.0, rtol=1e-5, err_msg="shares of area")


def test_a_pair_has_the_friction_of_its_joint() -> None:
    """Joints have one coefficient a point, or none; with that of the structure everywhere, they change nothing."""
    dome = load_structure("dome:rings=2,blocks=5")
    plain = ContactGraph.from_assembly(dome)
    for friction in (np.nan, dome.friction):
        same = dome.replace(joints=Joints.from_arrays(dome.contacts, friction=friction))
        np.testing.assert_array_equal(ContactGraph.from_assembly(same).pair, plain.pair)
    rough = dome.replace(joints=Joints.from_arrays(dome.contacts, friction=0.9))
    np.testing.assert_array_equal(
        ContactGraph.from_assembly(rough).pair, ContactGraph.from_assembly(dome.replace(friction=0.9)).pair
    )


@pytest.mark.parametrize("angle", [0.3, np.pi / 2, 4.0])
def test_a_turn_about_the_vertical_changes_no_answer(angle: float) -> None:
    dome = load_structure("dome:rings=2,blocks=5")
    policy = make_policy(dome, PolicySettings("local"))
    twin = transfer(policy.state_dict(), policy.settings, turned(dome, angle))
    states = states_of(dome)
    for ours, theirs in zip(policy(states), twin(states), strict=True):
        torch.testing.assert_close(theirs, ours, atol=2e-5, rtol=1e-4)


def test_slots_grow_with_neighbours_and_are_bounded() -> None:
    """A plate under many bricks sees a bounded number of them, and each brick sees the plate."""
    wall = load_structure(f"wall:bricks={MOST_NEIGHBOURS + 4},courses=1")
    graph = ContactGraph.from_assembly(Assembly.from_meshes(wall.meshes, boundary=[0]))
    assert graph.taken[-1].sum() == MOST_NEIGHBOURS
    assert graph.taken[1:-1].sum(axis=1).tolist() == [*[3] * (MOST_NEIGHBOURS + 2), 2]
    assert (graph.neighbour[1:-1] == wall.part_count - 1).any(axis=1).all()
    assert not graph.taken[0].any(), "what never changes needs no neighbours"


def test_a_policy_is_told_its_task() -> None:
    arch = load_structure("arch:blocks=5")
    policy, states = make_policy(arch, PolicySettings("local")), states_of(arch)
    two = policy(states)[0]
    assert not torch.allclose(policy.of_task(3, equilibrium=False)(states)[0], two)
    assert not torch.allclose(policy.of_task(2, equilibrium=True)(states)[0], two)
    assert torch.equal(policy.of_task(2, equilibrium=False)(states)[0], two)


def test_filling_up_changes_no_answer() -> None:
    """Parts and slots that only fill up a batch of several structures have no influence."""
    arch = load_structure("arch:blocks=5")
    policy = make_policy(arch, PolicySettings("local"))
    assert isinstance(policy, LocalAttentionPolicy)
    states = states_of(arch)
    graph = GraphTensors.from_graph(ContactGraph.from_assembly(arch))

    def filled(tensor: torch.Tensor, parts: int = 0, slots: int = 0) -> torch.Tensor:
        shape = list(tensor.shape)
        shape[1] += parts
        if len(shape) > 2 and slots:
            shape[2] += slots
        larger = torch.zeros(shape, dtype=tensor.dtype)
        larger[tuple(slice(size) for size in tensor.shape)] = tensor
        return larger

    fixed = filled(graph.fixed, 3)
    fixed[:, -3:] = True
    more = GraphTensors(
        filled(graph.part, 3), filled(graph.neighbour, 3, 2), filled(graph.taken, 3, 2), filled(graph.pair, 3, 2),
        filled(graph.lever, 3, 2), graph.whole, fixed, filled(graph.real, 3), graph.conditions, graph.robots,
    )  # fmt: skip
    numbers = policy.numbers(states, None)
    wider = torch.cat([numbers, torch.full((len(states), 3), 3)], dim=1)
    # A second structure in the batch, so that neighbours are gathered structure by structure.
    pair = more.take(torch.tensor([0, 0]))
    logits, value = policy.network(pair, torch.stack([wider, wider]))
    ours, ours_value = policy(states)
    parts = arch.part_count
    kept = logits[1].unflatten(1, (2, parts + 3))[..., :parts].flatten(1)
    torch.testing.assert_close(kept, ours, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(value[1], ours_value, atol=1e-5, rtol=1e-4)


def test_slots_do_not_multiply_with_parts() -> None:
    """Cost and memory are those of the contacts."""
    short, long = (ContactGraph.from_assembly(load_structure(f"wall:bricks={bricks},courses=4")) for bricks in (6, 24))
    assert long.neighbour.shape[1] == short.neighbour.shape[1] == 6

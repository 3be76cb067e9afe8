"""The network on the force-torque graph against a slow one that goes from edge to edge."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import elu, leaky_relu

from falsework import load_structure
from falsework.learn import PolicySettings, make_policy
from falsework.learn.networks import graph_attention as graph_network
from falsework.learn.networks.force_torque_graph import ForceTorqueGraph
from falsework.learn.networks.graph_attention import GraphAttentionPolicy, Layer

Nodes = dict[str, dict[int, Tensor]]
Edges = dict[tuple[str, str, str], list[tuple[int, int]]]


def edges_of(graph: ForceTorqueGraph) -> Edges:
    """All edges of figure 8 of the paper, self loops aside: (from, kind, to). Torque `2 p + s` is of point `p`."""
    torques, forces = np.arange(2 * len(graph.point_force)), np.arange(graph.force_count)
    a, b = graph.force_parts.T
    forward = {
        ("torque", "about", "part"): np.stack([torques, graph.force_parts[graph.point_force].reshape(-1)], axis=1),
        ("torque", "of", "force"): np.stack([torques, np.repeat(graph.point_force, 2)], axis=1),
        ("force", "into", "part"): np.stack([forces, b], axis=1),
        ("force", "out of", "part"): np.stack([forces, a], axis=1),
    }
    back = {(to, kind, start): pairs[:, ::-1] for (start, kind, to), pairs in forward.items()}
    every = forward | back | {("torque", "against", "torque"): np.stack([torques, torques ^ 1], axis=1)}
    every["part", "beside", "part"] = np.argwhere(~np.eye(graph.part_count, dtype=bool))
    return {kind: [(a, b) for a, b in pairs.tolist()] for kind, pairs in every.items()}


def present_in(graph: ForceTorqueGraph, state: np.ndarray) -> dict[str, list[int]]:
    """Nodes that are present in a state: those of which all parts are."""
    force = (state[graph.force_parts] != 0).all(axis=1)
    masks = {"part": state != 0, "force": force, "torque": force[np.repeat(graph.point_force, 2)]}
    return {kind: np.flatnonzero(mask).tolist() for kind, mask in masks.items()}


def attend(
    edges: list[tuple[int, int]],
    senders: dict[int, Tensor],
    says: Tensor,
    receivers: dict[int, Tensor],
    asks: Tensor,
    matrix: Tensor,
) -> dict[int, Tensor]:
    """Graph attention along one kind of edge, head by head, softmax over the edges into each node."""
    out = {}
    for node, own in receivers.items():
        into = [start for start, end in edges if end == node and start in senders]
        if not into:
            continue
        heads = []
        for head in range(len(matrix)):
            score = [leaky_relu(says[head] @ senders[one] + asks[head] @ own, 0.2) for one in into]
            weight = torch.softmax(torch.stack(score), dim=0)
            heads.append(
                torch.stack([w * (senders[one] @ matrix[head]) for w, one in zip(weight, into, strict=True)]).sum(0)
            )
        out[node] = torch.cat(heads)
    return out


def layer_by_edges(layer: Layer, nodes: Nodes, edges: Edges) -> Nodes:
    """One layer, from explicit lists of edges between nodes that are there."""
    h = layer.heads
    norms = {"part": layer.norm_part, "force": layer.norm_force, "torque": layer.norm_torque}
    x = {kind: {node: norms[kind](value) for node, value in group.items()} for kind, group in nodes.items()}
    new: Nodes = {"part": {node: layer.part_self(value) for node, value in x["part"].items()}}
    if layer.inward is not None:
        new["force"] = {node: layer.inward.force_self(value) for node, value in x["force"].items()}
        new["torque"] = {node: layer.inward.torque_self(value) for node, value in x["torque"].items()}

    def linear(kind: tuple[str, str, str], weight: Tensor) -> None:
        for start, end in edges[kind]:
            if start in x[kind[0]] and end in x[kind[2]]:
                new[kind[2]][end] = new[kind[2]][end] + weight @ x[kind[0]][start]

    def attention(kind: tuple[str, str, str], says: Tensor, asks: Tensor, matrix: Tensor) -> None:
        for node, value in attend(edges[kind], x[kind[0]], says, x[kind[2]], asks, matrix).items():
            new[kind[2]][node] = new[kind[2]][node] + value

    asks = layer.part_asks.weight.split(h)
    from_out, from_into = layer.force_sends.weight.split(h)
    attention(("torque", "about", "part"), layer.torque_sends.weight[:h], asks[0], layer.torque_to_part)
    attention(("force", "out of", "part"), from_out, asks[1], layer.out_to_part)
    attention(("force", "into", "part"), from_into, asks[2], layer.into_to_part)
    attention(("part", "beside", "part"), layer.part_sends.weight, asks[3], layer.part_to_part)
    inward = layer.inward
    if inward is None:  # the last layer: what is not updated stays
        return {**nodes, "part": {node: nodes["part"][node] + elu(value) for node, value in new["part"].items()}}
    # A node with one neighbour along a kind of edge gives it all its attention.
    linear(("part", "about", "torque"), inward.part_to_torque.weight)
    linear(("force", "of", "torque"), inward.force_to_torque.weight)
    linear(("torque", "against", "torque"), inward.torque_to_torque.weight)
    linear(("part", "out of", "force"), inward.out_to_force.weight)
    linear(("part", "into", "force"), inward.into_to_force.weight)
    attention(
        ("torque", "of", "force"), layer.torque_sends.weight[h:], inward.force_asks.weight, inward.torque_to_force
    )
    return {
        kind: {node: nodes[kind][node] + elu(value) for node, value in group.items()} for kind, group in new.items()
    }


def evaluate_by_edges(
    policy: GraphAttentionPolicy, graph: ForceTorqueGraph, state: np.ndarray, target: np.ndarray | None
) -> tuple[Tensor, Tensor]:
    """Logits and value of one state."""
    there = present_in(graph, state)
    goal = np.where(graph.boundary, 2, 0) if target is None else target
    nodes: Nodes = {"part": {}, "force": {}, "torque": {}}
    for part in there["part"]:
        flags = [float(state[part] == 2), float(goal[part] > 0)] + [
            float(goal[part] == 2)
        ] * policy.settings.goal_conditioned
        nodes["part"][part] = policy.part_in(torch.tensor([*flags, float(graph.mass[part])]))
    for force in there["force"]:
        nodes["force"][force] = policy.force_in(torch.tensor(graph.normals[force]))
    for torque in there["torque"]:
        nodes["torque"][torque] = policy.torque_in(torch.tensor(graph.levers.reshape(-1, 3)[torque]))
    edges = edges_of(graph)
    for layer in policy.layers:
        assert isinstance(layer, Layer)
        nodes = layer_by_edges(layer, nodes, edges)
    final = {part: policy.norm(value) for part, value in nodes["part"].items()}
    logits = torch.zeros(2, graph.part_count)
    for part, value in final.items():
        logits[:, part] = policy.action_head(elu(policy.action_hidden(value)))
    mean = torch.stack(list(final.values())).mean(dim=0)
    return logits.flatten(), torch.tanh(policy.value_head(elu(policy.value_hidden(mean))))[0]


@pytest.mark.parametrize("goal_conditioned", [False, True])
@pytest.mark.parametrize("name", ["polycube:pieces=6,size=3", "dome:rings=1,blocks=4", "arch:blocks=4"])
def test_agrees_with_a_network_that_goes_from_edge_to_edge(name: str, goal_conditioned: bool) -> None:
    assembly = load_structure(name)
    graph = ForceTorqueGraph.from_assembly(assembly)
    settings = PolicySettings("gat", goal_conditioned=goal_conditioned, layers=2, channels=8, heads=2)
    policy = make_policy(assembly, settings, seed=1)
    assert isinstance(policy, GraphAttentionPolicy)
    with torch.no_grad():
        for weight in policy.parameters():  # far from special values such as zero biases
            weight.add_(0.3 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(weight.numel())))
        rng = np.random.default_rng(0)
        states, targets = rng.integers(0, 3, (2, 5, assembly.part_count), dtype=np.uint8)
        states[0] = 1
        states[1] = 0
        states[:, assembly.boundary] = targets[:, assembly.boundary] = 2
        logits, value = policy(torch.from_numpy(states), torch.from_numpy(targets) if goal_conditioned else None)
        for row, state in enumerate(states):
            target = targets[row] if goal_conditioned else None
            wanted_logits, wanted_value = evaluate_by_edges(policy, graph, state, target)
            torch.testing.assert_close(logits[row], wanted_logits, atol=2e-5, rtol=1e-4)
            torch.testing.assert_close(value[row], wanted_value, atol=2e-5, rtol=1e-4)


def test_parts_that_are_gone_have_no_influence() -> None:
    """Neither their features, nor those of their forces and torques, change anything."""
    assembly = load_structure("bottle")
    policy = make_policy(assembly, PolicySettings("gat", layers=3))
    assert isinstance(policy, GraphAttentionPolicy)
    state = torch.ones((1, assembly.part_count), dtype=torch.uint8)
    state[:, policy.fixed] = 2
    gone = [2, 5]
    state[0, gone] = 0
    before = policy(state)
    topology = policy.topology
    rows = topology.row_part.view(-1, 2, assembly.part_count)[:, :, gone].sum(dim=(1, 2)) > 0
    forces = (topology.into + topology.out_of)[:, gone].sum(dim=1) > 0
    with torch.no_grad():
        policy.mass[gone] += 7.0
        policy.levers[rows] *= -3.0
        policy.normals[forces] *= 100.0
    after = policy(state)
    assert torch.equal(before[0], after[0])
    assert torch.equal(before[1], after[1])
    assert (after[0][0, gone] == 0).all()


STATES = 16_000


def test_large_batches_without_gradient_go_in_pieces() -> None:
    """Of more states than one piece holds; each half is one piece."""
    assembly = load_structure("arch:blocks=4")
    policy = make_policy(assembly, PolicySettings("gat", layers=2))
    states = torch.randint(
        0, 3, (STATES, assembly.part_count), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)
    )
    with torch.no_grad():
        whole, halves = policy(states), [policy(half) for half in states.split(STATES // 2)]
    for one, *others in zip(whole, *halves, strict=True):
        torch.testing.assert_close(one, torch.cat(others), atol=1e-6, rtol=1e-5)


def test_extreme_scores_do_not_break_the_softmax() -> None:
    assembly = load_structure("arch:blocks=4")
    policy = make_policy(assembly, PolicySettings("gat", layers=2))
    with torch.no_grad():
        for name, weight in policy.named_parameters():
            if "sends" in name or "asks" in name:
                weight.mul_(1e3)
    logits, value = policy(torch.ones((2, assembly.part_count), dtype=torch.uint8))
    (logits.sum() + value.sum()).backward()
    assert all(weight.grad is not None and weight.grad.isfinite().all() for weight in policy.parameters())


def test_the_norm_by_products_is_layer_norm() -> None:
    generator = torch.Generator().manual_seed(4)
    norm = graph_network.Norm(16)
    with torch.no_grad():
        norm.weight.uniform_(0.5, 2.0, generator=generator)
        norm.bias.uniform_(-1.0, 1.0, generator=generator)
    features = (3.0 + 5.0 * torch.randn(3, 7, 16, generator=generator)).requires_grad_()
    usual, ours = norm(features), norm.by_products(features)
    torch.testing.assert_close(ours, usual, atol=1e-5, rtol=1e-5)
    weight = torch.randn(3, 7, 16, generator=generator)
    wanted = torch.autograd.grad((usual * weight).sum(), [features, norm.weight, norm.bias])
    found = torch.autograd.grad((ours * weight).sum(), [features, norm.weight, norm.bias])
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    half = norm.by_products(features.detach().bfloat16())
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), usual.detach(), atol=0.1, rtol=0.05)

"""Networks that other processes evaluate: the answers are those of the policy itself."""

from __future__ import annotations

from typing import cast

import torch
from experiments.inference import Inference, RemotePolicy

from falsework import load_structure
from falsework.learn import PolicySettings, make_policy
from falsework.learn.networks.contact_graph import ContactGraph
from falsework.learn.networks.local_attention import LocalAttentionPolicy

SMALL = PolicySettings("local", layers=1, channels=16, heads=2)


def test_several_structures_are_answered_by_one_process() -> None:
    """Graphs of different sizes are filled up, and large batches split; with either of two sets of weights."""
    assemblies = [load_structure(name) for name in ("arch:blocks=5", "stack:blocks=9", "vault:parts=50")]
    policies = [cast(LocalAttentionPolicy, make_policy(assembly, SMALL)) for assembly in assemblies]
    weights, other = (one.network for one in policies[:2])
    inference = Inference(weights, policies[0].settings, len(assemblies), torch.device("cpu"))
    inference.send(weights, other)
    remotes = [RemotePolicy(connection) for connection in inference.connections]
    kept = [{name: tensor.clone() for name, tensor in one.state_dict().items()} for one in (weights, other)]
    for averaged, mine in zip((False, True), kept, strict=True):
        for policy, remote, assembly in zip(policies, remotes, assemblies, strict=True):
            one = remote.of(ContactGraph.from_assembly(assembly), 3, "contact", averaged=averaged)
            policy.of_task(3, equilibrium=False).network.load_state_dict(mine)
            states = torch.randint(0, 3, (100, assembly.part_count), dtype=torch.uint8)
            with torch.no_grad():
                for here, there in zip(policy(states), one(states), strict=True):
                    torch.testing.assert_close(here, there, atol=1e-5, rtol=1e-4)
    inference.close()

"""Construction of policies: new ones, ones with the weights of another, and their description."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.config.policy import PolicySettings
from falsework.learn.networks.custom_policy import PolicyOrClass, make_custom
from falsework.learn.networks.graph_attention import GraphAttentionPolicy
from falsework.learn.networks.local_attention import LocalAttentionPolicy
from falsework.learn.networks.part_transformer import PartTransformerPolicy
from falsework.learn.networks.policy import Policy
from falsework.learn.networks.vector import MlpPolicy, ResidualMlpPolicy

NETWORKS: dict[str, type[Policy]] = {
    "mlp": MlpPolicy,
    "resmlp": ResidualMlpPolicy,
    "transformer": PartTransformerPolicy,
    "local": LocalAttentionPolicy,
    "gat": GraphAttentionPolicy,
}
"""Class of each kind of network."""


def make_policy(
    assembly: Assembly,
    settings: PolicySettings | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    *,
    given: PolicyOrClass | None = None,
) -> Policy:
    """Make a policy with random weights; the same seed gives the same weights on every device.

    Args:
        assembly: structure whose actions it proposes.
        settings: which network, and how large.
        device: where it lives.
        given: for a class of your own, itself or a module of it, in place of the one that would be imported.

    Returns:
        The policy. One of your own class has what the protocol asks for (`falsework.learn.networks.custom_policy`),
        and may lack the other attributes of `Policy`.

    Raises:
        InputError: a class of your own cannot be imported or called, or breaks the protocol of policies.
    """
    settings = settings or PolicySettings()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if settings.custom:
            return make_custom(settings, assembly, device, given)
        return NETWORKS[settings.kind](assembly, settings).to(device)


def describe(policy: nn.Module, settings: PolicySettings) -> dict[str, Any]:
    """Return kind, sizes and number of weights of a policy, as plain JSON values."""
    return {**asdict(settings.resolved()), "parameters": sum(weight.numel() for weight in policy.parameters())}


def transfer(
    weights: Mapping[str, Tensor], settings: PolicySettings, assembly: Assembly, device: torch.device | str = "cpu"
) -> Policy:
    """Make a policy for a structure with the weights of a policy trained on another one.

    Args:
        weights: `state_dict` of the trained policy.
        assembly: the other structure.
        device: where the new policy lives.

    Raises:
        InputError: the network identifies parts by number, or the weights are of another network.
    """
    if not (settings.transfers or settings.custom):  # those of users describe parts as they like
        raise InputError(
            f"a policy of kind {settings.kind} that identifies parts by their number fits its own structure only; "
            "train another kind"
        )
    policy = make_policy(assembly, settings, "cpu")
    try:
        policy.load_state_dict(dict(weights))
    except RuntimeError:
        raise InputError(
            "the weights do not fit the settings of the policy; use the settings they were trained with"
        ) from None
    return policy.to(device)


def share(policy: Policy, assembly: Assembly) -> Policy:
    """Make a policy for another structure that shares the weights: training one trains the other.

    Raises:
        InputError: as `transfer`.
    """
    device = next(policy.parameters()).device
    other = transfer(policy.state_dict(), policy.settings, assembly, device)
    owners = dict(other.named_modules())
    for name, weight in policy.named_parameters():
        owner, _, leaf = name.rpartition(".")
        setattr(owners[owner], leaf, weight)
    return other

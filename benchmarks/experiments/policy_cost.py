"""Cost of networks: weights and operations a state, counted, not estimated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from falsework import Assembly
from falsework.learn import PolicySettings, make_policy
from falsework.learn.networks.factory import describe

KINDS = (PolicySettings("mlp"), PolicySettings("resmlp"), PolicySettings("gat"), PolicySettings("transformer"))


def policy_cost(
    assembly: Assembly, settings: Sequence[PolicySettings] = KINDS, *, batch: int = 64
) -> list[dict[str, Any]]:
    """Parameters and floating-point operations a state of several networks on one structure.

    Products of matrices are counted, forward alone and with the backward pass; what is done element by element is not.
    Work that a batch shares, such as the bias of attention, is spread over `batch` states.

    Args:
        assembly: the structure.
        settings: networks.
        batch: states evaluated together.

    Returns:
        A row for each network: `kind`, sizes, `parameters`, `flops_forward` and `flops_training`, plain JSON values.
    """
    rows = []
    for one in settings:
        policy = make_policy(assembly, one)
        states = torch.ones((batch, assembly.part_count), dtype=torch.uint8)
        counted = FlopCounterMode(display=False)
        with counted:
            logits, value = policy(states)
        forward = counted.get_total_flops()
        both = FlopCounterMode(display=False)
        with both:
            logits, value = policy(states)
            (logits.sum() + value.sum()).backward()
        operations = {"flops_forward": forward // batch, "flops_training": both.get_total_flops() // batch}
        rows.append({**describe(policy, one), **operations})
    return rows

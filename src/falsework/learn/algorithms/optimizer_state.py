"""Weights, their moving average and the moments of an optimizer as plain named tensors, for checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch


def saved_tensors(
    policy: torch.nn.Module, optimizer: Any, average: Sequence[torch.Tensor] = ()
) -> dict[str, torch.Tensor]:
    """All that there is to save, for `load_saved`."""
    saved = {f"weight.{name}": tensor for name, tensor in policy.state_dict().items()}
    saved |= {f"average.{place}": tensor for place, tensor in enumerate(average)}
    for place, state in optimizer.state_dict()["state"].items():
        saved |= {f"optimizer.{place}.{name}": torch.as_tensor(value) for name, value in state.items()}
    return saved


def load_saved(
    tensors: dict[str, torch.Tensor], policy: torch.nn.Module, optimizer: Any, average: Sequence[torch.Tensor] = ()
) -> None:
    """Go back to what `saved_tensors` gave; other names are left alone."""
    weights = {name[len("weight.") :]: one for name, one in tensors.items() if name.startswith("weight.")}
    policy.load_state_dict(weights)
    for place, one in enumerate(average):
        one.copy_(tensors[f"average.{place}"])
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, one in tensors.items():
        if name.startswith("optimizer."):
            _, place, key = name.split(".", 2)
            state.setdefault(int(place), {})[key] = one.clone()
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})

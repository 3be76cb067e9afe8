"""Collectives of several processes: averaged gradients, sums, broadcasts and gathered rows."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import import_torch

if TYPE_CHECKING:
    import torch


def average_gradients(parameters: Iterable[torch.nn.Parameter], shards: ProcessGroup) -> None:
    """Replace gradients by their mean over the processes, in one exchange."""
    if shards.size == 1:
        return
    torch = import_torch()
    import torch.distributed as dist

    # A parameter that this process did not use takes part with zero, so that all exchange the same.
    held = list(parameters)
    pieces = [torch.zeros_like(one) if one.grad is None else one.grad for one in held]
    flat = torch.cat([piece.reshape(-1) for piece in pieces])
    dist.all_reduce(flat)
    flat /= shards.size
    for one, mean in zip(held, flat.split([one.numel() for one in held]), strict=True):
        one.grad = mean.view_as(one)


def same_weights(module: torch.nn.Module, shards: ProcessGroup) -> None:
    """Give every process the weights of the first."""
    if shards.size == 1:
        return
    import torch.distributed as dist

    for tensor in module.state_dict().values():
        dist.broadcast(tensor, src=0)


def decided(value: float, shards: ProcessGroup, device: torch.device) -> float:
    """Return a number of the first process, such as its time, in all processes."""
    if shards.size == 1:
        return value
    torch = import_torch()
    import torch.distributed as dist

    box = torch.tensor([value], dtype=torch.float64, device=device)
    dist.broadcast(box, src=0)
    return float(box[0])


def summed(values: list[float], shards: ProcessGroup, device: torch.device) -> list[float]:
    """Return sums over the processes, such as of successes and of states tried."""
    if shards.size == 1:
        return values
    torch = import_torch()
    import torch.distributed as dist

    box = torch.tensor(values, dtype=torch.float64, device=device)
    dist.all_reduce(box)
    return box.tolist()


def gather_rows(rows: torch.Tensor, shards: ProcessGroup) -> torch.Tensor:
    """Return the rows of all processes, of possibly different numbers, in the order of the processes.

    Args:
        rows: shape (count, ...); count differs from process to process.

    Returns:
        Shape (sum of counts, ...).
    """
    if shards.size == 1:
        return rows
    torch = import_torch()
    counts = shards.gather(torch.tensor([len(rows)], device=rows.device)).tolist()
    padded = rows.new_zeros((max(counts), *rows.shape[1:]))
    padded[: len(rows)] = rows
    whole = shards.gather(padded).view(shards.size, max(counts), *rows.shape[1:])
    return torch.cat([whole[rank, :count] for rank, count in enumerate(counts)])

"""Process groups for a search in several processes: shares of work, and reductions."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from falsework.errors import InputError
from falsework.utils.tensors import choose_device, import_torch

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class ProcessGroup:
    """Process group of one search, seen from one of its processes.

    All reductions are exact, of integers or unchanged values, so that the result does not depend on the number of
    processes.
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def from_torch(cls) -> ProcessGroup:
        """Return the default process group of `torch.distributed`, or this process alone where that is not set up."""
        import_torch()
        import torch.distributed as dist

        if not (dist.is_available() and dist.is_initialized()):
            return cls()
        return cls(dist.get_rank(), dist.get_world_size())

    @property
    def is_main_process(self) -> bool:
        """Whether this process is the one that reports and writes files."""
        return self.rank == 0

    def interleaved(self) -> slice:
        """Return every `size`-th of some items: similar neighbours are spread over the processes."""
        return slice(self.rank, None, self.size)

    def block(self, count: int) -> slice:
        """Return one stretch of `count` items for this process."""
        each = -(-count // self.size)
        return slice(min(self.rank * each, count), min((self.rank + 1) * each, count))

    def add(self, tensor: torch.Tensor) -> torch.Tensor:
        """Return the sum over the processes, in place; only ever of integers, so that the order does not matter."""
        if self.size > 1:
            import torch.distributed as dist

            dist.all_reduce(tensor)
        return tensor

    def gather(self, tensor: torch.Tensor) -> torch.Tensor:
        """Return the tensors of all processes, which have the same shape, one after the other."""
        if self.size == 1:
            return tensor
        torch = import_torch()
        import torch.distributed as dist

        whole = torch.empty((self.size, *tensor.shape), dtype=tensor.dtype, device=tensor.device)
        dist.all_gather(list(whole.unbind()), tensor.contiguous())
        return whole.flatten(0, 1)


@contextmanager
def init_distributed(device: str = "auto") -> Iterator[tuple[ProcessGroup, torch.device]]:
    """Join the processes that `torchrun` started, for the length of a `with` block; alone without it.

    Each process takes the GPU of its local rank and NCCL, or the processor and gloo.

    Args:
        device: `auto`, `cpu` or `cuda`.

    Yields:
        The shards and the device of this process.
    """
    torch = import_torch()
    import torch.distributed as dist

    if "RANK" not in os.environ or "WORLD_SIZE" not in os.environ or dist.is_initialized():
        yield ProcessGroup.from_torch(), choose_device(device)
        return
    # Its functions have the group that exists at import as a default argument. Imported now, there is none; imported
    # later, which an optimizer does, they would keep the group and its threads beyond the block, and a thread that
    # frees a tensor while Python shuts down ends the process by `terminate`.
    importlib.import_module("torch.distributed.nn.functional")
    chosen = choose_device(device)
    if chosen.type == "cuda":
        local = int(os.environ.get("LOCAL_RANK", "0"))
        if local >= torch.cuda.device_count():
            raise InputError(
                f"process {local} of this machine has no GPU of its own; start {torch.cuda.device_count()} processes"
            )
        torch.cuda.set_device(local)
        chosen = torch.device("cuda", local)
        dist.init_process_group("nccl", device_id=chosen)
    else:
        dist.init_process_group("gloo")
    try:
        yield ProcessGroup.from_torch(), chosen
    finally:
        dist.destroy_process_group()

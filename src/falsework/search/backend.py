"""Choice of the beam search backend: arrays on the CPU, or tensors on a GPU and in several processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from falsework.errors import InputError
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.device.beam import DeviceBeam
from falsework.search.device.oracle import tensor_oracle
from falsework.search.problem.task import Task
from falsework.stability.contact.press_oracle import PressOracle
from falsework.utils.distributed import init_distributed
from falsework.utils.tensors import import_torch

if TYPE_CHECKING:
    from falsework.stability.oracle import StabilityOracle


@contextmanager
def beam_search(
    task: Task, oracle: StabilityOracle | PressOracle, settings: BeamSettings = BeamSettings(), device: str = "auto"
) -> Iterator[tuple[BeamSearch | DeviceBeam, bool]]:
    """Yield a beam search on the given device, shared with the other processes if `torchrun` started several.

    Args:
        task: rules between start and target.
        oracle: decides stability, or lends its problem to the solver of the GPU; one that presses, on the CPU.
        settings: width, direction and how states are chosen.
        device: `cpu`; `cuda`; or `auto`, a GPU if this machine has one that can be used, else the processor.

    Yields:
        The search, and whether this process is the one that reports and writes files.

    Raises:
        DependencyError: a GPU or several processes were asked for, and the packages for that are not installed.
        InputError: no such device, or an oracle that knows no GPU.
    """
    together = int(os.environ.get("WORLD_SIZE", "1")) > 1
    if not together and (device == "cpu" or (device == "auto" and not _gpu_is_usable())):
        yield BeamSearch(task, oracle, settings), True
        return
    if isinstance(oracle, PressOracle):
        raise InputError("this oracle decides on the CPU alone; search with device cpu, in one process")
    with init_distributed(device) as (shards, where):
        yield (
            DeviceBeam(task, tensor_oracle(oracle, where), settings, device=where, shards=shards),
            shards.is_main_process,
        )


def _gpu_is_usable() -> bool:
    if find_spec("torch") is None or find_spec("cuda") is None or find_spec("cuda.bindings") is None:
        return False
    return import_torch().cuda.is_available()

"""Beam search of whole levels whose verdicts and clusters come from a device, in one process or several."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.device.k_means import SAMPLE, find_centers
from falsework.search.device.oracle import TensorOracle, tensor_oracle
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.task import Task
from falsework.stability.contact.press_oracle import PressOracle
from falsework.stability.verdict import Verdicts
from falsework.utils.distributed import ProcessGroup, init_distributed
from falsework.utils.tensors import import_torch, put

if TYPE_CHECKING:
    import torch

    from falsework.stability.oracle import StabilityOracle


class SharedOracle(Oracle):
    """Oracle on arrays whose verdicts come from one on tensors, divided between processes that search alike."""

    def __init__(self, oracle: TensorOracle, device: torch.device, shards: ProcessGroup = ProcessGroup()) -> None:
        self._device, self._shards, self._oracle = device, shards, oracle

    @property
    def holds_keep_stable(self) -> bool:
        """As of the oracle."""
        return self._oracle.holds_keep_stable

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts, without certificates; see `falsework.search.problem.oracle.Oracle`."""
        own = self._shards.interleaved()
        near = states if near is None else near
        share, before = (put(np.ascontiguousarray(some[own]), self._device) for some in (states, near))
        found = Verdicts.all_undecided(len(states))
        verdicts = put(found.verdict, self._device)
        verdicts[own] = self._oracle(share, before)
        found.verdict[:] = self._shards.add(verdicts).cpu().numpy()
        return found


def device_beam(
    task: Task,
    oracle: TensorOracle,
    settings: BeamSettings = BeamSettings(),
    device: torch.device | str = "cpu",
    shards: ProcessGroup = ProcessGroup(),
) -> BeamSearch:
    """Return a beam search whose verdicts and clusters come from a device.

    Clusters are found in whole numbers, so for one seed and the same verdicts the levels are the same on every device
    and for any number of processes: these divide the verdicts and repeat the rest.

    Args:
        oracle: verdicts on tensors.
        settings: width, direction and how states are chosen.
        device: where verdicts and clusters are found.
        shards: the processes that search together; all must be given the same task and settings.

    Raises:
        DependencyError: torch is not installed.
    """
    where = import_torch().device(device)
    search = BeamSearch(task, SharedOracle(oracle, where, shards), settings)
    search.judge.batch = max(settings.pool // task.part_count, 1)

    def clusters(
        points: ArrayLike, count: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        states = put(np.asarray(points), where)
        sample = states[: SAMPLE * count]  # a fair one, since candidates come in random order
        words = put(rng.integers(2**63, size=len(sample)), where)
        labels, distance = find_centers(sample, words, count).assign(states)
        return labels.cpu().numpy(), distance.cpu().numpy()

    search.cluster = clusters
    return search


@contextmanager
def beam_search(
    task: Task, oracle: StabilityOracle | PressOracle, settings: BeamSettings = BeamSettings(), device: str = "auto"
) -> Iterator[tuple[BeamSearch, bool]]:
    """Yield a beam search on the given device, shared with the other processes if `torchrun` started several.

    Args:
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
        yield device_beam(task, tensor_oracle(oracle, where), settings, where, shards), shards.is_main_process


def _gpu_is_usable() -> bool:
    if find_spec("torch") is None or find_spec("cuda") is None or find_spec("cuda.bindings") is None:
        return False
    return import_torch().cuda.is_available()

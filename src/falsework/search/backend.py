"""Choice of the beam search backend: arrays on the CPU, or tensors on a GPU and in several processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING, Literal, get_args

from falsework.errors import InputError
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.level_search import Beams
from falsework.search.beam.settings import BeamSettings
from falsework.search.device.beam import DeviceBeam
from falsework.search.device.oracle import DeviceOracle, HostOracle, tensor_oracle
from falsework.search.margins.demands import MarginOracle
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.task import Task
from falsework.stability.contact.press_oracle import PressOracle
from falsework.utils.distributed import init_distributed
from falsework.utils.tensors import choose_device, import_torch

if TYPE_CHECKING:
    from falsework.stability.oracle import StabilityOracle


Backend = Literal["cpu", "torch", "cuda"]
"""Device and data type of the beams of a planner: arrays on the processor, tensors on it, or tensors on a GPU."""


def beams_on(backend: Backend, task: Task, oracle: StabilityOracle) -> Beams:
    """Return the beams of a backend, for a planner.

    Args:
        backend: where they search.
        task: rules between start and target.
        oracle: decides stability; its problem and settings are those of the solver of the GPU.

    Raises:
        InputError: no such backend or device, or a task or an oracle that beams on tensors do not know.
        DependencyError: a package that the backend needs is not installed.
    """
    if backend not in get_args(Backend):
        raise InputError(f"there is no backend {backend!r}; give {', '.join(get_args(Backend))}")
    if backend == "cpu":
        return BeamSearch
    presses = oracle.replayer is not None and oracle.settings.holds.presses
    unknown = {
        "repeated holds": task.allow_regrasp,
        "steps of several parts": task.together is not None,
        "margins": isinstance(oracle, MarginOracle),
        "robots that press (holds of a mode other than locked)": presses,
    }
    what = next((what for what, is_so in unknown.items() if is_so), None)
    if what is not None:
        raise InputError(f"the backend {backend} knows no {what}; leave them out, or use the backend cpu")
    device = choose_device("cuda" if backend == "cuda" else "cpu")
    on_device = DeviceOracle(oracle, device) if backend == "cuda" else None

    def beam(
        task: Task, oracle: Oracle, settings: BeamSettings = BeamSettings(), *, guide: Guide | None = None
    ) -> DeviceBeam:
        return DeviceBeam(task, on_device or HostOracle(oracle), settings, guide=guide, device=device)

    return beam


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

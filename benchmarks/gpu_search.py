"""Time complete beam searches on a device, every verdict proven: one JSON object per line.

    python benchmarks/gpu_search.py
    python benchmarks/gpu_search.py --cases vault-62:64 dome:256 --device cpu
    python benchmarks/gpu_search.py --criteria equilibrium contact
    torchrun --nproc-per-node 4 benchmarks/gpu_search.py --cases vault-62:4096

A case is a structure, by the name of a real one (FALSEWORK_DATA, else the folder `shared` beside the repository), of
a built-in one, or by its path, and a width. `seconds` is the whole search from the origin to plan and levels on the
host: median and range of `repeats`, after a narrow search that compiles the kernels (`warm_up_seconds`) and a first
search of the same width that takes memory from the device (`first_seconds`); `verdict_seconds` are those of its
verdicts. `levels` is a hash over all states kept: equal hashes, equal searches, on any number of processes.
`disagree` counts states kept, out of `checked` drawn at random, that the CPU solver does not call stable. With
`--host`, the CPU beam runs as well, at widths up to the one given.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from record import report, spread, write_to
from states import find

from falsework import Assembly, StabilityOracle, StabilitySettings, StateGraph, Task, load_structure
from falsework.search import BeamSearch, BeamSettings
from falsework.search.device.beam import device_beam
from falsework.search.device.oracle import tensor_oracle
from falsework.stability.settings import Criterion
from falsework.utils.cores import core_count
from falsework.utils.distributed import ProcessGroup, init_distributed


@dataclass(frozen=True)
class Options:
    """Cases and settings to time."""

    cases: tuple[str, ...] = ("vault-62:64", "dome-72:64", "vault-62:1024")
    """Structures and widths, `structure:width`."""
    criteria: tuple[Criterion, ...] = ("contact",)
    """Stability criteria."""
    robots: int = 2
    """Parts that may be held at once."""
    device: str = "auto"
    """`auto`, `cpu` or `cuda`."""
    host: int = 64
    """Widest case for which the CPU beam is timed too; 0 for none."""
    checked: int = 256
    """Kept states whose verdicts are compared with those of the CPU solver."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the searches, each with a record of its own."""
    repeats: int = 5
    """Number of timed searches."""
    graph: bool = False
    """Build the state graph too, and count the states from which it leads to the goal."""
    out: Path | None = None
    """File to which the records are appended."""


def wait(device: torch.device) -> None:
    """Wait until all queued work on a device is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def disagreements(states: np.ndarray, count: int, oracle: StabilityOracle) -> int:
    """Return how many of some states drawn at random the oracle does not prove stable."""
    rows = np.random.default_rng(0).permutation(len(states))[:count]
    return int((~oracle.verdicts(states[rows]).stable).sum())


def measure(
    case: str, criterion: Criterion, seed: int, options: Options, shards: ProcessGroup, device: torch.device
) -> dict[str, Any]:
    """Measure one case on the device."""
    name, _, width = case.rpartition(":")
    assembly: Assembly = load_structure(find(name))
    task = Task.from_rules(assembly.boundary, options.robots)
    settings = StabilitySettings(criterion)
    oracle = StabilityOracle(assembly, settings)
    on_device = tensor_oracle(oracle, device)

    def search(width: int) -> BeamSearch:
        return device_beam(task, on_device, BeamSettings(width=width, seed=seed), device, shards)

    begin = time.perf_counter()
    search(min(8, int(width))).run()
    warm_up = time.perf_counter() - begin
    seconds = []
    for _ in range(1 + options.repeats):
        beam = search(int(width))
        wait(device)
        begin = time.perf_counter()
        result = beam.run()
        states = beam.states()
        seconds.append(time.perf_counter() - begin)
    verdicts = beam.judge.seconds
    first, *timed = seconds
    measured = spread(timed or seconds)
    row: dict[str, Any] = {
        "structure": name,
        "criterion": criterion,
        "robots": options.robots,
        "width": int(width),
        "processes": shards.size,
        "seconds": round(measured["median"], 3),
        "seconds_range": [round(measured["least"], 3), round(measured["most"], 3)],
        "first_seconds": round(first, 3),
        "verdict_seconds": round(verdicts, 3),
        "warm_up_seconds": round(warm_up, 2),
        "found": result.found,
        "states": result.counters.states,
        "candidates": result.counters.candidates,
        "asked": result.counters.asked,
        "rejected": result.counters.rejected,
        "undecided": result.undecided,
        "levels": hashlib.sha256(states.tobytes()).hexdigest()[:16],
    }
    if device.type == "cuda":
        row["peak_bytes"] = torch.cuda.max_memory_allocated(device)
    if shards.is_main_process and options.checked:
        row["checked"] = min(options.checked, len(states))
        row["disagree"] = disagreements(states, options.checked, StabilityOracle(assembly, settings))
    if shards.is_main_process and options.graph:
        graph = StateGraph.from_states(task, states)
        row["graph_edges"], row["graph_solvable"] = len(graph.source), int(graph.solvable.sum())
    if shards.is_main_process and int(width) <= options.host:
        BeamSearch(task, StabilityOracle(assembly, settings), BeamSettings(width=4)).run()  # compiles
        host = BeamSearch(task, StabilityOracle(assembly, settings), BeamSettings(width=int(width)))
        begin = time.perf_counter()
        found = host.run()
        row["host"] = {
            "seconds": round(time.perf_counter() - begin, 3),
            "cores": core_count(),
            "found": found.found,
            "states": found.counters.states,
            "asked": found.counters.asked,
        }
    return row


def main(options: Options) -> None:
    """Run the benchmark."""
    write_to(options.out)
    with init_distributed(options.device) as (shards, device):
        for case, criterion, seed in product(options.cases, options.criteria, options.seeds):
            row = measure(case, criterion, seed, options, shards, device)
            if shards.is_main_process:
                report("gpu_search", **row, device=device, seeds=(seed,))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Compare GPU and CPU on batches under `contact`: the batch size from which a GPU pays. One JSON object per line.

    python benchmarks/gpu_size.py
    python benchmarks/gpu_size.py --structures vault:parts=246 --batches 16 256

States lack up to two random parts and have one held, where another has just been released. Both times are of a complete
call without certificates, states and verdicts crossing to the device and back, compilation left out. The CPU
starts from the displacements of the states' parents, as it does in a search, on all cores of the host; the GPU loads
every state from rest. `ratio` is CPU time over GPU time; `pays_from` the smallest batch timed from which
on it is above 1. Structures of the paper are read from FALSEWORK_DATA, else from the folder `shared` beside the
repository.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from record import report, spread, write_to
from states import find

from falsework import Assembly, StabilitySettings, Verdict, load_structure
from falsework.assembly import HELD, REMOVED, States, complete_state
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.problem import build_problem
from falsework.utils.cores import core_count


@dataclass(frozen=True)
class Options:
    """Structures and batch sizes to time."""

    structures: tuple[str, ...] = ("arch:blocks=15", "vault-62", "vault:parts=120", "vault:parts=246")
    """Built-in names, paths, or names of structures of the paper."""
    batches: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096)
    """States per call."""
    repeats: int = 5
    """Number of timed calls."""
    out: Path | None = None
    """File to which the records are appended."""


def nearly_complete(assembly: Assembly, count: int, seed: int = 0) -> tuple[States, States]:
    """Return states that lack up to two parts, with one part held, and parents in which another is held too."""
    random = np.random.default_rng(seed)
    loose = np.flatnonzero(~assembly.boundary)
    states = complete_state(assembly.boundary)[None].repeat(count, axis=0)
    parents = states.copy()
    for state, parent in zip(states, parents, strict=True):
        chosen = random.permutation(loose)
        missing, held = chosen[2 : 2 + random.integers(3)], chosen[:2]
        state[missing], parent[missing] = REMOVED, REMOVED
        parent[held], state[held[0]] = HELD, HELD
    return states, parents


def times(call: Callable[[], object], repeats: int) -> list[float]:
    """Return milliseconds of some calls after a first one."""
    found = []
    for _ in range(1 + repeats):
        begin = time.perf_counter()
        call()
        found.append((time.perf_counter() - begin) * 1e3)
    return found[1:]


def compare(name: str, options: Options) -> dict[str, Any]:
    """Compare both solvers on all batches of one structure."""
    assembly, settings = load_structure(find(name)), StabilitySettings()
    states, parents = nearly_complete(assembly, max(options.batches))
    problem = build_problem(assembly, cone=settings.friction_cone)
    gpu, processor = GpuSolver(assembly, problem, settings), ContactSolver(assembly, problem, settings)
    displacement = processor.check(parents).displacement
    assert displacement is not None
    result: dict[str, Any] = {
        "structure": name,
        "parts": problem.parts,
        "points": problem.points,
        "drawn_from": "lacking up to two parts, one held",
        "cores": core_count(),
        "verdicts": {},
        "gpu_ms": {},
        "processor_ms": {},
        "ratio": {},
    }
    found = gpu.check(states, certificates=False).verdict
    result["verdicts"] = {kind.name.lower(): int((found == kind).sum()) for kind in Verdict}
    for batch in options.batches:
        some, before, guess = states[:batch], parents[:batch], displacement[:batch]

        def warm(some: States = some, before: States = before, guess: np.ndarray = guess) -> object:
            return processor.check(some, certificates=False, parents=before, guess=guess.copy())

        on_gpu = times(lambda some=some: gpu.check(some, certificates=False), options.repeats)
        on_processor = times(warm, options.repeats)
        result["gpu_ms"][batch], result["processor_ms"][batch] = spread(on_gpu), spread(on_processor)
        result["ratio"][batch] = float(np.median(on_processor) / np.median(on_gpu))
    slower = [batch for batch in options.batches if result["ratio"][batch] <= 1]
    faster = [batch for batch in options.batches if batch > max(slower, default=0)]
    result["pays_from"] = min(faster) if faster else None
    return result


def main(options: Options) -> None:
    """Run the benchmark."""
    write_to(options.out)
    for name in options.structures:
        report("gpu_size", **compare(name, options), device="cuda", seeds=(0,))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Measure stability verdicts on the states that a width-64 beam search with two robots checks.

    python benchmarks/stability.py                                   # all that follows but the baseline
    python benchmarks/stability.py --measure verdicts --structures vault-62 dome-72 --states 1000
    python benchmarks/stability.py --measure baseline --device cuda --baseline-states 256

One JSON object a line. Real structures by name (FALSEWORK_DATA, else the folder `shared` beside the repository),
built-in ones, or paths; without names all real ones.

`verdicts`: agreement with the exact solver on the same states, certificates that the checker accepts, and speed: this
solver on all cores against the exact solver on one, in one run, in alternating rounds; ratios are medians over the
rounds. `speedup` is that within a search, which passes the stable predecessor of each state; `speedup_alone` is without
it. Caches are empty in every round.

`cold`: one verdict of one state from Python, kernels compiled: setting a structure up, and then the first verdict.

`baseline`: the paper's method with one constant inverse on the same states, in torch, against this solver.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from baselines.shared_inverse import SharedInverse, SharedInverseSettings
from record import report, write_to
from states import asked_states, find, real_structures

from falsework import Assembly, StabilityOracle, StabilitySettings, load_structure, verify_certificates
from falsework.assembly import States, complete_state
from falsework.stability import CpuSettings, ExactSolver

Measure = Literal["verdicts", "cold", "baseline"]


@dataclass(frozen=True)
class Options:
    """Structures and measurements."""

    structures: tuple[str, ...] = ()
    """Names of real or built-in structures, or paths; empty for all real ones."""
    measure: tuple[Measure, ...] = ("verdicts", "cold")
    """Measurements to make."""
    states: int = 300
    """Number of states of each structure."""
    rounds: int = 5
    """Rounds in which the solvers take turns."""
    threads: int = 2
    """Cores for this solver."""
    cone: Literal["octagon", "quadratic"] = "octagon"
    """Friction cone."""
    width: int = 64
    """Width of the beam search whose states are checked."""
    seed: int = 0
    """Seed of the search and the sample."""
    baseline_states: int = 16
    """Number of states for the paper's method."""
    baseline_threads: int = 1
    """Cores for the paper's method; torch loses more than it gains by distributing such small matrices."""
    device: str = "cpu"
    """Device of the paper's method."""
    inverse: Literal["reduced", "dense"] = "reduced"
    """Application of the inverse by the paper's method; see `SharedInverseSettings`."""
    precision: Literal["float64", "float32"] = "float64"
    """Precision of the paper's method."""
    out: Path | None = None
    """File to which the records are appended."""


def seconds_of(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the wall-clock seconds of a call, and its result."""
    begin = time.perf_counter()
    result = work()
    return time.perf_counter() - begin, result


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this thread, and those that it starts meanwhile, on one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def measure_verdicts(name: str, assembly: Assembly, states: States, parents: States, options: Options) -> None:
    """Measure agreement and speed on the same states."""
    settings = StabilitySettings(criterion="equilibrium", cone=options.cone, cpu=CpuSettings(threads=options.threads))
    checked = StabilityOracle(assembly, settings)
    verdicts = checked.verdicts(states, require_certificate=True)
    accepted = int(verify_certificates(assembly, states, verdicts, settings.claim).sum())
    exact = ExactSolver(assembly, settings)
    with one_core():
        exact.check(states[:1])
    verdict = np.zeros(len(states), np.int8)
    exact_seconds = 0.0
    rows: list[dict[str, float]] = []
    for chunk in np.array_split(np.arange(len(states)), options.rounds):
        near, alone = StabilityOracle(assembly, settings), StabilityOracle(assembly, settings)
        with_parents, judged = seconds_of(lambda near=near: near.verdicts(states, near=parents))
        without, _ = seconds_of(lambda alone=alone: alone.verdicts(states))
        with one_core():
            slow, answers = seconds_of(lambda chunk=chunk: exact.check(states[chunk]))
        verdict[chunk] = answers.verdict
        exact_seconds += slow
        one = slow / len(chunk)
        rows.append(
            {"near": with_parents / len(states), "alone": without / len(states), "exact": one}
            | {"speedup": one * len(states) / with_parents, "speedup_alone": one * len(states) / without}
        )
        if not np.array_equal(judged.verdict, verdicts.verdict):
            raise SystemExit(f"{name}: judge and check disagree")
    median = {key: float(np.median([row[key] for row in rows])) for key in rows[0]}
    report(
        "stability verdicts",
        structure=name,
        seeds=(options.seed,),
        states=len(states),
        stable=int(verdicts.stable.sum()),
        unstable=int(verdicts.unstable.sum()),
        undecided=int(verdicts.undecided.sum()),
        agree=int((verdicts.verdict == verdict).sum()),
        accepted=accepted,
        decided_by_exact=checked.counters.exact,
        states_per_second=1 / median["near"],
        states_per_second_alone=1 / median["alone"],
        exact_states_per_second=len(states) / exact_seconds,
        milliseconds=1e3 * median["near"],
        exact_milliseconds=1e3 * exact_seconds / len(states),
        speedup=median["speedup"],
        speedup_alone=median["speedup_alone"],
        threads=options.threads,
        cone=options.cone,
    )


def measure_cold(name: str, assembly: Assembly, states: States, options: Options) -> None:
    """Measure milliseconds from an assembly to the first verdict, and of single verdicts without cached neighbours."""
    settings = StabilitySettings(criterion="equilibrium", cone=options.cone, cpu=CpuSettings(threads=options.threads))
    state = complete_state(assembly.boundary)
    StabilityOracle(assembly, settings).verdicts(state, require_certificate=True)
    StabilityOracle(assembly, settings).verdicts(state)
    set_up, first, single = [], [], []
    for row in states[:50]:
        made, stability = seconds_of(lambda: StabilityOracle(assembly, settings))
        set_up.append(made)
        first.append(seconds_of(lambda stability=stability: stability.verdicts(state, require_certificate=True))[0])
        single.append(
            seconds_of(lambda stability=stability, row=row: stability.verdicts(row, require_certificate=True))[0]
        )
    report(
        "stability cold",
        structure=name,
        seeds=(options.seed,),
        set_up_milliseconds=1e3 * float(np.median(set_up)),
        complete_milliseconds=1e3 * float(np.median(first)),
        verdict_milliseconds=1e3 * float(np.median(single)),
        slowest_verdict_milliseconds=1e3 * max(single),
        cone=options.cone,
    )


def measure_baseline(name: str, assembly: Assembly, states: States, parents: States, options: Options) -> None:
    """Compare the paper's method with this solver."""
    import torch

    torch.set_num_threads(options.baseline_threads)
    settings = StabilitySettings(criterion="equilibrium", cpu=CpuSettings(threads=options.threads))
    states, parents = states[: options.baseline_states], parents[: options.baseline_states]
    method = SharedInverseSettings(
        device=options.device, inverse=options.inverse, precision=options.precision, batch=max(len(states), 1)
    )
    set_up, shared = seconds_of(lambda: SharedInverse(assembly, settings, method))
    shared.check(states[:1])
    seconds, answers = seconds_of(lambda: shared.check(states))
    stability = StabilityOracle(assembly, settings)
    ours, verdicts = seconds_of(lambda: stability.verdicts(states, near=parents))
    report(
        "stability baseline",
        structure=name,
        seeds=(options.seed,),
        states=len(states),
        stable=int(verdicts.stable.sum()),
        agree=int((answers.verdict == verdicts.verdict).sum()),
        stable_but_missed=int((verdicts.stable & ~answers.stable).sum()),
        unstable_but_called_stable=int((verdicts.unstable & answers.stable).sum()),
        baseline_set_up_seconds=set_up,
        baseline_milliseconds=1e3 * seconds / len(states),
        milliseconds=1e3 * ours / len(states),
        speedup=seconds / ours,
        device=options.device,
        baseline_threads=options.baseline_threads,
        threads=options.threads,
        precision=options.precision,
        inverse=options.inverse,
        penalty=method.penalty,
        iterations=method.iterations,
    )


def main(options: Options) -> None:
    """Run the benchmark."""
    write_to(options.out)
    for structure in options.structures or real_structures():
        assembly = load_structure(find(structure))
        name = Path(structure).name
        states, parents = asked_states(assembly, options.states, width=options.width, seed=options.seed)
        if "verdicts" in options.measure:
            measure_verdicts(name, assembly, states, parents, options)
        if "cold" in options.measure:
            measure_cold(name, assembly, states, options)
        if "baseline" in options.measure:
            measure_baseline(name, assembly, states, parents, options)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

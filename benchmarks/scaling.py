"""Cost against the number of parts on the built-in vault: one JSON object per size, then one with the fits.

    python benchmarks/scaling.py
    python benchmarks/scaling.py --parts 60 125 250 500 1000 --out benchmarks/results/scaling.jsonl

For every size, on the complete structure: seconds for the contacts, for the problem (wrench maps, order of
elimination), for one full verdict with its certificate accepted by the checker, and the peak memory of the
process. Each size runs in a process of its own, so that memory is that size's alone. `exponent` is the slope of
a straight line through the logarithms: 1 is linear in the number of parts.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from record import report, write_to

from falsework.assembly import load_structure
from falsework.assembly.state import complete_state
from falsework.geometry import find_contacts
from falsework.stability import Stability
from falsework.stability.settings import EQUILIBRIUM

MEASURED = ("contacts_s", "problem_s", "verdict_s", "memory_gib")


@dataclass(frozen=True)
class Options:
    """Sizes and numbers of runs."""

    parts: tuple[int, ...] = (60, 125, 250, 500, 1000)
    """Sizes to ask the vault for."""
    repeats: int = 3
    """Number of runs of each; the median counts."""
    out: Path | None = None
    """File to which the records are appended; the picture in the documentation is drawn from the last of them."""
    alone: bool = False
    """Measure the first size in this process and print its object only."""


def measure(parts: int, repeats: int) -> dict[str, float | int | str]:
    """Median times of one size."""
    times: dict[str, list[float]] = {name: [] for name in MEASURED[:3]}
    assembly = load_structure(f"vault:parts={parts}")
    state = complete_state(assembly.boundary)
    Stability(assembly, EQUILIBRIUM).check(state)  # compiles
    residual = np.nan
    for _ in range(repeats):
        begun = time.perf_counter()
        find_contacts(assembly.meshes)
        contacts = time.perf_counter()
        oracle = Stability(assembly, EQUILIBRIUM)
        problem = time.perf_counter()
        verdict = oracle.check(state)
        done = time.perf_counter()
        if not verdict.stable[0]:
            raise SystemExit(f"vault:parts={parts} is not proven stable")
        residual = float(verdict.residual[0])
        for name, seconds in zip(MEASURED, (contacts - begun, problem - contacts, done - problem), strict=False):
            times[name].append(seconds)
    return {
        "parts": assembly.part_count,
        "contact_points": len(assembly.contacts.points),
        **{name: round(float(np.median(seconds)), 5) for name, seconds in times.items()},
        "memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
        "residual": residual,
    }


def main(options: Options) -> None:
    """Run the benchmark."""
    if options.alone:
        print(json.dumps(measure(options.parts[0], options.repeats)), flush=True)
        return
    write_to(options.out)
    results = []
    for parts in options.parts:
        command = [sys.executable, __file__, "--alone", "--parts", str(parts), "--repeats", str(options.repeats)]
        line = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip().splitlines()[-1]
        results.append(json.loads(line))
        report("scaling", **results[-1], repeats=options.repeats)
    if len(results) > 1:
        sizes = np.log([result["parts"] for result in results])
        fit = {name: float(np.polyfit(sizes, np.log([r[name] for r in results]), 1)[0]) for name in MEASURED}
        report("scaling fit", parts=options.parts, exponent={name: round(value, 2) for name, value in fit.items()})


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

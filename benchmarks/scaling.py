"""Cost against the number of parts on the built-in vault: one JSON object per size, then one with the fits.

    python benchmarks/scaling.py
    python benchmarks/scaling.py --parts 62 250 1000 4000 10000 --out benchmarks/results/scaling.jsonl

For every size, processor time in seconds: for the contacts, for the problem (wrench maps, order of elimination), for
one verdict of the complete structure with its certificate accepted by the checker, under both criteria, and under
`contact` for one of the states in which the highest parts are held and removed in turn while it stands, from the
displacement of the state before (`next_s`, median). Besides, iterations from rest, and the peak memory of the process.
Each size runs in a process of its own, so that memory is that size's alone. `exponent` is the slope of a straight line
through the logarithms: 1 is linear in the number of parts.
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
from falsework.assembly.state import HELD, REMOVED, complete_state
from falsework.geometry import find_contacts
from falsework.stability import Stability, StabilitySettings
from falsework.stability.settings import EQUILIBRIUM

MEASURED = ("contacts_s", "problem_s", "equilibrium_s", "contact_s", "next_s", "memory_gib")
_HIGHEST = 4
"""Parts that are held and removed."""


@dataclass(frozen=True)
class Options:
    """Sizes and numbers of runs."""

    parts: tuple[int, ...] = (62, 125, 250, 500, 1000, 2000, 4000)
    """Numbers of parts of the vault."""
    repeats: int = 3
    """Number of runs of each; the median counts."""
    out: Path | None = None
    """File to which the records are appended; the picture in the documentation is drawn from the last of them."""
    alone: bool = False
    """Measure the first size in this process and print its object only."""


def measure(parts: int, repeats: int) -> dict[str, float | int | str]:
    """Return median times of one size."""
    times: dict[str, list[float]] = {name: [] for name in MEASURED[:-1]}
    begun = time.process_time()

    def clock(name: str) -> None:
        nonlocal begun
        times[name].append(time.process_time() - begun)
        begun = time.process_time()

    assembly = load_structure(f"vault:parts={parts}")
    small = load_structure("vault:parts=62")
    for settings in (EQUILIBRIUM, StabilitySettings()):  # compiles
        Stability(small, settings).check(complete_state(small.boundary))
    state = complete_state(assembly.boundary)
    loose = np.flatnonzero(~assembly.boundary)
    highest = loose[np.argsort(-assembly.mass.center[loose, 2])][:_HIGHEST]
    iterations = 0
    for _ in range(repeats):
        begun = time.process_time()
        find_contacts(assembly.meshes)
        clock("contacts_s")
        oracle = Stability(assembly, EQUILIBRIUM)
        clock("problem_s")
        for name, asked in (("equilibrium_s", oracle), ("contact_s", Stability(assembly))):
            begun = time.process_time()
            verdict = asked.check(state)
            clock(name)
            if not verdict.stable[0]:
                raise SystemExit(f"vault:parts={parts} is not proven stable")
        iterations = int(verdict.iterations[0])
        oracle, before = Stability(assembly), state
        oracle.judge(state[None], parents=state[None])
        for change in ((part, value) for part in highest for value in (HELD, REMOVED)):
            after = before.copy()
            after[change[0]] = change[1]
            begun = time.process_time()
            stands = oracle.judge(after[None], parents=before[None]).stable[0]
            if not stands:
                break
            clock("next_s")
            before = after
    return {
        "parts": assembly.part_count,
        "contact_points": len(assembly.contacts.points),
        **{name: round(float(np.median(seconds)), 5) for name, seconds in times.items()},
        "iterations": iterations,
        "memory_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 3),
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
        report("scaling", **results[-1], repeats=options.repeats, time="processor")
    if len(results) > 1:
        sizes = np.log([result["parts"] for result in results])
        fit = {name: float(np.polyfit(sizes, np.log([r[name] for r in results]), 1)[0]) for name in MEASURED}
        exponent = {name: round(value, 2) for name, value in fit.items()}
        report("scaling fit", parts=options.parts, exponent=exponent, time="processor")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

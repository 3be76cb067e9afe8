"""Time the clearance table of structures on one core, after imports: one JSON object per line.

    python benchmarks/clearance.py
    python benchmarks/clearance.py --structures vault:parts=100 --directions 300

Without names: dome-72, dome-37 and vault-62 where they are found (FALSEWORK_DATA, else the folder `shared`
beside the repository), then the built-in dome and vault. `ways` counts the directions in the
table, of `parts x directions`; `cpu_seconds` excludes waiting on a shared machine.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from record import report, spread, write_to
from states import find, one_core, real_structures

from falsework import load_structure
from falsework.geometry.clearance.table import StraightWays

REAL = ("dome-72", "dome-37", "vault-62")
BUILT_IN = ("dome", "vault")


@dataclass(frozen=True)
class Options:
    """Structures and settings to time."""

    structures: tuple[str, ...] = ()
    """Built-in names or paths; empty for a selection of real and built-in ones."""
    directions: int = 1000
    """Directions to try for each part."""
    repeats: int = 3
    """Number of runs of each."""
    out: Path | None = None
    """File to which the records are appended."""


def main(options: Options) -> None:
    """Run the benchmark."""
    one_core()
    write_to(options.out)
    warm_up = load_structure("arch")
    StraightWays(warm_up.meshes, warm_up.contacts, 10, tolerance=1e-4).table.can_leave(
        np.ones((1, warm_up.part_count), dtype=np.uint8)
    )
    locked = load_structure("shelf:shelves=0")  # needs the proof, which is compiled then
    StraightWays(locked.meshes, locked.contacts, 10, tolerance=1e-4).prepare()
    for structure in options.structures or (*real_structures(REAL), *BUILT_IN):
        assembly = load_structure(find(structure))
        _, overlap = assembly.contact_settings.lengths(assembly.meshes)
        table, seconds, cpu = None, [], []
        for _ in range(options.repeats):
            begin, begin_cpu = time.perf_counter(), time.process_time()
            table = StraightWays(assembly.meshes, assembly.contacts, options.directions, tolerance=overlap).table
            seconds.append(time.perf_counter() - begin)
            cpu.append(time.process_time() - begin_cpu)
        assert table is not None
        name = Path(structure).name
        complete = np.ones((1, assembly.part_count), dtype=np.uint8)
        states = np.random.default_rng(0).integers(0, 3, (10_000, assembly.part_count), dtype=np.uint8)
        begin = time.perf_counter()
        table.can_leave(states)
        lookup = time.perf_counter() - begin
        report(
            "clearance",
            structure=name,
            parts=assembly.part_count,
            directions=options.directions,
            seconds=spread(seconds),
            cpu_seconds=spread(cpu),
            ways=len(table.directions),
            table_bytes=table.blockers.nbytes + table.directions.nbytes,
            free_when_complete=int(table.can_leave(complete).sum()),
            lookup_microseconds_a_state=1e6 * lookup / len(states),
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Time the contact detection of structures on one core, after imports: one JSON object per line.

    python benchmarks/contacts.py
    python benchmarks/contacts.py --structures vault:parts=300 path/to/assembly --repeats 10

Without names: the real structures where they are found (FALSEWORK_DATA, else the folder `shared` beside the
repository) and public ones whose faces overlap, then the built-in vault of 1,000 parts. `seconds`, median and range of
the repeats, cover what `find_contacts` does, the search for overlaps included; `joints` are those that were resolved;
`peak_gib` is the memory of the whole process so far.
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from record import report, spread, write_to
from states import find, one_core, real_structures

from falsework import load_structure
from falsework.geometry import find_contacts

REAL = ("bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72")
INEXACT = ("ursula-6", "cra-curve-3-blocks", "dome-90", "genevault-110", "pavilion-vault-387", "armadillo-399-cra")
LARGE = "vault:parts=1000"


@dataclass(frozen=True)
class Options:
    """Structures and settings to time."""

    structures: tuple[str, ...] = ()
    """Built-in names or paths; empty for all real structures and the large vault."""
    repeats: int = 5
    """Number of runs of each."""
    out: Path | None = None
    """File to which the records are appended."""


def main(options: Options) -> None:
    """Run the benchmark."""
    one_core()
    write_to(options.out)
    for structure in options.structures or (*real_structures(REAL + INEXACT), LARGE):
        assembly = load_structure(find(structure))
        seconds = []
        for _ in range(options.repeats):
            begin = time.perf_counter()
            contacts = find_contacts(assembly.meshes, assembly.contact_settings)
            seconds.append(time.perf_counter() - begin)
        name = Path(structure).name
        report(
            "contacts",
            structure=name,
            parts=assembly.part_count,
            faces=sum(len(mesh.faces) for mesh in assembly.meshes),
            contacts=len(contacts),
            points=len(contacts.points),
            joints=len(contacts.report),
            seconds=spread(seconds),
            peak_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

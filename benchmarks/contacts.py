"""Time the contact detection and settling of structures on one core, after imports: one JSON object per line.

    python benchmarks/contacts.py
    python benchmarks/contacts.py --structures vault:parts=300 path/to/assembly --repeats 10
    python benchmarks/contacts.py --fine 50000 --repeats 3
    python benchmarks/contacts.py --settled cad/fabrica-car:cm:2 --repeats 1

Without names: the real structures where they are found (FALSEWORK_DATA, else the folder `shared` beside the
repository) and public ones whose faces overlap, then the built-in vault of 1,000 parts. `seconds`, median and range of
the repeats, cover what `find_contacts` does, the search for overlaps included; `joints` are those that were resolved;
`cpu_s` is processor time; `peak_gib` is the memory of the whole process so far.

With `--fine`: pairs of parts of so many faces each, flat, wavy and in bearings, instead. With `--settled`: folders of
meshes with their unit and a length in mm, on a ground, whose parts settle by at most that; `moved` and `most_mm` are
the parts that moved and the largest motion, `stopped` says whether contacts stopped all of them.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from fine_pairs import FINE_PAIRS
from record import report, spread, write_to
from states import find, one_core, real_structures

from falsework import StabilityOracle, load_structure
from falsework.geometry import ContactSettings, TriangleMesh, find_contacts

REAL = ("bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72")
INEXACT = ("ursula-6", "cra-curve-3-blocks", "dome-90", "genevault-110", "pavilion-vault-387", "armadillo-399-cra")
LARGE = "vault:parts=1000"


@dataclass(frozen=True)
class Options:
    """Structures and settings to time."""

    structures: tuple[str, ...] = ()
    """Built-in names or paths; empty for all real structures and the large vault."""
    fine: int = 0
    """Faces of each part of pairs that are timed instead."""
    settled: tuple[str, ...] = ()
    """Folders that are settled instead, each as FOLDER:UNIT:MM."""
    repeats: int = 5
    """Number of runs of each."""
    out: Path | None = None
    """File to which the records are appended."""


def main(options: Options) -> None:
    """Run the benchmark."""
    one_core()
    write_to(options.out)
    if options.fine:
        for name, pair in FINE_PAIRS.items():
            meshes = pair(options.fine)
            _report(name, meshes, None, options.repeats, kind="contacts fine")
        return
    if options.settled:
        for text in options.settled:
            _settle(text, options.repeats)
        return
    for structure in options.structures or (*real_structures(REAL + INEXACT), LARGE):
        assembly = load_structure(find(structure))
        _report(Path(structure).name, assembly.meshes, assembly.contact_settings, options.repeats)


def _report(
    name: str,
    meshes: Sequence[TriangleMesh],
    settings: ContactSettings | None,
    repeats: int,
    *,
    kind: str = "contacts",
) -> None:
    """Time the contact detection of parts."""
    seconds, cpu = [], []
    for _ in range(repeats):
        begin, spent = time.perf_counter(), time.process_time()
        contacts = find_contacts(meshes, settings)
        seconds.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - spent)
    report(
        kind,
        structure=name,
        parts=len(meshes),
        faces=sum(len(mesh.faces) for mesh in meshes),
        contacts=len(contacts),
        points=len(contacts.points),
        joints=len(contacts.report),
        seconds=spread(seconds),
        cpu_s=spread(cpu),
        peak_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    )


def _settle(text: str, repeats: int) -> None:
    """Time the settling of the parts of a folder, and what it did."""
    place, unit, length = text.rsplit(":", 2)
    folder = find(place)
    seconds, cpu = [], []
    for _ in range(repeats):
        begin, spent = time.perf_counter(), time.process_time()
        assembly = load_structure(folder, unit=unit, ground=True, settle=float(length) / 1000)
        seconds.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - spent)
    settled = assembly.settlement
    assert settled is not None
    state = np.where(assembly.boundary, 2, 1)
    report(
        "contacts settled",
        structure=Path(place).name,
        parts=assembly.part_count,
        faces=sum(len(mesh.faces) for mesh in assembly.meshes),
        bound_mm=float(length),
        steps=settled.steps,
        moved=int((settled.motion > 0).sum()),
        most_mm=1000 * float(settled.motion.max()),
        stopped=bool(settled.stopped.all()),
        stable=bool(StabilityOracle(assembly).verdicts(state[None]).stable[0]),
        seconds=spread(seconds),
        cpu_s=spread(cpu),
        peak_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Time the contact detection and settling of structures on one core, after imports: one JSON object per line.

    python benchmarks/contacts.py
    python benchmarks/contacts.py --structures vault:parts=300 path/to/assembly --repeats 10
    python benchmarks/contacts.py --fine 50000 --repeats 3
    python benchmarks/contacts.py --loose --repeats 1

Without names: the real structures where they are found (FALSEWORK_DATA, else the folder `shared` beside the
repository) and public ones whose faces overlap, then the built-in vault of 1,000 parts. `seconds`, median and range of
the repeats, cover what `find_contacts` does, the search for overlaps included; `joints` are those that were resolved;
`cpu_s` is processor time; `peak_gib` is the memory of the whole process so far.

With `--fine`: pairs of parts of so many faces each, flat, wavy and in bearings, instead. With `--loose`: assemblies
with clearance that nothing describes, twenty generated ones and those of CAD benchmarks where they are found. They are
loaded with no setting and planned for two robots within a minute; `moved` and `most_mm` are the parts that settled and
the largest motion, `stopped` says whether contacts stopped all of them.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro
from fine_pairs import FINE_PAIRS
from loose_parts import LOOSE, write_meshes
from record import report, spread, write_to
from states import find, one_core, real_structures

from falsework import find_plans, load_structure
from falsework.geometry import ContactSettings, TriangleMesh, find_contacts

REAL = ("bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72")
INEXACT = ("ursula-6", "cra-curve-3-blocks", "dome-90", "genevault-110", "pavilion-vault-387", "armadillo-399-cra")
CAD = ("cad/asap-beam/original", *(f"cad/fabrica-{name}" for name in ("beam", "car", "duct", "plumbers_block")))
MINUTE = 60.0
"""Time for a plan, seconds."""
LARGE = "vault:parts=1000"


@dataclass(frozen=True)
class Options:
    """Structures and settings to time."""

    structures: tuple[str, ...] = ()
    """Built-in names or paths; empty for all real structures and the large vault."""
    fine: int = 0
    """Faces of each part of pairs that are timed instead."""
    loose: bool = False
    """Load and plan assemblies with clearance instead."""
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
    if options.loose:
        for name in (*LOOSE, *real_structures(CAD)):
            _plan(name, options.repeats)
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


def _plan(name: str, repeats: int) -> None:
    """Time the loading and planning of an assembly with clearance, generated or a folder, without any setting."""
    load_s, plan_s, cpu = [], [], []
    with TemporaryDirectory() as scratch:
        folder = write_meshes(LOOSE[name](), Path(scratch)) if name in LOOSE else find(name)
        for _ in range(repeats):
            begin, spent = time.perf_counter(), time.process_time()
            assembly = load_structure(folder)
            loaded = time.perf_counter()
            result = find_plans(assembly, robots=2, deadline=MINUTE)
            load_s.append(loaded - begin)
            plan_s.append(time.perf_counter() - loaded)
            cpu.append(time.process_time() - spent)
    settled = assembly.settlement
    report(
        "contacts loose",
        structure=name,
        parts=assembly.part_count,
        faces=sum(len(mesh.faces) for mesh in assembly.meshes),
        outcome=str(result.outcome),
        moved=0 if settled is None else int((settled.motion > 0).sum()),
        most_mm=0.0 if settled is None else 1000 * float(settled.motion.max()),
        stopped=settled is None or bool(settled.stopped.all()),
        load_s=spread(load_s),
        plan_s=spread(plan_s),
        cpu_s=spread(cpu),
        peak_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Whether robots can close a free edge of the built-in vault from given surroundings: one JSON object per case.

    python benchmarks/free_edges.py --out benchmarks/results/free_edges.jsonl

The two edges along the courses of a vault are arches of their own, which two robots close one after the other. The
other two edges are of short cells that hold each other by friction alone. All orders of the parts near one of these
are searched without a limit on the width, everything else being as the case says:

- `first`: only both arches stand, with the course beside each; the parts near the edge are to be inserted.
- `strip`: besides, a rib stands across the middle of the vault, as in an order that a search tried.
- `last`: the vault is complete, and the parts near the edge are to be taken out.

`history` says whether releases are replayed with contact history, as in a plan; otherwise states are judged from rest
alone. `closes` is true where a state is reached in which no robot holds anything and the edge is complete (in `last`:
gone). No state is dropped. `exhaustive` is true where none was refused because of the order that led to it either; only
then does `closes` false mean that no order of these parts closes the edge. Elsewhere a state that several orders lead
to was tried by one of them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from record import report, write_to

from falsework import Assembly, Direction, StabilityOracle, load_structure, make_task
from falsework.assembly import HELD, INSTALLED, REMOVED, complete_state
from falsework.search import BeamSearch, BeamSettings, SupportGuide
from falsework.search.problem.oracle import WrappedOracle

Case = Literal["first", "strip", "last"]

_WIDTH = 100_000
"""More states than any level here has, so that none is left out."""
_ARCH = 1.3
"""Distance of the courses of the arches from the middle of the vault, m."""
_EDGE = 1.7
"""Distance of the parts of a free edge from the middle, m."""
_LAST = 1.5
"""The same of those taken out in `last`; more are too many to try all orders."""


@dataclass(frozen=True)
class Options:
    """Cases, robots and a limit."""

    cases: tuple[Case, ...] = ("first", "strip", "last")
    """Cases to search, see above."""
    robots: int = 2
    """Parts held at once."""
    limit: float = 120.0
    """Seconds of processor time for each case."""
    out: Path | None = None
    """File to which the records are appended."""


class FromRest(WrappedOracle):
    """Oracle without contact history."""

    @property
    def replayer(self) -> None:
        """None: states are judged from rest."""
        return None


def rib(assembly: Assembly) -> NDArray[np.intp]:
    """Return parts of a rib across the middle of the vault of 126 parts, without the arches that it rests on."""
    runs = ((21, 28), (34, 40), (47, 48), (50, 52), (59, 64), (72, 76), (84, 88), (96, 101))
    if assembly.part_count != 126:
        raise SystemExit(f"the rib is of a vault of 126 parts, this one has {assembly.part_count}")
    return np.concatenate([np.arange(*run) for run in runs])


def search(case: Case, history: bool, options: Options) -> None:
    """Search one case and report it."""
    assembly = load_structure("vault:parts=125")
    x, y = assembly.mass.center[:, 0], assembly.mass.center[:, 1]
    inner = (np.abs(y) < _ARCH) & ~assembly.boundary
    edge = inner & (x > _EDGE)
    full, empty = complete_state(assembly.boundary), complete_state(assembly.boundary)
    near = inner & (x > (_LAST if case == "last" else _ARCH))
    if case != "last":
        full[inner] = empty[inner] = REMOVED
        if case == "strip":
            full[rib(assembly)] = empty[rib(assembly)] = INSTALLED
            near = inner & (x > 0.6) & (empty == REMOVED)
        full[near] = INSTALLED
    empty[near] = REMOVED
    direction = Direction.DISASSEMBLY if case == "last" else Direction.ASSEMBLY
    oracle = StabilityOracle(assembly)
    beam = BeamSearch(
        make_task(assembly, options.robots, start=full, target=empty),
        oracle if history else FromRest(oracle),
        BeamSettings(width=_WIDTH, direction=direction, diversity="none", lookahead=_WIDTH),
        guide=SupportGuide(assembly),
    )
    begun, closes = time.process_time(), False
    while not closes and time.process_time() - begun < options.limit and beam.step():
        level = beam.levels[-1]
        held = ((level.states == HELD) & ~assembly.boundary).any(axis=1)
        present = (level.states[:, edge] != REMOVED).sum(axis=1)
        ended = present == (0 if case == "last" else edge.sum())
        closes = bool((ended & ~held & (level.grounded > 0)).any())
    sizes = [len(level.states) for level in beam.levels]
    report(
        "free_edges",
        case=case,
        history=history,
        parts=int(near.sum()),
        robots=options.robots,
        closes=closes,
        exhaustive=not closes and beam.done and beam.exhaustive,
        levels=len(sizes) - 1,
        steps=beam.task.steps,
        widest=max(sizes),
        verdicts=beam.asked,
        undecided=beam.result().undecided,
        cpu_seconds=time.process_time() - begun,
        limit=options.limit,
    )


def main(options: Options) -> None:
    """Search the cases; taking parts out leaves no history to replay."""
    write_to(options.out)
    for case in options.cases:
        for history in (False,) if case == "last" else (False, True):
            search(case, history, options)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

"""Time plans in which parts leave in several moves or turn, on one core, after imports: one JSON object per line.

    python benchmarks/motions.py
    python benchmarks/motions.py --repeats 9 --out benchmarks/results/motions.jsonl

`drawer` is lifted over a lip and pulled out, `lid` is tipped up and slides out, `tunnel` leads a block around six
corners, and in `bar` a robot shifts a bar aside that never leaves before the pin under it. `seconds` are those of the
search for a plan, with the clearance of straight exits; `check_seconds` those of the check, which sweeps the paths
anew; `moves` counts the moves of the longest exit path.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import tyro
from record import report, spread, write_to
from states import one_core

from falsework import Assembly, StabilitySettings, find_plans
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.library.voxels import surface
from falsework.search.plans.plan_check import validate_plan

SETTINGS = StabilitySettings(criterion="equilibrium")
EDGE = 0.1
Cells = set[tuple[int, int, int]]


def of_cubes(*pieces: Cells, low: int, high: int, hollow: Cells) -> Assembly:
    """Pieces of cubes in a fixed block of cubes from `low` to `high` with a hollow."""
    frame = {(x, y, z) for x, y, z in product(range(low, high), repeat=3)} - hollow - set().union(*pieces)
    solids = [surface("piece", frozenset(piece), (EDGE,) * 3, (0.0, 0.0, 0.0)) for piece in pieces]
    solids.append(replace(surface("frame", frozenset(frame), (EDGE,) * 3, (0.0, 0.0, 0.0)), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


def case(part: tuple, *fixed: tuple) -> Assembly:
    """A box among fixed boxes, each given by its lowest and highest corner."""
    blocks = gather([box("part", *part), *(box("case", *corners, fixed=True) for corners in fixed)])
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


def drawer() -> Assembly:
    """A drawer behind a lip, in a case."""
    return case(
        ((0.0, 0.0, 0.0), (0.3, 0.2, 0.1)),
        ((-0.05, -0.05, -0.05), (0.35, 0.25, 0.0)),
        ((-0.05, -0.05, 0.0), (0.0, 0.25, 0.25)),
        ((0.0, -0.05, 0.0), (0.3, 0.0, 0.25)),
        ((0.0, 0.2, 0.0), (0.3, 0.25, 0.25)),
        ((-0.05, -0.05, 0.25), (0.35, 0.25, 0.3)),
        ((0.3, -0.05, 0.0), (0.35, 0.25, 0.06)),
    )


def lid() -> Assembly:
    """A lid behind a low wall, with its back end under a ledge."""
    return case(
        ((0.0, 0.0, 0.0), (0.3, 0.2, 0.02)),
        ((-0.05, -0.05, -0.05), (0.35, 0.25, 0.0)),
        ((-0.05, -0.05, 0.0), (-0.01, 0.25, 0.1)),
        ((-0.01, -0.05, 0.03), (0.03, 0.25, 0.1)),
        ((-0.01, -0.05, 0.0), (0.3, 0.0, 0.03)),
        ((-0.01, 0.2, 0.0), (0.3, 0.25, 0.03)),
        ((0.3, -0.05, 0.0), (0.35, 0.25, 0.02)),
    )


def tunnel() -> Assembly:
    """A block at the blind end of a tunnel."""
    hollow = {(x, 0, 0) for x in range(4)} | {(3, 0, z) for z in range(3)} | {(x, 0, 2) for x in range(1, 4)}
    hollow |= {(1, y, 2) for y in range(4)} | {(x, 3, 2) for x in range(1, 5)} | {(4, 3, z) for z in range(2, 5)}
    hollow |= {(x, 3, 4) for x in range(4, 6)}
    return of_cubes({(0, 0, 0)}, low=-1, high=6, hollow=hollow)


def bar() -> Assembly:
    """A pin under a bar that stays in the frame."""
    hollow = {(1, 1, z) for z in range(6)} | {(x, y, 2) for x in range(1, 6) for y in (0, 1)}
    return of_cubes(
        {(1, 1, 0), (1, 1, 1)},
        {(1, 1, 2), (2, 1, 2), (1, 0, 2)},
        low=-1,
        high=6,
        hollow=hollow - {(5, 0, 2), (5, 1, 2)},
    )


CASES: tuple[tuple[Callable[[], Assembly], dict[str, Any]], ...] = (
    (drawer, {"robots": 1, "moves": 2}),
    (lid, {"robots": 1, "moves": 2, "turns": True}),
    (tunnel, {"robots": 1, "moves": 7}),
    (bar, {"robots": 2, "moves": 2, "target": [0, 2, 2]}),
)


@dataclass(frozen=True)
class Options:
    """Number of runs, and where they are recorded."""

    repeats: int = 5
    """Number of runs of each, after one that compiles."""
    out: Path | None = None
    """File to which the records are appended."""


def main(options: Options) -> None:
    """Run the benchmark."""
    one_core()
    write_to(options.out)
    for make, rules in CASES:
        seconds, checks, longest = [], [], 0
        for run in range(options.repeats + 1):
            assembly = make()
            begin = time.perf_counter()
            plan = find_plans(assembly, stability=SETTINGS, **rules).plans[0]
            found = time.perf_counter()
            good = validate_plan(plan, assembly, SETTINGS).good
            if not good:
                raise SystemExit(f"the plan of {make.__name__} is not good")
            if run:
                seconds.append(found - begin)
                checks.append(time.perf_counter() - found)
            longest = max(map(len, plan.exit_paths))
        figures = {"seconds": spread(seconds), "check_seconds": spread(checks), "moves": longest}
        report("motions", case=make.__name__, **figures)


if __name__ == "__main__":
    main(tyro.cli(Options))

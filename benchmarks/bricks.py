"""Chairs of bricks: cost of a verdict and of a plan with clutching studs.

    python benchmarks/bricks.py --heights 8,40 --repeats 3

A chair has four legs of 2 by 2 studs, a seat of 12 by 12 in three bonded layers, and a back in running bond.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from record import report, spread, write_to

from falsework import StabilityOracle, find_plans
from falsework.assembly import INSTALLED
from falsework.interop import Brick, assemble_bricks
from falsework.interop.bricks import HEIGHT, PITCH

STATES = 40
"""Number of late states of a plan, with most bricks in place, whose verdicts are timed."""
WIDTH, LEGS = 12, 12
"""Length of the sides of the seat in studs, and number of layers of the legs."""


def chair(back: int) -> list[Brick]:
    """Return the bricks of a chair whose back has this many layers."""
    bricks: list[Brick] = []

    def put(x: int, y: int, layer: int, *studs: int) -> None:
        bricks.append(Brick((PITCH * x, PITCH * y, HEIGHT * layer), (studs[0], studs[1])))

    for layer in range(LEGS):
        for x in (0, WIDTH - 2):
            for y in (0, WIDTH - 2):
                put(x, y, layer, 2, 2)
    for across in range(0, WIDTH, 2):
        for start, length in rows(across // 2 % 2 == 1):
            put(start, across, LEGS, length, 2)
        for start, length in rows(True):
            put(across, start, LEGS + 1, 2, length)
        for start, length in rows(False):
            put(across, start, LEGS + 2, 2, length)
    for layer in range(back):
        for start, length in rows(layer % 2 == 1):
            put(start, WIDTH - 2, LEGS + 3 + layer, length, 2)
    return bricks


def rows(shifted: bool) -> list[tuple[int, int]]:
    """Return positions and lengths of the bricks along a side."""
    if not shifted:
        return [(start, 4) for start in range(0, WIDTH, 4)]
    return [(0, 2), *((start, 4) for start in range(2, WIDTH - 2, 4)), (WIDTH - 2, 2)]


def cost(back: int, repeats: int) -> None:
    """Time a plan, and verdicts of its states, without and with a warm start from the previous state."""
    bricks = chair(back)
    assembly = assemble_bricks(bricks)
    seconds, found = [], None
    for _ in range(repeats):
        begun = time.process_time()
        found = find_plans(assembly, robots=2)
        seconds.append(time.process_time() - begun)
    assert found is not None
    assert found.found
    states = found.plans[0].states
    late = np.flatnonzero((states == INSTALLED).sum(axis=1) > 0.7 * len(bricks))
    chosen, alone, beside, together = late[:: max(len(late) // STATES, 1)], [], [], []
    for row in chosen:
        oracle = StabilityOracle(assembly)
        oracle.verdicts(states[:1])  # lays the structure out
        begun = time.process_time()
        oracle.verdicts(states[row - 1])
        between = time.process_time()
        oracle.verdicts(states[row], near=states[row - 1 : row])
        beside.append(time.process_time() - between)
        alone.append(between - begun)
    for _ in range(repeats):
        oracle = StabilityOracle(assembly)
        oracle.verdicts(states[:1])
        begun = time.process_time()
        oracle.verdicts(states[chosen])
        together.append((time.process_time() - begun) / len(chosen))
    hundred = 100.0 / float(np.median((states[chosen] == INSTALLED).sum(axis=1)))
    report(
        "bricks cost",
        bricks=len(bricks),
        points=len(assembly.contacts.points),
        robots=2,
        steps=len(found.plans[0].actions),
        plan_processor_s=float(np.median(seconds)),
        plan_range=spread(seconds),
        verdict_processor_ms=1000 * float(np.median(alone)),
        next_verdict_processor_ms=1000 * float(np.median(beside)),
        batch_verdict_processor_ms=1000 * float(np.median(together)),
        processor_ms_per_100_bricks=spread([1000 * hundred * value for value in together]),
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--heights", default="8,40", help="layers of the back of each chair")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    write_to(arguments.out)
    for height in arguments.heights.split(","):
        cost(int(height), arguments.repeats)


if __name__ == "__main__":
    main()

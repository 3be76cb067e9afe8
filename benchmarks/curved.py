"""Compare verdicts on random pairs with curved interfaces with linear programs on all of their facets.

    python benchmarks/curved.py
    python benchmarks/curved.py --pairs 100 --seed 1

One JSON object for each kind of surface and criterion. Each pair is asked about three times: without friction, and with
friction by `margin`, drawn between 0.1 % and 10 %, below and above what its equilibrium needs. `unsafe` counts states
that are stable with an accepted proof and have no equilibrium within the tolerance; `cautious` counts states that are
unstable, or undecided, and have one. `facets` and `points` are medians; `seconds` is the mean time of a verdict.
"""

from __future__ import annotations

import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from curved_pairs import SURFACES, CurvedPair, critical_friction, random_pair
from record import report, write_to
from states import one_core

from falsework.stability import Stability, StabilitySettings, verify_certificates
from falsework.stability.problem import TOLERANCE


@dataclass(frozen=True)
class Options:
    """Number of pairs, and their seed."""

    pairs: int = 1000
    """Pairs in all, of the surfaces in turn."""
    seed: int = 0
    out: Path | None = None
    """File to which the records are appended."""


def questions(pair: CurvedPair, rng: np.random.Generator) -> list[tuple[float, bool]]:
    """Return coefficients of friction, and whether there is equilibrium within the tolerance."""
    needed = critical_friction(pair, TOLERANCE, steps=8)
    frictions = [0.0]
    if 0.0 < needed < np.inf:
        margin = 10 ** rng.uniform(-3, -1)
        frictions += [needed * (1 - margin), needed * (1 + margin)]
    return [(friction, pair.residual(friction) <= TOLERANCE) for friction in frictions]


def main(options: Options) -> None:
    """Run the benchmark."""
    one_core()
    write_to(options.out)
    rng = np.random.default_rng(options.seed)
    counts: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    state = np.array([[1, 2]], dtype=np.uint8)
    for number in range(options.pairs):
        surface = SURFACES[number % len(SURFACES)]
        pair = random_pair(rng, surface)
        structure = pair.assembly(0.0)
        asked = questions(pair, rng)
        for criterion in ("equilibrium", "contact"):
            found = counts[surface, criterion]
            settings = StabilitySettings(criterion=criterion, cone="quadratic")
            found["pairs"].append(1)
            found["facets"].append(len(pair.corners))
            found["points"].append(len(structure.contacts.points))
            for friction, holds in asked:
                at = structure.replace(friction=friction)
                begin = time.perf_counter()
                verdict = Stability(at, settings).check(state)
                found["seconds"].append(time.perf_counter() - begin)
                stable = verdict.verdict[0] == 1
                proven = stable and verify_certificates(at, state, verdict, settings.claim)[0]
                found["states"].append(1)
                found["unsafe"].append(proven and not holds)
                found["cautious"].append(holds and (verdict.verdict[0] in (-1, 0)))
    for (surface, criterion), found in counts.items():
        report(
            "curved",
            surface=surface,
            criterion=criterion,
            **{key: int(sum(found[key])) for key in ("pairs", "states", "unsafe", "cautious")},
            **{key: float(np.median(found[key])) for key in ("facets", "points")},
            seconds=float(np.mean(found["seconds"])),
            seeds=[options.seed],
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

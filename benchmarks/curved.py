"""Compare verdicts on random pairs with curved interfaces with linear programs on all of their facets.

    python benchmarks/curved.py
    python benchmarks/curved.py --pairs 100 --seed 1
    python benchmarks/curved.py --faces inclined --pairs 200

One JSON object for each kind of surface and criterion. Each pair is asked about three times: without friction, and with
friction by `margin`, drawn between 0.1 % and 10 %, below and above what its equilibrium needs. `unsafe` counts states
that are stable with an accepted proof and have no equilibrium within the tolerance; `cautious` counts states that are
unstable, or undecided, and have one. `facets` and `points` are medians; `seconds` is the mean time of a verdict.

Where faces are inclined to each other, within the tolerances or of a fitted joint, a state has an equilibrium if it has
one with the normals of the body and one with those of the bed. `angle` is the median of the largest angle of a pair,
degrees, and `unsafe_about_mean` counts the unsafe states with all friction about the mean normals.
"""

from __future__ import annotations

import time
import warnings
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from curved_pairs import SURFACES, Pair, critical_friction, random_pair
from inclined_pairs import random_inclined_pair
from record import report, write_to
from states import one_core

from falsework import Assembly, StabilityOracle, StabilitySettings, verify_certificates
from falsework.assembly import ContactWarning
from falsework.stability.settings import EQUILIBRIUM

_COUNTS = ("pairs", "states", "unsafe", "cautious")


@dataclass(frozen=True)
class Options:
    """Number of pairs, and their seed."""

    pairs: int = 1000
    """Pairs in all, of the surfaces in turn."""
    seed: int = 0
    faces: Literal["shared", "inclined", "fitted"] = "shared"
    """Facets of body and bed: the same, others within the tolerances, or others with a fitted joint."""
    out: Path | None = None
    """File to which the records are appended."""


def questions(pair: Pair, rng: np.random.Generator) -> list[tuple[float, bool]]:
    """Return coefficients of friction, and whether there is equilibrium within the tolerance."""
    needed = critical_friction(pair, EQUILIBRIUM.tolerance, steps=8)
    frictions = [0.0]
    if 0.0 < needed < np.inf:
        margin = 10 ** rng.uniform(-3, -1)
        frictions += [needed * (1 - margin), needed * (1 + margin)]
    return [(friction, pair.residual(friction) <= EQUILIBRIUM.tolerance) for friction in frictions]


def pair_of(options: Options, rng: np.random.Generator, surface: str) -> tuple[Pair, Assembly, dict[str, float]]:
    """Return a pair, its structure, and its figures."""
    if options.faces == "shared":
        shared = random_pair(rng, surface)
        return shared, shared.assembly(0.0), {"facets": len(shared.corners)}
    pair = random_inclined_pair(rng, surface)
    structure = pair.assembly(0.0, fitted=options.faces == "fitted")
    return pair, structure, {"facets": pair.pieces, "angle": float(pair.angle.max())}


def main(options: Options) -> None:
    """Run the benchmark."""
    one_core()
    write_to(options.out)
    warnings.simplefilter("ignore", ContactWarning)
    rng = np.random.default_rng(options.seed)
    counts: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    state = np.array([[1, 2]], dtype=np.uint8)
    for number in range(options.pairs):
        surface = SURFACES[number % len(SURFACES)]
        pair, structure, figures = pair_of(options, rng, surface)
        asked = questions(pair, rng)
        for criterion in ("equilibrium", "contact"):
            found = counts[surface, criterion]
            settings = StabilitySettings(criterion=criterion, cone="quadratic")
            found["pairs"].append(1)
            for key, value in figures.items():
                found[key].append(value)
            found["points"].append(len(structure.contacts.points))
            for friction, holds in asked:
                at = structure.replace(friction=friction)
                begin = time.perf_counter()
                verdict = StabilityOracle(at, settings).verdicts(state, require_certificate=True)
                found["seconds"].append(time.perf_counter() - begin)
                stable = verdict.verdict[0] == 1
                proven = stable and verify_certificates(at, state, verdict, settings.claim)[0]
                found["states"].append(1)
                found["unsafe"].append(proven and not holds)
                found["cautious"].append(holds and (verdict.verdict[0] in (-1, 0)))
                if options.faces != "shared":
                    mean = replace(at, contacts=replace(at.contacts, lean=None))
                    there = StabilityOracle(mean, settings).verdicts(state, require_certificate=True)
                    proven = there.verdict[0] == 1 and verify_certificates(mean, state, there, settings.claim)[0]
                    found["unsafe_about_mean"].append(proven and not holds)
    for (surface, criterion), found in counts.items():
        report(
            "curved",
            surface=surface,
            criterion=criterion,
            faces=options.faces,
            **{key: int(sum(found[key])) for key in (*_COUNTS, "unsafe_about_mean") if key in found},
            **{key: float(np.median(found[key])) for key in ("facets", "points", "angle") if key in found},
            seconds=float(np.mean(found["seconds"])),
            seeds=[options.seed],
        )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

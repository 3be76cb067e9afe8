"""Plans under random changes of settings that no search has tried: one JSON object per line.

    python benchmarks/changes.py --structures vault-62 dome-72 --draws 32
    python benchmarks/changes.py --structures barrel-0 groin-2 --robots 3

A plan with a reserve stands under four changes of all settings to their extremes. Here it is replayed under all sixteen
combinations of extremes, and under random ones between them: ratio of stiffness, increments of a release, medium and
stiffness of holds are drawn evenly, on a logarithmic scale, and so is the error of presses; in a thicker medium new
contacts have initial friction. `falls` counts the draws under which the plan does not stand with friction divided by
its reserve, `true_falls` those under the true friction, `falls_at` and `true_falls_at` say at which states, and
`extremes` counts those of the sixteen, with the reserve.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from record import report, write_to
from shells import NAMES, shell
from states import REAL, find

from falsework import Assembly, PlannerSettings, StabilityOracle, find_plans, load_structure
from falsework.search.find import PLANS
from falsework.stability.contact.history import Change, ReplaySettings
from falsework.stability.contact.varied_replay import MANY, replay_varied, variations


@dataclass(frozen=True)
class Options:
    """Plans and draws."""

    structures: tuple[str, ...] = (*REAL, *NAMES)
    """Built-in names, paths, names of real structures or of random shells."""
    robots: int = 2
    """Parts held at once."""
    seeds: int = 1
    """Seeds of the search."""
    draws: int = 32
    """Random changes for each plan."""
    deadline: float = 60.0
    """Seconds for each plan."""
    out: Path | None = None
    """File to which the records are appended."""


def random_changes(count: int, rng: np.random.Generator) -> list[Change]:
    """Return changes of all settings at once, between the extremes of `variations`."""
    extremes = variations(MANY)
    found = []
    for number in range(count):
        ratio = _between(rng, [change.ratio for change in extremes if change.ratio is not None])
        factor = _between(rng, [change.hold_factor for change in extremes])
        increments = round(_between(rng, [change.replay.increments for change in extremes]))
        first_step = _between(rng, [change.replay.first_step for change in extremes])
        noise = float(first_step < ReplaySettings.first_step)
        replay = ReplaySettings(increments, first_step, friction_noise=noise, seed=1000 + number, keeps_track=False)
        found.append(Change(f"draw {number}", ratio, factor, int(rng.integers(4)), replay))
    return found


def _between(rng: np.random.Generator, values: Sequence[float]) -> float:
    """Return a number drawn evenly between the least and the largest value, on a logarithmic scale."""
    return float(np.exp(rng.uniform(np.log(min(values)), np.log(max(values)))))


def changed_plans(options: Options) -> Iterator[dict[str, Any]]:
    """Replay the plans of each structure under random changes."""
    for name in options.structures:
        for seed in range(options.seeds):
            yield {"structure": name, "robots": options.robots, "seeds": (seed,), **_plan(name, seed, options)}


def _plan(name: str, seed: int, options: Options) -> dict[str, Any]:
    """Return how the plan of a structure stands."""
    assembly: Assembly = shell(name) if name in NAMES else load_structure(find(name))
    settings, begun = PlannerSettings(seed=seed), time.process_time()
    found = find_plans(assembly, robots=options.robots, settings=settings, deadline=options.deadline, forces=False)
    row: dict[str, Any] = {"parts": assembly.part_count, "processor_seconds": time.process_time() - begun}
    row |= {"accepted": bool(found.accepted), "draws": options.draws}
    if not found.plans:
        return row
    plan = found.plans[0]
    row |= {"reserve": plan.claim.reserve, "steps": len(plan), "presses": sum(map(len, plan.presses))}
    drawn = random_changes(options.draws, np.random.default_rng(seed))
    for prefix, reserve in (("", plan.claim.reserve), ("true_", 1.0)):
        replayer = StabilityOracle(assembly, replace(PLANS, reserve=reserve)).replayer
        assert replayer is not None
        cases = replay_varied(replayer, plan.states, plan.presses_before, changes=drawn)
        row[f"{prefix}falls"] = sum(not case.good for case in cases)
        row[f"{prefix}falls_at"] = sorted({case.falls_at for case in cases if case.falls_at is not None})
        if not prefix:
            extremes = replay_varied(replayer, plan.states, plan.presses_before)
            row["extremes"] = sum(not case.good for case in extremes)
    return row


def main(options: Options) -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore")
    write_to(options.out)
    for row in changed_plans(options):
        report("changes plans", **row)


if __name__ == "__main__":
    main(tyro.cli(Options))

"""Modes of holds, and changed settings, on the same structures: one JSON object per line.

    python benchmarks/holds.py modes --structures vault:parts=125 vault:parts=250 --judge
    python benchmarks/holds.py settings --structures vault-62 vault dome-72

`modes`: a plan with two robots that press under force control, and one under hybrid control; processor seconds with
proofs, presses, how far parts move, and with `--judge` how far discrete elements build it. `settings`: seconds
of the search, of one replay of its plan, and of all changes one by one.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro
from record import report, spread, write_to
from shells import NAMES, shell
from states import find

from falsework import Assembly, PlannerSettings, find_plans, load_structure
from falsework.search.find import PLANS
from falsework.stability import HoldSettings
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.varied_replay import replay_varied
from falsework.stability.holds import HoldMode
from falsework.stability.judges.discrete_elements import BuildJudge


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["modes", "settings"]]
    """Benchmark."""
    structures: tuple[str, ...] = ("vault:parts=125",)
    """Built-in names, paths, names of real structures or of random shells."""
    modes: tuple[HoldMode, ...] = (HoldMode.FORCE, HoldMode.HYBRID)
    """Modes to compare."""
    deadline: float = 300.0
    """Seconds for each plan."""
    seeds: int = 1
    """Seeds of the search."""
    judge: bool = False
    """Also build the plans by discrete elements."""
    out: Path | None = None
    """File to which the records are appended."""


def _structure(name: str) -> Assembly:
    return shell(name) if name in NAMES else load_structure(find(name))


def modes(options: Options) -> Iterator[dict[str, Any]]:
    """Plan under each mode."""
    for name in options.structures:
        assembly = _structure(name)
        weight = 9.81 * float(assembly.mass.mass[~assembly.immovable].max())
        for mode in options.modes:
            for seed in range(options.seeds):
                stability = replace(PLANS, holds=HoldSettings(mode=mode))
                settings, begun = PlannerSettings(seed=seed), time.process_time()
                found = find_plans(assembly, stability=stability, settings=settings, deadline=options.deadline)
                row: dict[str, Any] = {"structure": name, "parts": assembly.part_count, "mode": mode, "seeds": [seed]}
                row |= {"processor_seconds": time.process_time() - begun, "found": found.found}
                row |= {"verdicts": found.result.counters.asked}
                if found.plans:
                    plan = found.plans[0]
                    forces = [press.force / weight for some in plan.presses for press in some]
                    row |= {
                        "reserve": plan.claim.reserve,
                        "presses": len(forces),
                        "most_weights": max(forces, default=0),
                    }
                    replay = plan.replay
                    assert replay is not None
                    row |= {"moved_mm": 1e3 * replay.moved, "varied": replay.varied}
                    if options.judge:
                        judged = BuildJudge(assembly, plan.claim.holds).judge(plan.states, plan.presses_before)
                        row |= {"states": judged.of, "built": judged.built}
                yield row


def settings(options: Options) -> Iterator[dict[str, Any]]:
    """Time the last tests of plans."""
    for name in options.structures:
        assembly, seconds = _structure(name), dict[str, list[float]]()

        def timed(what: str, begun: float, seconds: dict[str, list[float]] = seconds) -> float:
            seconds.setdefault(what, []).append(time.process_time() - begun)
            return time.process_time()

        for seed in range(options.seeds):
            begun = time.process_time()
            found = find_plans(assembly, settings=PlannerSettings(seed=seed), deadline=options.deadline)
            begun = timed("plan", begun)
            plan = found.plans[0]
            states, presses = plan.states, plan.presses_before
            replayer = Replayer(assembly, replace(PLANS, reserve=plan.claim.reserve, holds=plan.claim.holds))
            begun = time.process_time()
            replayer.replay(states, presses=presses)
            begun = timed("replay", begun)
            replay_varied(replayer, states, presses)
            timed("one_by_one", begun)
        measured = {f"{what}_seconds": spread(values) for what, values in seconds.items()}
        yield {"structure": name, "parts": assembly.part_count, "seeds": list(range(options.seeds)), **measured}


def main(options: Options) -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore")
    write_to(options.out)
    find_plans(load_structure("arch:blocks=5"))  # have everything compiled
    for row in (modes if options.what == "modes" else settings)(options):
        report(f"holds {options.what}", **row)


if __name__ == "__main__":
    main(tyro.cli(Options))

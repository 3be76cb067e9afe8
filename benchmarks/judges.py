"""Independent methods on delivered plans and on random scenes: one JSON object per line.

    python benchmarks/judges.py plans --structures wall-38 dome-37
    python benchmarks/judges.py plans --structures barrel-vault-121 --lmgc90 40
    python benchmarks/judges.py builds --structures vault-62 --robots 2 --reserve 1.1
    python benchmarks/judges.py scenes --scenes 1000

`plans`: a plan under `contact`, its replay, the replay under variations (stiffness ratio, speed of release, damping,
random friction at the start), the same building sequence by discrete elements, and each state by discrete elements:
`settled` from no stress and `proven` from the contact forces of its verdict. For `--lmgc90` states evenly spaced over
the plan, LMGC90. Discrete elements leave a state undecided that
neither rests nor has collapsed at their step limit; LMGC90 does not judge a state whose contacts it cannot detect.
`builds`: a plan with a reserve, built state by state by discrete elements under the true friction, with robots that are
springs and press as planned: on contact springs as stiff as those of the criterion (`alike`), stiff and soft ones.
`scenes`: the random rows and stacks of the tests; the verdict of each beside the replay in which the robots release.
"""

from __future__ import annotations

import runpy
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from record import report, write_to
from states import REAL, find

from falsework.assembly import Assembly, load_structure
from falsework.assembly.state import HELD, complete_state
from falsework.search import Plan, PlannerSettings, find_plans, task_of
from falsework.search.find import PLANS
from falsework.stability import Stability, Verdict
from falsework.stability.contact.varied_replay import DRAWS, replay_varied
from falsework.stability.judges import (
    DiscreteElementSettings,
    judge_by_lmgc90,
    replay_by_discrete_elements,
    settle,
)
from falsework.stability.judges.discrete_elements import SOFT, STIFF
from falsework.stability.stiffness import normal_stiffness

_STANDS = {1: "stands", -1: "falls", 0: "open"}
_TESTS = Path(__file__).resolve().parents[1] / "tests"


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["plans", "builds", "scenes"]]
    """Benchmark."""
    structures: tuple[str, ...] = REAL
    """Built-in names, paths, or names of real structures."""
    robots: int = 2
    """Parts held at once."""
    reserve: float = PLANS.reserve
    """Of `builds`: number by which friction is divided in planning; 1 where no such plan is found."""
    deadline: float = 120.0
    """Of `builds`: seconds for each plan."""
    steps: int = 100_000
    """Of `builds`: steps after which discrete elements leave a state undecided."""
    robust: bool = False
    """Search for plans whose replay succeeds under varied settings too."""
    draws: int = DRAWS
    """Random states of friction at the start of a replay."""
    lmgc90: int = 0
    """Largest number of states of a plan for LMGC90; each takes a second to a minute."""
    scenes: int = 1000
    """Random scenes, from seed 0 on."""
    out: Path | None = None
    """File to which the records are appended."""


def plans(options: Options) -> Iterator[dict[str, Any]]:
    """Compare independent methods with the plan of each structure."""
    for name in options.structures:
        assembly = load_structure(find(name))
        oracle = Stability(assembly)
        begun = time.process_time()
        settings, task = PlannerSettings(robust=options.robust), task_of(assembly, options.robots)
        found = find_plans(assembly, task, oracle=oracle, settings=settings, forces=False).plans
        row = {"structure": name, "parts": assembly.part_count, "robots": options.robots, "seeds": (0,)}
        row |= {"robust": options.robust, "processor_seconds": time.process_time() - begun}
        if not found:
            yield {**row, "states": 0}
            continue
        states, presses, replayer = found[0].assembly_states, found[0].assembly_presses, oracle.replayer
        assert replayer is not None
        varied = replay_varied(replayer, states, presses, draws=options.draws)
        row |= {
            "states": len(states),
            "replay": _count(replayer.replay(states, presses=presses).stands),
            "varied": len(varied),
            "varied_stands": sum(case.good for case in varied),
            "varied_falls": [f"{case.name}: state {case.falls_at}" for case in varied if not case.good],
            "built": _count(replay_by_discrete_elements(assembly, states, presses=presses).stands),
            "settled": _count(settle(assembly, states).stands),
            "proven": _count(settle(assembly, states, forces=oracle.check(states).forces).stands),
        }
        if options.lmgc90:
            some = np.unique(np.linspace(0, len(states) - 1, options.lmgc90).round().astype(int))
            answers = judge_by_lmgc90(assembly, states[some])
            row["lmgc90"] = {
                answer: sum(one.answer == answer for one in answers) for answer in ("stands", "falls", "not judged")
            }
            row["lmgc90_reasons"] = sorted({one.reason for one in answers if one.reason})[:3]
        yield row


def builds(options: Options) -> Iterator[dict[str, Any]]:
    """Build a plan with a reserve by discrete elements."""
    stability = replace(PLANS, reserve=options.reserve)
    for name in options.structures:
        assembly = load_structure(find(name))
        row = {"structure": name, "parts": assembly.part_count, "robots": options.robots, "seeds": (0,)}
        begun = time.process_time()
        found = find_plans(
            assembly, robots=options.robots, stability=stability, deadline=options.deadline, forces=False
        ).plans
        row |= {"asked_reserve": options.reserve, "processor_seconds": time.process_time() - begun}
        if not found:
            yield {**row, "states": 0}
            continue
        plan = found[0]
        row |= {"reserve": plan.claim.reserve, "states": len(plan.states), "presses": sum(map(len, plan.presses))}
        sinks = {"alike": _sink(assembly), "stiff": STIFF, "soft": SOFT}
        yield row | {label: _built(assembly, plan, sink, options) for label, sink in sinks.items()}


def _sink(assembly: Assembly) -> float:
    """Return the settlement of a typical part that makes contacts of discrete elements as stiff as the criterion's."""
    size = np.median([np.ptp(mesh.bounds, axis=0).max() for mesh in assembly.meshes])
    weight = 9.81 * assembly.mass.mass[~assembly.boundary].mean()
    return float(weight / (8 * size * normal_stiffness(assembly).mean()))


def _built(assembly: Assembly, plan: Plan, sink: float, options: Options) -> dict[str, Any]:
    """Return what becomes of the states of a plan on contact springs of one stiffness."""
    begun = time.process_time()
    settings = DiscreteElementSettings(sinks=(sink,), steps=options.steps)
    found = replay_by_discrete_elements(
        assembly, plan.assembly_states, settings, presses=plan.assembly_presses, holds=plan.claim.holds
    )
    row = {**_count(found.stands), "open_at": np.flatnonzero(found.stands == 0).tolist()}
    if found.stands[-1] < 0:
        last = len(found.stands) - 1
        before, after = plan.assembly_states[last - 1], plan.assembly_states[last]
        released = np.flatnonzero((before == HELD) & (after != HELD)).tolist()
        row |= {"falls_at": last, "part": assembly.names[found.part[last]]}
        row |= {"released": [assembly.names[part] for part in released]}
        row |= {"presses": len(plan.assembly_presses[last])}
    return {"sink": sink, **row, "judge_seconds": time.process_time() - begun}


def scenes(options: Options) -> Iterator[dict[str, Any]]:
    """Compare verdicts on random scenes with the replay in which robots hold every part and release them."""
    makers = runpy.run_path(str(_TESTS / "stability" / "contact" / "conftest.py"))["RandomScenes"]
    found: Counter[str] = Counter()
    for seed in range(options.scenes):
        assembly = (makers.row, makers.slope)[seed % 2](np.random.default_rng(seed))
        state = complete_state(assembly.boundary)
        oracle = Stability(assembly)
        assert oracle.replayer is not None
        verdict = Verdict(oracle.judge(state[None]).verdict[0]).name.lower()
        replay = oracle.replayer.replay(np.stack([np.full_like(state, HELD), state]))
        found[f"{verdict}, {_STANDS[int(replay.stands[-1])]} in the replay"] += 1
    yield {"scenes": options.scenes, "seeds": tuple(range(options.scenes)), "found": dict(found)}


def _count(stands: Any) -> dict[str, int]:
    """Return the numbers of stable, collapsing and undecided states."""
    return {name: int((np.asarray(stands) == value).sum()) for value, name in _STANDS.items()}


def main(options: Options) -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore")
    write_to(options.out)
    for row in {"plans": plans, "builds": builds, "scenes": scenes}[options.what](options):
        report(f"judges {options.what}", **row)


if __name__ == "__main__":
    main(tyro.cli(Options))

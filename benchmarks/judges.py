"""Independent methods on delivered plans and on random scenes: one JSON object per line.

    python benchmarks/judges.py plans --structures wall-38 dome-37
    python benchmarks/judges.py plans --structures barrel-vault-121 --lmgc90 40
    python benchmarks/judges.py builds --structures vault-62 --robots 2 --reserve 1.1
    python benchmarks/judges.py shells --runs out/shells.jsonl --processes 16
    python benchmarks/judges.py scenes --scenes 1000

`plans`: a plan under `contact`, its replay, the replay under variations (stiffness ratio, speed of release, damping,
random friction at the start), the same building sequence by discrete elements, and each state by discrete elements:
`settled` from no stress and `proven` from the contact forces of its verdict. For `--lmgc90` states evenly spaced over
the plan, LMGC90. Discrete elements leave a state undecided that
neither rests nor has collapsed at their step limit; LMGC90 does not judge a state whose contacts it cannot detect.
`builds`: a plan with a reserve, built state by state by discrete elements under the true friction, with robots that are
springs and press as planned: on contact springs as stiff as those of the criterion (`alike`), stiff and soft ones.
`shells`: the same for twenty random shells of five families (see `shells.py`), with two and three robots, on contact
springs as those of the criterion and stiff ones. Each is a process of its own, and a line of the file `--runs`, from
which the same command goes on where it was interrupted; the records follow once all are there.
`scenes`: the random rows and stacks of the tests; the verdict of each beside the replay in which the robots release.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from lmgc90 import judge_by_lmgc90
from record import commit, report, rounded, write_to
from runs import Run, append, kept, printed_by, read_runs, run_all
from settling import replay_by_discrete_elements, settle
from shells import NAMES, shell
from states import REAL, find

from falsework import Assembly, Plan, PlannerSettings, StabilityOracle, find_plans, load_structure, make_task
from falsework.assembly import HELD, complete_state
from falsework.search.find import PLANS
from falsework.stability.contact.varied_replay import MANY, replay_varied, variations
from falsework.stability.judges.discrete_elements import DiscreteElementSettings
from falsework.stability.stiffness import normal_stiffness

_DEADLINE, _SHELL_DEADLINE = 120.0, 60.0
"""Seconds for a plan: of a structure, and of a random shell."""
_PATIENCE = 30.0
"""Deadlines after which a process that plans and builds is killed."""
_SINKS = {"stiff": 2e-7, "soft": 2e-5}
"""Springs other than those of the criterion: settlement of a typical part on eight typical points, in part sizes."""
_STANDS = {1: "stands", -1: "falls", 0: "open"}
_TESTS = Path(__file__).resolve().parents[1] / "tests"


@dataclass(frozen=True)
class Options:
    """Benchmark and its settings."""

    what: tyro.conf.Positional[Literal["plans", "builds", "shells", "scenes"]]
    """Benchmark."""
    structures: tuple[str, ...] = ()
    """Built-in names, paths, or names of real structures, or of random shells; all real ones or all shells by default.
    """
    robots: int | None = None
    """Parts held at once; 2 by default, and of `shells` 2 and 3."""
    reserve: float = PLANS.reserve
    """Of builds: number by which friction is divided in planning; 1 where no such plan is found."""
    deadline: float | None = None
    """Of builds: seconds for each plan; 120 by default, of `shells` 60."""
    judge: bool = False
    """Of builds: let the search look for a plan that discrete elements build."""
    steps: int = 100_000
    """Of builds: steps after which discrete elements leave a state undecided."""
    robust: bool = False
    """Search for plans whose replay succeeds under varied settings too."""
    changes: int = MANY
    """Changes of settings under which a plan is replayed."""
    lmgc90: int = 0
    """Largest number of states of a plan for LMGC90; each takes a second to a minute."""
    scenes: int = 1000
    """Random scenes, from seed 0 on."""
    runs: Path | None = None
    """Of `shells`: file to which each run is appended, and whose runs are not repeated."""
    processes: int = 1
    """Of `shells`: runs at the same time, each on a core of its own (Linux)."""
    minutes: float | None = None
    """Of `shells`: minutes after which no more runs begin."""
    child: str = ""
    """Make the run of `shells` that this JSON object describes in this process, and print its figures."""
    out: Path | None = None
    """File to which the records are appended."""


def plans(options: Options) -> Iterator[dict[str, Any]]:
    """Compare independent methods with the plan of each structure."""
    robots = options.robots or 2
    for name in options.structures or REAL:
        assembly = load_structure(find(name))
        oracle = StabilityOracle(assembly)
        begun = time.process_time()
        settings, task = PlannerSettings(robust=options.robust), make_task(assembly, robots)
        found = find_plans(assembly, task, oracle=oracle, settings=settings, forces=False).plans
        row = {"structure": name, "parts": assembly.part_count, "robots": robots, "seeds": (0,)}
        row |= {"robust": options.robust, "processor_seconds": time.process_time() - begun}
        if not found:
            yield {**row, "states": 0}
            continue
        states, presses, replayer = found[0].states, found[0].presses_before, oracle.replayer
        assert replayer is not None
        varied = replay_varied(replayer, states, presses, changes=variations(options.changes))
        row |= {
            "states": len(states),
            "replay": _count(replayer.replay(states, presses=presses).stands),
            "varied": len(varied),
            "varied_stands": sum(case.good for case in varied),
            "varied_falls": [f"{case.name}: state {case.falls_at}" for case in varied if not case.good],
            "built": _count(replay_by_discrete_elements(assembly, states, presses=presses).stands),
            "settled": _count(settle(assembly, states).stands),
            "proven": _count(
                settle(assembly, states, forces=oracle.verdicts(states, require_certificate=True).forces).stands
            ),
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
    for name in options.structures or REAL:
        yield {"structure": name, "seeds": (0,), **_built_plan(load_structure(find(name)), options)}


def _built_plan(assembly: Assembly, options: Options) -> dict[str, Any]:
    """Return how discrete elements build a plan of a structure, on springs of several stiffnesses."""
    robots, stability = options.robots or 2, replace(PLANS, reserve=options.reserve)
    row: dict[str, Any] = {"parts": assembly.part_count, "robots": robots, "asked_reserve": options.reserve}
    row |= {"judge": True} if options.judge else {}
    begun, settings = time.process_time(), PlannerSettings(judge=options.judge)
    deadline = options.deadline or _DEADLINE
    how: dict[str, Any] = {"stability": stability, "settings": settings, "deadline": deadline, "forces": False}
    found = find_plans(assembly, robots=robots, **how).plans
    row |= {"processor_seconds": time.process_time() - begun}
    if not found:
        return {**row, "states": 0}
    plan = found[0]
    row |= {"reserve": plan.claim.reserve, "states": len(plan.states), "presses": sum(map(len, plan.presses))}
    loose, mesh_size = ~assembly.boundary, [np.ptp(mesh.bounds, axis=0).max() for mesh in assembly.meshes]
    weight = 9.81 * assembly.mass.mass[loose].mean()
    alike = float(weight / (8 * np.median(mesh_size) * normal_stiffness(assembly).mean()))
    sinks = {"alike": alike, **_SINKS}
    return row | {
        label: {"sink": sink, **_built(assembly, plan, alike / sink, options)}
        for label, sink in sinks.items()
        if label != "soft" or options.what == "builds"
    }


def shells(options: Options) -> Iterator[dict[str, Any]]:
    """Build plans of random shells by discrete elements, several at a time."""
    effort = {
        "asked_reserve": options.reserve,
        "deadline": options.deadline or _SHELL_DEADLINE,
        "judged": options.judge,
    }
    numbers = (2, 3) if options.robots is None else (options.robots,)
    wanted = [
        {"shell": name, "robots": robots, "commit": commit(), **effort}
        for name in options.structures or NAMES
        for robots in numbers
    ]

    def key_of(run: Run) -> tuple[Any, ...]:
        return tuple(run[name] for name in wanted[0])

    def make(case: Run, core: int) -> Run:
        words = ["--deadline", str(case["deadline"]), "--reserve", str(options.reserve), "--steps", str(options.steps)]
        words += ["--robots", str(case["robots"]), *(["--judge"] if options.judge else [])]
        command = [__file__, "shells", *words, "--child", json.dumps({"shell": case["shell"], "core": core})]
        return {**case, **printed_by(command, _PATIENCE * case["deadline"])}

    with kept(options.runs) as path:
        known = read_runs(path, key_of)
        todo = [case for case in wanted if key_of(case) not in known]

        def note(run: Run) -> None:
            known[key_of(run)] = run
            append(path, run)
            done = sum(key_of(case) in known for case in wanted)
            print(f"{done}/{len(wanted)} {run['shell']} robots={run['robots']}: {run['ended']}", file=sys.stderr)

        until = None if options.minutes is None else time.perf_counter() + 60 * options.minutes
        left = run_all(todo, make, note, options.processes, until=until)
    if left:
        raise SystemExit(f"{left} runs were not begun; give --runs and the same command again to make them")
    for case in wanted:
        run = {name: value for name, value in known[key_of(case)].items() if name not in ("commit", "judged")}
        name = run.pop("shell")
        yield {"structure": name, "family": name.rpartition("-")[0], **run, "seeds": (int(name.rpartition("-")[2]),)}


def _one_shell(options: Options) -> dict[str, Any]:
    """Make a run of `shells` in this process."""
    case = json.loads(options.child)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {case["core"]})
    find_plans("arch:blocks=5", forces=False)  # have everything compiled
    row = _built_plan(shell(case["shell"]), options)
    return {**row, "ended": "found" if row["states"] else "nothing found"}


def _built(assembly: Assembly, plan: Plan, stiffness: float, options: Options) -> dict[str, Any]:
    """Return what becomes of the states of a plan on contact springs of one stiffness, in those of the criterion."""
    begun = time.process_time()
    settings = DiscreteElementSettings(stiffness=stiffness, steps=options.steps)
    found = replay_by_discrete_elements(
        assembly, plan.states, settings, presses=plan.presses_before, holds=plan.claim.holds
    )
    row = {**_count(found.stands), "open_at": np.flatnonzero(found.stands == 0).tolist()}
    if found.stands[-1] < 0:
        last = len(found.stands) - 1
        before, after = plan.states[last - 1], plan.states[last]
        released = np.flatnonzero((before == HELD) & (after != HELD)).tolist()
        row |= {"falls_at": last, "part": assembly.names[found.part[last]]}
        row |= {"released": [assembly.names[part] for part in released]}
        row |= {"presses": len(plan.presses_before[last])}
    return {**row, "judge_seconds": time.process_time() - begun}


def scenes(options: Options) -> Iterator[dict[str, Any]]:
    """Compare verdicts on random scenes with the replay in which robots hold every part and release them."""
    makers = runpy.run_path(str(_TESTS / "stability" / "contact" / "conftest.py"))["RandomScenes"]
    found: Counter[str] = Counter()
    for seed in range(options.scenes):
        assembly = (makers.row, makers.slope)[seed % 2](np.random.default_rng(seed))
        state = complete_state(assembly.boundary)
        oracle = StabilityOracle(assembly)
        assert oracle.replayer is not None
        verdict = str(oracle.verdicts(state[None]).kinds[0])
        replay = oracle.replayer.replay(np.stack([np.full_like(state, HELD), state]))
        found[f"{verdict}, {_STANDS[int(replay.stands[-1])]} in the replay"] += 1
    yield {"scenes": options.scenes, "seeds": tuple(range(options.scenes)), "found": dict(found)}


def _count(stands: Any) -> dict[str, int]:
    """Return the numbers of stable, collapsing and undecided states."""
    return {name: int((np.asarray(stands) == value).sum()) for value, name in _STANDS.items()}


def main(options: Options) -> None:
    """Run the benchmark."""
    warnings.simplefilter("ignore")
    if options.child:
        print(json.dumps(rounded(_one_shell(options))))
        return
    write_to(options.out)
    for row in {"plans": plans, "builds": builds, "shells": shells, "scenes": scenes}[options.what](options):
        report(f"judges {options.what}", **row)


if __name__ == "__main__":
    main(tyro.cli(Options))

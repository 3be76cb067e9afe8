"""Margins of states: their cost, agreement of replays with them, and the gain of plans made for them.

    python benchmarks/margins.py cost --structures vault-62 --states 5
    python benchmarks/margins.py truth --cases 500
    python benchmarks/margins.py plans --structures arch,dome-37

`cost` times margins of states of a plan, or of the complete structure where it is large, one by one, and of several
runs of states in one call on all cores; `--before` compares with another version of the sources, by its folder `src`,
in one run. `truth` replays states just inside and just outside of their bounds, under the contact law with history and
by discrete elements, which share no code with the solver. `plans` compares the weakest friction of the first plan found
with that of the plan made for it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from record import report, spread, write_to
from settling import settle
from states import find

from falsework import (
    Assembly,
    StabilityOracle,
    StabilitySettings,
    find_plans,
    load_structure,
    make_task,
    maximise_margin,
)
from falsework.assembly import INSTALLED, complete_state
from falsework.search import Demands, PlanMargins
from falsework.stability.contact.replay import Replayer
from falsework.stability.margins.conditions import Condition
from falsework.stability.margins.state_margins import Bound
from falsework.stability.verdict import Criterion

KINDS = ("friction", "tilt", "load_factor", "push", "held")
TOGETHER = 8
"""Consecutive states of a plan, at each of some places in it, whose margins are computed in one call."""
LARGE = 150
"""Parts from which the complete structure is measured, without a search for a plan."""
FARTHEST = 3.0
"""Multiple of a bound, or of its inverse, up to which a bound by discrete elements is sought."""
BESIDE = 0.02
"""Distance from a bound, inside and outside, at which a state is replayed, as a share of the bound."""
RESOLVED = 100.0
"""Bounds below this multiple of the verdict tolerance are left out: states close to them are within the tolerance."""
TRUTH = ("arch:blocks=7", "stack", "wall", "corbel", "catenary:blocks=9", "house")


def cost(names: list[str], count: int, criterion: Criterion, before: Path | None, rounds: int) -> None:
    """Time the margins of states spread over a plan, in CPU seconds, the least of some rounds."""
    for name in names:
        assembly = load_structure(find(name))
        chosen = together = complete_state(assembly.boundary)[None]
        if assembly.part_count <= LARGE:
            states = find_plans(assembly, robots=2).plans[0].states
            chosen = states[np.linspace(0, len(states) - 1, count).astype(int)]
            chosen = chosen[(chosen == INSTALLED).any(axis=1)]
            places = np.linspace(0, max(len(states) - TOGETHER, 0), count - 1).astype(int)
            together = np.concatenate([states[place : place + TOGETHER] for place in places])
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))
        oracle.margins(chosen[-1])
        begun, wall = time.process_time(), time.perf_counter()
        oracle.margins(together, KINDS)
        at_once = {
            "states": len(together),
            "processor_ms": 1e3 * (time.process_time() - begun) / len(together),
            "wall_ms": 1e3 * (time.perf_counter() - wall) / len(together),
        }
        seconds = {kind: [np.inf] * len(chosen) for kind in KINDS}
        old = dict.fromkeys(KINDS, np.inf)
        compared: dict[str, Any] = {}
        for _ in range(rounds):
            for row, state in enumerate(chosen):
                for kind in KINDS:
                    begun = time.process_time()
                    oracle.margins(state, (kind,))
                    seconds[kind][row] = min(seconds[kind][row], time.process_time() - begun)
            if before is not None:
                command = [sys.executable, __file__, "cost", "--structures", name, "--states", str(count)]
                done = subprocess.run(
                    [*command, "--criterion", criterion],
                    env=os.environ | {"PYTHONPATH": str(before)},
                    check=True,
                    capture_output=True,
                    text=True,
                )
                found = json.loads(done.stdout.splitlines()[-1])
                old = {kind: min(old[kind], found["processor_ms"][kind]["mean"]) for kind in KINDS}
                compared["before_at_once"] = found["at_once"]
        if before is not None:
            compared["before_ms"], compared["rounds"] = old, rounds
            compared["ratio"] = {kind: old[kind] / (1e3 * float(np.mean(seconds[kind]))) for kind in KINDS}
            total = sum(1e3 * float(np.mean(values)) for values in seconds.values())
            compared["ratio"]["all"] = sum(compared["before_ms"].values()) / total
        report(
            "margins cost",
            structure=name,
            criterion=criterion,
            parts=assembly.part_count,
            states=len(chosen),
            processor_ms={
                kind: {**spread([1e3 * value for value in values]), "mean": 1e3 * float(np.mean(values))}
                for kind, values in seconds.items()
            },
            **compared,
            at_once=at_once,
            all_processor_ms=spread([1e3 * sum(values) for values in zip(*seconds.values(), strict=True)]),
        )


def truth(cases: int, seed: int) -> None:
    """Replay random states of small structures close to their bounds."""
    random = np.random.default_rng(seed)
    asked = {"replay": 0, "discrete elements": 0}
    wrong = {"replay": 0, "discrete elements": 0}
    examples = []
    from_forces = {"asked": 0, "stands": 0}
    limits: list[float] = []
    while asked["replay"] < 2 * cases:
        name = TRUTH[random.integers(len(TRUTH))]
        assembly = load_structure(name).replace(friction=float(random.uniform(0.3, 0.8)))
        state = random_state(assembly, random)
        kind = ("friction", "horizontal", "push")[random.integers(3)]
        oracle = StabilityOracle(assembly)
        (found,) = oracle.margins(state, (kind,))
        bound: Bound | None = getattr(found, kind)
        if not found.stands or bound is None or bound.outside is None or not bound.proven or not bound.monotone:
            continue
        if smallest(assembly, bound, kind) < RESOLVED * oracle.settings.tolerance:
            continue
        for inside in (True, False):
            changed = beside(assembly, bound, kind, inside)
            for judge in asked:
                stands = stands_by(judge, changed, state)
                asked[judge] += 1
                if stands is not None and stands != inside:
                    wrong[judge] += 1
                    examples.append([judge, name, kind, inside, bound.value])
                    if judge == "discrete elements":
                        limits.append(limit_of_elements(assembly, state, bound, kind))
                        examples[-1].append(limits[-1])
                        if inside:
                            from_forces["asked"] += 1
                            from_forces["stands"] += stands_from_forces(changed, state)
    report(
        "margins truth",
        seeds=[seed],
        cases=cases,
        asked=asked,
        wrong=wrong,
        beside=BESIDE,
        from_forces=from_forces,
        limits=limits,
        examples=examples[:12],
    )


def random_state(assembly: Assembly, random: np.random.Generator) -> np.ndarray:
    """Return a state with some parts missing and some held."""
    state = random.choice(3, assembly.part_count, p=(0.2, 0.65, 0.15)).astype(np.uint8)
    state[assembly.boundary] = 2
    return state


def beside(assembly: Assembly, bound: Bound, kind: str, inside: bool) -> Assembly:
    """Return the structure under a condition just inside or outside of a bound."""
    at = bound.inside_condition if inside else bound.outside_condition
    assert at is not None
    if kind == "friction":
        share = 1 + BESIDE if inside else 1 - BESIDE
        return replace(at, friction=share * at.friction).applied_to(assembly)
    share = 1 - BESIDE if inside else 1 + BESIDE
    return Condition(at.friction, share * at.extra).applied_to(assembly)


def limit_of_elements(assembly: Assembly, state: np.ndarray, bound: Bound, kind: str) -> float:
    """Return the bound by discrete elements loaded from nothing, as a share of a bound; at most `FARTHEST`."""
    at = bound.inside_condition
    assert at is not None
    inner, outer = 1.0 / FARTHEST, FARTHEST

    def stands(share: float) -> bool:
        friction = at.friction / share if kind == "friction" else at.friction
        load = at.extra if kind == "friction" else share * at.extra
        return bool(stands_by("discrete elements", Condition(friction, load).applied_to(assembly), state))

    if stands(outer):
        return outer
    while outer / inner > 1.01:
        middle = float(np.sqrt(inner * outer))
        inner, outer = (middle, outer) if stands(middle) else (inner, middle)
    return inner


def stands_from_forces(assembly: Assembly, state: np.ndarray) -> bool:
    """Return whether discrete elements stay at rest that begin with the forces of the certificate."""
    forces = StabilityOracle(assembly).verdicts(state, require_certificate=True).forces
    return bool(settle(assembly, state, forces=forces).stands[0] == 1)


def smallest(assembly: Assembly, bound: Bound, kind: str) -> float:
    """Return a bound relative to the base of the tolerance: friction, gravity, or the weight of the part."""
    assert bound.value is not None
    if kind != "push":
        return bound.value
    assert bound.part is not None
    return bound.value / (9.81 * float(assembly.mass.mass[bound.part]))


def stands_by(judge: str, assembly: Assembly, state: np.ndarray) -> bool | None:
    """Return whether a state comes to rest; None where the judge leaves it undecided."""
    if judge == "replay":
        answer = int(Replayer(assembly).replay(state[None]).stands[0])
    else:
        answer = int(settle(assembly, state).stands[0])
    return None if answer == 0 else answer == 1


def plans(names: list[str], robots: int, limit: float) -> None:
    """Compare the weakest friction of first plans with that of plans made for it in limited processor time."""
    for name in names:
        assembly = load_structure(find(name))
        begun = time.process_time()
        first = find_plans(assembly, robots=robots)
        first_s = time.process_time() - begun
        if not first.found:
            continue
        oracle, states = StabilityOracle(assembly), first.plans[0].states
        before = PlanMargins.from_oracle(oracle, states, Demands(), also="friction").weakest("friction")
        begun = time.process_time()
        end = begun + limit
        best = maximise_margin(
            assembly, make_task(assembly, robots), "friction", stop=lambda end=end: time.process_time() > end
        )
        seconds = time.process_time() - begun
        after = best.plans[0].margins
        assert after is not None
        weakest = after.weakest("friction")
        bound: dict[str, Any] = {} if after.bound is None else {"bound": after.bound}
        if np.isfinite(limit):
            bound["limit_processor_s"] = limit
        report(
            "margins plans",
            structure=name,
            robots=robots,
            steps=len(first.plans[0]),
            friction=assembly.friction,
            first=None if before is None else before[1],
            maximised=None if weakest is None else weakest[1],
            **bound,
            first_processor_s=first_s,
            maximise_processor_s=seconds,
        )


def main() -> None:
    """Run one of the benchmarks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("cost", "truth", "plans"))
    parser.add_argument("--structures", default="arch:blocks=15")
    parser.add_argument("--states", type=int, default=5)
    parser.add_argument("--criterion", default="contact")
    parser.add_argument("--before", type=Path)
    parser.add_argument("--rounds", type=int, default=1, help="of the present and the other version in turn")
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--robots", type=int, default=2)
    parser.add_argument("--limit", type=float, default=float("inf"), help="CPU s of the search for a maximised plan")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    write_to(options.out)
    names = options.structures.split(",") if options.structures else []
    if options.what == "cost":
        cost(names, options.states, options.criterion, options.before, options.rounds)
    elif options.what == "truth":
        truth(options.cases, options.seed)
    else:
        plans(names, options.robots, options.limit)


if __name__ == "__main__":
    main()

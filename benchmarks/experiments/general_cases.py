"""Cases on which a policy for all structures is tested: structures that no training sees."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from experiments.inference import RemotePolicy
from experiments.structure_generator import HELD_OUT, TRAINED, UNSEEN, named
from states import REAL, find

from falsework import (
    Assembly,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    find_plans,
    load_policy,
    load_structure,
    make_task,
)
from falsework.errors import FalseworkError
from falsework.learn import Environment, Policy, roll_out
from falsework.learn.data.dataset import search_states
from falsework.learn.env.rollout import PolicyFunction
from falsework.learn.networks.contact_graph import ContactGraph
from falsework.learn.training.evaluate import sample
from falsework.replanning.policy_guide import PolicyGuide
from falsework.search import SupportGuide
from falsework.search.device.oracle import HostOracle
from falsework.search.find import PLANS
from falsework.search.planner import Planner
from falsework.stability.verdict import Criterion

VALIDATION, TESTED = 1_000_000, 2_000_000
"""First numbers of generated structures to choose weights by, and to test on."""
PUBLIC = (
    "arch-30", "barrel-vault-121", "cra-A", "cra-H", "cra-bridge", "cra-concave-long", "cra-concave-short", "cra-cubes",
    "cra-cube-curve-short", "cra-cube-curve-tall", "cra-curve-3-blocks", "cra-shelf", "cra-shelf-s1", "cra-shelf-s2",
    "cra-shelf-s3", "cra-shelf-stable", "cra-snake", "cra-type-a", "cra-type-b", "cra-type-c", "cra-type-d",
    "crossvault-184", "dem-crossvault-38", "dome-90", "genevault-110", "nurbs-wall-52", "topolite-chips-256",
    "topolite-tube-85", "ursula-6", "wall-38", "armadillo-399", "pavilion-vault-387",
)  # fmt: skip
"""Structures from elsewhere."""
_EACH = {"unseen member": 2, "unseen family": 16, "validation": 4, "validation family": 12}
"""Structures of each family, by group."""
_STATES, _SAMPLES, _WIDTH = 48, 16, 64
"""States tried from, at most; rollouts drawn from each; and width of the search that they come from."""
_ROWS = 4000
"""Parts of all states tried from: of large structures fewer are tried."""
_SEARCH, _PLAN = 60.0, 60.0
"""Seconds for the states, and for each of the two plans."""


@dataclass(frozen=True)
class Case:
    """One structure, and how it is to be built."""

    group: str
    structure: str
    robots: int
    criterion: Criterion


def _cases() -> dict[str, Case]:
    cases = {}
    for family, group in [
        *((name, "unseen member") for name in TRAINED),
        *((name, "unseen family") for name in UNSEEN),
        *((name, "validation") for name in TRAINED),
        *((name, "validation family") for name in HELD_OUT),
    ]:
        first = TESTED if group.startswith("unseen") else VALIDATION
        count = _EACH[group]
        for number in range(first, first + count):
            name = f"{family}-{number}"
            cases[name] = Case(group, name, 0, "contact")
    for group, names in (("paper", REAL), ("public", PUBLIC)):
        for name in names:
            for criterion in ("equilibrium", "contact") if group == "paper" else ("contact",):
                cases[f"{name}:{criterion}"] = Case(group, name, 4 if name in ("vault-62",) else 2, criterion)
    cases |= {
        f"vault-62:2:{criterion}": Case("paper", "vault-62", 2, criterion) for criterion in ("equilibrium", "contact")
    }
    return cases


CASES = _cases()
"""By name."""


def evaluate_case(name: str, remote: RemotePolicy, width: int = _WIDTH, most: int = _STATES) -> dict[str, Any]:
    """Test a policy on one case.

    Args:
        name: of `CASES`.
        remote: the policy.
        width: of the searches whose states are tested.
        most: states that are tested.

    Returns:
        `greedy` and `sampled`: shares of the states of a search from which the most probable actions, or one of 16
        drawn rollouts, reach the end.
    """

    def test(assembly: Assembly, robots: int, criterion: Criterion) -> dict[str, Any]:
        policy = remote.of(ContactGraph.from_assembly(assembly), robots, criterion)
        return _success(assembly, robots, criterion, policy, width, most)

    return _tested(name, test)


def guide_case(name: str, folder: Path) -> dict[str, Any]:
    """Search for a plan of one case with and without the policy of a run as a guide.

    Returns:
        `plans`: verdicts, seconds and whether a plan was found, by guide; `ratio` of the verdicts where both find one.
    """

    def test(assembly: Assembly, robots: int, criterion: Criterion) -> dict[str, Any]:
        policy = load_policy(folder, "cpu", assembly=assembly)
        return _verdicts(assembly, robots, criterion, policy.of_task(robots, equilibrium=criterion == "equilibrium"))

    return _tested(name, test)


def _tested(name: str, test: Callable[[Assembly, int, Criterion], dict[str, Any]]) -> dict[str, Any]:
    case, begun = CASES[name], time.perf_counter()
    row: dict[str, Any] = {"case": name, "group": case.group}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            assembly, robots, criterion = _load(case)
        except (FalseworkError, OSError) as error:
            return {**row, "error": str(error)[:200]}
    row |= {"parts": assembly.part_count, "robots": robots, "criterion": criterion}
    try:
        row |= test(assembly, robots, criterion)
    except FalseworkError as error:
        row["error"] = str(error)[:200]
    return {**row, "seconds": round(time.perf_counter() - begun, 1)}


def _load(case: Case) -> tuple[Assembly, int, Criterion]:
    if case.robots == 0:
        drawn = named(case.structure)
        return drawn.assembly, drawn.robots, drawn.criterion
    return load_structure(find(case.structure)), case.robots, case.criterion


def _success(
    assembly: Assembly, robots: int, criterion: Criterion, policy: PolicyFunction, width: int, most: int
) -> dict[str, Any]:
    end = time.perf_counter() + _SEARCH
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))
    environment = Environment(assembly, robots, oracle=oracle, device="cpu")
    task = environment.rules.task
    found, _ = search_states(task, HostOracle(oracle), width, 1, stop=lambda: time.perf_counter() > end)
    if not (found == environment.rules.complete()[0].numpy()).all(axis=1).any():
        planner = Planner(task, oracle, PlannerSettings(width), guide=SupportGuide(assembly))
        planner.run(stop=lambda: time.perf_counter() > end + _SEARCH)
        found = np.concatenate([found, *(route.states for route in planner.routes)])
    found = found[~environment.rules.reached(torch.from_numpy(found)).numpy()]
    if len(found) == 0:
        return {"states": 0}
    starts = torch.from_numpy(sample(found, max(8, min(most, _ROWS // assembly.part_count))))
    good = roll_out(environment, policy, starts, keep="ends").success
    greedy = float(good.float().mean())
    generator = environment.generator(0)
    for _ in range(_SAMPLES):
        rest = (~good).nonzero()[:, 0]
        if len(rest) == 0:
            break
        good[rest] = roll_out(environment, policy, starts[rest], greedy=False, generator=generator, keep="ends").success
    complete = environment.rules.complete()
    whole = bool(roll_out(environment, policy, complete, keep="ends").success[0])
    return {"states": len(starts), "greedy": greedy, "sampled": float(good.float().mean()), "from_complete": whole}


def _verdicts(assembly: Assembly, robots: int, criterion: Criterion, policy: Policy) -> dict[str, Any]:
    settings = PLANS if criterion == "contact" else StabilitySettings(criterion=criterion)
    task = make_task(assembly, robots)
    judged = task.judged_by(StabilityOracle(assembly, settings))
    plans = {}
    for name, guide in (("support", None), ("policy", PolicyGuide(policy, task=judged))):
        planning = find_plans(assembly, task, stability=settings, guide=guide, deadline=_PLAN, forces=False)
        counted = {"found": planning.found, "verdicts": planning.result.counters.asked}
        plans[name] = {**counted, "seconds": round(planning.result.seconds, 2)}
    asked = [plans[name]["verdicts"] for name in ("policy", "support")]
    both = all(one["found"] for one in plans.values())
    return {"plans": plans, "ratio": asked[0] / max(asked[1], 1) if both else None}

"""Fewest robots with every part held once, with holding again, and with props: one JSON object per structure.

    python benchmarks/support.py --structures dome-37 dome-90 vault --deadline 60

With every part held once, `min_robots` answers: `robots` is the fewest with which a plan was found, `least` the
number below which it is proven that none exists. For large structures `--robots` names a number with which a plan is
sought first, since that question spends its time on other numbers; it then has a quarter of the deadline. With holding
again and with props, a plan for one robot fewer is sought, and again for one fewer, each with a deadline; where none is
found, `robots` stays, since a plan without them is a plan. A single robot that releases a part gains nothing, so
holding again alone is not tried with one.

`ended` says why there is no answer with fewer robots: `proof` that no plan exists, `deadline`, or `search` where every
search ended without one. Small structures are searched exhaustively as well, by code that shares only the rules and the
verdicts with the planner. Where the structure has no floor of its own under most parts that could take a prop, it is
put on a ground for all questions.
"""

from __future__ import annotations

import resource
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from record import report, write_to
from states import find

from falsework import (
    Assembly,
    Outcome,
    PlannerSettings,
    StabilityOracle,
    find_plans,
    load_structure,
    make_task,
    min_robots,
)
from falsework.assembly import prop_places, with_props
from falsework.assembly.props import keep_props
from falsework.errors import AssemblyError
from falsework.search import ExhaustiveSearch
from falsework.search.beam.state_search import StateSearch
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.search.problem.result import SearchResult

SMALL = 20
"""Most parts, fixed ones and places for props included, of a structure that is searched exhaustively."""
STATES = 100_000
"""States after which an exhaustive search gives up."""


@dataclass(frozen=True)
class Options:
    """Structures, props and time limits."""

    structures: tuple[str, ...] = ("dome-37",)
    """Built-in names, paths, or names of real structures."""
    props: tuple[int, ...] = (1, 2)
    """Numbers of props."""
    robots: int | None = None
    """Number of robots with which a plan is sought first."""
    deadline: float = 60.0
    """Seconds per question."""
    seed: int = 0
    """Seed of the searches."""
    out: Path | None = None
    """File to which the records are appended."""


def places_of(assembly: Assembly) -> int:
    """Return the number of parts that a prop can support."""
    try:
        return len(prop_places(assembly))
    except AssemblyError:
        return 0


def once(options: Options, assembly: Assembly) -> dict[str, Any]:
    """Find the fewest robots that hold every part once; the plan is checked again."""
    begun, settings = time.perf_counter(), PlannerSettings(seed=options.seed)
    first = None
    if options.robots is not None:
        first = find_plans(assembly, robots=options.robots, settings=settings, deadline=options.deadline)
    share = options.deadline if first is None else options.deadline / 4
    found = min_robots(assembly, settings=settings, deadline=share)
    plan = found.plan
    if first is not None and first.found and (plan is None or plan.robots > first.plans[0].robots):
        plan = first.plans[0]
    robots = None if plan is None else plan.robots
    proven = found.certain if found.impossible else robots == found.bound
    return {
        "robots": robots,
        "least": found.bound,
        "impossible": found.impossible,
        "refuted": 0 if found.barrier is None else found.barrier.robots,
        "steps": None if plan is None else len(plan),
        "check": None if plan is None else validate_plan(plan, assembly).good,
        "ended": "proof" if proven else "deadline" if found.deadline_passed else "search",
        "verdicts": found.verdicts + (0 if first is None else first.result.counters.asked),
        "seconds": time.perf_counter() - begun,
    }


def fewer(options: Options, assembly: Assembly, known: dict[str, Any], **rules: Any) -> dict[str, Any]:
    """Search for plans with fewer robots than are known to suffice, as long as there are any.

    Sets of parts that some number of robots cannot cross are a proof for parts that are held again as well.
    """
    begun, props = time.perf_counter(), rules.get("props", 0)
    answer = {key: known[key] for key in ("robots", "steps", "check", "ended")} | {"verdicts": 0}
    while answer["robots"] > 1 and (props or answer["robots"] > 2):
        if not props and known["refuted"] >= answer["robots"] - 1:
            answer["ended"] = "proof"
            break
        found = find_plans(
            assembly,
            robots=answer["robots"] - 1,
            settings=PlannerSettings(seed=options.seed),
            deadline=options.deadline,
            allow_regrasp=True,
            **rules,
        )
        answer["verdicts"] += found.result.counters.asked
        if not found.found:
            answer["reached"] = found.result.reached / found.result.steps
            answer["ended"] = ending(found.result)
            break
        (plan,) = found.plans
        structure = structure_of_plan(plan, structure=keep_props(assembly, ()))
        good = validate_plan(plan, structure).good
        answer |= {"robots": plan.robots, "steps": len(plan), "check": good}
    if answer["robots"] == 1:
        answer["ended"] = "proof"
    return answer | {"seconds": time.perf_counter() - begun}


def ending(result: SearchResult) -> str:
    """Return why a search found no plan."""
    if result.outcome is Outcome.PROVED_IMPOSSIBLE:
        return "proof"
    return "deadline" if result.interrupted else "search"


def exhaustively(options: Options, assembly: Assembly, props: int | None) -> int | None:
    """Return the fewest robots for which an exhaustive search finds the target; None if there is no answer.

    Args:
        options: the deadline of each search.
        assembly: the structure.
        props: props that may be in place; None if every part is held once.
    """
    oracle, stop = StabilityOracle(assembly), deadline(options.deadline)
    for robots in range(1, assembly.part_count):
        if props is None:
            result = ExhaustiveSearch(make_task(assembly, robots), oracle, state_limit=STATES).run(stop=stop).result
        else:
            task = make_task(assembly, robots, allow_regrasp=True, props=props)
            result = StateSearch(task, oracle, state_limit=STATES).run(stop=stop)
        if result.found:
            return robots
        # Even where a state slides, which is no proof, the search has visited everything that it may.
        if stop() or result.limit.startswith("gave up"):
            return None
    return None


def deadline(seconds: float) -> Callable[[], bool]:
    """Return a function that tells whether some seconds have passed."""
    end = time.perf_counter() + seconds
    return lambda: time.perf_counter() > end


def measure(options: Options, name: str) -> None:
    """Answer all questions for one structure."""
    assembly = load_structure(find(name))
    own = places_of(assembly)
    grounded = assembly.with_ground()
    added = own < places_of(grounded) / 2
    assembly = grounded if added else assembly
    places = places_of(assembly)
    propped = with_props(assembly, prop_places(assembly)) if places else assembly
    answers, whole = {"once": once(options, assembly)}, {}
    if answers["once"]["robots"] is not None:
        known = answers["again"] = fewer(options, assembly, answers["once"])
        if assembly.part_count <= SMALL:
            whole = {"once": exhaustively(options, assembly, None), "again": exhaustively(options, assembly, 0)}
        for props in options.props if places and known["robots"] > 1 else ():
            known = answers[f"props_{props}"] = fewer(options, propped, known, props=props)
            if propped.part_count <= SMALL:
                whole[f"props_{props}"] = exhaustively(options, propped, props)
    report(
        "support robots",
        structure=name,
        seeds=[options.seed],
        parts=assembly.part_count,
        floor="added" if added else "own",
        places=places,
        deadline=options.deadline,
        **answers,
        **({"exhaustive": whole} if whole else {}),
        memory_gib=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    )


if __name__ == "__main__":
    chosen = tyro.cli(Options, description=__doc__)
    write_to(chosen.out)
    warnings.simplefilter("ignore")
    for structure in chosen.structures:
        measure(chosen, structure)

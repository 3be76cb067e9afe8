"""Fewest robots with every part held once, with holding again, and with props: one JSON object per structure.

    python benchmarks/support.py --structures dome-37 dome-90 vault --deadline 60

With every part held once, `robots_needed` answers: `robots` is the fewest with which a plan was found, `least` the
number below which it is proven that none exists. With holding again and with props, a plan for one robot fewer is
sought, and again for one fewer, each with a deadline; where none is found, `robots` stays, since a plan without them
is a plan. A single robot that releases a part gains nothing, so holding again alone is not tried with one.
Where the structure has no floor of its own under most parts that could take a prop, it is put on a ground for all
questions.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from record import report, write_to
from states import find

from falsework.assembly import Assembly, keep_props, load_structure, prop_places, with_props
from falsework.errors import AssemblyError
from falsework.search import PlannerSettings, find_plans, robots_needed, structure_of_plan, validate_plan


@dataclass(frozen=True)
class Options:
    """Structures, props and time limits."""

    structures: tuple[str, ...] = ("dome-37",)
    """Built-in names, paths, or names of real structures."""
    props: tuple[int, ...] = (1, 2)
    """Numbers of props."""
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
    begun = time.perf_counter()
    settings = PlannerSettings(seed=options.seed)
    found = robots_needed(assembly, settings=settings, deadline=options.deadline)
    return {
        "robots": found.robots,
        "least": found.least,
        "steps": None if found.plan is None else len(found.plan),
        "check": None if found.plan is None else validate_plan(found.plan, assembly).good,
        "verdicts": found.verdicts,
        "seconds": time.perf_counter() - begun,
    }


def fewer(options: Options, assembly: Assembly, known: dict[str, Any], **rules: Any) -> dict[str, Any]:
    """Search for plans with fewer robots than are known to suffice, as long as there are any."""
    begun, answer = time.perf_counter(), {key: known[key] for key in ("robots", "steps", "check")} | {"verdicts": 0}
    while answer["robots"] > 1 and (rules.get("props") or answer["robots"] > 2):
        found = find_plans(
            assembly,
            robots=answer["robots"] - 1,
            settings=PlannerSettings(seed=options.seed),
            deadline=options.deadline,
            support=True,
            **rules,
        )
        answer["verdicts"] += found.result.counters.asked
        if not found.found:
            answer["reached"] = found.result.reached / found.result.steps
            break
        (plan,) = found.plans
        structure = structure_of_plan(plan, structure=keep_props(assembly, ()))
        good = validate_plan(plan, structure).good
        answer |= {"robots": plan.robots, "steps": len(plan), "check": good}
    return answer | {"seconds": time.perf_counter() - begun}


def measure(options: Options, name: str) -> None:
    """Answer all questions for one structure."""
    assembly = load_structure(find(name))
    own = places_of(assembly)
    grounded = assembly.with_ground()
    added = own < places_of(grounded) / 2
    assembly = grounded if added else assembly
    places = places_of(assembly)
    answers = {"once": once(options, assembly)}
    if answers["once"]["robots"] is not None:
        known = answers["again"] = fewer(options, assembly, answers["once"])
        propped = with_props(assembly, prop_places(assembly)) if places else assembly
        for props in options.props if places and known["robots"] > 1 else ():
            known = answers[f"props_{props}"] = fewer(options, propped, known, props=props)
    report(
        "support robots",
        structure=name,
        seeds=[options.seed],
        parts=assembly.part_count,
        floor="added" if added else "own",
        places=places,
        deadline=options.deadline,
        **answers,
    )


if __name__ == "__main__":
    chosen = tyro.cli(Options, description=__doc__)
    write_to(chosen.out)
    warnings.simplefilter("ignore")
    for structure in chosen.structures:
        measure(chosen, structure)

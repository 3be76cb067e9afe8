"""Fewest robots with every part held once, with holding again, and with props: one JSON object for each structure.

    python benchmarks/support.py --structures dome-37 dome-90 vault --deadline 60

Each question is `robots_needed` with a deadline of its own, one after the other. `robots` is the fewest with which a
plan was found, `least` the number below which it is proven that none exists; with props that is not looked for. Where
at most two robots suffice with every part held once, holding again cannot save one (a single robot that lets a part go
is where it was before), and is not asked about. Where the structure has no floor of its own under most parts that could
take a prop, it is put on a ground for all questions.
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

from falsework.assembly import Assembly, load_structure, prop_places, with_props
from falsework.errors import AssemblyError
from falsework.search import PlannerSettings, RobotsNeeded, robots_needed, validate_plan
from falsework.search.plans.plan_source import structure_of_plan


@dataclass(frozen=True)
class Options:
    """What to run."""

    structures: tuple[str, ...] = ("dome-37",)
    """Built-in names, paths, or names of real structures."""
    props: tuple[int, ...] = (1, 2)
    """Numbers of props."""
    deadline: float = 60.0
    """Seconds for each question."""
    seed: int = 0
    """Of the searches."""
    out: Path | None = None
    """File to which the records are appended."""


def places_of(assembly: Assembly) -> int:
    """Number of parts that have a place for a prop."""
    try:
        return len(prop_places(assembly))
    except AssemblyError:
        return 0


def answer_of(found: RobotsNeeded, assembly: Assembly, seconds: float) -> dict[str, Any]:
    """Figures of an answer; its plan is checked anew."""
    good = None
    if found.plan is not None:
        good = validate_plan(found.plan, structure_of_plan(found.plan, structure=assembly)).good
    return {
        "robots": found.robots,
        "least": found.least,
        "proven": found.proven,
        "impossible": bool(found.impossible),
        "steps": None if found.plan is None else len(found.plan),
        "check": good,
        "verdicts": found.verdicts,
        "seconds": seconds,
    }


def measure(options: Options, name: str) -> None:
    """Ask all questions about one structure."""
    assembly = load_structure(find(name))
    own = places_of(assembly)
    grounded = assembly.with_ground()
    added = own < places_of(grounded) / 2
    assembly = grounded if added else assembly
    settings = PlannerSettings(seed=options.seed)

    def ask(structure: Assembly, **rules: Any) -> dict[str, Any]:
        begun = time.perf_counter()
        found = robots_needed(structure, settings=settings, deadline=options.deadline, **rules)
        return answer_of(found, assembly, time.perf_counter() - begun)

    answers = {"once": ask(assembly)}
    most = answers["once"]["robots"]
    if most is None or most > 2:
        answers["again"] = ask(assembly, support=True)
        fewer = answers["again"]["robots"]
        most = fewer if most is None or (fewer is not None and fewer < most) else most
    else:
        answers["again"] = {"robots": most, "least": answers["once"]["least"], "by_theorem": True}
    places = 0
    if most is None or most > 1:
        places = places_of(assembly)
        propped = with_props(assembly, prop_places(assembly)) if places else None
        for props in options.props if propped is not None else ():
            answers[f"props_{props}"] = ask(propped, support=True, props=props)
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

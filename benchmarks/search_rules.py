"""Rules of the search for plans, each with what switches it off, and the comparison of searches without one of them.

`luck.py --without` makes the same searches with the rules and without one of them; a rule whose absence changes nothing
can go. A rule is switched off by a patch of classes
or module constants in the process of the search, and a probe notes whether it took effect there. Where it took none,
the search without it is the same, step by step, and is not made.

Not among them: moves to supports and props, which none of these searches has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import Any

import numpy as np
from record import spread

Run = dict[str, Any]
"""Figures of one search."""
Note = Callable[[], None]
"""Called when a rule takes effect."""
Pair = tuple[Run, Run]
"""The same search with a rule and without it."""

ALL, EACH = "all", "each"
"""Names of all rules at once, and of one after the other."""
LEFT_OUT = {
    ("armadillo-399", 3, "contact"),
    ("armadillo-399", 4, "contact"),
    ("vault:parts=480,span=6,rise=1.5,thickness=0.15", 3, "contact"),
    ("vault:parts=480,span=6,rise=1.5,thickness=0.15", 4, "contact"),
}
"""Cases, by structure, robots and criterion, whose searches with all rules take too long to repeat them for each."""


@dataclass(frozen=True)
class Rule:
    """Rule of a search that can be switched off."""

    what: str
    """What it does, and what happens without it."""
    patch: Callable[[], None]
    """Switch it off in this process, for good."""
    probe: Callable[[Note], None]
    """Have it noted in this process when the rule takes effect: never where it is switched off."""


def _wrap(kind: Any, name: str, around: Callable[..., Any]) -> None:
    """Replace a function or method by one that is passed the former one and its arguments."""
    call = getattr(kind, name)

    @wraps(call)
    def wrapped(*arguments: Any, **named: Any) -> Any:
        return around(call, *arguments, **named)

    setattr(kind, name, wrapped)


def _answer(kind: Any, name: str, value: Any) -> None:
    """Have a function or method always return one value."""
    _wrap(kind, name, lambda *_, **__: value)


def _watch(kind: Any, name: str, note: Note, shows: Callable[..., Any]) -> None:
    """Have a rule noted when `shows` is true of a result of a function or method and of its arguments."""

    def around(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        result = call(*arguments, **named)
        if shows(result, *arguments, **named):
            note()
        return result

    _wrap(kind, name, around)


def _answers(module: str, kind: str, name: str, value: Any) -> Callable[[], None]:
    """Return a patch that has a method always return one value."""
    return lambda: _answer(_kind(module, kind), name, value)


def _shown_by(module: str, kind: str, name: str, shows: Callable[..., Any]) -> Callable[[Note], None]:
    """Return a probe of a method, see `_watch`."""
    return lambda note: _watch(_kind(module, kind), name, note, shows)


def _kind(module: str, name: str) -> Any:
    return getattr(import_module(f"falsework.{module}"), name)


_CONFLICTS = "search.beam.nogoods"
_SELECTION = "search.beam.selection"
_GUIDE, _MEMORY, _SOLVER = "search.problem.guide", "search.beam.failed_moves", "stability.cpu.solver"


def _patch_failures() -> None:
    from falsework.search.beam import beam

    _answer(beam, "FailedMoves", None)


def _patch_refuted() -> None:
    nothing = np.empty(0, dtype=np.int64)
    _answer(_kind(_CONFLICTS, "Nogoods"), "barred", (nothing, nothing))


def _patch_jumps() -> None:
    _answer(import_module(f"falsework.{_CONFLICTS}"), "luby", 1)


def _probe_jumps(note: Note) -> None:
    _watch(import_module(f"falsework.{_CONFLICTS}"), "luby", note, lambda distance, _: distance > 1)


def _patch_hopeful() -> None:
    _wrap(_kind(_SELECTION, "Selector"), "_hopeful_first", lambda _, this, fixed, count: fixed[:count])


def _patch_supports() -> None:
    from falsework.stability.cpu import solver

    def around(call: Callable[..., Any], this: Any, *given: Any, **named: Any) -> None:
        call(this, *given, **named)
        this.reach = 0

    _wrap(solver.CpuSolver, "__init__", around)


RULES: dict[str, Rule] = {
    "edges": Rule(
        "A beam closes free edges first, before all others; without it, the others begin.",
        _answers(_GUIDE, "SupportGuide", "edges_first", None),
        _shown_by(_GUIDE, "SupportGuide", "edges_first", lambda guide, *_: guide is not None),
    ),
    "beside-held": Rule(
        "Under `contact`, parts beside held ones are preferred.",
        _answers(_GUIDE, "SupportGuide", "held_neighbours", None),
        _shown_by(_GUIDE, "SupportGuide", "held_neighbours", lambda guide, *_: guide is not None),
    ),
    "failures": Rule(
        "Moves that failed with the same surroundings are tried last, a few of them at a level.",
        _patch_failures,
        _shown_by(_MEMORY, "FailedMoves", "failed", lambda failed, *_: failed.any()),
    ),
    "refuted": Rule(
        "A choice that led to a dead end is not made again; without it, only random numbers differ.",
        _patch_refuted,
        _shown_by(_CONFLICTS, "Nogoods", "barred", lambda found, *_: len(found[0])),
    ),
    "jumps": Rule(
        "Jumps back are of Luby's lengths; without it, each is as short as possible.",
        _patch_jumps,
        _probe_jumps,
    ),
    "hopeful": Rule(
        "Half of the states ahead are candidates that are not known to fall at once; without it, all are the best.",
        _patch_hopeful,
        _shown_by(
            _SELECTION, "Selector", "_hopeful_first", lambda kept, _, best, n: not np.array_equal(kept, best[:n])
        ),
    ),
    "supports": Rule(
        "Verdicts under `equilibrium` change forces in a region; without it, anywhere.",
        _patch_supports,
        _shown_by(_SOLVER, "CpuSolver", "__init__", lambda _, solver, *__, **___: solver.reach > 0),
    ),
}
"""Rules by their names."""


def parts_of(without: str) -> tuple[str, ...]:
    """Return the rules that are switched off, of names joined by `+`, or `all`; none of an empty name.

    Raises:
        ValueError: a name that no rule has.
    """
    names = tuple(RULES) if without == ALL else tuple(without.split("+")) if without else ()
    unknown = [name for name in names if name not in RULES]
    if unknown:
        raise ValueError(f"no rule is called {', '.join(unknown)}; there are {', '.join(RULES)}, {ALL} and {EACH}")
    return names


def each_of(asked: Sequence[str]) -> list[str]:
    """Return what is switched off at a time, of what was asked for; `each` is every rule by itself."""
    found = dict.fromkeys(name for one in asked for name in (RULES if one == EACH else (one,)))
    for name in found:
        parts_of(name)
    return list(found)


def switch_off(without: str) -> None:
    """Switch rules off in this process, for good."""
    for name in parts_of(without):
        RULES[name].patch()


def probe_all() -> set[str]:
    """Return a set to which the names of rules are added when these take effect in this process."""
    acts: set[str] = set()
    for name, rule in RULES.items():
        rule.probe(lambda name=name: acts.add(name))
    return acts


def acts_in(without: str, base: Run) -> bool:
    """Return whether rules took effect in a search with all of them, so that it may differ without; yes if unknown."""
    acts = base.get("acts")
    return acts is None or not set(acts).isdisjoint(parts_of(without))


def _shares(pairs: Sequence[Pair], holds: Callable[[Run], bool]) -> dict[str, float] | None:
    if not pairs:
        return None
    with_it, without = (float(np.mean([holds(pair[k]) for pair in pairs])) for k in (0, 1))
    return {"with": with_it, "without": without}


def _ratios(cases: Sequence[Sequence[Pair]], name: str) -> dict[str, float] | None:
    """Return the spread over cases of the ratio of medians, without a rule over with it; None where there is none."""
    medians = [[np.median([pair[k][name] for pair in some]) for k in (0, 1)] for some in cases]
    found = [float(without / with_it) for with_it, without in medians if with_it > 0]
    return spread(found) if found else None


def _alike(pair: Pair) -> bool:
    """Return whether both searches find a plan, with the same reserve."""
    return pair[0]["reserve"] is not None and pair[0]["reserve"] == pair[1]["reserve"]


def _names(cases: Sequence[Sequence[Pair]], k: int) -> str:
    """Write which cases one of both searches solves less often, how often of how many."""

    def write() -> Iterator[str]:
        for some in cases:
            solved = [sum(pair[side]["solved"] for pair in some) for side in (0, 1)]
            if solved[k] < solved[1 - k]:
                run = some[0][0]
                many = f"{solved[0]} to {solved[1]} of {len(some)}"
                yield f"{run['structure']}, {run['robots']} robots, {run['criterion']}: {many}"

    return "; ".join(write())


def comparison(pairs: Sequence[Pair], runs: int) -> Run:
    """Compare searches without a rule with those that have it.

    Args:
        pairs: searches in which the rule takes effect.
        runs: searches altogether.
    """
    groups: dict[tuple[Any, ...], list[Pair]] = {}
    for pair in pairs:
        groups.setdefault(tuple(pair[0][name] for name in ("structure", "robots", "criterion")), []).append(pair)
    both = [[pair for pair in some if _alike(pair)] for some in groups.values()]
    both = [some for some in both if some]
    seconds = [sum(pair[k]["processor_seconds"] for pair in pairs) for k in (0, 1)]
    return {
        "runs": runs,
        "acts": len(pairs),
        "cases": len(groups),
        "solved": _shares(pairs, lambda run: run["solved"]),
        "without_reserve": _shares(pairs, lambda run: run["ended"] == "found" and not run["solved"]),
        "only_with": sum(one["solved"] and not other["solved"] for one, other in pairs),
        "only_without": sum(other["solved"] and not one["solved"] for one, other in pairs),
        "both": sum(map(len, both)),
        "cost": _ratios(both, "cost"),
        "verdicts": _ratios(both, "verdicts"),
        "replayed": _ratios(both, "replayed"),
        "processor_seconds": _ratios(both, "processor_seconds"),
        "all_processor_seconds": {"with": seconds[0], "without": seconds[1]} if pairs else None,
        "lost": _names(list(groups.values()), 1),
        "gained": _names(list(groups.values()), 0),
    }

"""Rules of the search for plans, each with what switches it off, and the comparison of searches without one of them.

Most of these rules were made when robots could only hold still. `luck.py --without` makes the same searches with the
rules and without one of them; a rule whose absence changes nothing can go. A rule is switched off by a patch of classes
or module constants in the process of the search, and a probe notes whether it took effect there. Where it took none,
the search without it is the same, step by step, and is not made.

Not among them: moves to supports and props, which none of these searches has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from importlib import import_module
from itertools import pairwise
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
    ("vault:parts=250", 3, "contact"),
    ("armadillo-399", 3, "contact"),
    ("armadillo-399", 4, "contact"),
    ("armadillo-399", 4, "equilibrium"),
    ("pavilion-vault-387", 2, "contact"),
    ("pavilion-vault-387", 3, "contact"),
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


def _constant(module: str, name: str, value: Any) -> Callable[[], None]:
    """Return a patch of a constant of a module.

    Raises:
        AttributeError: when patching, if the module has no such constant.
    """

    def patch() -> None:
        found = import_module(f"falsework.{module}")
        getattr(found, name)
        setattr(found, name, value)

    return patch


def _answers(module: str, kind: str, name: str, value: Any) -> Callable[[], None]:
    """Return a patch that has a method always return one value."""
    return lambda: _answer(_kind(module, kind), name, value)


def _shown_by(module: str, kind: str, name: str, shows: Callable[..., Any]) -> Callable[[Note], None]:
    """Return a probe of a method, see `_watch`."""
    return lambda note: _watch(_kind(module, kind), name, note, shows)


def _kind(module: str, name: str) -> Any:
    return getattr(import_module(f"falsework.{module}"), name)


_ADAPTIVE, _BEAM, _SELECTION = "search.beam.adaptive", "search.beam.beam", "search.beam.selection"
_GUIDE, _MEMORY, _SOLVER = "search.problem.guide", "search.beam.failures", "stability.cpu.solver"


def _without_parts(name: str) -> Callable[[], None]:
    """Return a patch that leaves the parts of one setting out of the settings of all beams."""

    def patch() -> None:
        def around(call: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
            return replace(call(*arguments, **named), **{name: ()})

        _wrap(_kind(_ADAPTIVE, "AdaptiveSettings"), "beam", around)

    return patch


def _beam_has(shows: Callable[[Any], Any]) -> Callable[[Note], None]:
    """Return a probe that looks at the settings of each beam."""
    return _shown_by(_ADAPTIVE, "AdaptiveSettings", "beam", lambda beam, *_, **__: shows(beam))


def _patch_compact() -> None:
    def around(call: Callable[..., Any], this: Any, *stage: Any, **named: Any) -> Any:
        return call(this, *stage, **{**named, "compact": False})

    _wrap(_kind("search.settings", "PlannerSettings"), "attempts", around)


def _patch_failures() -> None:
    from falsework.search.beam import beam

    _answer(beam, "FailureMemory", None)


def _patch_hopeless() -> None:
    def around(_: Any, __: Any, first: Callable[[int], Any], wanted: int, ___: int) -> Any:
        return first(wanted)[:wanted]

    _wrap(_kind(_SELECTION, "Selector"), "_hopeful_first", around)


def _patch_few_ahead() -> None:
    def around(call: Callable[..., Any], this: Any, *arguments: Any, **named: Any) -> Any:
        return call(replace(this, few_ahead=False), *arguments, **named)

    _wrap(_kind(_ADAPTIVE, "AdaptiveSettings"), "beam", around)


def _probe_few_ahead(note: Note) -> None:
    from falsework.search.beam import adaptive

    _beam_has(lambda beam: beam.lookahead < vars(adaptive)["_LOOKAHEAD_STATES"])(note)


def _patch_in_turn() -> None:
    _wrap(_kind(_SELECTION, "Selector"), "_in_turn", lambda _, __, fixed: fixed)


def _patch_supports() -> None:
    from falsework.stability.cpu import solver

    def around(call: Callable[..., Any], this: Any, *given: Any, **named: Any) -> None:
        call(this, *given, **named)
        this.reaches = this.reaches[:1]

    _wrap(solver.CpuSolver, "__init__", around)


def last_fixed(beam: Any) -> tuple[int, int]:
    """Return the last level before a part was fixed on the way to the best scored state, and this part.

    -1 as the part, where none was.
    """
    from falsework.assembly.state import HELD

    for (after, row), (number, _) in pairwise(beam._way_back()):
        level = beam.levels[after]
        part = int(level.action[row]) % beam.task.part_count
        if level.states[row, part] == HELD:
            return number, part
    return 0, -1


def _patch_chain_start() -> None:
    _wrap(_kind(_BEAM, "BeamSearch"), "chain", lambda _, beam: last_fixed(beam))


def _trial_of(retreats: int) -> int:
    """Return which trial of one width comes after so many retreats."""
    return int(_kind(_ADAPTIVE, "AdaptiveSettings").trial(retreats)[1])


RULES: dict[str, Rule] = {
    "edges": Rule(
        "A beam closes free edges first, before all others; without it, the others begin.",
        _answers(_GUIDE, "SupportGuide", "edges_first", None),
        _shown_by(_GUIDE, "SupportGuide", "edges_first", lambda guide, *_: guide is not None),
    ),
    "compact": Rule(
        "A beam whose robots work in one place takes over after 16 deaths of the first; without it, that goes on.",
        _patch_compact,
        _beam_has(lambda beam: beam.compact),
    ),
    "beside-held": Rule(
        "Under `contact`, parts beside held ones are preferred.",
        _answers(_GUIDE, "SupportGuide", "beside_held", None),
        _shown_by(_GUIDE, "SupportGuide", "beside_held", lambda guide, *_: guide is not None),
    ),
    "gaps": Rule(
        "The beam of free edges comes back to place parts that filled gaps before those around them.",
        _answers(_ADAPTIVE, "AdaptiveBeam", "_close_gaps", False),
        _shown_by(_ADAPTIVE, "AdaptiveBeam", "_close_gaps", lambda came_back, *_: came_back),
    ),
    "early": Rule(
        "Parts that filled gaps are placed before those around them; without it, the beam only comes back for them.",
        _without_parts("early"),
        _beam_has(lambda beam: beam.early),
    ),
    "failures": Rule(
        "Moves that failed with the same surroundings are tried last, and so is what leaves nothing but such moves.",
        _patch_failures,
        _shown_by(_MEMORY, "FailureMemory", "failed", lambda failed, *_: failed.any()),
    ),
    "hopeless": Rule(
        "What leaves nothing but moves that failed before is tried last; without it, such moves themselves still are.",
        _patch_hopeless,
        _shown_by(_MEMORY, "FailureMemory", "hopeless", lambda hopeless, *_: hopeless.any()),
    ),
    "chain-start": Rule(
        "A beam that died comes back to where the chain of held parts began; without it, to where one was fixed last.",
        _patch_chain_start,
        _shown_by(_BEAM, "BeamSearch", "chain", lambda found, beam: found != last_fixed(beam)),
    ),
    "chains": Rule(
        "It begins another chain there eight times; without it, it comes back from farther at once.",
        _constant(_ADAPTIVE, "_CHAINS", 0),
        _shown_by(_ADAPTIVE, "AdaptiveBeam", "_widen", lambda on, beam, _: on and beam._failures > 0),
    ),
    "turns": Rule(
        "The end of each chain goes another way twice, from before the part that no robot lets go of.",
        _constant(_ADAPTIVE, "_TURNS", 0),
        _shown_by(_ADAPTIVE, "AdaptiveBeam", "_widen", lambda on, beam, _: on and beam._turns > 0),
    ),
    "trials": Rule(
        "The beam comes back from farther three times before it is widened; without it, it is widened at once.",
        _constant(_ADAPTIVE, "_TRIALS", 0),
        _shown_by(
            _ADAPTIVE, "AdaptiveSettings", "beam", lambda _, __, retreats=0, *___, **____: _trial_of(retreats) > 0
        ),
    ),
    "disorder": Rule(
        "It then has random preferences.",
        _constant(_ADAPTIVE, "_DISORDER", 0.0),
        _beam_has(lambda beam: beam.disorder > 0),
    ),
    "avoided": Rule(
        "Parts that led nowhere from a state are fixed there after all others, and those beside them late.",
        _without_parts("avoided"),
        _beam_has(lambda beam: beam.avoided),
    ),
    "doubt": Rule(
        "Parts beside those that led nowhere are fixed late.",
        _answers(_BEAM, "BeamSearch", "_beside", np.empty(0, dtype=np.intp)),
        _shown_by(_BEAM, "BeamSearch", "_beside", lambda parts, *_: len(parts)),
    ),
    "preferred": Rule(
        "A beam that comes back from farther fixes the parts first in which the chains began that led nowhere.",
        _without_parts("preferred"),
        _beam_has(lambda beam: beam.preferred),
    ),
    "episodes": Rule(
        "Where a part binds a robot in four hard places, the beam comes back from far before the first of them.",
        _answers(_ADAPTIVE, "AdaptiveBeam", "_left_too_long", -1),
        _shown_by(_ADAPTIVE, "AdaptiveBeam", "_left_too_long", lambda level, *_: level >= 0),
    ),
    "few-ahead": Rule(
        "Under `equilibrium`, the beam of free edges keeps 16 states ahead instead of 64 until it dies.",
        _patch_few_ahead,
        _probe_few_ahead,
    ),
    "in-turn": Rule(
        "After a death, states in which all robots hold parts are taken in turn, parts beside held ones first.",
        _patch_in_turn,
        _shown_by(_SELECTION, "Selector", "_in_turn", lambda rows, _, fixed: not np.array_equal(rows, fixed)),
    ),
    "supports": Rule(
        "Verdicts under `equilibrium` change forces along ways to supports; without it, near the change, or anywhere.",
        _patch_supports,
        _shown_by(_SOLVER, "CpuSolver", "__init__", lambda _, solver, *__, **___: len(solver.reaches) > 1),
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

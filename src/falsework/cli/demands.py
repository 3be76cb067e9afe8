"""Margins required of plans: shortfalls, and the margins of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from falsework.assembly.state import States
    from falsework.cli.output import Output
    from falsework.search.margins.demands import MarginOracle
    from falsework.search.plans.plan import Plan
    from falsework.search.problem.result import SearchResult
    from falsework.search.problem.task import Task

LOOKED_AT = 8
"""Largest number of states where a search stopped whose margins are measured."""
_HALVINGS = 8
"""Steps of a search for the largest load or placement error that one of them keeps."""


def refuse_weak_end(oracle: MarginOracle, task: Task, output: Output) -> bool:
    """Report a start or target of an assembly that does not keep the required margins: then there is no plan."""
    from falsework.search.problem.ends import end_subject

    for name, state in (("target", task.start), ("start", task.target)):
        broken = oracle.broken(state)
        if broken:
            lacks = shortfall(oracle, state[None])
            text = f"no plan was found: the {end_subject(task, state, name)} does not keep {broken}"
            output.record({"reason": text, "shortfall": lacks})
            output.note(f"falsework: {text}{_words(lacks)}")
            return True
    return False


def explain_shortfall(oracle: MarginOracle, result: SearchResult) -> tuple[dict[str, Any], str]:
    """Return by how much the states where a search stopped miss the required margins, as a record and in words."""
    import numpy as np

    from falsework.stability.oracle import StabilityOracle

    states = result.rejected[: 4 * LOOKED_AT]
    if len(states):
        plain = StabilityOracle(oracle.assembly, oracle.settings).verdicts(states)
        states = states[np.flatnonzero(plain.stable)][:LOOKED_AT]
    lacks = shortfall(oracle, states)
    return lacks, _words(lacks)


def shortfall(oracle: MarginOracle, states: States) -> dict[str, dict[str, float]]:
    """Return the required margins that no state keeps, with the best margin among the states; SI units.

    Args:
        states: shape (batch, parts); those that are stable as they are.
    """
    from falsework.search.margins.plan_margins import MEASURED

    kinds = [kind for kind in MEASURED if getattr(oracle.demands, kind) is not None]
    if not len(states):
        return {}
    found = oracle.margins(states, tuple(kinds)) if kinds else []
    lacks: dict[str, dict[str, float]] = {}
    for kind in kinds:
        values = [bound.value for bound in (getattr(margins, kind) for margins in found) if bound is not None]
        if kind == "friction":
            values = [None if not value else oracle.assembly.friction / value for value in values]
        wanted = getattr(oracle.demands, kind)
        if values and all(value is not None and value < wanted * 1.1 for value in values):
            lacks[kind] = {"best": max(value for value in values if value is not None), "demanded": wanted}
    for kind in ("load", "placement"):
        wanted = getattr(oracle.demands, kind)
        if wanted is not None and not _keeps(oracle, states, kind, wanted):
            lacks[kind] = {"best": _largest_kept(oracle, states, kind, wanted), "demanded": wanted}
    return lacks


def _largest_kept(oracle: MarginOracle, states: States, kind: str, wanted: float) -> float:
    """Return a value that a state keeps, by bisection on a logarithmic scale; 0 if none keeps a thousandth of it."""
    kept, lost = 0.0, wanted
    for _ in range(_HALVINGS):
        middle = (kept * lost) ** 0.5 if kept else 0.1 * lost
        if middle < 0.999e-3 * wanted:
            break
        if _keeps(oracle, states, kind, middle):
            kept = middle
        else:
            lost = middle
    return kept


def _keeps(oracle: MarginOracle, states: States, kind: str, value: float) -> bool:
    """Return whether one of the states keeps a margin of this kind."""
    from falsework.search.margins.demands import Demands, MarginOracle

    return bool(MarginOracle(oracle.assembly, oracle.settings, Demands(**{kind: value})).keeps(states).any())


def _words(lacks: dict[str, dict[str, float]]) -> str:
    from falsework.search.margins.demands import Demands

    return "".join(
        f"; the best of the states there has {Demands(**{kind: entry['best']})}, "
        f"{Demands(**{kind: entry['demanded']})} is demanded"
        for kind, entry in lacks.items()
    )


def margin_lines(plan: Plan) -> list[str]:
    """Return the margins of a plan, one line each."""
    from falsework.search.margins.plan_margins import quantity_text

    margins, lines = plan.margins, []
    if margins is None:
        return []
    if margins.demands:
        lines.append(f"every state keeps {margins.demands}")
    for kind in margins.measured:
        weakest = margins.weakest(kind)
        if weakest is None:
            lines.append(f"{kind}: no state has a bound")
            continue
        row, value = weakest
        place = f"step {row}, {plan.words(row)}" if row else "the start"
        lines.append(
            f"weakest {kind}: {quantity_text(kind, value)}{' needed' if kind == 'friction' else ''} at {place}"
        )
    if margins.maximised is not None and margins.bound is not None:
        most = "do with less friction" if margins.maximised == "friction" else f"bear more {margins.maximised}"
        lines.append(f"no plan can {most} than {quantity_text(margins.maximised, margins.bound)}")
    elif margins.maximised is not None:
        lines.append(f"how much better a plan can be in {margins.maximised} is not known")
    return lines

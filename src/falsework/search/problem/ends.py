"""Ends of a task: whether they stand, which a search takes for granted."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from falsework.assembly.state import States, complete_state
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Outcome, SearchCounters, SearchResult
from falsework.search.problem.task import Direction, Task
from falsework.stability.verdict import Verdict, Verdicts


def end_subject(task: Task, state: States, name: str) -> str:
    """Return what a message calls an end of a task: the complete structure, or else by its name."""
    return "complete structure" if np.array_equal(state, complete_state(task.boundary)) else f"{name} state"


def judged_as_built(oracle: Oracle, directions: Collection[Direction]) -> bool:
    """Return whether a search in some directions judges the start as it is built, so that it may slide from rest.

    What slides or is undecided from rest, with all loads at once, may stand once it is reached step by step
    (`Verdicts.depends_on_path`).
    """
    return oracle.replayer is not None and Direction.ASSEMBLY in directions


def judge_ends(task: Task, oracle: Oracle, directions: Collection[Direction] = ()) -> tuple[SearchResult | None, str]:
    """Judge the start and the target of a task.

    Args:
        directions: of the search, which say whether the start is judged as it is built, see `judged_as_built`.

    Returns:
        The failed search if one of them is not stable, else None; and what the start does from rest, in words, where
        it may stand only as it is built.
    """
    ends, doubt = np.stack([task.start, task.target]), ""
    verdicts = oracle.verdicts(ends)
    if len(stand := np.flatnonzero(verdicts.stable)):
        oracle.verdicts(ends[stand], require_certificate=True)  # asks whether they tip, which is known from then on
        verdicts.put(stand, oracle.verdicts(ends[stand]))
    if judged_as_built(oracle, directions) and verdicts.depends_on_path[0]:
        doubt = f"from rest the {end_subject(task, task.start, 'start')} {_words(oracle, verdicts, 0)}"
        verdicts.verdict[0] = Verdict.STABLE
    if verdicts.stable.all():
        verdicts.verdict[~oracle.keeps(ends)] = Verdict.SLIDES
    if verdicts.stable.all():
        return None, doubt
    row = int(np.argmin(verdicts.stable))
    subject = end_subject(task, ends[row], ("start", "target")[row])
    proved, moves = bool(verdicts.unstable[row]), bool((verdicts.slides | verdicts.tips)[row])
    words = _words(oracle, verdicts, row)
    failed = SearchResult(
        outcome=Outcome.PROVED_IMPOSSIBLE if proved else Outcome.NOT_FOUND,
        routes=(),
        direction=(Direction.DISASSEMBLY, Direction.ASSEMBLY)[row],
        steps=task.steps,
        reached=0,
        deepest=ends[:0],
        rejected=ends[row : row + 1],
        counters=SearchCounters(asked=2, rejected=int((~verdicts.stable).sum())),
        seconds=0.0,
        limit="" if proved else f"the {subject} {words}",
        undecided=int(verdicts.undecided[row]),
        sliding=int(moves),
        notes=(f"the {subject} {words}",),
    )
    return failed, doubt


def _words(oracle: Oracle, verdicts: Verdicts, row: int) -> str:
    return verdicts.kinds[row].words + (oracle.settings.under if oracle.settings is not None else "")

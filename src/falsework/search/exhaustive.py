"""Exhaustive search for small structures: proof that no plan exists, or the count of all plans."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from falsework.errors import InputError
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.ends import judge_ends
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Outcome, Progress, SearchResult, Stop
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction, Task


@dataclass(frozen=True, eq=False)
class ExhaustiveResult:
    """Result of an exhaustive search."""

    result: SearchResult
    complete: bool
    """Every stable state that the start leads to was found; the counts below are then final."""
    graph: StateGraph
    """All states found, with all valid actions between them."""

    @property
    def states(self) -> int:
        """Stable states that the start leads to, the start included."""
        return len(self.graph)

    @cached_property
    def plans(self) -> int:
        """Different action sequences from start to target; exact, however large."""
        return self.graph.count_routes()

    @cached_property
    def solvable_states(self) -> int:
        """Number of states from which the target can still be reached."""
        return int(self.graph.solvable.sum())


class ExhaustiveSearch:
    """Breadth-first search through every stable state that the start leads to.

    It is a beam search of unlimited width that gives up at a limit on the number of states. Where the start or the
    target is not stable, there is no plan and nothing is searched.
    """

    def __init__(self, task: Task, oracle: Oracle, *, state_limit: int = 1_000_000, name: str = "") -> None:
        """Begin at the start of the task.

        Args:
            state_limit: give up once more states than this were found.
            name: name of the structure, for the state graph.

        Raises:
            InputError: a limit below one.
        """
        if state_limit < 1:
            raise InputError(f"a limit of {state_limit} states allows no search; give at least 1")
        self.task = task = task.judged_by(oracle)
        self.state_limit = state_limit
        self.name = name
        settings = BeamSettings(width=state_limit, direction=Direction.DISASSEMBLY, diversity="none")
        self._oracle, self._beam = oracle, BeamSearch(task, oracle, settings)

    @property
    def gave_up(self) -> bool:
        """Whether the limit on states is exceeded."""
        kept = sum(len(level.states) for level in self._beam.levels)
        return kept > self.state_limit or not self._beam.exhaustive

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> ExhaustiveResult:
        """Search until every state is found, the limit is exceeded, or `stop` stops it.

        Args:
            progress: called after every level.
            stop: called before every level; true stops the search, which can then be run on.
        """
        result, _ = judge_ends(self.task, self._oracle)
        complete = result is not None
        if result is None:
            result = self._beam.run(progress=progress, stop=lambda: self.gave_up or (stop is not None and stop()))
            complete = self._beam.done and not self.gave_up
            if result.outcome is Outcome.PROVED_IMPOSSIBLE and not complete:
                result = replace(result, outcome=Outcome.NOT_FOUND)
            if self.gave_up:
                why = f"gave up after {self.state_limit} states; raise the limit or use a beam search"
                result = replace(result, limit=why, interrupted=False)
        return ExhaustiveResult(
            result, complete, StateGraph.from_states(self.task, self._beam.states(), name=self.name)
        )

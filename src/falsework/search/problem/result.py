"""Search result: outcome, routes, depth reached, and the limit that stopped the search."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, field
from enum import StrEnum
from operator import add
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, REMOVED, States, state_of_key
from falsework.errors import NotFoundError
from falsework.search.problem.task import Direction, Task
from falsework.utils.quantity import counted

T = TypeVar("T")

REPORTED_STATES = 64
"""States that a result has as deepest and as rejected, at most."""


class Outcome(StrEnum):
    """Outcome of a search."""

    FOUND = "found"
    """There is at least one plan, and it is in the result."""
    PROVED_IMPOSSIBLE = "proved_impossible"
    """Every reachable state was examined, under rules that exclude no possible action: there is no plan."""
    NOT_FOUND = "not_found"
    """The search was limited or interrupted before it found a plan; one may exist."""


class Result(Generic[T]):
    """Answer of a planner: the best value that it found, how certain the answer is, and what it took.

    All planners return one, with more about what they did: `find_plans`, `plan_robots`, `replan`, `min_robots`.
    """

    if TYPE_CHECKING:  # fields of some results, properties of others

        @property
        def value(self) -> T | None:
            """The best that was found; None where nothing was."""

        @property
        def outcome(self) -> Outcome:
            """Whether something was found, and if not, whether there is nothing."""

        @property
        def bound(self) -> float | None:
            """What no value can be better than, in the unit of what is optimised; None where no bound is known."""

        @property
        def statistics(self) -> Mapping[str, Any]:
            """Work of the search: `seconds`, `verdicts` and others."""

        @property
        def reason(self) -> str:
            """Why there is no value, in words; empty where there is one."""

        @property
        def unreserved(self) -> str:
            """Reason of the search with the reserve that was asked for, where the value is of one without it."""

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__}: {self.outcome.value}, {self.reason if self.value is None else repr(self.value)}>"
        )

    @property
    def found(self) -> bool:
        """Whether there is a value."""
        return self.outcome is Outcome.FOUND

    def unwrap(self) -> T:
        """Return the value.

        Raises:
            NotFoundError: there is none; the message says why.
        """
        value = self.value
        if value is None:
            proved = self.outcome is Outcome.PROVED_IMPOSSIBLE
            what = "it is proved that there is none" if proved else "none was found, which proves nothing"
            raise NotFoundError(f"{what}: {self.reason}" if self.reason else what)
        return value


@dataclass(frozen=True, eq=False)
class Route:
    """Sequence of states from the start to the target of a task, in disassembly order."""

    states: States
    """Shape (steps + 1, parts)."""
    actions: NDArray[np.int64]
    """Shape (steps,)."""

    @classmethod
    def from_states(cls, states: States) -> Route:
        """Return the route through consecutive states, each one move from the next, in disassembly order.

        Action `i` holds part `i`, or with repeated holds releases it if it is held; `parts + i` removes it, or places
        it if it is a prop.
        """
        before, after = states[:-1], states[1:]
        # Of several parts that a step removes, it is named after the first that is held.
        changed = before != after
        held = changed & ((before == HELD) | (after == HELD))
        part = np.where(held.any(axis=1), held.argmax(axis=1), changed.argmax(axis=1))
        rows = np.arange(len(after))
        holds = (before[rows, part] != REMOVED) & (after[rows, part] != REMOVED)
        return cls(states, np.where(holds, part, part + states.shape[1]).astype(np.int64))

    @classmethod
    def back_from(cls, last: States, parent: Mapping[bytes, bytes], direction: Direction) -> Route:
        """Return the route to a state through the states that each was reached from; the first has none.

        Args:
            last: shape (parts,).
            parent: by the bytes of a state those of the one before; empty ones for the first.
            direction: of the search that reached it.
        """
        chain, key = list[States](), last.tobytes()
        while key:
            chain.append(state_of_key(key))
            key = parent[key]
        return cls.from_states(np.array(chain if direction is Direction.ASSEMBLY else chain[::-1]))

    def __repr__(self) -> str:
        return f"<Route of {counted(len(self.actions), 'step')}>"

    def removal_rank(self) -> NDArray[np.int64]:
        """Return for each part the number removed before it, or -1 if it stays. Shape (parts,).

        Parts that leave in one step have the same rank.
        """
        gone = (self.states == REMOVED) & (self.states[0] != REMOVED)
        before = gone.sum(axis=1)[np.maximum(gone.argmax(axis=0) - 1, 0)]
        return np.where(gone[-1], before, -1)

    def insertion_steps(self, task: Task) -> tuple[int, ...]:
        """Return the steps of assembly before the first, second, ... missing part of a task is inserted. Ascending.

        A step that inserts several parts counts as `Task.steps_done` counts it, and as if the missing one came last.
        """
        states = self.states[::-1]
        after = (states[:, list(task.missing)] != REMOVED).argmax(axis=0)
        return tuple(sorted((task.steps - task.steps_done(states[after]) - 1).tolist()))


def barred_row(row: int, count: int) -> int | None:
    """Return which state to exclude where a sequence of some states fails in one; None if it has only ends.

    Both ends belong to every sequence, so if one fails, it is the state next to it.
    """
    return min(max(row, 1), count - 2) if count > 2 else None


def beam_failure(
    width: int, exhaustive: bool, undecided: int, sliding: int = 0, caveat: str = ""
) -> tuple[Outcome, str]:
    """Return the outcome of a beam that died out, and the limit that it met, if any.

    Args:
        width: states that it keeps a level.
        exhaustive: it never omitted one.
        undecided: states that could be proved neither stable nor unstable.
        sliding: states in equilibrium for which no displacement was found.
        caveat: why the rules of the task may be too strict; see `Task.caveat`.
    """
    if not exhaustive:
        return Outcome.NOT_FOUND, f"the beam has a width of {width}; a wider one may find a plan"
    if undecided:
        return (
            Outcome.NOT_FOUND,
            f"{counted(undecided, 'state')} could be proved neither stable nor unstable",
        )
    if sliding:
        slide = "1 state slides" if sliding == 1 else f"{sliding} states slide"
        return Outcome.NOT_FOUND, f"no plan was found in which every state is stable: {slide}"
    if caveat:
        return Outcome.NOT_FOUND, caveat
    return Outcome.PROVED_IMPOSSIBLE, ""


@dataclass(frozen=True)
class SearchCounters:
    """Work counters of a search."""

    states: int = 0
    """Number of stable states in the beam."""
    candidates: int = 0
    """Number of distinct successors of these states."""
    asked: int = 0
    """Number of verdicts requested from the oracle."""
    rejected: int = 0
    """Of these, not stable."""
    work: int = 0
    """Work of verdicts, see `CountingOracle.work`."""

    def __add__(self, other: SearchCounters) -> SearchCounters:
        return SearchCounters(*map(add, astuple(self), astuple(other)))


@dataclass(frozen=True)
class SearchProgress:
    """Progress of a running search."""

    direction: Direction
    level: int
    """Steps between the origin of the search and where it works now."""
    levels: int
    """Steps of a whole plan."""
    kept: int
    """Number of states at this level."""
    width: int
    """Width of the beam; 0 if unlimited."""
    asked: int
    """Number of verdicts requested so far."""
    seconds: float
    """Since the search began or was resumed."""

    @property
    def share(self) -> float:
        """How far the search is, from 0 to 1."""
        return self.level / max(self.levels, 1)

    @property
    def words(self) -> str:
        """The progress on one line."""
        backwards = self.direction is Direction.DISASSEMBLY
        doing = f"width {self.width}, {progress_text(self.level, self.levels, backwards=backwards)}"
        return f"{doing}, {counted(self.kept, 'state')} kept, {counted(self.asked, 'verdict')}"


Progress = Callable[[SearchProgress], None]
Stop = Callable[[], bool]


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of a search, successful or not."""

    outcome: Outcome
    routes: tuple[Route, ...]
    direction: Direction
    steps: int
    """Steps of a whole plan."""
    reached: int
    """Steps from the origin of the search to the deepest states that it found."""
    deepest: States
    """Some of the deepest states, shape (count, parts)."""
    rejected: States
    """States one step further than `deepest` that are not stable, shape (count, parts): where the search stopped."""
    counters: SearchCounters
    seconds: float
    interrupted: bool = False
    """Stopped from outside, by the keyboard or by `stop`; the search can be resumed."""
    limit: str = ""
    """Reason why a search that found nothing is not a proof, in words; empty otherwise."""
    undecided: int = 0
    """Rejected states for which neither verdict could be proved; above 0 they forbid a proof of impossibility."""
    sliding: int = 0
    """Rejected states that slide under the criterion `contact`: forces in equilibrium exist, and no displacement was
    found that produces them. Above 0 they forbid a proof of impossibility too."""
    notes: tuple[str, ...] = field(default=())

    def __repr__(self) -> str:
        return f"<SearchResult: {self.outcome.value}, step {self.reached} of {self.steps} reached>"

    @property
    def found(self) -> bool:
        """Whether there is a plan in the result."""
        return self.outcome is Outcome.FOUND

    def unless_interrupted(self, stop: Stop | None = None) -> SearchResult:
        """Return the result of a search within another, unless the keyboard ended it, and not its own `stop`.

        Raises:
            KeyboardInterrupt: from the keyboard; the search itself has ended in good order and only reports it.
        """
        if self.interrupted and not (stop is not None and stop()):
            raise KeyboardInterrupt
        return self


def progress_text(reached: int, steps: int, *, backwards: bool) -> str:
    """Say how far a search came, in steps of assembly.

    Args:
        reached: steps that it completed from where it began.
        steps: steps of a whole plan.
        backwards: whether it began at the end of the assembly.
    """
    if backwards:
        return f"from the end of the assembly, the search came back to step {steps - reached} of {steps}"
    return f"from the beginning, the search reached step {reached} of {steps}"

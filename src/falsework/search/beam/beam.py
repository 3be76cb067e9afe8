"""Beam search in either direction, with diversity by clustering (paper, section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, States, held_count
from falsework.errors import InputError
from falsework.search.beam.failed_moves import FailedMoves
from falsework.search.beam.frontier import Frontier, Level, expand, pack
from falsework.search.beam.histories import ReplaySummary
from falsework.search.beam.level_search import LevelSearch
from falsework.search.beam.nogoods import Nogoods
from falsework.search.beam.paths import BeamPaths
from falsework.search.beam.scores import Scores
from falsework.search.beam.selection import Selector
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.result import REPORTED_STATES, Outcome, SearchCounters, SearchResult, beam_failure
from falsework.search.problem.task import Direction, Task


class BeamSearch(LevelSearch):
    """Beam search that can be stepped, interrupted, packed and resumed."""

    def __init__(
        self, task: Task, oracle: Oracle, settings: BeamSettings = BeamSettings(), *, guide: Guide | None = None
    ) -> None:
        """Begin at the origin of the direction; the start and the target are taken as stable.

        Args:
            task: rules between start and target.
            oracle: decides stability.
            settings: width, direction and how states are chosen.
            guide: scores actions; without it only diversity decides.
        """
        task = task.judged_by(oracle)
        # Only a beam that looks ahead confirms the ways to its states; one that judges whole levels has no histories.
        histories = settings.direction is Direction.ASSEMBLY and settings.lookahead > 0
        replayer = getattr(oracle, "replayer", None) if histories else None
        if replayer is not None:
            task = replace(task, holds_keep_stable=True)  # with a history, a part that is fixed changes no force
        super().__init__(task, settings)
        self.levels = self._levels
        self._whole: list[bool] = []
        """For each level after the first, and for the attempt at the next if dead: no stable state was left out."""
        self._judge = CountingOracle(oracle)
        if replayer is not None:  # candidates are replayed: see `Selector.select_lazily`
            self._judge.screen = getattr(oracle, "plausible", None)
        self._paths = BeamPaths(self.levels, self._judge, replayer)
        self._failures = None if task.neighbours is None else FailedMoves(task.neighbours)
        self._guide = guide
        self.conflicts = Nogoods()
        """Dead ends, which a search that jumps back adds to."""
        self._hash = StateHash.for_parts(task.part_count)
        self._candidates = 0
        self._farthest = 0
        self._deepest = np.empty((0, task.part_count), dtype=np.uint8)
        self._rejected = np.empty((0, task.part_count), dtype=np.uint8)
        self._before = SearchCounters()
        self._undecided = self._sliding = 0
        origin = task.origin(settings.direction)[None]
        if task.contains(origin)[0]:
            one = np.ones(1, np.int8)
            self.levels.append(Level(origin, np.zeros(1, np.int64), np.full(1, -1, np.int64), np.zeros(1), one))
        else:
            self._dead = True

    @property
    def exhaustive(self) -> bool:
        """Whether no state was left out so far: if so and the search is dead, there is no plan."""
        return all(self._whole)

    @property
    def asked(self) -> int:
        """Verdicts requested so far, earlier runs included."""
        return self._before.asked + self._judge.asked

    @property
    def counters(self) -> SearchCounters:
        """Work done so far, earlier runs included; takes time with the levels, unlike `asked`."""
        now = SearchCounters(0, self._candidates, self._judge.asked, self._judge.rejected)
        return self._before + now + SearchCounters(states=sum(len(level.parent) for level in self.levels))

    def step(self) -> bool:
        """Find the next level; False if there is none.

        An interruption from the keyboard leaves the search as it was before the step.
        """
        if self.done:
            return False
        settings, level = self.settings, self.levels[-1]
        frontier = expand(self.task, settings.direction, level.states, self._hash)
        refuted = frontier.without(*self.conflicts.barred(level.states)) if settings.lookahead > 0 else False
        scores = self._scores(frontier, level.score)
        rng = np.random.default_rng((settings.seed, settings.number, len(self.levels)))
        how = settings.diversity == "k-means", settings.pool, rng
        selector = Selector(frontier, scores, *how, self._paths.stable_ancestors(), self._failures)
        verifier, sliding = self._paths.verifier(frontier), self._judge.sliding
        if settings.lookahead > 0:
            choice = selector.select_lazily(
                self._judge,
                settings.width,
                settings.lookahead,
                verifier,
                commit=settings.commit,
            )
        else:
            choice = selector.select_from_all(self._judge, settings.width)
        self._candidates += len(frontier)
        self._dead = len(choice.kept) == 0
        if self._dead and len(self.levels) > self._farthest:
            self._farthest = len(self.levels)
            self._deepest = level.states[:REPORTED_STATES]
            self._rejected = frontier.states(choice.rejected[:REPORTED_STATES])
        # A state refused because of the way to it may be reached by another, which was merged with this one, unless it
        # is unstable however it is reached.
        whole = choice.exhaustive and not refuted and all(self._whole[: len(self.levels) - 1])
        if whole and verifier.refused:
            rejected = choice.rejected
            whole = self._judge.unstable(frontier.states(rejected), level.states[frontier.parent(rejected)])
            if whole:
                self._judge.sliding = sliding
        self._whole = [*self._whole[: len(self.levels) - 1], whole]
        if self._dead:
            return False
        kept = choice.kept
        waits = frontier.fixes(kept) & ~frontier.free(kept) & (settings.lookahead > 0)
        columns = (frontier.states(kept), frontier.parent(kept), frontier.action(kept), scores.of(kept))
        self.levels[-1] = pack(level)
        self.levels.append(Level(*columns, np.where(waits, 0, 1).astype(np.int8)))
        if self.found and not self._paths.stable(np.arange(len(kept))).any():
            self.levels.pop()
            self._dead = True
            return False
        if self._paths.replays is not None:
            self._paths.replays.keep(kept)
        return True

    def _scores(self, frontier: Frontier, before: NDArray[np.float64]) -> Scores:
        """Return the scores of candidates."""
        guide = None
        if self._guide is not None:
            guide = np.asarray(self._guide(frontier.level, frontier.legal, self.settings.direction))
            if guide.shape != frontier.moves.shape:
                raise InputError(f"the guide returned scores of shape {guide.shape}; expected {frontier.moves.shape}")
        return Scores(frontier, before, guide)

    def replay_summary(self) -> ReplaySummary | None:
        """Return the replay of the route found, see `Histories.summary`; None where no histories are kept."""
        replays = self._paths.replays
        return None if replays is None or not self.found else replays.histories.summary(0)

    def choices(self) -> Iterator[tuple[int, int]]:
        """Yield the choices on the way to the best scored state of the last level that led to a dead end, latest first.

        Yields:
            Level and the action chosen there: first those that fixed the parts that robots hold in all states of the
            last level, then the first of each chain of held parts before.
        """
        bound = (self.levels[-1].states == HELD).all(axis=0) & (self.task.origin(self.settings.direction) != HELD)
        fewest, held_after, action = self.task.robots, 0, -1
        for number, row in self._backtrace():
            state = self.levels[number].states[row]
            held = int(held_count(state[None], self.task.boundary)[0])
            bound, binds = bound & (state == HELD), (bound & (state != HELD)).any()
            if binds or (not bound.any() and held <= fewest and held < held_after):
                yield number, action
            if not bound.any():
                fewest = min(fewest, held)
            held_after, action = held, int(self.levels[number].action[row])

    def before(self, number: int) -> States:
        """Return the state at a level on the way to the best scored one, shape (parts,)."""
        row = next(row for level, row in self._backtrace() if level == number)
        return self.levels[number].states[row]

    def _backtrace(self) -> Iterator[tuple[int, int]]:
        """Yield levels and rows of the way to the best scored state of the last level, that state first."""
        row = 0
        for number in range(len(self.levels) - 1, -1, -1):
            yield number, row
            row = int(self.levels[number].parent[row])

    def rewind(self, level: int, settings: BeamSettings) -> None:
        """Discard all levels after `level` and continue from there with other settings.

        Raises:
            InputError: settings for the other direction, or a level that was not reached.
        """
        if settings.direction is not self.settings.direction or not 0 <= level < len(self.levels):
            raise InputError(f"cannot rewind a beam search of {len(self.levels)} levels to level {level}")
        if self._paths.replays is not None:
            self._paths.replays.rewind(level)
        del self.levels[level + 1 :]
        self.settings = settings
        del self._whole[level:]
        self._dead = False

    def _advance(self) -> None:
        self.step()

    @property
    def _asked(self) -> int:
        return self._judge.asked

    def forbid(self, states: States) -> None:
        """Rule states out from now on, and take the search back to where none of them is on the way.

        Args:
            states: shape (count, parts).
        """
        keys = {state.tobytes() for state in states}
        self._judge.forbidden |= keys
        for number, level in enumerate(self.levels):
            if any(state.tobytes() in keys for state in level.states):
                self._whole = [*self._whole[:number], *([False] * (len(self.levels) - number))]
                self.rewind(max(number - 1, 0), self.settings)
                return

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the state of the search: plain values, and arrays."""
        header: dict[str, Any] = {
            "task": self.task.to_dict(),
            "settings": asdict(self.settings),
            "counters": asdict(self.counters) | {"states": 0},
            "seconds": self._seconds,
            "undecided": self._judge.undecided + self._undecided,
            "sliding": self._judge.sliding + self._sliding,
            "whole": self._whole,
            "dead": self._dead,
            "farthest": self._farthest,
            "conflicts": self.conflicts.count,
            "refuted": self.conflicts.refuted,
        }
        arrays: dict[str, NDArray[Any]] = {
            "states": self.states(),
            "sizes": np.array([len(level.parent) for level in self.levels], dtype=np.int64),
            "deepest": self._deepest,
            "rejected": self._rejected,
        }
        for name in ("parent", "action", "score", "grounded"):
            arrays[name] = np.concatenate([getattr(level, name) for level in self.levels] or [np.empty(0)])
        known = {} if self._failures is None else self._failures.known
        arrays["tried"] = np.array(list(known), dtype=np.uint64)
        arrays["failed"] = np.array(list(known.values()), dtype=bool)
        return header, arrays

    @classmethod
    def unpack(
        cls,
        header: dict[str, Any],
        arrays: dict[str, NDArray[Any]],
        task: Task,
        oracle: Oracle,
        *,
        guide: Guide | None = None,
    ) -> BeamSearch:
        """Return the search that `pack` described.

        Raises:
            KeyError, TypeError, ValueError: not what `pack` returned for this task.
        """
        settings = dict(header["settings"])
        settings["direction"] = Direction(settings["direction"])
        search = cls(task, oracle, BeamSettings(**settings), guide=guide)
        sizes = arrays["sizes"]
        if len(sizes) > task.steps + 1 or any(
            len(arrays[name]) != sizes.sum() for name in ("states", "parent", "action", "score", "grounded")
        ):
            raise ValueError("levels of different sizes")
        ends = np.cumsum(sizes)[:-1]
        columns = [np.split(arrays[name], ends) for name in ("states", "parent", "action", "score", "grounded")]
        search.levels[:] = [Level(*column) for column in zip(*columns, strict=True)] if len(sizes) else []
        if search._failures is not None:
            search._failures.known.update(zip(arrays["tried"].tolist(), arrays["failed"].tolist(), strict=True))
        search._before = SearchCounters(**header["counters"])
        search._seconds, search._undecided = float(header["seconds"]), int(header["undecided"])
        search._sliding = int(header["sliding"])
        search._dead, search._whole = bool(header["dead"]), [bool(flag) for flag in header["whole"]]
        search._deepest, search._rejected = arrays["deepest"], arrays["rejected"]
        search._farthest = int(header["farthest"])
        search.conflicts.count = int(header["conflicts"])
        search.conflicts.refuted = {state: [int(one) for one in some] for state, some in header["refuted"].items()}
        return search

    def result(self, *, interrupted: bool = False) -> SearchResult:
        """As `LevelSearch.result`."""
        undecided, limit = self._judge.undecided + self._undecided, ""
        sliding = self._judge.sliding + self._sliding
        outcome = Outcome.FOUND if self.found else Outcome.NOT_FOUND
        if not self.found and not interrupted:
            outcome, limit = beam_failure(self.settings.width, self.exhaustive, undecided, sliding, self.task.caveat)
        # A beam that was taken back may be less far now than where it died before.
        farther_now = len(self.levels) > self._farthest
        return SearchResult(
            outcome=outcome,
            routes=(self.route(),) if self.found else (),
            direction=self.settings.direction,
            steps=self.task.steps,
            reached=max(len(self.levels), self._farthest, 1) - 1,
            deepest=self.levels[-1].states[:REPORTED_STATES] if farther_now else self._deepest,
            rejected=self._rejected[:0] if farther_now else self._rejected,
            counters=self.counters,
            seconds=self._seconds,
            interrupted=interrupted,
            limit=limit,
            undecided=undecided,
            sliding=sliding,
        )

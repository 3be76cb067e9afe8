"""Beam search in either direction, with diversity by clustering (paper, section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, held_count
from falsework.errors import InputError
from falsework.search.beam.failures import FailureMemory
from falsework.search.beam.frontier import Frontier, Level, expand, pack
from falsework.search.beam.level_search import LevelSearch
from falsework.search.beam.scores import Scores
from falsework.search.beam.selection import Selector
from falsework.search.beam.settings import BeamSettings
from falsework.search.beam.ways import BeamWays
from falsework.search.problem.guide import Guide
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.result import Outcome, SearchCounters, SearchResult, beam_failure
from falsework.search.problem.task import Direction, Task
from falsework.stability.holds import Press

_RETREAT_LEVELS = 8
"""Levels that a beam goes back when it is tried again ..."""
_RETREAT_FACTOR = 4
"""... and this many times more each further time."""
_RELUCTANCE, _DOUBT, _PREFERENCE = 1.0, 0.5, 0.5
"""Scores of a guide are shares of 1; fixing a part that is avoided counts so much less, one beside it that much less,
one preferred so much more."""
_CHAIN_LEVELS = 128
"""Levels back from the last at most to where a chain of held parts began."""
_REPORTED_STATES = 64
"""States handed back as deepest and as rejected, at most."""


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
        if replayer is not None:  # candidates are replayed: see `Selector.most_promising`
            self._judge.screen = getattr(oracle, "plausible", None)
        self._ways = BeamWays(self.levels, self._judge, replayer)
        self._failures = None if task.neighbours is None else FailureMemory(task.neighbours)
        self._guide = guide
        self._hash = StateHash.for_parts(task.part_count)
        self._candidates = 0
        self._farthest = 0
        self._deepest = np.empty((0, task.part_count), dtype=np.uint8)
        self._rejected = np.empty((0, task.part_count), dtype=np.uint8)
        self._retried = 0
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
        scores = self._scores(frontier, level.score)
        rng = np.random.default_rng((settings.seed, self._retried, len(self.levels)))
        how = settings.diversity == "k-means", settings.pool, rng
        selector = Selector(frontier, scores, *how, self._ways.stable_before(), self._failures)
        confirmed, sliding = self._ways.confirmation(frontier), self._judge.sliding
        if settings.lookahead > 0:
            choice = selector.most_promising(
                self._judge,
                settings.width,
                settings.lookahead,
                confirmed,
                commit=settings.commit,
                in_turn=settings.number > 0,
                compact=settings.compact,
                early=settings.early,
            )
        else:
            choice = selector.all_judged(self._judge, settings.width)
        self._candidates += len(frontier)
        self._dead = len(choice.kept) == 0
        if self._dead and len(self.levels) > self._farthest:
            self._farthest = len(self.levels)
            self._deepest = level.states[:_REPORTED_STATES]
            self._rejected = frontier.states(choice.rejected[:_REPORTED_STATES])
        # A state refused because of the way to it may be reached by another, which was merged with this one, unless it
        # is unstable however it is reached.
        whole = choice.exhaustive and all(self._whole[: len(self.levels) - 1])
        if whole and confirmed.refused:
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
        if self.found and not self._ways.stable(np.arange(len(kept))).any():
            self.levels.pop()
            self._dead = True
            return False
        if self._ways.replays is not None:
            self._ways.replays.keep(kept)
        return True

    def _scores(self, frontier: Frontier, before: NDArray[np.float64]) -> Scores:
        """Return the scores of candidates, by the guide and by what the settings say of parts."""
        settings, guide, moved = self.settings, None, None
        if self._guide is not None:
            guide = np.asarray(self._guide(frontier.level, frontier.legal, settings.direction))
            if guide.shape != frontier.moves.shape:
                raise InputError(f"the guide returned scores of shape {guide.shape}; expected {frontier.moves.shape}")
        fixed = []
        avoided, preferred = settings.avoided, settings.preferred
        weights = (avoided, -_RELUCTANCE), (self._beside(avoided), -_DOUBT), (preferred, _PREFERENCE)
        for parts, weight in weights:
            if len(parts):
                fixed.append(np.zeros(self.task.part_count))
                fixed[-1][list(parts)] = weight
        if settings.disorder > 0:
            draw = np.random.default_rng((settings.seed, settings.number))
            moved = draw.uniform(-settings.disorder, settings.disorder, self.task.part_count)
        return Scores(frontier, before, guide, tuple(fixed), moved)

    def replay_summary(self) -> tuple[float, int, None, tuple[tuple[Press, ...], ...]] | None:
        """Return the replay of the route found, see `Histories.summary`; None where no histories are kept."""
        replays = self._ways.replays
        return None if replays is None or not self.found else replays.histories.summary(0)

    def _beside(self, parts: tuple[int, ...]) -> NDArray[np.intp]:
        """Return the parts in contact with some others, those left out."""
        if self.task.neighbours is None or not parts:
            return np.empty(0, dtype=np.intp)
        return np.setdiff1d(np.flatnonzero(self.task.neighbours[list(parts)].any(axis=0)), parts)

    def binding(self) -> list[tuple[int, int]]:
        """Return where the parts were fixed that all states of the last level hold.

        Returns:
            The level before and the part, of each on the way to the best scored state; that held longest comes first.
        """
        held = (self.levels[-1].states == HELD) & (self.task.origin(self.settings.direction) != HELD)
        common, found = held.all(axis=0), []
        for number, row in islice(self._way_back(), 1, None):
            still = common & (self.levels[number].states[row] == HELD)
            found += [(number, int(part)) for part in np.flatnonzero(common & ~still)]
            common = still
        return found[::-1]

    def chain(self) -> tuple[int, int]:
        """Return where the last chain of parts began that were held one after the other until the next ones carried it.

        Returns:
            The last level near the end at which robots held fewest parts, and the part fixed there on the way to the
            best scored state, -1 where the beam did not leave its origin.
        """
        last = len(self.levels) - 1
        begun, part, fewest, action = last, -1, np.inf, -1
        for number, row in islice(self._way_back(), _CHAIN_LEVELS):
            level = self.levels[number]
            held = int(held_count(level.states[row][None], self.task.boundary)[0])
            if number < last and held < fewest:
                begun, part, fewest = number, action % self.task.part_count, held
            action = int(level.action[row])
        return begun, part

    def gaps(self) -> dict[int, int]:
        """Return the parts that robots hold though all parts around them were there before and stand without them.

        Returns:
            For each of them, on the way to the best scored state of the last level of an assembly, the level before the
            first of those around it was placed.
        """
        neighbours = self.task.neighbours
        if neighbours is None or self.settings.direction is not Direction.ASSEMBLY:
            return {}
        last, placed = self.levels[-1].states[0], np.full(self.task.part_count, -1)
        for (after, to), (number, row) in pairwise(self._way_back()):
            part = int(self.levels[after].action[to]) % self.task.part_count
            if self.levels[number].states[row, part] == REMOVED:
                placed[part] = number
        found = {}
        for part in np.flatnonzero((last == HELD) & (placed >= 0)).tolist():
            around = neighbours[part]
            when = placed[around]
            if (last[around] == INSTALLED).all() and (when < placed[part]).all() and (when >= 0).any():
                found[part] = int(when[when >= 0].min())
        return found

    def before(self, number: int) -> States:
        """Return the state at a level on the way to the best scored one, shape (parts,)."""
        row = next(row for level, row in self._way_back() if level == number)
        return self.levels[number].states[row]

    def _way_back(self) -> Iterator[tuple[int, int]]:
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
        if self._ways.replays is not None:
            self._ways.replays.rewind(level)
        del self.levels[level + 1 :]
        self.settings = settings
        del self._whole[level:]
        self._dead = False

    def _advance(self) -> None:
        if not self.step():
            self._retry()

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

    def _retry(self) -> None:
        """Go back and choose again, unless nothing was left out or it was tried often enough."""
        if self.exhaustive or self.found or self._retried >= self.settings.retries:
            return
        self._retried += 1
        self.rewind(
            max(len(self.levels) - 1 - _RETREAT_LEVELS * _RETREAT_FACTOR ** (self._retried - 1), 0), self.settings
        )

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
            "retried": self._retried,
            "farthest": self._farthest,
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
        search._farthest, search._retried = int(header["farthest"]), int(header["retried"])
        return search

    def result(self, *, interrupted: bool = False) -> SearchResult:
        """As `LevelSearch.result`."""
        undecided, limit = self._judge.undecided + self._undecided, ""
        sliding = self._judge.sliding + self._sliding
        outcome = Outcome.FOUND if self.found else Outcome.NOT_FOUND
        if not self.found and not interrupted:
            outcome, limit = beam_failure(self.settings.width, self.exhaustive, undecided, sliding, self.task.doubt)
        # A beam that was taken back may be less far now than where it died before.
        farther_now = len(self.levels) > self._farthest
        return SearchResult(
            outcome=outcome,
            routes=(self.route(),) if self.found else (),
            direction=self.settings.direction,
            steps=self.task.steps,
            reached=max(len(self.levels), self._farthest, 1) - 1,
            deepest=self.levels[-1].states[:_REPORTED_STATES] if farther_now else self._deepest,
            rejected=self._rejected[:0] if farther_now else self._rejected,
            counters=self.counters,
            seconds=self._seconds,
            interrupted=interrupted,
            limit=limit,
            undecided=undecided,
            sliding=sliding,
        )

"""Beam search in either direction, with diversity by clustering (paper, section 5.1)."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import States
from falsework.search.beam.failed_moves import FailedMoves
from falsework.search.beam.frontier import Level, expand, pack
from falsework.search.beam.k_means import k_means
from falsework.search.beam.level_search import LevelSearch
from falsework.search.beam.nogoods import Jumps
from falsework.search.beam.paths import BeamPaths
from falsework.search.beam.scores import Scores
from falsework.search.beam.selection import Clustering, Selector
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.result import REPORTED_STATES, SearchCounters
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
        # Only a beam that looks ahead confirms the paths to its states; one that judges whole levels has no histories.
        histories = settings.direction is Direction.ASSEMBLY and settings.lookahead > 0
        replayer = oracle.replayer if histories else None
        if replayer is not None:
            task = replace(task, holds_keep_stable=True)  # with a history, a part that is fixed changes no force
        super().__init__(task, settings, guide)
        self.judge = CountingOracle(oracle)
        self.judge.replayed = replayer is not None  # see `PathVerifier`
        self._paths = BeamPaths(self.levels, self.judge, replayer, settings.history_bytes)
        self._failures = None if task.neighbours is None else FailedMoves(task.neighbours)
        self.cluster: Clustering = k_means
        self._hash = StateHash.for_parts(task.part_count)
        self._candidates = 0
        self._before = SearchCounters()
        self._undecided = self._sliding = 0
        if not self._dead:
            origin, one = task.origin(settings.direction)[None], np.ones(1, np.int8)
            self.levels.append(Level(origin, np.zeros(1, np.int64), np.full(1, -1, np.int64), np.zeros(1), one))

    @property
    def asked(self) -> int:
        """See `Search.asked`."""
        return self._before.asked + self.judge.asked

    @property
    def effort(self) -> float:
        """See `Search.effort`."""
        return self.asked + self._paths.lost

    @property
    def work(self) -> int:
        """See `Search.work`."""
        return self._before.work + self.judge.work

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        now = SearchCounters(0, self._candidates, self.judge.asked, self.judge.rejected, self.judge.work)
        return self._before + now + SearchCounters(states=sum(len(level.parent) for level in self.levels))

    def _advance(self) -> bool:
        settings, level = self.settings, self.levels[-1]
        frontier = expand(self.task, settings.direction, level.states, self._hash)
        refuted = frontier.without(*self.conflicts.barred(level.states)) if settings.lookahead > 0 else False
        if self.judge.forbidden:  # of those that need no verdict
            refuted |= frontier.without_states(self.judge.forbidden)
        scores = Scores(frontier, level.score, self._guided(frontier.level, frontier.legal))
        rng = np.random.default_rng((settings.seed, settings.number, len(self.levels)))
        how = self.cluster if settings.diversity == "k-means" else None, settings.pool, rng
        selector = Selector(frontier, scores, *how, self._paths.stable_ancestors(), self.judge, self._failures)
        self._paths.refused, sliding = False, self.judge.sliding
        if settings.lookahead > 0:
            choice = selector.select_lazily(settings.width, settings.lookahead, self._paths, commit=settings.commit)
        else:
            choice = selector.select_from_all(settings.width)
        self._candidates += len(frontier)
        # A state refused because of the path to it may be reached by another, which was merged with this one, unless it
        # is unstable however it is reached. Where replays decide, states are left out before them without a proof, too.
        whole = choice.exhaustive and not refuted and self._whole_before
        if whole and (self._paths.refused or self.judge.replayed):
            rejected = choice.rejected
            whole = self.judge.unstable(frontier.states(rejected), level.states[frontier.parent(rejected)])
            if whole:
                self.judge.sliding = sliding
        self._whole = [*self._whole[: len(self.levels) - 1], whole]
        if len(choice.kept) == 0:
            self._died(frontier.states(choice.rejected[:REPORTED_STATES]))
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
        self._paths.keep(kept)
        return True

    def replay_summary(self) -> PlanReplay | None:
        """See `Search.replay_summary`."""
        return self._paths.summary() if self.found else None

    def rewind(self, level: int, settings: BeamSettings) -> None:
        """See `LevelSearch.rewind`."""
        super().rewind(level, settings)
        self._paths.rewind(level)

    def forbid(self, states: States) -> None:
        """See `Search.forbid`."""
        keys = {state.tobytes() for state in states}
        self.judge.forbidden |= keys
        for number, level in enumerate(self.levels):
            if any(state.tobytes() in keys for state in level.states):
                self._go_back(number)
                return

    def _open(self) -> tuple[int, int]:
        judge = self.judge
        return judge.undecided + self._undecided, judge.sliding + self._sliding

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the state of the search: plain values, and arrays."""
        header: dict[str, Any] = {
            "settings": asdict(self.settings),
            "counters": asdict(self.counters) | {"states": 0},
            "seconds": self._seconds,
            "undecided": self.judge.undecided + self._undecided,
            "sliding": self.judge.sliding + self._sliding,
            "whole": self._whole,
            "dead": self._dead,
            "farthest": self._farthest,
            "jumps": asdict(self._jumps),
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
        search._jumps = Jumps(**{name: int(number) for name, number in header["jumps"].items()})
        search.conflicts.count = int(header["conflicts"])
        search.conflicts.refuted = {state: [int(one) for one in some] for state, some in header["refuted"].items()}
        return search

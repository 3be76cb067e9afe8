"""Beam search in either direction, with diversity by clustering (paper, section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States, held_count, state_of_key
from falsework.errors import InputError
from falsework.search.beam.failed_moves import FailedMoves
from falsework.search.beam.frontier import Level, PackedLevel, expand, pack
from falsework.search.beam.k_means import k_means
from falsework.search.beam.nogoods import Jumps, Nogoods
from falsework.search.beam.paths import BeamPaths
from falsework.search.beam.scores import Scores
from falsework.search.beam.selection import Clustering, Selector
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.hashing import StateHash, StateIndex
from falsework.search.problem.oracle import CountingOracle, Oracle
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.result import REPORTED_STATES, Outcome, Route, SearchCounters, beam_failure
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task
from falsework.stability.contact.history import Presses

_PREFERENCE = 0.3
"""Largest random preference of a part, in shares of its support; searches do as well with half and with three times as
much."""
_ONCE = "each part was held once; parts that are let go of and held again may lead on"
"""Caveat where the task allows that: levels are steps done, which a repeated hold takes back."""


class BeamSearch(Search):
    """Beam search in levels, each one move from the last, that can be stepped, interrupted, packed and resumed.

    Robots mostly hold a chain of parts, one after the other, until it closes and all can be let go of; whether it
    closes is seen only at its end. Where a beam dies, the parts that robots hold in all its states are the conflict.
    With `BeamSettings.restarts` it jumps back to a choice that led to it, and does not make that again. Over how many
    choices it jumps follows the Luby sequence, until the beam gets farther than ever before; where it would jump beyond
    the origin, it restarts wider. After each dead end parts have other random preferences. Verdicts asked before are in
    the oracle's memory, so going over the same ground costs little.
    """

    def __init__(
        self, task: Task, oracle: Oracle, settings: BeamSettings = BeamSettings(), *, guide: Guide | None = None
    ) -> None:
        """Begin at the origin of the direction; the start and the target are taken as stable.

        Args:
            settings: width, direction and how states are chosen.
            guide: scores actions; without it only diversity decides.

        Raises:
            InputError: a task in which steps may move several parts.
        """
        if task.together is not None:
            raise InputError(
                "beams of levels move one part at a time; search with find_plans, or without parts_at_once"
            )
        task = task.judged_by(oracle)
        # Only a beam that looks ahead confirms the paths to its states; one that judges whole levels has no histories.
        histories = settings.direction is Direction.ASSEMBLY and settings.lookahead > 0
        replayer = oracle.replayer if histories else None
        if replayer is not None:
            task = replace(task, holds_keep_stable=True)  # with a history, a part that is fixed changes no force
        self.task, self.settings, self._guide = task, settings, guide
        self.direction = settings.direction
        self.conflicts = Nogoods()
        """Dead ends."""
        self._jumps = Jumps()
        self.levels: list[Level | PackedLevel] = []
        """Levels so far, from the origin on."""
        self._whole: list[bool] = []
        """For each level after the first, and for the attempt at the next if dead: no stable state was left out."""
        self._dead = not task.contains(task.origin(settings.direction)[None])[0]
        self._farthest = 0
        self._deepest = self._rejected = np.empty((0, task.part_count), dtype=np.uint8)
        self.judge = CountingOracle(oracle)
        self.judge.replayed = replayer is not None  # see `BeamPaths.verifier`
        self._paths = BeamPaths(self.levels, self.judge, replayer, settings.history_bytes)
        self._failures = None if task.neighbours is None else FailedMoves(task.neighbours)
        self.cluster: Clustering = k_means
        self._hash = StateHash.for_parts(task.part_count)
        self._forbidden: StateIndex | None = None
        self._candidates = 0
        if not self._dead:
            origin, one = task.origin(settings.direction)[None], np.ones(1, np.int8)
            self.levels.append(Level(origin, np.zeros(1, np.int64), np.full(1, -1, np.int64), np.zeros(1), one))

    @property
    def effort(self) -> float:
        """See `Search.effort`."""
        return self.asked + self._paths.lost

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        judge, states = self.judge, sum(len(level.parent) for level in self.levels)
        return SearchCounters(states, self._candidates, judge.asked, judge.rejected, judge.work)

    def _advance(self) -> bool:
        settings, level = self.settings, self.levels[-1]
        frontier = expand(self.task, settings.direction, level.states, self._hash)
        refuted = frontier.without(*self.conflicts.barred(level.states)) if settings.lookahead > 0 else False
        if self._forbidden is not None:  # of those that need no verdict
            refuted |= frontier.without_states(self._forbidden, self._hash)
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

    def built(self) -> tuple[States, Presses] | None:
        """See `Search.built`."""
        return self._paths.built()

    def forbid(self, states: States) -> None:
        """See `Search.forbid`."""
        self._go_back(self._bar(states))

    def _bar(self, states: States) -> set[bytes]:
        """Rule states out, shape (count, parts); return their keys."""
        keys = {state.tobytes() for state in states}
        self.judge.forbidden |= keys
        barred = np.array([state_of_key(key) for key in self.judge.forbidden])
        self._forbidden = StateIndex(barred, self._hash) if len(barred) else None
        return keys

    def go_back(self, state: States) -> None:
        """See `Search.go_back`."""
        self._go_back({state.tobytes()})

    @property
    def found(self) -> bool:
        """Whether the goal is reached."""
        return len(self.levels) == self.task.steps + 1

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        return self.found or (self._dead and (self.exhaustive or self._over or not self.settings.restarts))

    @property
    def exhaustive(self) -> bool:
        """Whether no state was left out so far: if so and the search is dead, there is no plan."""
        return all(self._whole)

    def step(self) -> bool:
        """Find the next level; where there is none, jump back from the dead end or restart wider, with `restarts`."""
        stepped = not self._dead and not self.found and self._advance()
        if self.settings.restarts and self._dead and not self.exhaustive:
            self._over = not self.jump_back() and not self._restart()
        return stepped

    def jump_back(self) -> bool:
        """Learn from the dead end and jump back; False where that would be beyond the origin."""
        distance = self._jumps.distance(len(self.levels) - 1)
        choice = next(islice(self.choices(), distance - 1, None), None)
        if choice is None:
            return False
        self._jumps.since += 1
        back, action = choice
        self.conflicts.learn(self.before(back), action)
        self.rewind(back, replace(self.settings, number=self.conflicts.count))
        return True

    def _restart(self) -> bool:
        """Begin again with a wider beam, which may make all choices; False if it would be too wide."""
        wider = self.settings.wider()
        if wider.width > self._widest:
            return False
        self.conflicts.refuted.clear()
        self._jumps = Jumps()
        self.rewind(0, replace(wider, number=self.conflicts.count))
        return True

    def states(self) -> States:
        """Return all states kept so far, level by level from the origin. Shape (count, parts)."""
        empty = np.empty((0, self.task.part_count), dtype=np.uint8)
        return np.concatenate([empty, *(level.states for level in self.levels)])

    def route(self) -> Route:
        """Return the best scored path from start to target, in disassembly order; only once `found`."""
        if not self.found:
            raise InputError("the beam search has not reached its goal; there is no route yet")
        states = [self.levels[number].state(row) for number, row in self._backtrace()]
        if self.settings.direction is Direction.DISASSEMBLY:
            states.reverse()
        return Route.from_states(np.array(states))

    def _failure(self) -> tuple[Outcome, str]:
        caveat = self.task.caveat or _ONCE * self.task.allow_regrasp
        outcome, limit = beam_failure(self.settings.width, self.exhaustive, *self._open(), caveat)
        if self.settings.restarts and not self.exhaustive and not any(self._open()):
            limit = f"beams up to a width of {self.settings.width} died; wider ones may come through"
        return outcome, limit

    def _farthest_states(self) -> tuple[int, States, States]:
        # A beam that was taken back may be less far now than where it died before.
        if len(self.levels) > self._farthest:
            return len(self.levels) - 1, self.levels[-1].states[:REPORTED_STATES], self._rejected[:0]
        return max(self._farthest, 1) - 1, self._deepest, self._rejected

    def _place(self) -> tuple[int, int, int]:
        level = len(self.levels) - 1
        return level, len(self.levels[-1].states) if self.levels else 0, self.settings.width

    def choices(self) -> Iterator[tuple[int, int]]:
        """Yield the choices on the path to the best state of the last level that led to a dead end, latest first.

        Yields:
            Level and the action chosen there: first those that fixed the parts that robots hold in all states of the
            last level, then the first of each chain of held parts before.
        """
        bound = (self.levels[-1].states == HELD).all(axis=0) & (self.task.origin(self.settings.direction) != HELD)
        fewest, held_after, action = self.task.robots, 0, -1
        for number, row in self._backtrace():
            state = self.levels[number].state(row)
            held = int(held_count(state[None], self.task.boundary)[0])
            bound, binds = bound & (state == HELD), (bound & (state != HELD)).any()
            if binds or (not bound.any() and held <= fewest and held < held_after):
                yield number, action
            if not bound.any():
                fewest = min(fewest, held)
            held_after, action = held, int(self.levels[number].action[row])

    def before(self, number: int) -> States:
        """Return the state at a level on the path to the best scored one, shape (parts,)."""
        row = next(row for level, row in self._backtrace() if level == number)
        return self.levels[number].state(row)

    def rewind(self, level: int, settings: BeamSettings) -> None:
        """Discard all levels after `level` and continue from there with other settings.

        Raises:
            InputError: settings for the other direction, or a level that was not reached.
        """
        if settings.direction is not self.settings.direction or not 0 <= level < len(self.levels):
            raise InputError(f"cannot rewind a beam search of {len(self.levels)} levels to level {level}")
        del self.levels[level + 1 :], self._whole[level:]
        self.settings, self._dead = settings, False
        self._paths.rewind(level)

    def _go_back(self, keys: set[bytes]) -> None:
        """Go back to before the first level with one of some states."""
        for number, level in enumerate(self.levels):
            if any(state.tobytes() in keys for state in level.states):
                self._whole = [*self._whole[:number], *([False] * (len(self.levels) - number))]
                self.rewind(max(number - 1, 0), self.settings)
                return

    @property
    def _whole_before(self) -> bool:
        """Whether no stable state was left out up to the last level."""
        return all(self._whole[: len(self.levels) - 1])

    def _guided(self, states: States, legal: Mask) -> NDArray[np.floating] | None:
        """Return the guide's scores of legal actions, shapes (level, parts) and (level, 2 parts).

        After a dead end each part has a random preference besides, until the next: what the guide alone puts first led
        there, and mostly does again. Such randomization cuts heavy tails (Gomes, Selman and Kautz 1998).

        Raises:
            InputError: scores of another shape.
        """
        if self._guide is None:
            return None
        scores = np.asarray(self._guide(states, legal, self.settings.direction))
        if scores.shape != legal.shape:
            raise InputError(f"the guide returned scores of shape {scores.shape}; expected {legal.shape}")
        if self.settings.number:
            rng = np.random.default_rng((self.settings.seed, self.settings.number))
            scores = scores + np.tile(_PREFERENCE * rng.random(self.task.part_count), 2)
        return scores

    def _died(self, rejected: States) -> None:
        """Note that there is no next level, and some of the states that might have been in it."""
        self._dead = True
        if len(self.levels) > self._farthest:
            self._farthest = len(self.levels)
            self._deepest, self._rejected = self.levels[-1].states[:REPORTED_STATES], rejected

    def _backtrace(self) -> Iterator[tuple[int, int]]:
        """Yield levels and rows of the path to the best scored state of the last level, that state first."""
        row, levels = 0, self.levels
        for number in range(len(levels) - 1, -1, -1):
            yield number, row
            row = int(levels[number].parent[row])

    def pack(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return the state of the search: plain values, and arrays."""
        header: dict[str, Any] = {
            "settings": asdict(self.settings),
            "counters": asdict(self.counters) | {"states": 0},
            "seconds": self._seconds,
            "undecided": self.judge.undecided,
            "sliding": self.judge.sliding,
            "whole": self._whole,
            "dead": self._dead,
            "farthest": self._farthest,
            "jumps": asdict(self._jumps),
            "conflicts": self.conflicts.count,
            "refuted": self.conflicts.refuted,
            "replays": self._paths.replays,
        }
        arrays: dict[str, NDArray[Any]] = {
            "states": self.states(),
            "sizes": np.array([len(level.parent) for level in self.levels], dtype=np.int64),
            "deepest": self._deepest,
            "rejected": self._rejected,
            "forbidden": np.array([state_of_key(key) for key in sorted(self.judge.forbidden)], dtype=np.uint8),
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
        judge, counters = search.judge, SearchCounters(**header["counters"])
        judge.asked, judge.rejected, judge.work = counters.asked, counters.rejected, counters.work
        judge.undecided, judge.sliding = int(header["undecided"]), int(header["sliding"])
        search._candidates, search._seconds = counters.candidates, float(header["seconds"])
        search._dead, search._whole = bool(header["dead"]), [bool(flag) for flag in header["whole"]]
        search._deepest, search._rejected = arrays["deepest"], arrays["rejected"]
        search._farthest = int(header["farthest"])
        search._jumps = Jumps(**{name: int(number) for name, number in header["jumps"].items()})
        search._bar(arrays["forbidden"])
        search._paths.replays = [int(number) for number in header["replays"]]
        search.conflicts.count = int(header["conflicts"])
        search.conflicts.refuted = {state: [int(one) for one in some] for state, some in header["refuted"].items()}
        return search

"""Planner: a portfolio of beams from both ends, postponement of missing parts, and alternative plans."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.errors import InputError
from falsework.search.beam.beam import BeamSearch
from falsework.search.plans.route_tests import RouteTests
from falsework.search.problem.ends import judge_ends
from falsework.search.problem.guide import Guide, NoveltyGuide, SupportGuide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.result import Outcome, Progress, Route, SearchCounters, SearchProgress, SearchResult, Stop
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task
from falsework.search.settings import PlannerSettings
from falsework.search.strategies import EDGES, TOGETHER, Pace, Portfolio, Turn, regrasps, start
from falsework.stability.contact.varied_replay import part_length
from falsework.utils.archive import read_archive, write_archive
from falsework.utils.files.damage import blamed_on

FORMAT = "falsework.planner/15"
MOST_FALLS = 64
"""Routes of one search, or plans with motions, whose replay may fail before it is given up."""
_NUMBERS = "_round", "_turn", "_rank", "_high", "_trial_reached", "_falls"
"""Numbers that say where a search stands."""


class Planner:
    """Planner of first plans, plans with postponed parts, and alternatives.

    Where parts are missing, plans are compared by the steps of assembly before the first of them is inserted, then
    before the second, and so on; each of these numbers in turn is raised by bisection, with searches in which the parts
    must not be present any earlier. The result is the latest that these searches find.
    """

    def __init__(
        self,
        task: Task,
        oracle: Oracle,
        settings: PlannerSettings = PlannerSettings(),
        *,
        guide: Guide | None = None,
        wide: bool = False,
    ) -> None:
        """Begin with nothing.

        Args:
            guide: scores actions; `SupportGuide` is a good one. Repeated holds need one.
            wide: beams are as wide as they may be from the beginning, see `Portfolio.from_settings`.

        Raises:
            InputError: alternatives, where parts are held again.
        """
        self.regrasps, self.together = regrasps(task, settings), task.together is not None
        """Whether plans may hold parts again, and whether steps may move several parts."""
        self._pace = Pace(lambda: len(self._left) > 1)
        self.task = task.judged_by(oracle)
        self.settings = settings
        self.routes: list[Route] = []
        """Plans found so far; the first keeps missing parts out longest."""
        self.states = np.empty((0, task.part_count), dtype=np.uint8)
        """States found by the searches for alternative plans, shape (count, parts)."""
        self._oracle, self._wide, self._falls = oracle, wide, 0
        self._doubt: str | None = None
        """What the start does from rest, where it may stand only as it is built; None until the ends are judged."""
        self.tests = RouteTests(oracle, settings, task.part_count)
        """Of complete routes, with their replays and the one that falls last."""
        self._guide, self._edge_guide = guide, None
        known = self.tests.replayer is not None or self.task.holds_keep_stable
        if isinstance(guide, SupportGuide) and known:  # not where histories matter and are not kept
            self._edge_guide = guide.edges_first(self.task)
            self._guide = guide.held_neighbours(self.task) or guide
        self._stage = "plan"
        self._left = list(self._portfolio.names)
        """Strategies of the present search that have not given up."""
        self._round = self._turn = 0
        self._beams: dict[str, Search] = {}
        self._turns: dict[str, Turn] = {}
        self._last: dict[str, SearchResult] = {}
        """How far each of these came."""
        self._rank, self._high, self._trial_reached = 0, 0, -1
        self._trial: tuple[int, ...] = (0,) * len(task.missing)
        self._failure: SearchResult | None = None
        self._counters, self._seconds = SearchCounters(), 0.0

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do."""
        return self._stage == "done"

    @property
    def asked(self) -> int:
        """Verdicts asked for so far by all attempts, without counting the states of their beams."""
        return self._counters.asked + sum(beam.asked for beam in self._beams.values())

    @property
    def counters(self) -> SearchCounters:
        """Work done so far by all attempts."""
        return sum((beam.counters for beam in self._beams.values()), self._counters)

    @property
    def postponed(self) -> tuple[int, ...]:
        """Steps of assembly before the first, second, ... missing part is inserted, in the plan found so far."""
        return self.routes[0].insertion_steps(self.task) if self.routes else self._trial

    def begin_with(self, route: Route) -> None:
        """Start from a known route instead of searching for one; only later missing parts and alternatives are left.

        Args:
            route: path from start to target whose states are known to be stable.

        Raises:
            InputError: the planner has begun already, or the route is of another task.
        """
        ends = np.stack([self.task.start, self.task.target])
        if self._stage != "plan" or self._beams or not np.array_equal(route.states[[0, -1]], ends):
            raise InputError("a planner takes a route between its own start and target, and before it begins")
        self.routes = [route]
        self._next_trial(begin=True)

    def run(self, *, progress: Progress | None = None, stop: Stop | None = None) -> SearchResult:
        """Search until all requested plans are found, all searches end, or `stop` returns true; return how far it came.

        Args:
            progress: called after every level of every attempt.
            stop: called before every level; true stops the search, which can then be saved or continued.
        """
        begun, interrupted = time.perf_counter(), False

        def report(event: SearchProgress) -> None:
            if progress is not None:
                seconds = self._seconds + time.perf_counter() - begun
                progress(replace(event, asked=self.asked, seconds=seconds))

        try:
            if self._doubt is None:
                failed, doubt = judge_ends(self.task, self._oracle, self.settings.directions)
                if failed is not None:
                    return failed
                self._doubt = doubt
            for route in self.routes if self.tests.slow else ():  # given, or of a search that was resumed
                if route.states.tobytes() not in self.tests.replays:
                    self.tests.passes(route, stop=stop)
            if self.task.clearance is not None:
                self.task.clearance.prepare()
            while not self.done and not interrupted:
                interrupted = self._advance(report, stop)
        except KeyboardInterrupt:
            interrupted = True
        self._seconds += time.perf_counter() - begun
        return self._result(interrupted)

    def check_saved(self) -> None:
        """Raise unless the search can be saved.

        Raises:
            InputError: plans may hold parts again, or steps may move several.
        """
        what = "repeated holds" if self.task.allow_regrasp else "several parts in one step" * self.together
        if what:
            raise InputError(f"a search with {what} cannot be saved; leave out the checkpoint")

    def save(self, path: Path | str) -> None:
        """Write the current search, to be resumed by `load`, but for why strategies gave up, and contact histories.

        Raises:
            InputError: it cannot be saved, see `check_saved`.
        """
        self.check_saved()
        beams, (tests, arrays) = dict[str, Any](), self.tests.pack()
        for key, beam in self._beams.items():
            assert isinstance(beam, BeamSearch)
            beams[key], packed = beam.pack()
            arrays |= {f"{key}_{name}": array for name, array in packed.items()}
        header = {
            **_identity(self.task, self._oracle, self.settings),
            "stage": self._stage,
            "left": self._left,
            "trial": list(self._trial),
            "turns": {name: vars(turn) for name, turn in self._turns.items()},
            "numbers": [getattr(self, name) for name in _NUMBERS],
            "counters": vars(self._counters),
            "seconds": self._seconds,
            "tests": tests,
            "beams": beams,
        }
        routes = np.concatenate([self.states[:0], *(route.states for route in self.routes)])
        write_archive(path, FORMAT, header, {"routes": routes, "states": self.states} | arrays)

    @classmethod
    def load(
        cls,
        path: Path | str,
        task: Task,
        oracle: Oracle,
        settings: PlannerSettings = PlannerSettings(),
        *,
        guide: Guide | None = None,
        wide: bool = False,
    ) -> Planner:
        """Read a search that `save` wrote, to continue it.

        Raises:
            InputError: no such file, a damaged one, or one of another task or other settings.
        """
        header, arrays = read_archive(path, FORMAT)
        expected = _identity(task.judged_by(oracle), oracle, settings)
        if {name: header.get(name) for name in expected} != expected:
            raise InputError(f"{path} belongs to another structure, task or settings; remove it to begin a new search")
        planner = cls(task, oracle, settings, guide=guide, wide=wide)
        with blamed_on(path, "remove it to begin a new search"):
            planner._restore(header, arrays)
        return planner

    def _restore(self, header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
        self._stage, self._left = str(header["stage"]), [str(name) for name in header["left"]]
        self._trial = tuple(int(steps) for steps in header["trial"])
        for name, number in zip(_NUMBERS, header["numbers"], strict=True):
            setattr(self, name, int(number))
        self._turns = {name: Turn(**turn) for name, turn in header["turns"].items()}
        self._counters = SearchCounters(**header["counters"])
        self.tests.restore(header["tests"], arrays)
        self._seconds, self.states = float(header["seconds"]), arrays["states"]
        rows = arrays["routes"].reshape(-1, self.task.steps + 1, self.task.part_count)
        self.routes = [Route.from_states(states) for states in rows]
        task = self.task.postpone(self._trial)
        for name, packed in header["beams"].items():
            inner = {key.removeprefix(f"{name}_"): array for key, array in arrays.items() if key.startswith(f"{name}_")}
            guide = self.beam_guide(name)
            self._beams[name] = BeamSearch.unpack(packed, inner, task, self._oracle, guide=guide)

    def _advance(self, report: Progress, stop: Stop | None) -> bool:
        """Run the strategy whose turn it is, and decide on the next; True if it was interrupted."""
        portfolio, name = self._portfolio, self._left[self._turn]
        if name not in self._beams:
            rules = self.task.postpone(self._trial), self._oracle, portfolio, self.settings.seed
            self._beams[name] = start(name, *rules, self.beam_guide)
        beam, turn, paused, due = self._beams[name], self._turns.setdefault(name, Turn()), False, False
        others = [self._beams[other].work for other in self._left if other in self._beams and other != name]
        least = min(filter(None, others), default=np.inf)

        def halt() -> bool:
            nonlocal paused, due
            turn.note(beam, portfolio.narrowest)
            paused = portfolio.is_over(self._round, turn, beam.work, least)
            due = self.tests.slow and beam.level >= turn.tested + part_length(beam.steps)
            return due or paused or (stop is not None and stop())

        with self._pace.turn(self._round):
            result = self._last[name] = beam.run(portfolio.widest, progress=report, stop=halt)
        if result.found and not result.interrupted:
            self._test(beam, result, stop)
        elif due:
            self.tests.test_so_far(beam)
            turn.tested = beam.level
        elif paused or self._pace.over:
            self._turn, turn.owed = self._turn + 1, 0.0
        elif result.interrupted:
            return True
        else:
            self._failed(result)
        if self._turn >= len(self._left):
            self._round, self._turn = self._round + 1, 0
        if self._round >= portfolio.rounds:
            self._failure = max(self._last.values(), key=lambda result: result.reached)
            self._finish()
        return False

    def _drop_beams(self) -> None:
        """Forget the beams of a search that is over, but not the work that they did."""
        self._counters = self.counters
        self._beams, self._turns, self._last = {}, {}, {}
        self._left, self._round, self._turn, self._falls = list(self._portfolio.names), 0, 0, 0

    def _give_up(self) -> bool:
        """Leave the present strategy out from now on; return whether it was the last."""
        del self._left[self._turn]
        self._left = self._left or [name for name in self._portfolio.later if name not in self._beams]
        self._falls = 0
        return not self._left

    def _test(self, beam: Search, result: SearchResult, stop: Stop | None) -> None:
        """Test the route found, and go on to the next search, or leave the state out in which it fails."""
        route = result.routes[0]
        if self._stage == "alternatives":
            self.states = np.concatenate([self.states, beam.states()])
        falls = self._falls + 1
        if not self.tests.passes(route, beam.replay_summary(), stop):
            if self.tests.again is not None:
                beam.go_back(self.tests.again)
            elif falls < MOST_FALLS:
                beam.forbid(self.tests.forbidden)
            else:
                limit = f"{falls} plans were found, and in each a state tips or a replay fails"
                self._failed(replace(result, outcome=Outcome.NOT_FOUND, routes=(), limit=limit))
                falls = 0
            self._falls = falls
        elif self._stage != "alternatives":
            begin = not self.routes
            self.routes = [route]
            self._next_trial(begin=begin)
        else:
            self.routes.append(route)
            self._drop_beams()
            if len(self.routes) == self.settings.alternatives:
                self._finish()

    def _failed(self, result: SearchResult) -> None:
        """Try the next attempt, or give this trial up."""
        decided = result.outcome is Outcome.PROVED_IMPOSSIBLE and not len(self.tests.forbidden)
        if self.regrasps or self.together:
            # Beams in which parts are held once, or move alone, prove nothing; even without a proof, nothing is left.
            name = self._left[self._turn]
            decided = self._beams[name].examined_all and not (self.regrasps and name.startswith(TOGETHER))
            if not decided:
                result = replace(result, outcome=Outcome.NOT_FOUND)
        over = self._give_up() or decided
        if self._stage == "plan" and (decided or self._failure is None or result.reached >= self._failure.reached):
            self._failure = result
        if self._stage != "postpone":
            if over:
                self._finish()
            return
        if result.direction is Direction.ASSEMBLY:
            self._trial_reached = max(self._trial_reached, result.reached)
        if over:
            self._high = self._trial[self._rank]
            if self._trial_reached >= 0:
                # Without this part assembly got no further, so it is needed by then.
                self._high = max(min(self._high, self._trial_reached + 1), self.postponed[self._rank] + 1)
            self._next_trial(begin=False)

    @property
    def _portfolio(self) -> Portfolio:
        edges = self._edge_guide is not None
        found = Portfolio.from_settings(self.settings, self._stage, self.task, edges=edges, wide=self._wide)
        beams = self._stage != "alternatives" and not (self.regrasps or self.together)
        found = found.assembly_first() if beams and self.tests.replayer is not None else found
        return found.doubted() if self._doubt and self._stage == "plan" else found

    def _finish(self) -> None:
        self._drop_beams()
        self._stage, self._left = "done", []

    def _next_trial(self, *, begin: bool) -> None:
        """Choose the next search, now that a plan is known; `begin` with the first missing part."""
        count = len(self.task.missing)
        self._stage, self._trial_reached = "postpone", -1
        self._drop_beams()
        if begin:
            self._rank, self._high = 0, self.task.steps - count + 1
        ambitious = begin
        while self._rank < count:
            low = self.postponed[self._rank]
            if self._high - low > 1:
                # The most ambitious trial comes first: the point of its failure bounds the others.
                steps = self._high - 1 if ambitious else (low + self._high) // 2
                self._trial = (*self.postponed[: self._rank], *(steps,) * (count - self._rank))
                return
            self._rank += 1
            ambitious, self._high = True, self.task.steps - count + self._rank + 1
        self._trial, self._stage = self.postponed, "alternatives"
        self._drop_beams()
        if self.settings.alternatives == 1:
            self._finish()

    def beam_guide(self, beam: str) -> Guide | None:
        """Return the guide of a beam, by its name."""
        if beam == EDGES:
            return self._edge_guide
        return NoveltyGuide(self._guide, self.routes) if self._stage == "alternatives" else self._guide

    def _result(self, interrupted: bool) -> SearchResult:
        counters = self.counters
        routes = self.routes or [route for route in [self.tests.doubted] if route is not None]
        if routes:
            what = "gathering alternatives" if self._stage == "alternatives" else "postponing missing parts"
            notes = (f"interrupted while {what}; the plan is complete",) * (interrupted and bool(self.routes))
            steps, ends = self.task.steps, (self.task.target[None], self.states[:0])
            found = Outcome.FOUND, tuple(routes), Direction.DISASSEMBLY, steps, steps, *ends
            return SearchResult(*found, counters, self._seconds, interrupted, notes=notes)
        ended = [result for result in (self._failure, *self._last.values()) if result is not None]
        best = max(ended, key=lambda result: result.reached, default=None)
        if best is None:  # interrupted before the first search began
            best = BeamSearch(self.task, self._oracle).result(interrupted=True)
        if self._doubt and best.outcome is Outcome.NOT_FOUND:
            best = replace(best, limit=self._doubt)
        return replace(best, counters=counters, seconds=self._seconds, interrupted=interrupted)


def _identity(task: Task, oracle: Oracle, settings: PlannerSettings) -> dict[str, Any]:
    """Return what tells one search from another, as plain JSON values."""
    return {"task": task.to_dict(), "settings": settings.to_dict(), "premises": oracle.premises}

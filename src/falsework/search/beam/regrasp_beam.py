"""Beam search with repeated holds: sets of present parts level by level, with changes of holds where needed."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import TYPE_CHECKING

import numpy as np

from falsework.assembly.state import REMOVED, States, state_of_key
from falsework.search.beam.nogoods import Jumps
from falsework.search.beam.settings import WIDENING
from falsework.search.beam.state_search import StateSearch
from falsework.search.problem.deadline import PIECE, DeadlineExceeded
from falsework.search.problem.guide import Guide
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.regrasp_moves import RegraspMoves
from falsework.search.problem.result import REPORTED_STATES, Outcome, SearchCounters
from falsework.search.problem.task import Direction, Task

if TYPE_CHECKING:
    from falsework.stability.contact.history import History

_MOST_AT_GOAL = 10_000
"""Largest number of other holds of the parts of the goal that are examined on the path to its own."""


@dataclass(frozen=True, eq=False)
class _Segment:
    """Path of states, one move each, from a state with a free robot to the next such state."""

    origin: bytes
    states: tuple[States, ...]
    score: float


class RegraspBeam(StateSearch):
    """Beam over the sets of present parts; each comes with holds that keep one robot free.

    From a level to the next a part is removed, or in assembly placed, with the present holds, or with one hold or prop
    changed. Only if none of these is stable are other holds searched for, by releasing parts and holding others, a few
    at a time. If that does not help either, the beam jumps back over levels as `LevelSearch` does over choices, and
    does not come to the same sets of parts again until it restarts wider.
    """

    def __init__(self, task: Task, oracle: Oracle, direction: Direction, *, guide: Guide, width: int = 1) -> None:
        """Begin at the origin of a direction.

        Args:
            task: rules between start and target, with `Task.allow_regrasp`.
            oracle: decides stability.
            direction: end to begin at.
            guide: scores actions.
            width: sets of parts kept a level.
        """
        super().__init__(task, oracle, direction, batch=16)
        self._guide, self._moves = guide, RegraspMoves(self.task)
        self._farthest = 0
        self._restart(width)
        self._last: list[bytes] = []
        self._wrong, self._rejected = list[States](), list[States]()
        self._pending: list[History] | None = None

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        return self.found or self._over

    @property
    def steps(self) -> int:
        """Two for each part to be removed, which every plan needs at least."""
        return 2 * self._moves.removals

    @property
    def counters(self) -> SearchCounters:
        """See `Search.counters`."""
        return SearchCounters(
            len(self.parent), len(self._stable), self.judge.asked, self.judge.rejected, self.judge.work
        )

    def step(self) -> bool:
        """Find the next level, or go to the goal from the last; where neither succeeds, jump back, or restart wider."""
        if len(self._levels) > self._moves.removals and self._to_goal():
            return True
        if self._advance():
            return True
        self._over = not self.jump_back()
        return False

    def _failure(self) -> tuple[Outcome, str]:
        return Outcome.NOT_FOUND, f"beams of width {self.width} with holding again died"

    def _farthest_states(self) -> tuple[int, States, States]:
        rejected = np.array(self._rejected, dtype=np.uint8).reshape(-1, self.task.part_count)
        return 2 * self._farthest, self._of_keys(self._last), rejected

    def _place(self) -> tuple[int, int, int]:
        return 2 * (len(self._levels) - 1), len(self._levels[-1]), int(self.width)

    def _advance(self) -> bool:
        """Find the next level, changing holds if needed; return False if there is none.

        Raises:
            DeadlineExceeded: `stop` ended it; the levels are as before.
        """
        level = self._levels[-1]
        if len(self._levels) > self._moves.removals:
            return False
        self._wrong = []
        found: dict[bytes, bytes] = {}
        ring, seen = list(level), set(level)
        within: list[_Segment] = []
        while ring:
            segments = self._sorted(
                segment
                for key in ring
                for segment in self._placement_moves(key)
                if not self._refuted or self._presence(segment.states[-1]) not in self._refuted
            )
            for place in self._standing(segments, found):
                found.setdefault(self._presence(segments[place].states[-1]), self._take(segments[place]))
                if len(found) == self.width:
                    break
            if 4 * len(found) >= self.width:
                break
            within = self._sorted([*within, *(w for key in ring for w in self._regrasp_moves(key))])
            ring = self._other_holds(within, seen)
            if ring and self._stop is not None and self._stop():
                raise DeadlineExceeded
        if not found:
            if len(self._levels) > self._farthest:
                self._rejected = self._wrong
            return False
        self._levels.append(list(found.values()))
        if len(self._levels) - 1 > self._farthest:
            self._farthest, self._last = len(self._levels) - 1, self._levels[-1]
        return True

    def _other_holds(self, segments: list[_Segment], seen: set[bytes]) -> list[bytes]:
        """Return more reachable states with the same parts and other holds; none if none is left.

        Args:
            segments: paths to such states, best first; those that need not be tried again are taken out.
            seen: states that were returned before; the new ones are added.
        """
        segments[:] = [segment for segment in segments if segment.states[-1].tobytes() not in seen]
        fresh, tried = [], len(segments)
        for place in self._standing(segments):
            key = segments[place].states[-1].tobytes()
            if key not in seen:
                self._take(segments[place])
                seen.add(key)
                fresh.append(key)
            if len(fresh) == PIECE:
                tried = place + 1
                break
        del segments[:tried]
        return fresh

    def _placement_moves(self, key: bytes) -> Iterator[_Segment]:
        """Yield the paths from a state to those with one part fewer, or in assembly more, and a robot free."""
        moves, state = self._moves, state_of_key(key)
        for action, after in self._after(state, presence=True):
            if self._free(after):
                yield self._segment(key, action, after)
            if self.direction is Direction.ASSEMBLY:
                for _, let_go in self._after(after, presence=False):
                    if moves.held(let_go) < moves.held(after):
                        yield self._segment(key, action, after, let_go)
                for _, propped in self._props(after, int(action) - moves.parts):
                    for _, let_go in self._after(propped, presence=False):
                        if moves.held(let_go) < moves.held(after):
                            yield self._segment(key, action, after, propped, let_go)
        if self.direction is Direction.DISASSEMBLY:
            for hold, held in self._after(state, presence=False):
                if moves.held(held) < moves.held(state):
                    continue
                for _, bare in [(0, held), *self._props(held, int(hold))]:
                    between = (held,) if bare is held else (held, bare)
                    for action, after in self._after(bare, presence=True):
                        if self._free(after) and (action == hold + moves.parts or not self._free(held)):
                            yield self._segment(key, action, *between, after)

    def _regrasp_moves(self, key: bytes) -> Iterator[_Segment]:
        """Yield the paths from a state to those with the same parts, other holds or props, and a robot free."""
        state, moves = state_of_key(key), self._moves
        for action, after in self._after(state, presence=False):
            if self._free(after):
                yield self._segment(key, action, after)
            else:
                for _, let_go in self._after(after, presence=False):
                    if moves.held(let_go) < moves.held(after) and not np.array_equal(let_go, state):
                        yield self._segment(key, action, after, let_go)
        for action, after in self._props(state):
            yield self._segment(key, action, after)

    def _after(self, state: States, *, presence: bool) -> Iterator[tuple[int, States]]:
        """Yield the actions of robots on a state and their results: those on presence, or those on holds."""
        parts, last = self._moves.parts, self._moves.parts - len(self.task.props)
        legal = self._moves.legal(state[None], self.direction)[0]
        actions = np.flatnonzero(legal[parts : parts + last]) + parts if presence else np.flatnonzero(legal[:parts])
        after = self._moves.follow(np.repeat(state[None], len(actions), axis=0), actions)
        yield from zip(actions.tolist(), after, strict=True)

    def _props(self, state: States, above: int | None = None) -> Iterator[tuple[int, States]]:
        """Yield the results of placing or removing a prop, only of that under a part if one is given."""
        parts, count = self._moves.parts, len(self.task.props)
        if not count:
            return
        legal = self._moves.legal(state[None], self.direction)[0, 2 * parts - count :]
        if above is not None:
            legal = legal & (np.asarray(self.task.props) == above)
        for prop in np.flatnonzero(legal):
            action = 2 * parts - count + int(prop)
            yield action, self._moves.follow(state[None], np.array([action]))[0]

    def _presence(self, state: States) -> bytes:
        """Return the parts that are present, without props."""
        return np.packbits(state[: len(state) - len(self.task.props)] != REMOVED).tobytes()

    def _free(self, state: States) -> bool:
        """Return whether a robot is free."""
        return int(self._moves.held(state)) < self.task.robots

    def _segment(self, origin: bytes, action: int, *states: States) -> _Segment:
        """Return a path with its score: free robots first, then few props, then the guide, then few moves."""
        before = state_of_key(origin)
        mask = np.zeros((1, 2 * self._moves.parts), dtype=bool)
        mask[0, action] = True
        score = float(self._guide(before[None], mask, self.direction)[0, action])
        busy = 10.0 * float(self._moves.held(states[-1])) + 5.0 * float(self._moves.standing(states[-1]))
        return _Segment(origin, states, score - busy - 1e-3 * len(states))

    @staticmethod
    def _sorted(segments: Iterable[_Segment]) -> list[_Segment]:
        return sorted(segments, key=lambda segment: -segment.score)

    def _standing(self, segments: list[_Segment], found: Collection[bytes] = ()) -> Iterator[int]:
        """Yield the indices of the paths whose states are all stable, except to parts that are `found`.

        They are checked in growing batches.
        """
        begin, count = 0, 1
        while begin < len(segments):
            places = range(begin, min(begin + count, len(segments)))
            batch = [k for k in places if self._presence(segments[k].states[-1]) not in found]
            self._ask([segments[k] for k in batch])
            yield from (
                k for k in batch if self._presence(segments[k].states[-1]) not in found and self._stands(segments[k])
            )
            begin, count = begin + count, min(2 * count, PIECE)

    def _ask(self, segments: list[_Segment]) -> None:
        """Check the unknown states of some paths, the last of each path first."""
        for place in (-1, -2, -3):
            asked: dict[bytes, tuple[States, States]] = {}
            for segment in segments:
                if len(segment.states) < -place or any(self._stable.get(s.tobytes()) is False for s in segment.states):
                    continue
                before = segment.states[place - 1] if len(segment.states) > -place else state_of_key(segment.origin)
                state = segment.states[place]
                if state.tobytes() not in self._stable:
                    asked.setdefault(state.tobytes(), (state, before))
            if not asked:
                continue
            states, before = (np.array(list(rows)) for rows in zip(*asked.values(), strict=True))
            stable = self.judge.stable(states, before)
            self._stable.update(zip(asked, stable.tolist(), strict=True))
            self._wrong = [*self._wrong, *states[~stable]][:REPORTED_STATES]

    def _stands(self, segment: _Segment) -> bool:
        """Return whether all states of a checked path are stable with their contact history too."""
        if not all(self._stable.get(state.tobytes(), False) for state in segment.states):
            return False
        if self._histories is None:
            return True
        self._pending = self._histories.along(segment.origin, segment.states)
        return self._pending is not None

    def _take(self, segment: _Segment) -> bytes:
        """Record how the states of the path last yielded by `_standing` were reached; return the last state."""
        before = segment.origin
        if self._histories is not None and self._pending is not None:
            fresh = [k for k, state in enumerate(segment.states) if state.tobytes() not in self.parent]
            self._histories.keep([segment.states[k] for k in fresh], [self._pending[k] for k in fresh])
        for state in segment.states:
            key = state.tobytes()
            self.parent.setdefault(key, before)
            before = key
        return before

    def jump_back(self) -> bool:
        """Jump back from a dead end, or beyond the origin restart wider; False if that would be too wide."""
        level = len(self._levels) - 1
        distance = self._jumps.distance(level)
        if distance > level:
            if self.width * WIDENING > self._widest:
                return False
            self._restart(self.width * WIDENING)
            return True
        self._jumps.since += 1
        self._refuted |= {self._presence(state_of_key(key)) for key in self._levels[level - distance + 1]}
        del self._levels[level - distance + 1 :]
        return True

    def _restart(self, width: float) -> None:
        origin = self.task.origin(self.direction).tobytes()
        self.width, self._jumps = width, Jumps()
        self._refuted = set[bytes]()
        """Sets of parts that led to dead ends."""
        self._levels = [[origin]]
        self.parent.setdefault(origin, b"")

    def _to_goal(self) -> bool:
        """Release or hold parts as in the goal, once all parts are placed or removed; False if no path is found."""
        goal = self.task.goal(self.direction).tobytes()
        seen, segments, count = set(self._levels[-1]), [], 0
        ring = list(self._levels[-1])
        while goal not in self.parent:
            for key in ring:
                state = state_of_key(key)
                for _, after in [*self._after(state, presence=False), *self._props(state)]:
                    if after.tobytes() not in seen:
                        seen.add(after.tobytes())
                        lacking, count = int(np.sum(after != state_of_key(goal))), count + 1
                        heappush(segments, (lacking, count, _Segment(key, (after,), 0.0)))
            if not segments or count > _MOST_AT_GOAL:
                break
            segment = heappop(segments)[2]
            ring = [self._take(segment) for _ in self._standing([segment])]
        return goal in self.parent

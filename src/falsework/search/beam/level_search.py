"""Level search: levels, jumps back from dead ends and restarts of a beam."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States, held_count
from falsework.errors import InputError
from falsework.search.beam.frontier import Level, PackedLevel
from falsework.search.beam.nogoods import Jumps, Nogoods
from falsework.search.beam.settings import BeamSettings
from falsework.search.problem.guide import Guide
from falsework.search.problem.result import REPORTED_STATES, Outcome, Route, beam_failure
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task


class LevelSearch(Search):
    """Search level by level from one end of a task, each level one move from the last.

    Robots mostly hold a chain of parts, one after the other, until it closes and all can be let go of; whether it
    closes is seen only at its end. Where a beam dies, the parts that robots hold in all its states are the conflict.
    With `BeamSettings.restarts` it jumps back to a choice that led to it, and does not make that again. Over how many
    choices it jumps follows the Luby sequence, until the beam gets farther than ever before; where it would jump beyond
    the origin, it restarts wider. Verdicts asked before are in the oracle's memory, so going over the same ground costs
    little.
    """

    def __init__(self, task: Task, settings: BeamSettings, guide: Guide | None) -> None:
        """Begin without a level.

        Raises:
            InputError: a task in which steps may move several parts.
        """
        if task.together is not None:
            raise InputError(
                "beams of levels move one part at a time; search with find_plans, or without parts_at_once"
            )
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

    @property
    def found(self) -> bool:
        """Whether the goal is reached."""
        return len(self.levels) == self.task.steps + 1

    @property
    def done(self) -> bool:
        """See `Search.done`."""
        return self.found or (self._dead and (self.exhaustive or self._over or not self.settings.restarts))

    @property
    def infeasible(self) -> bool:
        """Whether the search is dead with no state left out: there is no plan."""
        return self._dead and self.exhaustive

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

    @abstractmethod
    def _advance(self) -> bool:
        """Find the next level; False if there is none, and the search is dead."""

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
        outcome, limit = beam_failure(self.settings.width, self.exhaustive, *self._open(), self.task.caveat)
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

    def _go_back(self, level: int) -> None:
        """Go back to before a level in which states were ruled out."""
        self._whole = [*self._whole[:level], *([False] * (len(self.levels) - level))]
        self.rewind(max(level - 1, 0), self.settings)

    @property
    def _whole_before(self) -> bool:
        """Whether no stable state was left out up to the last level."""
        return all(self._whole[: len(self.levels) - 1])

    def _guided(self, states: States, legal: Mask) -> NDArray[np.floating] | None:
        """Return the guide's scores of legal actions, shapes (level, parts) and (level, 2 parts).

        Raises:
            InputError: scores of another shape.
        """
        if self._guide is None:
            return None
        scores = np.asarray(self._guide(states, legal, self.settings.direction))
        if scores.shape != legal.shape:
            raise InputError(f"the guide returned scores of shape {scores.shape}; expected {legal.shape}")
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

"""Memory of failed moves: what it goes by, and that a search with it proves as much as one without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest

from falsework import Direction, Outcome, StabilityOracle, StabilitySettings, Task, make_task
from falsework.assembly import HELD, INSTALLED, REMOVED, States, library
from falsework.search import BeamSearch, BeamSettings, SupportGuide
from falsework.search.beam.failed_moves import FailedMoves
from falsework.stability.contact.history import History
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import Press

CHAIN = [(k, k + 1) for k in range(1, 7)]


def memory(parts: int = 8) -> FailedMoves:
    task = Task.from_rules(np.arange(parts) == 0, 2, contacts=CHAIN)
    assert task.neighbours is not None
    return FailedMoves(task.neighbours)


def test_only_the_parts_around_matter() -> None:
    state = np.array([2, 1, 1, 1, 0, 0, 0, 2], dtype=np.uint8)
    far, near, itself, other = (state.copy() for _ in range(4))
    far[6], near[2], itself[3], other[4] = 1, 2, 2, 1
    key, same, *different = memory().keys(np.stack([state, far, near, itself, other]), np.full(5, 3))
    assert key == same
    assert key not in different
    assert memory().keys(state[None], np.array([2]))[0] != key  # another part


def test_the_last_verdict_counts() -> None:
    known = memory()
    keys = known.keys(np.array([[2, 1, 1, 0, 0, 0, 0, 0], [2, 1, 2, 0, 0, 0, 0, 0]], dtype=np.uint8), np.array([1, 1]))
    assert known.failed(keys).tolist() == [False, False]
    known.learn(keys, np.array([False, True]))
    assert known.failed(keys).tolist() == [True, False]
    known.learn(keys[:1], np.array([True]))
    assert known.failed(keys).tolist() == [False, False]


def test_a_place_in_which_a_part_failed_is_not_closed_before_it_is_there() -> None:
    """Only where nothing around it changes any more: not beside a part that is held or missing itself."""
    known = memory()
    full = np.array([2, 1, 1, 1, 1, 1, 1, 0], dtype=np.uint8)
    known.learn(known.keys(full[None], np.array([3])), np.array([False]))
    closed, held, missing, elsewhere = (full.copy() for _ in range(4))
    closed[3], held[3], held[4], missing[[3, 4]], elsewhere[5] = REMOVED, REMOVED, HELD, REMOVED, REMOVED
    states = np.stack([closed, held, missing, elsewhere, full])
    assert known.traps(states, np.array([2, 2, 2, 6, 2])).tolist() == [True, False, False, False, False]
    assert not known.traps(closed[None], np.array([5]))[0]  # its neighbours are there
    known.learn(known.keys(full[None], np.array([3])), np.array([True]))
    assert not known.traps(closed[None], np.array([2]))[0]


@pytest.mark.parametrize("direction", Direction)
def test_impossible_stays_proven(rules: Any, direction: Direction) -> None:
    """An arch of six with one robot: moves that failed before are tried last, but they are tried."""
    oracle = rules.arch(6)
    plain = Task.from_rules(rules.ground(6), 1)
    learning = Task.from_rules(rules.ground(6), 1, contacts=[(k, k + 1) for k in range(1, 5)])
    settings = BeamSettings(width=64, direction=direction, lookahead=64, diversity="none")
    for task in (plain, learning):
        assert BeamSearch(task, oracle, settings).run().outcome is Outcome.PROVED_IMPOSSIBLE
    assert BeamSearch(replace(learning, robots=6), oracle, settings).run().found


class Recorded(Replayer):
    """Replayer that notes the steps that it is asked for, and whether they come to rest."""

    steps: list[tuple[States, States, bool]]

    def step(
        self, history: History, before: States, after: States, presses: Sequence[Press] | None = None
    ) -> tuple[bool, History]:
        rests, found = super().step(history, before, after, presses)
        self.steps.append((before.copy(), after.copy(), rests))
        return rests, found


class Recording(StabilityOracle):
    """Oracle whose replayer notes what it is asked for."""

    @cached_property
    def recorded(self) -> Recorded:
        replayer = Recorded(self.assembly, self.settings)
        replayer.steps = []
        return replayer

    @property
    def replayer(self) -> Replayer:
        return self.recorded


def test_what_slid_waits_until_no_robot_is_free() -> None:
    """A part that slides is let go of again once something beside it is different, or nothing else is left to do."""
    assembly = library.build("vault:parts=60,span=4,rise=1.2,thickness=0.2")
    task, oracle = make_task(assembly, 2), Recording(assembly, StabilitySettings(reserve=1.1))
    assert task.neighbours is not None
    search = BeamSearch(task, oracle, BeamSettings.from_width(), guide=SupportGuide(assembly))
    search.run(1)
    known, failed = FailedMoves(task.neighbours), 0
    for before, after, rests in oracle.recorded.steps:
        part = np.flatnonzero((before != after) & (after == INSTALLED))
        keys = known.keys(np.repeat(after[None], len(part), axis=0), part)
        left = (before == REMOVED).any() and ((before == HELD) & ~assembly.boundary).sum() < task.robots
        assert not (known.failed(keys).any() and left)
        known.learn(keys, np.full(len(part), rests))
        failed += not rests
    assert failed > 0

"""The beam that widens where it dies."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework.search import BeamSearch, BeamSettings, Direction, Outcome, Task
from falsework.search.beam.adaptive import AdaptiveBeam, AdaptiveSettings


def misled(states: Any, actions: Any, direction: Direction) -> Any:
    """Prefers parts with high numbers, which a tower cannot take first."""
    parts = states.shape[1]
    return np.tile(np.arange(parts, dtype=float), 2)[None].repeat(len(states), axis=0)


def bound_to_the_last(rules: Any) -> tuple[AdaptiveBeam, Any]:
    """A beam with one robot and its oracle: it begins with part 7, which only stands last of all."""
    parts = 8
    oracle = rules.blocks(parts)
    oracle.supports[7] = [frozenset(range(1, 7))]
    oracle.supports[1:7] = [[frozenset({part - 1})] for part in range(1, 7)]
    beam = AdaptiveBeam(Task.create(rules.ground(parts), 1), oracle, AdaptiveSettings(), guide=misled)
    beam.search.settings = replace(beam.search.settings, lookahead=1)
    return beam, oracle


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("seed", range(25))
def test_wide_enough_it_decides_like_the_enumeration(rules: Any, direction: Direction, seed: int) -> None:
    oracle, clearance = rules.random(seed, 7)
    task = Task.create(rules.ground(7), 1 + seed % 2, clearance=clearance if seed % 3 == 0 else None)
    beam = AdaptiveBeam(task, oracle, AdaptiveSettings(direction))
    result = beam.run(4**6)
    possible = rules.enumeration(task, oracle).count() > 0
    assert result.found == possible
    assert result.outcome is (Outcome.FOUND if possible else Outcome.PROVED_IMPOSSIBLE)
    assert beam.infeasible == (not possible)


def test_widens_and_becomes_narrow_again(rules: Any) -> None:
    """One hard place near the beginning, then easy going: the beam ends as narrow as it began."""
    parts = 400
    oracle = rules.blocks(parts)
    # Part 90 carries everything else, and the guide puts it last among those that may go in first.
    oracle.supports[1:] = [[frozenset({90})] if part != 90 else [frozenset()] for part in range(1, parts)]

    def guide(states: Any, actions: Any, direction: Direction) -> Any:
        scores = np.ones((len(states), 2 * parts))
        scores[:, [90, parts + 90]] = -5.0
        return scores

    task = Task.create(rules.ground(parts), 1)
    beam = AdaptiveBeam(task, oracle, AdaptiveSettings(), guide=guide)
    narrow = beam.run(1)
    assert narrow.outcome is Outcome.NOT_FOUND
    assert "up to a width of 1" in narrow.limit
    result = beam.run(64)
    assert result.found
    assert beam.search.settings.width == 1
    assert len(beam.search.levels[-20].states) <= 1 + 64


def test_comes_back_before_what_robots_are_bound_to(rules: Any) -> None:
    """The guide begins with a part that only stands last of all: a robot waits at it while it could lay the others."""
    beam, _ = bound_to_the_last(rules)
    search = beam.search
    search.run()
    assert search.done
    assert not search.found
    assert search.binding() == [(0, 7)]
    assert search.chain() == (0, 7)
    assert np.array_equal(search.before(0), search.task.target)
    search.rewind(0, replace(search.settings, avoided=(7,)))
    assert search.step()
    assert search.levels[-1].states[0, 7] == 0


def test_nothing_is_bound_where_states_hold_different_parts(rules: Any) -> None:
    task = Task.create(rules.ground(5), 2)
    search = AdaptiveBeam(task, rules.blocks(5), AdaptiveSettings()).search
    assert search.binding() == []
    assert search.chain() == (0, -1)
    search.step()
    assert len(search.levels[-1].states) > 1
    assert search.binding() == []


@pytest.mark.parametrize("retreats", range(10))
def test_comes_back_wider_only_after_other_ways(retreats: int) -> None:
    """Three random ways, then wider, each time from farther back."""
    settings = AdaptiveSettings(width=2)
    beam = settings.beam(retreats, number=retreats)
    assert beam.width == (2 if retreats < 4 else 8 if retreats < 8 else 32)
    assert (beam.disorder > 0) == (retreats % 4 > 0)
    assert beam.lookahead == (64 if retreats == 0 else 256 if retreats < 8 else 512)


def test_tries_each_chain_once(rules: Any) -> None:
    """A part that stands last of all binds the only robot: the beam begins elsewhere, and does not come back to it."""
    beam, _ = bound_to_the_last(rules)
    beam.search.run()
    assert beam._widen(1)
    assert beam.search.settings.avoided == (7,)
    assert beam._tried == {beam.search.task.target.tobytes().hex(): [7]}
    assert beam.run(1).found


def test_a_limit_on_deaths_is_a_pause(rules: Any) -> None:
    beam, _ = bound_to_the_last(rules)
    paused = beam.run(1, deaths=0)
    assert paused.outcome is Outcome.NOT_FOUND
    assert not paused.interrupted
    assert beam.run(1).found


def test_robots_work_in_one_place(rules: Any) -> None:
    """Parts in a row that need both neighbours: the guide would hold parts far from each other."""
    parts = 30
    row = np.stack([np.arange(1, parts - 1), np.arange(2, parts)], axis=1)
    task = Task.create(rules.ground(parts), 4, contacts=row)

    def apart(states: Any, actions: Any, direction: Direction) -> Any:
        return np.tile((np.arange(parts) * 7) % parts, 2)[None].repeat(len(states), axis=0)

    def farthest(compact: bool) -> int:
        """Return how many parts away from the next held one a part was fixed."""
        search = AdaptiveBeam(task, rules.arch(parts), AdaptiveSettings(compact=compact), guide=apart).search
        search.run()
        most = 0
        for before, level in itertools.pairwise(search.levels):
            for state, parent in zip(level.states, before.states[level.parent], strict=True):
                held = np.flatnonzero(parent[1:] == 2)
                fixed = np.flatnonzero((state[1:] == 2) & (parent[1:] != 2))
                if len(held) and len(fixed):
                    most = max(most, int(np.abs(held - fixed[0]).min()))
        return most

    assert farthest(compact=True) == 2
    assert farthest(compact=False) > 2


def test_forgets_the_states_it_came_from_longest_ago(rules: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("falsework.search.beam.adaptive._REMEMBERED_STATES", 3)
    beam = AdaptiveBeam(Task.create(rules.ground(8), 2), rules.tower(8), AdaptiveSettings())
    beam.run(1)
    for level in (0, 1, 2, 0, 3):
        beam._tried_from(level).append(level)
    assert list(beam._tried.values()) == [[2], [0, 0], [3]]


def test_a_part_left_for_later_too_often_brings_the_beam_back(rules: Any) -> None:
    """Part 7 binds the only robot at four hard places, one after the other, and is never let go of."""
    beam, oracle = bound_to_the_last(rules)
    beam.search.run()
    assert (beam.search.levels[-1].states[0] == 2).nonzero()[0].tolist() == [0, 7]
    late = []
    for beam._episode in (0, 0, 1, 2, 3):
        late.append(beam._left_too_long(10 + beam._episode))
    assert late == [-1, -1, -1, -1, 10]
    header, arrays = beam.pack()
    again = AdaptiveBeam.unpack(header, arrays, beam.search.task, oracle, guide=misled)
    assert again._left == beam._left == {7: [(0, 10), (1, 11), (2, 12), (3, 13)]}
    beam._return_before(10)
    assert len(beam.search.levels) == 1
    assert beam.search.settings.disorder > 0
    assert beam.search.settings.width == 1
    assert beam._left == {}
    assert beam.run(1).found


def test_returns_only_so_often_and_not_for_parts_let_go_of(rules: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    beam = AdaptiveBeam(Task.create(rules.ground(8), 1), rules.tower(8), AdaptiveSettings())
    while (beam.search.levels[-1].states[0] == 1).sum() < 3:
        beam.search.step()
    beam._left = {1: [(0, 1), (1, 2), (2, 3), (3, 4)]}
    assert beam._left_too_long(5) == -1
    assert 1 not in beam._left
    beam._left = {7: [(0, 1), (1, 2), (2, 3), (3, 4)]}
    assert beam._left_too_long(5) == 1
    monkeypatch.setattr("falsework.search.beam.adaptive._RETURNS", 0)
    assert beam._left_too_long(5) == -1


def test_other_chains_do_not_begin_beside_those_that_failed(rules: Any) -> None:
    """Parts 1 to 3 are in contact; from 4 on nothing touches what failed, so 4 comes before 2."""
    parts = 6
    oracle = rules.blocks(parts)
    contacts = [(1, 2), (2, 3), (3, 1)]
    task = Task.create(rules.ground(parts), 1, contacts=contacts)

    def first_fixed(avoided: tuple[int, ...]) -> int:
        search = BeamSearch(
            task,
            oracle,
            BeamSettings(width=1, lookahead=1, diversity="none", avoided=avoided),
            guide=lambda states, actions, way: -0.01 * misled(states, actions, way),
        )
        search.step()
        return int(search.levels[-1].action[0]) % parts

    assert first_fixed(()) == 1
    assert first_fixed((1,)) == 4


def test_stops_in_between_and_goes_on(rules: Any) -> None:
    task = Task.create(rules.ground(41), 1)
    whole = AdaptiveBeam(task, rules.tower(41), AdaptiveSettings(), guide=misled)
    expected = whole.run(256)
    halted = AdaptiveBeam(task, rules.tower(41), AdaptiveSettings(), guide=misled)
    limit = 10
    while True:
        calls = iter(range(limit))
        result = halted.run(256, stop=lambda calls=calls: next(calls, None) is None)
        if not result.interrupted:
            break
        header, arrays = halted.pack()
        halted = AdaptiveBeam.unpack(header, arrays, task, rules.tower(41), guide=misled)
    assert result.outcome is expected.outcome
    assert np.array_equal(halted.search.states(), whole.search.states())
    assert result.counters == expected.counters

"""The beam that jumps back from dead ends and restarts wider."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest

from falsework import Direction, Outcome, Task
from falsework.search import BeamSearch, BeamSettings
from falsework.search.beam.nogoods import Nogoods, luby


def misled(states: Any, actions: Any, direction: Direction) -> Any:
    """Prefers parts with high numbers, which a tower cannot take first."""
    parts = states.shape[1]
    return np.tile(np.arange(parts, dtype=float), 2)[None].repeat(len(states), axis=0)


def bound_to_the_last(rules: Any, parts: int = 8) -> tuple[Task, Any]:
    """A task of one robot and its oracle, in which the guide begins with a part that only stands last of all."""
    oracle = rules.blocks(parts)
    oracle.supports[parts - 1] = [frozenset(range(1, parts - 1))]
    oracle.supports[1 : parts - 1] = [[frozenset({part - 1})] for part in range(1, parts - 1)]
    return Task.from_rules(rules.ground(parts), 1), oracle


def narrow(task: Task, oracle: Any) -> BeamSearch:
    """A beam that has one candidate ahead, and so follows its guide into dead ends, where it ends."""
    return BeamSearch(task, oracle, BeamSettings(width=1, lookahead=1, diversity="none"), guide=misled)


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("seed", range(25))
def test_wide_enough_it_decides_like_the_enumeration(rules: Any, direction: Direction, seed: int) -> None:
    oracle, clearance = rules.random(seed, 7)
    task = Task.from_rules(rules.ground(7), 1 + seed % 2, clearance=clearance if seed % 3 == 0 else None)
    beam = BeamSearch(task, oracle, BeamSettings.from_width(1, direction))
    result = beam.run(4**6)
    possible = rules.enumeration(task, oracle).count() > 0
    assert result.found == possible
    assert result.outcome is (Outcome.FOUND if possible else Outcome.PROVED_IMPOSSIBLE)
    assert (beam.exhaustive and not beam.found) == (not possible)


def test_restarts_wider_where_narrow_beams_do_not_see_the_way(rules: Any) -> None:
    """Everything stands on part 90, which the guide puts last: no narrow beam has it among its candidates."""
    parts = 150
    oracle = rules.blocks(parts)
    oracle.supports[1:] = [[frozenset({90})] if part != 90 else [frozenset()] for part in range(1, parts)]

    def guide(states: Any, actions: Any, direction: Direction) -> Any:
        scores = np.ones((len(states), 2 * parts))
        scores[:, [90, parts + 90]] = -5.0
        return scores

    beam = BeamSearch(Task.from_rules(rules.ground(parts), 1), oracle, BeamSettings.from_width(), guide=guide)
    first = beam.run(1)
    assert first.outcome is Outcome.NOT_FOUND
    assert "up to a width of 1" in first.limit
    assert beam.run(64).found
    assert beam.settings.width > 1


def test_jumps_back_before_the_part_that_no_robot_can_let_go_of(rules: Any) -> None:
    task, oracle = bound_to_the_last(rules)
    search = narrow(task, oracle)
    search.run()
    assert search.done
    assert not search.found
    assert list(search.choices()) == [(0, 8 + 7)]
    assert np.array_equal(search.before(0), task.target)
    search.conflicts.learn(search.before(0), 8 + 7)
    search.rewind(0, search.settings)
    assert search.step()
    assert not search.exhaustive
    assert (search.levels[-1].states[:, 7] == 0).all()


def test_choices_begin_the_chains_of_held_parts(rules: Any) -> None:
    """Of two robots one waits at part 7, then parts 1 and 2 are laid one after the other by the second."""
    task, oracle = bound_to_the_last(rules)
    oracle.supports[3:7] = [[frozenset({7})]] * 4
    search = narrow(Task.from_rules(task.boundary, 2), oracle)
    search.run()
    (latest, action), *earlier = search.choices()
    held = [(search.before(number)[1:] == 2).sum() for number, _ in [(latest, action), *earlier]]
    assert (search.levels[-1].states[:, 1 + (action - 8) - 1] == 2).all()
    assert all(count <= 1 for count in held)
    assert [number for number, _ in earlier] == sorted((number for number, _ in earlier), reverse=True)


def test_a_beam_without_dead_ends_has_no_choices_to_take_back(rules: Any) -> None:
    search = BeamSearch(Task.from_rules(rules.ground(5), 2), rules.blocks(5), BeamSettings.from_width())
    assert list(search.choices()) == []
    assert search.run().found
    assert search.conflicts.count == 0


def test_a_choice_that_led_to_a_dead_end_is_not_made_again(rules: Any) -> None:
    task, oracle = bound_to_the_last(rules)
    beam = narrow(task, oracle)
    beam.run()
    assert beam.jump_back()
    rows, actions = beam.conflicts.barred(task.target[None])
    assert (rows.tolist(), actions.tolist()) == ([0], [8 + 7])
    beam.rewind(0, BeamSettings.from_width())
    assert beam.run(1).found


def test_prefers_other_parts_after_each_dead_end(rules: Any) -> None:
    """Before the first, the guide alone decides; each seed has preferences of its own."""
    task, orders = Task.from_rules(rules.ground(8), 8), []

    def even(states: Any, actions: Any, direction: Direction) -> Any:
        """Score all parts alike."""
        return np.zeros(actions.shape)

    def scores(settings: BeamSettings) -> Any:
        beam = BeamSearch(task, rules.blocks(8), settings, guide=even)
        assert beam.step()
        return beam.levels[-1].score

    for seed, number in ((0, 0), (0, 1), (0, 2), (1, 1)):
        settings = replace(BeamSettings.from_width(lookahead=4), seed=seed, number=number)
        found = scores(settings)
        np.testing.assert_array_equal(found, scores(settings))
        assert (found > 0).any() == (number > 0)
        orders.append(tuple(found.tolist()))
    assert len(set(orders)) == len(orders)


def test_forgets_the_states_used_longest_ago() -> None:
    conflicts, states = Nogoods(remembered=2), np.eye(3, dtype=np.uint8)
    for row, action in ((0, 4), (1, 5), (0, 6), (0, 6), (2, 7)):
        conflicts.learn(states[row], action)
    rows, actions = conflicts.barred(states)
    assert (rows.tolist(), actions.tolist()) == ([0, 0, 2], [4, 6, 7])
    assert conflicts.count == 5


def test_distances_follow_the_sequence_of_luby() -> None:
    assert [luby(number) for number in range(1, 16)] == [1, 1, 2, 1, 1, 2, 4, 1, 1, 2, 1, 1, 2, 4, 8]


@pytest.mark.parametrize("limit", [1, 7])
def test_stops_in_between_and_goes_on(rules: Any, limit: int) -> None:
    task, oracle = bound_to_the_last(rules, 41)
    settings = BeamSettings.from_width(lookahead=1)
    whole = BeamSearch(task, oracle, settings, guide=misled)
    expected = whole.run(64)
    assert whole.conflicts.count > 0
    halted = BeamSearch(task, oracle, settings, guide=misled)
    while True:
        calls = islice(iter([False] * 1000), limit)
        result = halted.run(64, stop=lambda calls=calls: next(calls, True))
        if not result.interrupted:
            break
        header, arrays = halted.pack()
        halted = BeamSearch.unpack(header, arrays, task, oracle, guide=misled)
    assert result.outcome is expected.outcome
    assert np.array_equal(halted.states(), whole.states())
    assert result.counters == expected.counters

"""The beam that widens where it dies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework.search import Direction, Outcome, Task
from falsework.search.beam.adaptive import AdaptiveBeam, AdaptiveSettings


def misled(states: Any, actions: Any, direction: Direction) -> Any:
    """Prefers parts with high numbers, which a tower cannot take first."""
    parts = states.shape[1]
    return np.tile(np.arange(parts, dtype=float), 2)[None].repeat(len(states), axis=0)


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
    parts = 140
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
    assert "beams of up to 1 states" in narrow.limit
    result = beam.run(64)
    assert result.found
    assert beam.search.settings.width == 1
    assert len(beam.search.levels[-20].states) <= 1 + 64


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

"""Search for the weakest of many families whose bounds are known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from falsework.stability.margins.brackets import Bracket
from falsework.stability.margins.conditions import Answer, Condition, OutOfTime
from falsework.stability.margins.weakest import Weakest

CAP = 100.0
CONDITION = Condition(0.5, np.zeros((1, 6)))
START = Answer(CONDITION, True)


class Families:
    """Families that stand up to given bounds, with all probes counted, in place of what solves for states.

    A condition is the number of a family, and a value.
    """

    convex, limited = True, False

    def __init__(self, bounds: list[float], hidden: dict[int, float] | None = None, most: int = -1) -> None:
        """Take the bounds; quick probes find none of the rest positions beyond those in `hidden`.

        After `most` probes the time is over.
        """
        self.bounds, self.hidden, self.most = bounds, hidden or {}, most
        self.probes, self.fails = Counter[int](), Counter[int]()

    def ask_each(self, _: Any, conditions: Sequence[tuple[int, float]], near: Sequence[Answer]) -> list[Answer]:
        assert all(start.stands for start in near)
        answers: list[Answer] = []
        for row, value in conditions:
            if answers and not answers[-1].stands:
                break
            if self.probes.total() == self.most:
                raise OutOfTime
            self.probes[row] += 1
            stands = value < min(self.bounds[row], self.hidden.get(row, np.inf))
            self.fails[row] += not stands
            answers.append(Answer(CONDITION, stands, coarse=True))
        return answers

    def ask(self, _: Any, condition: tuple[int, float]) -> Answer:
        row, value = condition
        self.hidden.pop(row, None)
        return Answer(CONDITION, value < self.bounds[row])

    def find(self, *, time_limited: bool = False) -> tuple[int, Bracket] | None:
        """Return the weakest family and its bracket."""
        self.limited = time_limited
        prober: Any = self
        state, families = np.ones(1, np.uint8), range(len(self.bounds))
        return Weakest(prober, state, START, self.under, families, guess=lambda _: 1.0, cap=CAP).find()

    @staticmethod
    def under(row: int, value: float) -> Any:
        return row, value

    def search(self) -> tuple[int, float, float] | None:
        """Return the weakest family and the ends of its bracket; None where none has a bound."""
        found = self.find()
        assert found is not None
        row, bracket = found
        if bracket.outside is None:
            assert bracket.inside == CAP
            return None
        assert bracket.fails is not None
        assert not bracket.fails.coarse  # confirmed
        return row, bracket.inside, bracket.outside


@pytest.mark.parametrize("seed", range(10))
def test_the_least_bound_is_found_within_one_percent(seed: int) -> None:
    bounds = np.exp(np.random.default_rng(seed).uniform(np.log(0.05), np.log(300), 36)).tolist()
    families = Families(bounds)
    found = families.search()
    assert found is not None
    _, inside, outside = found
    assert inside < 1.01 * min(bounds)
    assert outside <= 1.01 * inside
    assert min(bounds) * 0.99 < outside


def test_most_families_take_one_or_two_probes() -> None:
    families = Families([2.0, *[50.0] * 100])
    found = families.search()
    assert found is not None
    assert found[0] == 0
    assert max(families.probes[row] for row in range(1, 101)) <= 2
    assert sum(families.fails[row] for row in range(1, 101)) == 0


def test_equal_families_end_the_search() -> None:
    families = Families([3.0] * 36)
    found = families.search()
    assert found is not None
    assert found[1] < 3.0 <= found[2]
    assert families.probes.total() < 36 * 6


def test_without_a_bound_each_family_is_tried_at_the_cap() -> None:
    families = Families([1e9] * 20)
    assert families.search() is None
    assert max(families.probes[row] for row in range(1, 20)) == 1


def test_a_family_that_bears_more_from_rest_gives_way_to_the_next() -> None:
    """Quick probes end at 1, from rest it bears 8; the weakest is another."""
    found = Families([8.0, 5.0, 9.0], hidden={0: 1.0}).search()
    assert found is not None
    assert found[0] == 1
    assert 4.95 < found[1] < 5.0 <= found[2]


def test_a_family_without_a_bound_from_rest_has_none() -> None:
    assert Families([1e9, 1e9], hidden={1: 2.0}).search() is None


def test_when_the_time_is_over_all_bear_the_inner_end_and_one_fails_at_the_outer() -> None:
    bounds = [4.0, 2.5, 7.0, 3.0, 50.0, 20.0]
    widths = []
    for most in range(60):
        found = Families(bounds, most=most).find(time_limited=True)
        assert found is not None
        _, bracket = found
        assert bracket.inside < 2.5
        assert bracket.outside is None or bracket.outside >= 2.5
        assert bracket.inside >= 2.0 if most >= 30 else bracket.inside >= 0.125 or most < 6
        if bracket.finished:
            break
        widths.append(np.inf if bracket.outside is None else bracket.outside - bracket.inside)
    assert bracket.finished
    assert widths[0] == np.inf > widths[-1] > 0


def test_without_families_there_is_no_bound() -> None:
    assert Families([]).find() is None

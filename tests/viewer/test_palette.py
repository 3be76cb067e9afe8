"""Colours stay apart, for colour-blind eyes too."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from falsework.viewer.arrows import KINDS
from falsework.viewer.palette import (
    BOUNDARY,
    FIXED,
    INSTALLED,
    MISSING,
    RAMP,
    ROBOTS,
    SELECTED,
    difference,
    mix,
    ramp,
    ramp_in_steps,
    rgb,
    seen_by_deuteranope,
)


def test_red_and_green_are_one_to_a_deuteranope_but_not_to_others() -> None:
    """The simulation does what it is for: a red and a green of one lightness fall together."""
    red, green = np.array([170, 105, 40]), np.array([121, 121, 42])
    seen = np.abs(seen_by_deuteranope(red) - seen_by_deuteranope(green)).max()
    assert seen < 0.05
    assert np.abs((red / 255) ** 2.2 - (green / 255) ** 2.2).max() > 0.15


def test_grey_stays_grey() -> None:
    np.testing.assert_allclose(seen_by_deuteranope((128, 128, 128)), np.full(3, 0.2158605), atol=2e-3)


@pytest.mark.parametrize(
    ("one", "other"),
    list(combinations((INSTALLED, BOUNDARY, FIXED, MISSING, SELECTED, *ROBOTS[:4]), 2)),
)
def test_parts_are_told_apart(one: str, other: str) -> None:
    assert difference(one, other) > 15  # a just visible difference is about 2


@pytest.mark.parametrize(("one", "other"), list(combinations(KINDS, 2)))
def test_arrows_are_told_apart(one: str, other: str) -> None:
    assert difference(KINDS[one], KINDS[other]) > 25


def test_the_scale_of_probabilities_only_darkens() -> None:
    """Lightness alone tells the values apart, whatever the eyes."""
    share = ramp(np.linspace(0, 1, 33)) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    light = linear @ [0.2126, 0.7152, 0.0722]  # luminance, on which lightness depends alone
    assert (np.diff(light) < 0).all()
    np.testing.assert_array_equal(ramp([0.0, 1.0]), [rgb(RAMP[0]), rgb(RAMP[-1])])
    np.testing.assert_array_equal(ramp([-1.0, 2.0]), ramp([0.0, 1.0]))


def test_few_colours_are_near_the_many() -> None:
    values = np.linspace(0, 1, 1001)
    few = ramp_in_steps(values)
    assert len(np.unique(few, axis=0)) == 17
    assert np.abs(few.astype(int) - ramp(values).astype(int)).max() < 20


def test_mixing() -> None:
    assert mix("#000000", "#ffffff", 0.5) == "#808080"

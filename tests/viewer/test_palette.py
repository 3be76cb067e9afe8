"""Colours stay apart, for colour-blind eyes too, by the matrices of Machado, Oliveira and Fernandes (2009)."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from falsework.viewer.arrows import KINDS
from falsework.viewer.palette import (
    BOUNDARY,
    FIXED,
    INSTALLED,
    MISSING,
    RAMP,
    ROBOTS,
    SELECTED,
    ink_on,
    mix,
    ramp,
    ramp_in_steps,
    rgb,
    unit_rgb,
)

# Linear RGB as seen without medium-wave or without long-wave cones, severity 1.
_DEUTERANOPE = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
)
_PROTANOPE = np.array(
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
)


def seen_by_deuteranope(color: ArrayLike) -> NDArray[np.float64]:
    """Return the linear RGB that somebody without medium-wave cones sees; `color` is red, green, blue from 0 to 255."""
    return np.clip(_DEUTERANOPE @ _linear(color), 0.0, 1.0)


def seen_by_protanope(color: ArrayLike) -> NDArray[np.float64]:
    """Return the linear RGB that somebody without long-wave cones sees; `color` is red, green, blue from 0 to 255."""
    return np.clip(_PROTANOPE @ _linear(color), 0.0, 1.0)


def difference(one: str, other: str) -> float:
    """Return the distance of two colours for the least discerning eyes (CIE 1976, about 2 is just visible)."""
    eyes = (_linear, seen_by_deuteranope, seen_by_protanope)
    return min(float(np.linalg.norm(_lab(eye(rgb(one))) - _lab(eye(rgb(other))))) for eye in eyes)


def _linear(color: ArrayLike) -> NDArray[np.float64]:
    """Return the linear RGB from 0 to 1 of sRGB from 0 to 255."""
    value = np.asarray(color, dtype=float) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _lab(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIE L*a*b* of linear RGB, white point D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = (to_xyz @ linear) / to_xyz.sum(axis=1)
    fx, fy, fz = (value ** (1 / 3) if value > 216 / 24389 else (24389 / 27 * value + 16) / 116 for value in (x, y, z))
    return np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)])


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


@pytest.mark.parametrize("alpha", [0.3, 1.0])
def test_letters_on_the_colours_of_robots_can_be_read(alpha: float) -> None:
    """A contrast of 3, as WCAG 2 asks of graphics."""

    def luminance(color: str, alpha: float = 1.0) -> float:
        channels = np.array(unit_rgb(color)) * alpha + 1 - alpha
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    for color in ROBOTS:
        levels = sorted((luminance(color, alpha), luminance(ink_on(color, alpha))))
        assert (levels[1] + 0.05) / (levels[0] + 0.05) >= 3, color

"""Quantities as people write them."""

from __future__ import annotations

import math

import pytest

from falsework.utils.quantity import counted, format_quantity, parse_quantity


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (0.83, "length", "830 mm"),
        (2.1449, "length", "2.14 m"),
        (2080.0, "length", "2,080 m"),
        (0.9996, "length", "1 m"),
        (6.03e-6, "length", "0.00603 mm"),
        (1e-9, "length", "less than 0.001 mm"),
        (0.0, "moment", "0 Nm"),
        (1.25e-5, "moment", "less than 0.001 Nm"),
        (10640.0, "mass", "10.6 t"),
        (999.6, "mass", "1 t"),
        (3660.0, "force", "3.66 kN"),
        (-3660.0, "force", "-3.66 kN"),
        (2.16e-4, "volume", "216 cm3"),
        (1e6, "stiffness", "1 MN/m"),
        (math.radians(2.4789), "angle", "2.48 deg"),
        (0.0831, "share of gravity", "0.0831 g"),
        (1.25, "factor", "1.25"),
        (math.inf, "force", "unlimited"),
    ],
)
def test_units_suit_the_size(value: float, kind: str, text: str) -> None:
    assert format_quantity(value, kind) == text


@pytest.mark.parametrize("kind", ["length", "force", "moment"])
def test_what_is_written_is_read(kind: str) -> None:
    """Three digits hold half a percent."""
    for exponent in range(-4, 7):
        for factor in (1.0, 1.2345, 9.996):
            value = factor * 10.0**exponent * (1e-3 if kind == "length" else 1.0) * 100
            text = format_quantity(value, kind)
            assert "e" not in text
            assert parse_quantity(text.replace(",", ""), kind, "--test") == pytest.approx(value, rel=5.1e-3)


@pytest.mark.parametrize(("number", "text"), [(0, "0 states"), (1, "1 state"), (2, "2 states")])
def test_counts_agree_with_their_nouns(number: int, text: str) -> None:
    assert counted(number, "state") == text

"""Quantities as people write them."""

from __future__ import annotations

import ast
import math
import re
from pathlib import Path

import pytest

import falsework
from falsework.utils.quantity import counted, format_bound, format_number, format_quantity, parse_quantity


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
        (8.7e-6, "share", "less than 0.001 %"),
        (0.00077, "share", "0.077 %"),
        (0.12, "share", "12 %"),
        (3e-4, "area", "3 cm2"),
        (127.0, "factor", "127"),
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


@pytest.mark.parametrize(
    ("value", "text"), [(1.27e-7, "0.000000127"), (250.0, "250"), (1.27e7, "12700000"), (-0.5, "-0.5"), (0.0, "0")]
)
def test_numbers_to_type_have_no_exponent(value: float, text: str) -> None:
    assert format_number(value) == text
    assert float(text) == value


def test_no_text_of_the_package_has_a_number_with_an_exponent() -> None:
    """Formats that write exponents are for numbers that are rounded by them, and for files of USD."""
    root = Path(falsework.__file__).parent
    found = []
    for file in sorted(root.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if not re.search(r"[eg]\}", text):
            continue  # to parse all files takes long
        tree = ast.parse(text)
        rounded = {
            id(value)
            for call in ast.walk(tree)
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "float"
            for argument in call.args
            for value in ast.walk(argument)
        }
        found += [
            f"{file.relative_to(root)}:{value.lineno}"
            for value in ast.walk(tree)
            if isinstance(value, ast.FormattedValue) and value.format_spec is not None and id(value) not in rounded
            if re.search(r"\.[^.]*[eg]'?$", ast.unparse(value.format_spec).removesuffix("'").removesuffix('"'))
        ]
    allowed = {"utils/quantity.py", "interop/usd.py"}
    assert [place for place in found if place.split(":")[0] not in allowed] == []


def test_a_bound_is_one_phrase() -> None:
    assert format_bound(0.003, "length") == "at most 3 mm"
    assert format_bound(1e-9, "length") == "less than 0.001 mm"

"""Numbers that users give and read: quantities with units, counts, and random seeds."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from decimal import Decimal
from numbers import Integral, Real
from typing import Any, TypeGuard

from falsework.errors import InputError

UNITS: dict[str, dict[str, float]] = {
    "angle": {"deg": math.pi / 180, "rad": 1.0},
    "force": {"N": 1.0, "kN": 1e3},
    "moment": {"Nm": 1.0, "kNm": 1e3},
    "length": {"mm": 1e-3, "cm": 1e-2, "m": 1.0},
    "duration": {"s": 1.0, "min": 60.0},
    "share of gravity": {"g": 1.0},
    "factor": {"": 1.0},
}
"""Units of each kind of quantity, and their size in SI units."""

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]*)\s*")


def parse_quantity(text: str, kind: str, option: str) -> float:
    """Read a number with its unit, such as `2deg` or `20 N`, and return it in SI units.

    Args:
        kind: one of `UNITS`.
    """
    units = UNITS[kind]
    match = _QUANTITY.fullmatch(text)
    wanted = " or ".join(f"2{unit}" for unit in units if unit) or "a number without a unit, such as 1.25"
    if match is None:
        raise InputError(f"{option}: {text!r} is no {kind}; give {wanted}")
    number, unit = float(match[1]), match[2]
    if unit not in units:
        said = f"has the unit {unit}" if unit else "has no unit"
        raise InputError(f"{option}: {text!r} {said}; give {wanted}")
    if not (math.isfinite(number) and number > 0):
        raise InputError(f"{option}: {text!r} is not above zero; give {wanted}")
    return number * units[unit]


def listed(items: Sequence[str], most: int = 5, noun: str = "") -> str:
    """Return the first of many names, and the number of the others, each a `noun` if given."""
    more = len(items) - most
    rest = f" and {more} more{f' {noun}' if noun else ''}" if more > 0 else ""
    return ", ".join(items[:most]) + rest


def counted(number: int, noun: str) -> str:
    """Return a number and what it counts, such as `1 step` or `2 steps`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


_SCALES: dict[str, tuple[tuple[float, str], ...]] = {
    "length": ((1e-3, "mm"), (1.0, "m")),
    "mass": ((1.0, "kg"), (1e3, "t")),
    "force": ((1.0, "N"), (1e3, "kN")),
    "moment": ((1.0, "Nm"), (1e3, "kNm")),
    "area": ((1e-6, "mm2"), (1e-4, "cm2"), (1.0, "m2")),
    "volume": ((1e-6, "cm3"), (1e-3, "dm3"), (1.0, "m3")),
    "stiffness": ((1.0, "N/m"), (1e3, "kN/m"), (1e6, "MN/m")),
    "angle": ((math.pi / 180, "deg"),),
    "duration": ((1.0, "s"),),
    "share of gravity": ((1.0, "g"),),
    "share": ((1e-2, "%"),),
    "factor": ((1.0, ""),),
}
"""Units in which each kind of quantity is written, and their size in SI units, the smallest first."""
_DIGITS = 3
"""Significant digits of a quantity that is written."""
_LEAST = 1e-3
"""Least share of the smallest unit that is written in digits."""


def format_quantity(value: float, kind: str, digits: int = _DIGITS) -> str:
    """Write a quantity as people do: in the unit that suits its size, without an exponent.

    Args:
        value: in SI units.
        kind: length, mass, force, moment, area, volume, stiffness, angle, duration, share of gravity, share or factor.
    """
    value = float(value)
    size = abs(value)
    if not math.isfinite(value):
        return "no number" if math.isnan(value) else f"{'-' * (value < 0)}unlimited"
    scales = _SCALES[kind]
    scale, unit = next((entry for entry in reversed(scales) if _rounded(size / entry[0], digits) >= 1.0), scales[0])
    number = _rounded(size / scale, digits)
    if 0 < number < _LEAST:
        return f"less than {_LEAST:g} {unit}".rstrip()
    whole = number >= 10**digits
    text = f"{number:,.0f}" if whole else f"{number:.{digits}g}"
    return f"{'-' * (value < 0 and number > 0)}{text} {unit}".rstrip()


def format_bound(value: float, kind: str) -> str:
    """Write an upper bound of a quantity: `at most 3 mm`, or `less than 0.001 mm`."""
    text = format_quantity(value, kind)
    return text if text.startswith("less than") else f"at most {text}"


def format_number(value: float, digits: int = _DIGITS) -> str:
    """Write a number as options and files take it: without a unit, an exponent, or commas."""
    return f"{Decimal(f'{float(value) + 0.0:.{digits}g}'):f}"


def _rounded(value: float, digits: int) -> float:
    """Round to the digits that are written."""
    return float(f"{value:.{digits}g}")


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value of a file is a number, which true and false are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_whole(value: Any) -> TypeGuard[int]:
    """Return whether a value is a whole number of Python or NumPy, which true and false are not."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def check_deadline(deadline: float | None) -> None:
    """Raise unless a deadline in seconds leaves time.

    Raises:
        InputError: it is zero, less, or no number.
    """
    if deadline is None:
        return
    if not isinstance(deadline, Real):
        raise InputError(f"a deadline of {deadline!r} is no number; give seconds")
    if not float(deadline) > 0:
        raise InputError(f"a deadline of {deadline:g} s leaves no time; give more than 0")


def check_positive(settings: object, *names: str) -> None:
    """Raise unless some numbers among settings are finite and above zero."""
    for name in names:
        value = getattr(settings, name)
        if not (isinstance(value, Real) and 0 < float(value) < math.inf):
            raise InputError(f"{name} is {value}; give a positive number")


def check_whole(**numbers: object) -> None:
    """Raise unless some numbers, which are given by their names, are whole."""
    for name, value in numbers.items():
        if not is_whole(value):
            raise InputError(f"{name} is {value!r}; give a whole number")


def check_counts(settings: object, *names: str) -> None:
    """Raise unless some numbers among settings are whole and at least 1."""
    for name in names:
        value = getattr(settings, name)
        check_whole(**{name: value})
        if value < 1:
            raise InputError(f"{name} is {value}; give at least 1")


def check_step_seconds(seconds: float) -> None:
    """Raise unless a step of a plan in motion may last for some seconds.

    Raises:
        InputError: it is too short or too long to be seen, or no number.
    """
    if not 1e-3 <= seconds <= 1e3:
        raise InputError(f"a step of {seconds:g} seconds cannot be seen; give 0.001 to 1000")


def check_seed(seed: int) -> None:
    """Raise unless a number can be a random seed."""
    if not is_whole(seed):
        raise InputError(f"a seed is a whole number; {seed!r} was given")
    if seed < 0:
        raise InputError(f"a seed is not negative; {seed} was given")

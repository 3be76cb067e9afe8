"""Numbers that users give: quantities with units, and random seeds."""

from __future__ import annotations

import math
import re

from falsework.errors import InputError

UNITS: dict[str, dict[str, float]] = {
    "angle": {"deg": math.pi / 180, "rad": 1.0},
    "force": {"N": 1.0, "kN": 1e3},
    "moment": {"Nm": 1.0, "kNm": 1e3},
    "length": {"mm": 1e-3, "cm": 1e-2, "m": 1.0},
    "share of gravity": {"g": 1.0},
    "factor": {"": 1.0},
}
"""Units of each kind of quantity, and their size in SI units."""

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-z]*)\s*")


def parse_quantity(text: str, kind: str, option: str) -> float:
    """Read a number with its unit, such as `2deg` or `20 N`, and return it in SI units.

    Args:
        text: number and unit; a factor has no unit.
        kind: one of `UNITS`.
        option: what the text belongs to, for the message.

    Raises:
        InputError: no number, another unit, none where there must be one, or a number that is not above zero.
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


def check_seed(seed: int) -> None:
    """Raise unless a number can be a random seed.

    Raises:
        InputError: it is negative.
    """
    if seed < 0:
        raise InputError(f"a seed is not negative; {seed} was given")

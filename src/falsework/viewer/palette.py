"""Colour scheme of page and pictures, safe for colour-blind viewers.

The robots' colours are those of Okabe and Ito (2008).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

INSTALLED = "#dccdb2"
BOUNDARY = "#56585c"
ROBOTS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9")
"""By robot, counted from 0; from the seventh on they repeat, and the label identifies the robot."""
SELECTED = "#fffb8f"
MISSING = "#b2182b"
"""Absent part, drawn as wires."""
FIXED = "#14241c"
"""Part not to be touched: darker than boundary."""
INK = "#22252a"

FORCE = "#1f4fd8"
FRICTION = "#d7263d"
GRAVITY = "#f08c00"
PRESS = "#3a0060"
"""Force with which a robot presses a part that it holds."""
MOTION = "#00c08b"
SLIDING = "#48d8f0"
"""Parts that slide, and their motion."""

RAMP = ("#dccdb2", "#d98aa5", "#a34a8f", "#5f2276", "#2a0845")
"""From probability 0 to 1 of an action; lightness decreases monotonically."""

_EQUAL = 0.218
"""Relative luminance at which `INK` and white have the same contrast, after WCAG 2."""

STEPS = 16
"""Number of steps of the colour scale of parts."""


def rgb(color: str) -> tuple[int, int, int]:
    """Return red, green, blue from 0 to 255 of a colour such as `#0072b2`."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def hex_of(color: ArrayLike) -> str:
    """Return a colour such as `#0072b2` of red, green, blue from 0 to 255."""
    return "#" + "".join(f"{int(channel):02x}" for channel in np.asarray(color))


def unit_rgb(color: str) -> tuple[float, float, float]:
    """Return red, green, blue from 0 to 1."""
    red, green, blue = rgb(color)
    return red / 255, green / 255, blue / 255


def ink_on(color: str, alpha: float = 1.0) -> str:
    """Return the colour of letters on a colour over white: dark, or white where that has more contrast."""
    linear = linear_rgb(np.array(unit_rgb(color)) * alpha + 1 - alpha)
    return INK if linear @ (0.2126, 0.7152, 0.0722) > _EQUAL else "#ffffff"


def linear_rgb(channels: ArrayLike) -> NDArray[np.float64]:
    """Return red, green, blue as renderers compute with them, of those from 0 to 1 that screens show (sRGB)."""
    values = np.asarray(channels, dtype=float)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def bytes_of(color: Sequence[float]) -> tuple[int, int, int]:
    """Return red, green, blue from 0 to 255 of those from 0 to 1."""
    red, green, blue = (round(255 * channel) for channel in color)
    return red, green, blue


def robot_color(robot: int) -> str:
    """Return the colour of a robot, counted from 0."""
    return ROBOTS[robot % len(ROBOTS)]


def ramp(values: ArrayLike) -> NDArray[np.uint8]:
    """Return colours on the scale of probabilities.

    Args:
        values: from 0 to 1, any shape; values outside count as the nearest end.

    Returns:
        Red, green, blue from 0 to 255, shape (..., 3).
    """
    stops, place = np.array([rgb(color) for color in RAMP]).T, np.asarray(values, dtype=float) * (len(RAMP) - 1)
    return np.rint(np.stack([np.interp(place, range(len(RAMP)), stop) for stop in stops], axis=-1)).astype(np.uint8)


def ramp_in_steps(values: ArrayLike) -> NDArray[np.uint8]:
    """Quantize `ramp` to seventeen colours, so that parts of one colour are drawn together."""
    return ramp(np.rint(np.asarray(values, dtype=float) * STEPS) / STEPS)


def mix(color: str, other: str, share: float) -> str:
    """Return a colour with a share of another in it."""
    mixed = (1 - share) * np.array(rgb(color)) + share * np.array(rgb(other))
    return hex_of(np.rint(mixed))

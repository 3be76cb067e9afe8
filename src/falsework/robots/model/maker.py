"""Makers of arms: as the cell states them, or after the name of the arm."""

from __future__ import annotations

import re

from falsework.robots.model.cell import CellRobot

_NAMES = {
    "ABB": re.compile(r"(abb[\W_]|(abb[\W_]?)?(irb|crb)[\W_]?\d)", re.IGNORECASE),
    "Universal Robots": re.compile(r"(universal[\W_]?robots?|ur(\d+(e|cb\d?)?)?)($|[\W_])", re.IGNORECASE),
}
"""Beginnings of names of models: built-in arms, and robot names of URDF files."""


def maker_of(robot: CellRobot) -> tuple[str | None, bool]:
    """Return the maker of an arm, and whether it is only taken from the name in a URDF file; None if it is unknown."""
    if robot.maker is not None:
        return robot.maker, False
    name = robot.model.name
    found = next((maker for maker, pattern in _NAMES.items() if pattern.match(name)), None)
    return found, found is not None and robot.model.source != "built-in"

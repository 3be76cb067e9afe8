"""List of the steps of a timeline, in HTML."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from falsework.viewer.palette import robot_color
from falsework.viewer.timeline import NO_ROBOT
from falsework.viewer.web.links import link_to
from falsework.viewer.web.markup import html_text

if TYPE_CHECKING:
    from falsework.viewer.timeline import Timeline

_CELL = "padding:1px 6px 1px 0"


def matching_steps(timeline: Timeline, search: str) -> list[int]:
    """Return the places of the steps whose number or words contain every word of a search; all if it is empty."""
    wanted = search.lower().split()
    found = []
    for place in range(1, len(timeline) + 1):
        text = f"{place} {timeline.words(place - 1)} {robot_words(timeline, place)}".lower()
        if all(word in text for word in wanted):
            found.append(place)
    return found


def robot_words(timeline: Timeline, place: int) -> str:
    """Return the robot of the step that leads to a place, such as `R2`; empty if none holds the part."""
    robot = timeline.robot_of(place - 1)
    return "" if robot == NO_ROBOT else f"R{robot + 1}"


def step_list(
    timeline: Timeline, places: Collection[int] | None = None, *, now: int | None = None, linked: bool = False
) -> str:
    """Return a table of steps: number, robot, action.

    Args:
        timeline: timeline whose steps are listed.
        places: places that the steps lead to; all if not given.
        now: place that is marked.
        linked: whether a click on a step goes there.
    """
    rows = []
    for place in range(1, len(timeline) + 1) if places is None else places:
        robot = timeline.robot_of(place - 1)
        color = "transparent" if robot == NO_ROBOT else robot_color(robot)
        words = html_text(timeline.words(place - 1))
        back = ";background:#fffb8f" if place == now else ""
        rows.append(
            f"<tr style='border-left:4px solid {color}{back}'><td style='{_CELL};padding-left:6px;text-align:right'>"
            f"{place}</td><td style='{_CELL}'>{robot_words(timeline, place)}</td>"
            f"<td style='{_CELL}'>{link_to(place, words) if linked else words}</td></tr>"
        )
    return f"<table style='border-collapse:collapse;font-size:0.85em'>{''.join(rows)}</table>"

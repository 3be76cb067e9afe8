"""List of the steps of a timeline, in HTML, and the tab of the page with it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from falsework.viewer.palette import SELECTED, robot_color
from falsework.viewer.web.links import link_to
from falsework.viewer.web.markup import html_text

if TYPE_CHECKING:
    from falsework.viewer.page.host import Host
    from falsework.viewer.timeline import Timeline

_CELL = "padding:1px 6px 1px 0;text-align:left"
_ROW = "falsework-step-"
"""Identifier of the row of a step, before the place that it leads to."""


def matching_places(timeline: Timeline, search: str) -> list[int]:
    """Return the places of the steps whose number or words contain every word of a search; all if it is empty."""
    wanted, found = search.lower().split(), []
    for place in timeline.places[1:]:
        step = timeline.step_to(place)
        assert step is not None
        text = f"{step.number} {step.told(timeline.robot_name)}".lower().split()
        if all(any(part in word for word in text) for part in wanted):
            found.append(place)
    return found


def step_list(timeline: Timeline, places: Iterable[int] | None = None, *, linked: bool = False) -> str:
    """Return a table of steps: number, robot, action.

    Args:
        places: places that the steps lead to; all if not given.
    """
    rows = []
    for place in timeline.places[1:] if places is None else places:
        step = timeline.step_to(place)
        assert step is not None
        color = "transparent" if step.robot is None else robot_color(step.robot)
        words = html_text(step.words_by(timeline.robot_name))
        rows.append(
            f"<tr id='{_ROW}{place}' style='border-left:4px solid {color}'>"
            f"<td style='{_CELL};padding-left:6px;text-align:right'>{step.number}</td>"
            f"<td style='{_CELL}'>{html_text(step.by(timeline.robot_name))}</td>"
            f"<td style='{_CELL}'>{link_to('step', place, words) if linked else words}</td></tr>"
        )
    return f"<table style='border-collapse:collapse;font-size:0.85em'>{''.join(rows)}</table>"


class StepsTab:
    """Tab with the list of steps and a search in it; a click on a step goes there."""

    def __init__(self, gui: Any, page: Host) -> None:
        """Fill the tab."""
        self._page = page
        self._timeline: Timeline | None = None
        self._search = gui.add_text("Search", "", hint="A part, a robot such as R2, a number or an action.")
        self._search.on_update(lambda event: page.guard(event, self._list))
        self._rows = gui.add_html("")
        self._now = gui.add_html("")

    def update(self) -> None:
        """Mark the present step, and list the steps anew if they have changed."""
        if self._page.model.timeline is not self._timeline:
            self._list()
        row = f"#{_ROW}{self._page.model.step}"
        style = f"<style>{row} {{ background: {SELECTED}; position: sticky; top: 0; bottom: 0; }}</style>"
        if self._now.content != style:
            self._now.content = style

    def _list(self) -> None:
        self._timeline = timeline = self._page.model.timeline
        places = matching_places(timeline, self._search.value)
        found = step_list(timeline, places, linked=True) if places else "no step matches"
        self._rows.content = f"<div style='margin:0 1em;max-height:45vh;overflow:auto'>{found}</div>"

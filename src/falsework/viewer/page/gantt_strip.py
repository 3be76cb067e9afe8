"""Gantt chart below the slider of the page, with a marker at the current time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from falsework.viewer.pictures.gantt import GanttChart, strip_of

if TYPE_CHECKING:
    from falsework.viewer.arms import Arms

_WIDTH = 380
"""Approximate width of the controls of the page, pixels."""


class GanttStrip:
    """Chart of the current plan; empty for plans without a schedule."""

    def __init__(self, gui: Any) -> None:
        """Add an empty strip to `viser.GuiApi`."""
        self._node = gui.add_html("")
        self._arms: Arms | None = None
        self._chart: GanttChart | None = None

    def show(self, arms: Arms | None, seconds: float) -> None:
        """Show the chart of the plan of some arms, and mark a time of its schedule."""
        if arms is not self._arms:
            self._arms = arms
            self._chart = None if arms is None or arms.clock is None else strip_of(arms.plan, _WIDTH)
        content = "" if self._chart is None else self._chart.html(seconds)
        if content != self._node.content:
            self._node.content = content

"""Gantt chart of a robot plan: when each arm moves, holds a part in place, and waits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import bars_of
from falsework.viewer.palette import INK, ink_on, rgb, robot_color
from falsework.viewer.pictures.graph_picture import figure_pixels
from falsework.viewer.pictures.picture import figure_class, save_figure

_WIDTH, _ROW = 12.0, 0.55
"""Width of the chart and height of the row of an arm, inches."""
_STRIP_ROW = 0.26
"""Height of the row of an arm in a strip below a picture, inches."""
_KEY_FROM = 5.0
"""Least width of a strip with its legend below, inches."""
_DOTS = 100
"""Pixels per inch."""
KEY = "high: carries a part; low: moves without one; pale: holds a part at its place; gap: waits"
"""Legend of the bars."""
ALPHA = {"moves": 1.0, "carries": 1.0, "holds": 0.35}
"""Opacity of the bars of an activity."""
_LETTER = 0.08
"""Width of a letter in a bar, inches."""


@dataclass(frozen=True, eq=False)
class GanttChart:
    """A chart as a figure, on which times can be marked."""

    figure: Any
    bars: int
    makespan: float

    @classmethod
    def from_plan(cls, plan: RobotPlan, *, width: float = _WIDTH, title: str | None = "") -> GanttChart:
        """Draw the chart.

        Args:
            width: of the figure, inches.
            title: a line above, of the plan if empty; None for a low strip without one.
        """
        bars, strip = bars_of(plan), title is None
        rows = len(plan.robots)
        height = (0.55 if width > _KEY_FROM else 0.35) + _STRIP_ROW * rows if strip else 1.3 + _ROW * rows
        figure = figure_class("Gantt charts")(figsize=(width, height), layout="constrained")
        axes = figure.add_subplot()
        for bar in bars:
            edge: dict[str, Any] = {"edgecolor": INK, "linewidth": 1.0 if bar.does == "carries" else 0.3}
            color, alpha = robot_color(bar.robot), ALPHA[bar.does]
            thick = 0.4 if bar.does == "moves" else 0.7
            axes.barh(bar.robot, bar.end - bar.begin, left=bar.begin, height=thick, color=color, alpha=alpha, **edge)
            name = "" if bar.part is None else plan.plan.part_names[bar.part]
            inches = (bar.end - bar.begin) / max(plan.makespan, 1e-3) * 0.9 * width
            if name and not strip and len(name) * _LETTER < inches:
                middle = (bar.begin + bar.end) / 2
                axes.text(
                    middle,
                    bar.robot,
                    name,
                    fontsize=8,
                    ha="center",
                    va="center",
                    color=ink_on(color, alpha),
                    parse_math=False,
                )
        axes.set_yticks(range(rows), [robot.name for robot in plan.robots], parse_math=False)
        axes.set_ylim(rows - 0.5, -0.5)
        axes.set_xlim(0.0, max(plan.makespan, 1e-3))
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        if strip:
            axes.tick_params(labelsize=7)
            if width > _KEY_FROM:
                axes.set_xlabel(f"seconds; {KEY}", fontsize=7)
        else:
            axes.set_xlabel(f"seconds; {KEY}")
            times = f"{plan.makespan:.1f} s, one after the other {plan.seconds:.1f} s"
            axes.set_title(title or f"{plan.plan.name}: {times}", parse_math=False)
        return cls(figure, len(bars), plan.makespan)

    @cached_property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, width and height of the axes, as shares of the figure; the top is counted from above."""
        self.figure.draw_without_rendering()
        left, bottom, width, height = self.figure.axes[0].get_position().bounds
        return left, 1 - bottom - height, width, height

    def mark(self, seconds: float) -> float:
        """Return where a time is, as a share of the width of the figure."""
        return self.box[0] + self.box[2] * min(max(seconds / max(self.makespan, 1e-3), 0.0), 1.0)

    @cached_property
    def pixels(self) -> NDArray[np.uint8]:
        """The chart as an image of 100 pixels an inch and of even height, shape (height, width, 3)."""
        image = figure_pixels(self.figure, _DOTS)
        return np.pad(image, ((0, len(image) % 2), (0, 0), (0, 0)), constant_values=255)

    def marked(self, seconds: float) -> NDArray[np.uint8]:
        """Return the image with a marker, two pixels wide, at a time; shape (height, width, 3)."""
        image, (_, top, _, high) = self.pixels.copy(), self.box
        rows, columns = image.shape[:2]
        column = min(round(self.mark(seconds) * columns), columns - 1)
        image[round(top * rows) : round((top + high) * rows), max(column - 1, 0) : column + 1] = rgb(INK)
        return image


def draw_gantt(plan: RobotPlan, path: Path, *, width: int = 0, title: str = "") -> int:
    """Draw the chart as PNG or SVG, and return the number of bars.

    Args:
        width: pixels across; 0 chooses.
    """
    chart = GanttChart.from_plan(plan, title=title)
    save_figure(chart.figure, path, width / _WIDTH or _DOTS)
    return chart.bars


def strip_of(plan: RobotPlan, width: int) -> GanttChart:
    """Return a low chart for below a picture that is `width` pixels across."""
    # A quarter of a pixel more, since matplotlib rounds down.
    return GanttChart.from_plan(plan, width=(width + 0.25) / _DOTS, title=None)

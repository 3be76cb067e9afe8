"""Plots over the time of a robot plan as SVG for the page: joints and clearance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.utils.quantity import format_quantity
from falsework.viewer.palette import INK, ROBOTS, robot_color
from falsework.viewer.pictures.joint_plot import joint_shares
from falsework.viewer.web.links import link_to
from falsework.viewer.web.markup import html_text

if TYPE_CHECKING:
    from falsework.robots.model.cell import Cell
    from falsework.robots.motion.near_pairs import NearPair
    from falsework.robots.plans.robot_plan import RobotPlan

WIDTH, AXIS = 360.0, 16.0
"""Width of a chart, height of its axis, pixels."""
CLEARANCE, CLEARANCE_TIMES = 0.1, 150
"""Largest clearance that is plotted, metres, and number of times at which it is computed."""
_HEIGHT, _TICKS = 70.0, 5
"""Height of a plot, pixels; intervals between the times below a chart."""
_POINTS = 240
"""Points of a curve."""
_COLORS = (*ROBOTS, INK)


@dataclass(frozen=True, eq=False)
class Curve:
    """Line of a plot."""

    name: str
    color: str
    times: NDArray[np.float64]
    """Seconds, ascending, shape (points,)."""
    values: NDArray[np.float64]
    """Shape (points,)."""


def time_axis(base: float, span: float) -> str:
    """Return the numbers below a chart that is so many pixels high and covers so many seconds, in SVG."""
    texts = []
    for tick in range(_TICKS + 1):
        x, anchor = WIDTH * tick / _TICKS, "start" if tick == 0 else "end" if tick == _TICKS else "middle"
        texts.append(
            f'<text x="{x:.1f}" y="{base + 10:.0f}" font-size="8" fill="{INK}" text-anchor="{anchor}">'
            f"{span * tick / _TICKS:.1f}</text>"
        )
    return "".join(texts)


def marked_chart(inside: str, base: float, label: str, kind: str = "plot") -> str:
    """Return a chart with the marker of the present time, in HTML."""
    return (
        f'<svg class="falsework-{kind}" viewBox="0 0 {WIDTH:.0f} {base + AXIS:.0f}" '
        f'style="display:block;width:100%;height:auto" role="img" aria-label="{html_text(label)}">{inside}'
        f'<rect class="falsework-now" x="0" y="0" width="1.5" '
        f'height="{base:.0f}" fill="{INK}"/></svg>'
    )


def plot_svg(title: str, curves: Sequence[Curve], span: float, ends: tuple[float, float], words: Sequence[str]) -> str:
    """Return a plot of curves over so many seconds, in HTML.

    Args:
        title: line above.
        span: seconds of the plan.
        ends: values at the lower and the upper end of the axis.
        words: names of values at equal distances between the ends, from the lower one on.
    """
    low, high = ends
    drawn = []
    for number, word in enumerate(words):
        y = 6 + _HEIGHT * (1 - number / (len(words) - 1))
        drawn.append(f'<line x1="0" x2="{WIDTH:.0f}" y1="{y:.1f}" y2="{y:.1f}" stroke="#d5d7da" stroke-width="0.7"/>')
        drawn.append(f'<text x="1" y="{y - 1.5:.1f}" font-size="7" fill="{INK}">{html_text(word)}</text>')
    for curve in curves:
        times = curve.times
        if len(times) > _POINTS:
            times = np.linspace(times[0], times[-1], _POINTS)
        values = np.interp(times, curve.times, curve.values)
        x, y = WIDTH * times / span, 6 + _HEIGHT * (1 - np.clip((values - low) / (high - low), 0, 1))
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
        name = f"<title>{html_text(curve.name)}</title>"
        drawn.append(f'<polyline points="{points}" fill="none" stroke="{curve.color}">{name}</polyline>')
    base = _HEIGHT + 8
    drawn.append(time_axis(base, span))
    key = " ".join(f'<span style="color:{curve.color}">&#9632;</span> {html_text(curve.name)}' for curve in curves)
    return (
        f'<div style="margin:4px 1em;font-size:11px"><b>{html_text(title)}</b>'
        f"{marked_chart(''.join(drawn), base, title)}<div>{key}</div></div>"
    )


def joint_plots(plan: RobotPlan, cell: Cell) -> str:
    """Return plots of position and speed of the joints of all arms, as shares of their limits, in HTML."""
    span, plots = max(plan.makespan, 1e-3), []
    for robot, record in enumerate(plan.robots):
        times, positions, rates = joint_shares(plan, cell, robot)
        for what, values, words in (
            ("position", positions, ("lower limit", "middle", "upper limit")),
            ("speed", rates, ("-limit", "0", "limit")),
        ):
            curves = [
                Curve(name, _COLORS[joint % len(_COLORS)], times, values[:, joint])
                for joint, name in enumerate(record.joint_names)
            ]
            plots.append(plot_svg(f"{record.name}: {what} of joints", curves, span, (-1.0, 1.0), words))
    return "".join(plots)


def clearance_plot(plan: RobotPlan, times: NDArray[np.float64], found: Sequence[Sequence[NearPair | None]]) -> str:
    """Return a plot of the distance of each arm to the nearest body, and where it is least, in HTML.

    Args:
        times: seconds.
        found: as `clearances` returns them.
    """
    curves, least = [], []
    for robot, (record, pairs) in enumerate(zip(plan.robots, found, strict=True)):
        values = np.array([CLEARANCE if pair is None else max(pair.distance, 0.0) for pair in pairs])
        curves.append(Curve(record.name, robot_color(robot), times, values))
        row = int(values.argmin())
        pair = pairs[row]
        if pair is not None:
            words = f"{pair.first} and {pair.second}, {format_quantity(values[row], 'length')}, at {times[row]:.1f} s"
            least.append(f"<div>least: {link_to('seconds', times[row], html_text(words))}</div>")
    step = format_quantity(float(times[1] - times[0]), "duration")
    top = format_quantity(CLEARANCE, "length")
    words = ("0", format_quantity(CLEARANCE / 2, "length"), f"{top} or more")
    title = f"distance of arms to what they do not grip, every {step}"
    plot = plot_svg(title, curves, max(plan.makespan, 1e-3), (0.0, CLEARANCE), words)
    return f'{plot}<div style="margin:0 1em;font-size:11px">{"".join(least)}</div>'

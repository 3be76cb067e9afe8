"""Gantt chart as SVG for the page: bars with names that go to their beginning when clicked."""

from __future__ import annotations

from typing import TYPE_CHECKING

from falsework.robots.plans.timeline import bars_of
from falsework.viewer.palette import INK, ink_on, robot_color
from falsework.viewer.pictures.gantt import ALPHA, KEY
from falsework.viewer.plot_svg import WIDTH, marked_chart, time_axis
from falsework.viewer.web.links import link_to
from falsework.viewer.web.markup import html_text

if TYPE_CHECKING:
    from falsework.robots.plans.robot_plan import RobotPlan

_ROW = 22.0
"""Height of the row of an arm, pixels."""
_LETTER = 5.2
"""Width of a letter in a bar, pixels."""


def gantt_svg(plan: RobotPlan) -> str:
    """Return the chart of a plan, in HTML."""
    span = max(plan.makespan, 1e-3)
    rows = [
        f'<text x="0" y="{_ROW * number + 8:.0f}" font-size="8" fill="{INK}">{html_text(robot.name)}</text>'
        for number, robot in enumerate(plan.robots)
    ]
    for bar in bars_of(plan):
        color, alpha = robot_color(bar.robot), ALPHA[bar.does]
        name = "" if bar.part is None else plan.plan.part_names[bar.part]
        x, width = WIDTH * bar.begin / span, WIDTH * (bar.end - bar.begin) / span
        high = 12.0 if bar.does != "moves" else 6.0
        y = _ROW * bar.robot + 10
        fits = bool(name) and len(name) * _LETTER < width
        words = f"{plan.robots[bar.robot].name} {bar.does} {name}, {bar.begin:.1f} to {bar.end:.1f} s"
        shape = (
            f'<rect x="{x:.2f}" y="{y + (12 - high) / 2:.1f}" width="{max(width, 0.5):.2f}" height="{high:.0f}" '
            f'fill="{color}" fill-opacity="{alpha}" stroke="{INK}" stroke-width="0.4"/>'
        )
        at = f'x="{x + 2:.2f}" y="{y + 9:.0f}" font-size="9" fill="{ink_on(color, alpha)}"'
        text = f"<text {at}>{html_text(name)}</text>" if fits else ""
        rows.append(link_to("seconds", bar.begin, f"<title>{html_text(words)}</title>{shape}{text}"))
    base = _ROW * len(plan.robots) + 2
    rows.append(time_axis(base, span))
    chart = marked_chart("".join(rows), base, "when the arms move", "gantt")
    return (
        f'<div style="margin:0 1em">{chart}'
        f'<div class="falsework-hint" style="font-size:11px">seconds; {KEY}; a click goes there</div></div>'
    )


def marker_style(share: float) -> str:
    """Return the style that puts the marker of the chart at a share of its time, in HTML; it moves by half percents."""
    x = round(200 * min(max(share, 0.0), 1.0)) / 200 * WIDTH
    return f"<style>.falsework-now {{ transform: translateX({x:.1f}px); }}</style>"

"""Texts of the page: plan position, marks, facts about a part, and the colour legend."""

from __future__ import annotations

from collections.abc import Collection

from falsework.search.plans.steps import NO_ROBOT
from falsework.viewer.arrows import KINDS
from falsework.viewer.page.markup import html_text, markdown_text
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import BOUNDARY, FIXED, INSTALLED, MISSING, RAMP, ROBOTS, SELECTED, SLIDING, robot_color


def where_text(model: ViewerState, *, ask: bool) -> str:
    """Return the step and its action, in Markdown.

    Args:
        model: state of the viewer.
        ask: whether to include the verdict on the state; it is always included where no plan has proven the state.
    """
    steps = len(model.timeline)
    where, _, doing = model.timeline.label(model.step).partition(": ")
    doing = f": **{markdown_text(doing)}**" if doing else ""
    lines = [f"{where}{doing}" if steps else f"**{markdown_text(model.assembly.name)}**"]
    if model.clock is not None:
        lines[0] = f"{model.seconds:.1f} s of {model.clock.makespan:.1f} s, {lines[0]}"
    # A plan has proven its states; states changed by marks have no verdict yet.
    if ask or not model.disruption.empty or not steps:
        lines.append(f"*{markdown_text(model.proof().words)}*")
    return "<br/>".join(lines)


def marked_text(model: ViewerState) -> str:
    """Describe the parts marked as missing, already there or not to be touched."""
    words = model.disruption.words(model.assembly)
    return f"Marked {markdown_text(words)}." if words else "Nothing is marked: choose the effect of a click."


def about_text(model: ViewerState) -> str:
    """Return a table of facts about the selected part, in HTML."""
    if model.selected is None:
        return "<div style='margin:0.5em 1em;color:#666'>Click a part to see its data.</div>"
    rows = "".join(
        f"<tr><td style='color:#666;padding-right:1em;vertical-align:top'>{html_text(name)}</td>"
        f"<td>{html_text(value)}</td></tr>"
        for name, value in model.about(model.selected)
    )
    return f"<table id='falsework-part' style='margin:0.5em 1em;font-size:0.85em'>{rows}</table>"


def legend_text(model: ViewerState, shown: Collection[str]) -> str:
    """Return the legend of the colours in use, in HTML.

    Args:
        model: state of the viewer.
        shown: kinds of the visible arrows.
    """
    entries = [(BOUNDARY, "boundary"), (INSTALLED, "installed")]
    holding = int(model.timeline.holders.max(initial=NO_ROBOT)) + 1
    entries += [(robot_color(robot), f"held by robot {robot + 1} (R{robot + 1})") for robot in range(holding)]
    if holding > len(ROBOTS):
        entries.append(("#ffffff", "colours repeat: labels give the robot"))
    entries += [(SELECTED, "selected"), (MISSING, "missing (wires)"), (FIXED, "not to be touched")]
    entries += [(color, kind) for kind, color in KINDS.items() if kind in shown]
    if model.sliding and "sliding" not in shown:
        entries.append((SLIDING, "would slide"))
    boxes = "".join(
        f"<div><span style='display:inline-block;width:1.2em;height:0.8em;background:{color};"
        f"border:1px solid #999;margin-right:0.5em'></span>{html_text(words)}</div>"
        for color, words in entries
    )
    if model.show_probabilities:
        scale = f"linear-gradient(to right,{','.join(RAMP)})"
        boxes += (
            f"<div style='height:0.8em;margin-top:0.5em;background:{scale}'></div>"
            "<div style='display:flex;justify-content:space-between'><span>0 %</span>"
            "<span>probability of the action on a part</span><span>100 %</span></div>"
        )
    return f"<div id='falsework-legend' style='margin:0.5em 1em;font-size:0.85em'>{boxes}</div>"

"""Texts of the page: plan position, marks, facts about a part, and the colour legend."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from falsework.assembly.state import HELD
from falsework.search.plans.steps import NO_ROBOT
from falsework.search.problem.task import Direction
from falsework.utils.quantity import format_quantity, listed
from falsework.viewer.appearance import Appearance
from falsework.viewer.arrows import KINDS, Arrows
from falsework.viewer.page.viewer_state import ViewerState
from falsework.viewer.palette import BOUNDARY, FIXED, INSTALLED, MISSING, RAMP, ROBOTS, SELECTED, SLIDING, robot_color
from falsework.viewer.web.markup import html_text, markdown_text


def where_text(model: ViewerState, *, ask: bool) -> str:
    """Return the step and its action, in Markdown.

    Args:
        ask: whether to include the verdict on the state; it is always included where no plan has proven the state.
    """
    steps = len(model.timeline)
    where, _, _ = model.timeline.label(model.step).partition(": ")
    step = model.timeline.step_to(model.step)
    doing = "" if step is None else f": **{markdown_text(step.told(model.timeline.robot_name))}**"
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
    return f"Marked {markdown_text(words)}." if words else ""


def labels_of(model: ViewerState, appearance: Appearance) -> dict[int, str]:
    """Return short labels of parts: holder, press, selection and marks."""
    labels = {
        int(part): model.timeline.robot_name(int(appearance.holder[part]))
        for part in np.flatnonzero((appearance.holder != NO_ROBOT) & (appearance.opacity > 0))
    }
    for load in model.timeline.loads_at(model.step):
        if load.part in labels:
            labels[load.part] += f" bears {format_quantity(load.force, 'force')}"
    for press in model.timeline.presses_at(model.step):
        if press.part in labels:
            labels[press.part] += f", presses {format_quantity(press.force, 'force')}"
    if model.selected is not None:
        name = model.assembly.names[model.selected]
        labels[model.selected] = f"{name}, {labels[model.selected]}" if model.selected in labels else name
    for word, parts in (
        ("missing", model.disruption.missing),
        ("there", model.disruption.there),
        ("fixed", model.disruption.fixed),
        ("prop", model.disruption.props),
        ("not in target" if model.direction is Direction.ASSEMBLY else "stays", model.disruption.target),
    ):
        for part in parts:
            labels[part] = f"{labels[part]}, {word}" if part in labels else word
    return labels


def about_text(model: ViewerState) -> str:
    """Return a table of facts about the selected part, in HTML."""
    if model.selected is None:
        return "<div style='margin:0.5em 1em;color:#666'>Click a part to see its data.</div>"
    rows = "".join(
        f"<tr><td style='color:#666;padding-right:1em;vertical-align:top'>{html_text(name)}</td>"
        f"<td>{html_text(value)}</td></tr>"
        for name, value in facts_of(model, model.selected)
    )
    return f"<table id='falsework-part' style='margin:0.5em 1em;font-size:0.85em'>{rows}</table>"


def facts_of(model: ViewerState, part: int) -> list[tuple[str, str]]:
    """Return the facts about a part, as pairs of label and text."""
    assembly, timeline = model.assembly, model.timeline
    contacts = assembly.contacts
    mine = np.flatnonzero((contacts.parts == part).any(axis=1))
    others = sorted({int(other) for other in contacts.parts[mine].ravel()} - {part})
    touching = listed([assembly.names[other] for other in others], 8)
    value = int(model.site[part])
    now = "boundary" if assembly.boundary[part] else ("not there", "installed", "held")[value]
    who = model.appearance().holder[part]
    if who != NO_ROBOT:
        now = f"held by {model.timeline.robot_name(int(who))}"
    spans = [
        f"{model.timeline.robot_name(robot)}, " + (f"step {first}" if first == last else f"steps {first} to {last}")
        for robot, first, last in timeline.held_when(part)
    ]
    facts = [
        ("part", f"{assembly.names[part]} (number {part})"),
        ("mass", format_quantity(float(assembly.mass.mass[part]), "mass")),
        ("now", now),
        (
            "contacts",
            f"{len(mine)}, {format_quantity(float(contacts.areas[mine].sum()), 'area')}, with {touching or 'nothing'}",
        ),
        ("held by", "; ".join(spans) if spans else "no robot"),
    ]
    chance = model.action_probabilities()[part] if model.policy is not None else np.nan
    if np.isfinite(chance):
        verb = "remove" if model.state[part] == HELD else "hold"
        facts.append(("policy", f"{verb} it with {100 * chance:.1f} %"))
    return facts


def legend_text(model: ViewerState, shown: Mapping[str, Arrows]) -> str:
    """Return the legend of the colours in use, in HTML."""
    entries = [(BOUNDARY, "boundary"), (INSTALLED, "installed")]
    holding = int(model.timeline.holders.max(initial=NO_ROBOT)) + 1
    entries += [(robot_color(robot), f"held by {model.timeline.robot_name(robot)}") for robot in range(holding)]
    if holding > len(ROBOTS):
        entries.append(("#ffffff", "colours repeat: labels give the robot"))
    if model.selected is not None:
        entries.append((SELECTED, "selected"))
    if model.disruption.missing:
        entries.append((MISSING, "missing (wires)"))
    if model.disruption.fixed:
        entries.append((FIXED, "not to be touched"))
    for kind, color in KINDS.items():
        some = shown.get(kind)
        if some is not None and len(some):
            entries.append((color, some.words(kind)))
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
    if model.arms is not None and (shown or model.selected is not None):
        boxes += f"<div>{html_text(model.arms.differs)}</div>"
    return f"<div id='falsework-legend' style='margin:0.5em 1em;font-size:0.85em'>{boxes}</div>"

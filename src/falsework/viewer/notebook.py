"""HTML of assemblies, plans, verdicts, robot plans and answers in notebooks: a picture and a table.

A picture is left out, with the reason, where a package is missing or a plan does not name its structure.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import numpy as np

from falsework.assembly.model import Assembly
from falsework.errors import FalseworkError
from falsework.replanning.result import ReplanResult
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.planning import Planning
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.stability.verdict import Proof, Verdict, Verdicts
from falsework.utils.quantity import counted, format_quantity
from falsework.viewer.appearance import bounds_of
from falsework.viewer.page.step_list import step_list
from falsework.viewer.show import picture
from falsework.viewer.timeline import Timeline
from falsework.viewer.web.markup import html_text

if TYPE_CHECKING:
    from falsework.viewer.pictures.picture import Picture

_ROWS = 12
"""Rows of a table of verdicts."""
_WIDE = 560
"""Pixels across of a picture."""


@singledispatch
def html_of(thing: object) -> str | None:
    """Return HTML with a picture and a table of an object; None for objects of other kinds."""
    return None


@html_of.register
def _(thing: Assembly) -> str:
    size = " x ".join(format_quantity(float(length), "length") for length in np.ptp(bounds_of(thing), axis=0))
    facts = {
        "structure": thing.name,
        "parts": f"{thing.part_count}, {int(thing.boundary.sum())} of them boundary",
        "size": size,
        "mass without boundary": format_quantity(float(thing.mass.mass[~thing.boundary].sum()), "mass"),
        "contacts": f"{len(thing.contacts)}, friction {thing.friction:g}",
    }
    return _page([_picture(lambda: picture(thing, width=_WIDE))], facts)


@html_of.register
def _(thing: Plan) -> str:
    facts = {
        "plan": thing.name,
        "steps": f"{len(thing)} with {counted(thing.robots, 'robot')}",
        "criterion": thing.claim.criterion + (f", reserve {thing.claim.reserve:g}" if thing.claim.reserve > 1 else ""),
    }
    if thing.margins is not None:
        weakest = [(kind, thing.margins.weakest(kind)) for kind in thing.margins.measured]
        facts |= {f"weakest {kind}": f"{thing.margins.words(found[0], kind)}" for kind, found in weakest if found}
    try:
        assembly = structure_of_plan(thing)
    except FalseworkError as error:
        rows = ((step.number, step.by(), step.words) for step in thing)
        listed = _folded(counted(len(thing), "step"), _table(("step", "robot", "action"), rows))
        return _page([_remark(error)], facts) + listed
    drawn = _picture(lambda: picture(thing, None, assembly, frames=6, columns=3, width=260))
    return _page([drawn], facts) + _folded(counted(len(thing), "step"), step_list(Timeline.from_plan(thing, assembly)))


@html_of.register
def _(thing: Planning) -> str:
    facts = {"outcome": thing.result.outcome.value, "plans": str(len(thing.plans))}
    if not thing.plans:
        facts |= {"reached": f"step {thing.result.reached} of {thing.result.steps}", "limit": thing.result.limit}
    return _page([], facts) + "".join(html_of(plan) or "" for plan in thing.plans[:1])


@html_of.register
def _(thing: ReplanResult) -> str:
    facts = {"outcome": thing.outcome.value, "decided by": thing.decided_by.value, "time": f"{thing.seconds:.2f} s"}
    if thing.value is None:
        return _page([], facts | {"reason": thing.reason})
    needs = {
        f"{thing.value.part_names[need.part]} is needed": f"at step {need.after_steps + 1}"
        for need in thing.value.needs
    }
    return _page([], facts | needs) + (html_of(thing.value) or "")


@html_of.register
def _(thing: RobotPlan) -> str:
    facts = {
        "robot plan": f"{thing.direction.value} of {thing.plan.name} in {thing.cell_name}",
        "robots": ", ".join(robot.name for robot in thing.robots),
        "steps": str(len(thing)),
        "duration": f"{thing.makespan:.1f} s" + ("" if thing.schedule is None else ", arms move at the same time"),
    }

    def chart() -> Picture:
        from falsework.viewer.pictures.gantt import GanttChart
        from falsework.viewer.pictures.picture import Picture, figure_of

        figure = GanttChart.from_plan(thing, width=8.0).figure
        return Picture("chart", content=figure_of(figure, "svg"), kind="svg")

    arms = _picture(lambda: picture(thing, step=len(thing.plan) // 2, width=_WIDE))
    steps = _table(("step", "action"), enumerate((thing.describe(step) for step in range(len(thing))), 1))
    return _page([arms, _picture(chart)], facts) + _folded(counted(len(thing), "step"), steps)


@html_of.register
def _(thing: Verdicts) -> str:
    rows = []
    for row, verdict in enumerate(thing.kinds[:_ROWS]):
        residual = float(thing.residual[row])
        proof = Proof(int(thing.proof[row])).name.lower()
        rows.append((row, verdict.name.lower(), proof, format_quantity(residual, "share")))
    left = len(thing) - len(rows)
    table = _table(("state", "verdict", "proof", "residual of gravity"), rows)
    counts = {kind.name.lower(): str(int((thing.verdict == kind).sum())) for kind in reversed(Verdict)}
    facts = {name: count for name, count in counts.items() if count != "0"}
    drawn = []
    if thing.assembly is not None and thing.states is not None and len(thing):
        row = int(np.argmin(thing.stable))  # the first that is not stable, or the first
        state, assembly = thing.states[row], thing.assembly
        drawn = [_picture(lambda: picture(state, None, assembly, width=_WIDE, title=f"state {row}"))]
    return _page(drawn, facts) + table + (f"<div>and {left} more</div>" if left else "")


def _page(pictures: Iterable[str], facts: dict[str, str]) -> str:
    cell = "<td style='text-align:left'>"
    rows = "".join(
        f"<tr>{cell}{html_text(name)}</td>{cell}{html_text(value)}</td></tr>" for name, value in facts.items() if value
    )
    return f"<table>{rows}</table>{''.join(pictures)}"


def _table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    head = "".join(f"<th>{html_text(name)}</th>" for name in heads)
    body = "".join(f"<tr>{''.join(f'<td>{html_text(str(cell))}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _folded(title: str, inside: str) -> str:
    return f"<details><summary>{html_text(title)}</summary>{inside}</details>"


def _picture(draw: Callable[[], Picture]) -> str:
    try:
        drawn = draw()
    except FalseworkError as error:
        return _remark(error)
    kind = {"png": "image/png", "svg": "image/svg+xml"}[drawn.kind]
    content = base64.b64encode(drawn.content).decode("ascii")
    return f'<img alt="{html_text(drawn.shows)}" src="data:{kind};base64,{content}" style="max-width:100%"/>'


def _remark(error: FalseworkError) -> str:
    return f"<div><i>no picture: {html_text(' '.join(str(error).split()))}</i></div>"

"""Strip of the margins of a plan, one column per step, for the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from falsework.search.margins.plan_margins import quantity_text
from falsework.viewer.palette import INK, MISSING, RAMP, hex_of, ramp_in_steps
from falsework.viewer.web.links import link_to
from falsework.viewer.web.markup import html_text

if TYPE_CHECKING:
    from falsework.search.plans.plan import Plan

_WIDTH, _HEIGHT = 360.0, 14.0
"""Sizes of a row, pixels."""


def margin_strip(plan: Plan | None, place: int, built: int = 0) -> str:
    """Return rows of coloured columns, one row per margin that the plan records, in HTML; empty if it records none.

    Dark columns are weak; a mark shows the weakest, and a frame the current step. A click on a column goes there.
    """
    if plan is None or plan.margins is None or not plan.margins.measured:
        return ""
    texts, column = [], _WIDTH / len(plan.states)
    now = place - built
    for kind, values in plan.margins.measured.items():
        weakest = plan.margins.weakest(kind)
        words = [kind]
        if weakest is not None:
            words.append(f"weakest {quantity_text(kind, weakest[1])} at step {built + weakest[0]}")
        if 0 <= now < len(values):
            value = values[now]
            words.append(f"now {'without bound' if value is None else quantity_text(kind, value)}")
        texts.append(f'<div style="font-size:11px">{html_text(", ".join(words))}</div>')
        rows = []
        for row, color in enumerate(ramp_in_steps(weakness(kind, values, plan.friction))):
            title = html_text(f"step {built + row}: {plan.margins.words(row, kind)}")
            shape = (
                f'<rect x="{row * column:.2f}" y="8" width="{column + 0.1:.2f}" height="{_HEIGHT}" '
                f'fill="{hex_of(color)}"><title>{title}</title></rect>'
            )
            rows.append(link_to("step", built + row, shape))
        if weakest is not None:
            x = (weakest[0] + 0.5) * column
            rows.append(f'<path d="M{x - 4:.1f},1 h8 l-4,6 z" fill="{MISSING}"/>')
        if 0 <= now < len(values):
            rows.append(
                f'<rect x="{now * column:.2f}" y="7.5" width="{max(column, 2):.2f}" height="{_HEIGHT + 1}" '
                f'fill="none" stroke="{INK}" stroke-width="1.5"/>'
            )
        texts.append(
            f'<svg viewBox="-4 0 {_WIDTH + 8:.0f} {_HEIGHT + 10:.0f}" style="display:block;width:100%;height:auto" '
            f'role="img" aria-label="{html_text(kind)} of every step">{"".join(rows)}</svg>'
        )
    ends = f'<span style="color:{RAMP[-1]}">dark</span>: weak; the mark is over the weakest step; a click goes there'
    hint = f'<div class="falsework-hint" style="font-size:11px">{ends}</div>'
    return f'<div style="margin:0 1em">{"".join(texts)}{hint}</div>'


def weakness(kind: str, values: tuple[float | None, ...], friction: float) -> np.ndarray:
    """Return the weakness of each state, from 0 without a bound to 1 without any margin left. Shape (states,)."""
    found = np.array([np.nan if value is None else value for value in values], float)
    if kind == "friction":
        return np.clip(np.nan_to_num(found, nan=0.0) / max(friction, 1e-300), 0.0, 1.0)
    # Half of the scale is at three times the weakest: most steps are much stronger, and weak ones must stand out.
    weakest = float(np.nanmin(found)) if np.isfinite(found).any() else 1.0
    return np.clip(np.nan_to_num(3.0 * weakest / (3.0 * weakest + found - weakest), nan=0.0), 0.0, 1.0)

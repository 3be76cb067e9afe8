"""Strip of the margins of a plan, one column per step, for the page."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

import numpy as np

from falsework.viewer.palette import INK, MISSING, RAMP, hex_of, ramp_in_steps

if TYPE_CHECKING:
    from falsework.search.plans.plan import Plan

_WIDTH, _HEIGHT, _LABEL = 300.0, 14.0, 62.0
"""Sizes of a row and of its label, pixels."""
_NAMES = {"friction": "friction", "tilt": "tilt", "horizontal": "horizontal", "push": "push"}


def margin_strip(plan: Plan | None, step: int) -> str:
    """Return rows of coloured columns, one row per margin that the plan records, in HTML; empty if it records none.

    Dark columns are weak; a mark shows the weakest, and a frame the current step.

    Args:
        plan: plan to show.
        step: current step, from 0.
    """
    if plan is None or plan.margins is None or not plan.margins.measured:
        return ""
    rows, y = [], 2.0
    column = _WIDTH / len(plan.states)
    for kind, values in plan.margins.measured.items():
        colors = ramp_in_steps(weakness(kind, values, plan.friction))
        y += 9.0
        rows.append(f'<text x="0" y="{y + 11:.1f}" font-size="11" fill="{INK}">{html.escape(_NAMES[kind])}</text>')
        rows += [
            f'<rect x="{_LABEL + k * column:.2f}" y="{y:.1f}" width="{column + 0.1:.2f}" height="{_HEIGHT}" '
            f'fill="{hex_of(color)}"><title>step {k}: {html.escape(plan.margins.words(k, kind))}</title></rect>'
            for k, color in enumerate(colors)
        ]
        weakest = plan.margins.weakest(kind)
        if weakest is not None:
            x = _LABEL + (weakest[0] + 0.5) * column
            rows.append(f'<path d="M{x - 4:.1f},{y - 7:.1f} h8 l-4,6 z" fill="{MISSING}"/>')
        x = _LABEL + step * column
        rows.append(
            f'<rect x="{x:.2f}" y="{y - 0.5:.1f}" width="{max(column, 2):.2f}" height="{_HEIGHT + 1}" fill="none" '
            f'stroke="{INK}" stroke-width="1.5"/>'
        )
        y += _HEIGHT
    ends = f'<span style="color:{RAMP[-1]}">dark</span>: weak; the mark is over the weakest step'
    return (
        f'<div style="margin:0 1em"><svg width="{_LABEL + _WIDTH + 4:.0f}" height="{y + 4:.0f}" role="img" '
        f'aria-label="margins of every step">{"".join(rows)}</svg><div style="font-size:11px">{ends}</div></div>'
    )


def weakness(kind: str, values: tuple[float | None, ...], friction: float) -> np.ndarray:
    """Return the weakness of each state, from 0 without a bound to 1 without any margin left. Shape (states,).

    Args:
        kind: name of the margin.
        values: values of the margin, one per state.
        friction: coefficient of friction of the structure.
    """
    found = np.array([np.nan if value is None else value for value in values], float)
    if kind == "friction":
        return np.clip(np.nan_to_num(found, nan=0.0) / max(friction, 1e-300), 0.0, 1.0)
    # Half of the scale is at three times the weakest: most steps are much stronger, and weak ones must stand out.
    weakest = float(np.nanmin(found)) if np.isfinite(found).any() else 1.0
    return np.clip(np.nan_to_num(3.0 * weakest / (3.0 * weakest + found - weakest), nan=0.0), 0.0, 1.0)

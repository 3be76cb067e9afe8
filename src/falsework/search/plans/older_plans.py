"""Plan files of the former version, converted to the newest one."""

from __future__ import annotations

from typing import Any

from falsework.search.plans.plan_model import FORMAT, UNPROVEN
from falsework.search.plans.steps import Action
from falsework.stability.holds import HoldMode

THIRD_FORMAT = "falsework.plan/3"
"""Plans of version 3 are in the order of assembly or of disassembly, and say in which. They say only whether robots
press, under force control, and not what they bear."""


def upgraded(data: dict[str, Any]) -> tuple[dict[str, Any], bool | None]:
    """Return a plan of either version in the newest one; malformed entries are left for the reader to report.

    Returns:
        The entries, and whether the packed proofs among them are still in the order of disassembly; None for a plan
        in neither order.
    """
    if data.get("format") != THIRD_FORMAT:
        return data, False
    direction = data.get("direction")
    if direction not in ("disassembly", "assembly"):
        return data, None
    data = {key: value for key, value in data.items() if key != "direction"} | {"format": FORMAT}
    data["stability"] = _with_mode(data.get("stability"))
    backwards = direction == "disassembly"
    return _reversed(data) if backwards else data, backwards


def _with_mode(stability: Any) -> Any:
    """Say how robots hold parts where version 3 said only whether they press."""
    if not isinstance(stability, dict) or not isinstance(stability.get("holds"), dict):
        return stability
    holds = dict(stability["holds"])
    if isinstance(holds.get("press"), bool):
        holds["mode"] = (HoldMode.FORCE if holds.pop("press") else HoldMode.LOCKED).value
    return stability | {"holds": holds}


def _reversed(data: dict[str, Any]) -> dict[str, Any]:
    """Turn a plan of version 3 in the order of disassembly into that of assembly, but for its packed proofs.

    Malformed entries are left for the reader to report.
    """
    start, steps, end, margins = (data.get(key) for key in ("start", "steps", "end", "margins"))
    if not isinstance(start, dict) or not isinstance(steps, list) or not all(isinstance(step, dict) for step in steps):
        return data
    judged = [{key: record[key] for key in UNPROVEN if key in record} for record in (start, *steps)]
    turned = [
        {key: value for key, value in step.items() if key not in UNPROVEN} | {"do": _undone(step.get("do"))} | judgement
        for step, judgement in zip(steps, judged, strict=False)
    ]
    others = {key: value for key, value in start.items() if key not in UNPROVEN}
    data = data | {"start": others | {"state": end} | judged[-1], "steps": turned[::-1], "end": start.get("state")}
    measured = margins.get("measured") if isinstance(margins, dict) else None
    if isinstance(margins, dict) and isinstance(measured, dict):
        turned = {kind: values[::-1] if isinstance(values, list) else values for kind, values in measured.items()}
        data["margins"] = margins | {"measured": turned}
    return data


def _undone(word: Any) -> Any:
    return Action(word).undone.value if isinstance(word, str) and word in set(Action) else word

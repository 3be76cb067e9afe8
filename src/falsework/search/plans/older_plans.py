"""Plan files of older versions, converted to the newest one."""

from __future__ import annotations

import warnings
from typing import Any

from falsework.errors import ReadWarning
from falsework.search.plans.plan_model import FORMAT, UNPROVEN
from falsework.search.plans.steps import Action
from falsework.stability.holds import HoldMode
from falsework.stability.stiffness import TANGENTIAL_RATIO

THIRD_FORMAT = "falsework.plan/3"
"""Plans of version 3 and before are in the order of assembly or of disassembly, and say in which. They say only whether
robots press, under force control, and not what they bear."""
SECOND_FORMAT = "falsework.plan/2"
"""Plans of version 2 are for robots that hold parts rigidly, without limits, and never press; under `contact` each of
their states was proved from rest."""
FIRST_FORMAT = "falsework.plan/1"
"""Plans of version 1 are under the criterion `equilibrium` and carry no replay."""

_SHARE = 0.1
"""Shares of gravity in 1 m/s2, rounded down."""


def upgraded(data: dict[str, Any], source: str) -> tuple[dict[str, Any], bool | None]:
    """Return a plan of any version in the newest one; malformed entries are left for the reader to report.

    Args:
        data: entries of the file.
        source: name of the file in warnings.

    Returns:
        The entries, and whether the packed proofs among them are still in the order of disassembly; None for a plan
        in neither order.
    """
    if data.get("format") == FIRST_FORMAT:
        data = _from_version_1(data)
    if data.get("format") == SECOND_FORMAT:
        data = _from_version_2(data, source)
    if data.get("format") != THIRD_FORMAT:
        return data, False
    direction = data.get("direction")
    if direction not in ("disassembly", "assembly"):
        return data, None
    data = {key: value for key, value in data.items() if key != "direction"} | {"format": FORMAT}
    data["stability"] = _with_mode(data.get("stability"))
    backwards = direction == "disassembly"
    return _reversed(data) if backwards else data, backwards


def _from_version_1(data: dict[str, Any]) -> dict[str, Any]:
    """Convert a plan of version 1 to version 2; malformed entries are left for the reader to report."""
    # Version 1 gave residuals and tolerance in m/s2, of which a tenth is about a share of gravity.
    stability, start, steps = data.get("stability"), data.get("start"), data.get("steps")
    if isinstance(stability, dict):
        stability = {"criterion": "equilibrium", "stiffness_ratio": TANGENTIAL_RATIO} | stability
        if isinstance(stability.get("tolerance"), (int, float)):
            stability["tolerance"] *= _SHARE
    if isinstance(steps, list):
        steps = [_scaled(step) for step in steps]
    return data | {"format": SECOND_FORMAT, "stability": stability, "start": _scaled(start), "steps": steps}


def _from_version_2(data: dict[str, Any], source: str) -> dict[str, Any]:
    """Convert a plan of version 2; proofs of single states from rest are left out, they prove no build."""
    stability = data.get("stability")
    if isinstance(stability, dict):
        stability = stability | {"reserve": 1.0}
        if stability.get("criterion") == "contact":
            stability["holds"] = {"stiffness": None, "force": None, "moment": None, "press": False}
            if "displacements" in data:
                warnings.warn(
                    f"{source}: displacements of plans of version 2 prove single states and no build: left out",
                    ReadWarning,
                    stacklevel=5,
                )
            data = {key: value for key, value in data.items() if key != "displacements"}
            data["start"] = _from_rest(data.get("start"))
            if isinstance(data.get("steps"), list):
                data["steps"] = [_from_rest(step) for step in data["steps"]]
    return data | {"format": THIRD_FORMAT, "stability": stability}


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


def _from_rest(record: Any) -> Any:
    known = isinstance(record, dict) and record.get("proof") == "displacement"
    return record | {"proof": "history"} if known else record


def _scaled(record: Any) -> Any:
    if not isinstance(record, dict) or not isinstance(record.get("residual"), (int, float)):
        return record
    return record | {"residual": record["residual"] * _SHARE}

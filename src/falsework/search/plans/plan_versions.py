"""Versions of the plan file: older ones are converted before they are read."""

from __future__ import annotations

import warnings
from typing import Any

from falsework.errors import ReadWarning
from falsework.stability.holds import HoldMode
from falsework.stability.stiffness import TANGENTIAL_RATIO

FORMAT = "falsework.plan/4"
THIRD_FORMAT = "falsework.plan/3"
"""Plans of version 3 say only whether robots press, under force control, and not what they bear."""
SECOND_FORMAT = "falsework.plan/2"
"""Plans of version 2 are for robots that hold parts rigidly, without limits, and never press; under `contact` each of
their states was proved from rest."""
FIRST_FORMAT = "falsework.plan/1"
"""Plans of version 1 are under the criterion `equilibrium` and carry no replay."""
_SHARE = 0.1
"""Shares of gravity in 1 m/s2, rounded down."""


def as_newest(data: dict[str, Any], source: str) -> dict[str, Any]:
    """Return a plan of an older version as one of the newest; malformed entries are left for the reader to report."""
    if data.get("format") == FIRST_FORMAT:
        data = _from_version_1(data)
    if data.get("format") == SECOND_FORMAT:
        data = _from_version_2(data, source)
    return _from_version_3(data) if data.get("format") == THIRD_FORMAT else data


def _from_version_1(data: dict[str, Any]) -> dict[str, Any]:
    """Convert a plan of version 1 to version 2."""
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


def _from_version_3(data: dict[str, Any]) -> dict[str, Any]:
    """Convert a plan of version 3."""
    stability = data.get("stability")
    if isinstance(stability, dict) and isinstance(stability.get("holds"), dict):
        holds = dict(stability["holds"])
        if isinstance(holds.get("press"), bool):
            holds["mode"] = (HoldMode.FORCE if holds.pop("press") else HoldMode.LOCKED).value
            data = data | {"stability": stability | {"holds": holds}}
    return data | {"format": FORMAT}


def _from_rest(record: Any) -> Any:
    known = isinstance(record, dict) and record.get("proof") == "displacement"
    return record | {"proof": "history"} if known else record


def _scaled(record: Any) -> Any:
    if not isinstance(record, dict) or not isinstance(record.get("residual"), (int, float)):
        return record
    return record | {"residual": record["residual"] * _SHARE}

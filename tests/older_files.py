"""Files of plans as former versions wrote them."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from falsework import Direction, Plan
from falsework.robots import RobotPlan
from falsework.robots.plans.robot_plan_file import robot_plan_to_dict
from falsework.search.plans.plan_file import plan_to_dict


def as_version_3(plan: Plan, direction: Direction) -> dict[str, Any]:
    """A plan of version 3, which may be in the order of disassembly, and says so."""
    backwards = direction is Direction.DISASSEMBLY
    order = slice(None, None, -1) if backwards else slice(None)
    arrays: dict[str, Any] = {name: getattr(plan, name) for name in ("forces", "displacement")}
    arrays = {name: None if array is None else array[order].copy() for name, array in arrays.items()}
    data = json.loads(json.dumps(plan_to_dict(replace(plan, **arrays), proofs=plan.proof_arrays() is not None)))
    states = [state.tolist() for state in plan.states[order]]
    judged = [
        {key: record[key] for key in ("verdict", "proof", "residual")} for record in (data["start"], *data["steps"])
    ]
    judged = judged[order]
    steps = [{key: step[key] for key in step if key not in judged[0]} for step in data["steps"]][order]
    words = {"insert": "remove", "release": "hold", "hold": "release", "remove": "insert"}
    steps = [step | {"do": words[step["do"]] if backwards else step["do"]} for step in steps]
    if "margins" in data:
        measured = data["margins"]["measured"]
        data["margins"]["measured"] = {kind: values[order] for kind, values in measured.items()}
    return data | {
        "format": "falsework.plan/3",
        "direction": direction.value,
        "start": {"state": states[0]} | judged[0],
        "steps": [step | judgement for step, judgement in zip(steps, judged[1:], strict=True)],
        "end": states[-1],
    }


def as_robot_version_2(plan: RobotPlan) -> dict[str, Any]:
    """A robot plan of version 2, whose order is that of the plan of version 3 in it."""
    data = json.loads(json.dumps(robot_plan_to_dict(plan)))
    del data["direction"]
    return data | {"format": "falsework.robot-plan/2", "plan": as_version_3(plan.plan, plan.direction)}

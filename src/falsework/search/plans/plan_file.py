"""Plan files: versioned JSON with a published schema, read strictly."""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from falsework.errors import InputError, PlanError
from falsework.search.plans.older_plans import FORMAT, UNPROVEN
from falsework.search.plans.packed_proofs import pack_proofs
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_reader import PROOF_ARRAYS, PROOF_WORDS, PlanReader
from falsework.search.plans.steps import PlanStep
from falsework.stability.verdict import Verdict
from falsework.utils.json_file import read_format, write_json


def plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of plan files."""
    text = resources.files("falsework.search.plans").joinpath("plan.schema.json").read_text(encoding="utf-8")
    return json.loads(text)


def save_plan(plan: Plan, path: Path | str, *, proofs: bool = False) -> None:
    """Write a plan as JSON, format `falsework.plan/4`, whole or not at all.

    Args:
        plan: the plan.
        path: file to write.
        proofs: write the displacements or contact forces too, some hundred kilobytes.

    Raises:
        PlanError: proofs are requested and the plan has none.
        InputError: something other than a plan, or a file that cannot be written.
    """
    if not isinstance(plan, Plan):
        raise InputError(f"save_plan writes a Plan, not {type(plan).__name__}; results have theirs in plans")
    if proofs and plan.proof_arrays() is None:
        raise PlanError("the plan carries no displacements or contact forces to write; save it without proofs")
    if proofs and plan.torn is not None and plan.torn.any():
        raise PlanError("contacts of the plan break, which its file cannot prove; save it without proofs")
    write_json(path, plan_to_dict(plan, proofs=proofs), spread=("steps",))


def _short(value: float) -> float:
    return value if isinstance(value, int) else float(f"{value:.6g}")


def plan_to_dict(plan: Plan, *, proofs: bool = False) -> dict[str, Any]:
    """Return the plan as plain JSON values; see `plan.schema.json`."""
    proof = PROOF_WORDS[plan.claim.criterion]
    judged = [
        {"verdict": "stable", "proof": proof, "residual": _short(residual)} if stable else dict(UNPROVEN)
        for residual, stable in zip(plan.residuals, [kind is Verdict.STABLE for kind in plan.verdicts], strict=True)
    ]

    def pressed(step: PlanStep) -> dict[str, Any]:
        some = [{"part": press.part, "wrench": list(press.wrench)} for press in step.presses]
        return {"presses": some} if some else {}

    def borne(row: int) -> dict[str, Any]:
        some = plan.loads[row] if plan.loads else ()
        return {"bears": [{name: _short(value) for name, value in vars(load).items()} for load in some]} if some else {}

    def several(step: PlanStep) -> dict[str, Any]:
        return {"parts": list(step.parts), "held": len(step.robots)} if len(step.parts) > 1 else {}

    steps = [
        {
            "do": step.action.value,
            "part": step.part,
            **several(step),
            **judged[step.number],
            **pressed(step),
            **borne(step.number),
        }
        for step in plan.steps
    ]
    data: dict[str, Any] = {
        "format": FORMAT,
        "structure": {
            "name": plan.name,
            "identity": plan.identity,
            "friction": plan.friction,
            "boundary": np.flatnonzero(plan.boundary).tolist(),
            "parts": list(plan.part_names),
            **({"props": [prop.to_dict() for prop in plan.props]} if plan.props else {}),
            **({} if plan.source is None else {"source": dict(plan.source)}),
        },
        "robots": plan.robots,
        "rules": {
            "fixed": list(plan.fixed),
            "missing": list(plan.missing),
            "removable_only_if_clear": plan.removable_only_if_clear,
            **({"support": True} if plan.support else {}),
            **({"props": plan.prop_limit} if plan.props else {}),
            **({"parts_at_once": plan.parts_at_once} if plan.parts_at_once > 1 else {}),
        },
        "stability": {
            "criterion": plan.claim.criterion,
            "stiffness_ratio": plan.claim.stiffness_ratio,
            "cone": plan.claim.cone,
            "gravity": plan.claim.gravity,
            "tolerance": plan.claim.tolerance,
            "force_bound": plan.claim.force_bound,
            "reserve": plan.claim.reserve,
            **({"holds": plan.claim.holds.to_dict()} if plan.claim.criterion == "contact" else {}),
        },
        "start": {"state": plan.states[0].tolist(), **judged[0], **borne(0)},
        "steps": steps,
        "end": plan.states[-1].tolist(),
        "needs": [asdict(need) for need in plan.needs],
    }
    if plan.replay is not None:
        data["replay"] = plan.replay.to_dict()
    if plan.margins is not None:
        data["margins"] = plan.margins.to_dict()
    arrays = plan.proof_arrays()
    if proofs and arrays is not None:
        name, count = PROOF_ARRAYS[plan.claim.criterion]
        data[name] = {count: arrays.shape[-2]}
        if isinstance(arrays, np.ndarray) and arrays.ndim == 4:
            data[name]["increments"] = arrays.shape[1]
            arrays = arrays.reshape(len(arrays), -1, 6)
        data[name] |= pack_proofs(arrays)
    return data


def is_plan_file(path: Path | str) -> bool:
    """Return whether a file says that it is a plan.

    Raises:
        PlanError: a JSON file that cannot be read.
    """
    file = Path(path)
    return file.suffix.lower() == ".json" and file.is_file() and read_format(file).startswith("falsework.plan/")


def load_plan(path: Path | str) -> Plan:
    """Read a plan and check that it is one: format, entries, lengths, and that every action is legal.

    Stability is not checked; see `validate_plan`.

    Raises:
        PlanError: no such file, damaged, of another version, or with an action that the rules forbid.
    """
    return plan_from_dict(PlanReader.load(path), str(Path(path)))


def plan_from_dict(data: Any, source: str = "the plan") -> Plan:
    """Read a plan from plain JSON values; `source` names them in messages.

    Raises:
        PlanError: as `load_plan`.
    """
    return Plan(**PlanReader(source).fields(data))

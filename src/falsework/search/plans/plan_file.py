"""Plan files: versioned JSON with a published schema, read strictly."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from msgspec import convert

from falsework.errors import InputError, PlanError
from falsework.search.plans.packed_proofs import pack_proofs
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_model import FORMAT, RULE_FIELDS, UNPROVEN, PlanFile
from falsework.search.plans.plan_reader import PROOF_WORDS, PlanReader
from falsework.stability.holds import HoldLoad
from falsework.stability.verdict import Verdict
from falsework.utils.json_file import read_format, read_json, write_json
from falsework.utils.models import to_json_values


def save_plan(plan: Plan, path: Path | str, *, proofs: bool = False) -> None:
    """Write a plan as JSON, format `falsework.plan/4`, whole or not at all.

    Args:
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
    return float(f"{value:.6g}")


def plan_to_dict(plan: Plan, *, proofs: bool = False) -> dict[str, Any]:
    """Return the plan as plain JSON values; see `plan_schema`."""
    proof = PROOF_WORDS[plan.claim.criterion]
    judged = [
        {"verdict": "stable", "proof": proof, "residual": _short(residual)} if kind is Verdict.STABLE else UNPROVEN
        for residual, kind in zip(plan.residuals.tolist(), plan.verdicts, strict=True)
    ]
    bears = [[HoldLoad(load.part, _short(load.force), _short(load.moment)) for load in row] for row in plan.loads]
    records: list[Any] = [{**record, "bears": bears[row] if bears else []} for row, record in enumerate(judged)]
    contact, margins, arrays = plan.claim.criterion == "contact", plan.margins, plan.proof_arrays()
    packed: dict[str, Any] | None = None
    if proofs and arrays is not None:
        packed = {"parts" if contact else "points": arrays.shape[-2]}
        if isinstance(arrays, np.ndarray) and arrays.ndim == 4:
            packed["increments"] = arrays.shape[1]
            arrays = arrays.reshape(len(arrays), -1, 6)
        packed |= pack_proofs(arrays)
    file = {
        "format": FORMAT,
        "structure": {
            "name": plan.name,
            "identity": plan.identity,
            "friction": plan.friction,
            "boundary": np.flatnonzero(plan.boundary).tolist(),
            "parts": plan.part_names,
            "props": plan.props,
            "source": None if plan.source is None else dict(plan.source),
        },
        "robots": plan.robots,
        "rules": {
            entry: getattr(plan, name) for entry, name in RULE_FIELDS.items() if name != "prop_limit" or plan.props
        },
        "stability": {**vars(plan.claim), "holds": plan.claim.holds.to_dict() if contact else None},
        "start": {"state": plan.states[0].tolist(), **records[0]},
        "steps": [
            {
                "do": step.action,
                "part": step.part,
                "parts": step.parts if len(step.parts) > 1 else None,
                "held": len(step.robots) if len(step.parts) > 1 else None,
                **records[step.number],
                "exit_path": [
                    {
                        "direction": move.direction,
                        "distance": move.distance,
                        "angle": move.angle or None,
                        "point": move.point if move.turns else None,
                        "parts": None if set(move.parts) == set(step.parts) else move.parts,
                    }
                    for move in (plan.exit_paths[step.number - 1] if plan.exit_paths else ())
                ],
                "presses": step.presses,
            }
            for step in plan.steps
        ],
        "end": plan.states[-1].tolist(),
        "needs": plan.needs,
        "replay": None if plan.replay is None else plan.replay.to_dict(),
        "margins": None if margins is None else margins.to_dict(),
        "displacements" if contact else "forces": packed,
    }
    return to_json_values(convert(file, PlanFile, from_attributes=True))


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
    return plan_from_dict(read_json(path, "plan file", "plan again"), str(Path(path)))


def plan_from_dict(data: Any, source: str = "the plan") -> Plan:
    """Read a plan from plain JSON values; `source` names them in messages.

    Raises:
        PlanError: as `load_plan`.
    """
    return Plan(**PlanReader(data, source).fields())

"""Write the JSON Schemas of files beside this script: `make schemas`, after a change of a model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from falsework.assembly.assembly_model import assembly_schema
from falsework.robots.cells.cell_model import cell_schema
from falsework.robots.plans.robot_plan_model import robot_plan_schema
from falsework.search.plans.plan_model import plan_schema

FOLDER = Path(__file__).parent


def schemas() -> dict[str, Any]:
    """Return the published schemas by the name of their file."""
    return {
        "assembly.schema.json": assembly_schema(),
        "cell.schema.json": cell_schema(),
        "plan.schema.json": plan_schema(),
        "robot-plan.schema.json": robot_plan_schema(),
    }


if __name__ == "__main__":
    for name, schema in schemas().items():
        (FOLDER / name).write_text(json.dumps(schema, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

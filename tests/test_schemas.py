"""The published JSON Schemas are those of the models, and accept what is written."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import falsework as fw

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "schemas"
NAMES = ("assembly.schema.json", "cell.schema.json", "plan.schema.json", "robot-plan.schema.json")


@pytest.fixture(scope="module")
def generated() -> dict[str, Any]:
    spec = importlib.util.spec_from_file_location("write_schemas", FOLDER / "write.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.schemas()


@pytest.mark.parametrize("name", NAMES)
def test_published_schemas_are_in_step(generated: dict[str, Any], name: str) -> None:
    jsonschema.Draft202012Validator.check_schema(generated[name])
    assert json.loads((FOLDER / name).read_text(encoding="utf-8")) == generated[name], "run make schemas"
    assert sorted(generated) == sorted(NAMES)


def test_every_entry_of_a_plan_is_described(generated: dict[str, Any]) -> None:
    plain = {"name", "friction", "part", "parts", "boundary", "format"}  # which say all
    schema = generated["plan.schema.json"]
    for entry in (schema, *schema["$defs"].values()):
        for field, about in entry.get("properties", {}).items():
            assert "description" in about or "$ref" in json.dumps(about) or field in plain, field


def test_a_written_assembly_follows_its_schema(generated: dict[str, Any], tmp_path: Path) -> None:
    loaded = fw.load_structure("stack", loads=[{"part": 0, "force": (0, 0, -100)}], earthquake=[0.05])
    fw.save(loaded, tmp_path / "stack")
    described = json.loads((tmp_path / "stack" / "assembly.json").read_text())
    jsonschema.validate(described, generated["assembly.schema.json"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(described | {"loads": [{"part": 0, "weight": 1}]}, generated["assembly.schema.json"])

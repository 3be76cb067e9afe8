"""JSON answers: one envelope for all commands, which the published schema describes, with units in names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from falsework.cli.main import COMMANDS
from falsework.cli.output import answer_schema
from tests.robots.cells.cell_texts import REACHING as CELL

Run = Callable[..., Any]

UNITS = re.compile(r"(^seconds|_(seconds|s|m|mm|m3|kg|n|nm|deg|rad|g))$")


def numbers(schema: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Numbers that a schema describes, with the name of the property that they are in."""
    if isinstance(schema, list):
        for item in schema:
            yield from numbers(item, name)
    if not isinstance(schema, dict):
        return
    kinds = schema.get("type", [])
    if "number" in ([kinds] if isinstance(kinds, str) else kinds):
        yield name, schema
    for key, value in schema.items():
        if key == "properties":
            for property_name, inner in value.items():
                nested = name if name.endswith(("_s", "_deg")) else property_name
                yield from numbers(inner, nested)
        elif isinstance(value, (dict, list)):
            yield from numbers(value, name)


def test_numbers_have_a_unit_in_their_name_or_are_ratios() -> None:
    schema = answer_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    found = list(numbers(schema["$defs"]))
    assert len(found) > 60
    wrong = {name for name, entry in found if (entry.get("unit") == "1") == bool(UNITS.search(name))}
    assert wrong == {"configuration", "confidences", "fails_at"}  # joint values, probabilities, units of margins


def test_every_command_is_in_the_schema() -> None:
    schema = answer_schema()
    assert set(schema["properties"]["command"]["enum"]) == {*COMMANDS, None}
    for command in COMMANDS:
        assert "properties" in schema["$defs"][command.replace(" ", "_")], command


def test_what_the_schema_does_not_describe_is_refused(falsework: Run, read_answer: Callable[[str], Any]) -> None:
    text = falsework("stability", "arch:blocks=5", "--json").out
    assert read_answer(text)["states"][0]["verdict"] == "stable"
    for old, new in (('"residual"', '"residue"'), ('"ok"', '"good"'), ('"outcome": "stable"', '"outcome": "fine"')):
        with pytest.raises(jsonschema.ValidationError):
            read_answer(text.replace(old, new, 1))


def test_answers_of_all_commands(falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command answers in one line that the schema describes; files are those that it wrote."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("falsework.viewer.page.page.Page.wait", lambda _: None)
    monkeypatch.setattr("falsework.service.server.run_service", lambda *_, started, **__: started("http://here"))
    Path("cell.toml").write_text(CELL)
    stack = "stack:blocks=2,length=0.3,height=0.15,depth=0.3"
    calls = {
        "structures": ((), ()),
        "export": (("arch:blocks=3",), ("folder",)),
        "doctor": (("folder",), ()),
        "stability": (("arch:blocks=3",), ()),
        "margins": (("stack:blocks=2",), ()),
        "plan": (("stack:blocks=2", "--alternatives", 2), ("plan.json", "plan-2.json")),
        "check": (("plan.json", "--replay"), ()),
        "graph": (("stack:blocks=2",), ("graph.npz",)),
        "replan": (("stack:blocks=2",), ("replan.json",)),
        "picture": (("plan.json", "--width", 200), ("plan.png",)),
        "view": (("plan.json", "--port", 8231), ()),
        "serve": (("stack:blocks=2",), ()),
        "cell new": (("ur10e", "--structure", "arch:radius=0.3", "--density", 100), ("new.toml",)),
        "robots plan": ((stack, "--cell", "cell.toml"), ("robot_plan.json",)),
        "robots check": (("robot_plan.json", "--motions-only"), ()),
        "robots export": (("robot_plan.json",), ("ros2",)),
        "train": (("arch:blocks=4", "--steps", 2, "--device", "cpu"), ("run",)),
        "evaluate": (("run", "--device", "cpu", "--states", 2), ()),
    }
    assert set(calls) == set(COMMANDS)
    places = {"cell new": "new.toml", "export": "folder", "picture": "plan.png", "robots export": "ros2"}
    needs = {"picture": "PIL", "view": "viser", "serve": "fastapi", "train": "torch", "evaluate": "torch"}
    for command, (words, files) in calls.items():
        if command in needs and not importable(needs[command]):
            continue
        out = ("--out", places[command]) if command in places else ()
        done = falsework(*command.split(), *words, *out, "--json")
        answer = done.answer
        assert done.code in (0, 3), (command, done.error)
        assert (answer["command"], answer["ok"]) == (command, done.code == 0)
        if command == "robots export":
            assert {str(Path(file).parent) for file in answer["files"]} == {"ros2"}
        else:
            assert answer["files"] == list(files), command
        assert all(Path(file).exists() for file in answer["files"]), command


def importable(name: str) -> bool:
    """Return whether a package is there."""
    from importlib.util import find_spec

    return find_spec(name) is not None

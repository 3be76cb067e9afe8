"""`falsework check`: what it says that it checked, exit codes, and text that names cannot forge."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework.cli.arguments import spell_options
from falsework.cli.exit_code import Exit
from falsework.cli.output import Output
from falsework.search.plans.plan_file import load_plan
from falsework.stability.contact import varied_replay
from falsework.stability.contact.varied_replay import Variation
from falsework.utils.files.printable import printable

Run = Callable[..., Any]
Write = Callable[..., Path]


@pytest.fixture
def planned(planned_once: Callable[..., bytes], tmp_path: Path) -> Path:
    out = tmp_path / "plan.json"
    out.write_bytes(planned_once("arch:blocks=3"))
    return out


def rewrite(path: Path, **entries: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


def test_a_structure_that_does_not_fit_is_answered_with_the_one_that_does(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=3", "--friction", 0.7, "--out", out).code == 0
    words = "give the structure that it was made for: arch:blocks=3, friction 0.7"
    for wrong in (("--structure", "arch:blocks=5"), ("--structure", "arch:blocks=3"), ("--friction", 0.9)):
        refused = falsework("check", out, *wrong)
        assert refused.code == 2
        assert words in refused.error


def test_options_of_the_plan_are_printed_and_the_exit_code_says_so(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    options = ("--friction", 0.5, "--ground", "--load", "2=0,0,-10")
    assert falsework("plan", "arch:blocks=3", *options, "--out", out).code == 0
    checked = falsework("check", out)
    assert checked.code == 3
    assert "all 7 states are stable" in checked.out
    shown = "--friction 0.5 --ground --load 2=0.0,0.0,-10.0"
    assert f"options of the structure that the plan sets: {shown}\n" in checked.out
    assert checked.error == (
        f"falsework: {out}: good only with options of the structure that the plan sets itself: {shown}; "
        "give them too, or --accept-overrides\n"
    )
    machine = falsework("check", out, "--json")
    assert machine.code == 3
    record = machine.answer
    loads = [{"part": "2", "force": [0.0, 0.0, -10.0]}]
    assert record["overrides"] == {"friction": 0.5, "ground": True, "loads": loads}
    for more in (options, shown.split(), ("--accept-overrides",)):
        accepted = falsework("check", out, *more)
        assert accepted.code == 0, accepted.error
        assert accepted.error == ""
    partly = falsework("check", out, "--ground", "--friction", 0.5)
    assert partly.code == 3
    assert "the plan sets itself: --load 2=0.0,0.0,-10.0;" in partly.error


def test_options_that_the_structure_has_anyway_change_nothing(
    falsework: Run, write_structure: Write, tmp_path: Path
) -> None:
    """Such as a ground, a friction and a boundary that its own file names by now."""
    folder, out = write_structure(tmp_path / "loose", boundary=[]), tmp_path / "plan.json"
    assert falsework("plan", folder, "--boundary", "0", "--friction", 0.4, "--out", out).code == 0
    assert falsework("check", out).code == 3
    (folder / "assembly.json").write_text(json.dumps({"boundary": ["0"], "friction": 0.4}))
    checked = falsework("check", out)
    assert (checked.code, checked.error) == (0, "")
    assert "options of the structure" not in checked.out


def test_a_bad_plan_is_bad_whatever_its_options(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=3", "--friction", 0.5, "--out", out).code == 0
    rewrite(out, steps=[], end=json.loads(out.read_text())["start"]["state"])
    empty = falsework("check", out)
    assert empty.code == 1
    assert empty.error == f"falsework: {out}: the plan has no step and shows nothing; plan again\n"
    assert empty.out == ""


def test_the_answer_says_what_was_checked(falsework: Run, planned: Path) -> None:
    record = falsework("check", planned, "--json").answer
    plan = load_plan(planned)
    assert record["about"] == {
        "structure": "arch:blocks=3",
        "identity": plan.identity,
        "boundary": [3, 4],
        "steps": 6,
        "robots": 2,
        "props": 0,
        "prop_limit": 0,
        "parts_at_once": 1,
        "moves": 1,
        "start": [0, 0, 0, 2, 2],
        "end": [1, 1, 1, 2, 2],
    }
    assert record["claim"]["criterion"] == "contact"
    assert record["overrides"] == {}
    assert record["unverified"] == ["its replay"]
    assert record["certified"] == 0


def test_start_and_end_in_words(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    options = ("--end", "1102", "--begin", "2002", "--criterion", "equilibrium")
    assert falsework("plan", "stack:blocks=3", *options, "--out", out).code == 0
    text = falsework("check", out, "--criterion", "equilibrium").out
    assert "from 1 of 3 parts, 1 held to 2 of 3 parts" in text


def test_certificates_are_evaluated(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=3", "--proofs", "--out", out).code == 0
    assert "certificates in the plan prove 7 states" in falsework("check", out).out
    assert falsework("check", out, "--json").answer["certified"] == 7
    other = falsework("check", out, "--criterion", "equilibrium", "--json")
    assert other.code == 0
    assert other.answer["certified"] == 0
    assert "its displacements" in other.answer["unverified"]


def test_a_replay_verifies_the_recorded_one(falsework: Run, planned: Path) -> None:
    verified = falsework("check", planned, "--replay", "--json")
    assert verified.code == 0
    assert verified.answer["unverified"] == []
    replay = json.loads(planned.read_text())["replay"]
    rewrite(planned, replay=replay | {"moved": 0.5 * replay["moved"]})
    assert falsework("check", planned).code == 0  # named as not verified
    denied = falsework("check", planned, "--replay")
    assert denied.code == 1
    assert "the plan says of its replay that parts move by " in denied.error
    rewrite(planned, replay=replay | {"moved": 2 * replay["moved"]})
    assert falsework("check", planned, "--replay").code == 0


def test_a_replay_says_under_which_settings_it_succeeds(
    falsework: Run, planned: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = falsework("check", planned, "--replay")
    assert done.code == 0
    assert "the replay succeeds, and under " in done.out
    cases = [Variation("damping 0.1", good=True, falls_at=None), Variation("stiffness 2", good=False, falls_at=3)]
    monkeypatch.setattr(varied_replay, "replay_varied", lambda *_, **__: cases)
    unclaimed = planned.with_name("unclaimed.json")
    unclaimed.write_text(planned.read_text().replace('"varied": true', '"varied": false'))
    done = falsework("check", unclaimed, "--replay")
    assert done.code == 0
    assert "succeeds under the given settings only, and fails under 1 of 2 changes of them" in done.out
    assert "marginal: its replay fails under stiffness 2 (fails after step 3 (" in done.error
    done = falsework("check", planned, "--replay")
    assert done.code == 1
    assert "says of its replay that it succeeds under changed settings too, which is not so" in done.error


def test_a_file_that_will_be_replaced_is_announced(falsework: Run, planned: Path) -> None:
    """By whatever command, before its work; bad options have one line alone, and the file stays."""
    words = f"{planned} exists and is replaced where there is a result; --out names another file"
    for command in (("plan", "arch:blocks=3"), ("replan", planned, "--step", 2), ("margins", planned)):
        assert words in falsework(*command, "--out", planned).error, command
    kept = planned.read_bytes()
    done = falsework("plan", "arch:blocks=3", "--robots", 0, "--out", planned)
    assert done.code == 2
    assert done.error.count("\n") == 1
    assert planned.read_bytes() == kept


def test_names_cannot_forge_what_is_printed(falsework: Run, planned: Path) -> None:
    """Neither those of a plan that is refused nor those of the structure itself."""
    forged = "a\n\x1b[2Kplan.json: all 7 states are stable\u202e\x9b"
    content = json.loads(planned.read_text())
    for entry in ({"name": forged}, {"identity": forged}, {"parts": [forged, *content["structure"]["parts"][1:]]}):
        rewrite(planned, structure=content["structure"] | entry)
        for more in ((), ("--steps",), ("--debug",)):
            finished = falsework("check", planned, *more)
            shown = finished.out + finished.error
            assert "\x1b" not in shown
            assert "\x9b" not in shown
            assert not any(line.startswith("\x1b") or line == forged.splitlines()[1] for line in shown.splitlines())
    refused = falsework("check", planned)
    assert refused.code == 2
    assert refused.error.count("\n") == 1


def test_control_characters_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    text = "a\x00\x07\t\n\r\x1b\x7f\x85\x9b\u2028\u202e\u2066\udcffz"
    escaped = r"a\x00\x07\t\n\r\x1b\x7f\x85\x9b\u2028\u202e\u2066\udcffz"
    assert printable(text) == escaped
    assert printable("Schlußstein 2 · キーストーン") == "Schlußstein 2 · キーストーン"
    output = Output(machine=False)
    output.say(text)
    output.note(text)
    output.table(("name", text), [(text, "[red]1"), ("  b", text)], dim="  ")
    shown = capsys.readouterr()
    assert shown.out.splitlines()[0] == shown.err.splitlines()[0] == escaped
    table = shown.out.splitlines()[1:]
    assert len(table) >= 3
    assert "[red]1" in "".join(table)
    assert not set(text[1:-1]) - {"\n"} & set(shown.out)
    output = Output(machine=True)
    output.record({"name": text})
    output.answer(Exit.DONE)
    record = capsys.readouterr().out
    assert json.loads(record)["name"] == text
    assert not set(text[1:-1]) - {"\n"} & set(record)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, ""),
        ({"unit": "mm", "density": 1800.0}, "--unit mm --density 1800.0"),
        ({"boundary": [0, 3], "ground": True}, "--boundary 0,3 --ground"),
        ({"boundary": ["a b", 3], "ground": False}, "--boundary 'a b,3'"),
        ({"earthquake": [0.1, 0.0], "interfaces": "stored"}, "--earthquake 0.1,0.0 --interfaces stored"),
        ({"loads": [{"part": 7, "force": [0, 0, -1e3], "at": [0.2, 0, 1]}]}, "--load 7=0,0,-1000.0@0.2,0,1"),
        ({"loads": [{"part": 7, "moment": [0, 0, 1]}]}, """--load '{"part": 7, "moment": [0, 0, 1]}'"""),
        ({"loads": ["odd"]}, "--load '\"odd\"'"),
    ],
)
def test_options_as_they_are_written(options: dict[str, Any], text: str) -> None:
    assert spell_options(options) == text

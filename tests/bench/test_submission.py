"""Faults of a line of a submission: one sentence with its number, and no effect on other lines."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from bench.__main__ import WRONG, main
from bench.structures import BRICKS, HERE
from bench.submission import read_submission
from falsework.errors import InputError
from tests.bench.conftest import ABOUT, CATENARY, STACK, Paper

PLAN, OTHER = f"plan/contact/{CATENARY}/2", f"plan/contact/{STACK}/2"
FEWEST, POLICY = f"fewest/contact/{CATENARY}", "policy/equilibrium/bottle-12/2/00"
LOOSE = f"plan/equilibrium/{CATENARY}/2"
HASH = "0" * 64
WRENCH = [0.0] * 6
WRONG_LINES: dict[str, tuple[str, dict[str, Any], str]] = {
    "unknown question": (PLAN, {"question": "plan/contact/pyramid/2"}, "no question 'plan/contact/pyramid/2'"),
    "no name": (PLAN, {"question": 3}, "no question 3"),
    "other structure": (PLAN, {"structure": HASH}, "for another structure: its hash 000000000000"),
    "no hash": (PLAN, {"structure": ...}, "lacks 'structure'"),
    "hash no text": (PLAN, {"structure": 1}, "structure is 1"),
    "unknown entry": (PLAN, {"verdicts": 3}, "unknown entry 'verdicts'"),
    "no steps, no reason": (PLAN, {"steps": None}, "either steps, or the reason"),
    "steps and reason": (PLAN, {"reason": "tired"}, "either steps, or the reason"),
    "reason no text": (PLAN, {"steps": None, "reason": 1}, "reason is 1"),
    "steps no list": (PLAN, {"steps": "insert 3"}, "steps is not a list"),
    "step no list": (PLAN, {"steps": ["insert 3"]}, "step 1 is 'insert 3'"),
    "verb": (PLAN, {"steps": [["insert", 1], ["glue", 1]]}, "step 2 does 'glue'"),
    "verb of the other way": (PLAN, {"steps": [["remove", 1]]}, "step 1 does 'remove'"),
    "verb of a policy": (POLICY, {"steps": [["insert", 1]]}, "policy takes hold and remove"),
    "part too large": (PLAN, {"steps": [["insert", 99]]}, "step 1: part is 99; give a whole number from 0 to 5"),
    "part negative": (PLAN, {"steps": [["insert", -1]]}, "part is -1"),
    "part a truth value": (PLAN, {"steps": [["insert", True]]}, "part is True"),
    "part not whole": (PLAN, {"steps": [["insert", 1.0]]}, "part is 1.0"),
    "robots missing": (FEWEST, {}, "robots is None"),
    "robots none": (FEWEST, {"robots": 0}, "robots is 0"),
    "robots of the question": (PLAN, {"robots": 3}, "robots is 3, but the question is about 2"),
    "reserve below one": (PLAN, {"reserve": 0.9}, "reserve is 0.9"),
    "reserve under equilibrium": (LOOSE, {"reserve": 1.1}, "under the criterion contact only"),
    "press under equilibrium": (LOOSE, {"steps": [["release", 1, [[2, WRENCH]]]]}, "equilibrium does not know"),
    "press": (PLAN, {"steps": [["release", 1, [[2, [1.0]]]]]}, "a press is [2, [1.0]]"),
    "presses": (PLAN, {"steps": [["release", 1, 5]]}, "presses is 5"),
    "seconds negative": (PLAN, {"seconds": -1}, "seconds is -1"),
}


@pytest.mark.parametrize("case", WRONG_LINES)
def test_a_wrong_line_is_a_fault_of_its_own(case: str, paper: Paper) -> None:
    name, changes, words = WRONG_LINES[case]
    paper.add(OTHER)
    line = paper.add(name, **changes)
    paper.add(LOOSE if name != LOOSE else PLAN)
    found = read_submission(paper.path, paper.data)
    (fault,) = found.faults
    assert fault.line == line
    assert words in fault.what
    assert len(found.answers) == 2


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"question": "plan/contact', "it is not valid JSON at line 1, column 14; it may be truncated"),
        ("[1, 2]", "not a JSON object"),
        ('{"question": "a", "question": "b"}', "entry 'question' twice"),
        ("[" * 100_000 + "]" * 100_000, "nested deeper"),
        ('{"seconds": 123456789012345678901234567890}', "does not fit into 64 bits"),
    ],
)
def test_a_line_that_is_no_answer_at_all(line: str, words: str, paper: Paper) -> None:
    number = paper.raw(line)
    (fault,) = read_submission(paper.path, paper.data).faults
    assert fault.line == number
    assert words in fault.what


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity"])
@pytest.mark.parametrize("entry", ["seconds", "reserve", "wrench"])
def test_numbers_are_finite(value: str, entry: str, paper: Paper) -> None:
    steps = [["release", 1, [[2, [0.0] * 5 + ["X"]]]]] if entry == "wrench" else []
    line = json.dumps(paper.answer(PLAN, steps=steps, **({} if entry == "wrench" else {entry: "X"})))
    paper.raw(line.replace('"X"', value))
    (fault,) = read_submission(paper.path, paper.data).faults
    assert "give a finite number" in fault.what


def test_an_answer_that_comes_twice_counts_once(paper: Paper) -> None:
    first = paper.add(PLAN)
    second = paper.add(PLAN, seconds=1)
    found = read_submission(paper.path, paper.data)
    assert [answer.line for answer in found.answers] == [first]
    assert found.faults[0].line == second
    assert f"answered in line {first} already" in found.faults[0].what


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "is empty"),
        (b'{"format": "falsework.plan/4"}\n', "line 1: its format is 'falsework.plan/4'"),
        (b'{"format": "falsework.bench/1"}\n', "line 1: it lacks 'method'"),
        (b'{"format": "falsework.bench/1", "method": ""}\n', "line 1: method is ''"),
        (b'{"format": "falsework.bench/1", "meth', "line 1: it is not valid JSON"),
        (b"\xff\xfe\x00", "is no text"),
    ],
)
def test_the_first_line_says_what_the_file_is(text: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.jsonl"
    path.write_bytes(text)
    with pytest.raises(InputError, match=words):
        read_submission(path, tmp_path)


def test_lines_may_end_as_on_windows(paper: Paper) -> None:
    paper.add(PLAN)
    paper.path.write_bytes(b"\xef\xbb\xbf" + paper.path.read_bytes().replace(b"\n", b"\r\n") + b"\r\n")
    found = read_submission(paper.path, paper.data)
    assert not found.faults
    assert len(found.answers) == 1


def test_the_command_names_file_and_line(paper: Paper, capsys: pytest.CaptureFixture[str]) -> None:
    line = paper.add(PLAN, structure=HASH)
    assert main(["check", str(paper.path), "--data", str(paper.data)]) == WRONG
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert said[0].startswith(f"{paper.path}, line {line}: ")


def test_texts_of_bricks_that_are_elsewhere_are_no_fault(paper: Paper) -> None:
    for name in (f"plan/contact/{BRICKS}/abc-1/2", f"fewest/contact/{BRICKS}/abc-1"):
        paper.raw(json.dumps({"question": name, "structure": HASH, "steps": [["insert", 7]], "robots": 2}))
    found = read_submission(paper.path, paper.data)
    assert not found.faults
    assert [answer.question.name for answer in found.answers] == [
        f"plan/contact/{BRICKS}/abc-1/2",
        f"fewest/contact/{BRICKS}/abc-1",
    ]


def test_the_schema_says_the_same(paper: Paper) -> None:
    schema = json.loads((HERE / "submission.schema.json").read_text(encoding="utf-8"))
    validator = jsonschema.Draft202012Validator(schema)
    validator.check_schema(schema)
    press = [["insert", 1], ["release", 1, [[2, WRENCH]]]]
    for good in (
        ABOUT,
        {**ABOUT, "version": "1", "settings": "none"},
        paper.answer(PLAN, steps=press, reserve=1.1, seconds=0),
        paper.answer(PLAN, steps=None, reason="none found"),
        paper.answer(FEWEST, robots=2),
    ):
        validator.validate(good)
    # What depends on the question cannot be in the schema.
    question = {"unknown question", "other structure", "verb of the other way", "verb of a policy", "part too large"}
    question |= {"robots missing", "robots of the question", "reserve under equilibrium", "press under equilibrium"}
    for case in WRONG_LINES.keys() - question - {"part not whole"}:  # 1.0 is an integer in JSON Schema
        name, changes, _ = WRONG_LINES[case]
        assert not validator.is_valid(paper.answer(name, **changes)), case

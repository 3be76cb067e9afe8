"""From questions to a table, on two small structures; and what is on record is true."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import pytest

from bench import table
from bench.__main__ import DONE, NO, WRONG, main
from bench.judge import judge
from bench.questions import questions
from bench.records import RESULTS, all_records, read_record, record_path, still_true
from bench.structures import manifest
from bench.submission import read_submission
from falsework.errors import InputError
from tests.bench.conftest import CATENARY, STACK, Paper

SUBMISSIONS = sorted(path for path in RESULTS.glob("*.jsonl") if not path.name.endswith(".judged.jsonl"))
AGAIN = 3
"""Answers of each submission that are judged again here, those about the smallest structures."""


def test_from_questions_to_judgements(tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine, more = tmp_path / "mine.jsonl", ["--data", str(data)]
    assert main(["questions", "--only", f"*/{CATENARY}*", *more]) == DONE
    listed = [json.loads(line)["question"] for line in capsys.readouterr().out.splitlines()]
    assert len(listed) == 3 + 10
    run = ["run", "falsework", "--out", str(mine), "--only", f"*/{CATENARY}*", *more]
    assert main(run) == DONE
    written = mine.read_text(encoding="utf-8")
    assert main(run) == DONE  # what is answered is not asked again
    assert mine.read_text(encoding="utf-8") == written
    assert main(["check", str(mine), "--record", *more]) == DONE
    assert f"{len(listed)} solved of {len(listed)} judged" in capsys.readouterr().out
    record = read_record(record_path(mine))
    assert sorted(record.judged) == sorted(listed)
    assert len(still_true(record, read_submission(mine, data))) == len(listed)
    assert main(["check", str(mine), "--line", "2", *more]) == DONE
    assert "1 solved of 1 judged" in capsys.readouterr().out


def test_a_place_that_cannot_be_written_is_one_line(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "mine.jsonl", tmp_path):
        run = ["run", "falsework", "--out", str(out), "--only", f"*/{CATENARY}*", "--data", str(data)]
        assert main(run) == WRONG
        captured = capsys.readouterr()
        assert (captured.out, captured.err.count("\n")) == ("", 1)
        assert captured.err.startswith(f"bench: {tmp_path}")


def test_a_refuted_answer_is_no(paper: Paper, capsys: pytest.CaptureFixture[str]) -> None:
    paper.add(f"plan/contact/{STACK}/2", steps=[["insert", 1], ["release", 1]])
    assert main(["check", str(paper.path), "--data", str(paper.data)]) == NO
    assert f"refuted  plan/contact/{STACK}/2: " in capsys.readouterr().out


def test_a_record_that_says_something_else_is_told(paper: Paper, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"plan/contact/{STACK}/2"
    paper.add(name, steps=[["insert", 1]])
    more = ["--data", str(paper.data)]
    assert main(["check", str(paper.path), "--record", *more]) == NO
    path = record_path(paper.path)
    path.write_text(path.read_text(encoding="utf-8").replace('"refuted"', '"solved"'), encoding="utf-8")
    capsys.readouterr()
    assert main(["check", str(paper.path), *more]) == NO
    assert f"another judgement of {name}" in capsys.readouterr().err


def test_judgements_stay_as_long_as_their_answer_does(paper: Paper, capsys: pytest.CaptureFixture[str]) -> None:
    first, second, more = f"plan/contact/{STACK}/2", f"plan/contact/{CATENARY}/2", ["--data", str(paper.data)]
    paper.add(first, steps=[["insert", 1]])
    main(["check", str(paper.path), "--record", *more])
    paper.add(second, steps=[["insert", 1]])
    capsys.readouterr()
    main(["check", str(paper.path), "--record", "--new", *more])
    assert "0 solved of 1 judged" in capsys.readouterr().out
    assert list(read_record(record_path(paper.path)).judged) == [second, first]
    paper.lines[1] = json.dumps(paper.answer(first, steps=[["insert", 2]]))
    paper.add(f"plan/equilibrium/{STACK}/2", steps=[["insert", 1]])
    main(["check", str(paper.path), "--record", "--only", "plan/equilibrium/*", *more])
    assert list(read_record(record_path(paper.path)).judged) == [second, f"plan/equilibrium/{STACK}/2"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "{mine}", "--line", "99"], "answers no question that was asked for"),
        (["check", "{mine}", "--only", "replan/*"], "answers no question that was asked for"),
        (["questions", "--only", "plan/contact/pyramid/*"], "no question matches"),
        (["run", "prayer", "--out", "{mine}"], "no method 'prayer'; choose falsework, depth-first"),
        (["run", "policy", "--out", "{mine}"], "needs the folder of a run; give --policy"),
        (["run", "falsework", "--out", "{mine}", "--policy", "x"], "and only this one, needs the folder of a run"),
        (["run", "uniform", "--out", "{mine}", "--only", "plan/*"], "uniform answers policy only"),
        (["run", "policy", "--out", "{mine}", "--policy", "{data}"], "run.json"),
    ],
)
def test_wrong_use_is_one_line(
    arguments: list[str], words: str, paper: Paper, capsys: pytest.CaptureFixture[str]
) -> None:
    paper.add(f"plan/contact/{STACK}/2")
    filled = [word.format(mine=paper.path, data=paper.data) for word in arguments]
    assert main([*filled, "--data", str(paper.data)]) == WRONG
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert words in said[0]


def test_a_run_does_not_go_on_after_a_faulty_line(paper: Paper, capsys: pytest.CaptureFixture[str]) -> None:
    line = paper.raw("{")
    arguments = ["run", "falsework", "--out", str(paper.path), "--only", f"plan/contact/{STACK}/2"]
    assert main([*arguments, "--data", str(paper.data)]) == WRONG
    assert f"line {line}: " in capsys.readouterr().err


def test_a_file_of_something_else_is_no_record(tmp_path: Path) -> None:
    path = tmp_path / "x.judged.jsonl"
    path.write_text('{"format": "other"}\n', encoding="utf-8")
    with pytest.raises(InputError, match="no file of judgements"):
        read_record(path)


def test_policies_answer_by_rollouts(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from bench.methods import METHODS, timed
    from bench.questions import Question
    from bench.structures import Structure
    from bench.submission import Answer, Step
    from falsework import load_structure

    wall = load_structure("wall:bricks=2,courses=2")
    verdicts = Counter()
    for number in range(8):
        state = "".join("2" if fixed else "1" for fixed in wall.boundary)
        question = Question("policy", "equilibrium", Structure("wall", "test"), 2, str(number), state)
        found, _ = timed(METHODS["uniform"], question, wall, 1.0)
        if found.steps is None:
            verdicts["failed"] += 1
            continue
        answer = Answer(2, question, tuple(Step(*step) for step in found.steps), 2, structure=wall.identity)
        verdicts["solved" if judge(answer, wall).solved else "refuted"] += 1
    assert verdicts["solved"] > 0
    assert not verdicts["refuted"]  # the environment ends a rollout at the first state that is not stable


@pytest.mark.parametrize("path", SUBMISSIONS, ids=lambda path: path.stem)
def test_what_is_on_record_is_of_the_submission_beside_it(path: Path, tmp_path: Path) -> None:
    record = read_record(record_path(path))
    found = read_submission(path, tmp_path)
    assert not found.faults
    assert still_true(record, found) == record.judged
    assert len(record.judged) == len(found.answers)
    small = [answer for answer in found.answers if answer.question.structure.generated and answer.steps is not None]
    for answer in sorted(small, key=lambda answer: answer.question.structure.parts)[:AGAIN]:
        judgement = judge(answer, answer.question.structure.load(tmp_path))
        assert judgement.outcome == record.judged[answer.question.name]["outcome"]


def test_the_page_has_the_tables_of_the_records() -> None:
    text = table.PAGE.read_text(encoding="utf-8")
    assert table.filled_text(text) == text
    for name in table.TABLES:
        assert f"<!-- bench: {name} -->" in text


def test_quoted_figures_are_of_questions_that_exist_and_marked(tmp_path: Path) -> None:
    rows = {question.row for question in questions(tmp_path)}
    quoted = json.loads(table.QUOTED.read_text(encoding="utf-8"))
    assert {entry["row"] for entry in quoted["quoted"]} <= rows
    assert all(entry["place"] for entry in quoted["quoted"])
    text = table.PAGE.read_text(encoding="utf-8")
    assert text.count(", quoted") >= 2


def test_records_are_of_known_methods_and_structures() -> None:
    records = all_records()
    assert {"falsework", "depth-first"} <= {record.about["method"] for record in records}
    for record in records:
        for name in record.judged:
            assert any(f"/{one}" in name for one in manifest()), name

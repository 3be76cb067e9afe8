"""Records of the judge, from which the tables are made: a line for each answer, in a file beside the submission."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.judge import Judgement
from bench.structures import HERE
from bench.submission import Answer, Submission
from falsework.errors import InputError

RESULTS = HERE / "results"
FORMAT = "falsework.bench.judged/1"
_SUFFIX = ".judged.jsonl"


@dataclass(frozen=True)
class Record:
    """Judgements of a submission."""

    about: Mapping[str, Any]
    """Method and file of the submission; commit, date and versions of the last check."""
    judged: Mapping[str, Mapping[str, Any]]
    """Judgement by the name of the question."""


def record_path(submission: Path) -> Path:
    """Return the file of the judgements of a submission."""
    return submission.with_name(submission.name.removesuffix(".jsonl") + _SUFFIX)


def line_of(answer: Answer, found: Judgement) -> dict[str, Any]:
    """Return the line of an answer."""
    claimed = {} if answer.seconds is None else {"seconds": answer.seconds}
    return {"question": answer.question.name, "answer": answer.digest, **found.to_dict(), **claimed}


def still_true(record: Record, submission: Submission) -> dict[str, Mapping[str, Any]]:
    """Return the judgements of a record that are about answers as they now are in a submission."""
    answers = {answer.question.name: answer.digest for answer in submission.answers}
    return {name: line for name, line in record.judged.items() if answers.get(name) == line["answer"]}


def write_record(path: Path, about: Mapping[str, Any], judged: Mapping[str, Mapping[str, Any]]) -> None:
    """Write judgements, in the order of the names of the questions."""
    lines = [{"format": FORMAT, **about}, *(judged[name] for name in sorted(judged))]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def read_record(path: Path) -> Record:
    """Read judgements.

    Raises:
        InputError: another file.
    """
    first, *lines = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    if first.pop("format", None) != FORMAT:
        raise InputError(f"{path} is no file of judgements; `python -m bench check --record` writes one")
    return Record(first, {line["question"]: line for line in lines})


def all_records() -> list[Record]:
    """Return the judgements of all submissions that come with the benchmark."""
    return [read_record(path) for path in sorted(RESULTS.glob(f"*{_SUFFIX}"))]

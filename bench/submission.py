"""Submissions: a file of JSON lines, first what the method is, then an answer a line; see `submission.schema.json`.

A line that cannot be used is a fault with its number and one sentence. It spoils no other line.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.questions import Question, question_elsewhere, questions
from falsework.errors import InputError
from falsework.stability.holds import Press
from falsework.utils.json_text import parse_json

FORMAT = "falsework.bench/1"
MOST_RESERVE = 10.0
"""Largest reserve that an answer may claim."""
_ABOUT = {"format", "method"}
_ABOUT_TEXTS = {"method", "version", "commit", "date", "device", "settings", "source"}
_REQUIRED = {"question", "structure", "steps"}
_OPTIONAL = {"robots", "reserve", "seconds", "reason"}


@dataclass(frozen=True)
class Step:
    """One step of an answer."""

    verb: str
    part: int
    presses: tuple[Press, ...] = ()


@dataclass(frozen=True)
class Answer:
    """One line of a submission."""

    line: int
    """Number of the line in the file, from 1."""
    question: Question
    steps: tuple[Step, ...] | None
    """In the order in which they are done; None where the method found none."""
    robots: int
    """Of the question, or those that the answer to `fewest` needs."""
    reserve: float = 1.0
    """Number by which friction is divided in the check, besides the check under the true friction."""
    seconds: float | None = None
    """Time that the method says it took, which cannot be checked."""
    reason: str = ""
    """Why there are no steps."""
    structure: str = ""
    """Hash of the structure that the answer is for."""
    digest: str = ""
    """Hash of the line."""


@dataclass(frozen=True)
class Fault:
    """A line that cannot be used."""

    line: int
    what: str


@dataclass(frozen=True)
class Submission:
    """What a file says."""

    about: Mapping[str, str]
    """Method, version and so on."""
    answers: tuple[Answer, ...]
    faults: tuple[Fault, ...]


def read_submission(path: Path, root: Path) -> Submission:
    """Read a submission; what is wrong with a line is a fault.

    Args:
        path: file of JSON lines.
        root: folder of data.

    Raises:
        InputError: the file cannot be read, or its first line does not say what it is.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}; name a submission") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is no text; name a submission, a file of JSON lines") from None
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    if not lines:
        raise InputError(f"{path} is empty; its first line must say what the method is")
    number, first = lines[0]
    try:
        about = _about(_object(first))
    except ValueError as error:
        raise InputError(f"{path}, line {number}: {error}") from None
    by_name = {question.name: question for question in questions(root)}
    answers: dict[str, Answer] = {}
    faults: list[Fault] = []
    for number, line in lines[1:]:
        try:
            answer = _answer(_object(line), number, by_name, root)
            earlier = answers.get(answer.question.name)
            if earlier is not None:
                raise ValueError(f"{answer.question.name} is answered in line {earlier.line} already; keep one of them")
        except ValueError as error:
            faults.append(Fault(number, str(error)))
            continue
        digest = hashlib.sha256(line.strip().encode()).hexdigest()
        answers[answer.question.name] = replace(answer, digest=digest)
    return Submission(about, tuple(answers.values()), tuple(faults))


def _object(line: str) -> dict[str, Any]:
    data = parse_json(line)
    if not isinstance(data, dict):
        raise ValueError("it is not a JSON object; write one a line")
    return data


def _about(data: dict[str, Any]) -> dict[str, str]:
    if data.get("format") != FORMAT:
        raise ValueError(f"its format is {str(data.get('format'))[:40]!r}; the first line must say {FORMAT!r}")
    _keys(data, _ABOUT, _ABOUT_TEXTS)
    for key, value in data.items():
        if not isinstance(value, str) or not value.strip():
            raise ValueError(f"{key} is {_short(value)}; give a text")
    return {key: value for key, value in data.items() if key != "format"}


def _answer(data: dict[str, Any], line: int, known: Mapping[str, Question], root: Path) -> Answer:
    _keys(data, _REQUIRED, _OPTIONAL)
    name = data["question"]
    question = (known.get(name) or question_elsewhere(name, root)) if isinstance(name, str) else None
    if question is None:
        raise ValueError(f"there is no question {_short(data['question'])}; `python -m bench questions` lists them")
    structure, digest = question.structure, question.structure.digest
    if not isinstance(data["structure"], str) or not data["structure"]:
        raise ValueError(f"structure is {_short(data['structure'])}; `python -m bench questions` has its hash")
    if digest and data["structure"] != digest:
        raise ValueError(
            f"it is for another structure: its hash {data['structure'][:12]} is not {digest[:12]} of {structure.name}; "
            "solve it again for the structure of the manifest"
        )
    if (data["steps"] is None) != ("reason" in data):
        raise ValueError("an answer has either steps, or the reason why there are none; give one of them")
    reason = data.get("reason", "")
    if not isinstance(reason, str):
        raise ValueError(f"reason is {_short(reason)}; give a text")
    robots = question.robots
    if not robots and data["steps"] is not None:
        robots = _count(data.get("robots"), "robots", 1, structure.parts or None)
    elif "robots" in data and robots and data["robots"] != robots:
        raise ValueError(f"robots is {_short(data['robots'])}, but the question is about {robots}; leave it out")
    reserve = _number(data.get("reserve", 1.0), "reserve", 1.0, MOST_RESERVE)
    if reserve > 1.0 and question.criterion != "contact":
        raise ValueError("a reserve is checked under the criterion contact only; leave it out")
    seconds = data.get("seconds")
    steps = None if data["steps"] is None else _steps(data["steps"], question)
    return Answer(
        line=line,
        question=question,
        steps=steps,
        robots=robots,
        reserve=reserve,
        seconds=None if seconds is None else _number(seconds, "seconds", 0.0, math.inf),
        reason=reason,
        structure=data["structure"],
    )


def _steps(value: Any, question: Question) -> tuple[Step, ...]:
    if not isinstance(value, list):
        raise ValueError("steps is not a list")
    verbs = ("insert", "release") if question.builds else ("hold", "remove")
    parts, found = question.structure.parts or None, []
    for number, entry in enumerate(value, 1):
        place = f"step {number}"
        if not isinstance(entry, list) or len(entry) not in (2, 3):
            raise ValueError(f'{place} is {_short(entry)}; give a list such as ["{verbs[0]}", 3]')
        if entry[0] not in verbs:
            raise ValueError(f"{place} does {_short(entry[0])}; {question.task} takes {verbs[0]} and {verbs[1]}")
        part = _count(entry[1], f"{place}: part", 0, None if parts is None else parts - 1)
        presses = _presses(entry[2], place, parts) if len(entry) == 3 else ()
        if presses and question.criterion != "contact":
            raise ValueError(f"{place} has presses, which the criterion equilibrium does not know; leave them out")
        found.append(Step(entry[0], part, presses))
    return tuple(found)


def _presses(value: Any, place: str, parts: int | None) -> tuple[Press, ...]:
    if not isinstance(value, list):
        raise ValueError(f"{place}: presses is {_short(value)}; give a list of parts with their wrenches")
    found = []
    for entry in value:
        if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[1], list) or len(entry[1]) != 6:
            raise ValueError(f"{place}: a press is {_short(entry)}; give a part and its wrench, six numbers (N, N m)")
        part = _count(entry[0], f"{place}: pressed part", 0, None if parts is None else parts - 1)
        wrench = tuple(_number(entry, f"{place}: wrench", -math.inf, math.inf) for entry in entry[1])
        found.append(Press(part, wrench))
    return tuple(found)


def _keys(data: dict[str, Any], required: set[str], optional: set[str]) -> None:
    lacking, unknown = sorted(required - set(data)), sorted(set(data) - required - optional)
    if lacking:
        raise ValueError(f"it lacks {lacking[0]!r}; it needs {', '.join(sorted(required))}")
    if unknown:
        raise ValueError(f"it has an unknown entry {unknown[0][:40]!r}; leave it out")


def _count(value: Any, name: str, least: int, most: int | None) -> int:
    if type(value) is not int or value < least or (most is not None and value > most):
        upto = "up" if most is None else f"to {most}"
        raise ValueError(f"{name} is {_short(value)}; give a whole number from {least} {upto}")
    return value


def _number(value: Any, name: str, least: float, most: float) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or not least <= value <= most:
        limits = [f"from {least:g}"] * math.isfinite(least) + [f"to {most:g}"] * math.isfinite(most)
        raise ValueError(f"{name} is {_short(value)}; give a finite number {' '.join(limits)}".rstrip())
    return float(value)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."

"""Tables of docs/benchmark.md, from the manifest, the judgements on record, and quoted figures.

A cell counts what the judge found, never what a submission says; only seconds are those that a method claims.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

from bench.questions import Question, questions_of
from bench.records import Record, all_records
from bench.structures import HERE, MANIFEST, manifest

PAGE = HERE.parent / "docs" / "benchmark.md"
QUOTED = HERE / "quoted.json"
_BLOCK = re.compile(r"(<!-- bench: ([\w-]+) -->\n).*?(<!-- /bench -->)", re.DOTALL)


def fill(page: Path = PAGE) -> bool:
    """Fill every block of a page; return whether anything changed."""
    text = page.read_text(encoding="utf-8")
    filled = filled_text(text)
    if filled == text:
        return False
    page.write_text(filled, encoding="utf-8")
    return True


def filled_text(text: str) -> str:
    """Return a text with every block `<!-- bench: NAME -->` made anew."""
    return _BLOCK.sub(lambda block: f"{block[1]}{TABLES[block[2]]()}\n{block[3]}", text)


def _structures() -> str:
    splits = json.loads(MANIFEST.read_text(encoding="utf-8"))["splits"]
    body = []
    for split, words in splits.items():
        some = [one for one in manifest().values() if one.split == split]
        parts = [one.parts for one in some]
        sources = dict.fromkeys(
            "this package" if one.generated else f"{one.repository.removeprefix('github.com/')}, {one.licence}"
            for one in some
        )
        size = f"{min(parts)} to {max(parts)}" if parts else ""
        body.append(
            [f"`{split}`", words, str(len(some) or ""), size, "; ".join(sources) or "AvaLovelace/StableText2Brick, MIT"]
        )
    return _markdown(["split", "what", "structures", "parts", "source, licence"], body)


def _summary() -> str:
    records = all_records()
    groups: dict[tuple[str, str], list[Question]] = {}
    for question in _questions():
        groups.setdefault((f"{question.task}, `{question.criterion}`", question.structure.split), []).append(question)
    body = []
    for (task, split), some in groups.items():
        cells = [_share(record, some) for record in records]
        body.append([task, f"`{split}`", str(len(some)), *cells])
    heads = ["task, criterion", "split", "questions", *(record.about["method"] for record in records)]
    return _markdown(heads, [row for row in body if any(row[3:])])


def _plans() -> str:
    records = [record for record in all_records() if any(name.startswith("plan/") for name in record.judged)]
    quoted = _quoted("plan/")
    body = []
    for question in _questions():
        if question.task != "plan" or question.structure.split == "generated":
            continue
        cells = [_cell(record.judged.get(question.name)) for record in records]
        about = quoted.get(question.name)
        body.append([f"`{question.name}`", *cells, "" if about is None else f"{about['figure']} ({about['place']})"])
    heads = ["question", *(record.about["method"] for record in records), "depth-first search of the paper, quoted"]
    return _markdown(heads, [row for row in body if any(row[1:])])


def _fewest() -> str:
    records = [record for record in all_records() if any(name.startswith("fewest/") for name in record.judged)]
    body = []
    for question in _questions():
        if question.task == "fewest":
            found = [record.judged.get(question.name) for record in records]
            cells = ["" if one is None else _failure(one) or str(one["robots"]) for one in found]
            body.append([f"`{question.name}`", *cells])
    heads = ["question", *(record.about["method"] for record in records)]
    return _markdown(heads, [row for row in body if any(row[1:])])


def _policies() -> str:
    records = [record for record in all_records() if any(name.startswith("policy/") for name in record.judged)]
    quoted, rows = _quoted("policy/"), {}
    for question in _questions():
        if question.task == "policy":
            rows.setdefault(question.row, []).append(question)
    body = []
    for row, some in rows.items():
        about = quoted.get(row)
        cells = [_share(record, some) for record in records]
        body.append([f"`{row}/*`", *cells, "" if about is None else f"{about['figure']} ({about['place']})"])
    heads = ["questions", *(record.about["method"] for record in records), "policy of the paper, quoted"]
    return _markdown(heads, body)


def _methods() -> str:
    body = []
    for record in all_records():
        about = record.about
        path = f"bench/results/{about['submission']}"
        body.append(
            [
                about["method"],
                f"`{path}`",
                str(len(record.judged)),
                about.get("commit", ""),
                about.get("date", ""),
                about.get("device", ""),
                about.get("settings", ""),
                about["checked"]["commit"],
            ]
        )
    heads = ["method", "submission", "answers judged", "commit", "date", "device", "settings", "judged at commit"]
    return _markdown(heads, body)


TABLES: Mapping[str, Callable[[], str]] = {
    "structures": _structures,
    "summary": _summary,
    "plans": _plans,
    "fewest": _fewest,
    "policies": _policies,
    "methods": _methods,
}


@cache
def _questions() -> tuple[Question, ...]:
    """Return the questions of the manifest, which do not depend on the data of this machine."""
    return tuple(questions_of(manifest()))


def _quoted(task: str) -> dict[str, dict[str, str]]:
    entries = json.loads(QUOTED.read_text(encoding="utf-8"))["quoted"]
    return {entry["row"]: entry for entry in entries if entry["row"].startswith(task)}


def _share(record: Record, some: Sequence[Question]) -> str:
    """Write how many questions are solved of those that were judged, and the median of the claimed seconds."""
    judged = [record.judged[question.name] for question in some if question.name in record.judged]
    if not judged:
        return ""
    solved = [one for one in judged if one["outcome"] == "solved"]
    seconds = [one["seconds"] for one in solved if "seconds" in one]
    refuted = sum(one["outcome"] == "refuted" for one in judged)
    words = f"{len(solved)} of {len(judged)}"
    words += f", {refuted} refuted" if refuted else ""
    return words + (f"; {_seconds(median(seconds))}" if seconds else "")


def _cell(judged: Mapping[str, Any] | None) -> str:
    if judged is None:
        return ""
    if judged["outcome"] != "solved":
        return _failure(judged)
    reserve = f", reserve {judged['reserve']:g}" if judged["reserve"] > 1 else ""
    return f"solved{reserve}; {_seconds(judged['seconds'])}" if "seconds" in judged else f"solved{reserve}"


def _failure(judged: Mapping[str, Any]) -> str:
    return {"solved": "", "open": "not found", "refuted": "refuted"}[judged["outcome"]]


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value < 100 else f"{value:.0f} s"


def _markdown(heads: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    rows = list(body)
    shown = [n for n in range(len(heads)) if any(row[n] for row in rows)]
    lines = [[heads[n] for n in shown], ["---"] * len(shown), *([row[n] for n in shown] for row in rows)]
    return "\n".join(re.sub(r"  (?=\|)", " ", f"| {' | '.join(line)} |") for line in lines)

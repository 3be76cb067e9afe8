from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bench.questions import questions
from bench.submission import FORMAT

ABOUT = {"format": FORMAT, "method": "by hand"}
CATENARY = "catenary:blocks=4,rise=1.556"
STACK = "stack:blocks=3,overhang=0.609,height=0.147"


class Paper:
    """A submission that is being written."""

    def __init__(self, path: Path, data: Path) -> None:
        self.path, self.data = path, data
        self.lines: list[str] = [json.dumps(ABOUT)]

    def answer(self, name: str, **changes: Any) -> dict[str, Any]:
        """The entries of a line, with the right hash and no steps unless they are given."""
        (question,) = questions(self.data, name)
        line = {"question": name, "structure": question.structure.digest, "steps": [], **changes}
        return {key: value for key, value in line.items() if value is not ...}

    def add(self, name: str, **changes: Any) -> int:
        return self.raw(json.dumps(self.answer(name, **changes)))

    def raw(self, line: str) -> int:
        """Write a line as it is; return its number."""
        self.lines.append(line)
        self.path.write_text("\n".join(self.lines) + "\n", encoding="utf-8")
        return len(self.lines)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """An empty folder of data."""
    folder = tmp_path / "data"
    folder.mkdir()
    return folder


@pytest.fixture
def paper(tmp_path: Path, data: Path) -> Paper:
    return Paper(tmp_path / "mine.jsonl", data)

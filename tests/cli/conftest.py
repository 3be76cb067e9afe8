"""Structures on disk and a way to run the command, for all tests of the command line."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from falsework.cli.main import main

Box = tuple[Sequence[float], Sequence[float]]

STACK: tuple[Box, ...] = (((0, 0, 0), (2, 1, 1)), ((0, 0, 1), (2, 1, 2)), ((0.5, 0, 2), (1.5, 1, 3)))
"""Three boxes on top of each other, lower and upper corners."""


def box_obj(low: Sequence[float], high: Sequence[float]) -> str:
    """A box as OBJ text."""
    corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    return "\n".join(lines) + "\n"


def write_structure(folder: Path, boxes: Sequence[Box] = STACK, **description: Any) -> Path:
    """A folder with one OBJ a box and `assembly.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (low, high) in enumerate(boxes):
        (folder / f"{number}.obj").write_text(box_obj(low, high))
    (folder / "assembly.json").write_text(json.dumps({"boundary": [0], **description}))
    return folder


@pytest.fixture(name="write_structure")
def _write_structure() -> Callable[..., Path]:
    """`write_structure(folder, boxes, **description)`; test modules cannot import from here."""
    return write_structure


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    """Folder with a stack of three boxes, the lowest of which is boundary."""
    return write_structure(tmp_path / "stack")


@dataclass(frozen=True)
class Finished:
    """What a run of the command left behind."""

    code: int
    out: str
    error: str

    read: Callable[[str], dict[str, Any]]

    @property
    def answer(self) -> dict[str, Any]:
        """JSON answer on standard output, which the schema describes."""
        return self.read(self.out)


@pytest.fixture
def falsework(
    capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], dict[str, Any]]
) -> Callable[..., Finished]:
    """Run the command in this process."""

    def run(*arguments: str | Path | int | float) -> Finished:
        capsys.readouterr()
        code = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Finished(int(code), captured.out, captured.err, read_answer)

    return run

"""A fixed corpus of 500 damaged files of all kinds: each is read, or refused in one line. `make fuzz` tries others."""

from __future__ import annotations

import random
import time
from itertools import islice
from pathlib import Path

import pytest

from falsework.errors import InputError

fuzz = pytest.importorskip("fuzz_readers", reason="the fuzzer forks, which needs POSIX")

COUNT, SEED, PIECES = 500, 20, 10
"""Inputs, and the parts in which they are tested."""
SLOWEST = 10.0
"""Seconds for an input, on machines that do other things besides."""
CORE = {"assembly.json", "1.obj", "glb", "compas-dem", "plan", "graph", "npy states", "cell", "robot plan"}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, fuzz.Kind]:
    return fuzz.kinds(tmp_path_factory.mktemp("intact"))


def test_intact_files_are_read(found: dict[str, fuzz.Kind], tmp_path: Path) -> None:
    assert set(found) >= CORE
    for name, kind in found.items():
        (tmp_path / name).mkdir()
        assert fuzz.examine(kind, fuzz.place(kind, kind.content, tmp_path / name)) == "", name


@pytest.mark.parametrize("piece", range(PIECES))
def test_the_corpus(piece: int, found: dict[str, fuzz.Kind], tmp_path: Path) -> None:
    wrong, refused = {}, 0
    for name, number, content in islice(fuzz.inputs(found, SEED), piece, COUNT, PIECES):
        folder = tmp_path / f"{name} {number}"
        folder.mkdir()
        begun = time.perf_counter()
        path = fuzz.place(found[name], content, folder)
        if said := fuzz.examine(found[name], path):
            wrong[name, number] = said
        elif time.perf_counter() - begun > SLOWEST:
            wrong[name, number] = "too slow"
        refused += content != found[name].content
        assert {entry.name for entry in folder.iterdir()} == {path.name, *found[name].beside}
    assert not wrong
    assert refused > 0.9 * COUNT / PIECES  # inputs that are damaged


def test_the_fuzzer_notices(found: dict[str, fuzz.Kind], tmp_path: Path) -> None:
    """Readers with defects are found out, in this process and in one of their own."""

    def fail(_: Path) -> None:
        raise KeyError("defect")

    def repeat(_: Path) -> None:
        raise InputError("a.json is damaged (KeyError: 'defect'); write it again")

    def kind(read: object) -> fuzz.Kind:
        return fuzz.Kind(b"{}", "a.json", read, {})

    path = tmp_path / "a.json"
    path.write_bytes(b"{}")
    assert fuzz.examine(kind(fail), path) == "KeyError: 'defect'"
    assert fuzz.in_process_of_its_own(kind(fail), path) == "KeyError: 'defect'"
    assert fuzz.examine(kind(repeat), path).startswith("in the words of Python: ")
    assert fuzz.in_process_of_its_own(kind(lambda _: bytearray(1 << 40)), path) == "MemoryError"
    assert fuzz.in_process_of_its_own(kind(lambda _: fuzz.os.abort()), path) == "SIGABRT"
    outside = tmp_path.parent / "outside"
    assert "forbidden: open" in fuzz.in_process_of_its_own(kind(lambda _: outside.write_text("")), path)
    assert not outside.exists()
    assert fuzz.in_process_of_its_own(kind(lambda read: read.read_text()), path) == ""


def test_mutations_are_the_same_every_time(found: dict[str, fuzz.Kind]) -> None:
    kind = found["glb"]
    first = fuzz.mutate(kind, random.Random("7"))
    assert first == fuzz.mutate(kind, random.Random("7"))
    assert first != fuzz.mutate(kind, random.Random("8"))

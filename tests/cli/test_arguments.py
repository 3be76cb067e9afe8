"""Lists of parts and states as they are written on the command line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework.cli.arguments import parse_parts, parse_state, read_states
from falsework.errors import InputError, StateError

FOUR_PARTS: Any = SimpleNamespace(boundary=np.array([True, False, False, False]))


@pytest.mark.parametrize(
    ("text", "parts"),
    [("3", (3,)), ("3,4", (3, 4)), (" 0-2, 7 ", (0, 1, 2, 7)), ("key,1", (2, 1)), ("5-5", (5,)), ("1-a", (3,))],
)
def test_parts(text: str, parts: tuple[int, ...]) -> None:
    assert parse_parts(text, "--fixed", ("left", "right", "key", "1-a")) == parts


@pytest.mark.parametrize("text", ["", ",", "1,", "-1", "2-1", "1.5", "0-99999999999", "top"])
def test_what_is_no_part_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--fixed"):
        parse_parts(text, "--fixed", ("left", "right"))


@pytest.mark.parametrize(
    ("text", "state"),
    [
        ("complete", [2, 1, 1, 1]),
        ("empty", [2, 0, 0, 0]),
        ("2102", [2, 1, 0, 2]),
        ("[2, 1, 0, 2]", [2, 1, 0, 2]),
    ],
)
def test_states(text: str, state: list[int]) -> None:
    assert parse_state(text, "--end", FOUR_PARTS).tolist() == state


@pytest.mark.parametrize(
    "text", ["", "full", "210", "1111", "2103", "[2, 1", "[[2, 1, 1, 1], [2, 1, 1, 0]]", "no.json"]
)
def test_what_is_no_state_is_refused(text: str) -> None:
    with pytest.raises(StateError):
        parse_state(text, "--end", FOUR_PARTS)


def test_states_from_files(tmp_path: Path) -> None:
    states = [[2, 1, 1, 0], [2, 2, 1, 0]]
    text, array = tmp_path / "states.json", tmp_path / "states.npy"
    text.write_text(str(states))
    np.save(array, np.array(states))
    assert read_states(text) == states
    assert read_states(array).tolist() == states
    text.write_text(str(states[:1]))
    assert parse_state(str(text), "--end", FOUR_PARTS).tolist() == states[0]


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.json", b"[[2, 1"), ("b.json", b"{}"), ("c.json", b"\xff\xfe"), ("d.npy", b"[1]"), ("e.npy", b"\x93NUMPY\x01")],
)
def test_damaged_files_are_refused(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(StateError, match=name):
        read_states(tmp_path / name)


def test_pickled_arrays_are_not_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "evil.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(StateError, match="evil"):
        read_states(tmp_path / "evil.npy")

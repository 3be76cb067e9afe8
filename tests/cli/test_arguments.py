"""Lists of parts and states as they are written on the command line."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework import find_plans, load_structure
from falsework.cli.arguments import parse_parts, parse_state, parse_states, read_states
from falsework.errors import InputError, StateError
from falsework.search.plans.plan_file import save_plan

_BOUNDARY = np.array([True, False, False, False])
FOUR_PARTS: Any = SimpleNamespace(
    boundary=_BOUNDARY, immovable=_BOUNDARY, props=(), part_count=4, names=("ground", "left", "key", "held:up")
)


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
        ("left,held:key", [2, 1, 2, 0]),
        ("1-2", [2, 1, 1, 0]),
        ("held:1-2,ground", [2, 2, 2, 0]),
        ("held:up", [2, 0, 0, 1]),  # a name comes first
        ("held:held:up", [2, 0, 0, 2]),
    ],
)
def test_states(text: str, state: list[int]) -> None:
    assert parse_state(text, "--end", FOUR_PARTS).tolist() == state


@pytest.mark.parametrize(
    "text", ["", "full", "210", "1111", "2103", "[2, 1", "[[2, 1, 1, 1], [2, 1, 1, 0]]", "no.json", "no.json:3"]
)
def test_what_is_no_state_is_refused(text: str) -> None:
    with pytest.raises(StateError):
        parse_state(text, "--end", FOUR_PARTS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("left,top", "'top' is neither a part nor a file; give complete, empty, a plan and its step"),
        ("left,held:left", "part left both stands by itself and is held"),
        ("left,9", "is part 9, which does not exist"),
        ("left,,key", "an item is empty"),
        ("no.json:3", "there is no file no.json"),
    ],
)
def test_messages_on_parts_of_a_state(text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as refused:
        parse_state(text, "--state", FOUR_PARTS)
    assert str(refused.value).startswith("--state left" if "left" in text else "--state no.json")


def test_states_of_a_plan(tmp_path: Path) -> None:
    arch = load_structure("arch:blocks=3")
    plan = find_plans(arch, robots=2).plans[0]
    file = tmp_path / "plan.json"
    save_plan(plan, file)
    np.testing.assert_array_equal(parse_states(str(file), "--states", arch).states, plan.states)
    for step in range(len(plan) + 1):
        np.testing.assert_array_equal(parse_state(f"{file}:{step}", "--state", arch), plan.states[step])
    for text, steps in (("3", [3]), ("1", [1]), ("4,0-2", [4, 0, 1, 2])):
        chosen = parse_states(text, "--states", arch, plan)
        np.testing.assert_array_equal(chosen.states, plan.states[steps])
        assert [chosen.number(row) for row in range(len(steps))] == steps
    assert parse_states("11122", "--states", arch, plan).plan is None
    assert parse_states("voussoir-1,held:voussoir-0", "--states", arch, plan).states.tolist() == [[2, 1, 0, 2, 2]]
    for step in ("99", "2-1", "0,3-77"):
        with pytest.raises(StateError, match=f"step '{step.removeprefix('0,')}' does not exist"):
            parse_states(step, "--states", arch, plan)
    for step in ("99", "-1", "", "two"):
        with pytest.raises(
            StateError, match=f"step '{step}' does not exist; the plan has the steps 1 to {len(plan)}, and 0 is"
        ):
            parse_state(f"{file}:{step}", "--state", arch)
    with pytest.raises(StateError, match="the plan is for arch:blocks=3 with 5 parts, but arch:blocks=5 has 7"):
        parse_state(f"{file}:1", "--state", load_structure("arch:blocks=5"))
    with pytest.raises(StateError, match=r"is for another structure.* that it was made for: arch:blocks=3"):
        parse_state(f"{file}:1", "--state", load_structure("arch:blocks=3", friction=0.9))
    with pytest.raises(StateError, match=f"holds {len(plan) + 1} states; give one"):
        parse_state(str(file), "--state", arch)


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

"""Parts by number, range and name mean the same wherever they are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from falsework import load_structure
from falsework.assembly.part_numbers import boundary_ids, part_id, part_ids
from falsework.cli.arguments import parse_parts
from falsework.cli.main import main
from falsework.errors import AssemblyError, InputError

NAMES = ("sill", "1-2", "2", "top")


def test_numbers_ranges_and_names() -> None:
    assert part_ids(["sill", 3, "0-1", "2"], NAMES, "fixed") == (0, 3, 0, 1, 2)
    assert parse_parts("sill,3,0-1,2", "--fixed", NAMES) == (0, 3, 0, 1, 2)
    assert part_ids(["1-2"], NAMES, "fixed") == parse_parts("1-2", "--fixed", NAMES) == (1,), "a name before a range"
    assert boundary_ids(["sill", "roof", "0-9"], NAMES) == [0, 0, 1, 2, 3]
    assert boundary_ids([False, True, False, False], NAMES) == [1]


def test_a_text_that_means_two_parts_is_refused() -> None:
    names = ("1", "top")
    with pytest.raises(AssemblyError, match="'1', which is the name of part 0 and the number of part 'top'"):
        part_id("1", names, "a load acts on part")
    with pytest.raises(AssemblyError, match="--fixed is part '1'"):
        parse_parts("1", "--fixed", names)
    assert part_id(1, names, "a load acts on part") == 1, "a number is none of a name"


@pytest.mark.parametrize("text", ["roof", "5-1", "0-999999999", "", "1,,2", "9" * 5000])
def test_what_is_no_part(text: str) -> None:
    with pytest.raises(InputError, match="--fixed"):
        parse_parts(text, "--fixed", NAMES)


def test_boundary_by_name_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arch = load_structure("arch:blocks=5")
    ends = ",".join(np.array(arch.names)[arch.boundary])
    assert main(["stability", "arch:blocks=5", "--boundary", ends]) == 0
    plan = tmp_path / "plan.json"
    assert main(["plan", "arch:blocks=5", "--boundary", ends, "--out", str(plan)]) == 0
    assert main(["check", str(plan)]) == 0
    capsys.readouterr()
    assert main(["stability", "arch:blocks=5", "--boundary", "left"]) == 2
    assert "boundary is part 'left', which does not exist" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("abut", "; perhaps abutment_E or abutment_W; "),
        ("Stone1", "; perhaps stone1; "),
        ("ston2", "stone2"),
        ("x", ""),
    ],
)
def test_names_that_may_be_meant(given: str, meant: str) -> None:
    names = ("abutment_E", "abutment_W", "stone1", "stone2")
    with pytest.raises(AssemblyError, match="which does not exist") as refused:
        part_id(given, names, "boundary is part")
    assert meant in str(refused.value)
    assert ("perhaps" in str(refused.value)) == bool(meant)

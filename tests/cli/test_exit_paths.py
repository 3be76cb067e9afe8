"""Ways out in several moves by the command line: plan, check, picture, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework import Assembly
from falsework.assembly.store import save_assembly

Run = Callable[..., Any]


@pytest.fixture
def folder(drawer: Assembly, tmp_path: Path) -> Path:
    """Files of a drawer behind a lip."""
    save_assembly(drawer, tmp_path / "drawer")
    return tmp_path / "drawer"


def test_a_drawer_is_planned_checked_and_drawn(falsework: Run, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    done = falsework("plan", folder, "--robots", 1, "--moves", 2, "--out", out)
    assert done.code == 0, done.error
    assert "step 1 inserts drawer-0 in 2 moves: from +x, then from above" in done.out
    checked = falsework("check", out)
    assert checked.code == 0, checked.error
    assert "ways out of up to 2 moves" in checked.out
    assert falsework("picture", out, "--out", tmp_path / "plan.png").code == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--moves", 0), "0 is not a number of moves of a way out; give 1 (one move) to 100"),
        (
            ("--moves", 2, "--parts-at-once", 2),
            "2 is not a number of parts of drawer that can move at once",
        ),
    ],
)
def test_moves_that_cannot_be_had(falsework: Run, folder: Path, options: tuple, message: str) -> None:
    done = falsework("plan", folder, *options, "--out", folder / "plan.json")
    assert done.code == 2
    assert message in done.error

"""Ways out in several moves by the command line: plan, check, picture, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework import Assembly
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.store import save_assembly

Run = Callable[..., Any]


@pytest.fixture
def drawer(tmp_path: Path) -> Path:
    """A drawer behind a lip, in a case."""
    blocks = gather(
        [
            box("drawer", (0.0, 0.0, 0.0), (0.3, 0.2, 0.1)),
            box("floor", (-0.05, -0.05, -0.05), (0.35, 0.25, 0.0), fixed=True),
            box("back", (-0.05, -0.05, 0.0), (0.0, 0.25, 0.25), fixed=True),
            box("side", (0.0, -0.05, 0.0), (0.3, 0.0, 0.25), fixed=True),
            box("side", (0.0, 0.2, 0.0), (0.3, 0.25, 0.25), fixed=True),
            box("top", (-0.05, -0.05, 0.25), (0.35, 0.25, 0.3), fixed=True),
            box("lip", (0.3, -0.05, 0.0), (0.35, 0.25, 0.06), fixed=True),
        ]
    )
    save_assembly(Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary, name="drawer"), tmp_path / "drawer")
    return tmp_path / "drawer"


def test_a_drawer_is_planned_checked_and_drawn(falsework: Run, drawer: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    done = falsework("plan", drawer, "--robots", 1, "--moves", 2, "--out", out)
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
        (("--moves", 2, "--parts-at-once", 2), "parts_at_once is 2, but sets of parts leave in one straight line"),
    ],
)
def test_moves_that_cannot_be_had(falsework: Run, drawer: Path, options: tuple, message: str) -> None:
    done = falsework("plan", drawer, *options, "--out", drawer / "plan.json")
    assert done.code == 2
    assert message in done.error

"""Pictures of a cell with real arms, where their descriptions are there."""

from __future__ import annotations

import os
import re
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from commands import run
from screen import shoot

from falsework.viewer import view_cell

ARMS = {"panda": "franka_fer", "ur": "ur5e", "gofa": "abb_crb15000_5_95"}
"""Names of robots, and the folders of their descriptions."""
STRUCTURE = "arch:blocks=11,radius=0.35,thickness=0.1,depth=0.12"


@contextmanager
def new_cell() -> Iterator[Path | None]:
    """Write a cell with three arms around an arch; None without their descriptions."""
    named = os.environ.get("FALSEWORK_DATA")
    robots = (Path(named) if named else Path(__file__).parents[3] / "shared") / "robots"
    files = [robots / folder / f"{folder}.urdf" for folder in ARMS.values()]
    if not all(file.is_file() for file in files):
        yield None
        return
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        out = Path(folder) / "cell.toml"
        arms = ",".join(f"{name}={file}" for name, file in zip(ARMS, files, strict=True))
        run("cell", "new", arms, "--structure", STRUCTURE, "--density", "300", "--out", str(out))
        yield out


def cell(path: Path) -> None:
    """The cell as it is written; without the descriptions the picture stays as it was."""
    with new_cell() as file:
        if file is None:
            print(f"{path} is left as it is: there are no descriptions of arms")
            return
        run("picture", str(file), "--structure", STRUCTURE, "--width", "1000", "--azimuth", "-40", "--out", str(path))


def cell_page(path: Path) -> None:
    """The page of the cell with one home that is wrong."""
    with new_cell() as file:
        if file is None:
            print(f"{path} is left as it is: there are no descriptions of arms")
            return
        text = file.read_text(encoding="utf-8")
        home = re.search(r'name = "ur".*?(home = \[[^]]*\])', text, re.DOTALL)
        assert home is not None
        file.write_text(text.replace(home[1], "home = [0, 20, 30, 0, -90, 0]"), encoding="utf-8")
        shown = view_cell(file, STRUCTURE, port=8192)
        shoot(shown.address, "Reach of the arms", path)
        shown.close()

"""Pictures that are made by the command line alone, as a reader would make them."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from falsework.cli.main import main
from falsework.search.plans.plan_file import load_plan

BUILT_IN = {
    "arch": "arch:blocks=11",
    "catenary": "catenary:blocks=13",
    "dome": "dome",
    "vault": "vault",
    "wall": "wall",
    "stack": "stack",
    "corbel": "corbel",
    "bottle": "bottle",
    "polycube": "polycube",
    "house": "house",
    "shelf": "shelf",
}
"""Pictures of the gallery, and the structures on them."""
REAL = ("bottle-12", "tetris-14", "cube-17", "dog-35", "dome-37", "vault-62")
"""Published structures, one of each kind; see `real`."""
PUBLIC = {"armadillo-399": ("4",), "pavilion-vault-387": ("3",)}
"""Public structures, and the numbers of robots to try; a search takes minutes."""
DEADLINE = "2400"
"""Seconds after which a search ends with the plan that it has, without the reserve of friction if it found none."""
SHEETS = {"armadillo-399": ("--frames", "6", "--columns", "3", "--width", "420")}
"""Contact sheets other than four pictures in a row."""


def run(*words: str, answers: Sequence[int] = (0,)) -> int:
    """Run one command; one that fails ends the making of pictures."""
    code = main(list(words))
    if code not in answers:
        raise SystemExit(f"falsework {' '.join(words)} ended with {code}")
    return code


def vault_plan(path: Path) -> None:
    """Contact sheet of a plan for the built-in vault."""
    with tempfile.TemporaryDirectory() as folder:
        plan = str(Path(folder) / "plan.json")
        run("plan", "vault", "--robots", "2", "--width", "256", "--out", plan)
        run("picture", plan, "--out", str(path))


def sheet(path: Path) -> None:
    """Cover, setting-out drawing and first steps of an instruction sheet, pages of a PDF side by side."""
    import numpy as np
    import pypdfium2
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        plan, file = (str(Path(folder) / name) for name in ("plan.json", "sheet.pdf"))
        run("plan", "arch:blocks=9", "--robots", "2", "--out", plan)
        run("export", plan, "--out", file)
        document = pypdfium2.PdfDocument(file)
        pages = [np.array(document[number].render(scale=0.9).to_pil().convert("RGB")) for number in (0, 1, 2)]
        document.close()
    for page in pages:
        page[[0, -1]] = page[:, [0, -1]] = 190  # the edge of the paper
    gap = np.full((pages[0].shape[0], 12, 3), 255, dtype=np.uint8)
    Image.fromarray(np.hstack([pages[0], gap, pages[1], gap, pages[2]])).save(path, optimize=True)


def press(path: Path) -> None:
    """First step of a plan for a vault of 126 parts in which a robot presses, with all forces."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.json"
        run("plan", "vault:parts=125", "--robots", "2", "--out", str(file))
        step = next(step for step, presses in enumerate(load_plan(file).presses_before) if presses)
        options = ("--step", str(step), "--forces", "--azimuth", "-40", "--elevation", "35")
        run("picture", str(file), *options, "--out", str(path))


def equilibrium_plan(path: Path) -> None:
    """States of a plan for the built-in dome that is in equilibrium throughout; what slides is marked."""
    with tempfile.TemporaryDirectory() as folder:
        plan = str(Path(folder) / "plan.json")
        run("plan", "dome", "--robots", "2", "--criterion", "equilibrium", "--out", plan)
        run("picture", plan, "--verdicts", "--frames", "34", "--columns", "9", "--out", str(path))


def state_graph(path: Path) -> None:
    """All states of a small arch that stand and can be reached, and one plan."""
    with tempfile.TemporaryDirectory() as folder:
        graph = str(Path(folder) / "graph.npz")
        run("graph", "arch:blocks=4,thickness=0.3", "--width", "1000", "--search-from", "end", "--out", graph)
        run("picture", graph, "--out", str(path))


def arch_that_stands(path: Path) -> None:
    """A thick arch with the forces that prove it stable."""
    run("picture", "arch:blocks=15,thickness=0.2", "--forces", "--width", "420", "--out", str(path))


def arch_that_falls(path: Path) -> None:
    """A thin arch with the motion that proves it unstable."""
    run("picture", "arch:blocks=15,thickness=0.08", "--forces", "--width", "420", "--out", str(path))


def gallery(path: Path) -> None:
    """A built-in structure, whole."""
    name = path.stem.removeprefix("gallery-")
    run("picture", BUILT_IN[name], "--width", "420", "--title", BUILT_IN[name], "--out", str(path))


def real(path: Path) -> None:
    """Steps of a plan for a published or public structure, where its data is there; else the picture stays."""
    name = path.stem.removeprefix("real-")
    named = os.environ.get("FALSEWORK_DATA")
    data = Path(named) if named else Path(__file__).parents[3] / "shared"
    structure = data / ("structures" if name in PUBLIC else "assemblies") / name
    if not structure.is_dir():
        print(f"{path} is left as it is: there is no {structure}")
        return
    with tempfile.TemporaryDirectory() as folder:
        plan = str(Path(folder) / "plan.json")
        for robots in PUBLIC.get(name, ("2", "3")):
            limit = ("--deadline", DEADLINE)
            if run("plan", str(structure), "--robots", robots, *limit, "--out", plan, answers=(0, 1)) == 0:
                break
        sheet = SHEETS.get(name, ("--frames", "4", "--columns", "4", "--width", "300"))
        run("picture", plan, *sheet, "--out", str(path))


def film(path: Path) -> None:
    """A plan for an arch as a short film."""
    with tempfile.TemporaryDirectory() as folder:
        plan, draft = str(Path(folder) / "plan.json"), str(Path(folder) / path.name)
        run("plan", "arch:blocks=7", "--out", plan)
        run("picture", plan, "--width", "360", "--rate", "6", "--out", draft)
        shutil.copyfile(draft, path)

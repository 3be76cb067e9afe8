"""Verdicts of this version and of another one on the same states in one run: answers, and processor time.

    git worktree add ../before COMMIT
    python benchmarks/verdicts.py --before ../before --structures vault-62 dome-72

One JSON object for each structure and criterion. The states are the first that a search for a plan asks about, each
with the state near to it. Both versions answer in processes of their own, on one core, in alternating rounds with empty
caches: without certificates, in the order of the search, and then every tenth of the states with certificates. `ratio`
is the time here over the time there, the median over the rounds; below 1 this version is faster. `differ` counts the
states that both decide in different ways, and `lost` those that only the other version decides.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import ArrayLike, NDArray
from record import report, spread, write_to
from states import find, one_core

from falsework import Assembly, StabilityOracle, StabilitySettings, find_plans, load_structure
from falsework.assembly import States
from falsework.stability import NumericalSettings, Verdicts

Criterion = Literal["contact", "equilibrium"]
BATCH = 16
"""States of a query."""
EACH = 10
"""One in so many states is asked about with a certificate."""


@dataclass(frozen=True)
class Options:
    """Structures, and the version to compare with."""

    structures: tuple[str, ...] = ("vault-62", "dome-72", "vault")
    """Names of real or built-in structures, or paths."""
    before: Path | None = None
    """Folder of the other version: a worktree of its commit."""
    criteria: tuple[Criterion, ...] = ("equilibrium", "contact")
    """Stability criteria."""
    robots: int = 2
    """Parts held at once in the search for states."""
    states: int = 500
    """Number of states."""
    seconds: float = 30.0
    """Longest search for states."""
    rounds: int = 7
    """Rounds in which the versions take turns; one more, before them, is not counted."""
    serve: Path | None = None
    """Answer rounds on the states of this file in this process."""
    out: Path | None = None
    """File to which the records are appended."""


class Asked(StabilityOracle):
    """Oracle that keeps the states that it is asked about beside others."""

    def __init__(self, assembly: Assembly, settings: StabilitySettings) -> None:
        super().__init__(assembly, settings)
        self.asked: list[States] = []
        self.near: list[States] = []

    def verdicts(
        self, states: ArrayLike, *, near: ArrayLike | None = None, require_certificate: bool = False
    ) -> Verdicts:
        """Return verdicts."""
        if near is not None:
            self._keep(states, near)
        return super().verdicts(states, near=near, require_certificate=require_certificate)

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states a replay may find at rest."""
        self._keep(states, parents)
        return super().plausible(states, parents)

    def _keep(self, states: ArrayLike, near: ArrayLike) -> None:
        self.asked.append(np.array(states, np.uint8))
        self.near.append(np.array(near, np.uint8))


def oracle_of(structure: str, criterion: Criterion) -> StabilityOracle:
    """Return a new oracle of a structure, with empty caches and one thread."""
    numerics = NumericalSettings(threads=1)
    return StabilityOracle(load_structure(find(structure)), StabilitySettings(criterion=criterion, numerics=numerics))


def write_states(structure: str, criterion: Criterion, options: Options, path: Path) -> int:
    """Write the first states that a search asks about, and those near to them; return their number."""
    made = oracle_of(structure, criterion)
    recorder = Asked(made.assembly, made.settings)
    end = time.monotonic() + options.seconds

    def stop() -> bool:
        return time.monotonic() > end or sum(map(len, recorder.asked)) >= options.states

    find_plans(recorder.assembly, robots=options.robots, oracle=recorder, stop=stop)
    states, near = (np.concatenate(some)[: options.states] for some in (recorder.asked, recorder.near))
    np.savez(path, states=states, near=near, structure=structure, criterion=criterion)
    return len(states)


def serve(path: Path) -> None:
    """Answer one round for each line of the standard input."""
    one_core()
    given = np.load(path)
    states, near, criterion = given["states"], given["near"], given["criterion"].item()
    made = oracle_of(given["structure"].item(), criterion)
    for _ in sys.stdin:
        oracle = StabilityOracle(made.assembly, made.settings)
        begun, found = time.process_time(), []
        for first in range(0, len(states), BATCH):
            rows = slice(first, first + BATCH)
            found.append(oracle.verdicts(states[rows], near=near[rows]).verdict)
        middle = time.process_time()
        certified = oracle.verdicts(states[::EACH], near=near[::EACH], require_certificate=True).verdict
        seconds = {"verdicts": middle - begun, "certificates": time.process_time() - middle}
        print(json.dumps([seconds, np.concatenate([*found, certified]).tolist()]), flush=True)


def compare(structure: str, criterion: Criterion, options: Options, path: Path) -> None:
    """Report both versions on the states of one structure."""
    count = write_states(structure, criterion, options, path)
    trees = {"here": Path(__file__).resolve().parents[1], "before": options.before}
    runs = {
        name: subprocess.Popen(
            [sys.executable, __file__, "--serve", str(path)],
            env=os.environ | {"PYTHONPATH": f"{tree}/src"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for name, tree in trees.items()
        if tree is not None
    }
    seconds: dict[str, list[dict[str, float]]] = {name: [] for name in runs}
    answers: dict[str, Any] = {}
    for number in range(options.rounds + 1):
        for name, run in runs.items():
            assert run.stdin is not None
            assert run.stdout is not None
            print(number, file=run.stdin, flush=True)
            taken, answers[name] = json.loads(run.stdout.readline())
            seconds[name].append(taken)
    for run in runs.values():
        run.communicate()
    figures: dict[str, Any] = {name: spread([sum(row.values()) for row in rows[1:]]) for name, rows in seconds.items()}
    if "before" in runs:
        pairs = list(zip(seconds["here"][1:], seconds["before"][1:], strict=True))
        git = ["git", "-C", str(options.before), "rev-parse", "--short=7", "HEAD"]
        figures["before_commit"] = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
        figures["ratio"] = {what: spread([mine[what] / theirs[what] for mine, theirs in pairs]) for what in pairs[0][0]}
        mine, theirs = (np.array(answers[name]) for name in ("here", "before"))
        figures["differ"] = int(((mine != theirs) & (mine != 0) & (theirs != 0)).sum())
        figures["lost"], figures["gained"] = (
            int(((mine == 0) & (theirs != 0)).sum()),
            int(((mine != 0) & (theirs == 0)).sum()),
        )
    report(
        "verdicts", structure=Path(structure).name, criterion=criterion, states=count, rounds=options.rounds, **figures
    )


def main(options: Options) -> None:
    """Run the benchmark."""
    if options.serve is not None:
        serve(options.serve)
        return
    write_to(options.out)
    with tempfile.TemporaryDirectory() as folder:
        for structure in options.structures:
            for criterion in options.criteria:
                compare(structure, criterion, options, Path(folder) / "states.npz")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

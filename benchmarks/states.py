"""States for stability benchmarks: those that a beam search checks."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, Task
from falsework.assembly import States
from falsework.search import BeamSearch, BeamSettings
from falsework.search.problem.oracle import WrappedOracle
from falsework.stability import Verdicts
from falsework.stability.settings import EQUILIBRIUM

REAL = ("bottle-12", "tetris-13", "tetris-14", "tetris-17", "cube-17", "dog-35", "dome-37", "vault-62", "dome-72")


class Recorder(WrappedOracle):
    """Wrapper of an oracle that records its queries."""

    def __init__(self, oracle: StabilityOracle) -> None:
        super().__init__(oracle)
        self.states: list[States] = []
        self.parents: list[States] = []

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """Return verdicts as `StabilityOracle`; states without near ones, such as ends of a task, are not recorded."""
        if near is not None:
            self._record(states, near)
        return super().verdicts(states, near=near, require_certificate=require_certificate)

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states a replay may find at rest, as `StabilityOracle.plausible`."""
        self._record(states, parents)
        return super().plausible(states, parents)

    def _record(self, states: States, parents: States) -> None:
        self.states.append(states.copy())
        self.parents.append(parents.copy())


def asked_states(
    assembly: Assembly, count: int, *, width: int = 64, robots: int = 2, seed: int = 0
) -> tuple[States, States]:
    """Return a random sample of the distinct states that a beam search under `equilibrium` checks.

    Args:
        assembly: the structure.
        count: number of states; fewer are returned where the search checks fewer.
        width: beam width of the search.
        robots: parts that may be held at once.
        seed: seed of the search and of the sample.

    Returns:
        States and, for each, its stable predecessor; both of shape (count, parts).
    """
    recorder = Recorder(StabilityOracle(assembly, EQUILIBRIUM))
    task = Task.from_rules(assembly.boundary, robots)
    BeamSearch(task, recorder, BeamSettings(width=width, seed=seed)).run()
    states, parents = np.concatenate(recorder.states), np.concatenate(recorder.parents)
    _, first = np.unique(states, axis=0, return_index=True)
    chosen = np.random.default_rng(seed).permutation(first)[:count]
    return states[chosen], parents[chosen]


def one_core() -> None:
    """Keep this process on one core, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def find(name: str) -> str:
    """Return the path of the real structure of a name if there is one, else the name."""
    named = os.environ.get("FALSEWORK_DATA")
    data = Path(named) if named else Path(__file__).resolve().parents[2] / "shared"
    paths = (data / folder / name for folder in ("assemblies", "structures"))
    return next((str(path) for path in paths if path.is_dir()), name)


def real_structures(names: tuple[str, ...] = REAL) -> tuple[str, ...]:
    """Return the named real structures that this machine has."""
    return tuple(name for name in names if find(name) != name)

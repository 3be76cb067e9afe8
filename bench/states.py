"""States of the tasks that begin at one, drawn from searches with fixed seeds: `python -m bench states`.

For `replan` they come from a search under `contact` that takes the complete structure apart, so that each can be built
on. For `policy` they come from one of width 128 under `equilibrium` that builds it from nothing, so that each can be
taken apart, without the states of one of width 64 with another seed: as the test states of the paper, and held out from
what `falsework train --data width64` learns from. They are written down, since a search may keep other states on
another machine.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from bench.questions import STATES_FORMAT, Question
from bench.structures import Structure
from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.find import make_task
from falsework.search.problem.hashing import StateIndex
from falsework.search.problem.task import Direction
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion

SEED, TRAIN_SEED = 1000, 0
"""Of the searches for states, and of the narrower one to learn from."""
REPLAN_WIDTH, REPLAN_COUNT = 16, 10
POLICY_WIDTH, TRAIN_WIDTH, POLICY_COUNT = 128, 64, 50
_TRIED = 40
"""States of a search that are proven."""
REPLAN_SPLITS, POLICY_SPLITS = ("paper", "generated"), ("paper",)
"""Splits whose structures have states."""


def draw(task: str, structure: Structure, assembly: Assembly, robots: int) -> tuple[str, ...]:
    """Return the states of a row as digits, the same each time on one machine."""
    if task == "replan":
        states = _searched(assembly, robots, "contact", Direction.DISASSEMBLY, REPLAN_WIDTH, SEED)
        return _sample(_proven(states, assembly), REPLAN_COUNT)
    way = Direction.ASSEMBLY
    states = _searched(assembly, robots, "equilibrium", way, POLICY_WIDTH, SEED)
    known = _searched(assembly, robots, "equilibrium", way, TRAIN_WIDTH, TRAIN_SEED)
    return _sample(states[StateIndex(known).find(states) < 0], POLICY_COUNT)


def _searched(
    assembly: Assembly, robots: int, criterion: Criterion, direction: Direction, width: int, seed: int
) -> States:
    """Return the states of a search in between its ends, sorted, shape (count, parts)."""
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))
    beam = BeamSearch(make_task(assembly, robots), oracle, BeamSettings(width, direction, seed=seed))
    beam.run()
    states, ends = beam.states(), beam.task
    inside = (states != ends.start).any(axis=1) & (states != ends.target).any(axis=1)
    return np.unique(states[inside], axis=0)


def _proven(states: States, assembly: Assembly) -> States:
    """Return the states, in random order at most `_TRIED` of them, that do not tip either, which only a proof shows."""
    chosen = np.random.default_rng(SEED).permutation(len(states))[:_TRIED]
    oracle = StabilityOracle(assembly, StabilitySettings(criterion="contact"))
    return states[chosen][oracle.verdicts(states[chosen], require_certificate=True).stable]


def _sample(states: States, count: int) -> tuple[str, ...]:
    chosen = np.sort(np.random.default_rng(SEED).permutation(len(states))[:count])
    return tuple("".join(map(str, state.tolist())) for state in states[chosen])


def write_states(path: Path, sets: dict[str, tuple[str, ...]]) -> None:
    """Write the states of all rows."""
    entries = ",\n".join(f"  {json.dumps(row)}: {json.dumps(list(states))}" for row, states in sorted(sets.items()))
    text = f'{{\n "format": {json.dumps(STATES_FORMAT)},\n "seed": {SEED},\n "states": {{\n{entries}\n }}\n}}\n'
    path.write_text(text, encoding="utf-8")


def rows(known: dict[str, Structure]) -> list[tuple[str, Structure, int]]:
    """Return task, structure and robots of each row that has states."""
    return [
        (task, structure, robots)
        for task, splits in (("replan", REPLAN_SPLITS), ("policy", POLICY_SPLITS))
        for structure in known.values()
        if structure.split in splits
        for robots in (structure.robots if task == "policy" else structure.robots[:1])
    ]


def row_name(task: str, structure: Structure, robots: int) -> str:
    """Return the name of a row, as `Question.row` has it."""
    return Question(task, "contact" if task == "replan" else "equilibrium", structure, robots).name  # type: ignore[arg-type]

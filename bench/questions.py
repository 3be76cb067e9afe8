"""Questions of the benchmark: a task, a criterion, a structure, a number of robots, and for some tasks a state.

The name of a question says all of it: `plan/contact/dog-35/2`, `fewest/contact/dog-35`, `replan/contact/dog-35/2/07`,
`policy/equilibrium/dog-35/2/042`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bench.structures import BRICKS, HERE, Structure, structures
from falsework.assembly.state import Mask, States, as_states, complete_state, empty_state
from falsework.errors import InputError
from falsework.stability.verdict import Criterion

Task = Literal["plan", "fewest", "replan", "policy"]
STATES = HERE / "states.json"
STATES_FORMAT = "falsework.bench.states/1"
TASKS: Mapping[Task, str] = {
    "plan": "build the structure from nothing with the robots of the question",
    "fewest": "build it from nothing with as few robots as possible",
    "replan": "go on building from a state to the complete structure",
    "policy": "take the structure apart from a state by one rollout of a policy, without verdicts and without search",
}
CRITERIA: Mapping[Task, tuple[Criterion, ...]] = {
    "plan": ("contact", "equilibrium"),
    "fewest": ("contact",),
    "replan": ("contact",),
    "policy": ("equilibrium",),
}
"""Criteria that each task is judged by; policies by that of the paper."""


@dataclass(frozen=True)
class Question:
    """One question, which one line of a submission answers."""

    task: Task
    criterion: Criterion
    structure: Structure
    robots: int = 0
    """Parts that may be held at a time; 0: the answer says how many it needs."""
    number: str = ""
    """Of the state, as text."""
    state: str = ""
    """Where the answer begins, a digit for each part: 0 removed, 1 installed, 2 held or boundary."""

    @property
    def name(self) -> str:
        """Name in submissions."""
        robots = () if self.task == "fewest" else (str(self.robots),)
        numbered = (self.number,) if self.number else ()
        return "/".join((self.task, self.criterion, self.structure.name, *robots, *numbered))

    @property
    def row(self) -> str:
        """Name without the number of the state."""
        return self.name.removesuffix(f"/{self.number}") if self.number else self.name

    @property
    def builds(self) -> bool:
        """Whether parts are added, up to the complete structure; else they are removed, down to the boundary."""
        return self.task != "policy"

    def begin(self, boundary: Mask) -> States:
        """Return the state in which the answer begins, shape (parts,).

        Raises:
            StateError: the state of the question does not fit the structure.
        """
        if self.state:
            return as_states(np.array([int(digit) for digit in self.state], dtype=np.uint8), boundary)[0]
        return empty_state(boundary) if self.builds else complete_state(boundary)

    def goal(self, boundary: Mask) -> States:
        """Return the state in which it ends, shape (parts,)."""
        return complete_state(boundary) if self.builds else empty_state(boundary)

    def to_dict(self) -> dict[str, Any]:
        """Return the question as a JSON object, for programs that answer it without this package."""
        return {
            "question": self.name,
            "task": self.task,
            "criterion": self.criterion,
            "structure": self.structure.digest,
            "robots": self.robots or None,
            "begin": self.state or ("empty" if self.builds else "complete"),
            "end": "complete" if self.builds else "empty",
        }


def questions(root: Path, only: str = "*", splits: Collection[str] = ()) -> list[Question]:
    """Return questions, about structures of the manifest and texts of bricks below a folder of data.

    Args:
        root: folder of data.
        only: pattern of names, as of a shell, such as `plan/*/dog-35/2`.
        splits: splits of the structures; all if none is given.

    Raises:
        InputError: a split that does not exist.
    """
    known = structures(root)
    unknown = set(splits) - {*(structure.split for structure in known.values()), BRICKS}
    if unknown:
        raise InputError(f"there is no split {min(unknown)!r}; `python -m bench structures` lists them")
    return [
        question
        for question in questions_of(known)
        if fnmatchcase(question.name, only) and (not splits or question.structure.split in splits)
    ]


def questions_of(known: Mapping[str, Structure]) -> Iterator[Question]:
    """Yield all questions about some structures."""
    for structure in known.values():
        for robots in structure.robots:
            for criterion in CRITERIA["plan"]:
                if criterion in structure.criteria:
                    yield Question("plan", criterion, structure, robots)
        for criterion in CRITERIA["fewest"]:
            if criterion in structure.criteria:
                yield Question("fewest", criterion, structure)
    for row, states in state_sets().items():
        task, criterion, name, robots = row.split("/")
        digits = len(str(len(states) - 1))
        for number, state in enumerate(states):
            yield Question(task, criterion, known[name], int(robots), f"{number:0{digits}d}", state)  # type: ignore[arg-type]


def question_elsewhere(name: str, root: Path) -> Question | None:
    """Return the question about a text of bricks that is not on this machine; None if the name is of no such."""
    found = re.fullmatch(rf"(?:plan/(contact|equilibrium)|fewest/contact)/({BRICKS}/[\w-]+?)(?:/([1-9]\d?))?", name)
    if found is None or (root / BRICKS).exists() or (found[1] is None) != (found[3] is None):
        return None
    structure = Structure(found[2], BRICKS)
    if found[1] is None:
        return Question("fewest", "contact", structure)
    return Question("plan", found[1], structure, int(found[3]))  # type: ignore[arg-type]


@cache
def state_sets(path: Path = STATES) -> Mapping[str, tuple[str, ...]]:
    """Return the states of each row of the tasks that have them, such as `replan/contact/dog-35/2`."""
    if not path.exists():
        return {}
    return {row: tuple(states) for row, states in json.loads(path.read_text(encoding="utf-8"))["states"].items()}

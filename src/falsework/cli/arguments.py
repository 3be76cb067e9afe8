"""Parsers and checks of command-line arguments: paths, part numbers and states."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falsework.assembly.part_numbers import alike, part_id, part_range
from falsework.errors import InputError, PlanError, StateError
from falsework.utils.files.input_file import read_text
from falsework.utils.json_text import parse_json
from falsework.utils.quantity import parse_quantity

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States
    from falsework.search.plans.plan import Plan
    from falsework.stability.criterion import Cone
    from falsework.stability.settings import SolverName, StabilitySettings
    from falsework.stability.verdict import Criterion


def conventions() -> dict[str, Any]:
    """Return the arguments of `tyro.cli` that all commands share: markers of options, and a parser of paths."""
    import tyro
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

    def read(words: list[str]) -> Path:
        if not words[0]:  # `Path("")` would be the present folder
            raise ValueError("is empty; name a file or folder")
        return Path(words[0])

    registry = ConstructorRegistry()

    @registry.primitive_rule
    def path_rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
        if info.type is not Path:
            return None
        return PrimitiveConstructorSpec(
            1, "PATH", read, lambda value: isinstance(value, Path), lambda path: [str(path)]
        )

    # Help texts are docstrings: in search of comments tyro would tokenize each class, for half of the time of parsing.
    known = tyro.conf
    config = known.FlagCreatePairsOff, known.DisallowNone, known.OmitArgPrefixes, known.HelptextFromCommentsOff
    return {"config": config, "registry": registry}


def split_parts(text: str, option: str) -> list[str]:
    """Return the items of a list of parts, separated by commas."""
    items = [piece.strip() for piece in text.split(",")]
    if not all(items):
        raise InputError(f"{option} {text}: an item is empty; give numbers such as 3,4 or 0-16, or names")
    return items


def parse_parts(text: str, option: str, names: Sequence[str]) -> tuple[int, ...]:
    """Read a list of parts such as `3,4`, `0-16` or `keystone,7`."""
    parts: list[int] = []
    for item in split_parts(text, option):
        span = part_range(item, names)
        if span is not None:
            parts.extend(span)
        elif item in names:
            parts.append(part_id(item, names, f"{option} is part"))
        elif item.isdecimal() and len(item) < 10:
            parts.append(int(item))
        else:
            near = alike(item, names)
            raise InputError(
                f"{option} {text}: {item!r} is not a part{near}; give numbers such as 3,4 or 0-16, or names"
            )
    return tuple(parts)


def parse_numbers(text: str, option: str, count: Sequence[int] = (1, 2)) -> list[float]:
    """Read numbers separated by commas."""
    try:
        numbers = [float(item) for item in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in count or not all(math.isfinite(number) for number in numbers):
        shown = f"{option}{text}" if option.endswith(("=", "@")) else f"{option} {text}"
        raise InputError(f"{shown}: give {' or '.join(map(str, count))} numbers without units, such as 0.1")
    return numbers


def parse_load(text: str) -> dict[str, Any]:
    """Read a load such as `keystone=0,0,-1000` or `7=0,0,-1000@0.2,0,1` as an entry of `loads` in `assembly.json`."""
    part, equals, rest = text.rpartition("=")
    force, at, place = rest.partition("@")
    if not (part and equals):
        raise InputError(f"--load {text}: give a part and its force in N, such as keystone=0,0,-1000")
    option = f"--load {part}="
    load: dict[str, Any] = {"part": part, "force": parse_numbers(force, option, (3,))}
    return load | {"at": parse_numbers(place, f"{option}{force}@", (3,))} if at else load


def spell_options(options: Mapping[str, Any]) -> str:
    """Return options of a structure, as `LoadOptions.given` returns them, as they are written on the command line."""
    words: list[str] = []
    for name, value in options.items():
        if name == "loads":
            for load in value:
                words += ["--load", _spell_load(load)]
        elif name == "settle":
            words += ["--settle", f"{1000 * value:g}"]
        elif name == "ground":
            words += ["--ground"] * bool(value)
        else:
            words += [f"--{name}", ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)]
    return " ".join(shlex.quote(word) for word in words)


def _spell_load(load: Any) -> str:
    """Return an entry of `loads` as `parse_load` reads it; one with further entries, which it cannot read, as JSON."""
    if not isinstance(load, dict) or not {"part", "force"} <= set(load) <= {"part", "force", "at"}:
        return json.dumps(load)
    force, at = (",".join(map(str, load.get(key, []))) for key in ("force", "at"))
    return f"{load['part']}={force}{'@' if at else ''}{at}"


STATE_FORMS = (
    "complete, empty, a plan and its step such as plan.json:31, parts such as 0-16,keystone,held:left, or a file"
)
"""Forms of states on the command line, for messages."""
_STEPS = re.compile(r"\d+(-\d+)?(,\d+(-\d+)?)*", re.ASCII)
"""Numbers and ranges alone, which are steps where a plan is given."""
_HELD = "held:"
"""Before a part that is held."""


def read_states(path: Path) -> Any:
    """Read states from a JSON list or a `.npy` file, without checking their length or values."""
    from falsework.utils.archive import read_array

    if not path.is_file():
        raise StateError(f"no file {path}; give a JSON list of states or a .npy array")
    try:
        if path.suffix.lower() == ".npy":
            return read_array(path)
        content = parse_json(read_text(path))
    except Exception as error:  # NumPy fails in many ways on a damaged file
        raise StateError(f"{path} cannot be read; give a JSON list of states or a .npy array") from error
    if not isinstance(content, list):
        raise StateError(f"{path} contains no list; give a JSON list of states such as [[2, 1, 0], [2, 2, 0]]")
    return content


def parse_state(text: str, option: str, assembly: Assembly) -> States:
    """Read one state, as `parse_states` does.

    Returns:
        Shape (parts,).
    """
    states = parse_states(text, option, assembly).states
    if len(states) != 1:
        raise StateError(f"{option} {text}: holds {len(states)} states; give one")
    return states[0]


@dataclass(frozen=True, eq=False)
class ChosenStates:
    """States that a command is about: those of a plan, which stand as built, or others, which are loaded from rest."""

    states: States
    """Shape (states, parts)."""
    plan: Plan | None = None
    steps: Sequence[int] = ()
    """Step of the plan that leads to each of the states, 0 for its start; of a plan alone."""

    @staticmethod
    def from_plan(plan: Plan, steps: Sequence[int] | None = None) -> ChosenStates:
        """Take the states after some steps of a plan; all of them if none are given."""
        chosen = range(len(plan) + 1) if steps is None else steps
        return ChosenStates(plan.states[list(chosen)], plan, chosen)

    def settings(self, criterion: Criterion | None, cone: Cone | None, solver: SolverName = "cpu") -> StabilitySettings:
        """Return settings of stability: the criterion, unless it is given, and the gravity of the plan, if any."""
        from falsework.stability.settings import StabilitySettings

        claim = None if self.plan is None else self.plan.claim
        criterion = criterion or ("contact" if claim is None else claim.criterion)
        return StabilitySettings(criterion=criterion, cone=cone, solver=solver).under_gravity_of(claim)

    def number(self, row: int) -> int:
        """Return the step of the plan that leads to a state, or its number."""
        return row if self.plan is None else self.steps[row]

    def subject(self, row: int) -> str:
        """Return the name of a state: the step of the plan that leads to it, or its number."""
        step = self.number(row)
        if self.plan is None:
            return f"state {step}"
        return f"{step} {self.plan.steps[step - 1] if step else 'start'}"


def parse_states(text: str, option: str, assembly: Assembly, plan: Plan | None = None) -> ChosenStates:
    """Read states.

    Args:
        plan: plan that the states are of, if there is one: then numbers and ranges alone, such as `3,5-7`, are steps.
        text: `complete`, `empty`, digits such as `2110`, a step of a plan such as `plan.json:31`, names of parts that
            stand and, after `held:`, of those that are held, such as `0-16,keystone,held:left`; or a file: a plan,
            whose states all count, a JSON list or a `.npy` array.
    """
    from falsework.assembly.state import as_states
    from falsework.replanning.named_state import named_state
    from falsework.search.plans.plan_file import is_plan_file

    try:
        if text in ("complete", "empty"):
            return ChosenStates(named_state(text, assembly)[None])
        if text and set(text) <= set("012") and _is_digits(text, assembly, plan):
            return ChosenStates(as_states([int(digit) for digit in text], assembly.boundary))
        if text.startswith("["):
            return ChosenStates(as_states(parse_json(text), assembly.boundary))
        if plan is not None and _STEPS.fullmatch(text):
            return ChosenStates.from_plan(plan, _steps(text, plan))
        file, colon, steps = text.rpartition(":")
        if colon and Path(file).is_file():
            plan = _plan(file, assembly)
            return ChosenStates.from_plan(plan, _steps(steps, plan))
        if Path(text).is_file():
            if is_plan_file(text):
                return ChosenStates.from_plan(_plan(text, assembly))
            return ChosenStates(as_states(read_states(Path(text)), assembly.boundary))
        if ".json" in (Path(text).suffix.lower(), Path(file).suffix.lower()) or text.endswith(".npy"):
            raise StateError(f"there is no file {file if colon else text}")
        return ChosenStates(_state_of_parts(text, option, assembly)[None])
    except (StateError, PlanError, ValueError) as error:
        raise StateError(f"{option} {text}: {error}") from None


def _is_digits(text: str, assembly: Assembly, plan: Plan | None) -> bool:
    """Return whether 0, 1 and 2 are the digits of a state, also one of wrong length, rather than a step or a part."""
    part = text in assembly.names or text in map(str, range(assembly.part_count))
    return len(text) == assembly.part_count or (plan is None and not part)


def _plan(file: str, assembly: Assembly) -> Plan:
    """Read the plan of a structure."""
    from falsework.search.plans.plan_check import check_identity
    from falsework.search.plans.plan_file import load_plan

    plan = load_plan(file)
    check_identity(plan, assembly)
    return plan


def _steps(text: str, plan: Plan) -> list[int]:
    """Read steps of a plan, such as `31` or `3,5-7`."""
    from falsework.search.plans.steps import no_such_step

    steps: list[int] = []
    for item in text.split(","):
        span = part_range(item, ()) or [int(item) if item.isascii() and item.isdecimal() and len(item) < 10 else -1]
        if not 0 <= span[0] <= span[-1] <= len(plan):
            raise PlanError(no_such_step(repr(item), len(plan)))
        steps += span
    return steps


def _state_of_parts(text: str, option: str, assembly: Assembly) -> States:
    """Return the state in which some parts stand and others are held."""
    from falsework.replanning.named_state import named_state

    parts: dict[str, list[int]] = {"standing": [], "held": []}
    for item in split_parts(text, option):
        held = item.startswith(_HELD) and item not in assembly.names
        name = item.removeprefix(_HELD) if held else item
        if part_range(name, assembly.names) is None and name not in assembly.names and not name.isdecimal():
            raise StateError(f"{name!r} is neither a part nor a file{alike(name, assembly.names)}; give {STATE_FORMS}")
        parts["held" if held else "standing"] += parse_parts(name, option, assembly.names)
    return named_state(parts, assembly)


def parse_limits(force: str | None, moment: str | None) -> tuple[float | None, float | None]:
    """Read the largest force and moment of a robot, such as `300N` and `40Nm`; numbers alone are N and Nm."""

    def limit(text: str | None, kind: str) -> float | None:
        try:
            return None if text is None else float(text)
        except ValueError:
            return parse_quantity(text or "", kind, f"--hold-{kind}")

    return limit(force, "force"), limit(moment, "moment")

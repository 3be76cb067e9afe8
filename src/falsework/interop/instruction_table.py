"""Assembly instructions for a crew: parts to place, to hold and to release in each step.

A robot of a plan is called a support here: a robot, a prop, or a pair of hands that keeps a part exactly where it is
until the sheet says that it may be released. The table is always in the order of assembly.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.state import REMOVED, States
from falsework.errors import InputError, PlanError
from falsework.geometry.clearance.moves import ExitPath
from falsework.search.plans.plan import Plan
from falsework.search.plans.steps import NO_ROBOT, Action, name_together
from falsework.stability.holds import Press
from falsework.utils.files.formats import Exporter, writer_of
from falsework.utils.quantity import counted, format_number, format_quantity, listed
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly

COLUMNS = (
    "step",
    "do",
    "part",
    "name",
    "mass_kg",
    "support",
    "hold",
    "press",
    "way",
    "way_x",
    "way_y",
    "way_z",
    "center_x",
    "center_y",
    "center_z",
    "placed",
    "needed",
    "margins",
    "join",
)
"""Of the table in CSV: metres and kilograms; `hold` names all parts that must be held when the step is done, `press`
those that are pressed while a part is released, `join` those that mortar, glue or fasteners join with the part. Where
several parts are placed at once, semicolons separate them, `mass_kg` and the centre are those of all, and `way_x` to
`way_z` those of the first."""
_LISTED_LOADS = 12
"""Loads in one line; the rest is a number."""
_LEANS = 0.35
"""Components of a direction below this, the sine of about 20 degrees, are omitted."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""First characters of texts that a spreadsheet evaluates as formulas."""


@dataclass(frozen=True, eq=False)
class AssemblyInstruction:
    """Step of the assembly instructions."""

    number: int
    """From 1."""
    parts: tuple[int, ...]
    """The part; where several are placed at once all of them, those that are held first."""
    place: bool
    """Whether the part is placed, and held from then on; else it is released."""
    supports: tuple[int, ...]
    """Supports that hold or release, from 0, in the order of the parts; parts without are carried by the first."""
    hold: tuple[tuple[int, int], ...]
    """Part and support of everything that must be held when the step is done."""
    presses: tuple[Press, ...]
    """Presses of supports while the part is released."""
    directions: NDArray[np.float64] | None
    """Unit vectors along which the parts come in, shape (parts, 3); None for a release."""
    placed: int
    """Parts that are there when the step is done, boundary not counted."""
    needed: bool
    """Whether the part was declared missing when the plan was made."""
    margins: str = ""
    """Margins of the state after the step, as far as the plan records them."""
    joins: tuple[tuple[int, int], ...] = ()
    """Parts that are placed, each with one that is there then and which a joint with a strength joins to it."""

    @property
    def verb(self) -> str:
        """Action, as a verb."""
        return "place" if self.place else "release"


@dataclass(frozen=True, eq=False)
class AssemblyInstructions:
    """Plan as instructions for a crew."""

    timeline: Timeline
    steps: tuple[AssemblyInstruction, ...]
    supports: int
    """That there must be."""

    def __repr__(self) -> str:
        work = f"{counted(len(self.steps), 'step')} with {counted(self.supports, 'support')}"
        return f"<AssemblyInstructions for {self.assembly.name}: {work}>"

    @property
    def assembly(self) -> Assembly:
        """The structure."""
        return self.timeline.assembly

    @property
    def start(self) -> tuple[int, ...]:
        """Parts that are there before the first step, boundary not counted."""
        state = self.timeline.states[0]
        return tuple(np.flatnonzero((state != REMOVED) & ~self.assembly.boundary).tolist())

    def name(self, part: int) -> str:
        """Return the number and name of a part; only one of them if that suffices."""
        name = self.assembly.names[part]
        return name if name == str(part) or name.endswith((f"-{part}", f"_{part}")) else f"{part} {name}"

    def joining(self, step: AssemblyInstruction) -> str:
        """Describe what is joined in a step, such as `block-3 with block-2`; empty for nothing."""
        return "; ".join(f"{self.name(part)} with {self.name(other)}" for part, other in step.joins)

    @property
    def premises(self) -> list[str]:
        """Return what the proofs of the plan rest on beside its order, in sentences."""
        assembly, joints, loads = self.assembly, self.assembly.joints, self.assembly.loads
        own = [] if joints is None else np.unique(joints.friction[np.isfinite(joints.friction)]).tolist()
        differs = f" ({', '.join(f'{value:g}' for value in own)} in joints that have their own)" if own else ""
        said = [
            f"The proofs hold for friction of at least {assembly.friction:g}{differs} and parts of the masses given, "
            "at rest, where the model has them."
        ]
        if any(step.joins for step in self.steps):
            said.append("JOIN: mortar, glue or fasteners of the model join parts; the proofs hold with them only.")
        if loads is not None:
            force, moment = (np.linalg.norm(loads.wrench[:, rows], axis=1) for rows in (slice(3), slice(3, 6)))
            acts = [
                f"{format_quantity(*((force[part], 'force') if force[part] else (moment[part], 'moment')))} on "
                f"{self.name(part)}"
                for part in np.flatnonzero(loads.wrench.any(axis=1)).tolist()
            ]
            if loads.acceleration.any():
                shares = ", ".join(f"{value:g}" for value in loads.acceleration)
                acts.append(f"an acceleration of ({shares}) g on all parts")
            said.append(f"The proofs take into account loads beside the weight: {listed(acts, _LISTED_LOADS)}.")
        return said

    def holding(self, place: int) -> tuple[tuple[int, int], ...]:
        """Return the part and support of everything that is held after so many steps."""
        return _holding(self.timeline, place)

    def named(self, step: AssemblyInstruction) -> str:
        """Return the numbers and names of the parts of a step."""
        return name_together([self.name(part) for part in step.parts], len(step.supports))

    def comes_in(self, step: AssemblyInstruction) -> str:
        """Describe from where the parts of a step come in; empty for a release."""
        moves = self.timeline.path_of(step.parts[0]) if step.place else ()
        if moves:
            return describe_path(moves, self.assembly.names)
        words = dict.fromkeys(describe_motion(way) for way in step.directions) if step.directions is not None else {}
        return "; ".join(words)

    def pressing(self, step: AssemblyInstruction) -> list[tuple[str, str]]:
        """Describe the presses of a step, such as `block-3 with 885 N` and `from -x by support 2`."""
        supports = dict(step.hold)
        described = []
        for press in step.presses:
            way = describe_motion(np.array(press.wrench[:3]) / max(press.force, 1e-300))
            what = f"{self.name(press.part)} with {format_quantity(press.force, 'force')}"
            described.append((what, f"{way} by support {supports[press.part] + 1}"))
        return described


def sheet(assembly: AnyStructure, plan: Plan) -> AssemblyInstructions:
    """Return the assembly instructions of a plan for a crew: what to place, to hold and to release.

    `export` writes them to a file, `pdf` with pictures or `csv`.

    Args:
        assembly: the structure, or its name or path.

    Raises:
        InputError: something other than a plan.
        PlanError: the plan is for another structure, or it holds parts again or has props.
    """
    if not isinstance(plan, Plan):
        raise InputError(f"{type(plan).__name__} is no plan; give the structure first, then its plan")
    if plan.allow_regrasp:
        raise PlanError("a sheet says when to place and when to release, not what is held again or propped; export it")
    assembly = as_assembly(assembly)
    timeline, missing, steps = Timeline.from_plan(plan, assembly), set(plan.missing), []
    for step in plan.steps:
        place, number = step.action is Action.INSERT, step.number
        assert step.robots  # a sheet has no props
        steps.append(
            AssemblyInstruction(
                number=number,
                parts=step.parts,
                place=place,
                supports=step.robots,
                hold=_holding(timeline, number),
                presses=step.presses,
                directions=-timeline.exit_directions[list(step.parts)] if place else None,
                placed=int(((step.state != REMOVED) & ~assembly.boundary).sum()),
                needed=place and not missing.isdisjoint(step.parts),
                margins="" if plan.margins is None else plan.margins.words(number),
                joins=_joins(step.parts, step.state, assembly) if place else (),
            )
        )
    return AssemblyInstructions(timeline, tuple(steps), int(timeline.holders.max(initial=NO_ROBOT)) + 1)


def describe_motion(way: NDArray[np.float64]) -> str:
    """Describe a motion along a vector, shape (3,), by where it comes from, such as `from above`."""
    sides = [f"{'-' if way[axis] > 0 else '+'}{'xy'[axis]}" for axis in (0, 1) if abs(way[axis]) > _LEANS]
    if abs(way[2]) > _LEANS:
        sides.append("above" if way[2] < 0 else "below")
    return f"from {' and '.join(sides)}" if sides else "straight in"


def describe_path(path: ExitPath, names: Sequence[str]) -> str:
    """Describe how a part comes in that undoes an exit path, such as `from +x, then from above, with bar-2 aside`.

    Args:
        path: moves in which it leaves.
    """
    words, part = [], path[-1].parts[0]
    aside = sorted({one for move in path for one in move.parts} - {part})
    for move in reversed(path):
        if part not in move.parts:
            continue
        turn = f"turning by {abs(np.degrees(move.angle)):.0f}°" if move.turns else ""
        shift = describe_motion(-np.array(move.direction)) if move.distance else ""
        words.append(", ".join(filter(None, (shift, turn))))
    described = ", then ".join(words)
    return f"{described}, with {listed([names[one] for one in aside])} aside" if aside else described


def instructions_csv(sheet: AssemblyInstructions) -> str:
    """Return the table as CSV with a line of headings, one step a line."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(COLUMNS)
    for row in _rows(sheet):
        writer.writerow([row[column] for column in COLUMNS])
    return text.getvalue()


def _rows(sheet: AssemblyInstructions) -> Iterator[dict[str, Any]]:
    assembly = sheet.assembly
    for step in sheet.steps:
        way = ["", "", ""] if step.directions is None else [f"{value:.4f}" for value in step.directions[0]]
        hold = "; ".join(f"{sheet.name(part)} (support {support + 1})" for part, support in step.hold)
        mass = assembly.mass.mass[list(step.parts)]
        center = mass @ assembly.mass.center[list(step.parts)] / mass.sum()
        yield {
            "step": step.number,
            "do": step.verb,
            "part": "; ".join(map(str, step.parts)),
            "name": _harmless("; ".join(assembly.names[part] for part in step.parts)),
            "mass_kg": format_number(mass.sum(), 6),
            "support": "; ".join(str(support + 1) for support in step.supports),
            "hold": hold,
            "press": "; ".join(map(" ".join, sheet.pressing(step))),
            "way": sheet.comes_in(step),
            **dict(zip(("way_x", "way_y", "way_z"), way, strict=True)),
            **{f"center_{axis}": format_number(center[i], 6) for i, axis in enumerate("xyz")},
            "placed": step.placed,
            "needed": "yes" if step.needed else "",
            "margins": step.margins,
            "join": _harmless(sheet.joining(step)),
        }


def _harmless(text: str) -> str:
    """Return a text that no spreadsheet takes for a formula."""
    return f"'{text}" if text.startswith(_FORMULA) else text


def _joins(parts: Sequence[int], state: States, assembly: Assembly) -> tuple[tuple[int, int], ...]:
    """Return the parts that come to a state, each with one that is there and which a joint with a strength joins to it.

    Args:
        state: with the parts, shape (parts,).
    """
    if assembly.joints is None:
        return ()
    owner = assembly.contacts.contact_of_point
    strong = np.unique(owner[(np.nan_to_num(assembly.joints.cohesion) > 0) | (assembly.joints.tension > 0)])
    found = set()
    for pair in assembly.contacts.parts[strong].tolist():
        part, other = pair if pair[0] in parts else pair[::-1]
        if part in parts and state[other] != REMOVED:
            found.add((part, other))
    return tuple(sorted(found))


def _holding(timeline: Timeline, place: int) -> tuple[tuple[int, int], ...]:
    """Return the part and support of everything that is held after so many steps, by support."""
    robots = timeline.holders[place]
    held = np.flatnonzero(robots != NO_ROBOT)
    return tuple(sorted(((int(part), int(robots[part])) for part in held), key=lambda pair: pair[1]))


# The byte order mark is how spreadsheets detect the encoding.
_WRITE = writer_of(lambda assembly, plan: instructions_csv(sheet(assembly, plan)).encode("utf-8-sig"))
CSV = Exporter(_WRITE, (".csv",), ("Plan",))

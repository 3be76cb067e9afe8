"""Checks of plan files beyond their model: parts exist, rules hold, and the steps lead from the start to the end."""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np
from msgspec import to_builtins
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, as_states, held_count
from falsework.errors import PlanError, StateError
from falsework.geometry.clearance.moves import ExitPath, PathMove
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.plans.older_plans import upgraded
from falsework.search.plans.packed_proofs import CHANGES, WHOLE, unpack_proofs
from falsework.search.plans.plan import needs_of
from falsework.search.plans.plan_model import (
    FORMAT,
    RULE_FIELDS,
    UNPROVEN,
    MarginsEntry,
    PlanFile,
    ReplayEntry,
    StartEntry,
    StepEntry,
)
from falsework.search.plans.plan_source import check_source
from falsework.search.plans.steps import Action
from falsework.search.problem.plan_replay import PlanReplay
from falsework.stability.certificate import StabilityCriterion
from falsework.stability.holds import HoldLoad, HoldSettings, Press
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Proof, Verdict
from falsework.utils.json_file import check_format
from falsework.utils.models import read_model, to_json_values
from falsework.utils.quantity import format_quantity

MOVES = {
    Action.INSERT: (REMOVED, HELD),
    Action.RELEASE: (HELD, INSTALLED),
    Action.HOLD: (INSTALLED, HELD),
    Action.REMOVE: (HELD, REMOVED),
}
"""Value of the part before a step, and after."""
PROOF_WORDS = {"contact": "history", "equilibrium": "forces"}
MOST_ANGLE = 1e4
"""Angle of a turn that is read, rad."""
MOST_ENTRIES = 1 << 30
"""States of a plan times parts that are read, a byte each: a complete plan of 23,000 parts."""


class PlanReader:
    """Reader of plans that checks everything that can be checked without the structure."""

    def __init__(self, data: Any, source: str) -> None:
        """Read the model of a plan.

        Raises:
            PlanError: they are no plan; the message names the entry.
        """
        self._about = f"{source} is not a valid plan: "
        data, self._backwards = upgraded(data) if isinstance(data, dict) else (data, False)
        if self._backwards is None:
            self._fail(f"direction is {data.get('direction')!r}", "it must be disassembly or assembly")
        check_format(data, FORMAT, self._about, "falsework plan")
        self._file = read_model(
            PlanFile, data, self._about, PlanError, remedy="; it may be damaged or from another version; plan again"
        )
        self._parts, self._props = len(self._file.structure.parts), len(self._file.structure.props)

    def fields(self) -> dict[str, Any]:
        """Return the fields of the plan.

        Raises:
            PlanError: the entries contradict each other.
        """
        file, structure, rules = self._file, self._file.structure, self._file.rules
        parts = self._parts
        boundary = np.zeros(parts, dtype=bool)
        boundary[list(self._distinct(structure.boundary, "structure.boundary"))] = True
        for number, prop in enumerate(structure.props):
            self._part(prop.part, f"structure.props[{number}].part", parts - self._props)
        if structure.source is not None:
            check_source(structure.source, self._about)
        claim = self._claim()
        if rules.waiting and rules.moves == 1:
            self._fail("rules.waiting is true", "it needs rules.moves above 1")
        if (rules.moves > 1 or rules.turns) and not rules.removable_only_if_clear:
            self._fail("rules.moves is above 1, or rules.turns is true", "they need rules.removable_only_if_clear")
        if rules.parts_at_once > 1 and not rules.removable_only_if_clear:
            self._fail("rules.parts_at_once is above 1", "parts move at once only with rules.removable_only_if_clear")
        states, actions, residuals = self._sequence(boundary)
        proven = ~np.isnan(residuals)
        if (residuals[proven] > claim.tolerance).any():
            self._fail(
                f"a residual of {format_quantity(float(residuals[proven].max()), 'share')} is above the tolerance "
                f"of {format_quantity(claim.tolerance, 'share')}"
            )
        moved = np.flatnonzero((states[1:] != states[:-1]).any(axis=0)).tolist()
        touched = sorted(set(self._distinct(rules.fixed, "rules.fixed")) & set(moved))
        if touched:
            self._fail(f"its steps touch part {touched[0]}, which is fixed")
        missing = self._distinct(rules.missing, "rules.missing")
        if file.needs != needs_of(states, missing):
            self._fail("its needs do not agree with its steps")
        loads = [self._loads(record, number) for number, record in enumerate((file.start, *file.steps))]
        if any(loads) and claim.criterion != "contact":
            self._fail("it says what robots bear, which is not known under the criterion equilibrium")
        exit_paths = [self._exit_path(step, number) for number, step in enumerate(file.steps, 1)]
        presses = [self._presses(step, number) for number, step in enumerate(file.steps, 1)]
        if any(presses) and not claim.presses:
            self._fail("robots press in it, which they do under contact alone, not with holds.mode locked or force 0")
        return {
            "states": states,
            "actions": actions,
            "verdicts": tuple(Verdict.STABLE if stable else Verdict.UNDECIDED for stable in proven),
            "proofs": tuple(Proof[PROOF_WORDS[claim.criterion].upper()] if stable else Proof.NONE for stable in proven),
            "residuals": residuals,
            "name": structure.name,
            "identity": structure.identity,
            "part_names": structure.parts,
            "boundary": boundary,
            "friction": structure.friction,
            "robots": file.robots,
            "claim": claim,
            "props": structure.props,
            **{name: getattr(rules, entry) for entry, name in RULE_FIELDS.items()},
            "exit_paths": tuple(exit_paths) if any(exit_paths) else (),
            "source": None if structure.source is None else to_json_values(structure.source),
            "presses": tuple(presses) if any(presses) else (),
            "loads": tuple(loads) if any(loads) else (),
            "replay": None if file.replay is None else self._replay(file.replay, len(states)),
            "margins": None if file.margins is None else self._margins(file.margins, len(states)),
            **self._proofs(states.shape),
        }

    def _claim(self) -> StabilityCriterion:
        entry = self._file.stability
        contact, holds = entry.criterion == "contact", HoldSettings()
        if contact != (entry.holds is not None):
            self._fail("stability.holds must be there under contact, and not under equilibrium")
        if entry.holds is not None:
            given = {name: getattr(entry.holds, name) for name in ("stiffness", "force", "moment")}
            limits = {name: np.inf if value is None else value for name, value in given.items()}
            holds = HoldSettings(**limits, mode=entry.holds.mode)
        return StabilityCriterion(**(to_builtins(entry) | {"holds": holds}))

    def _sequence(self, boundary: NDArray[np.bool_]) -> tuple[States, NDArray[np.int64], NDArray[np.float64]]:
        """Replay the steps from the start; the end must be the one that the file names."""
        file, parts, robots, props = self._file, self._parts, self._file.robots, self._props
        state = self._state(file.start.state, boundary, "start.state")
        is_prop = np.arange(parts) >= parts - props
        if (is_prop & (state == INSTALLED)).any():
            self._fail("start.state has a prop that is neither there nor away")
        held = int(held_count(state[None], boundary | is_prop)[0])
        if held > robots:
            self._fail(f"start.state has {held} parts held with {robots} robots")
        if (len(file.steps) + 1) * parts > MOST_ENTRIES:
            self._fail(f"it has {len(file.steps)} steps of {parts} parts", f"at most {MOST_ENTRIES} entries are read")
        states, actions = np.empty((len(file.steps) + 1, parts), dtype=np.uint8), []
        states[0] = state
        residuals = [self._judged(file.start, "start")]
        for number, step in enumerate(file.steps, 1):
            place, part = f"step {number}", step.part
            word = step.do.value
            self._part(part, f"steps[{number - 1}].part")
            old, new = MOVES[step.do]
            above = REMOVED in (old, new)
            again = file.rules.support or step.do != Action.HOLD
            if not (above if is_prop[part] else step.do != Action.REMOVE and again):
                what = "a prop is inserted or removed" if is_prop[part] else "a plan inserts parts and releases them"
                self._fail(f"{place} does {word!r} with part {part}", what)
            if boundary[part] or state[part] != old:
                found = "boundary" if boundary[part] else ("removed", "installed", "held")[int(state[part])]
                self._fail(f"{place} cannot {word} part {part}, which is {found}")
            with_it, carried = self._with(step, number, state, boundary | is_prop)
            state[[part, *with_it]], state[list(carried)] = new, INSTALLED
            held += 0 if is_prop[part] else 1 + len(with_it) if new == HELD else -1
            if held > robots:
                self._fail(f"{place} needs {held} robots, but the plan has {robots}")
            states[number] = state
            actions.append(part + parts * above)
            residuals.append(self._judged(step, place))
        if not np.array_equal(self._state(file.end, boundary, "end"), state):
            self._fail("its steps do not lead to its end")
        return states, np.array(actions, dtype=np.int64), np.array(residuals)

    def _with(
        self, step: StepEntry, number: int, state: States, immovable: NDArray[np.bool_]
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the parts that a step inserts beside its own: those that robots hold, and those that it carries."""
        if step.parts is None and step.held is None:
            return (), ()
        place, most = f"step {number}", self._file.rules.parts_at_once
        if step.parts is None or step.held is None:
            self._fail(f"{place} has only one of parts and held", "a step that inserts several parts has both")
        members, held = self._distinct(step.parts, f"steps[{number - 1}].parts"), step.held
        if step.do != Action.INSERT or len(members) > most or members[0] != step.part:
            self._fail(
                f"{place} does {step.do.value!r} with parts {list(members)}",
                f"a step inserts its part and others, at most {most} with rules.parts_at_once",
            )
        if held not in (1, len(members)):
            self._fail(f"{place} holds {held} of {len(members)} parts", "robots hold each of them, or the first alone")
        there = [part for part in members if immovable[part] or state[part] != REMOVED]
        if there:
            self._fail(f"{place} cannot insert part {there[0]}, which is there already")
        return members[1:held], members[held:]

    def _exit_path(self, step: StepEntry, number: int) -> ExitPath:
        """Return the moves of a step; whether they lead out is for the check."""
        if not step.exit_path:
            return ()
        place, most = f"step {number}", self._file.rules.moves
        if step.do != Action.INSERT:
            self._fail(f"{place} has an exit_path", "only a step that inserts parts has one")
        if len(step.exit_path) > most:
            self._fail(f"{place} has {len(step.exit_path)} moves", f"at most {most} with rules.moves")
        for count, move in enumerate(step.exit_path):
            place = f"steps[{number - 1}].exit_path[{count}]"
            if abs(np.linalg.norm(move.direction) - 1.0) > 1e-6:
                self._fail(f"{place}.direction is no unit vector")
            if move.distance == 0.0 and not move.angle:
                self._fail(f"{place} moves nothing")
            if (move.angle is None) != (move.point is None):
                self._fail(f"{place} has only one of angle and point", "a turn has both")
            if move.angle and not self._file.rules.turns:
                self._fail(f"{place} turns", "it may not without rules.turns")
            if abs(move.angle or 0.0) > MOST_ANGLE:
                self._fail(f"{place}.angle is {move.angle:g}", f"at most {MOST_ANGLE:g} rad")
            if move.parts is not None and not self._distinct(move.parts, f"{place}.parts"):
                self._fail(f"{place}.parts is empty")
        return tuple(
            PathMove(
                move.parts or tuple(sorted(step.parts or (step.part,))),
                move.direction,
                move.distance,
                move.angle or 0.0,
                move.point or (0.0,) * 3,
            )
            for move in step.exit_path
        )

    def _judged(self, record: StartEntry | StepEntry, place: str) -> float:
        """Return the residual of a state; nan where a plan whose replay fails has not proven it."""
        falls = self._file.replay is not None and not self._file.replay.stands
        if falls and all(getattr(record, name) == value for name, value in UNPROVEN.items()):
            return np.nan
        wanted = PROOF_WORDS[self._file.stability.criterion]
        if (record.verdict, record.proof) != ("stable", wanted) or record.residual is None:
            found = f"{place} has verdict {record.verdict!r} with proof {record.proof!r}"
            self._fail(found, f"every state must be stable by {wanted}, with its residual")
        return record.residual

    def _state(self, values: tuple[int, ...], boundary: NDArray[np.bool_], place: str) -> States:
        if len(values) != len(boundary):
            self._fail(f"{place} has {len(values)} values for {len(boundary)} parts")
        try:
            return as_states(values, boundary)[0]
        except StateError as error:
            self._fail(f"{place}: {error}")

    def _part(self, part: int, place: str, count: int | None = None) -> None:
        count = self._parts if count is None else count
        if part >= count:
            self._fail(f"{place} is {part}", f"it must be a part from 0 to {count - 1}")

    def _distinct(self, parts: tuple[int, ...], place: str, key: str = "") -> tuple[int, ...]:
        for number, part in enumerate(parts):
            self._part(part, f"{place}[{number}]{key}")
        if len(set(parts)) != len(parts):
            self._fail(f"{place} names a part twice")
        return parts

    def _presses(self, step: StepEntry, number: int) -> tuple[Press, ...]:
        """Return the presses of a step; whether robots hold these parts is for the check."""
        for place, press in enumerate(step.presses):
            self._part(press.part, f"steps[{number - 1}].presses[{place}].part")
        return step.presses

    def _loads(self, record: StartEntry | StepEntry, number: int) -> tuple[HoldLoad, ...]:
        """Return what robots bear in a state; whether they hold these parts is for the check."""
        place = f"steps[{number - 1}].bears" if number else "start.bears"
        self._distinct(tuple(load.part for load in record.bears), place, ".part")
        return record.bears

    def _replay(self, entry: ReplayEntry, states: int) -> PlanReplay:
        if entry.stands != (entry.falls_at is None):
            self._fail("replay.stands must be true, with no falls_at, or false, with one")
        if entry.falls_at is not None and entry.falls_at >= states:
            self._fail(f"replay.falls_at is {entry.falls_at}", f"the plan has {states} states")
        self._part(entry.part, "replay.part")
        built = entry.judgement
        if built is not None:
            self._part(built.part, "replay.judgement.part")
            if max(built.built, *built.undecided, 0) > states or built.of != states:
                self._fail(f"replay.judgement: built, of and undecided are numbers of states; the plan has {states}")
            fallen = built.falls_at is None or built.falls_at == built.built < states
            if not fallen or max(built.undecided, default=-1) >= built.built:
                what = f"{built.built} states were built, which does not go with falls_at or undecided"
                self._fail(f"replay.judgement: {what}")
        return PlanReplay(entry.stands, entry.moved, entry.part, entry.falls_at, varied=entry.varied, judgement=built)

    def _margins(self, entry: MarginsEntry, states: int) -> PlanMargins:
        measured: dict[str, tuple[float | None, ...]] = to_builtins(entry.measured)
        for name, values in measured.items():
            if len(values) != states:
                self._fail(f"margins.measured.{name} has {len(values)} numbers", f"the plan has {states} states")
        if entry.maximised == "tilt" and entry.bound is not None and entry.bound > np.pi / 2:
            self._fail(f"margins.bound is {entry.bound}", "it must be a number within the range of its kind, or null")
        return PlanMargins(entry.demands, measured, entry.maximised, entry.bound)

    def _proofs(self, shape: tuple[int, ...]) -> dict[str, Any]:
        """Return the proofs of all states, of so many states and parts: forces of points, or displacements of parts."""
        contact, (states, parts) = self._file.stability.criterion == "contact", shape
        moved, forces = self._file.displacements, self._file.forces
        name = "forces" if contact else "displacements"
        if (forces if contact else moved) is not None:
            self._fail(f"it has {name}, which prove nothing under the criterion {self._file.stability.criterion}")
        if moved is not None:
            if moved.parts != parts:
                self._fail(f"displacements.parts is {moved.parts}", f"the plan has {parts} parts; plan again")
            rows = moved.increments * parts
            flat = self._unpacked("displacements", WHOLE, moved.zlib_base64, (states, rows, 6), f"{rows} parts")
            return {"displacement": np.asarray(flat).reshape(states, moved.increments, parts, 6)}
        if forces is not None:
            whole, changes = forces.zlib_base64, forces.changes_zlib_base64
            if (whole is None) == (changes is None):
                self._fail(f"forces must have either {WHOLE} or {CHANGES}")
            entry, text = (WHOLE, whole) if changes is None else (CHANGES, changes)
            return {
                "forces": self._unpacked("forces", entry, text, (states, forces.points, 3), f"{forces.points} points")
            }
        return {}

    def _unpacked(
        self, name: str, entry: str, text: str | None, shape: tuple[int, int, int], counted: str
    ) -> NDArray[np.float64] | StateArrays:
        try:
            found = unpack_proofs(entry, text, shape, f"{name} of {counted} for each of {shape[0]} states")
        except ValueError as error:
            self._fail(f"{name}.{entry} {error}")
        return found[::-1].copy() if self._backwards else found

    def _fail(self, what: str, remedy: str = "the file is damaged; plan again") -> NoReturn:
        raise PlanError(f"{self._about}{what}; {remedy}")

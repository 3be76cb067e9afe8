"""Strict reader of plan files: the entries, the rules, and that the steps lead from the start to the end."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.prop import Prop
from falsework.assembly.state import HELD, INSTALLED, REMOVED, States, as_states, held_count
from falsework.errors import InputError, StateError
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.plans.older_plans import FORMAT, UNPROVEN, upgraded
from falsework.search.plans.packed_proofs import CHANGES, WHOLE, unpack_proofs
from falsework.search.plans.plan import needs_of
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.plans.plan_source import wrong_source
from falsework.search.plans.steps import Action
from falsework.stability.certificate import StabilityCriterion
from falsework.stability.holds import HoldLoad, HoldMode, HoldSettings, Press
from falsework.stability.judges.judgement import Judgement
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Proof, Verdict
from falsework.utils.json_file import Reader

MOVES = {
    Action.INSERT: (REMOVED, HELD),
    Action.RELEASE: (HELD, INSTALLED),
    Action.HOLD: (INSTALLED, HELD),
    Action.REMOVE: (HELD, REMOVED),
}
"""Value of the part before a step, and after."""
PROOF_WORDS = {"contact": "history", "equilibrium": "forces"}
PROOF_ARRAYS = {"contact": ("displacements", "parts"), "equilibrium": ("forces", "points")}
"""Entry of the file that holds the proofs, and the items along its first axis."""
MOST_ENTRIES = 1 << 30
"""States of a plan times parts that are read, a byte each: a complete plan of 23,000 parts."""
MOST_INCREMENTS = 64
"""Increments of a step that are read."""
_REPLAY = frozenset({"judgement", "varied", "weak_under", "weak_at"})
"""Entries of a replay that may be missing."""
_KEYS = {"format", "structure", "robots", "rules", "stability", "start", "steps", "end", "needs"}


class PlanReader(Reader):
    """Reader of plans that checks everything that can be checked without the structure."""

    kind, form, command = "plan", FORMAT, "falsework plan"
    _backwards: bool | None = False
    """Whether the packed proofs in the file are in the order of disassembly."""

    def fields(self, data: Any) -> dict[str, Any]:
        """Return the fields of the plan in JSON values.

        Raises:
            PlanError: they are no plan; the message names the entry.
        """
        if isinstance(data, dict):
            data, self._backwards = upgraded(data, self._source)
        if self._backwards is None:
            self._fail(f"direction is {data.get('direction')!r}", "it must be disassembly or assembly")
        self._header(data, _KEYS, optional=frozenset({"forces", "displacements", "replay", "margins"}))
        structure, rules, stability = data["structure"], data["rules"], data["stability"]
        self._keys(
            structure,
            {"name", "identity", "friction", "boundary", "parts"},
            "structure",
            frozenset({"source", "props"}),
        )
        self._keys(rules, {"fixed", "missing", "removable_only_if_clear"}, "rules", frozenset({"support", "props"}))
        self._keys(
            stability,
            {"criterion", "stiffness_ratio", "cone", "gravity", "tolerance", "force_bound", "reserve"},
            "stability",
            frozenset({"holds"}),
        )
        names = structure["parts"]
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            self._fail("structure.parts is not a list of names")
        if not all(isinstance(structure[key], str) for key in ("name", "identity")):
            self._fail("structure.name and structure.identity must be texts")
        parts, props = len(names), self._props(structure.get("props", []), len(names))
        boundary = np.zeros(parts, dtype=bool)
        boundary[self._parts(structure["boundary"], parts, "structure.boundary")] = True
        if not isinstance(rules["removable_only_if_clear"], bool):
            self._fail("rules.removable_only_if_clear must be true or false")
        if not isinstance(rules.get("support", False), bool):
            self._fail("rules.support must be true or false")
        if stability["cone"] not in ("octagon", "quadratic"):
            self._fail(f"stability.cone is {stability['cone']!r}", "it must be octagon or quadratic")
        if not isinstance(stability["criterion"], str) or stability["criterion"] not in PROOF_WORDS:
            self._fail(f"stability.criterion is {stability['criterion']!r}", "it must be contact or equilibrium")
        numbers = ("gravity", "tolerance", "force_bound", "stiffness_ratio", "reserve")
        claim = StabilityCriterion(
            cone=stability["cone"],
            criterion=stability["criterion"],
            holds=self._holds(stability),
            **{key: self._number(stability[key], f"stability.{key}") for key in numbers},
        )
        if 0 in (claim.gravity, claim.tolerance, claim.force_bound, claim.stiffness_ratio, claim.reserve):
            self._fail("stability has a zero where a positive number must be")
        self._proof = PROOF_WORDS[claim.criterion]
        replay = data.get("replay")
        self._falls = isinstance(replay, dict) and replay.get("stands") is False
        robots = self._count(data["robots"], "robots", least=1)
        states, actions, residuals = self._sequence(data, boundary, robots, rules.get("support", False), len(props))
        proven = ~np.isnan(residuals)
        if (residuals[proven] > claim.tolerance).any():
            self._fail(f"a residual of {residuals[proven].max():.3g} is above the tolerance of {claim.tolerance:g}")
        fixed = self._parts(rules["fixed"], parts, "rules.fixed")
        touched = sorted(set(fixed) & set((actions % parts).tolist()))
        if touched:
            self._fail(f"its steps touch part {touched[0]}, which is fixed")
        fields: dict[str, Any] = {
            "states": states,
            "actions": actions,
            "verdicts": tuple(Verdict.STABLE if stable else Verdict.UNDECIDED for stable in proven),
            "proofs": tuple(Proof[self._proof.upper()] if stable else Proof.NONE for stable in proven),
            "residuals": residuals,
            "name": structure["name"],
            "identity": structure["identity"],
            "part_names": tuple(names),
            "boundary": boundary,
            "friction": self._number(structure["friction"], "structure.friction"),
            "robots": robots,
            "claim": claim,
            "fixed": tuple(fixed),
            "missing": tuple(self._parts(rules["missing"], parts, "rules.missing")),
            "removable_only_if_clear": rules["removable_only_if_clear"],
            "support": rules.get("support", False),
            "props": props,
            "prop_limit": self._count(rules.get("props", 0), "rules.props"),
        }
        if "source" in structure:
            fields["source"] = self._source_of(structure["source"])
        if "replay" in data:
            fields["replay"] = self._replay(data["replay"], parts, len(states))
        if "margins" in data:
            try:
                fields["margins"] = PlanMargins.read(data["margins"], len(states))
            except InputError as error:
                self._fail(str(error))
        entry, counted = PROOF_ARRAYS[claim.criterion]
        for name in ("forces", "displacements"):
            if name in data and name != entry:
                self._fail(f"it has {name}, which prove nothing under the criterion {claim.criterion}")
        if entry in data:
            if entry == "displacements":
                fields["displacement"] = self._displacements(data[entry], states.shape)
            else:
                fields[entry] = self._packed(data[entry], entry, counted, states.shape)
        presses = [self._presses(step, number, parts) for number, step in enumerate(data["steps"], 1)]
        if any(presses):
            fields["presses"] = tuple(presses)
        loads = [self._loads(record, number, parts) for number, record in enumerate([data["start"], *data["steps"]])]
        if any(loads):
            if claim.criterion != "contact":
                self._fail("it says what robots bear, which is not known under the criterion equilibrium")
            fields["loads"] = tuple(loads)
        if data["needs"] != [asdict(need) for need in needs_of(actions, parts, fields["missing"])]:
            self._fail("its needs do not agree with its steps")
        return fields

    def _props(self, value: Any, parts: int) -> tuple[Prop, ...]:
        """Read the places of props, without checking them against the structure."""
        found = []
        for number, entry in enumerate(self._list(value, "structure.props"), 1):
            place = f"structure.props, prop {number}"
            self._keys(entry, {"part", "at", "floor"}, place)
            numbers = [*self._list(entry["at"], f"{place}: at"), entry["floor"]]
            if len(numbers) != 4 or not all(type(x) in (int, float) and math.isfinite(x) for x in numbers):
                self._fail(f"{place} has no place", "at must be three numbers, and floor one")
            part, (*at, floor) = self._count(entry["part"], f"{place}: part"), map(float, numbers)
            if part >= parts - len(value):
                self._fail(f"{place} is under part {part}", f"parts other than props are 0 to {parts - len(value) - 1}")
            found.append(Prop(part, (at[0], at[1], at[2]), floor))
        return tuple(found)

    def _source_of(self, value: Any) -> dict[str, Any]:
        """Read the source of the structure, without checking that it exists."""
        wrong = wrong_source(value)
        if wrong:
            self._fail(wrong)
        return value

    def _sequence(
        self,
        data: dict[str, Any],
        boundary: NDArray[np.bool_],
        robots: int,
        support: bool,
        props: int,
    ) -> tuple[States, NDArray[np.int64], NDArray[np.float64]]:
        """Replay the steps from the start; the end must be the one that the file names."""
        parts = len(boundary)
        self._keys(data["start"], {"state", "verdict", "proof", "residual"}, "start", frozenset({"bears"}))
        state = self._state(data["start"]["state"], boundary, "start.state")
        is_prop = np.arange(parts) >= parts - props
        if (is_prop & (state == INSTALLED)).any():
            self._fail("start.state has a prop that is neither there nor away")
        held = int(held_count(state[None], boundary | is_prop)[0])
        if held > robots:
            self._fail(f"start.state has {held} parts held with {robots} robots")
        residuals = [self._judged(data["start"], "start")]
        steps, actions = self._list(data["steps"], "steps"), []
        if (len(steps) + 1) * parts > MOST_ENTRIES:
            self._fail(f"it has {len(steps)} steps of {parts} parts", f"at most {MOST_ENTRIES} entries are read")
        states = np.empty((len(steps) + 1, parts), dtype=np.uint8)
        states[0] = state
        for number, step in enumerate(steps, 1):
            place = f"step {number}"
            self._keys(step, {"do", "part", "verdict", "proof", "residual"}, place, frozenset({"presses", "bears"}))
            word, part = step["do"], self._count(step["part"], f"{place}: part")
            if part >= parts:
                self._fail(f"{place} names part {part}, but parts are numbered 0 to {parts - 1}")
            if not isinstance(word, str) or word not in MOVES:
                self._fail(f"{place} does {word!r}", f"it must be one of {', '.join(MOVES)}")
            old, new = MOVES[Action(word)]
            above = REMOVED in (old, new)
            known = above if is_prop[part] else word != Action.REMOVE and (support or word != Action.HOLD)
            if not known:
                what = "a prop is inserted or removed" if is_prop[part] else "a plan inserts parts and releases them"
                self._fail(f"{place} does {word!r} with part {part}", what)
            if boundary[part] or state[part] != old:
                found = "boundary" if boundary[part] else ("removed", "installed", "held")[int(state[part])]
                self._fail(f"{place} cannot {word} part {part}, which is {found}")
            state[part] = new
            held += 0 if is_prop[part] else 1 if new == HELD else -1
            if held > robots:
                self._fail(f"{place} needs {held} robots, but the plan has {robots}")
            states[number] = state
            actions.append(part + parts * above)
            residuals.append(self._judged(step, place))
        if not np.array_equal(self._state(data["end"], boundary, "end"), state):
            self._fail("its steps do not lead to its end")
        return states, np.array(actions, dtype=np.int64), np.array(residuals)

    def _judged(self, record: dict[str, Any], place: str) -> float:
        """Return the residual of a state; nan where a plan whose replay fails has not proven it."""
        if self._falls and {name: record[name] for name in UNPROVEN} == UNPROVEN:
            return np.nan
        if (record["verdict"], record["proof"]) != ("stable", self._proof):
            found = f"{place} has verdict {record['verdict']!r} with proof {record['proof']!r}"
            self._fail(found, f"every state must be stable by {self._proof}")
        return self._number(record["residual"], f"{place}: residual")

    def _state(self, value: Any, boundary: NDArray[np.bool_], place: str) -> States:
        if not isinstance(value, list) or not all(type(entry) is int for entry in value):
            self._fail(f"{place} is not a list of 0, 1, 2")
        if len(value) != len(boundary):
            self._fail(f"{place} has {len(value)} values for {len(boundary)} parts")
        try:
            return as_states(value, boundary)[0]
        except StateError as error:
            self._fail(f"{place}: {error}")

    def _parts(self, value: Any, parts: int, place: str) -> list[int]:
        if not isinstance(value, list) or not all(type(part) is int and 0 <= part < parts for part in value):
            self._fail(f"{place} is not a list of part numbers from 0 to {parts - 1}")
        if len(set(value)) != len(value):
            self._fail(f"{place} names a part twice")
        return value

    def _holds(self, stability: dict[str, Any]) -> HoldSettings:
        contact, value = stability["criterion"] == "contact", stability.get("holds")
        if contact != ("holds" in stability):
            self._fail("stability.holds must be there under contact, and not under equilibrium")
        if value is None:
            return HoldSettings()
        self._keys(value, {"stiffness", "force", "moment", "mode"}, "stability.holds")
        numbers = {
            key: np.inf if value[key] is None else self._number(value[key], f"stability.holds.{key}")
            for key in ("stiffness", "force", "moment")
        }
        if value["mode"] not in tuple(HoldMode):
            self._fail(f"stability.holds.mode is {value['mode']!r}", f"it must be {', '.join(HoldMode)}")
        if numbers["stiffness"] == 0:
            self._fail("stability.holds.stiffness is 0", "it must be a positive number, or null for rigid holds")
        return HoldSettings(**numbers, mode=HoldMode(value["mode"]))

    def _presses(self, step: dict[str, Any], number: int, parts: int) -> tuple[Press, ...]:
        """Read the presses of a step; whether robots hold these parts is for the check."""
        found = []
        for entry in self._list(step.get("presses", []), f"step {number}: presses"):
            place = f"step {number}: presses"
            self._keys(entry, {"part", "wrench"}, place)
            part, wrench = self._count(entry["part"], f"{place}: part"), self._list(entry["wrench"], f"{place}: wrench")
            if part >= parts:
                self._fail(f"{place} name part {part}, but parts are numbered 0 to {parts - 1}")
            if len(wrench) != 6 or not all(type(x) in (int, float) and math.isfinite(x) for x in wrench):
                self._fail(f"{place} have the wrench {wrench!r}", "it must be six finite numbers, N and N m")
            found.append(Press(part, tuple(map(float, wrench))))
        return tuple(found)

    def _loads(self, record: dict[str, Any], number: int, parts: int) -> tuple[HoldLoad, ...]:
        """Read what robots bear in a state; whether they hold these parts is for the check."""
        found, place = [], f"step {number}: bears" if number else "start.bears"
        for entry in self._list(record.get("bears", []), place):
            self._keys(entry, {"part", "force", "moment"}, place)
            part = self._count(entry["part"], f"{place}: part")
            if part >= parts:
                self._fail(f"{place} names part {part}, but parts are numbered 0 to {parts - 1}")
            if any(load.part == part for load in found):
                self._fail(f"{place} names part {part} twice")
            sizes = [self._number(entry[name], f"{place}: {name}") for name in ("force", "moment")]
            found.append(HoldLoad(part, *sizes))
        return tuple(found)

    def _displacements(self, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the displacements in the increments of all steps, shape (states, increments, parts, 6)."""
        name, (states, parts) = "displacements", shape
        self._keys(value, {"parts", "increments", WHOLE}, name)
        increments = self._count(value["increments"], f"{name}.increments", least=1)
        if increments > MOST_INCREMENTS:
            self._fail(f"{name}.increments is {increments}", f"at most {MOST_INCREMENTS} are read")
        if self._count(value["parts"], f"{name}.parts") != parts:
            self._fail(f"{name}.parts is {value['parts']!r}", f"the plan has {parts} parts; plan again")
        flat = self._packed(
            {"parts": parts * increments, WHOLE: value[WHOLE]}, name, "parts", (states, parts * increments)
        )
        return np.asarray(flat).reshape(states, increments, parts, 6)

    def _replay(self, value: Any, parts: int, states: int) -> PlanReplay:
        self._keys(value, {"stands", "moved", "part", "falls_at"}, "replay", optional=_REPLAY)
        stands, part, falls_at = value["stands"], value["part"], value["falls_at"]
        if not isinstance(stands, bool) or stands != (falls_at is None):
            self._fail("replay.stands must be true, with no falls_at, or false, with one")
        if type(part) is not int or not -1 <= part < parts:
            self._fail(f"replay.part is {part!r}", f"it must be a part number below {parts}, or -1")
        if falls_at is not None and self._count(falls_at, "replay.falls_at") >= states:
            self._fail(f"replay.falls_at is {falls_at}", f"the plan has {states} states")
        if not isinstance(value.get("varied", False), bool):
            self._fail("replay.varied must be true or false")
        moved = self._number(value["moved"], "replay.moved")
        try:
            judgement = Judgement.read(value["judgement"], states, parts) if "judgement" in value else None
        except InputError as error:
            self._fail(f"replay.judgement: {error}")
        return PlanReplay(stands, moved, part, falls_at, varied=value.get("varied", False), judgement=judgement)

    def _packed(self, value: Any, name: str, counted: str, shape: tuple[int, ...]) -> NDArray[np.float64] | StateArrays:
        """Return the proofs of all states, of so many states and parts: forces of points, or displacements of parts."""
        entry = CHANGES if isinstance(value, dict) and CHANGES in value and name == "forces" else WHOLE
        self._keys(value, {counted, entry}, name)
        (states, parts), count = shape, self._count(value[counted], f"{name}.{counted}")
        what = f"{name} of {count} {counted} for each of {states} states"
        if counted == "parts" and count != parts:
            self._fail(f"{name}.{entry} does not hold {what}", f"the plan has {parts} parts; plan again")
        try:
            found = unpack_proofs(entry, value[entry], (states, count, 6 if name == "displacements" else 3), what)
        except ValueError as error:
            self._fail(f"{name}.{entry} {error}")
        return found[::-1].copy() if self._backwards else found

    def _number(self, value: Any, place: str) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value < 0:
            self._fail(f"{place} is {value!r}", "it must be a number from 0 on")
        return float(value)

    def _count(self, value: Any, place: str, least: int = 0) -> int:
        if type(value) is not int or value < least:
            self._fail(f"{place} is {value!r}", f"it must be a whole number from {least} on")
        return value

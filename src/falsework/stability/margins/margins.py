"""Margins of states of a structure under the criterion of its oracle."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import INSTALLED, REMOVED, States, as_states
from falsework.errors import InputError
from falsework.stability.cpu.solver import TASK
from falsework.stability.margins.brackets import ACCURACY, GROWTH, Bracket, Interval, largest
from falsework.stability.margins.conditions import Answer, Condition, OutOfTime
from falsework.stability.margins.prober import Prober
from falsework.stability.margins.pushes import Pushes
from falsework.stability.margins.state_margins import Bound, StateMargins, triple
from falsework.stability.margins.supports import held_loads, settlements
from falsework.stability.margins.weakest import Near, Weakest, friction_bracket
from falsework.stability.strength import SMOOTH, strength_of
from falsework.stability.verdict import Verdict, Verdicts
from falsework.utils.quantity import check_deadline

if TYPE_CHECKING:
    from falsework.stability.contact.history import History

Array = NDArray[np.float64]

QUICK = ("friction", "tilt", "horizontal", "load_factor", "push", "held")
"""Margins that are computed by default: one probe per part, face or direction."""
KINDS = (*QUICK, "polygon", "settlement")

DIRECTIONS = 36
"""Number of horizontal directions, of which the worst counts."""
LARGEST_SHARE = 10.0
"""Horizontal acceleration in shares of gravity, or push in weights of the structure, beyond which there is no bound: a
tilt of 84 degrees."""
LARGEST_FACTOR = 100.0
"""Factor on a weight beyond which there is no bound."""


class MarginFinder:
    """Finder of the margins of states of one structure; it may be used from several threads."""

    def __init__(self, prober: Prober) -> None:
        """Take the structure and its criterion from a prober."""
        self.prober = prober
        self._assembly = prober.assembly
        self._parts = prober.assembly.part_count
        self.weights = prober.settings.gravity * prober.assembly.mass.mass
        angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        self.directions = np.stack([np.cos(angle), np.sin(angle), np.zeros(DIRECTIONS)], axis=1)
        self.sideways = self.weights[None, :, None] * np.pad(self.directions, ((0, 0), (0, 3)))[:, None, :]
        """Weights of all parts along each direction, N, shape (directions, parts, 6)."""

    @cached_property
    def pushes(self) -> Pushes:
        """Faces of the parts that a gripper can push on."""
        return Pushes.from_assembly(self._assembly)

    def margins(
        self,
        states: ArrayLike,
        kinds: Sequence[str] = QUICK,
        *,
        deadline: float | None = None,
        histories: Sequence[History] = (),
    ) -> list[StateMargins]:
        """Return the margins of states, computed in parallel on all cores; as `StabilityOracle.margins`.

        After the deadline, verdicts of the unmodified states, and one probe a core, may still be found.
        """
        for kind in kinds:
            if kind not in KINDS:
                raise InputError(f"unknown margin {kind!r}; choose among {', '.join(KINDS)}")
        if "settlement" in kinds and not self.prober.displaced:
            raise InputError("the criterion equilibrium has no displacements; compute settlement under contact")
        check_deadline(deadline)
        batch = as_states(states, self._assembly.boundary)
        assert self.pushes is not None  # computed once, before copies and threads share it
        limited = self if deadline is None else self._with(self.prober.until(time.perf_counter() + deadline))
        return limited._all(batch, kinds, histories)

    def _with(self, prober: Prober) -> MarginFinder:
        """Return a finder that shares all but the prober."""
        finder = copy(self)
        finder.prober = prober
        return finder

    def _all(self, batch: States, kinds: Sequence[str], histories: Sequence[History]) -> list[StateMargins]:
        finders = [self._with(self.prober.as_built(history)) for history in histories] or [self] * len(batch)

        def begin(finder: MarginFinder, state: States) -> Answer:
            prober = finder.prober.until(np.inf)
            return prober.ask(state, prober.own())

        with ThreadPoolExecutor(self.prober.settings.numerics.threads) as pool:
            starts = list(pool.map(begin, finders, batch))
            found = [StateMargins(start.stands, tuple(kinds)) for start in starts]

            def run(job: tuple[int, str]) -> list[StateMargins]:
                """Compute one margin of consecutive states: each search starts at the bound of the state before."""
                near: Near = {}
                rows = range(job[0], min(job[0] + TASK, len(batch)))
                return [finders[row]._in_time(batch[row], starts[row], job[1], kinds, near) for row in rows]

            jobs = [(first, kind) for first in range(0, len(batch), TASK) for kind in kinds]
            for (first, _), parts in zip(jobs, pool.map(run, jobs), strict=True):
                for row, part in enumerate(parts, first):
                    given = {name: value for name, value in vars(part).items() if value is not None and np.size(value)}
                    given["unfinished"] = (*found[row].unfinished, *part.unfinished)
                    found[row] = replace(found[row], **given)
        return found

    def _in_time(self, state: States, start: Answer, kind: str, kinds: Sequence[str], near: Near) -> StateMargins:
        """Return one margin of a state as `_one` does, with a note if the deadline cut it short."""
        try:
            found = self._one(state, start, kind, kinds, near)
        except OutOfTime:
            return StateMargins(start.stands, unfinished=(kind,))
        cut = tuple(name for name, value in vars(found).items() if isinstance(value, Bound) and not value.finished)
        return replace(found, unfinished=cut)

    def _one(self, state: States, start: Answer, kind: str, kinds: Sequence[str], near: Near) -> StateMargins:
        """Return one margin of a state, and those that come with it; `near` has the bounds of the state before."""
        if not start.stands:
            return self._fallen(state, kinds) if kind == kinds[0] else StateMargins(False)
        compute: dict[str, Callable[[], dict[str, Any]]] = {
            "friction": lambda: {"friction": self._friction(state, start, near)},
            "tilt": lambda: {} if "horizontal" in kinds else self._sideways(state, start, kinds, near),
            "horizontal": lambda: self._sideways(state, start, kinds, near),
            "load_factor": lambda: {
                "load_factor": self._load_factor(state, start, near),
                "total_load_factor": self._total_factor(state, start),
            },
            "push": lambda: {"push": self._push(state, start, near)},
            "held": lambda: {"held": held_loads(self.prober, state, start)},
            "polygon": lambda: {"polygon": self._polygon(state, start)},
            "settlement": lambda: {"settlement": settlements(self.prober, state, start)},
        }
        return StateMargins(True, **compute[kind]())

    def _fallen(self, state: States, kinds: Sequence[str]) -> StateMargins:
        """Return the least friction of a state that is not stable, if more friction helps, and no other margins."""
        if "friction" not in kinds:
            return StateMargins(False)
        prober, own = self.prober, self._assembly.friction
        start = low = prober.ask(state, prober.own())
        high = max(own, SMOOTH)
        while (high := 2 * high) <= GROWTH * max(1.0, own):
            answer = prober.ask(state, Condition(high, prober.own().extra))
            if answer.stands:
                break
            low = answer
        else:
            return StateMargins(False)

        def ask(inverse: float, near: Answer) -> Answer:
            return prober.ask(state, Condition(1.0 / inverse, start.condition.extra), near)

        cap = 1.0 / max(low.condition.friction, SMOOTH)
        found = largest(ask, Interval(answer, guess=1.0 / high, low=1.0 / high, cap=cap, known=(cap, low)))
        turned = replace(found, inside=1.0 / found.inside, outside=(found.fails or low).condition.friction)
        return StateMargins(False, friction=self._bound(state, turned, start.condition.at_friction, always=True))

    def _friction(self, state: States, start: Answer, near: Near) -> Bound | None:
        bracket = friction_bracket(self.prober, state, start, near)
        return None if bracket is None else self._bound(state, bracket, start.condition.at_friction, always=True)

    def _sideways(self, state: States, start: Answer, kinds: Sequence[str], near: Near) -> dict[str, Bound]:
        """Return the largest tilt and the largest horizontal acceleration in the worst direction, where requested."""
        order = sorted(range(DIRECTIONS), key=lambda row: (row % 9 != 0) + (row % 3 != 0))
        guess, loads = max(self._assembly.friction, 0.1), self.sideways
        row, bracket = self._weakest(state, start, loads, order, lambda _: guess, LARGEST_SHARE, near=near)
        found: dict[str, Bound] = {}
        if "horizontal" in kinds:
            times = self._times(start.condition, loads[row])
            found["horizontal"] = self._bound(state, bracket, times, direction=triple(self.directions[row]))
        if "tilt" not in kinds:
            return found
        if self.prober.scales:
            # Weight with a horizontal acceleration `a g` is the weight on ground tilted by atan(a), times a factor;
            # forces, displacements and velocities that prove one prove the other after scaling by that factor.
            tilted = Bracket(
                float(np.arctan(bracket.inside)),
                self._tilted(bracket.stands, row, bracket.inside),
                None if bracket.outside is None else float(np.arctan(bracket.outside)),
                None if bracket.fails is None else self._tilted(bracket.fails, row, bracket.outside or 0.0),
                bracket.monotone,
                bracket.finished,
            )
        else:  # other loads keep their direction
            angle, cap = float(np.arctan(guess)), float(np.arctan(LARGEST_SHARE))
            under = partial(self._tilted_condition, start.condition)
            weakest = Weakest(self.prober, state, start, under, order, guess=lambda _: angle, cap=cap).find()
            assert weakest is not None  # there are directions
            row, tilted = weakest
        tilts = partial(self._tilted_condition, start.condition, row)
        found["tilt"] = self._bound(state, tilted, tilts, direction=triple(self.directions[row]))
        return found

    def tilt_load(self, row: int, angle: float) -> Array:
        """Return the wrenches that a tilt adds to the weights, N, shape (parts, 6)."""
        turned = np.sin(angle) * self.directions[row] + np.array([0.0, 0.0, 1.0 - np.cos(angle)])
        return self.weights[:, None] * np.pad(turned, (0, 3))

    def _tilted(self, answer: Answer, row: int, share: float) -> Answer:
        angle = np.arctan(share)
        factor = float(np.cos(angle))
        return replace(
            answer,
            condition=Condition(answer.condition.friction, self.tilt_load(row, angle)),
            forces=None if answer.forces is None else factor * answer.forces,
            displacement=None if answer.displacement is None else factor * answer.displacement,
        )

    def _weakest(
        self,
        state: States,
        start: Answer,
        loads: Array,
        order: Sequence[int],
        guess: Callable[[int], float],
        cap: float,
        **options: Any,
    ) -> tuple[int, Bracket]:
        """Return the load with the least largest multiple, and its bracket; -1 without loads. See `Weakest`."""
        friction = start.condition.friction
        found = Weakest(
            self.prober,
            state,
            start,
            lambda row, value: Condition(friction, value * loads[row]),
            order,
            guess=guess,
            cap=cap,
            loads=loads,
            **options,
        ).find()
        return found or (-1, Bracket(0.0, start, None, None))

    def _polygon(self, state: States, start: Answer) -> Array:
        guess, limits = max(self._assembly.friction, 0.1), np.full(DIRECTIONS, np.inf)
        for row in range(DIRECTIONS):
            load = self.sideways[row : row + 1]
            _, bracket = self._weakest(state, start, load, [0], lambda _, guess=guess: guess, LARGEST_SHARE)
            if not bracket.finished:
                raise OutOfTime
            if bracket.outside is not None:
                limits[row] = guess = bracket.inside
        return np.arctan(limits)

    def _load_factor(self, state: States, start: Answer, near: Near) -> Bound:
        installed = np.flatnonzero(state == INSTALLED)
        loads = np.zeros((len(installed), self._parts, 6))
        loads[np.arange(len(installed)), installed, 2] = -self.weights[installed]
        order = np.argsort(-self.weights[installed], kind="stable").tolist()
        numbers = installed.tolist()
        cap = LARGEST_FACTOR - 1.0
        row, bracket = self._weakest(state, start, loads, order, lambda _: 1.0, cap, near=near, numbers=numbers)
        if row < 0:
            return self._unbounded(state, start)
        times = self._times(start.condition, loads[row])
        return self._bound(state, bracket, times, shift=1.0, part=numbers[row], direction=(0.0, 0.0, -1.0))

    def _total_factor(self, state: States, start: Answer) -> Bound:
        if self.prober.scales:
            return self._unbounded(state, start)
        load = np.where((state != REMOVED)[:, None], self.weights[:, None] * np.array([0, 0, -1.0, 0, 0, 0]), 0.0)
        _, bracket = self._weakest(state, start, load[None], [0], lambda _: 1.0, LARGEST_FACTOR - 1.0)
        return self._bound(state, bracket, self._times(start.condition, load), shift=1.0)

    def _push(self, state: States, start: Answer, near: Near) -> Bound:
        pushes = self.pushes
        rows = pushes.exposed(state)
        # A part slips at about the push that exceeds the friction limit of its contacts.
        grip = np.maximum(self._grip(state, start)[pushes.part[rows]], 0.1 * self.weights[pushes.part[rows]])
        order = np.argsort(grip, kind="stable").tolist()
        cap = LARGEST_SHARE * self.prober.problem.weight
        loads = pushes.loads(rows, self._parts)
        numbers = rows.tolist()
        weakest, bracket = self._weakest(
            state, start, loads, order, lambda row: float(grip[row]), cap, near=near, numbers=numbers
        )
        if weakest < 0:
            return self._unbounded(state, start)
        row, times = numbers[weakest], self._times(start.condition, loads[weakest])
        direction = triple(pushes.normal[row])
        return self._bound(state, bracket, times, part=int(pushes.part[row]), direction=direction)

    def _grip(self, state: States, start: Answer) -> Array:
        """Return the sum of the friction limits at the contacts of each part, N, shape (parts,)."""
        assembly, forces = self._assembly, self.prober.forces(state, start)
        limit = np.maximum(strength_of(assembly).friction * forces[:, 0], 0.0)
        ends = assembly.contacts.parts[assembly.contacts.contact_of_point]
        total = np.zeros(self._parts)
        np.add.at(total, ends, limit[:, None])
        return total

    def _unbounded(self, state: States, start: Answer) -> Bound:
        """Return a margin without bound for want of loads, with the proof of the unmodified state."""
        return self._bound(state, Bracket(0.0, start, None, None), lambda _: start.condition)

    @staticmethod
    def _times(condition: Condition, load: Array) -> Callable[[float], Condition]:
        return lambda value: Condition(condition.friction, value * load)

    def _tilted_condition(self, condition: Condition, row: int, angle: float) -> Condition:
        return Condition(condition.friction, self.tilt_load(row, angle))

    def _bound(
        self,
        state: States,
        bracket: Bracket,
        beyond: Callable[[float], Condition],
        *,
        shift: float = 0.0,
        part: int | None = None,
        direction: tuple[float, float, float] | None = None,
        always: bool = False,
    ) -> Bound:
        """Certify both ends of a bracket; a bracket without an outer end has no bound, unless `always`.

        Args:
            state: shape (parts,).
            beyond: the family, for a value further outside where a proof may exist.
            shift: offset of the reported values.
            part, direction: those of the weakest load.
            always: whether the family has a bound even without an outer end, as friction has at zero.
        """
        fails, outside = bracket.fails if bracket.finished else None, bracket.outside
        known = outside is not None or always or not bracket.finished
        inside = self.prober.certify(state, bracket.stands)
        proof = None if fails is None else self.prober.certify(state, fails, inside)
        if fails is not None and proof is not None and not _fails(proof):
            # Close to the bound neither side may be provable; try at the largest distance that a bracket may span.
            share = 1.0 - ACCURACY if always else 1.0 + ACCURACY
            condition = beyond(share * bracket.inside)
            if fails.reached is None:
                again = self.prober.ask(state, condition)
            else:
                again = self.prober.refine(state, replace(fails, condition=condition))
            second = proof if again.stands else self.prober.certify(state, again, inside)
            if _fails(second):
                fails, outside, proof = again, share * bracket.inside, second
        return Bound(
            value=float(bracket.inside) + shift if known else None,
            outside=None if outside is None else float(outside) + shift,
            inside_proof=inside,
            outside_proof=proof,
            inside_condition=bracket.stands.condition,
            outside_condition=None if fails is None else fails.condition,
            monotone=bracket.monotone,
            part=part if known and bracket.finished else None,
            direction=direction if known and bracket.finished else None,
            finished=bracket.finished,
        )


def _fails(verdicts: Verdicts) -> bool:
    """Return whether a verdict proves that the state is not stable."""
    return bool(verdicts.verdict[0] in (Verdict.UNSTABLE, Verdict.SLIDES))

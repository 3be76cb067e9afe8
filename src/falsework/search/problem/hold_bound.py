"""Lower bound on the robots of every plan, from necessary conditions on its first and its last steps.

Just after a part is removed, one robot has nothing to hold, so a plan with `n` robots leads through sets of present
parts that `n - 1` held parts, chosen at will, keep in equilibrium. Which parts were held before and after does not
matter here, and no state that stands under the criterion `contact` is out of equilibrium, so what is refuted this way
is refuted under both criteria.

Two kinds of sets are looked at: all sets near either end of the orders, one part after the other, and the sets within a
core: parts that fall wherever `n - 1` others of the core are held, with the whole rest of the structure held as well. A
motion that proves that they fall leaves the rest still, so it proves the same whatever is there of the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.search.problem.deadline import PIECE, Deadline
from falsework.search.problem.task import Direction, Task
from falsework.stability.certificate import residual_bound_of_velocity
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.quantity import listed


class _BudgetSpent(Exception):
    """The verdicts granted to a bound are used up."""


@dataclass(frozen=True)
class Barrier:
    """Sets of parts that every order has to cross, and that too few robots cannot."""

    robots: int
    """Number of robots with which no plan exists."""
    parts: int
    """Parts removed, or placed, after which no set of parts is left that can be kept in equilibrium."""
    end: Direction
    """Disassembly: the first `parts` removals; assembly: the first `parts` insertions."""
    core: tuple[int, ...] = ()
    """Parts among which `parts` are counted, whatever is there of the others; empty where all count."""

    @property
    def text(self) -> str:
        """The same in words."""
        moved = "removed" if self.end is Direction.DISASSEMBLY else "placed"
        held = f"at most {self.robots - 1} held" if self.robots > 1 else "none held"
        if self.core:
            some = f"the {len(self.core)} parts {listed([str(part) for part in self.core])}"
            counted = f"{self.parts if self.parts > 1 else 'one'} of {some}"
            return f"no state with {counted} {moved} and {held} is in equilibrium, whichever others are there"
        counted = f"{self.parts} parts" if self.parts > 1 else "one part"
        return f"no state with {counted} {moved} and {held} is in equilibrium"

    def to_dict(self) -> dict[str, Any]:
        """Return the barrier as a JSON object."""
        barrier = {"robots": self.robots, "parts": self.parts, "end": self.end.value, "text": self.text}
        return barrier | ({"core": list(self.core)} if self.core else {})


class HoldBound:
    """Refutation of numbers of robots by the sets of parts that each order crosses near its two ends."""

    def __init__(self, assembly: Assembly, task: Task, settings: StabilitySettings, clock: Deadline) -> None:
        """Prepare to refute.

        Args:
            assembly: the structure.
            task: start, target, fixed parts and clearance; its number of robots does not matter.
            settings: of the plan; the friction cone, gravity, tolerances and reserve are taken over.
            clock: raises `DeadlineExceeded` out of `barrier` once it has run out.
        """
        self.task = task
        self.asked = self._stop_at = 0
        """Verdicts requested, and those after which a bound gives up."""
        same = {name: getattr(settings, name) for name in ("gravity", "tolerance", "force_bound", "reserve")}
        equilibrium = StabilitySettings(criterion="equilibrium", cone=settings.friction_cone, **same)
        if assembly.joints is not None:  # those that set bear less before
            assembly = assembly.replace(joints=assembly.joints.fully_set())
        self._oracle = StabilityOracle(assembly, equilibrium)
        self._clock = clock
        fixed = np.zeros(task.part_count, dtype=bool)
        fixed[list(task.fixed)] = True
        self._touched = ~task.boundary & ~fixed
        # With holding again, what stays in the end may be held on the way.
        self._holdable = self._touched & (task.allow_regrasp | (task.target != INSTALLED))
        self._removable = (task.start != REMOVED) & (task.target == REMOVED)
        self._known: dict[tuple[bytes, int], bool] = {}
        self._cores: dict[int, tuple[int, ...]] = {}
        self._beside = np.zeros((task.part_count, task.part_count), dtype=bool)
        a, b = assembly.contacts.parts.T
        self._beside[a, b] = self._beside[b, a] = True

    def barrier(self, robots: int, budget: int) -> Barrier | None:
        """Look for a number of removed or placed parts at which no plan with so many robots passes.

        Args:
            robots: number to refute.
            budget: verdicts after which it gives up near the ends; a core takes a few verdicts for each part.

        Returns:
            None where none was found.

        Raises:
            DeadlineExceeded: the clock ran out.
        """
        self._stop_at = self.asked + budget
        try:
            barrier = self._near_the_ends(robots)
        except _BudgetSpent:
            barrier = None
        return barrier or self.core_barrier(robots)

    def core_barrier(self, robots: int) -> Barrier | None:
        """Return the barrier of a core alone, which takes seconds where the sets near the ends take minutes.

        Raises:
            DeadlineExceeded: the clock ran out.
        """
        core = self.core(robots)
        return Barrier(robots, robots, Direction.ASSEMBLY, core) if core else None

    def _near_the_ends(self, robots: int) -> Barrier | None:
        """As `barrier`, among all parts.

        Raises:
            _BudgetSpent: the verdicts are used up.
        """
        ends = list(Direction)
        fronts = {end: self._bare(self.task.origin(end))[None] for end in ends}
        levels = dict.fromkeys(ends, 0)
        total = int(self._removable.sum())
        while sum(levels.values()) < total:
            end = min(ends, key=lambda side: len(fronts[side]))
            candidates = self._next(fronts[end], end)
            keep = [levels[end] == total - 1 or self._can_be_held(state, robots - 1) for state in candidates]
            fronts[end] = candidates[np.array(keep, dtype=bool)] if len(candidates) else candidates
            levels[end] += 1
            if not len(fronts[end]):
                return Barrier(robots, levels[end], end)
        return None

    def core(self, robots: int) -> tuple[int, ...]:
        """Return parts of which no plan with so many robots places more than `robots`; none where none were found.

        When one more of them comes in, `robots` of them are there and one robot has it in its hands, so at least one
        of those is held by none; it falls though all others are held, and all that are not of the core. Beginning
        with all parts, those that may stand so are left out until none does.

        Raises:
            DeadlineExceeded: the clock ran out.
        """
        if robots not in self._cores:
            core = self._removable & self._touched
            waiting = list(np.flatnonzero(core)[::-1])
            while waiting:
                part = waiting.pop()
                if core[part] and self._stands_beside(core, part, robots - 1):
                    core[part] = False
                    waiting += np.flatnonzero(core & self._beside[part]).tolist()
            self._cores[robots] = tuple(np.flatnonzero(core).tolist()) if core.sum() > robots else ()
        return self._cores[robots]

    def _stands_beside(self, core: Mask, part: int, holds: int) -> bool:
        """Return whether a part of a core may be in equilibrium beside some choice of `holds` held ones."""
        state = np.where(core, REMOVED, HELD).astype(np.uint8)
        state[part] = INSTALLED
        beside = np.flatnonzero(core & self._beside[part])
        choices = combinations(beside.tolist(), min(holds, len(beside)))
        while some := list(islice(choices, PIECE)):
            self._clock.check()
            rows = np.repeat(state[None], len(some), axis=0)
            for row, held in zip(rows, some, strict=True):
                row[list(held)] = HELD
            self.asked += len(rows)
            if not self._oracle.verdicts(rows, require_certificate=True).unstable.all():
                return True
        return False

    def _bare(self, state: States) -> States:
        """State with the same parts and nothing held but what always is."""
        return np.where((state == HELD) & self._touched, INSTALLED, state).astype(np.uint8)

    def _next(self, front: States, end: Direction) -> States:
        """Return the distinct sets with one part less, in assembly with one more, that the rules allow."""
        moves: Mask = self._removable & (front != REMOVED if end is Direction.DISASSEMBLY else front == REMOVED)
        if self.task.clearance is not None and self.task.moves_out == 1:  # else holds matter
            moves = moves & self.task.clearance.can_leave(front, moves)
        row, part = np.nonzero(moves)
        states = front[row]
        states[np.arange(len(row)), part] = REMOVED if end is Direction.DISASSEMBLY else INSTALLED
        return np.unique(states, axis=0)

    def _can_be_held(self, state: States, holds: int) -> bool:
        """Return whether some choice of `holds` more parts may keep a state in equilibrium; False is proven."""
        key = state.tobytes(), holds
        if key not in self._known:
            self._known[key] = self._some_hold(state[None], holds)
        return self._known[key]

    def _some_hold(self, states: States, holds: int) -> bool:
        """Return whether one of the states may be in equilibrium with `holds` more parts held."""
        for begin in range(0, len(states), PIECE):
            rows = states[begin : begin + PIECE]
            self._clock.check()
            if self.asked >= self._stop_at:
                raise _BudgetSpent
            verdicts = self._oracle.verdicts(rows, require_certificate=True)
            self.asked += len(rows)
            if not verdicts.unstable.all():
                return True
            if holds == 0:
                continue
            assert verdicts.velocity is not None
            for state, velocity in zip(rows, verdicts.velocity, strict=True):
                # Whatever is held among the parts that stay still, the same velocity proves the state unstable.
                moving = np.flatnonzero(self._moving(state, velocity) & self._holdable)
                more = np.repeat(state[None], len(moving), axis=0)
                more[np.arange(len(moving)), moving] = HELD
                if self._some_hold(more, holds - 1):
                    return True
        return False

    def _moving(self, state: States, velocity: NDArray[np.float64]) -> Mask:
        """Return the parts that move in a proof of instability, without those whose motion is negligible."""
        free = state == INSTALLED
        speed = np.where(free, np.abs(velocity).max(axis=1), 0.0)
        claim, assembly = self._oracle.settings.claim, self._oracle.assembly
        # Speeds below such a share of the fastest part's are taken as zero, where what is left is a proof as well.
        for share in (claim.tolerance / 10, claim.tolerance**2):
            moving = speed > share * speed.max()
            kept = np.where(moving[:, None], velocity, 0.0)
            if residual_bound_of_velocity(assembly, state[None], kept[None], claim)[0] > claim.tolerance:
                return moving
        return free

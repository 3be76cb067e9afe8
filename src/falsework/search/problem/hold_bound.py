"""Lower bound on the robots of every plan, from parts that no order can bring together.

Just before a part is placed, or after it is removed, one robot has nothing to hold, so a plan with `n` robots leads
through sets of present parts that `n - 1` held parts, chosen at will, keep in equilibrium. In a core, a part falls
wherever `n - 1` others of the core are held, with the whole rest of the structure held as well. A motion that proves
that it falls leaves the rest still, so it proves the same whatever is there of the rest. No state that stands under the
criterion `contact` is out of equilibrium, so what is refuted this way is refuted under both criteria.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, islice
from typing import Any

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.task import Task
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.interruption import PIECE
from falsework.utils.quantity import listed


@dataclass(frozen=True)
class Barrier:
    """Parts of which every order places more than too few robots can."""

    robots: int
    """Number of robots with which no plan exists."""
    core: tuple[int, ...]
    """Parts, of which no state has `robots` with one robot free, whatever is there of the others."""
    names: tuple[str, ...]
    """Names of those parts."""

    @property
    def text(self) -> str:
        """The same in words."""
        held = f"at most {self.robots - 1} held" if self.robots > 1 else "none held"
        some = f"the {len(self.core)} parts {listed(list(self.names))}"
        counted = f"{self.robots if self.robots > 1 else 'one'} of {some}"
        return f"no state with {counted} placed and {held} is in equilibrium, whichever others are there"

    def to_dict(self) -> dict[str, Any]:
        """Return the barrier as a JSON object."""
        return {"robots": self.robots, "text": self.text, "core": list(self.core)}


class HoldBound:
    """Refutation of numbers of robots by cores."""

    def __init__(self, assembly: Assembly, task: Task, settings: StabilitySettings, clock: Deadline) -> None:
        """Prepare to refute.

        Args:
            task: start, target and fixed parts; its number of robots does not matter.
            settings: of the plan; the friction cone, gravity, tolerances and reserve are taken over.
            clock: raises `DeadlineExceeded` out of `barrier` once it has run out.
        """
        self.asked = 0
        """Verdicts requested."""
        same = {name: getattr(settings, name) for name in ("gravity", "tolerance", "force_bound", "reserve")}
        equilibrium = StabilitySettings(criterion="equilibrium", cone=settings.friction_cone, **same)
        if assembly.joints is not None:  # those that set bear less before
            assembly = assembly.replace(joints=assembly.joints.fully_set())
        self._oracle = StabilityOracle(assembly, equilibrium)
        self._clock = clock
        fixed = np.zeros(task.part_count, dtype=bool)
        fixed[list(task.fixed)] = True
        self._touched = ~task.boundary & ~fixed
        self._removable = (task.start != REMOVED) & (task.target == REMOVED)
        self._cores: dict[int, tuple[int, ...]] = {}
        self._beside = np.zeros((task.part_count, task.part_count), dtype=bool)
        a, b = assembly.contacts.parts.T
        self._beside[a, b] = self._beside[b, a] = True

    def barrier(self, robots: int) -> Barrier | None:
        """Return the barrier of the core for so many robots; None where there is none.

        Raises:
            DeadlineExceeded: the clock ran out.
        """
        core = self.core(robots)
        names = tuple(self._oracle.assembly.names[part] for part in core)
        return Barrier(robots, core, names) if core else None

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
            left = {part: self._holds_beside(core, part, robots - 1) for part in np.flatnonzero(core).tolist()}
            while left:
                for part in self._standing(core, left):
                    core[part] = False
                    del left[part]
                    beside = np.flatnonzero(core & self._beside[part]).tolist()
                    for other in beside:  # moved to the end, so tried next: what it touches now is held
                        left.pop(other, None)
                        left[other] = self._holds_beside(core, other, robots - 1)
            self._cores[robots] = tuple(np.flatnonzero(core).tolist()) if core.sum() > robots else ()
        return self._cores[robots]

    def _holds_beside(self, core: Mask, part: int, holds: int) -> Iterator[tuple[int, ...]]:
        """Yield the choices of up to `holds` parts of a core that are held beside one of them."""
        beside = np.flatnonzero(core & self._beside[part]).tolist()
        return combinations(beside, min(holds, len(beside)))

    def _standing(self, core: Mask, left: dict[int, Iterator[tuple[int, ...]]]) -> list[int]:
        """Return some parts of a core that may be in equilibrium beside their next choice of held ones.

        Args:
            core: shape (parts,).
            left: choices of held parts that are left to try; parts without are dropped.
        """
        parts, rows = list[int](), list[States]()
        for part in list(islice(reversed(left), 4 * PIECE)):
            held = next(left[part], None)
            if held is None:
                del left[part]
                continue
            rows.append(np.where(core, REMOVED, HELD).astype(np.uint8))
            rows[-1][list(held)], rows[-1][part] = HELD, INSTALLED
            parts.append(part)
        if not parts:
            return []
        self._clock.check()
        self.asked += len(parts)
        found = self._oracle.verdicts(np.array(rows), require_certificate=True)
        return [part for part, falls in zip(parts, found.unstable, strict=True) if not falls]

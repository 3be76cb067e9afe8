"""Large-neighbourhood search for the order of the steps of a plan in which the makespan is least, and for their arms.

A neighbourhood is a window of the order. Its steps are searched again by a narrow beam: an arm may take its own parts
in another order, and parts of other arms; all else stays in its order. Windows are searched until none leads to a
better order. Then one at random leads to a slightly worse order, from which windows nearby are searched (iterated local
search, after Lourenço, Martin and Stützle 2003).

Whatever fails is excluded for the rest of the search: a state without a stable verdict, the last steps of an order
whose replay ends early, and a step for which there is no motion in some state. Waits are those of a schedule in which
of two motions in conflict the earlier in the order of disassembly goes first, as the plan is executed.
"""

from __future__ import annotations

import itertools
from bisect import insort
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from falsework.assembly.state import States
from falsework.robots.interleaving.orders import NextSteps, Partial, UnitStep, beginning, expected, extended
from falsework.robots.interleaving.work import Unit, Work
from falsework.robots.keyframes.keyframes import Edge, Node, state_after
from falsework.search.plans.acceptance import Acceptance
from falsework.stability.oracle import StabilityOracle

_WIDTH = 4
"""Beam width for each arm."""
_LENGTHS = (10, 14, 8, 12, 18)
"""Steps of windows, in turn: in longer ones the beam is too narrow."""
_CHOICES = 4
"""Next parts of its own that an arm chooses from; half as many of other arms."""
_SAME = 2
"""Partial orders of the same steps that are kept."""
_ENDS = 4
"""Orders of a window that are continued to the end of the plan; and searches of it, where none of them stands."""
_WORSE = 0.02
"""Share by which an order may be worse for better ones to be searched from it."""
_TOTAL = 0.01
"""Weight of the total time in the comparison of complete orders, which decides between those with equal makespan."""

Order = tuple[float, list[Unit], list[Partial]]
"""Cost, units and beginnings of an order."""
Signature = tuple[tuple[int, int, int], ...]
"""Jobs of an order with the places in them, and the robots."""


class OrderSearch:
    """Search for an order of the steps of one plan."""

    def __init__(
        self,
        work: Work,
        oracle: StabilityOracle,
        root: Node,
        chain: Sequence[Edge],
        *,
        legal: Callable[[States], Sequence[int]],
        stop: Callable[[], bool],
        builds: bool = False,
    ) -> None:
        """Prepare the search, as `reorder` takes its arguments."""
        self.builds = builds
        self.work, self.graph = work, work.graph
        self.root, self.legal, self.stop = root, legal, stop
        self.parts = len(root.state)
        self.units = work.units(root, chain)
        """Of each job the unit that does it in the best order."""
        self.next = NextSteps(work, oracle, self.units, legal)
        for edge in chain:  # the replay of the plan decides on its states, even those that would slide from rest
            self.next.know(edge.node.state)
        self._acceptance = Acceptance(oracle.replayer)
        """Replays of orders, in which robots press where it is needed, whatever they did in the plan."""
        self.fallen: set[tuple[int, ...]] = set()
        """Last actions of orders that end the replay in assembly order, which carries forces from state to state."""
        holds = [unit.seconds[0] for unit in self.units if unit.movable]
        self._hold = sum(holds) / max(len(holds), 1)
        self._width = _WIDTH * len(root.configurations)
        self.best: list[Partial] = []
        """Beginnings of the best order, from none of its steps to all of them."""
        self._begin_with(self._as_planned(chain))
        self._planned = self.order
        self._record = self.cost
        """Cost of the best order whose replay succeeds."""
        self._futile: dict[Signature, set[tuple[float, ...]]] = {}
        """Of each order that was the best one, the windows that led to no other order."""

    def _as_planned(self, chain: Sequence[Edge]) -> list[UnitStep]:
        place_of = {edge: (unit, k) for unit in self.units for k, edge in enumerate(unit.edges)}
        last: dict[int, Unit] = {}
        steps = []
        for edge in chain:
            unit, place = place_of[edge]
            steps.append(UnitStep(unit, place, tuple(variants[0] for variants in unit.legs[place])))
            if place == 0 and unit.approaches and unit.legs[0] and unit.legs[0][0][0].segment.kind == "free":
                self.next.add_approach(last.get(unit.robot), unit)
            last[unit.robot] = unit
        return steps

    def _begin_with(self, steps: Sequence[UnitStep]) -> None:
        """Let an order be the best one."""
        for step in steps:
            self.units[step.unit.job] = step.unit
        first = beginning(self.work, self.root, self.units)
        self.best = list(itertools.accumulate(steps, self._extended, initial=first))

    def _extended(self, partial: Partial, step: UnitStep) -> Partial:
        return extended(self.work, partial, step, self.units[step.unit.job], builds=self.builds)

    def run(self, seed: int = 0) -> None:
        """Find a better order, with a seed of the windows that lead to worse orders."""
        rng, steps = np.random.default_rng(seed), len(self.best) - 1
        windows = [(first, size) for size in _LENGTHS for first in range(max(steps - size, 1))]
        self.improve(0, steps, own=1, others=0)  # first the sequences of the arms are merged, each as it is
        self._descend(0, steps)
        best = self.order
        since, left = 0, rng.permutation(windows).tolist()
        while left and since < len(self.units) and not self.stop():
            first, size = left.pop()
            if not self.improve(first, size, worse=_WORSE):
                continue
            since += 1
            self._descend(first - size, first + 2 * size)
            if self.cost < best[0]:
                best, since, left = self.order, 0, rng.permutation(windows).tolist()
            self.take(best)

    def _descend(self, first: int, last: int) -> None:
        """Search windows in a part of the order until none leads to a better one."""
        first, last, since = max(first, 0), min(last, len(self.best) - 1), 0
        for size in itertools.cycle(_LENGTHS):
            since += 1
            for k in range(first, max(last - size // 2, first + 1), size // 2):
                if self.stop():
                    return
                if self.improve(k, size):
                    since = 0
            if since == len(_LENGTHS):
                return

    def refuse(self, index: int) -> None:
        """Exclude a step of the best order in the state in which it is there, and go back to the order of the plan."""
        step, before = self.best[-1].steps[index], self.best[index].node
        self.next.refuse(step.unit, step.place, before.state.tobytes())
        for windows in self._futile.values():
            windows.clear()
        self.take(self._planned)

    @property
    def changed(self) -> bool:
        """Whether the best order is not that of the plan."""
        return self.best is not self._planned[2]

    @property
    def order(self) -> Order:
        """The best order, to go back to."""
        return self.cost, list(self.units), self.best

    def improve(
        self, first: int, size: int, *, own: int = _CHOICES, others: int = _CHOICES // 2, worse: float = 0.0
    ) -> bool:
        """Search some steps of the best order again; return whether another order was found.

        An order that was not the best one before may be `worse` by a share; by default it must be better.
        """
        last, cost = min(first + size, len(self.best) - 1), self.cost
        futile = self._futile.setdefault(_signature(self.best[-1]), set())
        window = (first, last, own, others, worse)
        if window in futile:
            return False
        limit = cost * (1 + worse) if worse else cost - 1e-6
        for _ in range(_ENDS):  # what does not stand is excluded, and the window searched again
            completed = [order for order in self.completed(first, last, own, others) if self.allows(order)]
            if worse:
                completed = [order for order in completed if _signature(order) not in self._futile]
            better = sorted((order for order in completed if _cost(order) < limit), key=_cost)
            for order in better:
                if self._stands(order):
                    self._begin_with(order.steps)
                    self._futile.setdefault(_signature(order), set())
                    return True
            if not better:
                break
        futile.add(window)
        return False

    @property
    def cost(self) -> float:
        """What the search minimises, of the best order."""
        return _cost(self.best[-1])

    def take(self, order: Order) -> None:
        """Go back to an earlier order."""
        _, units, self.best = order
        self.units = list(units)

    def allows(self, order: Partial) -> bool:
        """Return whether the replay of an order is not known to end early."""
        actions = tuple(step.action for step in order.steps if not step.hands_over)
        return all(actions[-len(last) :] != last for last in self.fallen)

    def _stands(self, order: Partial) -> bool:
        """Return whether the states of an order are stable, and if it is the best so far its replay; note failures."""
        states, actions = [self.root.state], [step.action for step in order.steps if not step.hands_over]
        for action in actions:
            states.append(state_after(states[-1], action))
        if not all(self.next.is_stable(after, before) for before, after in itertools.pairwise(states)):
            return False
        if _cost(order) >= self._record:
            return True
        row = self._acceptance.falls_at(np.array(states[::-1], dtype=np.uint8))
        if row is not None:
            # The same state may stand with other forces from before it, so it is the history that is excluded.
            self.fallen.add(tuple(actions[len(actions) - row :]))
        else:
            self._record = _cost(order)
        return row is None

    def completed(self, first: int, last: int, own: int, others: int) -> Iterator[Partial]:
        """Yield complete orders with other steps in a window; what is left of it follows in the old order."""
        old = self.best
        for partial in self._beam(first, last, own, others)[:_ENDS]:
            if partial is old[last]:
                continue
            done = {(step.unit.job, step.place) for step in partial.steps[first:]}
            whole: Partial | None = partial
            for step in old[-1].steps[first:]:
                if whole is None:
                    break
                begun = whole.begun[step.unit.robot]
                if (step.unit.job, step.place) in done:
                    continue
                if step.place == 0 and begun is not None:
                    # The arm still holds a part that comes later in the old order.
                    done.add((begun[0].job, begun[1]))
                    whole = self._continued(whole, *begun)
                if whole is not None:
                    held = (entry[0] for entry in whole.begun if entry is not None)
                    unit = next((unit for unit in held if unit.job == step.unit.job), step.unit)
                    whole = self._continued(whole, unit, step.place)
            if whole is not None:
                yield whole

    def _continued(self, partial: Partial, unit: Unit, place: int) -> Partial | None:
        """Return an order with one more step, whose state is not checked; None if no motion is free."""
        legs = self.next.legs(partial, unit, place)
        return None if legs is None else self._extended(partial, UnitStep(unit, place, legs))

    def _beam(self, first: int, last: int, own: int, others: int) -> list[Partial]:
        """Return orders of the steps of a window after those before it, best first."""
        window = self.best[-1].steps[first:last]
        inside = {(step.unit.job, step.place) for step in window}
        beam, width = [self.best[first]], self._width
        for level in range(first + 1, last + 1):
            hold, builds = self._hold, self.builds
            made = sorted(  # a robot does a job at most once after each order, so units are never compared
                (expected(partial, robot, unit, place, hold, builds=builds), row, robot, unit.job, unit, place)
                for row, partial in enumerate(beam)
                for robot, unit, place in self._steps(partial, window, inside, own, others)
            )
            found: list[tuple[float, int, Partial]] = []
            worst, scores = np.inf, []
            for least, row, robot, _, unit, place in made:
                if least > worst:
                    break
                following = self.next.step(beam[row], robot, unit, place)
                if following is None:
                    continue
                partial = self._extended(beam[row], following)
                found.append((partial.score(self._hold), len(found), partial))
                insort(scores, found[-1][0])
                if len(found) >= width:
                    worst = scores[width - 1]
            kept: dict[object, int] = {}
            beam = []
            for _, _, partial in sorted(found, key=lambda entry: entry[:2]):
                key = (partial.jobs, partial.node.held)
                kept[key] = kept.get(key, 0) + 1
                if kept[key] <= _SAME and len(beam) < width:
                    beam.append(partial)
            beam.append(self.best[level])
        return sorted(beam, key=lambda partial: partial.score(self._hold))

    def _steps(
        self,
        partial: Partial,
        window: Sequence[UnitStep],
        inside: set[tuple[int, int]],
        own: int,
        others: int,
    ) -> Iterator[tuple[int, Unit, int]]:
        """Yield steps of a window that may come next: robots, units as in the best order, and places in them."""
        waiting = [step.unit for step in window if step.place == 0 and step.unit.job not in partial.jobs]
        for robot, begun in enumerate(partial.begun):
            if begun is not None:
                if (begun[0].job, begun[1]) in inside:
                    yield robot, *begun
                continue
            room = 0 if partial.node.held[robot] is not None else others
            seen = [0] * len(partial.begun)
            fixed = False
            for unit in waiting:
                if seen[unit.robot] >= (own if unit.robot == robot else room):
                    continue
                # Units that stay with their arm stay in their order, too; others pass them.
                if not unit.movable and (fixed or unit.robot != robot):
                    continue
                fixed |= not unit.movable
                whole = (unit.job, 1) in inside
                if unit.robot == robot or whole:
                    yield robot, unit, 0
                seen[unit.robot] += 1


def _cost(order: Partial) -> float:
    return order.end + _TOTAL * sum(order.free)


def _signature(order: Partial) -> Signature:
    return tuple((step.unit.job, step.place, step.unit.robot) for step in order.steps)

"""Search for an order of the steps of a plan in which the makespan is least, and for the arms that take the parts.

First the sequences of the arms are merged by a beam search, each as it is. Then short windows of the order are searched
again, where an arm may take its own parts in another order or parts of other arms; all that comes after a window stays.
Where this helps no more, an arm may take its parts from behind the end of windows at the longest waits, too.
Every state is proven stable, every motion is proven free of what is at rest, and waits are those of a schedule in which
of two motions in conflict the earlier in the order goes first.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from falsework.assembly.state import States
from falsework.robots.interleaving.next_steps import NextSteps
from falsework.robots.interleaving.partial_order import Partial, UnitStep, beginning, expected, extended, waits
from falsework.robots.interleaving.work import Unit, Work
from falsework.robots.keyframes.keyframes import Edge, Node, state_after
from falsework.search.plans.plan_replay import Acceptance
from falsework.stability.oracle import Stability

_MERGE_WIDTH = 24
"""Beam width of the merge."""
MANY = 3
"""Arms from which on more effort pays: two are seldom far from their lower bound, half of the motions."""
_MODERATE = 64
"""Parts up to which a second plan and ways out of local optima are worth their time, which grows with the square."""
_WIDTH = 12
"""Beam width in a window for many arms."""
_NARROW = 6
"""Beam width for two arms, which have half as many choices in a step."""
LENGTHS = (10, 14, 8, 12, 18)
"""Steps of a window, in turn until none of them leads to a better order: in long ones the beam is too narrow."""
_OWN = 4
"""Next parts of its own that an arm chooses from."""
_OTHERS = 2
"""Next parts of each other arm that an arm chooses from."""
_SAME = 2
"""Partial orders of the same steps that are kept."""
_ENDS = 4
"""Orders of a window that are continued to the end of the plan."""
_FALLS = 4
"""Better orders of a window of which a state or the replay may turn out to be unstable."""
_FAR = 4
"""Parts from behind the end of a window that each arm may take in it."""
_WAITS = 16
"""Longest waits, at each of which a window with parts from behind its end is searched."""
_FAR_TURNS = 2
"""Turns with such windows without a better order after which the search ends, for many arms."""
_FEW_TURNS = 1
"""Turns without a better order after which the search ends for two arms: later ones save little."""
_LEAST_GAIN = 0.002
"""Share by which a turn must shorten an order to count as one with a better order."""
_TOTAL = 0.01
"""Weight of the total time in the comparison of complete orders, which decides between those with equal makespan."""

Signature = tuple[tuple[int, int, int], ...]
"""Jobs of an order with the places in them, and the robots."""


def is_worth_more(arms: int, parts: int) -> bool:
    """Return whether several searches for orders are worth their time, for a plan that takes a number of parts away."""
    return arms >= MANY and parts <= _MODERATE


class OrderSearch:
    """Search for an order of the steps of one plan."""

    def __init__(
        self,
        work: Work,
        oracle: Stability,
        root: Node,
        chain: Sequence[Edge],
        *,
        legal: Callable[[States], Sequence[int]],
        stop: Callable[[], bool],
    ) -> None:
        """Prepare the search.

        Args:
            work: motions of the cell.
            oracle: decides stability.
            root: the first keyframe.
            chain: the edges of the plan.
            legal: actions that the rules of the task allow in a state, releases aside.
            stop: tells when to end with the order found so far.
        """
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
        self._fallen: set[tuple[int, ...]] = set()
        """Last actions of orders that end the replay in assembly order, which carries forces from state to state."""
        holds = [unit.seconds[0] for unit in self.units if unit.movable]
        self._hold = sum(holds) / max(len(holds), 1)
        many = len(root.configurations) >= MANY
        self._width, self._turns = (_WIDTH, len(LENGTHS) + _FAR_TURNS) if many else (_NARROW, _FEW_TURNS)
        if any(edge.hands_over or edge.put_down is not None for edge in chain):
            # What pays once such a step is done looks worse before it, and narrow beams drop it.
            self._width = _WIDTH
        self.best = self._as_planned(chain)
        """Beginnings of the best order, from that without steps to the complete one."""
        self._planned = list(self.units), self.best
        self._futile: dict[Signature, set[tuple[float, ...]]] = {}
        """Of each order that was the best one, the windows that led to no other order."""

    def _as_planned(self, chain: Sequence[Edge]) -> list[Partial]:
        place_of = {edge: (unit, k) for unit in self.units for k, edge in enumerate(unit.edges)}
        last: dict[int, Unit] = {}
        steps = []
        for edge in chain:
            unit, place = place_of[edge]
            steps.append(UnitStep(unit, place, tuple(variants[0] for variants in unit.legs[place])))
            if place == 0 and unit.approaches and unit.legs[0] and unit.legs[0][0][0].segment.kind == "free":
                self.next.add_approach(last.get(unit.robot), unit)
            last[unit.robot] = unit
        return self._beginnings(steps)

    def _beginnings(self, steps: Sequence[UnitStep]) -> list[Partial]:
        found = [beginning(self.work, self.root, self.units)]
        for step in steps:
            found.append(self._extended(found[-1], step))
        return found

    def _extended(self, partial: Partial, step: UnitStep) -> Partial:
        return extended(self.work, partial, step, self.units[step.unit.job])

    def run(self) -> None:
        """Find a better order."""
        length = len(self.best) - 1
        self.improve(0, length, _MERGE_WIDTH, own=1, others=0)
        since = turn = 0
        while since < self._turns:
            # Parts from behind the end of a window are worth their time once nothing else helps.
            far, size, before = since >= len(LENGTHS), LENGTHS[turn % len(LENGTHS)], self.cost
            for first in waits(self.best)[:_WAITS] if far else range(0, length, size // 2):
                if self.stop():
                    return
                behind = self._behind(min(first + size, length)) if far else []
                if behind or not far:
                    self.improve(first, size, far=behind)
            since, turn = 0 if self.cost < before * (1 - _LEAST_GAIN) else since + 1, turn + 1

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
        return self.best is not self._planned[1]

    def _behind(self, last: int) -> list[Unit]:
        """Return the next units from behind the end of a window, of each arm, that nothing blocks at its end."""
        node, found, seen = self.best[last].node, [], [0] * len(self.root.configurations)
        for step in self.best[-1].steps[last:]:
            unit = step.unit
            if step.place or not unit.movable or seen[unit.robot] >= _FAR:
                continue
            if unit.part in self.legal(node.state) and self.next.comes_out(node.state, unit.edges[1]):
                found.append(unit)
                seen[unit.robot] += 1
        return found

    def improve(
        self,
        first: int,
        size: int,
        width: int | None = None,
        *,
        own: int = _OWN,
        others: int = _OTHERS,
        far: Sequence[Unit] = (),
        worse: float = 0.0,
    ) -> bool:
        """Search some steps of the best order again; return whether another order was found.

        Args:
            first: the first of the steps.
            size: number of steps, as far as there are so many.
            width: beam width, by default that of windows.
            own: next parts of its own that an arm chooses from.
            others: next parts of each other arm that an arm chooses from.
            far: units from behind the end that may be taken too.
            worse: share by which an order that was not the best one before may be worse; by default it must be better.
        """
        last, cost, width = min(first + size, len(self.best) - 1), self.cost, width or self._width
        futile = self._futile.setdefault(_signature(self.best[-1]), set())
        window = (first, last, width, own, others, len(far), worse)
        if window in futile:
            return False
        for _ in range(_FALLS):
            completed = [order for order in self._completed(first, last, width, own, others, far) if self._may(order)]
            if worse:
                completed = [order for order in completed if _signature(order) not in self._futile]
            found = min(completed, key=_cost, default=None)
            if found is None or _cost(found) >= (cost * (1 + worse) if worse else cost - 1e-6):
                futile.add(window)
                return False
            if self._stands(found):
                for step in found.steps:
                    self.units[step.unit.job] = step.unit
                self.best = self._beginnings(found.steps)
                self._futile.setdefault(_signature(found), set())
                return True
        return False

    @property
    def cost(self) -> float:
        """What the search minimises, of the best order."""
        return _cost(self.best[-1])

    def take(self, order: tuple[list[Unit], list[Partial]]) -> None:
        """Go back to an earlier order: its units and its beginnings."""
        self.units, self.best = list(order[0]), order[1]

    def _may(self, order: Partial) -> bool:
        """Return whether the replay of an order is not known to end early."""
        actions = tuple(step.action for step in order.steps if not step.hands_over)
        return all(actions[-len(last) :] != last for last in self._fallen)

    def _stands(self, order: Partial) -> bool:
        """Return whether the states and the replay in assembly order of an order are stable; note what is not."""
        states, actions = [self.root.state], [step.action for step in order.steps if not step.hands_over]
        for action in actions:
            states.append(state_after(states[-1], action))
        if not all(self.next.is_stable(after, before) for before, after in pairwise(states)):
            return False
        row = self._acceptance.falls_at(np.array(states[::-1], dtype=np.uint8))
        if row is not None:
            # The same state may stand with other forces from before it, so it is the history that is excluded.
            self._fallen.add(tuple(actions[len(actions) - row :]))
        return row is None

    def _completed(
        self, first: int, last: int, width: int, own: int, others: int, far: Sequence[Unit]
    ) -> Iterator[Partial]:
        """Yield complete orders with other steps in a window; what is left of it follows in the old order."""
        old = self.best
        for partial in self._beam(first, last, width, own, others, far)[:_ENDS]:
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

    def _beam(self, first: int, last: int, width: int, own: int, others: int, far: Sequence[Unit]) -> list[Partial]:
        """Return orders of the steps of a window after those before it, best first."""
        window = self.best[-1].steps[first:last]
        inside = {(step.unit.job, step.place) for step in window}
        inside |= {(unit.job, place) for unit in far for place in range(2)}
        beam = [self.best[first]]
        for level in range(first + 1, last + 1):
            made = sorted(  # a robot does a job at most once after each order, so units are never compared
                (expected(partial, robot, unit, place, self._hold), row, robot, unit.job, unit, place)
                for row, partial in enumerate(beam)
                for robot, unit, place in self._steps(partial, window, inside, own, others, far)
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
        far: Sequence[Unit],
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
            for unit in far:
                if unit.robot == robot and unit.job not in partial.jobs:
                    yield robot, unit, 0


def _cost(order: Partial) -> float:
    return order.end + _TOTAL * sum(order.free)


def _signature(order: Partial) -> Signature:
    return tuple((step.unit.job, step.place, step.unit.robot) for step in order.steps)

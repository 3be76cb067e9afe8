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
from numpy.typing import NDArray

from falsework.assembly.state import HELD, States
from falsework.robots.interleaving.partial_order import Partial, UnitStep, beginning, expected, extended, waits
from falsework.robots.interleaving.work import Leg, Unit, Work
from falsework.robots.keyframes.keyframes import Edge, Node, state_after
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import CellRobot
from falsework.stability.oracle import Stability

Array = NDArray[np.float64]

_MERGE_WIDTH = 24
"""Beam width of the merge."""
_WIDTH = 12
"""Beam width in a window."""
_LENGTHS = (10, 14, 8, 12, 18)
"""Steps of a window, in turn until none of them leads to a better order: in long ones the beam is too narrow."""
_OWN = 4
"""Next parts of its own that an arm chooses from."""
_OTHERS = 2
"""Next parts of each other arm that an arm chooses from."""
_SAME = 2
"""Partial orders of the same steps that are kept."""
_ENDS = 4
"""Orders of a window that are continued to the end of the plan."""
_VARIANTS = 2
"""Motions on one way that are planned, each in another scene."""
_REPLACEMENTS = 2
"""Replacements per part of the plan that are planned in all."""
_FALLS = 4
"""Better orders of a window of which a state or the replay may turn out to be unstable."""
_SAME_WAY = 1 - 1e-6
"""Cosine above which a line and an exit direction count as the same."""
_STANDSTILL = 1e-7
"""Distance below which two configurations count as the same, rad or m."""
_FAR = 4
"""Parts from behind the end of a window that each arm may take in it."""
_WAITS = 16
"""Longest waits, at each of which a window with parts from behind its end is searched."""
_FAR_TURNS = 2
"""Turns with such windows without a better order after which the search ends."""
_TOTAL = 0.01
"""Weight of the total time in the comparison of complete orders, which decides between those with equal makespan."""


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
        self.work, self.graph, self.oracle = work, work.graph, oracle
        self.root, self.legal, self.stop = root, legal, stop
        self.parts = len(root.state)
        self.units = work.units(root, chain)
        """Of each job the unit that does it in the best order."""
        self._replacements: dict[tuple[int, int], Unit | None] = {(unit.job, unit.robot): unit for unit in self.units}
        self._approaches: dict[tuple[Unit | None, Unit], list[Leg]] = {}
        self._refused: set[tuple[Unit, int, bytes]] = set()
        self._stable: dict[bytes, bool] = {}
        self._fallen: set[tuple[int, ...]] = set()
        """Last actions of orders that end the replay in assembly order, which carries forces from state to state."""
        self._ways: dict[Edge, Array] = {}
        self._rules: dict[tuple[bytes, Edge], bool] = {}
        holds = [unit.seconds[0] for unit in self.units if unit.movable]
        self._hold = sum(holds) / max(len(holds), 1)
        self.best = self._as_planned(chain)
        """Beginnings of the best order, from that without steps to the complete one."""
        self._planned = list(self.units), self.best

    def _as_planned(self, chain: Sequence[Edge]) -> list[Partial]:
        place_of = {edge: (unit, k) for unit in self.units for k, edge in enumerate(unit.edges)}
        last: dict[int, Unit] = {}
        steps = []
        for edge in chain:
            unit, place = place_of[edge]
            steps.append(UnitStep(unit, place, tuple(variants[0] for variants in unit.legs[place])))
            if place == 0 and unit.approaches and unit.legs[0] and unit.legs[0][0][0].segment.kind == "free":
                self._approaches[last.get(unit.robot), unit] = unit.legs[0][0]
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
        self._improve(0, length, _MERGE_WIDTH, own=1, others=0)
        since = turn = 0
        while since < len(_LENGTHS) + _FAR_TURNS:
            # Parts from behind the end of a window are worth their time once nothing else helps.
            far, size = since >= len(_LENGTHS), _LENGTHS[turn % len(_LENGTHS)]
            better = False
            for first in waits(self.best)[:_WAITS] if far else range(0, length, size // 2):
                if self.stop():
                    return
                last = min(first + size, length)
                behind = self._behind(last) if far else []
                if behind or not far:
                    better |= self._improve(first, last, _WIDTH, own=_OWN, others=_OTHERS, far=behind)
            since, turn = 0 if better else since + 1, turn + 1

    def refuse(self, index: int) -> None:
        """Exclude a step of the best order in the state in which it is there, and go back to the order of the plan."""
        step, before = self.best[-1].steps[index], self.best[index].node
        self._refused.add((step.unit, step.place, before.state.tobytes()))
        self.units, self.best = list(self._planned[0]), self._planned[1]

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
            if unit.part in self.legal(node.state) and self._comes_out(node.state, unit.edges[1]):
                found.append(unit)
                seen[unit.robot] += 1
        return found

    def _improve(self, first: int, last: int, width: int, *, own: int, others: int, far: Sequence[Unit] = ()) -> bool:
        """Search the steps from `first` to before `last` of the best order again; return whether that was better."""
        for _ in range(_FALLS):
            completed = self._completed(first, last, width, own, others, far)
            found = min((order for order in completed if not self._falls(order)), key=_cost, default=self.best[-1])
            if _cost(found) >= _cost(self.best[-1]) - 1e-6:
                return False
            if self._stands(found):
                for step in found.steps:
                    self.units[step.unit.job] = step.unit
                self.best = self._beginnings(found.steps)
                return True
        return False

    def _falls(self, order: Partial) -> bool:
        """Return whether the replay of an order is known to end early."""
        actions = tuple(step.edge.action for step in order.steps)
        return any(actions[-len(last) :] == last for last in self._fallen)

    def _stands(self, order: Partial) -> bool:
        """Return whether the states and the replay in assembly order of an order are stable; note what is not."""
        states = [self.root.state]
        for step in order.steps:
            states.append(state_after(states[-1], step.edge.action))
        if not all(self._is_stable(after, before) for before, after in pairwise(states)):
            return False
        replayer = self.oracle.replayer
        row = None if replayer is None else replayer.replay(np.array(states[::-1], dtype=np.uint8)).falls_at
        if row is not None:
            # The same state may stand with other forces from before it, so it is the history that is excluded.
            self._fallen.add(tuple(step.edge.action for step in order.steps[len(order.steps) - row :]))
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
        legs = self._legs(partial, unit, place)
        return None if legs is None else self._extended(partial, UnitStep(unit, place, legs))

    def _beam(self, first: int, last: int, width: int, own: int, others: int, far: Sequence[Unit]) -> list[Partial]:
        """Return orders of the steps of a window after those before it, best first."""
        window = self.best[-1].steps[first:last]
        beam = [self.best[first]]
        for level in range(first + 1, last + 1):
            made = [
                (expected(partial, *step, self._hold), row, step)
                for row, partial in enumerate(beam)
                for step in self._steps(partial, window, own, others, far)
            ]
            made.sort(key=lambda entry: (entry[0], entry[1], entry[2][0], entry[2][1].job))
            found: list[tuple[float, int, Partial]] = []
            worst, scores = np.inf, []
            for least, row, (robot, unit, place) in made:
                if least > worst:
                    break
                partial = self._after(beam[row], robot, unit, place)
                if partial is None:
                    continue
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
        self, partial: Partial, window: Sequence[UnitStep], own: int, others: int, far: Sequence[Unit]
    ) -> Iterator[tuple[int, Unit, int]]:
        """Yield steps of a window that may come next: robots, units as in the best order, and places in them."""
        inside = {(step.unit.job, step.place) for step in window}
        inside |= {(unit.job, place) for unit in far for place in range(2)}
        waiting = [step.unit for step in window if step.place == 0 and step.unit.job not in partial.jobs]
        for robot, begun in enumerate(partial.begun):
            if begun is not None:
                if (begun[0].job, begun[1]) in inside:
                    yield robot, *begun
                continue
            room = 0 if partial.node.held[robot] is not None else others
            seen = dict.fromkeys(range(len(partial.begun)), 0)
            barred: set[int] = set()
            for unit in waiting:
                limit = own if unit.robot == robot else room
                if unit.robot in barred or seen[unit.robot] >= limit:
                    continue
                if not unit.movable:
                    barred.add(unit.robot)
                    if unit.robot != robot or seen[robot]:
                        continue
                whole = (unit.job, 1) in inside
                if unit.robot == robot or whole:
                    yield robot, unit, 0
                seen[unit.robot] += 1
            for unit in far:
                if unit.robot == robot and unit.job not in partial.jobs:
                    yield robot, unit, 0

    def _after(self, partial: Partial, robot: int, unit: Unit, place: int) -> Partial | None:
        """Return an order with one more step; None where it is not possible or not stable."""
        node = partial.node
        after = state_after(node.state, unit.edges[place].action)
        if self._stable.get(after.tobytes()) is False:
            return None
        if unit.robot != robot:
            other = self._replacement(partial, unit, robot)
            if other is None:
                return None
            unit = other
        legs = self._legs(partial, unit, place)
        if legs is None:
            return None
        # Holds rarely make a state unstable, so they are checked in better orders only.
        if unit.edges[place].action >= self.parts and not self._is_stable(after, node.state):
            return None
        return self._extended(partial, UnitStep(unit, place, legs))

    def _is_stable(self, state: States, before: States) -> bool:
        key = state.tobytes()
        if key not in self._stable:
            self._stable[key] = bool(self.oracle.stable(state[None], parents=before[None])[0])
        return self._stable[key]

    def _replacement(self, partial: Partial, unit: Unit, robot: int) -> Unit | None:
        """Return the unit of another robot that does a job."""
        key = (unit.job, robot)
        if key not in self._replacements:
            if len(self._replacements) >= (1 + _REPLACEMENTS) * len(self.units) or unit.part not in self.legal(
                partial.node.state
            ):
                return None
            found = self.work.replacement(unit.job, partial.node, unit.part, robot, partial.rests)
            self._replacements[key] = found
            if found is not None and found.legs[0][0][0].segment.kind == "free":
                self._approaches[partial.last[robot], found] = found.legs[0][0]
        return self._replacements[key]

    def _legs(self, partial: Partial, unit: Unit, place: int) -> tuple[Leg, ...] | None:
        """Return motions of a step that are free at the end of an order; None if there are none."""
        node, edge = partial.node, unit.edges[place]
        if (unit, place, partial.key) in self._refused or not self._allowed(partial, edge):
            return None
        groups = list(unit.legs[place])
        if place == 0 and unit.approaches:
            goal = edge.segments[0].path[-1]
            lines = [variants for variants in groups if variants[0].segment.kind == "line"]
            groups = lines
            if np.abs(goal - node.configurations[unit.robot]).max() > _STANDSTILL:
                groups = [self._approaches.setdefault((partial.last[unit.robot], unit), []), *lines]
        found = []
        for variants in groups:
            leg = next((leg for leg in variants if self._is_free(partial, unit, leg)), None)
            if leg is None:
                if len(variants) >= _VARIANTS or (variants and variants[0].segment.kind == "line"):
                    return None
                leg = self.work.replan(node, unit, place, partial.rests)
                if leg is None:
                    self._refused.add((unit, place, partial.key))
                    return None
                variants.append(leg)
            found.append(leg)
        return tuple(found)

    def _allowed(self, partial: Partial, edge: Edge) -> bool:
        """Return whether the rules allow an action, and nothing blocks the line on which a part is withdrawn."""
        key, action, state = (partial.key, edge), edge.action, partial.node.state
        if key not in self._rules:
            releases = action < self.parts and state[action] == HELD
            legal = releases or action in self.legal(state)
            self._rules[key] = legal and (action < self.parts or self._comes_out(state, edge))
        return self._rules[key]

    def _comes_out(self, state: States, edge: Edge) -> bool:
        """Return whether the direction of a removal is a free exit."""
        if edge not in self._ways:
            self._ways[edge] = way_out(self.graph.cell.robots[edge.robot], edge)
        free = self.graph.exits.free(edge.action - self.parts, state)
        return bool(len(free) and (free @ self._ways[edge]).max() >= _SAME_WAY)

    def _is_free(self, partial: Partial, unit: Unit, leg: Leg) -> bool:
        """Return whether a motion keeps clear of other robots at rest and of parts that it was not planned around."""
        for robot, rest in enumerate(partial.rests):
            if robot != unit.robot and self.work.wait(leg, rest) >= 0:
                return False
        # A part is not withdrawn past one that had left before: free exits may be so narrow that it would jam.
        return not self.work.blocked(leg, partial.present & ~(1 << unit.part))


def way_out(robot: CellRobot, edge: Edge) -> Array:
    """Return the direction in which a robot withdraws a part."""
    path = edge.segments[0].path
    ends = tool_pose(robot, path[[0, -1]])[:, :3, 3]
    return (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])


def _cost(order: Partial) -> float:
    return order.end + _TOTAL * sum(order.free)

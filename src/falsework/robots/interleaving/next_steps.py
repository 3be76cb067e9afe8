"""Steps that may come next in an order: what the rules and the parts around allow, motions, and stability."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from falsework.assembly.state import HELD, States
from falsework.robots.interleaving.partial_order import Partial, UnitStep
from falsework.robots.interleaving.work import NO_WAIT, Leg, Unit, Work
from falsework.robots.keyframes.keyframes import Edge, Node, state_after
from falsework.robots.keyframes.trajectory_assembly import STANDSTILL
from falsework.robots.kinematics.forward import tool_pose
from falsework.robots.model.cell import CellRobot
from falsework.stability.oracle import StabilityOracle
from falsework.utils.arrays import Array

_VARIANTS = 2
"""Motions on one way that are planned, each in another scene."""


class NextSteps:
    """Next steps of the orders of one plan, each with what is known of it."""

    def __init__(
        self, work: Work, oracle: StabilityOracle, units: Sequence[Unit], legal: Callable[[States], Sequence[int]]
    ) -> None:
        """Know no steps but those of the plan; `legal` are actions that the rules allow in a state, releases aside."""
        self.work, self.graph, self.oracle, self.legal = work, work.graph, oracle, legal
        self.parts = self.graph.assembly.part_count
        self._replacements: dict[tuple[int, int], Unit | None] = {(unit.job, unit.robot): unit for unit in units}
        self._approaches: dict[tuple[Unit | None, Unit], list[Leg]] = {}
        self._moves: dict[tuple[Unit | None, Unit], bool] = {}
        """Whether the arm has a way to go from the end of a unit to the first line of another one."""
        self._refused: set[tuple[Unit, int, bytes]] = set()
        self._stable: dict[bytes, bool] = {}
        self._ways: dict[Edge, Array] = {}
        self._rules: dict[tuple[bytes, Edge], bool] = {}

    def add_approach(self, last: Unit | None, unit: Unit) -> None:
        """Note that the first motion of a unit begins where another one ended."""
        self._approaches[last, unit] = unit.legs[0][0]

    def know(self, state: States) -> None:
        """Note that a state is stable as the plan reaches it."""
        self._stable[state.tobytes()] = True

    def refuse(self, unit: Unit, place: int, state: bytes) -> None:
        """Exclude a step of a unit in a state."""
        self._refused.add((unit, place, state))

    def step(self, partial: Partial, robot: int, unit: Unit, place: int) -> UnitStep | None:
        """Return a step of a robot after an order; None where it is not possible or not stable."""
        node, edge = partial.node, unit.edges[place]
        after = node.state if edge.hands_over else state_after(node.state, edge.action)
        if self._stable.get(after.tobytes()) is False:
            return None
        if unit.robot != robot:
            other = None if node.handed is not None else self._replacement(partial, unit, robot)
            if other is None:
                return None
            unit = other
        legs = self.legs(partial, unit, place)
        if legs is None:
            return None
        # Holds rarely make a state unstable, so they are checked in better orders only.
        if unit.edges[place].action >= self.parts and not self.is_stable(after, node.state):
            return None
        return UnitStep(unit, place, legs)

    def is_stable(self, state: States, before: States) -> bool:
        """Return whether a state is stable, which follows another one."""
        key = state.tobytes()
        if key not in self._stable:
            self._stable[key] = bool(self.oracle.verdicts(state[None], near=before[None]).stable[0])
        return self._stable[key]

    def _replacement(self, partial: Partial, unit: Unit, robot: int) -> Unit | None:
        """Return the unit of another robot that does a job."""
        key = (unit.job, robot)
        if key not in self._replacements:
            if unit.part not in self.legal(partial.node.state):
                return None
            found = self.work.replacement(unit.job, partial.node, unit.part, robot, partial.rests)
            self._replacements[key] = found
            if found is not None and found.legs[0][0][0].segment.kind == "free":
                self._approaches[partial.last[robot], found] = found.legs[0][0]
        return self._replacements[key]

    def legs(self, partial: Partial, unit: Unit, place: int) -> tuple[Leg, ...] | None:
        """Return motions of a step that are free at the end of an order; None if there are none."""
        node, edge = partial.node, unit.edges[place]
        refused = (unit, place, partial.key) in self._refused
        if refused or not grippers_allow(node, edge) or not self._allowed(partial, edge):
            return None
        groups = list(unit.legs[place])
        if place == 0 and unit.approaches:
            goal = edge.segments[0].path[-1]
            lines = [variants for variants in groups if variants[0].segment.kind == "line"]
            groups = lines
            way = partial.last[unit.robot], unit
            if way not in self._moves:
                self._moves[way] = bool(np.abs(goal - node.configurations[unit.robot]).max() > STANDSTILL)
            if self._moves[way]:
                groups = [self._approaches.setdefault(way, []), *lines]
        found = []
        for variants in groups:
            leg = next((leg for leg in variants if self._is_free(partial, unit, leg)), None)
            if leg is None:
                fixed = edge.put_down is not None or (variants and variants[0].segment.kind == "line")
                if len(variants) >= _VARIANTS or fixed:
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
            self._rules[key] = legal and (action < self.parts or self.is_removable(state, edge))
        return self._rules[key]

    def is_removable(self, state: States, edge: Edge) -> bool:
        """Return whether the direction of a removal is a free exit."""
        if edge not in self._ways:
            self._ways[edge] = exit_direction_of(self.graph.cell.robots[edge.robot], edge)
        return self.graph.exits.allows(edge.action - self.parts, state, self._ways[edge])

    def _is_free(self, partial: Partial, unit: Unit, leg: Leg) -> bool:
        """Return whether a motion keeps clear of other robots at rest and of parts that it was not planned around."""
        for robot, rest in enumerate(partial.rests):
            if robot != unit.robot:
                wait = leg.waits.get(rest)
                if (self.work.wait(leg, rest) if wait is None else wait) != NO_WAIT:
                    return False
        # A part is not withdrawn past one that had left before: free exits may be so narrow that it would jam.
        return not self.work.blocked(leg, partial.present & ~(1 << unit.part))


def grippers_allow(node: Node, edge: Edge) -> bool:
    """Return whether a step may follow a keyframe as far as the parts that the robots hold go.

    One that holds nothing holds a part, or takes over a part that another one holds, which then leaves it at once.
    """
    part, mine = edge.action % len(node.state), node.held[edge.robot]
    if node.handed is not None:
        return edge.hands_over and part == node.handed and node.holder(part) == edge.robot
    if mine is not None:
        return mine == part and not edge.hands_over
    return edge.action < len(node.state) and edge.hands_over == (part in node.held)


def exit_direction_of(robot: CellRobot, edge: Edge) -> Array:
    """Return the direction in which a robot withdraws a part."""
    path = edge.segments[0].path
    ends = tool_pose(robot, path[[0, -1]])[:, :3, 3]
    return (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])

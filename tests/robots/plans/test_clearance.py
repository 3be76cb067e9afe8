"""Clearance of arms over the time of a plan, against distances of all bodies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from falsework import Assembly
from falsework.assembly import REMOVED
from falsework.geometry.arrays import apply
from falsework.robots import Cell, RobotPlan
from falsework.robots.checks.clearance import clearances
from falsework.robots.model.part_shapes import place_parts
from falsework.robots.motion.collision_world import CollisionWorld, Scene
from falsework.robots.motion.near_pairs import separation


def test_no_body_is_nearer_than_the_clearance(
    planned_in_turn: Callable[[Assembly, Cell], RobotPlan], column: Assembly, cell: Cell
) -> None:
    """At the end it is the distance of all pieces; at no time do bodies touch that are not gripped."""
    plan = planned_in_turn(column, cell)
    parts = place_parts(column, cell.placement)
    times = np.linspace(0.0, plan.makespan, 40)
    found = clearances(plan, cell, parts, times, within=0.5)
    assert all(len(pairs) == len(times) for pairs in found)
    assert all(pair.distance > 0 for pairs in found for pair in pairs if pair is not None)
    ends = clearances(plan, cell, parts, [plan.makespan], within=np.inf)
    last, world = plan.keyframes[-1], CollisionWorld(cell, parts)
    values = [
        plan.steps[-1].of(robot)[-1].positions[-1] if robot in plan.steps[-1].robots else at
        for robot, at in enumerate(last.configurations)
    ]
    present = plan.states[-1] != REMOVED
    scene = Scene(tuple(values), present, (None,) * cell.robot_count)
    for robot, (pair,) in enumerate(ends):
        assert pair is not None
        own = [piece for _, _, piece in world.robot_pieces(robot, scene)]
        others = [piece for k in range(cell.robot_count) if k != robot for _, _, piece in world.robot_pieces(k, scene)]
        others += [
            piece
            for part in np.flatnonzero(present).tolist()
            if part != last.held[robot]
            for piece in parts.pieces[part]
        ]
        bases = [entry for k, entry in enumerate(cell.robots) if k != robot]
        others += [apply(entry.base, piece) for entry in bases for piece in entry.model.pieces[0]]
        assert cell.floor is not None
        least = min(float(piece[:, 2].min()) - cell.floor for piece in own)
        least = min(least, *(separation(a, b) for a in own for b in others))
        assert pair.distance == pytest.approx(least, abs=1e-9)

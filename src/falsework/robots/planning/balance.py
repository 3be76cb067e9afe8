"""Heuristic for robots that move at the same time: take parts from all sides of a structure in turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import REMOVED, Mask, States
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import PartShapes
from falsework.search.problem.guide import Guide
from falsework.search.problem.task import Direction


class BalanceGuide:
    """Heuristic that keeps the shares of parts that are left near each robot alike, on top of another heuristic.

    Each part counts for the robot that stands nearest to it. Robots then find work on their own sides at any time, far
    from each other.
    """

    def __init__(self, base: Guide | None, cell: Cell, parts: PartShapes) -> None:
        """Assign parts to robots; `base` is the other heuristic."""
        self._base = base
        bases = np.array([robot.base[:2, 3] for robot in cell.robots])
        nearest = np.linalg.norm(parts.center[:, None, :2] - bases, axis=2).argmin(axis=1)
        self._near = (nearest[:, None] == np.arange(cell.robot_count)) & ~parts.boundary[:, None]

    def __call__(self, states: States, actions: Mask, direction: Direction) -> NDArray[np.float64]:
        """As `Guide`."""
        near = self._near.astype(np.float64)
        left = (states != REMOVED).astype(np.float64) @ near
        whole = near.sum(axis=0)
        share = left / np.maximum(whole, 1.0)
        ahead = (share - (left.sum(axis=1) / max(whole.sum(), 1.0))[:, None]) * whole
        score = np.clip(ahead / 2, -1.0, 1.0) @ near.T
        if direction is Direction.ASSEMBLY:
            score = -score
        found = np.concatenate([score, score], axis=1)
        return found if self._base is None else found + self._base(states, actions, direction)

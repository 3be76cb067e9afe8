"""Ways out for robots: straight ones, several per part and steep ones included, paths of moves, and those of sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, States
from falsework.geometry.arrays import apply
from falsework.geometry.clearance.locked import PartSet
from falsework.geometry.clearance.moves import ExitPath, PathMove, after
from falsework.geometry.clearance.protocol import Clearance
from falsework.geometry.clearance.sweep import Sweeper, includes_one
from falsework.geometry.clearance.table import ClearanceTable
from falsework.robots.model.cell import Placement
from falsework.robots.model.part_shapes import placed_move
from falsework.robots.model.shapes import Array
from falsework.search.problem.task import Task
from falsework.search.together.exits import sets_of
from falsework.search.together.posed_states import PosedStates
from falsework.stability.oracle import StabilityOracle
from falsework.utils.bits import pack, unpack

_TILT_DEGREES = (20.0, 50.0, 85.0)
"""Angles to the vertical of the directions that are tried besides straight up, degrees."""
_HEADINGS = 6
"""Headings of the tilted directions, evenly around the vertical."""
_LOWEST_SLOPE = -1e-6
"""Least upward component of a direction: level ones count in spite of rounding."""
_SAME_WAY = 1 - 1e-6
"""Cosine above which two directions count as the same."""


class ExitWays:
    """Ways out for every part: a fan of straight ones, none downwards, with the parts that block each, or a path.

    The clearance table decides whether a part can leave at all, for which any free direction will do. A robot has
    preferences: it cannot drag a part along the floor for long, nor pull beyond the reach of its arm. Where a part has
    no straight way, and the task allows more, its way has several moves (`ExitPaths`). Ways are in the world frame; a
    straight move that ends one is as long as it needs to be.
    """

    def __init__(
        self,
        assembly: Assembly,
        placement: Placement,
        present: NDArray[np.bool_] | None = None,
        leaving: NDArray[np.bool_] | None = None,
    ) -> None:
        """Compute the blocking parts of every part and direction.

        Args:
            present, leaving: parts that are ever in place, and that ever leave, all by default: others need no fan.
        """
        self._assembly, self._placement, turn = assembly, placement, placement.pose[:3, :3]
        known = assembly.clearance
        _, overlap = assembly.contact_settings.lengths(assembly.meshes)
        sweeper = Sweeper(assembly.meshes, assembly.contacts, overlap)
        fan = _fan() @ turn  # into the frame of the structure
        self._ways: list[tuple[Array, NDArray[np.bool_]]] = []
        exact = known.exact.copy()
        fanned = ~assembly.boundary
        for only in (present, leaving):
            fanned = fanned if only is None else fanned & only
        for part in range(assembly.part_count):
            rows = slice(known.start[part], known.start[part + 1])
            directions = known.directions[rows]
            blockers = unpack(known.blockers[rows])[:, : assembly.part_count].astype(bool)
            if fanned[part]:
                directions = np.concatenate([directions, fan])
                blockers = np.concatenate([blockers, sweeper.blocked(part, fan, present)])
            world = directions @ turn.T
            rises = world[:, 2] > _LOWEST_SLOPE
            # Downward directions are missed only where something that never leaves does not block them anyway.
            missed = blockers[~rises & ~blockers[:, assembly.boundary].any(axis=1)]
            world, blockers = world[rises], blockers[rises]
            exact[part] &= all(includes_one(row, blockers) for row in missed)
            order = np.argsort(-np.round(world[:, 2], 9), kind="stable")
            self._ways.append((world[order], blockers[order]))
        counts = [len(world) for world, _ in self._ways]
        self._table = ClearanceTable(
            np.concatenate([world for world, _ in self._ways]) @ turn,
            pack(np.concatenate([blockers for _, blockers in self._ways])),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
            exact,
            known.sampled,
        )
        self.clearance: Clearance = self._table
        """The same for the rules of a task: a part that can only leave downwards cannot leave."""
        self._sets: tuple[PartSet, ...] = ()

    def allow(self, task: Task, oracle: StabilityOracle, robots: int) -> None:
        """Let parts leave in as many moves, and as many at once, as a task allows.

        Parts that so many robots hold may move aside where the rest stands by verdicts of the oracle.
        """
        movable = ~task.boundary & (task.start != REMOVED) & (task.target == REMOVED)
        self._sets = sets_of(task, movable)[0]
        self.clearance = self._table
        if task.moves_out > 1 or task.turns:
            from falsework.geometry.paths.exit_paths import ExitPaths  # few tasks need it

            assembly = self._assembly
            still = assembly.immovable.copy()
            still[list(task.fixed)] = True
            posed = PosedStates(assembly) if task.waiting else None
            given = assembly.meshes, assembly.contacts, self._table, assembly.part_motions, still
            paths = ExitPaths(*given, task.moves_out, task.turns, posed)
            self.clearance = paths.judged_by(oracle, robots)

    def blockers(self, part: int) -> NDArray[np.bool_]:
        """Return the parts that block each straight way of a part, shape (ways, parts)."""
        return self._ways[part][1]

    def _straight(self, part: int, state: States) -> Array:
        """Return the directions in which no present part blocks a part, shape (directions, 3)."""
        directions, blockers = self._ways[part]
        return directions[~(blockers & (state != REMOVED)).any(axis=1)]

    def free(self, part: int, state: States) -> list[ExitPath]:
        """Return the ways of a part that no present part blocks, straight ones if there are any, the steepest first."""
        free = self._straight(part, state)
        if len(free):
            return [(PathMove.straight((part,), direction),) for direction in free]
        path = self.clearance.exit_path(state, (part,))
        return [] if not path else [self._placed(part, path, state)]

    def free_later(self, part: int, state: States) -> tuple[States, list[ExitPath]]:
        """Return a later state in which a part may leave, with little else removed, and its free ways there."""
        blockers = self.blockers(part) & (state != REMOVED)
        boundary = self._assembly.boundary
        count = blockers.sum(axis=1) + 1000 * (blockers & boundary).any(axis=1)
        later = state.copy()
        if len(count):
            later[blockers[int(np.argmin(count))] & ~boundary] = REMOVED
        alone = np.where(boundary | (np.arange(len(state)) == part), state, REMOVED).astype(np.uint8)
        tried = [later] if self.clearance is self._table else [later, state, alone]
        for there in tried:
            if ways := self.free(part, there):
                return there, ways
        for there in (state, alone):
            for parts in self._sets:
                if part not in parts:
                    continue
                held = there.copy()
                held[list(parts)] = HELD
                path, motions = self.path(parts, held), self.motions(parts, there)
                if path or motions:
                    beside = there.copy()
                    beside[[other for other in parts if other != part]] = REMOVED
                    return beside, [motion[parts.index(part)] for motion in motions] or [path]
        return later, []

    def path(self, parts: PartSet, state: States) -> ExitPath:
        """Return the way of several moves on which held parts leave a state together; none where they leave straight.

        The last move is 1 m long.
        """
        if self.motions(parts, state) or self.clearance is self._table:
            return ()
        path = self.clearance.exit_path(state, parts)
        if not path:
            return ()
        *moves, last = (placed_move(move, self._placement) for move in path)
        return (*moves, replace(last, distance=1.0))

    def motions(self, parts: PartSet, state: States) -> list[tuple[ExitPath, ...]]:
        """Return ways on which a set leaves a state together, one for each part; distances are in proportion.

        In each the fastest part goes 1 m, and none goes downwards. The least inclined to the vertical come first.
        """
        turn = self._placement.pose[:3, :3]
        found = [velocity @ turn.T for velocity in self._assembly.clearance_of_sets.exit_motions(parts, state)]
        level = [velocities for velocities in found if (velocities[:, 2] > _LOWEST_SLOPE).all()]
        level.sort(key=lambda velocities: -round(float(velocities[:, 2].min()), 9))
        return [
            tuple(
                (PathMove.straight((part,), velocity / (speed := float(np.linalg.norm(velocity))), speed),)
                for part, velocity in zip(parts, velocities, strict=True)
            )
            for velocities in level
        ]

    def allows(self, part: int, state: States, way: ExitPath) -> bool:
        """Return whether a way is one on which no present part blocks a part; of a straight one its length is free."""
        free = self._straight(part, state)
        if len(free):
            return len(way) == 1 and float((free @ np.array(way[0].direction)).max()) >= _SAME_WAY
        return way in self.free(part, state)

    def _placed(self, part: int, path: ExitPath, state: States) -> ExitPath:
        """Return a path in the world frame; one that ends with a turn goes on straight, away from the other parts."""
        if not path[-1].turns:
            path = (*path[:-1], replace(path[-1], distance=np.inf))
        elif beyond := self._beyond(part, path, state):
            path = (*path, beyond)
        return tuple(placed_move(move, self._placement) for move in path)

    def _beyond(self, part: int, path: ExitPath, state: States) -> PathMove | None:
        """Return a free straight move from the end of a path, in the structure's frame, up if that is one."""
        motions, poses = self._assembly.part_motions, after(path)
        others = state != REMOVED
        others[part] = False
        size = float(np.ptp(motions.bounds(np.ones(len(others), dtype=bool)), axis=0).max())
        center = self._assembly.mass.center[part]
        before = path[-1].until(1 - 1e-6).displacement() @ after(path[:-1]).get(part, np.eye(4))
        tangent = apply(poses[part], center) - apply(before, center)
        ways = [*_fan() @ self._placement.pose[:3, :3], tangent / max(np.linalg.norm(tangent), 1e-12)]
        for way in ways:
            move = PathMove.straight((part,), way, size)
            if not motions.blockers(move, others, poses, stop=True).any():
                return replace(move, distance=np.inf)
        return None


def _fan() -> Array:
    """Return straight up, and rings of directions around it; unit vectors, shape (n, 3)."""
    found = [(0.0, 0.0, 1.0)]
    for tilt in np.radians(_TILT_DEGREES):
        for turn in 2 * np.pi * np.arange(_HEADINGS) / _HEADINGS:
            found.append((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
    return np.array(found)

"""Reference checker and planner by Pinocchio, Coal and OMPL: the same shapes and pairs, none of falsework's code."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio
from numpy.typing import NDArray

from falsework.robots.motion.collision_world import CollisionQuery

Array = NDArray[np.float64]


class Reference:
    """Collision checks and free plans for the scene of a view."""

    def __init__(self, view: CollisionQuery) -> None:
        robot = view.world.cell.robots[view.robot]
        model = robot.model
        self.model = pinocchio.Model()
        parent, before = 0, pinocchio.SE3(np.array(robot.base))
        for j in range(model.joints):
            kind = pinocchio.JointModelRevoluteUnaligned(np.array(model.axes[j]))
            parent = self.model.addJoint(parent, kind, before * pinocchio.SE3(model.origins[j]), f"j{j}")
            before = pinocchio.SE3.Identity()
        self.geometry = pinocchio.GeometryModel()
        joints = model.joints
        shapes = [(link, piece) for link in range(joints + 1) for piece in model.pieces[link]]
        bodies = [self._add(link, piece if link else _moved(robot.base, piece)) for link, piece in shapes]
        bodies += [self._add(joints, _moved(model.flange, piece)) for piece in robot.gripper.pieces]
        held = view.scene.attached[view.robot]
        if held is not None:
            pieces = view.world.carried(view.robot, held)
            bodies += [self._add(joints, _moved(model.flange, piece)) for piece in pieces]
        obstacles = [self._add(0, vertices) for vertices in view.obstacles]
        for body, obstacle in np.argwhere(view.arrays.rules.pair).tolist():
            self._pair(bodies[body], obstacles[obstacle])
        if view.arrays.rules.floor > -1e6:
            slab = coal.Halfspace(np.array([0.0, 0, 1]), view.arrays.rules.floor)
            floor = self.geometry.addGeometryObject(
                pinocchio.GeometryObject("floor", 0, pinocchio.SE3.Identity(), slab)
            )
            for body in np.flatnonzero(view.arrays.rules.on_floor).tolist():
                self._pair(bodies[body], floor)
        self.apart = self.pairs
        for a, b in view.arrays.rules.self_pairs.tolist():
            self._pair(bodies[a], bodies[b])
        self.data = self.model.createData()
        self.found = pinocchio.GeometryData(self.geometry)
        self.broad = pinocchio.BroadPhaseManager_DynamicAABBTreeCollisionManager(self.model, self.geometry, self.found)

    @property
    def pairs(self) -> int:
        """Number of checked pairs."""
        return len(self.geometry.collisionPairs)

    def keep(self, margin: float) -> None:
        """Count pairs nearer than a margin, metres, as collisions; bodies of the arm itself only where they touch."""
        for request in list(self.found.collisionRequests)[: self.apart]:
            request.security_margin = margin

    def collides(self, values: Array) -> bool:
        """Return whether any pair collides."""
        return pinocchio.computeCollisions(self.model, self.data, self.broad, values, True)

    def distance(self, values: Array) -> float:
        """Return the distance of the nearest pair, metres."""
        pinocchio.computeDistances(self.model, self.data, self.geometry, self.found, values)
        return min(result.min_distance for result in self.found.distanceResults)

    def plan(self, start: Array, goal: Array, low: Array, high: Array, step: float, seconds: float) -> Array | None:
        """Return a path by OMPL's RRT-Connect and its simplification, edges sampled every `step` rad."""
        import ompl.base
        import ompl.geometric
        import ompl.util

        ompl.util.setLogLevel(ompl.util.LogLevel.LOG_ERROR)
        joints = len(start)
        space: Any = ompl.base.RealVectorStateSpace(joints)
        bounds = ompl.base.RealVectorBounds(joints)
        for j in range(joints):
            bounds.setLow(j, float(min(low[j], start[j], goal[j])))
            bounds.setHigh(j, float(max(high[j], start[j], goal[j])))
        space.setBounds(bounds)
        setup: Any = ompl.geometric.SimpleSetup(space)
        info = setup.getSpaceInformation()
        setup.setStateValidityChecker(lambda state: not self.collides(np.array([state[j] for j in range(joints)])))
        info.setStateValidityCheckingResolution(step / space.getMaximumExtent())
        ends = []
        for values in (start, goal):
            state = space.allocState()
            for j in range(joints):
                state[j] = float(values[j])
            ends.append(state)
        setup.setStartAndGoalStates(*ends)
        setup.setPlanner(ompl.geometric.RRTConnect(info))
        setup.setup()
        if not setup.solve(seconds) or not setup.haveExactSolutionPath():
            return None
        setup.simplifySolution()
        path = setup.getSolutionPath()
        return np.array([[path.getState(k)[j] for j in range(joints)] for k in range(path.getStateCount())])

    def _add(self, joint: int, points: Array) -> int:
        name = f"shape{self.geometry.ngeoms}"
        shape = convex(points)
        return self.geometry.addGeometryObject(pinocchio.GeometryObject(name, joint, pinocchio.SE3.Identity(), shape))

    def _pair(self, a: int, b: int) -> None:
        self.geometry.addCollisionPair(pinocchio.CollisionPair(a, b))


def convex(points: Array) -> Any:
    """Return a convex shape for Coal."""
    vertices = coal.StdVec_Vec3s()
    for point in points:
        vertices.append(np.asarray(point, float))
    return coal.Convex.convexHull(vertices, True, None)


def _moved(pose: Array, points: Array) -> Array:
    return points @ pose[:3, :3].T + pose[:3, 3]

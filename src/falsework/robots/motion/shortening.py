"""Shortening of free motions: other trees, shortcuts of single joints, and rounded corners.

The search accepts any path; where arms move at the same time, the longest chain of motions determines the makespan.
Every path is proven free again, in the scene that it was planned for. Shortcuts of single joints: Geraerts and
Overmars, Creating high-quality paths for motion planning (2007).
"""

from __future__ import annotations

import numpy as np

from falsework.robots.model.robot_model import RobotModel
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import CollisionQuery
from falsework.robots.motion.path_planner import plan_free
from falsework.robots.motion.timing import time_path

_TREES = 4
"""Additional pairs of trees that are grown for one motion."""
_NODES = 1000
_SHORTCUTS = 60
"""Shortcuts tried, each on a subset of the joints."""
_CORNER = 0.1
"""Cost of a corner in the choice of a path, seconds."""
_EXCESS = 0.05
"""Motions at most this much longer than the straight one are not shortened, seconds."""
_ROUNDINGS = (0.48, 0.3, 0.15, 0.07)
"""Shares of the edges at a corner that its rounding may take, largest first."""
_ARC = 10
"""Number of edges of a rounded corner."""


def shorter_path(view: CollisionQuery, path: Array, speed: float, seed: list[int]) -> Array:
    """Return a path between the same configurations that takes less time, or the same path.

    Args:
        path: configurations, shape (points, joints).
        speed: share of the velocity limits of the cell.
    """
    if len(path) < 3 or _cost(view, path, speed) < expected_seconds(view.model, path[[0, -1]], speed) + _EXCESS:
        return path
    rng = np.random.default_rng(seed)
    paths = [path]
    for _ in range(_TREES):
        other = plan_free(view, path[0], path[-1], seed=int(rng.integers(2**31)), nodes=_NODES).path
        if other is not None:
            paths.append(other)
    best = min(paths, key=lambda candidate: _cost(view, candidate, speed))
    best = _by_joints(view, best, speed, rng)
    best = _rounded(view, best)
    return min(path, best, key=lambda candidate: time_path(view.model, candidate, speed).duration)


def expected_seconds(model: RobotModel, path: Array, speed: float) -> float:
    """Return about the seconds that a path takes from rest to rest, at limits as of `time_path`: those of one joint."""
    travel = np.abs(np.diff(path, axis=0)).sum(axis=0)
    velocity, acceleration = model.velocity * speed, model.acceleration * speed**2
    ramp = velocity**2 / acceleration
    times = np.where(travel < ramp, 2 * np.sqrt(travel / acceleration), travel / velocity + velocity / acceleration)
    return float(times.max(initial=0.0))


def _cost(view: CollisionQuery, path: Array, speed: float) -> float:
    return expected_seconds(view.model, path, speed) + _CORNER * (len(path) - 2)


def _by_joints(view: CollisionQuery, path: Array, speed: float, rng: np.random.Generator) -> Array:
    """Return a path in which segments of some joints are straight, without the points that are not needed."""
    cost = _cost(view, path, speed)
    for _ in range(_SHORTCUTS):
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        first, second = np.sort(rng.random(2)) * along[-1]
        joints = rng.random(path.shape[1]) < rng.choice([0.3, 0.6, 1.0])
        inner = (along > first) & (along < second)
        where = np.concatenate([[first], along[inner], [second]])
        middle = np.stack([np.interp(where, along, column) for column in path.T], axis=1)
        share = (where - first)[:, None] / max(second - first, 1e-12)
        straight = middle[0] + share * (middle[-1] - middle[0])
        middle = np.where(joints, straight, middle)
        if joints.all():
            middle = middle[[0, -1]]
        made = np.concatenate([path[along <= first], middle, path[along >= second]])
        made = _needed(made)
        if _cost(view, made, speed) < cost - 1e-3 and view.is_free(made):
            path, cost = made, _cost(view, made, speed)
    k = 1
    while k < len(path) - 1:
        made = np.delete(path, k, axis=0)
        if _cost(view, made, speed) < cost and view.is_free(made[k - 1 : k + 1]):
            path, cost = made, _cost(view, made, speed)
        else:
            k += 1
    return path


def _needed(path: Array) -> Array:
    """Return a path without points that repeat the previous one or lie on the edge between their neighbours."""
    path = path[np.concatenate([[True], np.abs(np.diff(path, axis=0)).sum(axis=1) > 1e-9])]
    if len(path) < 3:
        return path
    before, after = np.diff(path, axis=0)[:-1], np.diff(path, axis=0)[1:]
    product = (before * after).sum(axis=1)
    bent = product < (1 - 1e-9) * np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return path[np.concatenate([[True], bent, [True]])]


def _rounded(view: CollisionQuery, path: Array) -> Array:
    """Return a path with its corners rounded by parabolas, where these are free."""
    found = [path[:1]]
    u = np.linspace(0.0, 1.0, _ARC + 1)[:, None]
    for before, corner, after in zip(path[:-2], path[1:-1], path[2:], strict=True):
        arc = corner[None]
        for share in _ROUNDINGS:
            start, stop = corner + share * (before - corner), corner + share * (after - corner)
            tried = (1 - u) ** 2 * start + 2 * u * (1 - u) * corner + u**2 * stop
            if view.is_free(tried):
                arc = tried
                break
        found.append(arc)
    return np.concatenate([*found, path[-1:]])

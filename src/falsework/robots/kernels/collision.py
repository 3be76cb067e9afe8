"""Compiled collision check of an arm with its load at given joint values.

Forward kinematics, broad phase (spheres against boxes, of groups and of single pieces) and narrow phase (`gjk.gap`) run
in one function on flat arrays. The result "clear" is a proof for every pair; see `docs/decisions/arms-motion.md`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.paths.gjk import INNER, OUTER, gap
from falsework.utils.kernels import njit

Array = NDArray[np.float64]

CLEAR = -1
"""Result of the check without a collision; else the number of the first pair found."""


class Chain(NamedTuple):
    """Joints with their frames rotated so that every axis is z."""

    base: Array
    """Pose of the base in the world, shape (3, 4)."""
    origin: Array
    """Pose of each joint frame at joint value zero in the frame before it, shape (joints, 3, 4)."""
    prismatic: NDArray[np.bool_]


class Bodies(NamedTuple):
    """Convex pieces of a robot and its load."""

    frame: NDArray[np.int64]
    """Frame that carries the piece: 0 for the base, 1 for the link that the first joint moves, shape (bodies,)."""
    start: NDArray[np.int64]
    """Rows of `vertices` of piece b are `start[b]:start[b + 1]`."""
    vertices: Array
    center: Array
    """Centre of a bounding sphere of the piece, in its frame, shape (bodies, 3)."""
    radius: Array
    sweep: Array
    """Bound on the motion of any point of the piece when a joint moves by one unit, m/rad, shape (bodies, joints)."""


class Obstacles(NamedTuple):
    """Static convex pieces, in groups of neighbours."""

    start: NDArray[np.int64]
    vertices: Array
    low: Array
    """Lower corners of the bounding boxes of the pieces, shape (obstacles, 3)."""
    high: Array
    group_start: NDArray[np.int64]
    """Group g has the pieces `group_start[g]:group_start[g + 1]`."""
    group_low: Array
    group_high: Array


class Rules(NamedTuple):
    """Pairs to check, and the margins to keep."""

    pair: NDArray[np.bool_]
    """Whether a body and an obstacle are checked, shape (bodies, obstacles)."""
    self_pairs: NDArray[np.int64]
    """Pairs of bodies of the same arm that are checked for contact only, shape (pairs, 2)."""
    floor: float
    """Height of the floor, metres."""
    on_floor: NDArray[np.bool_]
    """Whether a body is checked against the floor, shape (bodies,)."""
    margin: float
    """Distance to keep from obstacles and floor, metres."""


class QueryScratch(NamedTuple):
    """Scratch memory of one caller: not to be shared between threads."""

    frames: Array
    vertices: Array
    center: Array
    low: Array
    high: Array
    placed: NDArray[np.bool_]
    axis: Array
    self_axis: Array
    simplex: Array
    swept: Array
    """Bound on the motion of the points of every body along an edge, metres, shape (bodies,)."""
    self_swept: Array
    """Bound on the relative motion of the two bodies of every self pair, metres, shape (pairs,)."""


class Query(NamedTuple):
    """Arm among obstacles, as compiled functions take it; made by `make_query`."""

    chain: Chain
    bodies: Bodies
    obstacles: Obstacles
    rules: Rules
    scratch: QueryScratch


def make_query(chain: Chain, bodies: Bodies, obstacles: Obstacles, rules: Rules) -> Query:
    """Return a query with scratch of its own."""
    count, pairs = len(bodies.frame), len(rules.self_pairs)
    scratch = QueryScratch(
        frames=np.empty((len(chain.origin) + 1, 3, 4)),
        vertices=np.empty_like(bodies.vertices),
        center=np.empty((count, 3)),
        low=np.empty((count, 3)),
        high=np.empty((count, 3)),
        placed=np.empty(count, np.bool_),
        axis=np.zeros((count, len(obstacles.low), 3)),
        self_axis=np.zeros((pairs, 3)),
        simplex=np.empty((6, 3)),
        swept=np.zeros(count),
        self_swept=np.zeros(pairs),
    )
    return Query(chain, bodies, obstacles, rules, scratch)


@njit(**INNER)
def place_frames(values, chain, frames):
    """Compute forward kinematics: poses of all frames in the world, shape (joints + 1, 3, 4)."""
    for r in range(3):  # entry by entry: assigning rows would compile numba's error messages, for seconds
        for c in range(4):
            frames[0, r, c] = chain.base[r, c]
    for j in range(len(values)):
        before, step, after = frames[j], chain.origin[j], frames[j + 1]
        cos, sin, slide = 1.0, 0.0, 0.0
        if chain.prismatic[j]:
            slide = values[j]
        else:
            cos, sin = math.cos(values[j]), math.sin(values[j])
        for r in range(3):
            x = before[r, 0] * step[0, 0] + before[r, 1] * step[1, 0] + before[r, 2] * step[2, 0]
            y = before[r, 0] * step[0, 1] + before[r, 1] * step[1, 1] + before[r, 2] * step[2, 1]
            z = before[r, 0] * step[0, 2] + before[r, 1] * step[1, 2] + before[r, 2] * step[2, 2]
            t = before[r, 0] * step[0, 3] + before[r, 1] * step[1, 3] + before[r, 2] * step[2, 3] + before[r, 3]
            after[r, 0] = cos * x + sin * y
            after[r, 1] = cos * y - sin * x
            after[r, 2] = z
            after[r, 3] = t + slide * z


@njit(**INNER)
def _place(body, bodies, work):
    """Write the world vertices of one body and their bounding box."""
    pose = work.frames[bodies.frame[body]]
    for r in range(3):
        work.low[body, r], work.high[body, r] = 1e300, -1e300
    for i in range(bodies.start[body], bodies.start[body + 1]):
        x, y, z = bodies.vertices[i, 0], bodies.vertices[i, 1], bodies.vertices[i, 2]
        for r in range(3):
            value = pose[r, 0] * x + pose[r, 1] * y + pose[r, 2] * z + pose[r, 3]
            work.vertices[i, r] = value
            work.low[body, r] = min(work.low[body, r], value)
            work.high[body, r] = max(work.high[body, r], value)
    work.placed[body] = True


@njit(inline="always", **INNER)
def _outside(x, y, z, low, high, k):
    """Return the squared distance of a point from box k."""
    dx = max(low[k, 0] - x, x - high[k, 0], 0.0)
    dy = max(low[k, 1] - y, y - high[k, 1], 0.0)
    dz = max(low[k, 2] - z, z - high[k, 2], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(**INNER)
def first_hit(values, share, query):
    """Return the first pair that is not proven to keep its distance, or CLEAR.

    Args:
        values: joint values, shape (joints,).
        share: share of `swept` and `self_swept` of the scratch that is added to the margins; 0 checks `values` alone.
        query: the `Query`.

    Returns:
        With n obstacles and m bodies: `b n + o` for body b and obstacle o, `m n + b` for body b and the floor,
        `m n + m + k` for self pair k, or -1.
    """
    chain, bodies, obstacles, rules, work = query
    place_frames(values, chain, work.frames)
    count, many = len(bodies.frame), len(obstacles.low)
    for b in range(count):
        pose, c = work.frames[bodies.frame[b]], bodies.center[b]
        for r in range(3):
            work.center[b, r] = pose[r, 0] * c[0] + pose[r, 1] * c[1] + pose[r, 2] * c[2] + pose[r, 3]
        work.placed[b] = False
    for back in range(count):
        b = count - 1 - back  # load and gripper are the likeliest to collide
        margin = rules.margin
        if share > 0.0:
            margin += share * work.swept[b]
        x, y, z = work.center[b, 0], work.center[b, 1], work.center[b, 2]
        reach = bodies.radius[b] + margin
        if rules.on_floor[b] and z - reach < rules.floor:
            if not work.placed[b]:
                _place(b, bodies, work)
            if work.low[b, 2] - margin <= rules.floor:
                return count * many + b
        square = reach * reach
        for g in range(len(obstacles.group_low)):
            if _outside(x, y, z, obstacles.group_low, obstacles.group_high, g) > square:
                continue
            for o in range(obstacles.group_start[g], obstacles.group_start[g + 1]):
                if not rules.pair[b, o] or _outside(x, y, z, obstacles.low, obstacles.high, o) > square:
                    continue
                if not work.placed[b]:
                    _place(b, bodies, work)
                apart = False
                for r in range(3):
                    if work.low[b, r] - margin > obstacles.high[o, r] or work.high[b, r] + margin < obstacles.low[o, r]:
                        apart = True
                if apart:
                    continue
                found = gap(
                    work.vertices,
                    bodies.start[b],
                    bodies.start[b + 1],
                    obstacles.vertices,
                    obstacles.start[o],
                    obstacles.start[o + 1],
                    margin,
                    margin,
                    work.axis[b, o],
                    work.simplex,
                )
                if found <= margin:
                    return b * many + o
    for k in range(len(rules.self_pairs)):
        a, b = rules.self_pairs[k, 0], rules.self_pairs[k, 1]
        margin = 0.0
        if share > 0.0:
            margin = share * work.self_swept[k]
        dx = work.center[a, 0] - work.center[b, 0]
        dy = work.center[a, 1] - work.center[b, 1]
        dz = work.center[a, 2] - work.center[b, 2]
        reach = bodies.radius[a] + bodies.radius[b] + margin
        if dx * dx + dy * dy + dz * dz > reach * reach:
            continue
        if not work.placed[a]:
            _place(a, bodies, work)
        if not work.placed[b]:
            _place(b, bodies, work)
        found = gap(
            work.vertices,
            bodies.start[a],
            bodies.start[a + 1],
            work.vertices,
            bodies.start[b],
            bodies.start[b + 1],
            margin,
            margin,
            work.self_axis[k],
            work.simplex,
        )
        if found <= margin:
            return count * many + count + k
    return CLEAR


@njit(**OUTER)
def check_many(configurations, query, found):
    """Write `first_hit` of a batch, shape (batch, joints), into `found`, shape (batch,)."""
    for i in range(len(configurations)):
        found[i] = first_hit(configurations[i], 0.0, query)


@njit(**OUTER)
def _distance(a, b, axis, scratch, found):
    found[0] = gap(a, 0, len(a), b, 0, len(b), 1e300, 0.0, axis, scratch)


def distance_between(a: Array, b: Array) -> float:
    """Return a proven lower bound on the distance of two convex pieces, tight to 1e-6 of itself; 0 where they touch."""
    found = np.empty(1)
    _distance(a, b, np.zeros(3), np.empty((6, 3)), found)
    return float(found[0])

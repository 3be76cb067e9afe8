"""Compiled motion planning: proofs of free edges, RRT-Connect, and shortcutting.

An edge is proven free by intervals. At the midpoint of an interval every body must keep its distance plus the largest
motion of any of its points over half the interval; then the whole interval is free, and no collision can hide between
samples. Where that fails, the interval is bisected, down to a resolution below which the edge counts as blocked.
"""

from __future__ import annotations

import math

import numpy as np

from falsework.geometry.paths.gjk import INNER, OUTER
from falsework.robots.kernels.collision import CLEAR, first_hit
from falsework.utils.kernels import njit

INTERVALS = 4096
"""Largest number of open intervals of one edge; with more, the edge counts as blocked."""


@njit(**INNER)
def edge_free(a, b, resolution, query, values, opened):
    """Return whether the straight edge between two configurations keeps its distances everywhere; ends included.

    Args:
        a, b: configurations, shape (joints,).
        resolution: metres; an interval in which no point moves farther is not bisected again.
        query: as `first_hit` takes it.
        values: scratch, shape (joints,).
        opened: scratch, shape (2, INTERVALS).
    """
    bodies, rules, work = query.bodies, query.rules, query.scratch
    count, joints = bodies.sweep.shape
    farthest = 0.0
    for body in range(count):
        swept = 0.0
        for j in range(joints):
            swept += bodies.sweep[body, j] * abs(b[j] - a[j])
        work.swept[body] = swept
        farthest = max(farthest, swept)
    for k in range(len(rules.self_pairs)):
        one, other = rules.self_pairs[k, 0], rules.self_pairs[k, 1]
        if bodies.frame[one] > bodies.frame[other]:
            one, other = other, one
        swept = 0.0
        for j in range(bodies.frame[one], bodies.frame[other]):  # only these joints move the two relative to each other
            swept += bodies.sweep[other, j] * abs(b[j] - a[j])
        work.self_swept[k] = swept
    pending, side, parts = 1, 0, 1
    opened[0, 0] = 0
    while pending > 0:
        ahead = 0
        for k in range(pending):
            index = opened[side, k]
            t = (index + 0.5) / parts
            for j in range(joints):
                values[j] = a[j] + t * (b[j] - a[j])
            if first_hit(values, 0.5 / parts, query) == CLEAR:
                continue
            if 0.5 * farthest / parts <= resolution:
                return False
            if first_hit(values, 0.0, query) != CLEAR:
                return False
            if ahead + 2 > INTERVALS:
                return False
            opened[1 - side, ahead] = 2 * index
            opened[1 - side, ahead + 1] = 2 * index + 1
            ahead += 2
        pending, side, parts = ahead, 1 - side, 2 * parts
    return True


@njit(**OUTER)
def edges_free(path, resolution, query):
    """Return the number of leading edges of a path that are free, shape (points, joints)."""
    values, opened = np.empty(path.shape[1]), np.empty((2, INTERVALS), np.int64)
    for i in range(len(path) - 1):
        if not edge_free(path[i], path[i + 1], resolution, query, values, opened):
            return i
    return len(path) - 1


@njit(**INNER)
def _uniform(seed):
    """Return the next number in [0, 1) of a generator whose state is seed[0]: splitmix64."""
    seed[0] += np.uint64(0x9E3779B97F4A7C15)
    z = seed[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) / 9007199254740992.0


@njit(**INNER)
def _nearest(tree, size, target):
    best, found = 1e300, 0
    for i in range(size):
        far = 0.0
        for j in range(len(target)):
            far += (tree[i, j] - target[j]) ** 2
        if far < best:
            best, found = far, i
    return found, math.sqrt(best)


@njit(**OUTER)
def grow(trees, parents, sizes, low, high, stride, rounds, resolution, seed, query, met):
    """Grow two trees towards each other for some rounds (RRT-Connect, Kuffner and LaValle 2000).

    Args:
        trees: configurations, shape (2, nodes, joints); tree 0 has the start as node 0, tree 1 the goal.
        parents: shape (2, nodes).
        sizes: nodes in use and, third, which tree is next to grow; shape (3,).
        low, high: box that samples are drawn from, shape (joints,).
        stride: longest edge, in joint space.
        rounds: samples to draw.
        seed: state of the generator, shape (1,).
        query: as `first_hit` takes it.
        met: out: the meeting nodes of the two trees, shape (2,).

    Returns:
        1: connected; 0: not yet; -1: no room for more nodes.
    """
    joints, opened = len(low), np.empty((2, INTERVALS), np.int64)
    target, fresh, values = np.empty(joints), np.empty(joints), np.empty(joints)
    for _ in range(rounds):
        if max(sizes[0], sizes[1]) >= trees.shape[1] - 1:
            return -1
        one = sizes[2]
        other = 1 - one
        sizes[2] = other
        for j in range(joints):
            target[j] = low[j] + (high[j] - low[j]) * _uniform(seed)
        near, far = _nearest(trees[one], sizes[one], target)
        share = min(1.0, stride / max(far, 1e-12))
        for j in range(joints):
            fresh[j] = trees[one, near, j] + share * (target[j] - trees[one, near, j])
        if first_hit(fresh, 0.0, query) != CLEAR:
            continue
        if not edge_free(trees[one, near], fresh, resolution, query, values, opened):
            continue
        leaf = sizes[one]
        for j in range(joints):
            trees[one, leaf, j] = fresh[j]
        parents[one, leaf] = near
        sizes[one] += 1
        near, far = _nearest(trees[other], sizes[other], fresh)
        while True:
            share = min(1.0, stride / max(far, 1e-12))
            for j in range(joints):
                target[j] = trees[other, near, j] + share * (fresh[j] - trees[other, near, j])
            if share < 1.0 and first_hit(target, 0.0, query) != CLEAR:
                break
            if not edge_free(trees[other, near], target, resolution, query, values, opened):
                break
            if share >= 1.0:
                met[one], met[other] = leaf, near
                return 1
            if sizes[other] >= trees.shape[1]:
                return -1
            for j in range(joints):
                trees[other, sizes[other], j] = target[j]
            parents[other, sizes[other]] = near
            near = sizes[other]
            sizes[other] += 1
            far -= stride
    return 0


@njit(**OUTER)
def shorten(path, size, tries, resolution, seed, query):
    """Replace segments of a path by straight edges where those are free; return the number of points left.

    Args:
        path: points, overwritten, shape (room, joints), `size` of them in use; there must be room for two more.
        tries: number of pairs of points along the path to try.
    """
    joints, opened = path.shape[1], np.empty((2, INTERVALS), np.int64)
    a, b, values = np.empty(joints), np.empty(joints), np.empty(joints)
    along = np.empty(len(path))
    for _ in range(tries):
        if size < 3:
            break
        along[0] = 0.0
        for i in range(1, size):
            far = 0.0
            for j in range(joints):
                far += (path[i, j] - path[i - 1, j]) ** 2
            along[i] = along[i - 1] + math.sqrt(far)
        first, second = _uniform(seed) * along[size - 1], _uniform(seed) * along[size - 1]
        if first > second:
            first, second = second, first
        i = 0
        while i < size - 2 and along[i + 1] <= first:
            i += 1
        k = i
        while k < size - 2 and along[k + 1] <= second:
            k += 1
        if i == k:
            continue
        s = (first - along[i]) / max(along[i + 1] - along[i], 1e-12)
        t = (second - along[k]) / max(along[k + 1] - along[k], 1e-12)
        for j in range(joints):
            a[j] = path[i, j] + s * (path[i + 1, j] - path[i, j])
            b[j] = path[k, j] + t * (path[k + 1, j] - path[k, j])
        if not edge_free(a, b, resolution, query, values, opened):
            continue
        # Points i + 1 to k are replaced by a and b.
        change = 2 - (k - i)
        if size + change > len(path):
            continue
        for j in range(joints):
            if change > 0:
                for m in range(size - 1, k, -1):
                    path[m + change, j] = path[m, j]
            elif change < 0:
                for m in range(k + 1, size):
                    path[m + change, j] = path[m, j]
            path[i + 1, j] = a[j]
            path[i + 2, j] = b[j]
        size += change
    return size

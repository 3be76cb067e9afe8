"""Compiled time-optimal speed along a path of straight and parabolic pieces: TOPP-RA (Pham and Pham 2018).

On every interval of the grid the slope of a joint is linear in the position along the path and its curvature constant,
so that limits kept at both ends of the interval are kept between them. Standing still is always feasible: the sets of
controllable squared speeds begin at 0, and one number per point, their upper end, describes them.
"""

from __future__ import annotations

import math

import numpy as np

from falsework.geometry.paths.gjk import INNER, OUTER
from falsework.utils.kernels import njit

_FLAT = 1e-12
"""Slope of a joint below which acceleration along the path does not move it."""
_STRIDES = (64, 32, 16, 8, 4, 2)
"""Numbers of samples to step ahead from one knot to the next, tried in turn before 1."""


@njit(**INNER)
def _rows(i, grid, piece, origin, slope, bend, push, top, rows):
    """Write the limits of interval i as rows (a, b, c) of `a u + b x <= c`; return their number.

    u is the acceleration along the path, x the squared speed at the start of the interval, and `top` the largest
    squared speed at its end.
    """
    p, step = piece[i], grid[i + 1] - grid[i]
    count = 0
    for end in range(2):
        at = grid[i + end] - origin[p]
        for j in range(len(push)):
            curve = bend[p, j]
            tangent = slope[p, j] + at * curve
            along = tangent + 2.0 * step * curve if end else tangent
            rows[count, 0], rows[count, 1], rows[count, 2] = along, curve, push[j]
            rows[count + 1, 0], rows[count + 1, 1], rows[count + 1, 2] = -along, -curve, push[j]
            count += 2
    rows[count, 0], rows[count, 1], rows[count, 2] = 2.0 * step, 1.0, top
    rows[count + 1, 0], rows[count + 1, 1], rows[count + 1, 2] = -2.0 * step, -1.0, 0.0
    return count + 2


@njit(**INNER)
def _most(rows, count, most):
    """Return the largest x up to `most` for which some u satisfies all rows, by elimination of u."""
    for k in range(count):
        if abs(rows[k, 0]) <= _FLAT and rows[k, 1] > 0.0:
            most = min(most, rows[k, 2] / rows[k, 1])
    for k in range(count):
        if rows[k, 0] <= _FLAT:
            continue
        for m in range(count):
            if rows[m, 0] >= -_FLAT:
                continue
            weight = rows[m, 1] * rows[k, 0] - rows[k, 1] * rows[m, 0]
            if weight > 0.0:
                most = min(most, (rows[m, 2] * rows[k, 0] - rows[k, 2] * rows[m, 0]) / weight)
    return most


@njit(**OUTER)
def fastest(grid, piece, origin, slope, bend, speed, push, squares):
    """Write the largest squared speeds along a path, from rest to rest, into `squares`, shape (points,).

    Args:
        grid: positions along the path, ascending, shape (points,); pieces meet at points of it.
        piece: piece of every interval, shape (points - 1,).
        origin: position along the path at which each piece begins, shape (pieces,).
        slope: derivatives of the joint values there, shape (pieces, joints).
        bend: second derivatives, constant on each piece, shape (pieces, joints).
        speed, push: limits of velocity and acceleration, shape (joints,).
    """
    last = len(grid) - 1
    rows = np.empty((4 * len(speed) + 2, 3))
    squares[last] = 0.0
    for i in range(last - 1, -1, -1):
        p, at = piece[i], grid[i] - origin[piece[i]]
        most = 1e300
        for j in range(len(speed)):
            tangent = abs(slope[p, j] + at * bend[p, j])
            if tangent > _FLAT:
                most = min(most, (speed[j] / tangent) ** 2)
        count = _rows(i, grid, piece, origin, slope, bend, push, squares[i + 1], rows)
        squares[i] = _most(rows, count, most)
    squares[0] = 0.0
    for i in range(last):
        count = _rows(i, grid, piece, origin, slope, bend, push, squares[i + 1], rows)
        most = 1e300
        for k in range(count):
            if rows[k, 0] > _FLAT:
                most = min(most, (rows[k, 2] - rows[k, 1] * squares[i]) / rows[k, 0])
        reached = squares[i] + 2.0 * (grid[i + 1] - grid[i]) * most
        squares[i + 1] = min(max(reached, 0.0), squares[i + 1])


@njit(**OUTER)
def evaluate(times, clock, grid, squares, piece, origin, start, slope, bend, positions, velocities, accelerations):
    """Write joint values and their derivatives by time at ascending times, shape (times, joints) each.

    Args:
        times: seconds, shape (times,).
        clock: times at the points of the grid, shape (points,).
        grid, piece, origin, slope, bend: as `fastest` takes them.
        squares: squared speeds at the points of the grid.
        start: joint values where each piece begins, shape (pieces, joints).
    """
    i, last = 0, len(grid) - 2
    for k in range(len(times)):
        while i < last and times[k] >= clock[i + 1]:
            i += 1
        p, step = piece[i], grid[i + 1] - grid[i]
        push = (squares[i + 1] - squares[i]) / (2.0 * step)
        first, t = math.sqrt(squares[i]), min(times[k], clock[last + 1]) - clock[i]
        rate = max(first + push * t, 0.0)
        at = min(first * t + push * t * t / 2, step) + grid[i] - origin[p]
        for j in range(positions.shape[1]):
            tangent = slope[p, j] + at * bend[p, j]
            positions[k, j] = start[p, j] + at * (slope[p, j] + at * bend[p, j] / 2)
            velocities[k, j] = tangent * rate
            accelerations[k, j] = bend[p, j] * rate * rate + tangent * push


@njit(**OUTER)
def thin(times, positions, velocities, push, error, kept):
    """Write into `kept` the indices of knots whose cubics approximate all samples; return their number.

    Args:
        times, positions, velocities: samples, shape (samples,) and (samples, joints).
        push: limits of acceleration of the cubics, shape (joints,).
        error: largest distance of a dropped sample from the cubic, in every joint.
        kept: shape (samples,).
    """
    count, here = 1, 0
    kept[0] = 0
    while here < len(times) - 1:
        for ahead in _STRIDES:
            there = here + ahead
            if there < len(times) and _close(times, positions, velocities, here, there, push, error):
                break
        else:
            there = here + 1
        kept[count] = here = there
        count += 1
    return count


@njit(**INNER)
def _close(times, positions, velocities, here, there, push, error):
    """Return whether the cubic between two samples keeps the limits and is near all samples between them."""
    span = times[there] - times[here]
    for j in range(len(push)):
        rise, before, after = positions[there, j] - positions[here, j], velocities[here, j], velocities[there, j]
        first = (6 * rise / span - 4 * before - 2 * after) / span
        final = (-6 * rise / span + 2 * before + 4 * after) / span
        if max(abs(first), abs(final)) > push[j]:
            return False
        for k in range(here + 1, there):
            t = times[k] - times[here]
            cubic = positions[here, j] + t * (before + t * (first / 2 + t * (final - first) / span / 6))
            if abs(cubic - positions[k, j]) > error:
                return False
    return True

"""Compiled numeric inverse kinematics for any chain: damped Newton steps, along lines and from many starts."""

from __future__ import annotations

import math

import numpy as np

from falsework.geometry.paths.gjk import INNER, OUTER
from falsework.robots.kernels.collision import place_frames
from falsework.utils.kernels import njit

TOLERANCE = 1e-9
"""Tolerance of a reached pose, metres and radians."""


@njit(**INNER)
def _reach_pose(q, target, chain, tail, steps, damping, longest, frames, columns, system, error):
    """Move joint values until the frame at the end of the chain reaches a pose; return whether it does.

    Args:
        q: joint values, overwritten.
        target: target pose, shape (3, 4).
        tail: pose of the end in the last frame, shape (3, 4).
        damping: weight of the squared error in the damping of a step.
        longest: largest change of a joint per step.
        frames, columns, system, error: scratch, shapes (joints + 1, 3, 4), (6, joints), (6, 7), (6,).
    """
    joints = len(q)
    for _ in range(steps + 1):
        place_frames(q, chain, frames)
        last = frames[joints]
        for r in range(3):
            at = last[r, 3]
            for k in range(3):
                at += last[r, k] * tail[k, 3]
            error[r] = target[r, 3] - at
        # Rotation vector from the present orientation to the target, from the columns of both.
        error[3] = error[4] = error[5] = 0.0
        trace = 0.0
        for c in range(3):
            x = last[0, 0] * tail[0, c] + last[0, 1] * tail[1, c] + last[0, 2] * tail[2, c]
            y = last[1, 0] * tail[0, c] + last[1, 1] * tail[1, c] + last[1, 2] * tail[2, c]
            z = last[2, 0] * tail[0, c] + last[2, 1] * tail[1, c] + last[2, 2] * tail[2, c]
            u, v, w = target[0, c], target[1, c], target[2, c]
            trace += x * u + y * v + z * w
            error[3] += 0.5 * (y * w - z * v)
            error[4] += 0.5 * (z * u - x * w)
            error[5] += 0.5 * (x * v - y * u)
        sine = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
        angle = math.atan2(sine, 0.5 * (trace - 1.0))
        if sine > 1e-9:
            stretch = min(angle / sine, 1e3)  # at a half turn the axis is undetermined
            for r in range(3, 6):
                error[r] *= stretch
        if angle < TOLERANCE and math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2) < TOLERANCE:
            return True
        for j in range(joints):
            frame = frames[j + 1]
            ax, ay, az = frame[0, 2], frame[1, 2], frame[2, 2]
            if chain.prismatic[j]:
                columns[0, j], columns[1, j], columns[2, j] = ax, ay, az
                columns[3, j] = columns[4, j] = columns[5, j] = 0.0
                continue
            dx = target[0, 3] - error[0] - frame[0, 3]
            dy = target[1, 3] - error[1] - frame[1, 3]
            dz = target[2, 3] - error[2] - frame[2, 3]
            columns[0, j], columns[1, j], columns[2, j] = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
            columns[3, j], columns[4, j], columns[5, j] = ax, ay, az
        weight = 1e-12
        for r in range(6):
            weight += damping * error[r] * error[r]
        for r in range(6):
            for c in range(6):
                total = 0.0
                for j in range(joints):
                    total += columns[r, j] * columns[c, j]
                system[r, c] = total
            system[r, r] += weight
            system[r, 6] = error[r]
        for r in range(6):  # elimination without pivoting: the matrix is positive definite
            for below in range(r + 1, 6):
                factor = system[below, r] / system[r, r]
                for c in range(r, 7):
                    system[below, c] -= factor * system[r, c]
        for back in range(6):
            r = 5 - back
            for c in range(r + 1, 6):
                system[r, 6] -= system[r, c] * system[c, 6]
            system[r, 6] /= system[r, r]
        most = 0.0
        for j in range(joints):
            step = 0.0
            for r in range(6):
                step += columns[r, j] * system[r, 6]
            columns[0, j] = step
            most = max(most, abs(step))
        share = min(1.0, longest / max(most, 1e-300))
        for j in range(joints):
            q[j] += share * columns[0, j]
    return False


@njit(**OUTER)
def reach_poses(guesses, targets, chain, tail, steps, damping, longest, follow, reached):
    """Solve for many poses, each from its guess, or along a line, each from the previous solution.

    Args:
        guesses: initial values, overwritten with solutions, shape (batch, joints).
        targets: poses of the end, shape (batch, 3, 4).
        follow: whether to take the previous solution as the guess, and stop at the first failure.
        reached: out: shape (batch,).
    """
    joints = guesses.shape[1]
    frames, columns, system = np.empty((joints + 1, 3, 4)), np.empty((6, joints)), np.empty((6, 7))
    error = np.empty(6)
    for i in range(len(targets)):
        if follow and i > 0:
            for j in range(joints):
                guesses[i, j] = guesses[i - 1, j]
        reached[i] = _reach_pose(
            guesses[i], targets[i], chain, tail, steps, damping, longest, frames, columns, system, error
        )
        if follow and not reached[i]:
            break

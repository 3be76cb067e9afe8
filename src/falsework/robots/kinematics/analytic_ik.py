"""Closed-form inverse kinematics of arms with six revolute joints, on batches of poses.

All formulas use the joint axes at zero joint values, so the frames and signs of a robot description do not matter.
Points move by `x -> e1 e2 ... e6 x`, with `ei` the rotation of joint i about its axis at zero; target T and flange
at zero H give `G = T H^-1 = e1 ... e6`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from falsework.robots.model.shapes import Array, inverse_pose, square_to

Owner = NDArray[np.int64]

WRIST_ANGLES = 120
"""Angles of the sixth joint at which the equation of an offset wrist is sampled."""
NEAR_ROOT = 0.15
"""Minima of the equation below this value, without a change of sign, are also tried as roots."""


@dataclass(frozen=True, eq=False)
class Screws:
    """Joint axes of an arm at zero joint values, in the frame of the base."""

    axes: Array
    """Unit vectors, shape (6, 3)."""
    points: Array
    """A point on each axis, shape (6, 3), metres."""
    home: Array
    """Pose of the flange at zero joint values, shape (4, 4)."""
    center: Array | None = None
    """Intersection of two wrist axes, shape (3,)."""
    spherical: bool = False

    def distance(self, joint: int, point: Array) -> float:
        """Return the distance of a point from an axis, metres."""
        return float(np.linalg.norm(np.cross(point - self.points[joint], self.axes[joint])))

    def meeting(self, a: int, b: int) -> Array | None:
        """Return the intersection of two axes, or None if they are more than a micrometre apart."""
        across = np.cross(self.axes[a], self.axes[b])
        square = across @ across
        if square < 1e-12:
            return None
        apart = self.points[b] - self.points[a]
        if abs(apart @ across) > 1e-6 * np.sqrt(square):
            return None
        along = np.cross(apart, self.axes[b]) @ across / square
        return self.points[a] + along * self.axes[a]


def solve_wrist(screws: Screws, targets: Array) -> tuple[Array, Owner]:
    """Return guesses for arms whose fourth and fifth axes meet, (batch, 4, 4) to (guesses, 6) and the row of each."""
    turn, shift = _moved(screws, targets)
    if screws.spherical:
        q6 = np.zeros((len(targets), 1))
        first, good = _arm(screws, turn, shift, q6)
        return _euler(screws, turn, first[:, 0], _turned(screws, first[:, 0]), good[:, 0])
    grid = np.linspace(-np.pi, np.pi, WRIST_ANGLES + 1)
    q6 = grid[None]  # the same for all targets
    first, good = _arm(screws, turn, shift, q6)
    value = np.where(good, _offset_equation(screws, turn, first, q6), np.nan)
    left, right = value[:, :-1], value[:, 1:]
    with np.errstate(invalid="ignore"):
        crossing = left * right <= 0
        size = np.abs(value)
        padded = np.pad(np.where(np.isnan(size), np.inf, size), ((0, 0), (1, 1), (0, 0)), constant_values=np.inf)
        dip = (size <= padded[:, :-2]) & (size <= padded[:, 2:]) & (size < NEAR_ROOT)
        share = left / (left - right)
    rows, cells, branches = np.nonzero(crossing)
    step = grid[1] - grid[0]
    at = grid[cells] + step * np.nan_to_num(share[rows, cells, branches], nan=0.5)
    more_rows, more_cells, more_branches = np.nonzero(dip)
    rows, branches = np.concatenate([rows, more_rows]), np.concatenate([branches, more_branches])
    at = np.concatenate([at, grid[more_cells]])
    return _finish_offset(screws, turn[rows], shift[rows], at, branches, rows)


def solve_parallel(screws: Screws, targets: Array) -> tuple[Array, Owner]:
    """Return guesses for arms whose second to fourth axes are parallel, as `solve_wrist`."""
    turn, shift = _moved(screws, targets)
    w, p, center = screws.axes, screws.points, screws.center
    assert center is not None
    batch = len(targets)
    moved = np.einsum("bij,j->bi", turn, center) + shift
    q1, good = _level(w[0], w[1], moved - p[0], float((center - p[0]) @ w[1]))  # (batch, 2)
    back = _about(w[0], -q1)  # (batch, 2, 3, 3)
    inner = back @ turn[:, None]
    # The component of the sixth axis along the parallel ones is invariant under them: it gives the fifth angle.
    level = np.einsum("i,bkij,j->bk", w[1], inner, w[5])
    base = np.array([w[1] @ w[5], w[1] @ np.cross(w[4], w[5])])
    reach = np.hypot(*base)
    with np.errstate(invalid="ignore"):
        spread = np.arccos(np.clip(level / reach, -1 - 1e-9, 1 + 1e-9).clip(-1, 1))
    good = good & (np.abs(level) <= reach * (1 + 1e-9))
    tilt = np.arctan2(base[1], base[0])
    q5 = np.stack([tilt + spread, tilt - spread], axis=2)  # (batch, 2, 2)
    good = np.repeat(good[:, :, None], 2, axis=2)
    # The direction of the parallel axes in the frame of the sixth joint gives the sixth angle.
    seen = np.einsum("bkji,j->bki", inner, w[1])[:, :, None]
    before = np.einsum("bklji,j->bkli", _about(w[4], q5), w[1])
    q6 = -_turn_between(w[5], before, np.broadcast_to(seen, before.shape))
    rest = inner[:, :, None] @ np.swapaxes(_about(w[5], q6), -1, -2) @ np.swapaxes(_about(w[4], q5), -1, -2)
    total = _turn_between(w[1], *_pair(rest, w[1]))
    # Target of the fourth axis: a point on it, moved by the second and third joints alone.
    about5 = p[4] + np.einsum("bklij,j->bkli", _about(w[4], -q5), p[3] - p[4])
    here = p[5] + np.einsum("bklij,bklj->bkli", _about(w[5], -q6), about5 - p[5])
    world = np.einsum("bij,bklj->bkli", turn, here) + shift[:, None, None]
    flat = p[0] + np.einsum("bkij,bklj->bkli", back, world - p[0])
    q2, q3, met = _two_bars(w, p[1], p[2], p[3], flat)  # (batch, 2, 2, 2)
    sign3, sign4 = w[2] @ w[1], w[3] @ w[1]
    q4 = sign4 * (total[..., None] - q2 - sign3 * q3)
    shape = q2.shape
    spread_out = [np.broadcast_to(q, shape) for q in (q1[:, :, None, None], q2, q3, q4, q5[..., None], q6[..., None])]
    keep = met & good[..., None]
    owner = np.broadcast_to(np.arange(batch)[:, None, None, None], shape)[keep]
    return np.stack([q[keep] for q in spread_out], axis=1), owner


def _moved(screws: Screws, targets: Array) -> tuple[Array, Array]:
    """Return rotation and translation of G = T H^-1, shapes (batch, 3, 3) and (batch, 3)."""
    moved = targets @ inverse_pose(screws.home)
    return moved[:, :3, :3], moved[:, :3, 3]


def _arm(screws: Screws, turn: Array, shift: Array, q6: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the first three joints that bring the wrist centre to its target for given sixth angles.

    Args:
        turn, shift: G, shapes (batch, 3, 3) and (batch, 3).
        q6: shape (batch, angles) or (1, angles).

    Returns:
        Joint values, shape (batch, angles, 4, 3), and whether solutions exist, shape (batch, angles, 4).
    """
    w, p, center = screws.axes, screws.points, screws.center
    assert center is not None
    arm = p[5] + _rotate(w[5], -q6, center - p[5])
    moved = np.einsum("bij,bgj->bgi", turn, arm) + shift[:, None]
    q1, good = _level(w[0], w[1], moved - p[0], float((center - p[0]) @ w[1]))
    flat = p[0] + _rotate(w[0], -q1, (moved - p[0])[:, :, None])
    q2, q3, met = _two_bars(w, p[1], p[2], center, flat)
    q1 = np.broadcast_to(q1[..., None], q2.shape)
    shape = (*moved.shape[:2], 4)
    return np.stack([q1, q2, q3], axis=-1).reshape(*shape, 3), (met & good[..., None]).reshape(shape)


def _turned(screws: Screws, first: Array) -> Array:
    """Return the rotations e1 e2 e3 of the first three joints, shape (..., 3) to (..., 3, 3)."""
    about = [_about(axis, first[..., joint]) for joint, axis in enumerate(screws.axes[:3])]
    return about[0] @ about[1] @ about[2]


def _euler(screws: Screws, turn: Array, first: Array, turned: Array, good: NDArray[np.bool_]) -> tuple[Array, Owner]:
    """Return the last three joints of a spherical wrist; shapes (batch, 4, ...)."""
    w = screws.axes
    rest = np.swapaxes(turned, -1, -2) @ turn[:, None]
    image = rest @ w[5]
    base = np.array([w[3] @ w[5], w[3] @ np.cross(w[4], w[5])])
    spread = np.arccos(np.clip(image @ w[3], -1, 1))
    tilt = np.arctan2(base[1], base[0])
    q5 = np.stack([tilt + spread, tilt - spread], axis=2)
    before = _about(w[4], q5) @ w[5]
    q4 = _turn_between(w[3], before, np.broadcast_to(image[:, :, None], before.shape))
    last = np.swapaxes(_about(w[3], q4) @ _about(w[4], q5), -1, -2) @ rest[:, :, None]
    q6 = _turn_between(w[5], *_pair(last, w[5]))
    arm = np.broadcast_to(first[:, :, None], (*q5.shape, 3))
    keep = np.broadcast_to(good[:, :, None], q5.shape)
    owner = np.broadcast_to(np.arange(len(turn))[:, None, None], q5.shape)[keep]
    return np.concatenate([arm[keep], np.stack([q4[keep], q5[keep], q6[keep]], axis=1)], axis=1), owner


def _offset_equation(screws: Screws, turn: Array, first: Array, q6: Array) -> Array:
    """Return the residual of the offset wrist equation, zero at solutions; shape (batch, angles, 4).

    It is the cosine between the fifth axis at its target and the fourth, e1 e2 e3 w4. With the first axis, the second
    and a third one square to both as a basis, e2 e3 is a turn about the second, to which the third joint is parallel.
    """
    w = screws.axes
    world = np.einsum("bij,bgj->bgi", turn, _rotate(w[5], -q6, w[4]))
    basis = np.array([w[0], w[1], np.cross(w[0], w[1])])
    along, level, side = np.moveaxis(world @ basis.T, 2, 0)[..., None]
    fourth = basis @ w[3]
    q1, q23 = first[..., 0], first[..., 1] + float(np.sign(w[2] @ w[1])) * first[..., 2]
    sin, cos = np.sin(q1), np.cos(q1)
    level, side = cos * level + sin * side, cos * side - sin * level
    sin, cos = np.sin(q23), np.cos(q23)
    return fourth[1] * level + (cos * fourth[2] - sin * fourth[0]) * side + (sin * fourth[2] + cos * fourth[0]) * along


def _finish_offset(
    screws: Screws, turn: Array, shift: Array, q6: Array, branches: NDArray[np.int64], owner: Owner
) -> tuple[Array, Owner]:
    """Return all joints for sixth angles near roots."""
    w = screws.axes
    first, good = _arm(screws, turn, shift, q6[:, None])
    pick = np.arange(len(q6))
    first, good = first[pick, 0, branches], good[pick, 0, branches]
    rest = np.swapaxes(_turned(screws, first), -1, -2) @ turn @ _about(w[5], -q6)
    image = rest @ w[4]
    q4 = _turn_between(w[3], np.broadcast_to(w[4], image.shape), image)
    last = np.swapaxes(_about(w[3], q4), -1, -2) @ rest
    q5 = _turn_between(w[4], *_pair(last, w[4]))
    return np.concatenate([first, np.stack([q4, q5, q6], axis=1)], axis=1)[good], owner[good]


def _about(axis: Array, angle: Array) -> Array:
    """Return rotations about an axis, shape (...) to (..., 3, 3)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sin, cos = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) * cos + cross * sin + np.outer(axis, axis) * (1 - cos)


def _rotate(axis: Array, angle: Array, vector: Array) -> Array:
    """Return vectors rotated about an axis, shapes (...) and (..., 3) to (..., 3)."""
    along = (vector @ axis)[..., None] * axis
    sin, cos = np.sin(angle)[..., None], np.cos(angle)[..., None]
    return along + cos * (vector - along) + sin * np.cross(axis, vector)


def _level(axis: Array, across: Array, arm: Array, level: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return angles q, two each, with `rot(axis, -q) arm . across = level`; shape (..., 3) to (..., 2) and (..., 2)."""
    u, s = arm @ across, arm @ np.cross(axis, across)
    reach = np.hypot(u, s)
    share = level / np.maximum(reach, 1e-12)
    spread = np.arccos(np.clip(share, -1, 1))
    middle = np.arctan2(s, u)
    good = np.abs(share) <= 1 + 1e-9
    return np.stack([middle + spread, middle - spread], axis=-1), np.stack([good, good], axis=-1)


def _two_bars(
    w: Array, start: Array, elbow: Array, end: Array, target: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return second and third angles, two each, that bring two links to a point; shape (..., 3) to (..., 2)."""
    flat = square_to(w[1])
    a, b = flat @ (elbow - start), flat @ (end - elbow)
    t = (target - start) @ flat.T
    la, lb = np.hypot(*a), np.hypot(*b)
    share = ((t**2).sum(axis=-1) - la**2 - lb**2) / (2 * la * lb)
    good = np.abs(share) <= 1 + 1e-9
    spread = np.arccos(np.clip(share, -1, 1))
    bend = np.arctan2(a[1], a[0]) - np.arctan2(b[1], b[0])
    q3 = np.stack([bend + spread, bend - spread], axis=-1)
    cos, sin = np.cos(q3), np.sin(q3)
    x, y = a[0] + cos * b[0] - sin * b[1], a[1] + sin * b[0] + cos * b[1]
    q2 = np.arctan2(t[..., 1], t[..., 0])[..., None] - np.arctan2(y, x)
    return q2, float(np.sign(w[2] @ w[1])) * q3, np.stack([good, good], axis=-1)


def _turn_between(axis: Array, before: Array, after: Array) -> Array:
    """Return the angle about an axis from one vector to another, both seen along the axis; shape (..., 3) to (...)."""
    sin = np.einsum("...i,...i->...", np.cross(before, after), np.broadcast_to(axis, before.shape))
    cos = np.einsum("...i,...i->...", before, after) - (before @ axis) * (after @ axis)
    return np.arctan2(sin, cos)


def _pair(turn: Array, axis: Array) -> tuple[Array, Array]:
    """Return a vector orthogonal to an axis, and its image under rotations about the axis, shape (..., 3)."""
    helper = square_to(axis)[0]
    image = turn @ helper
    return np.broadcast_to(helper, image.shape), image

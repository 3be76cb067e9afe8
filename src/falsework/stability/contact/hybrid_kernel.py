"""Compiled holds that control the force along one line, and the position of the part across it."""

from __future__ import annotations

from falsework.utils.kernels import njit

LOCKED = -1.0
"""Mark of a hold that lets a part move along one line only."""


@njit(cache=True)
def along_line(contact, j, motion):
    """Leave of a motion or wrench of a part, row `j` of shape (n, 6), what is along the line of its hold."""
    line = contact.line
    size = motion[j, 0] * line[j, 0] + motion[j, 1] * line[j, 1] + motion[j, 2] * line[j, 2]
    for r in range(3):
        motion[j, r], motion[j, 3 + r] = size * line[j, r], 0.0


@njit(cache=True)
def add_across(contact, j, displacement, factor, out):
    """Add `factor` times the wrench of the spring across the line of a hold, beyond that of `grip`."""
    line, more = contact.line, factor * (contact.across[j] - contact.grip[j])
    size = displacement[j, 0] * line[j, 0] + displacement[j, 1] * line[j, 1] + displacement[j, 2] * line[j, 2]
    for r in range(3):
        out[j, r] += more * (displacement[j, r] - size * line[j, r])
        out[j, 3 + r] += more * displacement[j, 3 + r]


@njit(cache=True)
def resist_across(contact, j, displacement, out):
    """Balance a part across the line of its hold: by the spring of the robot, or whatever it takes."""
    if contact.across[j] == LOCKED:
        along_line(contact, j, out)
    else:
        add_across(contact, j, displacement, -1.0, out)

"""States, legal actions and transitions.

A state is a `uint8` vector over parts: 0 removed, 1 installed, 2 held; boundary parts are always 2 and
use no robot. Every function takes a batch `(batch, parts)` and works on whole batches at once.
Actions are indices in `[0, 2 parts)`: `i` holds part `i`, `parts + i` removes part `i` (paper, section 3).
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import index

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.errors import InputError, StateError

REMOVED, INSTALLED, HELD = 0, 1, 2
MOST_ROBOTS = 1_000_000
"""More robots than any structure has parts; a plan file could not hold any number."""

States = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def complete_state(boundary: Mask) -> States:
    """Return the state with every part installed and none held. Shape (parts,)."""
    return np.where(boundary, HELD, INSTALLED).astype(np.uint8)


def empty_state(boundary: Mask) -> States:
    """Return the state with only the boundary present. Shape (parts,)."""
    return np.where(boundary, HELD, REMOVED).astype(np.uint8)


def as_states(states: ArrayLike, boundary: Mask) -> States:
    """Validate states and return them as a batch.

    Args:
        states: one state `(parts,)` or a batch `(batch, parts)` of 0 removed, 1 installed, 2 held.

    Returns:
        Contiguous copy-free where possible, `uint8`, shape (batch, parts).
    """
    parts = len(boundary)
    try:
        array = np.asarray(states)
    except ValueError:
        raise StateError(f"states have different lengths; each needs {parts} values, one a part") from None
    if array.dtype == object or not (np.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise StateError(f"states must be numbers 0, 1 or 2, not {array.dtype}")
    if array.ndim == 1:
        if len(array) != parts:
            raise StateError(f"a state of {len(array)} values does not fit {parts} parts; give one value for each part")
        array = array[None]
    if array.ndim != 2 or array.shape[1] != parts:
        raise StateError(f"states have shape {array.shape}; expected (batch, {parts}), one value for each part")
    bad = (array != REMOVED) & (array != INSTALLED) & (array != HELD)
    if bad.any():
        row, part = np.argwhere(bad)[0]
        raise StateError(
            f"state {row} has value {array[row, part]} at part {part}; use 0 (removed), 1 (installed) or 2 (held)"
        )
    loose = boundary[None] & (array != HELD)
    if loose.any():
        row, part = np.argwhere(loose)[0]
        raise StateError(f"state {row} has boundary part {part} as {array[row, part]}; boundary parts are always 2")
    return np.ascontiguousarray(array, dtype=np.uint8)


def state_of_key(key: bytes) -> States:
    """Return the state whose bytes are a key, shape (parts,), read-only."""
    return np.frombuffer(key, dtype=np.uint8)


def check_robots(robots: int) -> int:
    """Return the number of robots, or raise `InputError` if it is no whole number from one to `MOST_ROBOTS`."""
    try:
        robots = index(robots)
    except TypeError:
        raise InputError(f"the number of robots is {robots!r}; give a whole number") from None
    if robots < 1:
        raise InputError(f"{robots} robots cannot hold anything; give at least 1")
    if robots > MOST_ROBOTS:
        raise InputError(f"{robots} robots are too many; give at most {MOST_ROBOTS}")
    return robots


def held_count(states: States, boundary: Mask) -> NDArray[np.int64]:
    """Return the number of parts that robots hold, shape (batch,)."""
    return ((states == HELD) & ~boundary).sum(axis=-1)


def action_mask(states: States, boundary: Mask, robots: int) -> Mask:
    """Return actions that the rules of disassembly allow, stability aside.

    A part is held at most once, at most `robots` parts are held, and only a held part can be removed.

    Args:
        robots: parts that can be held at a time.

    Returns:
        Shape (batch, 2 parts); `[:, i]` hold part `i`, `[:, parts + i]` remove part `i`.
    """
    free_robot = held_count(states, boundary) < robots
    hold = (states == INSTALLED) & free_robot[:, None]
    remove = (states == HELD) & ~boundary
    return np.concatenate([hold, remove], axis=1)


def apply_actions(states: States, actions: NDArray[np.integer]) -> States:
    """Return states after one action each: hold sets 2, remove sets 0. Shapes (batch, parts), (batch,)."""
    return _changed(states, actions, HELD, REMOVED)


def undo_mask(states: States, boundary: Mask, robots: int) -> Mask:
    """Return actions that can have led to each state, stability aside: the moves of assembly.

    Undoing a hold releases a held part; undoing a removal installs a part that a robot then holds.

    Args:
        robots: parts that can be held at a time.

    Returns:
        Shape (batch, 2 parts), indexed like `action_mask`.
    """
    held = (states == HELD) & ~boundary
    free_robot = held.sum(axis=1) < robots
    insert = (states == REMOVED) & free_robot[:, None]
    return np.concatenate([held, insert], axis=1)


def undo_actions(states: States, actions: NDArray[np.integer]) -> States:
    """Return states before one action each: the reverse of `apply_actions`. Shapes (batch, parts), (batch,)."""
    return _changed(states, actions, INSTALLED, HELD)


def _changed(states: States, actions: NDArray[np.integer], hold: int, remove: int) -> States:
    """Return states with the value of a part changed in each: the first for actions that hold, else the second."""
    if states.ndim != 2 or np.shape(actions) != states.shape[:1]:
        raise StateError(
            f"states have shape {states.shape} and actions {np.shape(actions)}; expected (batch, parts) and (batch,)"
        )
    batch, parts = states.shape
    wrong = (actions < 0) | (actions >= 2 * parts)
    if wrong.any():
        raise StateError(f"action {actions[wrong][0]} does not exist; actions are numbered 0 to {2 * parts - 1}")
    changed = states.copy()
    changed[np.arange(batch), actions % parts] = np.where(actions < parts, hold, remove)
    return changed


STEP_WORDS = {
    (INSTALLED, HELD): "hold",
    (HELD, INSTALLED): "release",
    (HELD, REMOVED): "remove",
    (REMOVED, HELD): "insert",
}
"""Name of a step, by the value of its part before and after."""


def describe_step(before: States, after: States, names: Sequence[str]) -> str:
    """Describe the step between two states one move apart, such as `hold 7` or `insert keystone`."""
    part = int((before != after).argmax())
    return f"{STEP_WORDS[int(before[part]), int(after[part])]} {names[part]}"


def describe_action(action: int, names: tuple[str, ...] | list[str]) -> str:
    """Describe one action, such as `hold 7` or `remove keystone`."""
    parts = len(names)
    return f"{'hold' if action < parts else 'remove'} {names[action % parts]}"

"""Ways in which parts leave in one step of a task: one or several, straight or in several moves."""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from falsework.assembly.state import HELD, Mask, States
from falsework.geometry.clearance.locked import MOST_SETS, PartSet
from falsework.geometry.clearance.moves import ExitPath
from falsework.search.problem.task import Task


def sets_of(task: Task, movable: Mask, most: int = MOST_SETS) -> tuple[tuple[PartSet, ...], str]:
    """Return the sets of two parts and more, among parts of shape (parts,), that may leave together in a task.

    With several moves those are all sets, since moves of others may open any; as long as there are at most `most`.

    Returns:
        The sets; and why others may, which is empty if none can.

    Raises:
        InputError: so many sets that they cannot be examined.
    """
    if task.together is None:
        return (), ""
    if task.moves_out == 1:
        return task.together.sets(movable), ""
    every, largest = np.flatnonzero(movable).tolist(), min(task.together.largest, int(movable.sum()))
    count = sum(comb(len(every), size) for size in range(2, largest + 1))
    if count > most:
        return task.together.sets(movable), f"of {count} sets of parts those were tried that lock each other in place"
    return tuple(some for size in range(2, largest + 1) for some in combinations(every, size)), ""


def exit_path(task: Task, state: States, leaving: PartSet) -> ExitPath | None:
    """Return the moves in which parts leave a state in one step of a task; none of them where they leave straight.

    Args:
        state: shape (parts,), with the parts in it.
        leaving: one part, or several that leave together: each held by a robot, or all carried by that of one.

    Returns:
        None if they do not leave, or fewer of several do.
    """
    if task.clearance is None:
        return ()
    if len(leaving) == 1 or task.together is None:
        return task.clearance.exit_path(state, leaving)
    apart = bool((state[list(leaving)] == HELD).all())
    if task.together.clearance.leave_together(leaving, state[None], apart=apart)[0]:
        return ()
    if task.moves_out == 1 or task.clearance.can_leave(state[None])[0, list(leaving)].any():
        return None
    fewer = (some for count in range(2, len(leaving)) for some in combinations(leaving, count))
    if any(exit_path(task, state, some) is not None for some in fewer):
        return None
    return task.clearance.exit_path(state, leaving)

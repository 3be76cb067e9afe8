"""States and actions."""

from __future__ import annotations

import numpy as np
import pytest

from falsework.assembly import HELD, INSTALLED, REMOVED
from falsework.assembly.state import apply_actions, undo_actions
from falsework.errors import StateError

STATES = np.array([[INSTALLED, HELD, HELD], [HELD, INSTALLED, HELD]], np.uint8)


def test_undone_actions_leave_nothing_behind() -> None:
    actions = np.array([0, 3])  # hold part 0; remove part 0
    after = apply_actions(STATES, actions)
    np.testing.assert_array_equal(after, [[HELD, HELD, HELD], [REMOVED, INSTALLED, HELD]])
    np.testing.assert_array_equal(undo_actions(after, actions), STATES)


@pytest.mark.parametrize("step", [apply_actions, undo_actions])
@pytest.mark.parametrize(
    ("states", "actions", "message"),
    [
        (STATES, [0, 6], "action 6 does not exist; actions are numbered 0 to 5"),
        (STATES, [-1, 0], "action -1 does not exist"),
        (STATES, [0], r"states have shape \(2, 3\) and actions \(1,\)"),
        (STATES[0], [0], r"states have shape \(3,\)"),
    ],
)
def test_actions_that_do_not_exist_are_refused(step, states, actions, message) -> None:
    with pytest.raises(StateError, match=message):
        step(states, np.array(actions))

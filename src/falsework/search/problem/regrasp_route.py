"""Routes with repeated holds: states, and the actions derived from them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from falsework.assembly.state import REMOVED, States, state_of_key
from falsework.search.problem.result import Route


class RegraspRoute(Route):
    """Route in which parts may be released and held again.

    Action `i` holds part `i`, or releases it if it is held; `parts + i` removes it, or places it if it is a prop.
    """

    @classmethod
    def from_states(cls, states: States) -> RegraspRoute:
        """Return the route through consecutive states, each one move from the next, in disassembly order."""
        return cls(states, actions_between(states))

    @classmethod
    def from_parents(cls, last: bytes, parent: Mapping[bytes, bytes], parts: int) -> RegraspRoute:
        """Return the route to a state through the states that each was reached from; the first has none."""
        chain = []
        while last:
            chain.append(state_of_key(last))
            last = parent[last]
        return cls.from_states(np.array(chain[::-1]).reshape(-1, parts))


def actions_between(states: States) -> np.ndarray:
    """Return the action between each state and the next, shape (states - 1,)."""
    changed = states[1:] != states[:-1]
    part, rows = changed.argmax(axis=1), np.arange(len(changed))
    ends = states[:-1][rows, part], states[1:][rows, part]
    presence = (ends[0] == REMOVED) | (ends[1] == REMOVED)
    return np.where(presence, part + states.shape[1], part).astype(np.int64)

"""Contact histories of the states of a beam with repeated holds, in the order of assembly."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from falsework.assembly.state import States, state_of_key
from falsework.search.beam.settings import HISTORY_BYTES

if TYPE_CHECKING:
    from falsework.stability.contact.history import History
    from falsework.stability.contact.varied_replay import AnyReplayer


class PathHistories:
    """Contact history of each state, along the path by which it was reached first."""

    def __init__(self, replayer: AnyReplayer, parent: Mapping[bytes, bytes]) -> None:
        """Begin with nothing.

        Args:
            replayer: of the structure.
            parent: state that each state was reached from, empty for the origin; the search that owns it adds to it.
        """
        self._replayer, self._parent = replayer, parent
        self._known: OrderedDict[bytes, History] = OrderedDict()

    def along(self, origin: bytes, states: Sequence[States]) -> list[History] | None:
        """Return the histories after each of some moves from a state; None where one does not come to rest."""
        history, before = self._of(origin), state_of_key(origin)
        found = []
        for after in states:
            stands, history = (False, None) if history is None else self._replayer.step(history, before, after)
            if not stands or history is None:
                return None
            found.append(history)
            before = after
        return found

    def keep(self, states: Sequence[States], histories: Sequence[History]) -> None:
        """Store the histories of states that were reached for the first time."""
        for state, history in zip(states, histories, strict=True):
            self._known.setdefault(state.tobytes(), history)
        while histories and len(self._known) > max(HISTORY_BYTES // max(histories[-1].nbytes, 1), 4):
            self._known.popitem(last=False)

    def _of(self, state: bytes) -> History | None:
        """Return the history of a state, along its path from the last state whose history is known."""
        path = [state]
        while path[-1] not in self._known and self._parent[path[-1]]:
            path.append(self._parent[path[-1]])
        first = path.pop()
        if first not in self._known:
            start = self._replayer.replay(state_of_key(first)[None])
            if not start.histories:
                return None
            self._known[first] = start.histories[0]
        states = [state_of_key(key) for key in reversed(path)]
        history = self._known[first]
        if states:
            found = self.along(first, states)
            if found is None:
                return None
            self.keep(states, found)
            history = found[-1]
        return history

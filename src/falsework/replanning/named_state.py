"""States given by the names of the parts that stand and of those that are held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.model import Assembly
from falsework.assembly.part_numbers import part_id, part_ids
from falsework.assembly.props import whole_state
from falsework.assembly.state import HELD, INSTALLED, States, as_states, empty_state
from falsework.errors import StateError

StateLike: TypeAlias = ArrayLike | Mapping[str, Sequence[int | str]]
"""One value a part, `complete`, `empty`, or an object such as `{"standing": ["row0"], "held": ["row1"]}`."""
STANDING, HELD_PARTS = "standing", "held"
"""Keys of a state that is given by its parts."""


def named_state(given: StateLike, assembly: Assembly, what: str = "the state") -> States:
    """Return a state that is given as values or by the parts that stand and that are held.

    Args:
        given: one value a part, shape (parts,); `complete`; `empty`; or an object with lists of numbers, ranges or
            names of parts, `standing` for those that stand by themselves and `held` for those that robots hold. All
            others are removed, boundary parts apart.
        what: begins the message.

    Returns:
        Shape (parts,).
    """
    if isinstance(given, str):
        if given not in ("complete", "empty"):
            raise StateError(f"{what} is {given!r}; give complete, empty, or one value a part")
        return whole_state(assembly) if given == "complete" else empty_state(assembly.boundary)
    if not isinstance(given, Mapping):
        states = as_states(given, assembly.boundary)
        if len(states) != 1:
            raise StateError(f"{what} holds {len(states)} states; give one, of shape ({assembly.part_count},)")
        return states[0]
    unknown = sorted(set(given) - {STANDING, HELD_PARTS})
    if unknown:
        raise StateError(f"{what} has an unknown entry {unknown[0]!r}; give {STANDING} and {HELD_PARTS}")
    parts = {key: _parts(given.get(key, ()), assembly, f"{what}: {key}") for key in (STANDING, HELD_PARTS)}
    both = sorted(set(parts[STANDING]) & set(parts[HELD_PARTS]) - set(np.flatnonzero(assembly.boundary).tolist()))
    if both:
        raise StateError(f"{what}: part {assembly.names[both[0]]} both stands by itself and is held; name it once")
    state = empty_state(assembly.boundary)
    for key, value in ((STANDING, INSTALLED), (HELD_PARTS, HELD)):
        chosen = np.array(parts[key], dtype=np.intp)
        state[chosen[~assembly.immovable[chosen]]] = value
    return state


def _parts(given: Sequence[int | str], assembly: Assembly, what: str) -> tuple[int, ...]:
    """Return the numbers of parts, all of which exist."""
    return tuple(part_id(part, assembly.names, f"{what} is part") for part in part_ids(given, assembly.names, what))

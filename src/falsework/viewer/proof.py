"""The verdict on one state with its proof, in words and as arrows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import INSTALLED, States
from falsework.stability.oracle import Stability
from falsework.viewer.arrows import Arrows, arrows_of_forces, arrows_of_motion, moved_parts

_NAMED = 3


@dataclass(frozen=True, eq=False)
class StateProof:
    """Whether a state stands, and why."""

    stable: bool
    decided: bool
    words: str
    """One line for people."""
    arrows: dict[str, Arrows]
    """By what they show: contact forces, friction, gravity; or motion."""
    moved: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """Of an unstable state: vertices of the parts that move, a little later; by part, shape (vertices, 3)."""


def proof_of_state(oracle: Stability, state: States) -> StateProof:
    """Ask for the verdict on a state and turn its proof into arrows.

    Args:
        oracle: decides stability.
        state: shape (parts,).

    Raises:
        StateError: not a state of the oracle's structure.
    """
    assembly = oracle.assembly
    verdicts = oracle.check(state)
    if verdicts.stable[0]:
        assert verdicts.forces is not None
        free = int((state == INSTALLED).sum())
        words = f"stable: contact forces balance {free} free parts" if free else "stable: every part is held"
        return StateProof(True, True, words, arrows_of_forces(assembly, state, verdicts.forces[0]))
    if not verdicts.unstable[0]:
        return StateProof(False, False, "neither stable nor unstable could be proven", {})
    assert verdicts.velocity is not None
    velocity = verdicts.velocity[0]
    moved = moved_parts(assembly, state, velocity)
    speed = np.linalg.norm(velocity[:, :3], axis=1)
    order = sorted(moved, key=lambda part: -speed[part])
    named = ", ".join(assembly.names[part] for part in order[:_NAMED])
    more = f" and {len(order) - _NAMED} more" if len(order) > _NAMED else ""
    words = f"unstable: {named}{more} would move"
    weight = arrows_of_forces(assembly, state, np.zeros((len(assembly.contacts.points), 3)))["gravity"]
    return StateProof(
        False, True, words, {"gravity": weight, "motion": arrows_of_motion(assembly, state, velocity)}, moved
    )

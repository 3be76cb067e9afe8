"""Verdicts on states with their proofs, as text, arrows and marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, States
from falsework.stability.motion import motion_of
from falsework.stability.oracle import Stability
from falsework.stability.verdict import Verdicts
from falsework.viewer.arrows import Arrows, arrows_of_forces, arrows_of_motion, moved_parts
from falsework.viewer.palette import MOTION, SLIDING

_NAMED = 3
_TIPS = "forces balance every part, but a small motion grows"
_WHY = "balancing forces exist, but the contacts do not develop them"
_AT_ONCE = 64
"""States whose contact forces are in memory at the same time."""


@dataclass(frozen=True, eq=False)
class StateProof:
    """Stability of a state, with its proof."""

    stable: bool
    decided: bool
    words: str
    """Summary in one line."""
    arrows: dict[str, Arrows]
    """Arrows by kind: contact forces, friction, gravity; or motion; or sliding."""
    moved: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """For a state that is not stable: displaced vertices of the moving parts; by part, shape (vertices, 3)."""
    slides: bool = False
    """Whether forces in equilibrium exist although parts move: only under the criterion `contact`."""
    tips: bool = False
    """Whether they move because the equilibrium is unstable."""

    @property
    def verdict(self) -> str:
        """One word for captions."""
        if self.slides:
            return "tips" if self.tips else "slides"
        return "stable" if self.stable else "unstable" if self.decided else "undecided"

    @property
    def motion_color(self) -> str:
        """Colour of the parts slightly later in their motion."""
        return SLIDING if self.slides else MOTION

    @property
    def marks(self) -> dict[int, str]:
        """Colours of the parts that slide, by part."""
        return dict.fromkeys(self.moved, SLIDING) if self.slides else {}


def proof_of_state(oracle: Stability, state: States) -> StateProof:
    """Request the verdict on a state and convert its proof into arrows.

    Args:
        oracle: decides stability.
        state: shape (parts,).

    Raises:
        StateError: not a state of the oracle's structure.
    """
    return _proof(oracle.assembly, state, oracle.check(state), 0)


def proofs_of_states(oracle: Stability, states: States) -> list[StateProof]:
    """Prove several states as `proof_of_state`.

    Args:
        oracle: decides stability.
        states: shape (states, parts).

    Raises:
        StateError: not states of the oracle's structure.
    """
    proofs = []
    for first in range(0, len(states), _AT_ONCE):
        some = states[first : first + _AT_ONCE]
        verdicts = oracle.check(some)
        proofs += [_proof(oracle.assembly, state, verdicts, row) for row, state in enumerate(some)]
    return proofs


def _proof(assembly: Assembly, state: States, verdicts: Verdicts, row: int) -> StateProof:
    if verdicts.stable[row]:
        assert verdicts.forces is not None
        free = int((state == INSTALLED).sum())
        words = f"stable: contact forces balance {free} free parts" if free else "stable: every part is held"
        return StateProof(True, True, words, arrows_of_forces(assembly, state, verdicts.forces[row]))
    tips = bool(verdicts.tips[row])
    slides = bool(verdicts.slides[row]) or tips
    if not (slides or verdicts.unstable[row]):
        return StateProof(False, False, "neither stable nor unstable could be proven", {})
    motion = motion_of(assembly, verdicts, row)
    moved: dict[int, NDArray[np.float64]] = {} if motion is None else moved_parts(assembly, state, motion)
    weighed = state.copy()
    if slides:  # the arrow of a part that slides down would lie on that of its weight
        weighed[list(moved)] = HELD
    arrows = {"gravity": arrows_of_forces(assembly, weighed, np.zeros((len(assembly.contacts.points), 3)))["gravity"]}
    if motion is None:  # a state that slides which the exact solver decided
        return StateProof(False, True, f"slides: {_WHY}", arrows, moved, slides)
    kind = "sliding" if slides else "motion"
    arrows[kind] = arrows_of_motion(assembly, state, motion, kind)
    speed = np.linalg.norm(motion[:, :3], axis=1)
    named = _named(assembly, sorted(moved, key=lambda part: -speed[part]))
    words = f"slides: {named} would slide; {_WHY}" if slides else f"unstable: {named} would move"
    if tips:
        words = f"tips: {named} would move; {_TIPS}"
    return StateProof(False, True, words, arrows, moved, slides, tips)


def _named(assembly: Assembly, parts: Sequence[int]) -> str:
    """Return the first parts by name, and how many more there are."""
    more = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
    return ", ".join(assembly.names[part] for part in parts[:_NAMED]) + more

"""Verdicts on states with their proofs, as text, arrows and marks.

Under the criterion `contact` there are two: a state of a plan is judged as built, by the steps that lead to it,
any other state from rest, all its loads at once. The text says which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, States
from falsework.search.plans.plan import Plan
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import Press
from falsework.stability.motion import motion_of
from falsework.stability.oracle import StabilityOracle
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Verdicts
from falsework.utils.quantity import counted, format_quantity, listed
from falsework.viewer.arrows import Arrows, arrows_of_forces, arrows_of_motion, moved_parts
from falsework.viewer.palette import MOTION, SLIDING

_NAMED = 3
"""Parts that a text names; the rest is counted."""
_TIPS = "forces balance every part, but a small motion grows"
_WHY = "balancing forces exist, but the contacts do not develop them"
_REST, _BUILT = "from rest", "as built"
_AT_ONCE = 64
"""States whose contact forces are in memory at the same time, and proofs that are kept."""


@dataclass(frozen=True, eq=False)
class StateProof:
    """Stability of a state, with its proof."""

    stable: bool
    decided: bool
    words: str
    """Summary in one line."""
    arrows: dict[str, Arrows]
    """Arrows by kind: contact forces, friction, gravity, presses; or motion; or sliding."""
    moved: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """For a state that is not stable: displaced vertices of the moving parts; by part, shape (vertices, 3)."""
    slides: bool = False
    """Whether forces in equilibrium exist although parts move: only under the criterion `contact`."""
    tips: bool = False
    """Whether they move because the equilibrium is unstable."""
    forces: NDArray[np.float64] | None = None
    """Contact forces `(n, t1, t2)` of a stable state, N, shape (points, 3)."""

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


def proof_of_state(oracle: StabilityOracle, state: States) -> StateProof:
    """Request the verdict on a state, under `contact` from rest, and convert its proof into arrows."""
    return proofs_of_states(oracle, state[None])[0]


def proofs_of_states(oracle: StabilityOracle, states: States) -> list[StateProof]:
    """Prove several states as `proof_of_state`."""
    how = _REST if oracle.settings.criterion == "contact" else ""
    proofs = []
    for first in range(0, len(states), _AT_ONCE):
        some = states[first : first + _AT_ONCE]
        verdicts = oracle.verdicts(some, require_certificate=True)
        proofs += [_proof(oracle, state, verdicts, row, how) for row, state in enumerate(some)]
    return proofs


class BuildProofs:
    """Proofs of the states of a plan under `contact`, as built.

    The plan is built step by step, with its presses, up to the last state that is asked for; each step once. Whether a
    state at rest tips was asked when the plan was accepted, and is not asked again.
    """

    def __init__(self, plan: Plan, oracle: StabilityOracle) -> None:
        """Begin before the first step.

        Args:
            oracle: of its structure, under `contact` and the gravity of the plan; judges from rest what the build does
                not reach.
        """
        settings = replace(oracle.settings, reserve=plan.claim.reserve, holds=plan.claim.holds)
        assembly = oracle.assembly
        self._assembly, self._oracle, self._tolerance = assembly, oracle, settings.tolerance
        self._states, self._presses = plan.states, plan.presses_before
        self._verifier = BuildVerifier(assembly, settings.claim)
        self._certificates = Replayer(assembly, settings).certificates(self._states, self._presses)
        self._forces = StateArrays(len(self._states), len(assembly.contacts.points), 3)
        self._reached = 0
        self._ended = ""

    def at(self, place: int) -> StateProof:
        """Return the proof of the state after so many steps."""
        self._build(place)
        state = self._states[place]
        if place < self._reached:
            return _stable(self._oracle, state, self._forces[place], _BUILT, self._presses[place])
        rest = proof_of_state(self._oracle, state)
        if place > self._reached or not rest.stable:
            return rest
        why = f"slides: parts do not come to rest {_BUILT}{self._ended}, only {_REST}"
        return replace(rest, stable=False, words=why, arrows={}, slides=True, forces=None)

    def _build(self, place: int) -> None:
        """Go on to a state, or to the first that does not come to rest."""
        while self._reached <= place and not self._ended:
            certificate = next(self._certificates, None)
            if certificate is None:
                self._ended = " (the build ends there)"
                return
            proof = self._verifier.step(self._states[self._reached], certificate)
            if not proof.residual <= self._tolerance:
                why = proof.reason or f"forces leave {format_quantity(proof.residual, 'share')} of gravity"
                self._ended = f" ({why})"
                return
            self._forces[np.array([self._reached])] = proof.forces[None]
            self._reached += 1


class ProofCache:
    """The last proofs of states: of a plan as built, under `contact`; of others from rest."""

    def __init__(self, *, contact: bool) -> None:
        self._contact = contact
        self._proofs: dict[int | bytes, StateProof] = {}
        self._plan: Plan | None = None
        self._build: BuildProofs | None = None

    def find(self, plan: Plan | None, row: int, state: States) -> StateProof | None:
        """Return a proof that is known; the arguments are those of `prove`."""
        return self._proofs.get(self._key(plan, row, state))

    def prove(self, oracle: StabilityOracle, plan: Plan | None, row: int, state: States) -> StateProof:
        """Return the proof of a state, shape (parts,): a row of a plan; without a plan one that none has reached."""
        key = self._key(plan, row, state)
        if key not in self._proofs:
            if len(self._proofs) >= _AT_ONCE:
                del self._proofs[next(iter(self._proofs))]
            if plan is not None and self._contact:
                self._build = self._build or BuildProofs(plan, oracle)
            self._proofs[key] = self._build.at(row) if self._build and plan else proof_of_state(oracle, state)
        return self._proofs[key]

    def _key(self, plan: Plan | None, row: int, state: States) -> int | bytes:
        """Return the row of a state of a plan under `contact`, else the state; another plan begins anew."""
        if plan is None or not self._contact:
            return state.tobytes()
        if plan is not self._plan:
            self._plan, self._build = plan, None
            self._proofs.clear()
        return row


def _stable(
    oracle: StabilityOracle, state: States, forces: NDArray[np.float64], how: str, presses: Sequence[Press] = ()
) -> StateProof:
    free = int((state == INSTALLED).sum())
    words = f"stable: contact forces balance {counted(free, 'free part')}" if free else "stable: every part is held"
    arrows = arrows_of_forces(oracle.assembly, state, forces, presses, gravity=oracle.settings.gravity)
    return StateProof(True, True, words + _said(how), arrows, forces=forces)


def _said(how: str) -> str:
    """Return in brackets how a state was judged."""
    return f" ({how})" if how else ""


def _proof(oracle: StabilityOracle, state: States, verdicts: Verdicts, row: int, how: str) -> StateProof:
    assembly = oracle.assembly
    if verdicts.stable[row]:
        assert verdicts.forces is not None
        return _stable(oracle, state, verdicts.forces[row], how)
    tips = bool(verdicts.tips[row])
    slides = bool(verdicts.slides[row]) or tips
    if not (slides or verdicts.unstable[row]):
        return StateProof(False, False, f"neither stable nor unstable could be proven{_said(how)}", {})
    motion = motion_of(assembly, verdicts, row)
    moved: dict[int, NDArray[np.float64]] = {} if motion is None else moved_parts(assembly, state, motion)
    weighed = state.copy()
    if slides:  # the arrow of a part that slides down would lie on that of its weight
        weighed[list(moved)] = HELD
    none, gravity = np.zeros((len(assembly.contacts.points), 3)), oracle.settings.gravity
    arrows = {"gravity": arrows_of_forces(assembly, weighed, none, gravity=gravity)["gravity"]}
    if motion is None:  # a state that slides which the exact solver decided
        return StateProof(False, True, f"slides: {_WHY}{_said(how)}", arrows, moved, slides)
    kind = "sliding" if slides else "motion"
    arrows[kind] = arrows_of_motion(assembly, state, motion, kind)
    speed = np.linalg.norm(motion[:, :3], axis=1)
    named = listed([assembly.names[part] for part in sorted(moved, key=lambda part: -speed[part])], _NAMED)
    # Velocities that prove a state unstable do so however it was reached.
    words = f"slides: {named} would slide; {_WHY}{_said(how)}" if slides else f"unstable: {named} would move"
    if tips:
        words = f"tips: {named} would move; {_TIPS}{_said(how)}"
    return StateProof(False, True, words, arrows, moved, slides, tips)

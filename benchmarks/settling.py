"""States and sequences of states settled by the discrete elements of the package, for comparisons and tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import as_states
from falsework.errors import InputError
from falsework.stability.holds import HoldSettings, Press
from falsework.stability.judges.discrete_elements import Build, DiscreteElementSettings, added_wrenches
from falsework.stability.judges.relaxation import FALLS

Array = NDArray[np.float64]

IN_TURN = DiscreteElementSettings(stiffness=0.05, steps=30_000), DiscreteElementSettings(stiffness=5.0, steps=30_000)
"""Soft springs, on which states come to rest, or collapse, in the fewest steps; what collapses is tried on stiff ones.
Between joints nearly parallel to the load, parts slip by thousands of times their settlement before they jam."""


@dataclass(frozen=True, eq=False)
class Settling:
    """Results of the relaxation, one entry per state."""

    stands: NDArray[np.int8]
    """1 stable, -1 collapses, 0 undecided at the step limit. Shape (states,)."""
    moved: Array
    """Largest displacement of a part, metres: of its centre of mass, plus rotation times half the diagonal of its
    bounding box; infinite for a part without contacts. Shape (states,)."""
    part: NDArray[np.int32]
    """Part that moved most; -1 where no part is free to move. Shape (states,)."""

    @classmethod
    def of(cls, answers: Sequence[tuple[int, float, int]]) -> Settling:
        """Collect the answers of `Build.step`."""
        stands, moved, part = zip(*answers, strict=True) if answers else ((), (), ())
        return cls(np.array(stands, np.int8), np.array(moved, float), np.array(part, np.int32))


def settle(
    assembly: Assembly,
    states: ArrayLike,
    settings: DiscreteElementSettings | None = None,
    forces: ArrayLike | None = None,
) -> Settling:
    """Check states: gravity is ramped up on an unstressed structure, which is stable if it comes to rest.

    Args:
        states: one state (parts,) or a batch (batch, parts).
        settings: springs, damping and step limit; those of `IN_TURN` if not given.
        forces: initial contact forces, none by default, N, shape (batch, points, 3), such as those of a verdict.
            Where the verdict is right, the state is at rest with them from the first step.

    Raises:
        InputError: forces of the wrong shape, or a structure with joints.
        StateError: states of the wrong shape or with wrong values.
    """
    batch, answers = as_states(states, assembly.boundary), []
    builds = [Build(assembly, some) for some in (IN_TURN if settings is None else (settings,))]
    expected = len(batch), len(assembly.contacts.points), 3
    begin = np.zeros(expected) if forces is None else np.asarray(forces, float)
    if begin.shape != expected:
        raise InputError(f"forces have shape {begin.shape}; expected {expected}")
    for state, force in zip(batch, begin, strict=True):
        for build in builds:
            build.forces = build.unstressed(force)
            answer = build.step(state, {})
            if answer[0] != FALLS:
                break
        answers.append(answer)
    return Settling.of(answers)


def replay_by_discrete_elements(
    assembly: Assembly,
    states: ArrayLike,
    settings: DiscreteElementSettings | None = None,
    *,
    presses: Sequence[Sequence[Press]] | None = None,
    holds: HoldSettings = HoldSettings(),
) -> Settling:
    """Build a structure state by state, keeping compression and slip of every contact point; see `Build`.

    Args:
        states: in assembly order, shape (steps + 1, parts); the first one has no history.
        settings: springs of contacts, damping and step limit; those of `IN_TURN` if not given.
        presses: those of the step that leads to each state, one entry a state; none by default.
        holds: stiffness and mode of the robots.

    Returns:
        An entry for each state up to the first that collapses, which is the last entry; an undecided one does not end
        the replay. `moved` is relative to the previous state.

    Raises:
        InputError: presses of the wrong number, or on a part that is not held before and after its step; or joints.
        StateError: states of the wrong shape or with wrong values.
    """
    batch = as_states(states, assembly.boundary)
    added = added_wrenches(assembly, batch, presses)
    for some in IN_TURN if settings is None else (settings,):
        build, answers = Build(assembly, some, holds), list[tuple[int, float, int]]()
        for state, press in zip(batch, added, strict=True):
            answers.append(build.step(state, press))
            if answers[-1][0] == FALLS:
                break
        if answers[-1][0] != FALLS:
            break
    return Settling.of(answers)

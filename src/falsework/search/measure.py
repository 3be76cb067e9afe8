"""Measurement of the margins of a plan or of states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from numpy.typing import ArrayLike

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import complete_state
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_check import check_identity
from falsework.stability.contact.history import History
from falsework.stability.contact.replay import Replayer
from falsework.stability.margins.state_margins import StateMargins
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings


def margins(
    assembly: AnyStructure,
    subject: Plan | ArrayLike | None = None,
    kinds: Sequence[str] | None = None,
    *,
    stability: StabilitySettings | None = None,
    deadline: float | None = None,
) -> list[StateMargins]:
    """Measure how far friction, tilt, loads and pushes are from the limit of stability.

    States of a plan under `contact` are measured as built, see `histories_as_built`; others from rest.

    Args:
        assembly: the structure, or its name or path.
        subject: a plan, for all its states; or a state, shape (parts,), or states, shape (states, parts). The complete
            structure if not given.
        kinds: margins to measure; by default all but the polygon of tilts and the settlement of supports.
        stability: criterion and gravity; those of the plan if not given.
        deadline: seconds for each state after which searches return what they have proven.

    Returns:
        One entry a state, each value with a certificate on both sides of its bound.

    Raises:
        PlanError: a plan for another structure.
        InputError: a margin that is not defined under the criterion, or a deadline of zero or less.
        StateError: states of the wrong length or with other values.
    """
    assembly, settings = as_assembly(assembly), stability or StabilitySettings()
    histories: Sequence[History] = ()
    if isinstance(subject, Plan):
        check_identity(subject, assembly)
        if stability is None:
            settings = StabilitySettings.from_claim(subject.claim)
        histories = histories_as_built(subject, assembly, settings, range(len(subject.states)))
        subject = subject.states
    states = complete_state(assembly.boundary) if subject is None else subject
    return StabilityOracle(assembly, settings).margins(states, kinds, deadline=deadline, histories=histories)


def histories_as_built(
    plan: Plan, assembly: Assembly, settings: StabilitySettings, steps: Sequence[int]
) -> tuple[History, ...]:
    """Return what the contacts have taken on after some steps of a plan, under the true friction.

    Args:
        settings: criterion and gravity.
        steps: 0 for the start.

    Returns:
        One entry a step; none where states are measured from rest: under `equilibrium`, with joints, or where the plan
        does not come to rest.
    """
    if (settings.criterion, plan.claim.criterion) != ("contact", "contact") or assembly.joints is not None:
        return ()
    count = max(steps, default=0) + 1
    replayer = Replayer(assembly, replace(settings, holds=plan.claim.holds, reserve=1.0))
    histories = replayer.replay(plan.states[:count], presses=plan.presses_before[:count]).histories
    return tuple(histories[step] for step in steps) if len(histories) == count else ()

"""Report on a plan check: what was checked, up to where it is good, and which claims of the plan were not verified."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field

import numpy as np

from falsework.assembly.model import Assembly
from falsework.search.margins.demands import Demands
from falsework.search.plans.plan import Plan
from falsework.stability.certificate import StabilityCriterion
from falsework.stability.contact.hold_loads import Loads
from falsework.stability.verdict import Verdicts

PROOF_NAMES = {"contact": "displacements", "equilibrium": "contact forces"}
"""Certificates of stable states under each criterion."""
REPLAY = "its replay"
"""Claim of a plan that only a replay verifies."""
JUDGEMENT = "its build by discrete elements"
"""Claim of a plan that only that build verifies."""


@dataclass(frozen=True)
class CheckedPlan:
    """What a check was about."""

    structure: str
    """Name of the structure, from itself."""
    identity: str
    """Digest of the structure, `Assembly.identity`."""
    boundary: tuple[int, ...]
    """Parts that the structure calls boundary."""
    steps: int
    robots: int
    """Parts that the plan may hold at a time."""
    props: int
    """Props of the plan."""
    prop_limit: int
    """Props that it may use at a time."""
    parts_at_once: int
    """Parts that a step of it moves at most."""
    moves: int
    """Moves of a way out at most."""
    start: tuple[int, ...]
    """First state."""
    end: tuple[int, ...]
    """Last state."""

    @classmethod
    def from_plan(cls, plan: Plan, assembly: Assembly) -> CheckedPlan:
        """Return what a check of a plan for a structure is about."""
        return cls(
            structure=assembly.name,
            identity=assembly.identity,
            boundary=tuple(np.flatnonzero(assembly.boundary).tolist()),
            steps=len(plan),
            robots=plan.robots,
            props=len(plan.props),
            prop_limit=plan.prop_limit,
            parts_at_once=int((plan.states[1:] != plan.states[:-1]).sum(axis=1).max(initial=1)),
            moves=max((len(way) for way in plan.exit_paths), default=1),
            start=tuple(plan.states[0].tolist()),
            end=tuple(plan.states[-1].tolist()),
        )


@dataclass(frozen=True, eq=False)
class PlanReport:
    """Result of a plan check."""

    states: int
    """States of the plan."""
    checked: int
    """States found good, from the first on."""
    reason: str = ""
    """Error of the first bad state; empty if all are good."""
    residual: float = 0.0
    """Largest residual of a good state, a share of gravity."""
    claim: StabilityCriterion = field(default_factory=StabilityCriterion)
    """Stability criterion of the check: the caller's criterion, cone, gravity, tolerance and force bound."""
    verdict: Verdicts | None = None
    """Verdict on the first bad state, with the velocity that proves it unstable; None if it broke a rule."""
    seconds: float = 0.0
    about: CheckedPlan | None = None
    """Structure, steps, robots, start and end that were checked."""
    certified: int = 0
    """Good states that the certificates in the plan prove; the others were solved."""
    unverified: tuple[str, ...] = ()
    """Claims of the plan that the check does not verify."""
    loads: Loads = ()
    """What robots bear in each state of a good plan under `contact`, as `Plan.loads`."""

    def __repr__(self) -> str:
        of = "" if self.about is None else f" of {self.about.structure}"
        good = f"all {self.states} states are {self.claim.proves}"
        return f"<PlanReport{of}: {good if self.good else self.reason}>"

    @property
    def good(self) -> bool:
        """Whether every step keeps the rules and every state is stable."""
        return not self.reason

    @property
    def bad_step(self) -> int | None:
        """Number of the step that leads to the first bad state; 0 if the first state is bad, None if none is."""
        return None if self.good else self.checked


def weaker_claim(claimed: StabilityCriterion, asked: StabilityCriterion) -> str:
    """Return why the claim of a plan is weaker than required; empty if it is not.

    Args:
        claimed: criterion that the plan claims.
        asked: criterion of the caller.
    """
    if claimed.criterion != asked.criterion and asked.criterion == "contact":
        return "the plan claims equilibrium only; plan again, or check it with --criterion equilibrium"
    if claimed.reserve < asked.reserve * (1 - 1e-12):
        return f"the plan claims a reserve of {claimed.reserve:g}; {asked.reserve:g} is asked"
    for name, unit in (("tolerance", ""), ("force_bound", " weights")):
        if getattr(claimed, name) > getattr(asked, name) * (1 + 1e-12):
            return f"the plan claims a {name} of {getattr(claimed, name):g}{unit}; {getattr(asked, name):g} is asked"
    if not math.isclose(claimed.gravity, asked.gravity, rel_tol=1e-9):
        return f"the plan is for a gravity of {claimed.gravity:g} m/s2; {asked.gravity:g} is asked"
    given, wanted = claimed.stiffness_ratio, asked.stiffness_ratio
    if claimed.criterion == asked.criterion == "contact" and not math.isclose(given, wanted, rel_tol=1e-9):
        return f"the plan is for a stiffness ratio of {given:g}; {wanted:g} is asked"
    return ""


def unverified_claims(plan: Plan, asked: StabilityCriterion, demands: Demands | None = None) -> tuple[str, ...]:
    """Return the claims of a plan that a check of its states under a criterion does not verify, in words.

    Args:
        plan: the plan, whose claim is not weaker than required.
        asked: criterion of the caller.
        demands: margins of the caller, checked instead of those of the plan.
    """
    found = [] if plan.replay is None else [REPLAY]
    if plan.replay is not None and plan.replay.judgement is not None:
        found.append(JUDGEMENT)
    # Under `contact` a plan is built with the reserve and for the robots that it names.
    checked = {"reserve", "holds"} if plan.claim.criterion == "contact" else {"holds"}
    for name, value in asdict(plan.claim).items():
        if (
            name not in checked
            and value != getattr(asked, name)
            and (name != "stiffness_ratio" or plan.claim.criterion == "contact")
        ):
            found.append(f"its {name.replace('_', ' ')} {value if isinstance(value, str) else f'{value:g}'}")
    if plan.proof_arrays() is not None and not comparable(plan.claim, asked):
        found.append(f"its {PROOF_NAMES[plan.claim.criterion]}")
    margins = plan.margins
    if margins is not None and demands is not None and margins.demands and margins.demands != demands:
        found.append(f"its margins {margins.demands}")
    if margins is not None and margins.bound is not None:
        found.append(f"its bound on the margin of {margins.maximised} of all plans")
    return tuple(found)


def comparable(claimed: StabilityCriterion, asked: StabilityCriterion) -> bool:
    """Return whether certificates under one criterion can prove another."""
    return (claimed.criterion, claimed.cone) == (asked.criterion, asked.cone)


def describe_unstable(plan: Plan, row: int, verdict: Verdicts) -> str:
    """Say why a state of a plan is not stable, and where it is in the plan."""
    hangs = ", which depends on the tolerance" if verdict.on_tolerance[0] else ""
    return f"the structure {verdict.kinds[0].words} {describe_place(plan, row)}{hangs}"


def describe_place(plan: Plan, row: int) -> str:
    """Say where a state is in a plan."""
    return f"after step {row} ({plan.words(row)})" if row else "at the beginning"

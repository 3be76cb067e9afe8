"""Plan check: the rules, and the stability of every state; facts about the structure are taken from the structure."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.errors import InputError, PlanError
from falsework.search.margins.demands import Demands, MarginOracle
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_report import (
    PROOF_NAMES,
    CheckedPlan,
    PlanReport,
    comparable,
    describe_place,
    describe_unstable,
    unverified_claims,
    weaker_claim,
)
from falsework.search.plans.plan_rules import broken_rule
from falsework.search.plans.plan_source import made_for, structure_of_plan
from falsework.stability.certificate import StabilityCriterion, chunks, residual_of_forces, verify_certificates
from falsework.stability.contact.build_verifier import BuildVerifier, StepCertificate
from falsework.stability.contact.hold_loads import CLOSE, Loads, larger_loads, largest_load, loads_in
from falsework.stability.contact.replay import Replayer
from falsework.stability.cpu.solver import TASK
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.quantity import format_quantity


def check_identity(plan: Plan, assembly: Assembly) -> None:
    """Raise unless the plan is for this structure.

    Raises:
        PlanError: parts, geometry, boundary, density, friction, names or props differ.
    """
    if len(plan.boundary) != assembly.part_count:
        raise PlanError(
            f"the plan is for {plan.name} with {len(plan.boundary)} parts, but {assembly.name} has "
            f"{assembly.part_count}; {made_for(plan)}"
        )
    if plan.identity != assembly.identity:
        raise PlanError(
            f"the plan is for another structure: its hash {plan.identity[:12]} of {plan.name} differs from "
            f"{assembly.identity[:12]} of {assembly.name}; geometry, contacts, boundary, density, friction, loads or "
            f"joints differ; {made_for(plan)}"
        )
    # The hash is copied from the structure; what the plan says besides it must agree too.
    other = np.flatnonzero(plan.boundary != assembly.boundary)
    if len(other):
        part, words = int(other[0]), ("free", "boundary")
        raise PlanError(
            f"the plan says that part {part} is {words[int(plan.boundary[part])]}, but in {assembly.name} it is "
            f"{words[int(assembly.boundary[part])]}; plan again"
        )
    for part, (said, name) in enumerate(zip(plan.part_names, assembly.names, strict=True)):
        if said != name:
            raise PlanError(f"the plan calls part {part} {said!r}, but in {assembly.name} it is {name!r}; plan again")
    if plan.friction != assembly.friction:
        raise PlanError(
            f"the plan says that friction is {plan.friction:g}, but in {assembly.name} it is {assembly.friction:g}; "
            "plan again"
        )
    for said, prop in zip(plan.props, assembly.props, strict=True):
        same = said.part == prop.part and np.allclose((*said.at, said.floor), (*prop.at, prop.floor), 1e-9, 1e-9)
        if not same:
            raise PlanError(
                f"the plan has a prop under part {said.part} from {said.floor:g} m up to {said.at[2]:g} m, but in "
                f"{assembly.name} it is under part {prop.part}, from {prop.floor:g} m to {prop.at[2]:g} m; plan again"
            )


def validate_plan(
    plan: Plan,
    assembly: AnyStructure,
    settings: StabilitySettings = StabilitySettings(),
    *,
    demands: Demands | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PlanReport:
    """Check the rules and the stability of a plan, state by state up to the first bad one.

    The caller sets the stability criterion. Tolerance, gravity, force bound and criterion in the plan are claims: a
    plan that claims less than the caller requires is refused, and so is one without steps, unless no part can move.

    States are proven by the certificates that the plan carries, which the certificate checker evaluates; it shares no
    code with the solvers. States without them are solved: under `equilibrium` each from the state before, and the
    checker accepts what is found; under `contact` the plan is built anew, with its presses and for the robots that it
    names, and `BuildVerifier` evaluates every step. A plan with a reserve must come to rest under the true friction
    too. A plan with a certificate that proves nothing is not good, even if the state is stable.

    Args:
        assembly: the structure, with the props of the plan; or its name or path, to which they are added.
        demands: margins that every state must keep; those that the plan was made to keep if not given.
        progress: called with the number of states checked and of all states.

    Raises:
        PlanError: the plan is for another structure.
        InputError: something other than a plan.
    """
    if not isinstance(plan, Plan):
        raise InputError(f"{type(plan).__name__} is no plan; give a Plan, such as the value of a result")
    if not isinstance(assembly, Assembly):
        assembly = structure_of_plan(plan, structure=as_assembly(assembly))
    check_identity(plan, assembly)
    begun = time.perf_counter()
    report = _blank(plan, assembly, settings.claim, demands)
    if not report.good:
        return report
    if settings.criterion == "contact":
        settings = replace(settings, reserve=plan.claim.reserve, holds=plan.claim.holds.within(settings.holds))
        report = replace(report, claim=settings.claim)
    broken = broken_rule(plan, assembly, settings)
    carried = plan.proof_arrays() is not None and comparable(plan.claim, settings.claim)
    misfit = _misfit(plan, assembly, settings.claim) if carried else ""
    count = len(plan.states) if broken is None else broken[0]
    if settings.criterion == "contact":
        if broken is None:
            report = _check_build(report, plan, assembly, settings, carried and not misfit, progress)
        else:
            report = replace(report, checked=broken[0])
    else:
        proven = _residuals_of_forces(plan, assembly, settings.claim) if carried and not misfit else None
        report = _solve(report, plan, assembly, settings, count, proven, progress)
    weak = _weak(plan, assembly, settings, demands) if report.good and broken is None else None
    if weak is not None:
        report = replace(report, checked=weak[0], reason=f"{weak[1]} {describe_place(plan, weak[0])}")
    if report.good:
        report = replace(report, reason=misfit if broken is None else broken[1])
    return replace(report, seconds=time.perf_counter() - begun)


def _blank(plan: Plan, assembly: Assembly, claim: StabilityCriterion, demands: Demands | None) -> PlanReport:
    """Return the report on a plan of which no state is checked yet, with the reason if none needs to be."""
    about, unverified = CheckedPlan.from_plan(plan, assembly), unverified_claims(plan, claim, demands)
    # Where every part is boundary, no other plan exists.
    complete = len(plan) > 0 or assembly.boundary.all()
    empty = "" if complete else "the plan has no step and shows nothing; plan again"
    reason = weaker_claim(plan.claim, claim) or empty
    return PlanReport(len(plan.states), 0, reason, claim=claim, about=about, unverified=unverified)


def _solve(
    report: PlanReport,
    plan: Plan,
    assembly: Assembly,
    settings: StabilitySettings,
    count: int,
    carried: NDArray[np.float64] | None,
    progress: Callable[[int, int], None] | None,
) -> PlanReport:
    """Check under `equilibrium` the stability of states from the first on, up to the first bad one.

    Args:
        plan, assembly, settings: as for `validate_plan`.
        count: states to check.
        carried: residuals that the certificates in the plan leave, shape (states,), or None; states that they do not
            prove are solved, so that the report says whether the state or only its certificate is at fault.
        progress: as for `validate_plan`.
    """
    claim, largest, certified, oracle = settings.claim, 0.0, 0, None
    for rows in chunks(np.arange(count), len(assembly.contacts.points), TASK):
        residual = np.full(len(rows), np.inf) if carried is None else carried[rows]
        proven = residual <= claim.tolerance
        left = rows[~proven] if carried is None else rows[~proven][:1]  # which is bad, one way or the other
        if len(left):
            oracle = oracle or StabilityOracle(assembly, settings)
            states, near = plan.states[left], plan.states[np.maximum(left - 1, 0)]
            found = oracle.verdicts(states, near=near, require_certificate=True)
            residual[np.isin(rows, left)] = found.residual
            accepted = found.stable & verify_certificates(assembly, states, found, claim)
            bad = np.flatnonzero(~accepted | (carried is not None))
            if len(bad):
                at, count = int(bad[0]), int(left[bad[0]])
                if carried is not None and accepted[at]:
                    report = replace(report, reason=_unproven(plan, count, float(carried[count]), claim))
                else:
                    report = replace(report, reason=describe_unstable(plan, count, found[at]), verdict=found[at])
        done = rows < count
        largest, certified = max(largest, residual[done].max(initial=0.0)), certified + int(proven[done].sum())
        if progress is not None and done.any():
            progress(int(rows[done][-1]) + 1, report.states)
        if not done.all():
            break
    return replace(report, checked=count, residual=float(largest), certified=certified)


def _check_build(
    report: PlanReport,
    plan: Plan,
    assembly: Assembly,
    settings: StabilitySettings,
    carried: bool,
    progress: Callable[[int, int], None] | None,
) -> PlanReport:
    """Check under `contact` the stability of states as built, up to the first bad one.

    Args:
        plan, assembly, settings: as for `validate_plan`, with the reserve and the robots of the plan.
        carried: the plan carries a certificate for each of its states.
        progress: as for `validate_plan`.
    """
    states, presses = plan.states, plan.presses_before
    largest, cases = 0.0, [settings] if settings.reserve == 1.0 else [settings, replace(settings, reserve=1.0)]
    loads: list[Loads] = []
    for number, case in enumerate(cases):
        verifier, row, wrong = BuildVerifier(assembly, case.claim), -1, ""
        own, borne = carried and number == 0, []
        # Without limits, so that the verifier names what a robot bears beyond them.
        strong = replace(case, holds=replace(case.holds, force=np.inf, moment=np.inf))
        steps = _carried_steps(plan) if own else Replayer(assembly, strong).certificates(states, presses)
        with np.errstate(over="ignore", invalid="ignore"):
            for row, certificate in enumerate(steps):
                proof = verifier.step(states[row], certificate)
                if not proof.residual <= case.tolerance:
                    why = proof.reason or f"its forces leave {format_quantity(proof.residual, 'share')} of gravity"
                    carries = "the displacements in the plan prove nothing: " * own
                    wrong = f"{_built(plan, row)} is not proven{case.under}: {carries}{why}"
                    break
                largest = max(largest, proof.residual)
                borne.append(loads_in(assembly, states[row], proof.wrenches))
                if progress is not None and number == 0:
                    progress(row + 1, len(states))
        if not wrong and row + 1 < len(states):
            row, wrong = row + 1, f"the structure does not come to rest{case.under} at {_built(plan, row + 1)}"
        if wrong:
            verdict = StabilityOracle(assembly, replace(case, reserve=1.0)).verdicts(
                states[row], require_certificate=True
            )
            if verdict.unstable[0]:
                wrong = describe_unstable(plan, row, verdict)
            return replace(report, reason=wrong, checked=row, residual=largest, verdict=verdict)
        loads.append(tuple(borne))
    count, found = len(states), loads[0] if len(loads) == 1 else larger_loads(*loads)
    denied = _denied_load(plan, found)
    if denied is not None:
        return replace(report, reason=denied[1], checked=denied[0], residual=largest)
    return replace(report, checked=count, residual=largest, certified=count * carried, loads=found)


def _denied_load(plan: Plan, found: Loads) -> tuple[int, str] | None:
    """Return the first state for which a plan says too little of what robots bear, and how.

    Args:
        plan: the plan; one that says nothing denies nothing.
        found: what robots bear in its states.
    """
    largest = dict(zip(("force", "moment"), largest_load(found), strict=True))
    for row, (said, true) in enumerate(zip(plan.loads, found, strict=True) if plan.loads else ()):
        by_part = {load.part: load for load in said}
        for load in true:
            name, known = plan.part_names[load.part], by_part.pop(load.part, None)
            if known is None:
                return row, f"the plan does not say what the robot bears that holds {name} at {_built(plan, row)}"
            for kind in ("force", "moment"):
                says, is_so = getattr(known, kind), getattr(load, kind)
                if says < is_so * (1 - CLOSE) - CLOSE**2 * largest[kind]:
                    return row, (
                        f"the plan says that the robot that holds {name} bears {format_quantity(says, kind, 4)} at "
                        f"{_built(plan, row)}; it bears {format_quantity(is_so, kind, 4)}"
                    )
        if by_part:
            name = plan.part_names[next(iter(by_part))]
            return row, f"the plan says what a robot bears for {name} at {_built(plan, row)}, but none holds it"
    return None


def _carried_steps(plan: Plan) -> Iterator[StepCertificate]:
    """Yield the certificates that a plan carries."""
    assert plan.displacement is not None
    for row, presses in enumerate(plan.presses_before):
        torn = np.zeros(0, dtype=bool) if plan.torn is None else plan.torn[row]
        yield StepCertificate(plan.displacement[row], torn, presses)


def _built(plan: Plan, row: int) -> str:
    """Name a state by the step that leads to it."""
    return f"step {row} ({plan.words(row)})" if row else "the beginning"


def _misfit(plan: Plan, assembly: Assembly, claim: StabilityCriterion) -> str:
    """Return why certificates in the plan are none of its states; empty if there is one for each."""
    proofs = plan.proof_arrays()
    assert proofs is not None
    shape, name = tuple(proofs.shape), PROOF_NAMES[claim.criterion]
    rows: tuple[int, ...] = (len(assembly.contacts.points), 3)
    if claim.criterion == "contact":
        rows = (*shape[1:2], assembly.part_count, 6)  # any number of increments
    wanted = (len(plan.states), *rows)
    return "" if shape == wanted else f"the plan has {name} of shape {shape}; expected {wanted}; plan again"


def _residuals_of_forces(plan: Plan, assembly: Assembly, claim: StabilityCriterion) -> NDArray[np.float64]:
    """Return the residuals that the contact forces in a plan leave, which fit its states."""
    assert plan.forces is not None
    # Numbers from a file may overflow; what is not finite leaves an infinite residual.
    with np.errstate(over="ignore", invalid="ignore"):
        return residual_of_forces(assembly, plan.states, plan.forces, claim)


def _unproven(plan: Plan, row: int, residual: float, claim: StabilityCriterion) -> str:
    name = PROOF_NAMES[claim.criterion]
    return (
        f"the {name} in the plan for the state {describe_place(plan, row)} leave "
        f"{format_quantity(residual, 'share')} of gravity, above "
        f"{format_quantity(claim.tolerance, 'share')}, and prove nothing"
    )


def _weak(
    plan: Plan, assembly: Assembly, settings: StabilitySettings, demands: Demands | None
) -> tuple[int, str] | None:
    """Return the first state that does not keep the required or recorded margins, and the reason."""
    if demands is None and plan.margins is not None:
        demands = plan.margins.demands
    if plan.margins is None and not demands:
        return None
    oracle = MarginOracle(assembly, settings, demands or Demands())
    lost = np.flatnonzero(~oracle.keeps(plan.states)) if demands else []
    if len(lost):
        row = int(lost[0])
        return row, f"the structure does not keep {oracle.broken(plan.states[row])}"
    found = None if plan.margins is None else plan.margins.overstated(oracle, plan.states)
    return None if found is None else (found[0], f"the structure {found[1]}")

"""Judge: makes a plan of the steps of an answer alone, and checks every state of it anew.

Nothing else of a submission counts: structure, robots, criterion, begin and end are those of the question, friction is
that of the structure, and the reserve that an answer claims is checked.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from bench.questions import Question
from bench.submission import Answer
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.errors import FalseworkError
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_check import validate_plan
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Proof, Verdict

_MOVES = {
    "insert": (REMOVED, HELD),
    "release": (HELD, INSTALLED),
    "hold": (INSTALLED, HELD),
    "remove": (HELD, REMOVED),
}
"""Value of the part before a step, and after."""
_WORDS = {REMOVED: "not there", INSTALLED: "installed", HELD: "held"}


@dataclass(frozen=True)
class Judgement:
    """What the judge found."""

    outcome: Literal["solved", "refuted", "open"]
    """Whether every step and state is right, or one is not, or the method found nothing."""
    reason: str = ""
    """Why it is not solved, in one sentence."""
    steps: int = 0
    robots: int = 0
    reserve: float = 1.0
    residual: float = 0.0
    """Largest residual of a state, a share of gravity."""
    seconds: float = 0.0
    """That the check took."""

    @property
    def solved(self) -> bool:
        """Whether the answer is right."""
        return self.outcome == "solved"

    def to_dict(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        entries = {"outcome": self.outcome, "steps": self.steps, "robots": self.robots, "reserve": self.reserve}
        numbers = {"residual": float(f"{self.residual:.3g}"), "check_seconds": round(self.seconds, 3)}
        return {**entries, **numbers, **({} if self.solved else {"reason": self.reason})}


def settings_of(question: Question, reserve: float = 1.0) -> StabilitySettings:
    """Return the criterion of a question: everything but its name and the reserve is the default of the package."""
    return StabilitySettings(criterion=question.criterion, reserve=reserve)


def judge(answer: Answer, assembly: Assembly) -> Judgement:
    """Check an answer on its structure.

    Args:
        answer: what a method says.
        assembly: structure of its question.
    """
    begun = time.perf_counter()
    if answer.steps is None:
        return Judgement("open", answer.reason, robots=answer.robots)
    found = _judge(answer, assembly)
    return replace(found, seconds=time.perf_counter() - begun)


def _judge(answer: Answer, assembly: Assembly) -> Judgement:
    question = answer.question
    no = Judgement("refuted", steps=len(answer.steps or ()), robots=answer.robots, reserve=answer.reserve)
    if not question.structure.digest and answer.structure != assembly.identity:
        return replace(no, reason=f"it is for another structure than {question.structure.name} on this machine")
    if answer.robots > assembly.part_count:
        return replace(no, reason=f"it takes {answer.robots} robots for {assembly.part_count} parts")
    states, wrong = _follow(answer, assembly.boundary)
    if wrong:
        return replace(no, reason=wrong)
    try:
        report = validate_plan(_plan(answer, assembly, states), assembly, settings_of(question, answer.reserve))
    except FalseworkError as error:  # such as presses that no solver takes
        return replace(no, reason=str(error))
    return replace(no, outcome="solved" if report.good else "refuted", reason=report.reason, residual=report.residual)


def _follow(answer: Answer, boundary: Mask) -> tuple[States, str]:
    """Return the states that the steps lead through, and why they do not lead to the end; empty if they do."""
    state, question = answer.question.begin(boundary), answer.question
    states = [state]
    for number, step in enumerate(answer.steps or (), 1):
        before, after = _MOVES[step.verb]
        if step.part >= len(boundary):
            return np.array(states), f"step {number} names part {step.part}, but there are {len(boundary)}"
        if boundary[step.part]:
            return np.array(states), f"step {number} names part {step.part}, which is boundary"
        if state[step.part] != before:
            is_now = _WORDS[int(state[step.part])]
            return np.array(states), f"step {number} would {step.verb} part {step.part}, which is {is_now}"
        state = state.copy()
        state[step.part] = after
        states.append(state)
    left = int((state != question.goal(boundary)).sum())
    where = "complete" if question.builds else "empty"
    return np.array(states), f"its steps end {left} parts before the {where} structure" if left else ""


def _plan(answer: Answer, assembly: Assembly, states: States) -> Plan:
    """Return the steps as a plan without any proof, in the order of assembly."""
    steps = answer.steps or ()
    parts = assembly.part_count
    actions = np.array([step.part + parts * (step.verb in ("insert", "remove")) for step in steps], dtype=np.int64)
    presses = tuple(step.presses for step in steps)
    if not answer.question.builds:
        states, actions, presses = states[::-1].copy(), actions[::-1].copy(), presses[::-1]
    count = len(states)
    return Plan(
        states=states,
        actions=actions,
        verdicts=(Verdict.UNDECIDED,) * count,
        proofs=(Proof.NONE,) * count,
        residuals=np.full(count, np.nan),
        name=assembly.name,
        identity=assembly.identity,
        part_names=tuple(assembly.names),
        boundary=assembly.boundary,
        friction=assembly.friction,
        robots=answer.robots,
        claim=settings_of(answer.question, answer.reserve).claim,
        presses=presses if any(presses) else (),
    )

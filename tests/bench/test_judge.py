"""The judge believes the steps alone, and checks every state that they lead through."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.judge import judge
from bench.methods import METHODS, Method, line_of, timed
from bench.questions import Question, question_elsewhere
from bench.structures import Structure
from bench.submission import Answer, Step
from falsework import Assembly, load_structure

ARCH = "arch:blocks=5"


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure(ARCH)


def asked(task: str, criterion: str, robots: int = 2, state: str = "") -> Question:
    return Question(task, criterion, Structure(ARCH, "test", 7), robots, "0" if state else "", state)  # type: ignore[arg-type]


def answered(question: Question, steps: list[list[Any]] | None, **more: object) -> Answer:
    made = None if steps is None else tuple(Step(*step) for step in steps)  # type: ignore[arg-type]
    return Answer(2, question, made, **{"robots": question.robots, **more})  # type: ignore[arg-type]


def found_by(method: Method, question: Question, arch: Assembly) -> list[list[Any]]:
    found, _ = timed(method, question, arch, 20.0)
    assert found.steps is not None, found.reason
    return found.steps


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
@pytest.mark.parametrize("name", ["falsework", "depth-first"])
def test_a_plan_counts(name: str, criterion: str, arch: Assembly) -> None:
    question = asked("plan", criterion)
    judgement = judge(answered(question, found_by(METHODS[name], question, arch)), arch)
    assert judgement.solved, judgement.reason
    assert judgement.steps == 10


def test_every_error_in_the_steps_is_found(arch: Assembly) -> None:
    question = asked("plan", "contact")
    steps = found_by(METHODS["falsework"], question, arch)
    free = int(np.flatnonzero(~arch.boundary)[0])
    fixed = int(np.flatnonzero(arch.boundary)[0])
    first = steps[0][1]
    cases: dict[str, list[list[Any]]] = {
        "before the complete structure": steps[:-1],
        f"would insert part {first}, which is held": [steps[0], *steps],
        "is boundary": [["insert", fixed], *steps],
        "but there are 7": [["insert", 7], *steps],
        f"would release part {free}, which is not there": [["release", free], *steps],
        "its steps end 5 parts before": [],
    }
    for words, wrong in cases.items():
        judgement = judge(answered(question, wrong), arch)
        assert not judgement.solved
        assert words in judgement.reason


def test_more_parts_held_than_there_are_robots(arch: Assembly) -> None:
    free = np.flatnonzero(~arch.boundary).tolist()
    steps = [["insert", part] for part in free] + [["release", part] for part in free]
    judgement = judge(answered(asked("plan", "equilibrium"), steps), arch)
    assert "every robot is holding" in judgement.reason
    assert judge(answered(asked("fewest", "contact", 0), steps, robots=5), arch).solved


def test_a_state_that_falls_refutes_the_answer(arch: Assembly) -> None:
    """With one robot the first block of an arch cannot be let go of away from its support."""
    keystone = int(np.argmax([mesh.vertices[:, 2].max() for mesh in arch.meshes]))
    others = [part for part in np.flatnonzero(~arch.boundary).tolist() if part != keystone]
    order = [keystone, *others]
    steps = [[verb, part] for part in order for verb in ("insert", "release")]
    for criterion in ("contact", "equilibrium"):
        judgement = judge(answered(asked("plan", criterion), steps), arch)
        assert not judgement.solved
        assert "after step 2" in judgement.reason


def test_a_reserve_that_is_claimed_is_checked(arch: Assembly) -> None:
    question = asked("plan", "contact")
    steps = found_by(METHODS["falsework"], question, arch)
    assert judge(answered(question, steps, reserve=1.1), arch).reserve == 1.1
    judgement = judge(answered(question, steps, reserve=10.0), arch)
    assert not judgement.solved
    assert "step" in judgement.reason


@pytest.mark.parametrize("name", ["falsework", "depth-first"])
def test_building_goes_on_from_a_state(name: str, arch: Assembly) -> None:
    steps = found_by(METHODS[name], asked("plan", "contact"), arch)
    state = np.where(arch.boundary, 2, 0).tolist()
    for verb, part in steps[:3]:
        state[part] = 2 if verb == "insert" else 1
    question = asked("replan", "contact", state="".join(map(str, state)))
    judgement = judge(answered(question, found_by(METHODS[name], question, arch)), arch)
    assert judgement.solved, judgement.reason
    assert judgement.steps == 7
    assert judge(answered(question, steps[3:]), arch).solved
    assert not judge(answered(question, steps), arch).solved


def test_a_rollout_is_judged_in_the_order_in_which_it_was_done(arch: Assembly) -> None:
    built = found_by(METHODS["depth-first"], asked("plan", "equilibrium"), arch)
    undone = [["hold" if verb == "release" else "remove", part] for verb, part in reversed(built)]
    assert judge(answered(asked("policy", "equilibrium"), undone), arch).solved
    turned = judge(answered(asked("policy", "equilibrium"), undone[::-1]), arch)
    assert not turned.solved
    assert "would remove part" in turned.reason


def test_the_fewest_robots_are_those_that_the_answer_needs(arch: Assembly) -> None:
    question = asked("fewest", "contact", 0)
    found, _ = timed(METHODS["falsework"], question, arch, 20.0)
    assert found.steps is not None
    line = line_of(question, arch, found, 0.0)
    steps = found.steps
    assert judge(answered(question, steps, robots=line["robots"]), arch).solved
    assert not judge(answered(question, steps, robots=line["robots"] - 1 or 8), arch).solved


def test_what_was_not_found_is_no_answer(arch: Assembly) -> None:
    judgement = judge(answered(asked("plan", "contact"), None, reason="too hard"), arch)
    assert (judgement.outcome, judgement.reason) == ("open", "too hard")


def test_a_structure_that_the_manifest_does_not_pin_must_be_the_same_here(arch: Assembly, tmp_path: Path) -> None:
    question = question_elsewhere("plan/contact/stabletext2brick/abc/2", tmp_path)
    assert question is not None
    judgement = judge(Answer(2, question, (), 2, structure="0" * 64), arch)
    assert "another structure" in judgement.reason

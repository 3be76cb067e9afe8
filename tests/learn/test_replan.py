"""Replanning: every answer is a proven plan, a proof that there is none, or an honest admission."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from falsework import (
    Direction,
    Outcome,
    Plan,
    Replanner,
    StabilityOracle,
    StabilitySettings,
    find_plans,
    load_structure,
    replan,
)
from falsework.assembly import HELD, INSTALLED, REMOVED, States, complete_state, empty_state
from falsework.errors import FalseworkError, InputError, StateError
from falsework.learn import PolicySettings, make_policy
from falsework.replanning.replanner import ReplanSettings, Request, Stage
from falsework.replanning.search_stages import TimeSlices
from falsework.replanning.session import ReplanSession
from falsework.search import ExhaustiveSearch
from falsework.search.planner import Planner
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.result import SearchResult
from falsework.stability import Proof
from falsework.stability.contact.history import History, Replay
from falsework.stability.contact.replay import Replayer
from falsework.utils.interruption import check_interruption

ARCH = load_structure("arch:blocks=5")
COMPLETE = complete_state(ARCH.boundary)
EMPTY = empty_state(ARCH.boundary)


def make(kind: str = "mlp", **options: Any) -> Any:
    """A policy that was never trained: it proposes nonsense, which must not matter."""
    return make_policy(ARCH, PolicySettings(kind=kind, **options))  # type: ignore[arg-type]


def test_what_the_deadline_left_open_is_said_of_each_plan() -> None:
    answer = replan(ARCH, "empty", target="complete", alternatives=2)
    assert answer.open_replay == ""
    first, second = answer.replays
    cut = dataclasses.replace(second, stands=None, steps=3)
    fell = dataclasses.replace(first, stands=False, steps=4)
    found = dataclasses.replace(answer, replays=(first, cut)).open_replay
    assert found == f"the deadline left time to replay 3 of the {cut.of} steps of assembly of plan 2"
    assert "the replay of this one fails at step 5" in dataclasses.replace(answer, replays=(fell, second)).open_replay


@pytest.mark.parametrize("told", [(1, True), (3, False)])
def test_a_policy_for_many_tasks_is_told_the_task_of_each_request(told: tuple[int, bool]) -> None:
    """Whatever it was told before: the same request has the same answer, alone, among others, and after them."""
    dome = load_structure("dome:rings=2,blocks=6")
    policy = make_policy(dome, PolicySettings("local"), "cpu", seed=0)
    replanner = Replanner(dome, policy)
    asked = [Request("complete", robots=robots, confidences=True) for robots in (3, 2, 3)]
    answers = [replanner.replan_many([request])[0] for request in asked]
    policy.of_task(told[0], equilibrium=told[1])
    for answer, other in zip(replanner.replan_many(asked), answers, strict=True):
        assert answer.decided_by is other.decided_by
        np.testing.assert_array_equal(answer.plans[0].states, other.plans[0].states)
        np.testing.assert_allclose(answer.confidences[0], other.confidences[0], atol=1e-5)


@pytest.fixture(scope="module")
def alone() -> Replanner:
    return Replanner(ARCH)


@pytest.fixture(scope="module")
def guided(alone: Replanner) -> Replanner:
    return Replanner(ARCH, make(), alone.oracle)


@pytest.fixture(scope="module")
def goal_conditioned(alone: Replanner) -> Replanner:
    return Replanner(ARCH, make("mlp", goal_conditioned=True), alone.oracle)


def test_repeated_holds_are_left_to_the_search(guided: Replanner) -> None:
    """Policies know none: one that takes no step at all would be at the end of a plan that changes a hold."""
    start, target = COMPLETE.copy(), COMPLETE.copy()
    start[0] = target[3] = HELD
    begun = find_plans(ARCH, robots=1, start=start, target=target, allow_regrasp=True).plans[0]
    for step in range(3):
        answer = guided.replan(plan=begun, step=step, target=start, direction=Direction.ASSEMBLY, robots=1)
        assert [str(one.action) for one in answer.plans[0]] == ["release", "hold"]


class Falling:
    """Replays like another replayer, but every sequence falls in some states."""

    varies = False

    def __init__(self, inner: Replayer, falls: Callable[[States], bool], seconds: float = 0.0) -> None:
        self.inner, self.falls, self.seconds = inner, falls, seconds

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def replay(self, states: States, history: History | None = None, presses: Any = None) -> Replay:
        check_interruption()
        if len(states) > 2:  # a step of a search takes no time
            time.sleep(self.seconds * (len(states) - 1))
        rows = [row for row, state in enumerate(states) if self.falls(state)]
        found = self.inner.replay(states, history, presses)
        if not rows:
            return found
        stands = found.stands.copy()
        stands[rows[0] :] = 0
        return dataclasses.replace(found, stands=stands)


def falling(falls: Callable[[States], bool], seconds: float = 0.0) -> StabilityOracle:
    """An oracle of the arch whose replays fall."""
    oracle = StabilityOracle(ARCH)
    assert oracle.replayer is not None
    oracle.__dict__["replayer"] = Falling(oracle.replayer, falls, seconds)
    return oracle


def any_state() -> st.SearchStrategy[States]:
    values = st.lists(st.sampled_from([REMOVED, INSTALLED, HELD]), min_size=5, max_size=5)
    return values.map(lambda own: np.array([*own, HELD, HELD], dtype=np.uint8))


def truth(request: Request, oracle: StabilityOracle) -> bool:
    """Whether there is a plan, by looking at every state there is."""
    task = request.task(ARCH)
    if not oracle.verdicts(np.stack([task.start, task.target]), require_certificate=True).stable.all():
        return False
    return ExhaustiveSearch(task, oracle).run().result.found


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much])
@given(
    any_state(),
    st.one_of(st.none(), any_state()),
    st.integers(1, 3),
    st.lists(st.integers(0, 4), max_size=2, unique=True),
    st.lists(st.integers(0, 4), max_size=1),
    st.sampled_from([None, Direction.ASSEMBLY, Direction.DISASSEMBLY]),
    st.integers(1, 2),
    st.integers(0, 2),
)
def test_every_answer_is_true(
    alone: Replanner,
    guided: Replanner,
    goal_conditioned: Replanner,
    state: States,
    target: States | None,
    robots: int,
    missing: list[int],
    fixed: list[int],
    direction: Direction | None,
    alternatives: int,
    which: int,
) -> None:
    """Found exactly if a search through all states finds one; the plans hold for the exact solver."""
    replanner = (alone, guided, goal_conditioned)[which]
    request = Request(
        state,
        target=target,
        direction=direction,
        robots=robots,
        missing=missing,
        fixed=fixed,
        alternatives=alternatives,
    )
    try:
        request.task(ARCH)
    except InputError:
        with pytest.raises(InputError) as caught:
            replanner.replan_many([request])
        assert "\n" not in str(caught.value)
        return
    (answer,) = replanner.replan_many([request])
    assert answer.found == truth(request, replanner.oracle)
    assert answer.outcome is not Outcome.NOT_FOUND  # so small a structure leaves no doubt
    assert len(answer.plans) <= alternatives
    for plan in answer.plans:
        assert validate_plan(plan, ARCH).good or not len(plan)  # a plan without steps shows nothing
        assert answer.direction is request.resolved_direction(ARCH)
        first, last = plan.states[[0, -1]] if answer.direction is Direction.ASSEMBLY else plan.states[[-1, 0]]
        np.testing.assert_array_equal(first, state)
        if target is not None:
            np.testing.assert_array_equal(last, target)
        if fixed:
            assert (plan.states[:, fixed] == state[fixed]).all()
    if answer.found:
        assert answer.reached == answer.steps == len(answer.plans[0])
    else:
        assert answer.reason


def test_directions() -> None:
    """Where parts are missing that the state lacks, it goes up; a target says which way; else it goes down."""
    half = find_plans(ARCH, forces=False).plans[0].states[-5]
    absent = int(np.flatnonzero(half == REMOVED)[0])
    assert Request(half).resolved_direction(ARCH) is Direction.DISASSEMBLY
    assert Request(half, missing=[absent]).resolved_direction(ARCH) is Direction.ASSEMBLY
    assert Request(half, target=COMPLETE).resolved_direction(ARCH) is Direction.ASSEMBLY
    assert Request(half, target=EMPTY).resolved_direction(ARCH) is Direction.DISASSEMBLY


def test_from_here_on(alone: Replanner) -> None:
    """Assembly begins in the state and ends with everything in place; a late part goes in as late as it can."""
    plan = find_plans(ARCH, oracle=alone.oracle, forces=False).plans[0]
    state = plan.states[4]
    late = int(np.flatnonzero(state == REMOVED)[0])
    answer = alone.replan(state, missing=[late])
    (first,) = answer.plans
    np.testing.assert_array_equal(first.states[0], state)
    np.testing.assert_array_equal(first.states[-1], COMPLETE)
    (need,) = first.needs
    without = alone.replan(state, direction=Direction.ASSEMBLY).plans[0]
    order = without.inserted_parts.tolist()
    assert need.after_parts >= order.index(late)


def test_there_already(alone: Replanner) -> None:
    answer = alone.replan(COMPLETE, target=COMPLETE)
    assert answer.found
    assert answer.decided_by is Stage.RULES
    assert len(answer.plans[0]) == 0


def test_an_arch_needs_two_robots(alone: Replanner, guided: Replanner) -> None:
    """One robot cannot take the first block out of an arch, whoever proposes it."""
    for replanner in (alone, guided):
        answer = replanner.replan(COMPLETE, robots=1)
        assert answer.outcome is Outcome.PROVED_IMPOSSIBLE
        assert answer.decided_by is Stage.EXHAUSTIVE
        assert answer.moving
        assert answer.value is None


def test_unstable_state_names_what_moves(alone: Replanner) -> None:
    fallen = COMPLETE.copy()
    fallen[0] = REMOVED
    answer = alone.replan(fallen)
    assert answer.outcome is Outcome.PROVED_IMPOSSIBLE
    assert answer.decided_by is Stage.RULES
    assert answer.reason == "the state is not stable"
    assert set(answer.moving) <= set(np.flatnonzero(fallen == INSTALLED).tolist())
    assert answer.moving


def test_not_found_is_told_from_proved() -> None:
    """Limits that are too tight for a proof give no proof."""
    tight = ReplanSettings(samples=0, widths=(), width=1, state_limit=1)
    arch = load_structure("arch:blocks=9")
    answer = Replanner(arch, settings=tight).replan(complete_state(arch.boundary))
    if not answer.found:
        assert answer.outcome is Outcome.NOT_FOUND
        assert answer.decided_by is Stage.NONE
        assert answer.reason


def test_same_seed_same_answer(alone: Replanner) -> None:
    policy = make()
    first, second = (Replanner(ARCH, policy, alone.oracle).replan(COMPLETE, seed=7, alternatives=3) for _ in range(2))
    assert [plan.actions.tolist() for plan in first.plans] == [plan.actions.tolist() for plan in second.plans]
    assert first.decided_by is second.decided_by


@pytest.mark.parametrize("policy", [False, True])
def test_alternatives_differ(policy: bool, alone: Replanner, guided: Replanner) -> None:
    answer = (guided if policy else alone).replan(COMPLETE, alternatives=4)
    assert len(answer.plans) == 4
    assert len({plan.actions.tobytes() for plan in answer.plans}) == 4
    assert answer.distance[~np.eye(4, dtype=bool)].min() > 0.3
    for plan in answer.plans:
        assert validate_plan(plan, ARCH).good


def test_batch_is_as_good_as_one_by_one(guided: Replanner) -> None:
    """Requests of all kinds answered together, each announced once, none mixed up with another."""
    plan = guided.replan(COMPLETE).plans[0]
    requests = [
        Request(COMPLETE, robots=3),
        Request(COMPLETE, robots=1),
        *(Request(state, seed=n) for n, state in enumerate(plan.states)),
        Request(plan.states[4], direction=Direction.ASSEMBLY),
        Request(plan.states[4], target=COMPLETE, alternatives=2),
    ]
    announced: list[int] = []
    answers = guided.replan_many(requests, finished=lambda number, _: announced.append(number))
    assert sorted(announced) == list(range(len(requests)))
    for request, answer in zip(requests, answers, strict=True):
        (single,) = guided.replan_many([request])
        assert answer.outcome is single.outcome
        for found in answer.plans:
            assert validate_plan(found, ARCH).good or not len(found)
            first = 0 if answer.direction is Direction.ASSEMBLY else -1
            np.testing.assert_array_equal(found.states[first], np.asarray(request.state))


@pytest.mark.parametrize("name", ["vault:rows=5,columns=7", "dome:rings=4,blocks=8"])
def test_deadline_is_kept(name: str) -> None:
    """An answer comes in time, with a plan or without; scheduling of a busy machine is allowed for."""
    try:
        assembly = load_structure(name)
    except InputError:
        assembly = load_structure(name.split(":")[0])
    replanner = Replanner(assembly)
    for deadline in (0.01, 0.1, 0.3):
        began = time.perf_counter()
        answer = replanner.replan(complete_state(assembly.boundary), robots=2, alternatives=8, deadline=deadline)
        assert time.perf_counter() - began < deadline + 0.5
        if not answer.found:
            assert answer.deadline_passed
            assert answer.outcome is Outcome.NOT_FOUND
            assert "the deadline passed" in answer.reason
        else:
            assert answer.value is not None
            assert validate_plan(answer.value, assembly).good


def test_deadline_is_kept_in_company() -> None:
    """Who has a deadline does not wait for those who have none and ask for much."""
    dome = load_structure("dome:rings=3,blocks=6")
    replanner = Replanner(dome)
    complete = complete_state(dome.boundary)
    requests = [Request(complete, alternatives=3), Request(complete, seed=1, deadline=0.2), Request(complete, seed=2)]
    order: list[int] = []
    answers = replanner.replan_many(requests, finished=lambda number, _: order.append(number))
    assert order[0] == 1
    assert answers[1].seconds < 0.2 + 0.3
    assert answers[1].found or answers[1].deadline_passed
    assert answers[0].found
    assert answers[2].found


def test_best_answer_at_the_deadline(alone: Replanner) -> None:
    """What was found before the clock ran out is handed back, and said to be cut short."""
    arch = load_structure("arch:blocks=15")
    replanner = Replanner(arch)
    answer = replanner.replan(complete_state(arch.boundary), alternatives=200, deadline=1.5)
    assert answer.found
    assert 1 <= len(answer.plans) < 200
    assert answer.deadline_passed


def test_confidences_are_probabilities(guided: Replanner, goal_conditioned: Replanner) -> None:
    for replanner in (guided, goal_conditioned):
        answer = replanner.replan(COMPLETE, confidences=True)
        (confidence,), plan = answer.confidences, answer.plans[0]
        task = Request(COMPLETE).task(ARCH)
        legal = task.moves(plan.states, Direction.DISASSEMBLY)
        assert confidence.shape == (len(plan) + 1, 2 * ARCH.part_count)
        assert (confidence[~legal] == 0).all()
        np.testing.assert_allclose(confidence[1:].sum(axis=1), 1, atol=1e-5)
        assert (confidence[0] == 0).all()  # nothing is legal in the empty structure
    assert guided.replan(COMPLETE).confidences == ()


def knowing(plan: Plan) -> Any:
    """A policy that knows a plan by heart."""
    import torch

    book = {state.tobytes(): int(action) for state, action in zip(plan.states[1:], plan.actions, strict=True)}

    class Knowing(torch.nn.Module):
        def forward(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> Any:
            logits = torch.zeros(len(states), 2 * ARCH.part_count)
            for row, state in enumerate(states.numpy()):
                if state.tobytes() in book:
                    logits[row, book[state.tobytes()]] = 50.0
            return logits, torch.zeros(len(states))

    return Knowing()


def test_a_perfect_policy_decides_alone(alone: Replanner) -> None:
    """A policy that knows a plan by heart is believed, once every state of it is proved."""
    plan = find_plans(ARCH, oracle=alone.oracle, forces=False).plans[0]
    answer = Replanner(ARCH, knowing(plan), alone.oracle).replan(COMPLETE, confidences=True)
    assert answer.decided_by is Stage.GREEDY
    np.testing.assert_array_equal(answer.plans[0].actions, plan.actions)
    assert answer.confidences[0][np.arange(1, len(plan) + 1), plan.actions].min() > 0.99
    assert {"policy", "verdicts", "proofs"} <= set(answer.spent)
    assert sum(answer.spent.values()) <= answer.seconds


def test_a_plan_is_replayed(alone: Replanner) -> None:
    """The answer names its criterion, says how the replay went, and rests on displacements."""
    answer = alone.replan(COMPLETE, alternatives=2)
    assert answer.criterion == "contact"
    assert len(answer.replays) == len(answer.plans) == 2
    for plan, replayed in zip(answer.plans, answer.replays, strict=True):
        assert set(plan.proofs) == {Proof.HISTORY}
        assert alone.oracle.replayer is not None
        whole = alone.oracle.replayer.replay(plan.states)
        assert replayed.stands is whole.good is True
        assert replayed.steps == replayed.of == len(plan)
        # Replayed a few steps at a time, and in one go.
        assert replayed.moved == pytest.approx(whole.largest, rel=1e-9)
        assert replayed.moved > 0
    record = answer.to_dict()
    assert record["criterion"] == "contact"
    assert record["replay"] == record["replays"][0]
    assert record["replay"]["stands"] is True
    assert record["replay"]["steps"] == answer.steps


def test_equilibrium_knows_no_history() -> None:
    answer = Replanner(ARCH, oracle=StabilityOracle(ARCH, StabilitySettings(criterion="equilibrium"))).replan(COMPLETE)
    assert answer.criterion == answer.to_dict()["criterion"] == "equilibrium"
    assert answer.replays == ()
    assert "replay" not in answer.to_dict()
    assert set(answer.plans[0].proofs) == {Proof.FORCES}


@pytest.mark.parametrize("policy", [False, True])
@pytest.mark.parametrize("alternatives", [1, 3])
def test_a_plan_whose_replay_falls_is_not_delivered(policy: bool, alternatives: int, alone: Replanner) -> None:
    """Whatever is proposed first is ruled out in its middle, twice; another plan is found."""
    bad: set[bytes] = set()
    oracle = falling(lambda state: state.tobytes() in bad)
    for _ in range(2):
        replanner = Replanner(ARCH, make() if policy else None, oracle)
        answer = replanner.replan(COMPLETE, alternatives=alternatives)
        assert answer.found
        assert len(answer.plans) == alternatives
        for plan, replayed in zip(answer.plans, answer.replays, strict=True):
            assert replayed.stands is True
            assert validate_plan(plan, ARCH).good
            assert not {state.tobytes() for state in plan.states} & bad
        bad |= {answer.plans[0].states[4].tobytes(), answer.plans[0].states[5].tobytes()}
    assert len(bad) == 4


def test_a_policy_whose_plan_falls_does_not_decide(alone: Replanner) -> None:
    plan = find_plans(ARCH, oracle=alone.oracle, forces=False).plans[0]
    oracle = falling(lambda state: state.tobytes() == plan.states[4].tobytes())
    answer = Replanner(ARCH, knowing(plan), oracle).replan(COMPLETE)
    assert answer.found
    assert answer.decided_by is not Stage.GREEDY
    assert answer.replays[0].stands is True
    assert not (answer.plans[0].states == plan.states[4]).all(axis=1).any()


@pytest.mark.parametrize("policy", [False, True])
@pytest.mark.parametrize("end", [COMPLETE, EMPTY])
def test_where_every_replay_falls_nothing_is_proved(policy: bool, end: States) -> None:
    """Even if it is an end that falls, which no search can go round: the work ends, and with an honest no."""
    oracle = falling(lambda state: np.array_equal(state, end))
    answer = Replanner(ARCH, make() if policy else None, oracle).replan(COMPLETE)
    assert answer.outcome is Outcome.NOT_FOUND
    assert answer.decided_by is Stage.NONE
    assert answer.plans == answer.replays == ()
    assert "whose replay in the order of assembly succeeds" in answer.reason
    # One step, which has nothing but ends.
    last = find_plans(ARCH, oracle=StabilityOracle(ARCH), forces=False).plans[0].states[1]
    answer = Replanner(ARCH, make() if policy else None, falling(lambda _: True)).replan(last)
    assert answer.outcome is Outcome.NOT_FOUND


@pytest.mark.parametrize("policy", [False, True])
def test_a_replay_goes_as_far_as_the_deadline_allows(policy: bool) -> None:
    """The plan is handed back, and what is not known of it is not claimed."""
    oracle = falling(lambda _: False, seconds=0.07)
    replanner = Replanner(ARCH, make() if policy else None, oracle)
    began = time.perf_counter()
    answer = replanner.replan(COMPLETE, deadline=0.5)
    assert time.perf_counter() - began < 0.5 + 0.9
    assert answer.found
    assert answer.deadline_passed
    (replayed,) = answer.replays
    assert replayed.stands is None
    assert replayed.steps < replayed.of == len(answer.plans[0])
    assert answer.to_dict()["replay"]["stands"] is None
    assert answer.spent["replays"] > 0.3


def test_at_the_deadline_a_plan_that_falls_is_not_said_to_stand() -> None:
    """No time is left for another one, and every state of it stands; nor is it proven that there is none."""
    answer = Replanner(ARCH, oracle=falling(lambda state: np.array_equal(state, EMPTY), seconds=0.07)).replan(
        COMPLETE, deadline=0.5
    )
    assert all(replayed.stands is not True for replayed in answer.replays)
    assert answer.found == bool(answer.replays)
    assert answer.outcome is not Outcome.PROVED_IMPOSSIBLE
    if answer.found:
        assert answer.deadline_passed
        assert answer.to_dict()["replay"]["stands"] is not True


def test_a_state_that_slides_is_no_proof() -> None:
    """An end that slides makes looking vain, but does not prove that there is no plan."""
    bottle = load_structure("bottle")
    slides = np.array([1, 0, 1, 0, 0, 2, 1, 1, 0, 1, 2, 2], dtype=np.uint8)
    answer = Replanner(bottle).replan(slides)
    assert answer.outcome is Outcome.NOT_FOUND
    assert answer.reason == "the state slides"


def test_broken_weights_are_noticed(alone: Replanner) -> None:
    import torch

    policy = make()
    with torch.no_grad():
        next(policy.parameters()).fill_(torch.nan)
    with pytest.raises(InputError, match="not finite"):
        Replanner(ARCH, policy, alone.oracle).replan(COMPLETE)


def test_policy_of_another_structure() -> None:
    with pytest.raises(InputError, match="this policy is for 7"):
        Replanner(load_structure("arch:blocks=7"), make())


def test_oracle_of_another_structure(alone: Replanner) -> None:
    with pytest.raises(InputError, match="make one of the latter"):
        Replanner(load_structure("arch:blocks=7"), oracle=alone.oracle)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"robots": 0}, "at least 1"),
        ({"alternatives": 0}, "ask for at least 1"),
        ({"alternatives": 10**9}, "at most 1000"),
        ({"deadline": 0}, "give more than 0"),
        ({"deadline": float("nan")}, "give more than 0"),
        ({"target": [1, 1, 1, 1, 1]}, "a state of 5 values does not fit 7 parts"),
        ({"fixed": [9]}, "fixed"),
        ({"missing": [9]}, "missing"),
        ({"missing": [2], "direction": Direction.ASSEMBLY}, "said to be missing, yet the state has it"),
        ({"target": [2, 1, 1, 1, 1, 2, 2], "robots": 1}, ""),
    ],
)
def test_bad_requests(options: dict[str, Any], words: str) -> None:
    if not words:
        replan(ARCH, COMPLETE, **options)
        return
    with pytest.raises(InputError, match=words) as caught:
        replan(ARCH, COMPLETE, **options)
    assert "\n" not in str(caught.value)


def test_target_on_both_sides_is_refused() -> None:
    here, there = COMPLETE.copy(), COMPLETE.copy()
    here[0], there[4] = REMOVED, REMOVED
    with pytest.raises(StateError, match="not reachable: part voussoir-0 would have to be added and part voussoir-4"):
        replan(ARCH, here, target=there)


def test_no_legal_action_is_refused() -> None:
    """The only robot holds a part that stays held, while others wait."""
    state, target = COMPLETE.copy(), EMPTY.copy()
    state[2] = target[2] = HELD
    with pytest.raises(StateError, match=r"no action is legal in this state: voussoir-2 is held"):
        replan(ARCH, state, target=target, robots=1)


def test_works_without_torch() -> None:
    """Search alone needs no torch; a policy says which extra brings it."""
    program = (
        "import sys; sys.modules['torch'] = None\n"
        "import importlib.util as u; find = u.find_spec\n"
        "u.find_spec = lambda name, *rest: None if name == 'torch' else find(name, *rest)\n"
        "from falsework import load_structure\n"
        "from falsework.assembly.state import complete_state\n"
        "from falsework.replanning.replanner import replan\n"
        "import falsework.replanning.plan_diff, falsework.replanning.policy_guide\n"
        "arch = load_structure('arch:blocks=3')\n"
        "assert replan(arch, complete_state(arch.boundary)).found\n"
        "try:\n    replan(arch, complete_state(arch.boundary), policy=object())\n"
        "except Exception as error:\n    print(type(error).__name__, error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "DependencyError" in done.stdout
    assert "falsework[learn]" in done.stdout


def test_interruption_is_passed_on(alone: Replanner, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody at the keyboard ends the work; nothing is found in the meantime."""

    def interrupted(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Planner, "_advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        alone.replan(COMPLETE)
    monkeypatch.undo()
    assert alone.replan(COMPLETE).found  # it can be asked again


def test_errors_are_ours() -> None:
    assert issubclass(StateError, FalseworkError)


def test_a_deadline_may_pass_before_a_search_begins() -> None:
    """A search that raises then, such as on the ends of the task, ends its turn and no other request."""

    def late(*, progress: object = None, stop: object = None) -> SearchResult:
        raise DeadlineExceeded

    clock = SimpleNamespace(passed=True, limited=True, between=lambda: None, check=lambda: None)
    session = cast(ReplanSession, SimpleNamespace(busy=False, clock=clock))
    turns = TimeSlices(late, Stage.EXHAUSTIVE, 1)
    assert turns.take(session) is None
    assert turns.run(lambda: True) is None
    assert not session.busy

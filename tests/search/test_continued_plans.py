"""New plans go on from steps that are done: their numbers stay, and replays begin with their history."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import falsework as fw
from falsework import (
    Assembly,
    Direction,
    Plan,
    Replanner,
    StabilityOracle,
    StabilitySettings,
    Verdict,
    find_plans,
    load_structure,
    replan,
)
from falsework.assembly import HELD, with_props
from falsework.errors import InputError, StateError
from falsework.replanning import SiteSteps
from falsework.replanning.named_state import named_state
from falsework.replanning.replanner import ReplanResult, replan_with_reserve
from falsework.replanning.request import Request
from falsework.replanning.request_replayer import RequestReplayer
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import save_plan
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.result import Route
from falsework.stability.contact.replay import Replayer
from falsework.stability.verdict import Proof

ARCH = load_structure("arch:blocks=7")


@pytest.fixture(scope="module")
def plan() -> Plan:
    return find_plans(ARCH, robots=2).plans[0]


def late(plan: Plan, step: int) -> int:
    """The part that the plan inserts next after a step."""
    return next(one.part for one in plan.steps[step:] if one.action == "insert")


@pytest.mark.parametrize("reserve", [1.0, 1.1])
def test_a_replay_that_goes_on_is_that_of_the_whole(plan: Plan, reserve: float) -> None:
    settings = StabilitySettings(reserve=reserve)
    whole = Replayer(ARCH, settings).replay(plan.states, presses=plan.presses_before)
    for step in (0, 1, 5, len(plan) - 1):
        built = plan.states[: step + 1], plan.presses_before[: step + 1]
        goes_on = RequestReplayer(Replayer(ARCH, settings), Deadline(None), built=built)
        rest = goes_on.replay(plan.states[step:])
        np.testing.assert_allclose(rest.moved, whole.moved[step:], rtol=1e-9, atol=1e-15)
        assert rest.stands.tolist() == whole.stands[step:].tolist()
        summary = goes_on.replay_in_time(plan.states[step:])
        assert (summary.stands, summary.steps, summary.of) == (True, len(plan), len(plan))
        assert summary.moved == pytest.approx(whole.moved.max(), rel=1e-9)
        assert len(summary.residuals) == len(summary.presses) == len(plan.states)


def test_history_counts(plan: Plan) -> None:
    """From rest the same steps move parts by other amounts, so that it matters where a replay begins."""
    step = len(plan) // 2
    built = plan.states[: step + 1], plan.presses_before[: step + 1]
    goes_on = RequestReplayer(Replayer(ARCH), Deadline(None), built=built).replay(plan.states[step:])
    from_rest = RequestReplayer(Replayer(ARCH), Deadline(None)).replay(plan.states[step:])
    assert np.abs(goes_on.moved[1:] - from_rest.moved[1:]).max() > 1e-3 * goes_on.moved.max()


def test_a_search_begins_with_the_history_of_what_is_built(plan: Plan) -> None:
    """One state alone, as a search replays its first, comes with the history that the steps so far have left."""
    step = len(plan) // 2
    built = plan.states[: step + 1], plan.presses_before[: step + 1]
    (begun,) = (
        RequestReplayer(Replayer(ARCH), Deadline(None), built=built).replay(plan.states[step : step + 1]).histories
    )
    whole = Replayer(ARCH).replay(*built[:1], presses=built[1]).histories[-1]
    np.testing.assert_array_equal(begun.springs, whole.springs)
    from_rest = Replayer(ARCH).replay(plan.states[step : step + 1]).histories[0]
    assert np.abs(begun.springs - from_rest.springs).max() > 1e-3 * np.abs(whole.springs).max()


def test_a_state_stands_as_it_was_built_also_where_it_slides_from_rest() -> None:
    vault = load_structure("vault:parts=30")
    plan = find_plans(vault, robots=2).plans[0]
    oracle = StabilityOracle(vault, StabilitySettings.from_claim(plan.claim))
    (step, *_) = np.flatnonzero(oracle.verdicts(plan.states).slides).tolist()
    answer = replan(plan, step=step, structure=vault)
    assert answer.found, answer.reason
    assert validate_plan(answer.plans[0], vault).good
    assert (
        Replanner(vault, oracle=oracle).replan(plan.states[step]).reason
        == "the state slides with friction divided by 1.1"
    )
    tight = Replanner(vault, oracle=oracle).replan(plan=plan, step=step, deadline=1e-6)
    assert tight.reason == "the deadline passed; more time may find a plan"


def test_steps_that_are_done_stay(plan: Plan) -> None:
    for step in (2, 6, 9):
        part = late(plan, step)
        answer = replan(plan, step=step, structure=ARCH, missing=[ARCH.names[part]])
        assert answer.found, answer.reason
        new = answer.plans[0]
        assert answer.built == step
        np.testing.assert_array_equal(new.states[: step + 1], plan.states[: step + 1])
        np.testing.assert_array_equal(new.actions[:step], plan.actions[:step])
        assert new.steps[step].number == step + 1
        assert validate_plan(new, ARCH).good
        assert new.replay is not None
        assert new.replay.stands
        repeated = Replayer(ARCH, StabilityOracle(ARCH, StabilitySettings(**vars(new.claim))).settings).replay(
            new.states, presses=new.presses_before
        )
        assert new.replay.denied_by(repeated) == ""


def test_what_it_takes_from_the_plan(plan: Plan, tmp_path: Path) -> None:
    """Robots, criterion and reserve, from the file of a plan too."""
    three = find_plans(ARCH, robots=3, stability=StabilitySettings(reserve=1.2)).plans[0]
    save_plan(replace(three, source={"built_in": "arch:blocks=7"}), tmp_path / "plan.json")
    for subject in (three, tmp_path / "plan.json", str(tmp_path / "plan.json")):
        new = fw.replan(subject, step=3).plans[0]
        assert (new.robots, new.claim.reserve) == (3, 1.2)
    fewer = fw.replan(plan, step=4, robots=2, stability=StabilitySettings(criterion="equilibrium")).plans[0]
    assert fewer.claim.criterion == "equilibrium"
    assert validate_plan(fewer, ARCH, StabilitySettings(criterion="equilibrium")).good


def test_ways_in_are_asked_of_what_follows() -> None:
    """As of the steps that are done; and where these were not asked for ways but have them, those of all are known."""
    stands = StabilitySettings(criterion="equilibrium")
    clear, free = (
        find_plans(ARCH, robots=2, stability=stands, removable_only_if_clear=rule).plans[0] for rule in (True, False)
    )
    assert replan(clear, step=3, structure=ARCH).plans[0].removable_only_if_clear
    assert not replan(free, step=3, structure=ARCH).plans[0].removable_only_if_clear
    asked = replan(free, step=3, structure=ARCH, removable_only_if_clear=True).plans[0]
    assert asked.removable_only_if_clear
    assert validate_plan(asked, ARCH, stands).good


def test_repeated_holds_go_on() -> None:
    """One robot changes from a part to another. Plans that hold parts again take no missing parts, said at once."""
    first, second = np.flatnonzero(~ARCH.boundary)[[0, 3]]
    start = np.where(ARCH.boundary, 2, 1).astype(np.uint8)
    target = start.copy()
    start[first] = target[second] = 2
    begun = find_plans(ARCH, robots=1, start=start, target=target, allow_regrasp=True).plans[0]
    for step in range(3):
        answer = replan(begun, step=step, structure=ARCH, target=start, direction=Direction.ASSEMBLY)
        assert [str(one.action) for one in answer.plans[0]] == ["release", "hold"]
    plan = find_plans(ARCH, robots=2, stability=StabilitySettings(criterion="equilibrium")).plans[0]
    step = int(np.flatnonzero((plan.states[:, plan.boundary == 0] == 1).any(axis=1))[0])
    states = [*plan.states[: step + 1], *plan.states[step : step - 2 : -1], *plan.states[step:]]
    again = replace(
        plan,
        states=np.array(states),
        actions=Route.from_states(np.array(states)).actions,
        verdicts=(Verdict.STABLE,) * len(states),
        proofs=(Proof.NONE,) * len(states),
        residuals=np.zeros(len(states)),
        allow_regrasp=True,
    )
    late_part = [ARCH.names[late(plan, step)]]
    assert replan(again, step=step, structure=ARCH, missing=late_part).found
    with pytest.raises(InputError, match="repeated holds take no missing parts"):
        Request(plan=again, step=step + 2, missing=late_part).task(ARCH)


def test_steps_that_do_not_come_to_rest_are_named(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RequestReplayer, "executed_fails_at", lambda _: 3)
    answer = replan(plan, step=5)
    assert not answer.found
    assert answer.reason == "the steps that are done do not come to rest in a replay, after step 3"


def test_a_replayer_answers_within_the_deadline(plan: Plan) -> None:
    replanner = Replanner(ARCH)
    answer = replanner.replan(plan=plan, step=4, deadline=1e-4)
    assert not answer.found or len(answer.plans[0]) == len(plan)
    assert replanner.replan(plan=plan, step=4, deadline=30.0).built == 4


def test_alternatives_all_begin_with_what_is_done(plan: Plan) -> None:
    answer = replan(plan, step=4, alternatives=2)
    assert len(answer.plans) == 2
    for new in answer.plans:
        np.testing.assert_array_equal(new.states[:5], plan.states[:5])
        assert validate_plan(new, ARCH).good


@pytest.mark.parametrize(
    ("subject", "options", "message"),
    [
        ("plan", {"step": 99}, "step 99 does not exist; the plan has the steps 1 to 14, and 0 is the start"),
        ("plan", {"step": 4, "parts_at_once": 0}, "0 is not a number of parts of arch:blocks=7 that can move at once"),
        ("plan", {"step": 4, "moves": -1}, "-1 is not a number of moves of a way out; give 1"),
        ("plan", {"step": 4, "direction": "up"}, "there is no direction 'up'; give disassembly or assembly"),
        ("plan", {}, "the plan has 14 steps; name the last one that is done, 0 for none"),
        ("plan", {"step": 1.5}, "name the last one that is done, 0 for none; 1.5 is no step"),
        ("plan", {"step": 4, "alternatives": 1.5}, "1.5 alternatives is not a number of plans"),
        ("plan", {"step": 4, "seed": 0.5}, "a seed is a whole number; 0.5 was given"),
        ("plan", {"step": 4, "deadline": "soon"}, "a deadline of 'soon' is no number; give seconds"),
        ("plan", {"step": 2, "state": "empty"}, "leave one of the two out"),
        ("plan", {"step": 4, "missing": [0]}, "is said to be missing, yet step 1 has placed it"),
        ("plan", {"step": 4, "missing": ["stone17"]}, "missing is part 'stone17', which does not exist"),
        ("plan", {"step": 4, "structure": "arch:blocks=5"}, "the plan is for arch:blocks=7 with 9 parts"),
        ("arch:blocks=7", {"step": 4}, "step 4 is of no plan; give the plan too, or the state"),
        ("arch:blocks=7", {"structure": "arch"}, "structure names that of a plan"),
    ],
)
def test_wrong_requests(subject: str, options: dict[str, Any], message: str, plan: Plan) -> None:
    if options.get("missing") == [0]:
        options = {**options, "missing": [plan.steps[0].part]}
    with pytest.raises(InputError, match=message):
        replan(plan if subject == "plan" else subject, **options)


@pytest.mark.parametrize("direction", list(Direction))
def test_more_held_than_robots_is_said_of_the_state_in_either_direction(direction: Direction) -> None:
    held = {"standing": [], "held": [0, 6]}
    with pytest.raises(StateError, match="the state has 2 parts held; 1 robot can hold 1; give more, or let go"):
        replan(ARCH, held, robots=1, direction=direction)


def test_plans_with_props_go_on() -> None:
    """The prop that stands stays until it may go, and the steps that are done keep their numbers."""
    arch = load_structure("arch:blocks=7", ground=True)
    plan = find_plans(arch, robots=2).plans[0]
    step = next(k for k in range(len(plan)) if (plan.states[k] == 2).sum() == arch.boundary.sum() + 2)
    part = arch.names[int(np.flatnonzero((plan.states[step] == 2) & ~arch.boundary)[0])]
    first = replan(plan, step=step, since=SiteSteps(props=[part]), structure=arch)
    assert first.built == step + 1
    new = first.plans[0]
    assert [str(one) for one in new.steps[:step]] == [str(one) for one in plan.steps[:step]]
    assert new[step].words == f"insert prop-{part}"
    assert new[-1].state[-1] == 0  # taken away in the end
    propped = with_props(arch, new.props)
    assert validate_plan(new, propped).good
    for done in (step + 1, len(new) - 1):
        again = replan(new, step=done, structure=arch)
        assert [str(one) for one in again.plans[0].steps[:done]] == [str(one) for one in new.steps[:done]]
        assert validate_plan(again.plans[0], propped).good
    with pytest.raises(InputError, match="plans with props take no missing parts; leave out one of the two"):
        replan(new, step=step + 1, structure=arch, missing=[part])
    with pytest.raises(InputError, match="plans with props take no alternatives; leave out one of the two"):
        replan(new, step=step + 1, structure=arch, alternatives=2)
    with pytest.raises(InputError, match="has props, which policies do not know; leave the policy out"):
        Replanner(propped, policy=object())


def test_holds_since_are_the_next_steps(plan: Plan) -> None:
    step = next(k for k in range(len(plan)) if (plan.states[k] == 1).any() and (plan.states[k] == 2).sum() == 3)
    standing = int(np.argmax(plan.states[step] == 1))
    answer = replan(plan, step=step, since=SiteSteps(held=[standing]), structure=ARCH)
    assert answer.plans[0][step].words == f"hold {ARCH.names[standing]}"
    assert validate_plan(answer.plans[0], ARCH).good


def test_a_robot_changes_from_part_to_part(plan: Plan) -> None:
    """Where no robot is free, one lets go before it takes hold."""
    step = next(k for k in range(len(plan)) if (plan.states[k] == 1).any() and (plan.states[k] == 2).sum() == 4)
    held = int(np.flatnonzero((plan.states[step] == 2) & ~ARCH.boundary)[0])
    standing = int(np.argmax(plan.states[step] == 1))
    done, _ = SiteSteps(held=[standing], released=[held]).after(plan, step, ARCH)
    names = ARCH.names
    assert [one.words for one in done.steps[step:]] == [f"release {names[held]}", f"hold {names[standing]}"]
    with pytest.raises(StateError, match=r"no robot is free to hold part .* are held; release one of them too"):
        SiteSteps(held=[standing]).after(plan, step, ARCH)


@pytest.mark.parametrize(
    ("since", "message"),
    [
        (SiteSteps(props=[0]), "part voussoir-0 is not placed yet, so no prop can stand under it"),
        (SiteSteps(props=["abutment-7"]), "part abutment-7 is fixed and needs no prop"),
        (SiteSteps(held=[0]), "part voussoir-0 is not placed yet, so no robot can take hold of it"),
        (SiteSteps(released=["abutment-7"]), "part abutment-7 is fixed, so no robot can let go of it"),
        (SiteSteps(held=["keystone"]), "held is part 'keystone', which does not exist"),
    ],
)
def test_what_cannot_have_been_done_is_refused(since: SiteSteps, message: str) -> None:
    arch = load_structure("arch:blocks=7", ground=True)
    plan = find_plans(arch, robots=2).plans[0]
    with pytest.raises(InputError, match=message):
        replan(plan, step=0, since=since, structure=arch)


def test_what_was_done_since_needs_a_step() -> None:
    with pytest.raises(InputError, match="give plan and step"):
        replan("arch:blocks=7", since=SiteSteps(held=[0]))


@pytest.mark.parametrize(
    ("given", "values"),
    [
        ("empty", [0, 0, 0, 2, 2]),
        ("complete", [1, 1, 1, 2, 2]),
        ({"standing": ["voussoir-0"], "held": [1]}, [1, 2, 0, 2, 2]),
        ({"standing": ["0-1"], "held": ["voussoir-2"]}, [1, 1, 2, 2, 2]),
        ({"standing": ["abutment-3", 0], "held": []}, [1, 0, 0, 2, 2]),
        ({}, [0, 0, 0, 2, 2]),
        ([1, 2, 0, 2, 2], [1, 2, 0, 2, 2]),
    ],
)
def test_states_by_parts(given: Any, values: list[int]) -> None:
    small: Assembly = load_structure("arch:blocks=3")
    assert named_state(given, small).tolist() == values


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("half", "the state is 'half'; give complete, empty, or one value a part"),
        ({"lying": [0]}, "the state has an unknown entry 'lying'; give standing and held"),
        ({"standing": ["top"]}, "the state: standing is part 'top', which does not exist"),
        ({"held": [17]}, "the state: held is part 17, which does not exist"),
        ({"standing": [0], "held": ["voussoir-0"]}, "part voussoir-0 both stands by itself and is held"),
        ({"standing": "voussoir-0"}, "the state: standing parts are 'voussoir-0'; give a list"),
        ([[1, 1, 1, 2, 2]] * 2, "the state holds 2 states; give one, of shape"),
    ],
)
def test_what_is_no_state(given: Any, message: str) -> None:
    with pytest.raises((StateError, InputError), match=message):
        named_state(given, load_structure("arch:blocks=3"))


def test_requests_are_asked_again_without_the_reserve_where_no_plan_keeps_it() -> None:
    """The arch slides with a friction of 0.3 / 1.1, a held part of it does not; each request has one answer."""
    arch = load_structure("arch:blocks=5", friction=0.3)
    one = arch.boundary * 2
    one[0] = HELD
    requests = [Request("empty", target=target, deadline=60.0) for target in (one, "complete")]
    made: list[float] = []

    def replanner(stability: StabilitySettings) -> Replanner:
        made.append(stability.reserve)
        return Replanner(arch, None, StabilityOracle(arch, stability))

    told: dict[int, ReplanResult] = {}
    answers = replan_with_reserve(
        requests,
        StabilitySettings(reserve=1.1),
        replanner,
        finished=lambda number, answer: told.update({number: answer}),
    )
    assert made == [1.1, 1.0]
    assert [answer.unwrap().claim.reserve for answer in answers] == [1.1, 1.0]
    assert [answer.unreserved for answer in answers] == ["", "the target is not stable with friction divided by 1.1"]
    assert [told[number] for number in (0, 1)] == answers


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_the_rest_of_the_plan_is_tried_first(criterion: Any) -> None:
    """It is the answer while it stands and keeps the rules of the request, and no search is needed for that."""
    stability = StabilitySettings(criterion=criterion)
    old = find_plans(ARCH, stability=stability, robots=2).plans[0]
    replanner = Replanner(ARCH, None, StabilityOracle(ARCH, stability))
    for step in (0, 5, len(old) - 1):
        answer = replanner.replan(plan=old, step=step)
        assert answer.decided_by == "rest of the plan"
        assert answer.unwrap().actions.tolist() == old.actions.tolist()
        assert answer.search is None
        assert validate_plan(answer.unwrap(), ARCH, stability).good
    answer = replanner.replan(plan=old, step=5, target=old.states[7])  # where the plan does not end
    assert answer.found
    assert answer.decided_by != "rest of the plan"
    late = int(old.actions[6] % ARCH.part_count)
    (need,) = replanner.replan(plan=old, step=2, missing=[late], robots=3).unwrap().needs
    assert need.after_parts >= int((old.actions[2:6] >= ARCH.part_count).sum())


def test_the_rest_of_a_plan_that_falls_now_is_no_answer(plan: Plan) -> None:
    """With less friction the arch slides, and with a reserve of fifty none of its parts stay."""
    answer = replan(plan, step=4, structure=ARCH, stability=StabilitySettings(reserve=50.0))
    assert answer.unwrap().claim.reserve == 1.0
    slippery = ARCH.replace(friction=0.2)
    stability = StabilitySettings.from_claim(plan.claim)
    moved = replace(plan, identity=slippery.identity, friction=slippery.friction)
    answer = Replanner(slippery, None, StabilityOracle(slippery, stability)).replan(plan=moved, step=4)
    assert answer.decided_by != "rest of the plan"
    assert not answer.found

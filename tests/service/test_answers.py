"""Truth of the answers of a service: plans hold by the exact solver, verdicts agree with it, and a no is a no."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import jsonschema
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from falsework import Plan, StabilityOracle, StabilitySettings, find_plans
from falsework.assembly import complete_state, empty_state
from falsework.assembly.props import with_props
from falsework.search.find import PLANS
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.search.plans.plan_model import plan_schema
from falsework.stability import HoldSettings

HALF = [1, 2, 0, 2, 1, 2, 2]
"""The keystone is not in, and robots hold its neighbours."""


def plans_of(answer: dict[str, Any]) -> list[Plan]:
    """The plans in an answer, each as its published schema has it."""
    for plan in answer["plans"]:
        jsonschema.Draft202012Validator(plan_schema()).validate(plan)
    return [plan_from_dict(plan) for plan in answer["plans"]]


@pytest.mark.parametrize(
    ("question", "first", "last", "direction"),
    [
        ({}, "complete", "empty", "disassembly"),
        ({"state": "empty", "direction": "assembly"}, "empty", "complete", "assembly"),
        ({"state": [0, 0, 1, 1, 1, 2, 2], "target": "complete"}, None, None, None),
        ({"state": HALF}, HALF, "empty", "disassembly"),
        (
            {"state": [1, 2, 0, 2, 1, 2, 2], "target": "complete", "robots": 3},
            [1, 2, 0, 2, 1, 2, 2],
            "complete",
            "assembly",
        ),
    ],
)
def test_a_plan_leads_where_it_shall_and_every_state_stands(
    question: dict[str, Any], first: Any, last: Any, direction: str | None, live: Any
) -> None:
    reply = live.post("/replan", {"robots": 2, "deadline": 60_000, **question})
    assert reply.status_code == 200
    answer = reply.json()
    if direction is None:  # two blocks of an arch are gone and nobody holds the others: that state has fallen
        assert answer["outcome"] == "proved_impossible"
        assert answer["moving"]
        return
    (plan,) = plans_of(answer)
    words = {"complete": complete_state(live.assembly.boundary), "empty": empty_state(live.assembly.boundary)}
    assert answer["outcome"] == "found"
    assert answer["direction"] == direction
    begun, ended = plan.states[[0, -1]] if direction == "assembly" else plan.states[[-1, 0]]
    assert np.array_equal(begun, words.get(first, first) if isinstance(first, str) else first)
    assert np.array_equal(ended, words[last])
    assert plan.source is None
    assert validate_plan(plan, live.assembly).good


def test_where_no_plan_keeps_the_reserve_there_is_one_without_and_why(live: Any) -> None:
    """As `falsework replan` has it."""
    asked = {"state": "complete", "direction": "disassembly", "reserve": 50, "deadline": 60_000}
    answer = live.post("/replan", asked).json()
    (plan,) = plans_of(answer)
    assert plan.claim.reserve == 1.0
    assert answer["unreserved"] == "the state is not stable with friction divided by 50"
    assert validate_plan(plan, live.assembly).good
    answer = live.post("/replan", {**asked, "robots": 1}).json()
    assert answer["outcome"] == "proved_impossible"
    assert answer["reason"] != answer["unreserved"]


def test_the_reserve_is_that_of_the_command_and_that_of_a_plan_goes_on(live: Any) -> None:
    answer = live.post("/replan", {"state": "empty", "direction": "assembly"}).json()
    (plan,) = plans_of(answer)
    assert (plan.claim.reserve, answer["unreserved"]) == (PLANS.reserve, "")
    (other,) = plans_of(live.post("/replan", {"state": "empty", "direction": "assembly", "reserve": 1.2}).json())
    for sent, given, kept in ((plan, {}, 1.1), (other, {}, 1.2), (other, {"reserve": 1.0}, 1.0)):
        asked = {"plan": plan_to_dict(sent), "step": 2, "deadline": 60_000, **given}
        (found,) = plans_of(live.post("/replan", asked).json())
        assert found.claim.reserve == kept


def test_robots_and_reserve_are_those_of_the_request(live: Any) -> None:
    """Requests for different robots that come together each get theirs; what is left out is as by default."""
    usual = {"state": "empty", "direction": "assembly", "deadline": 60_000}
    force = 20 * 9.81 * float(live.assembly.mass.mass.max())
    asked = [
        {},
        {"holds": {"force": force, "stiffness": None, "mode": "locked"}, "reserve": 1.2},
        {"holds": {"stiffness": 2e6}},
    ]
    with ThreadPoolExecutor(len(asked)) as pool:
        replies = list(pool.map(lambda entries: live.post("/replan", {**usual, **entries}), asked))
    usual_robots, strong, soft = (plans_of(reply.json())[0] for reply in replies)
    assert (usual_robots.claim.reserve, strong.claim.reserve, soft.claim.reserve) == (1.1, 1.2, 1.1)
    assert (strong.claim.holds.force, strong.claim.holds.stiffness) == (force, np.inf)
    assert strong.claim.holds.mode == "locked"
    assert soft.claim.holds == replace(usual_robots.claim.holds, stiffness=2e6)
    for plan in (usual_robots, strong, soft):
        assert validate_plan(plan, live.assembly).good


def test_alternatives_differ(live: Any) -> None:
    answer = live.post("/replan", {"alternatives": 3, "robots": 3}).json()
    plans = plans_of(answer)
    assert len(plans) == 3
    assert [(replay["stands"], replay["of"]) for replay in answer["replays"]] == [(True, len(plan)) for plan in plans]
    assert len({plan.actions.tobytes() for plan in plans}) == 3
    assert np.array(answer["distances"])[np.triu_indices(3, 1)].min() > 0


def test_fixed_and_missing_parts(live: Any) -> None:
    answer = live.post("/replan", {"fixed": [0], "robots": 3}).json()
    (plan,) = plans_of(answer)
    assert 0 not in plan.actions % live.assembly.part_count
    answer = live.post("/replan", {"state": "empty", "direction": "assembly", "missing": [4], "robots": 3}).json()
    (plan,) = plans_of(answer)
    (need,) = plan.needs
    assert need.part == 4
    assert need.after_parts == 4  # the last of five


def test_one_robot_cannot_build_an_arch_and_that_is_proved(live: Any) -> None:
    answer = live.post("/replan", {"robots": 1}).json()
    assert answer["outcome"] == "proved_impossible"
    assert answer["plans"] == []
    assert answer["reason"]


def test_verdicts_agree_with_the_exact_solver(live: Any) -> None:
    random = np.random.default_rng(0)
    states = random.integers(0, 3, (60, live.assembly.part_count))
    states[:, live.assembly.boundary] = 2
    truth = StabilityOracle(live.assembly, StabilitySettings(solver="exact")).verdicts(states, require_certificate=True)
    for explain in (False, True):
        found = live.post("/stability", {"states": states.tolist(), "explain": explain}).json()["verdicts"]
        assert [record["verdict"] == "stable" for record in found] == truth.stable.tolist()
        for record, stable in zip(found, truth.stable, strict=True):
            assert ("moving" in record) == explain
            if explain:
                assert bool(record["moving"]) != stable
                assert not set(record["moving"]) & set(np.flatnonzero(live.assembly.boundary).tolist())


def test_clients_that_come_together_are_served_together(live: Any) -> None:
    def one(seed: int) -> int:
        kind = ("/replan", {"seed": seed}) if seed % 2 else ("/stability", {"states": ["complete", "empty"]})
        return live.post(*kind).status_code

    with ThreadPoolExecutor(24) as clients:
        assert set(clients.map(one, range(72))) == {200}
    counts = {
        sample.name + "".join(sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(live.client.get("/metrics").text)
        for sample in family.samples
    }
    assert counts["falsework_requests_total/replan200"] >= 36
    assert counts["falsework_batch_size_sumreplan"] > counts["falsework_batch_size_countreplan"]
    assert counts["falsework_batch_size_sumstability"] > counts["falsework_batch_size_countstability"]
    assert counts["falsework_workers_ready"] == 2


def test_the_structure_says_which_number_is_which_part(live: Any) -> None:
    record = live.client.get("/structure").json()
    assert record["identity"] == live.assembly.identity
    assert record["policy"] is False
    assert [part["name"] for part in record["parts"]] == list(live.assembly.names)
    assert sum(part["mass"] for part in record["parts"]) == pytest.approx(live.assembly.mass.mass.sum(), rel=1e-5)


def test_the_page_describes_everything_and_loads_nothing(live: Any) -> None:
    document = live.client.get("/openapi.json").json()
    page = live.client.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    assert page.text == live.client.get("/").text
    for path in document["paths"]:
        assert path in page.text
    for name in document["components"]["schemas"]:
        assert f'id="{name}"' in page.text
    assert "<script" not in page.text
    assert "src=" not in page.text
    assert 'href="http' not in page.text


def test_every_reference_in_the_description_leads_somewhere(live: Any) -> None:
    document = live.client.get("/openapi.json").json()
    names = set(document["components"]["schemas"])
    found = json.dumps(document).split('"#/components/schemas/')[1:]
    assert {text.partition('"')[0] for text in found} <= names
    assert "#/$defs" not in json.dumps(document)


def test_a_plan_goes_on_from_its_step_without_a_late_part(live: Any) -> None:
    """Parts by name; the new plan has the steps that are done, with their numbers."""
    (old,) = plans_of(live.post("/replan", {"state": "empty", "direction": "assembly"}).json())
    late = next(step for step in old.steps[3:] if step.action == "insert")
    values = live.post("/replan", {"state": "empty", "direction": "assembly"}).json()["plans"][0]
    reply = live.post("/replan", {"plan": values, "step": 2, "missing": [late.name]})
    assert reply.status_code == 200, reply.json()
    answer = reply.json()
    (new,) = plans_of(answer)
    assert (answer["outcome"], answer["built"], answer["direction"]) == ("found", 2, "assembly")
    assert answer["steps"] == len(new) - 2
    np.testing.assert_array_equal(new.states[:3], old.states[:3])
    assert validate_plan(new, live.assembly).good
    named = {"standing": [step.name for step in old.steps[:2] if old.states[2, step.part] == 1]}
    named["held"] = [old.part_names[part] for part in np.flatnonzero(old.states[2] == 2) if not old.boundary[part]]
    plain = live.post("/replan", {"state": named, "target": "complete", "missing": [late.part]}).json()
    (rest,) = plans_of(plain)
    np.testing.assert_array_equal(rest.states[0], old.states[2])
    assert plain["built"] == 0


def test_a_plan_goes_on_under_its_own_gravity_and_tolerance(live: Any) -> None:
    """And with its own holds, which may be too weak for another gravity, where the request gives no others."""
    moon = StabilitySettings(gravity=1.62, tolerance=5e-5, cone="octagon", holds=HoldSettings(1e7, 600.0))
    old = find_plans(live.assembly, stability=moon).unwrap()
    (new,) = plans_of(live.post("/replan", {"plan": plan_to_dict(old), "step": 3, "deadline": 60_000}).json())
    assert new.claim == old.claim
    assert validate_plan(new, live.assembly, moon).good
    strong = {"force": 1e6, "moment": 1e6}
    asked = {"plan": plan_to_dict(old), "step": 3, "deadline": 60_000, "holds": strong}
    (new,) = plans_of(live.post("/replan", asked).json())
    assert new.claim == replace(old.claim, holds=HoldSettings(**strong))
    heavy = plan_to_dict(old)
    heavy["stability"]["gravity"] = 9.81
    reply = live.post("/replan", {"plan": heavy, "step": 3})
    assert reply.status_code == 422
    assert "holds: robots that hold with at most 600 N cannot carry part voussoir-0" in reply.json()["error"]


def test_props_and_holds_on_site_are_the_next_steps(grounded: Any) -> None:
    """And the plan that has them goes on once more, with its props, and can be drawn."""
    (values,) = grounded.post("/replan", {"state": "empty", "direction": "assembly"}).json()["plans"]
    old, size = plan_from_dict(values), grounded.assembly.part_count
    # One of the stones that lean over the ground is held, and no other part is.
    step, held = next(
        (row, part)
        for row, state in enumerate(old.states)
        for part in (1, 2, 3)
        if state[part] == 2 and (state[~old.boundary] == 2).sum() == 1
    )
    part = old.part_names[held]
    since = {"props": [part], "released": [part]}
    reply = grounded.post("/replan", {"plan": values, "step": step, "since": since, "target": "complete"})
    answer = reply.json()
    assert reply.status_code == 200, answer
    assert (answer["outcome"], answer["built"]) == ("found", step + 2)
    (new,) = plans_of(answer)
    assert [(one.action, one.name) for one in new.steps[step : step + 2]] == [
        ("insert", f"prop-{part}"),
        ("release", part),
    ]
    assert new.states.shape[1] == size + 1
    assert not new.states[-1, size:].any()
    assert validate_plan(new, with_props(grounded.assembly, new.props)).good
    again = grounded.post("/replan", {"plan": answer["plans"][0], "step": step + 3}).json()
    assert (again["outcome"], again["built"]) == ("found", step + 3)
    drawn = grounded.post("/picture", {"plan": answer["plans"][0], "step": step + 1, "width": 100})
    assert drawn.content.startswith(b"\x89PNG"), drawn.text
    values["structure"]["props"] = answer["plans"][0]["structure"]["props"]
    assert "the plan is of" in grounded.post("/replan", {"plan": values, "step": 1}).json()["error"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"since": {"held": ["nobody"]}}, "since: held is part 'nobody', which does not exist"),
        ({"since": {"props": [3]}}, "since: part voussoir-3 is not placed yet, so no prop can stand under it"),
        ({"since": {"released": [1]}}, "since: part voussoir-1 is not "),
        ({"since": {"lifted": [1]}}, "since.lifted is not known; known are held, props, released"),
        ({"since": {"props": [0]}, "step": None}, "since: these steps follow a step of the plan; give step too"),
        ({"since": {"props": [0]}, "plan": None, "step": None}, "since: these steps follow a step of a plan"),
        ({"step": 99}, "step 99 does not exist; the plan has the steps 1 to "),
        ({"step": None}, "name the last one that is done"),
        ({"state": "empty"}, "state: a plan with its step says what the state is"),
        ({"missing": ["nobody"]}, "missing is part 'nobody', which does not exist"),
        ({"missing": "FIRST"}, "is said to be missing, yet step 1 has placed it"),
        ({"identity": "0" * 64}, "the plan is for another structure"),
        ({"plan": {"format": "falsework.plan/4"}}, "plan: "),
        ({"plan": None}, "step 2 is of no plan"),
        ({"plan": None, "step": None, "state": {"standing": [0], "held": [0]}}, "both stands by itself and is held"),
        ({"plan": None, "step": None, "state": {"lying": [0]}}, "state.lying is not known; known are held, standing"),
        ({"missing": [2.5]}, "missing[0] is 2.5; give a whole number or a text"),
    ],
)
def test_a_wrong_step_gets_one_line(change: dict[str, Any], message: str, live: Any) -> None:
    values = live.post("/replan", {"state": "empty", "direction": "assembly"}).json()["plans"][0]
    if "identity" in change:
        values["structure"]["identity"] = change.pop("identity")
    if change.get("missing") == "FIRST":
        change = {"missing": [plan_from_dict(values).steps[0].name]}
    question = {"plan": values, "step": 2, **change}
    reply = live.post("/replan", {key: value for key, value in question.items() if value is not None})
    assert reply.status_code == 422
    error = reply.json()["error"]
    assert message in error, error
    assert "\n" not in error

"""Loads of robots in a plan: computed with it, saved, and verified by evaluation."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from falsework import Assembly, Plan, StabilityOracle, StabilitySettings, Task, find_plans, load_structure
from falsework.assembly import HELD
from falsework.errors import PlanError
from falsework.geometry import TriangleMesh
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.search.plans.proofs import prove_build
from falsework.search.problem.result import Route
from falsework.stability import HoldSettings
from falsework.stability.contact.hold_loads import largest_load
from falsework.stability.holds import HoldMode
from falsework.stability.settings import EQUILIBRIUM

SPEC = "arch:blocks=5"
FACES = [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4)]
FACES += [(2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure(SPEC)


@pytest.fixture(scope="module")
def plan(arch: Assembly) -> Plan:
    """Plan with a reserve, its certificates and its loads."""
    return find_plans(arch).plans[0]


def limited(**limits: float) -> StabilitySettings:
    return StabilitySettings(holds=HoldSettings(**limits))  # type: ignore[arg-type]


def test_a_robot_bears_its_part_and_what_rests_on_it() -> None:
    """A block held in mid-air, and another that is placed on it off its centre and let go."""
    names, shifts = ("lower", "upper", "ground"), (0.0, 0.25, 50.0)
    corners = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    boxes = [
        TriangleMesh.from_arrays(name, corners + [shift, 0, number % 2], FACES)
        for number, (name, shift) in enumerate(zip(names, shifts, strict=True))
    ]
    assembly = Assembly.from_meshes(boxes, boundary=[2])
    weight = 9.81 * assembly.mass.mass[0]
    states = np.array([[2, 1, 2], [2, 2, 2], [2, 0, 2]], np.uint8)
    task = Task.from_rules(assembly.boundary, 2, start=states[0], target=states[-1], fixed=[0])
    replayer = StabilityOracle(assembly).replayer
    assert replayer is not None
    found = prove_build(Route.from_states(states), assembly, task, replayer, None, forces=True)
    (alone,), (lower, upper), (both,) = found.loads
    assert (both.part, lower.part, upper.part, alone.part) == (0, 0, 1, 0)
    np.testing.assert_allclose([both.force, both.moment], [2 * weight, 0.25 * weight], rtol=1e-3)
    np.testing.assert_allclose([lower.force, upper.force, alone.force], weight, rtol=1e-9)
    np.testing.assert_allclose([lower.moment, upper.moment, alone.moment], 0, atol=1e-6 * weight)


def test_a_plan_says_what_robots_bear_in_every_state(arch: Assembly, plan: Plan) -> None:
    held = [np.flatnonzero((state == HELD) & ~arch.immovable).tolist() for state in plan.states]
    assert [[load.part for load in loads] for loads in plan.loads] == held
    report = validate_plan(plan, arch)
    assert report.good
    assert [[load.part for load in loads] for loads in report.loads] == held
    np.testing.assert_allclose(largest_load(report.loads), largest_load(plan.loads), rtol=1e-9)
    again = plan_from_dict(json.loads(json.dumps(plan_to_dict(plan, proofs=True))))
    np.testing.assert_allclose(largest_load(again.loads), largest_load(plan.loads), rtol=1e-5)
    assert validate_plan(again, arch).good


def test_loads_hold_with_and_without_reserve(arch: Assembly, plan: Plan) -> None:
    """They are no less than what each of both friction values gives."""
    assert plan.claim.reserve > 1
    for reserve in (1.0, plan.claim.reserve):
        other = replace(plan, claim=replace(plan.claim, reserve=reserve), displacement=None, loads=())
        found = validate_plan(other, arch).loads
        for said, true in zip(plan.loads, found, strict=True):
            for one, two in zip(said, true, strict=True):
                assert one.force >= 0.999 * two.force
                assert one.moment >= 0.999 * two.moment - 1e-6 * one.force


@pytest.mark.parametrize("solved", [False, True])
@pytest.mark.parametrize("kind", ["force", "moment"])
def test_limits_are_checked_by_evaluation(arch: Assembly, plan: Plan, kind: str, solved: bool) -> None:
    """Whatever limit the plan claims: by its certificates, and by building it anew."""
    plan = replace(plan, displacement=None) if solved else plan
    largest = largest_load(plan.loads)[("force", "moment").index(kind)]
    without = [0.0, np.inf] if kind == "force" else [np.inf]
    for claimed in (getattr(plan.claim.holds, kind), *without):
        holds = replace(plan.claim.holds, **{kind: claimed})  # type: ignore[arg-type]
        free = replace(plan, claim=replace(plan.claim, holds=holds))
        assert validate_plan(free, arch, limited(**{kind: 1.01 * largest})).good
        reason = validate_plan(free, arch, limited(**{kind: 0.98 * largest})).reason
        assert re.search(r"the robot that holds [a-z]+-\d+ bears .* k?N and .* k?Nm, more than it can", reason)


@pytest.mark.parametrize("kind", ["force", "moment"])
def test_a_plan_that_says_too_little_of_a_load_is_refused(arch: Assembly, plan: Plan, kind: str) -> None:
    row, load = max(
        ((row, load) for row, some in enumerate(plan.loads) for load in some), key=lambda pair: getattr(pair[1], kind)
    )

    def changed(other: Any) -> str:
        loads = [list(some) for some in plan.loads]
        loads[row] = [new for old in loads[row] for new in ([old] if old != load else other)]
        return validate_plan(replace(plan, loads=tuple(map(tuple, loads))), arch).reason

    assert changed([load]) == ""
    assert changed([structs.replace(load, **{kind: 1.1 * getattr(load, kind)})]) == ""
    name = arch.names[load.part]
    assert f"that holds {name} bears" in changed([structs.replace(load, **{kind: 0.95 * getattr(load, kind)})])
    assert f"does not say what the robot bears that holds {name}" in changed([])
    stray = next(part for part in range(arch.part_count) if plan.states[row, part] != HELD)
    assert f"bears for {arch.names[stray]}" in changed([load, structs.replace(load, part=stray)])
    assert validate_plan(replace(plan, loads=()), arch).good  # as in older files


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"part": 99, "force": 1.0, "moment": 0.0}, ".bears[0].part is 99; it must be a part from 0 to"),
        (
            {"part": 1, "force": -1.0, "moment": 0.0},
            ".bears[0].force is -1.0; give a number >= 0 (size of the force, N)",
        ),
        ({"part": 1, "force": 1.0}, ".bears[0].moment is missing"),
        ({"part": 1.5, "force": 1.0, "moment": 0.0}, ".bears[0].part is 1.5; give a whole number"),
        ("much", ".bears[0] is 'much'; give an object"),
    ],
)
@pytest.mark.parametrize("place", ["start", "step"])
def test_damaged_loads_are_refused(plan: Plan, entry: Any, words: str, place: str) -> None:
    data = json.loads(json.dumps(plan_to_dict(plan)))
    (data["start"] if place == "start" else data["steps"][0])["bears"] = [entry]
    with pytest.raises(PlanError) as caught:
        plan_from_dict(data)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_under_equilibrium_nothing_is_known_of_loads(arch: Assembly) -> None:
    plan = find_plans(arch, stability=EQUILIBRIUM).plans[0]
    assert plan.loads == ()
    data = json.loads(json.dumps(plan_to_dict(plan)))
    data["steps"][0]["bears"] = [{"part": 1, "force": 1.0, "moment": 0.0}]
    with pytest.raises(PlanError, match="under the criterion equilibrium"):
        plan_from_dict(data)


@pytest.mark.parametrize(("press", "mode"), [(True, HoldMode.FORCE), (False, HoldMode.LOCKED)])
def test_plans_of_version_3_are_read(arch: Assembly, plan: Plan, press: bool, mode: HoldMode) -> None:
    data = json.loads(json.dumps(plan_to_dict(plan, proofs=True))) | {
        "format": "falsework.plan/3",
        "direction": "assembly",
    }
    holds = data["stability"]["holds"]
    assert holds.pop("mode") == HoldSettings().mode
    holds["press"] = press
    for record in (data["start"], *data["steps"]):
        record.pop("bears", None)
    old = plan_from_dict(data)
    assert (old.claim.holds.mode, old.loads) == (mode, ())
    assert validate_plan(old, arch).good
    holds["press"] = "yes"
    with pytest.raises(PlanError, match="holds"):
        plan_from_dict(data)


@pytest.mark.parametrize("mode", ["stiff", None, 1])
def test_other_modes_are_refused(plan: Plan, mode: Any) -> None:
    data = json.loads(json.dumps(plan_to_dict(plan)))
    data["stability"]["holds"]["mode"] = mode
    with pytest.raises(PlanError, match="mode"):
        plan_from_dict(data)

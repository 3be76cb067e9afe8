"""Plans with holding again of real structures: files, checks, and the rules that they are refused for."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from falsework import (
    Action,
    Assembly,
    Direction,
    Outcome,
    Plan,
    PlannerSettings,
    StabilityOracle,
    find_plans,
    load_structure,
    make_task,
    min_robots,
)
from falsework import sheet as make_sheet
from falsework.assembly import prop_places, with_props
from falsework.assembly.props import keep_props
from falsework.errors import AssemblyError, InputError, PlanError
from falsework.interop.tracks import tracks_of
from falsework.search.beam.state_search import StateSearch
from falsework.search.margins.demands import Demands, MarginOracle
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan, plan_from_dict, plan_to_dict, save_plan
from falsework.search.plans.plan_model import plan_schema
from falsework.search.plans.plan_source import structure_of_plan
from falsework.search.plans.proofs import prove_route
from falsework.search.problem.result import Route


@pytest.fixture(scope="module")
def regrasped(small_arch: Assembly, arch_oracle: StabilityOracle) -> Plan:
    """Plan of the arch with two robots in which in the end a hold is handed over and taken back."""
    plan = find_plans(small_arch, robots=2, oracle=arch_oracle, forces=False).plans[0]
    first, second = np.flatnonzero(~small_arch.boundary)[[0, 3]]
    states = [plan.route.states[0]]
    for part, value in ((first, 2), (second, 2), (first, 1), (first, 2), (second, 1), (first, 1)):
        states.append(states[-1].copy())
        states[-1][part] = value
    route = Route.from_states(np.concatenate([states, plan.route.states[1:]]))
    return prove_route(route, small_arch, make_task(small_arch, 2, allow_regrasp=True), arch_oracle)


def test_a_hold_handed_over(regrasped: Plan, small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """Each state in between is proven, the replay knows what is held again, and the checkers accept all of it."""
    words = [step.action.value for step in regrasped[-6:]]
    assert words == ["hold", "hold", "release", "hold", "release", "release"]
    back = [step.action.value for step in regrasped.in_order(Direction.DISASSEMBLY)[:6]]
    assert back == ["hold", "hold", "release", "hold", "release", "release"]
    assert regrasped.replay is not None
    assert regrasped.replay.stands
    assert validate_plan(regrasped, small_arch, arch_oracle.settings).good


def test_files(regrasped: Plan, tmp_path: Path) -> None:
    plan = regrasped
    save_plan(plan, tmp_path / "plan.json")
    read = load_plan(tmp_path / "plan.json")
    assert read.allow_regrasp
    assert np.array_equal(read.states, plan.states)
    assert np.array_equal(read.actions, plan.actions)
    data = plan_to_dict(plan)
    del data["rules"]["support"]
    with pytest.raises(PlanError, match="does 'hold' with part"):
        plan_from_dict(data)
    data["rules"]["support"] = 1
    with pytest.raises(PlanError, match=r"rules\.support is 1; give true or false"):
        plan_from_dict(data)


def test_the_check_refuses_more_holds_than_robots(regrasped: Plan, small_arch: Assembly) -> None:
    report = validate_plan(replace(regrasped, robots=1), small_arch)
    assert not report.good
    assert "every robot is holding" in report.reason
    once = validate_plan(replace(regrasped, allow_regrasp=False), small_arch)
    assert not once.good
    assert "against the rules" in once.reason


def test_from_and_to_states_with_holds(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """A part that is held at the start may be let go; without holding again that is refused."""
    first, second = np.flatnonzero(~small_arch.boundary)[[0, 3]]
    start = np.where(small_arch.boundary, 2, 1).astype(np.uint8)
    target = start.copy()
    start[first] = target[second] = 2
    found = find_plans(small_arch, robots=1, oracle=arch_oracle, start=start, target=target, allow_regrasp=True)
    assert [step.action.value for step in found.plans[0]] == ["release", "hold"]
    with pytest.raises(InputError, match="held part is never released"):
        make_task(small_arch, 1, start=start, target=target)


def test_no_plan_is_proven(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """With one robot the arch falls at the first stone; the search with holding again says so, for two states too."""
    equilibrium = StabilityOracle(small_arch, replace(arch_oracle.settings, criterion="equilibrium", cone=None))
    result = StateSearch(make_task(small_arch, 1, allow_regrasp=True), equilibrium).run()
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.reached == 0
    answer = min_robots(small_arch, oracle=arch_oracle, allow_regrasp=True)
    assert (answer.value, answer.bound, answer.proven) == (2, 2, True)


def test_a_limit_on_states(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    result = StateSearch(make_task(small_arch, 2, allow_regrasp=True), arch_oracle, state_limit=5).run()
    assert result.outcome is Outcome.NOT_FOUND
    assert "gave up after 5 states" in result.limit
    with pytest.raises(InputError, match="a limit of 0 states"):
        StateSearch(make_task(small_arch, 2, allow_regrasp=True), arch_oracle, state_limit=0)


def test_what_does_not_go_together(small_arch: Assembly, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no missing parts"):
        find_plans(small_arch, allow_regrasp=True, missing=[2])
    with pytest.raises(InputError, match="no alternatives"):
        find_plans(small_arch, allow_regrasp=True, settings=PlannerSettings(alternatives=2))
    with pytest.raises(InputError, match="cannot be saved"):
        find_plans(small_arch, allow_regrasp=True, checkpoint=tmp_path / "search")


def test_stops_and_runs_on(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """A deadline that has passed leaves no plan, and says so."""
    planning = find_plans(small_arch, robots=2, oracle=arch_oracle, allow_regrasp=True, stop=lambda: True)
    assert not planning.found
    assert planning.result.interrupted


@pytest.fixture(scope="module")
def propped_arch() -> Assembly:
    arch = load_structure("arch:blocks=7").with_ground()
    return with_props(arch, prop_places(arch))


@pytest.fixture(scope="module")
def propped(propped_arch: Assembly) -> Plan:
    """Plan of an arch with a single robot and three props."""
    return find_plans(propped_arch, robots=1, allow_regrasp=True, props=3).plans[0]


def test_props_replace_a_robot(propped: Plan, propped_arch: Assembly) -> None:
    """No more than three stand at a time, and all are taken away in the end."""
    stand = propped.states[:, -len(propped.props) :] == 2
    assert 0 < stand.sum(axis=1).max() <= 3
    assert not stand[[0, -1]].any()
    assert propped.replay is not None
    assert propped.replay.stands
    arch = keep_props(propped_arch, [])
    structure = structure_of_plan(propped, structure=arch)
    assert structure.identity == propped.identity
    assert validate_plan(propped, structure).good


def test_a_plan_has_only_the_props_that_it_uses(propped_arch: Assembly) -> None:
    """Of a route that uses none, it is a plan of the arch without places for any."""
    arch = keep_props(propped_arch, [])
    plain = find_plans(arch, robots=2, forces=False).plans[0]
    away = np.zeros((len(plain.states), len(propped_arch.props)), dtype=np.uint8)
    route = Route.from_states(np.concatenate([plain.route.states, away], axis=1))
    task = make_task(propped_arch, 2, allow_regrasp=True, props=1)
    plan = prove_route(route, propped_arch, task, StabilityOracle(propped_arch))
    assert plan.props == ()
    assert not plan.allow_regrasp
    assert plan.identity == arch.identity
    assert np.array_equal(plan.states, plain.states)


def test_a_plan_without_some_props_keeps_what_was_found_of_it(propped_arch: Assembly) -> None:
    """Here of a route that uses none: that it stands under changed settings, and the margins that it was to keep."""
    demands = Demands(friction=1.05)
    arch = keep_props(propped_arch, [])
    plain = find_plans(arch, robots=2, forces=False).plans[0]
    assert plain.replay is not None
    assert plain.replay.varied
    away = np.zeros((len(plain.states), len(propped_arch.props)), dtype=np.uint8)
    route = Route.from_states(np.concatenate([plain.route.states, away], axis=1))
    task = make_task(propped_arch, 2, allow_regrasp=True, props=1)
    oracle = MarginOracle(propped_arch, demands=demands)
    plan = prove_route(route, propped_arch, task, oracle, replay=plain.replay)
    assert plan.replay is not None
    assert plan.replay.varied
    assert plan.margins is not None
    assert plan.margins.demands == demands


def test_files_of_props(propped: Plan, tmp_path: Path) -> None:
    save_plan(propped, tmp_path / "plan.json", proofs=True)
    read = load_plan(tmp_path / "plan.json")
    assert read.props == propped.props
    assert read.prop_limit == 3
    assert np.array_equal(read.states, propped.states)
    assert {step.action for step in read if step.robot is None} == {Action.INSERT, Action.REMOVE}  # of props
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator(plan_schema()).validate(plan_to_dict(propped))


def test_damaged_files_of_props(propped: Plan) -> None:
    def damaged(change: Callable[[dict[str, Any]], None]) -> str:
        data = json.loads(json.dumps(plan_to_dict(propped)))
        change(data)
        with pytest.raises(PlanError) as error:
            plan_from_dict(data)
        assert "\n" not in str(error.value)
        return str(error.value)

    entry = len(propped.boundary) - 1
    assert "structure.props is 3; give a list" in damaged(lambda data: data["structure"].update(props=3))
    assert "structure.props[0].at is [0, 0]; give a list of length 3" in damaged(
        lambda data: data["structure"]["props"][0].update(at=[0, 0])
    )
    assert "structure.props[0].part is" in damaged(lambda data: data["structure"]["props"][0].update(part=entry))
    assert "rules.props" in damaged(lambda data: data["rules"].update(props=-1))
    assert "neither there nor away" in damaged(lambda data: data["start"]["state"].__setitem__(entry, 1))
    first = damaged(lambda data: data["steps"][0].update(do="hold", part=entry))
    assert "a prop is inserted or removed" in first
    # Without repeated holds no part is held again; props come and go all the same.

    def without_holds(data: dict[str, Any]) -> None:
        del data["rules"]["support"]
        data["steps"][1]["do"] = "hold"

    held = damaged(without_holds)
    assert "a plan inserts parts and releases them" in held


def test_the_check_counts_props(propped: Plan, propped_arch: Assembly) -> None:
    structure = structure_of_plan(propped, structure=keep_props(propped_arch, []))
    report = validate_plan(replace(propped, prop_limit=1), structure)
    assert not report.good
    assert "1 props may stand at a time" in report.reason
    far = structs.replace(propped.props[0], at=(50.0, 0.0, 0.0))
    with pytest.raises(AssemblyError, match="is not below it"):
        structure_of_plan(replace(propped, props=(far,)), structure=keep_props(propped_arch, []))


def test_no_plan_with_props_is_no_proof(propped_arch: Assembly) -> None:
    """They may help at other places than those that were tried."""
    planning = find_plans(propped_arch, robots=1, allow_regrasp=True, props=1)
    assert planning.result.outcome is Outcome.NOT_FOUND
    assert "one under a part" in planning.result.limit


def test_props_that_cannot_be(small_arch: Assembly, propped_arch: Assembly) -> None:
    for structure, support in ((small_arch, True), (propped_arch, False)):
        with pytest.raises(InputError, match="props is 1, which cannot be placed"):
            find_plans(structure, allow_regrasp=support, props=1)
    with pytest.raises(InputError, match="props is -1, which cannot be placed"):
        make_task(propped_arch, allow_regrasp=True, props=-1)


def test_what_takes_no_plans_with_holding_again(regrasped: Plan, small_arch: Assembly) -> None:
    with pytest.raises(PlanError, match="held again"):
        make_sheet(small_arch, regrasped)
    tracks = tracks_of(regrasped, small_arch)
    assert sum(len(track.path) for track in tracks.tracks) == 2 * 7

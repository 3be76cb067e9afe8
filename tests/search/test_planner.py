"""The planner and `find_plans`: the right plan, found again after an interruption, and honest where there is none."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import (
    Assembly,
    Direction,
    Outcome,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    Task,
    find_plans,
    load_structure,
    make_task,
)
from falsework.errors import InputError
from falsework.search import BeamSearch, BeamSettings, Demands, SearchProgress, SupportGuide
from falsework.search.margins.demands import MarginOracle
from falsework.search.planner import Planner
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.oracle import CountingOracle
from falsework.search.strategies import EDGES, REGRASP, Portfolio, Turn


def insertions(route: tuple[tuple[int, ...], ...], parts: tuple[int, ...]) -> tuple[int, ...]:
    """Steps of assembly before each of `parts` goes in, ascending."""
    assembly = route[::-1]
    return tuple(sorted(next(k for k, state in enumerate(assembly) if state[part]) - 1 for part in parts))


@pytest.mark.parametrize("seed", range(25))
def test_missing_parts_come_as_late_as_they_can(rules: Any, seed: int) -> None:
    """On small structures the bisection finds the lexicographic maximum over all plans."""
    oracle, _ = rules.random(seed, 6)
    missing = (2, 4)
    task = Task.from_rules(rules.ground(6), 1 + seed % 2, missing=missing)
    routes = rules.enumeration(Task.from_rules(rules.ground(6), 1 + seed % 2), oracle).routes()
    planner = Planner(task, oracle)
    result = planner.run()
    if not routes:
        assert result.outcome is Outcome.PROVED_IMPOSSIBLE
        return
    best = max(insertions(route, missing) for route in routes)
    assert result.found
    found = tuple(map(tuple, result.routes[0].states.tolist()))
    assert found in set(routes)
    assert insertions(found, missing) == result.routes[0].insertion_steps(task) == planner.postponed == best


def test_a_missing_part_of_a_tower_is_needed_in_its_place(rules: Any) -> None:
    """The fourth floor can wait until three floors stand, and no longer."""
    task = Task.from_rules(rules.ground(9), 1, missing=[4])
    planner = Planner(task, rules.tower(9))
    assert planner.run().found
    assert planner.postponed == (2 * 3,)


def test_a_structure_that_is_all_boundary_has_a_plan_without_steps() -> None:
    arch = load_structure("arch:blocks=3")
    slab = Assembly.from_meshes(arch.meshes[:1], boundary=[0])
    (plan,) = find_plans(slab, robots=1).plans
    assert len(plan.actions) == 0
    assert validate_plan(plan, slab).good


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("alternatives", [1, 3])
def test_resuming_changes_nothing(rules: Any, tmp_path: Path, seed: int, alternatives: int) -> None:
    oracle, _ = rules.random(seed, 8)
    task = Task.from_rules(rules.ground(8), 2, missing=[3, 5])
    settings = PlannerSettings(alternatives=alternatives, seed=seed)
    whole = Planner(task, oracle, settings)
    expected = whole.run()
    planner = Planner(task, oracle, settings)
    path = tmp_path / "planner.npz"
    while True:
        calls = iter(range(7 + seed))  # interrupted after other levels with each seed
        result = planner.run(stop=lambda calls=calls: next(calls, None) is None)
        if not result.interrupted:
            break
        planner.save(path)
        planner = Planner.load(path, task, oracle, settings)
    assert result.outcome is expected.outcome
    assert result.counters == expected.counters
    assert len(result.routes) == len(expected.routes)
    for mine, theirs in zip(result.routes, expected.routes, strict=True):
        assert np.array_equal(mine.states, theirs.states)
    assert np.array_equal(planner.states, whole.states)


@pytest.mark.parametrize("seed", range(6))
def test_resuming_strategies_that_take_turns_changes_nothing(rules: Any, tmp_path: Path, seed: int) -> None:
    settings = PlannerSettings(patience=0.01)
    oracle, _ = rules.random(seed, 8)
    row = np.stack([np.arange(7), np.arange(1, 8)], axis=1)
    task = Task.from_rules(rules.ground(8), 2, contacts=row)
    expected = Planner(task, oracle, settings).run()
    planner, path = Planner(task, oracle, settings), tmp_path / "planner.npz"
    while True:
        calls = iter(range(3))
        result = planner.run(stop=lambda calls=calls: next(calls, None) is None)
        if not result.interrupted:
            break
        planner.save(path)
        planner = Planner.load(path, task, oracle, settings)
    assert result.outcome is expected.outcome
    assert result.found == (rules.enumeration(task, oracle).count() > 0)
    assert result.counters == expected.counters


def test_turns_end_where_a_search_gets_no_farther_for_twice_as_many_verdicts_in_each_round(rules: Any) -> None:
    def portfolio(
        stage: str = "plan", parts: int = 100, *, edges: bool = False, allow_regrasp: bool = False, **how: Any
    ):
        task = Task.from_rules(np.arange(parts) == 0, 2, allow_regrasp=allow_regrasp)
        return Portfolio.from_settings(PlannerSettings(**how), stage, task, edges=edges)

    both = portfolio()
    assert both.names == (Direction.ASSEMBLY, Direction.DISASSEMBLY)
    for number in range(4):
        most = 200 * 2**number
        assert [both.is_over(number, Turn(owed=owed)) for owed in (most - 1, most)] == [False, True]
        assert not portfolio(parts=200).is_over(number, Turn(owed=most))
    assert [both.is_over(0, Turn(), work, 100) for work in (200, 201)] == [False, True]
    assert portfolio(edges=True).names == (EDGES, *both.names)
    backwards = {"directions": (Direction.DISASSEMBLY,)}
    assert portfolio(edges=True, **backwards) == portfolio(**backwards)
    others = portfolio("alternatives", edges=True)
    assert others.names == (Direction.DISASSEMBLY, Direction.ASSEMBLY)
    assert not others.is_over(0, Turn(owed=1e9))
    assert not others.is_over(0, Turn(), 201, 100)
    search = BeamSearch(Task.from_rules(rules.ground(4), 2), rules.blocks(4), BeamSettings.from_width())
    turn = Turn(asked=-10)
    turn.note(search, 1)
    assert (turn.asked, turn.level, turn.owed) == (0, 0, 10.0)
    search.step()
    turn.note(search, 1)  # a new level makes up for some of them
    assert 0 < turn.owed - search.asked < 10
    assert turn.level == 1
    assert portfolio("postpone", width=2).widest == 2
    first = both.assembly_first()
    assert (first.names, first.later) == ((Direction.ASSEMBLY,), (Direction.DISASSEMBLY,))
    assert portfolio(**backwards).assembly_first() == portfolio(**backwards)
    again = tuple(REGRASP + name for name in both.names)
    assert portfolio(allow_regrasp=True).names == (*again, both.names[0])


def test_work_tells_dear_verdicts_from_cheap_ones_and_is_always_the_same(small_arch: Assembly) -> None:
    task = make_task(small_arch, 2)
    whole, few = task.start[None], task.target[None].copy()
    few[0, np.flatnonzero(~small_arch.boundary)[0]] = 1

    def work(states: Any, *, replayed: bool = False) -> int:
        judge = CountingOracle(StabilityOracle(small_arch, StabilitySettings(criterion="equilibrium")))
        judge.replayed = replayed
        judge.stable(states, states)
        return judge.work

    assert work(few) == work(few) < work(whole) == work(whole)
    assert work(whole, replayed=True) == 0


def test_a_checkpoint_of_another_search_is_refused(rules: Any, tmp_path: Path) -> None:
    task = Task.from_rules(rules.ground(8), 2)
    planner = Planner(task, rules.blocks(8))
    calls = iter(range(3))
    planner.run(stop=lambda: next(calls, None) is None)
    path = tmp_path / "planner.npz"
    planner.save(path)
    with pytest.raises(InputError, match="another structure, task or settings"):
        Planner.load(path, Task.from_rules(rules.ground(8), 1), rules.blocks(8))
    with pytest.raises(InputError, match="another structure, task or settings"):
        Planner.load(path, task, rules.blocks(8), PlannerSettings(seed=1))
    data = path.read_bytes()
    for keep in (0, 10, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:keep])
        with pytest.raises(InputError, match="damaged or not"):
            Planner.load(path, task, rules.blocks(8))
    with pytest.raises(InputError, match="there is no file"):
        Planner.load(tmp_path / "none.npz", task, rules.blocks(8))
    assert [entry.name for entry in tmp_path.iterdir()] == ["planner.npz"]


def test_interrupted_after_the_plan_keeps_the_plan(rules: Any) -> None:
    task = Task.from_rules(rules.ground(7), 2)
    planner = Planner(task, rules.blocks(7), PlannerSettings(alternatives=4))
    result = planner.run(stop=lambda: bool(planner.routes))
    assert result.found
    assert result.interrupted
    assert "gathering alternatives" in result.notes[0]
    assert len(result.routes) == 1


def test_an_interruption_from_the_keyboard(rules: Any) -> None:
    def press(event: SearchProgress) -> None:
        if event.level == 5:
            raise KeyboardInterrupt

    planner = Planner(Task.from_rules(rules.ground(7), 2), rules.blocks(7))
    result = planner.run(progress=press)
    assert result.interrupted
    assert result.outcome is Outcome.NOT_FOUND
    assert result.reached >= 4
    assert planner.run().found


@pytest.mark.parametrize("end", ["start", "target"])
def test_an_unstable_end_is_a_proof(rules: Any, end: str) -> None:
    """A tower with a gap, held nowhere: no plan begins or ends there."""
    gap = [2, 1, 0, 1, 0]
    ends = {"start": None, "target": None} | {end: gap}
    task = Task.from_rules(rules.ground(5), 2, start=ends["start"], target=ends["target"])
    result = Planner(task, rules.tower(5)).run()
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.notes == (f"the {end} state is unstable",)
    assert result.rejected.tolist() == [gap]


def test_says_how_far_it_came(rules: Any) -> None:
    """The wide arch of rules cannot be closed by one robot: proved at once, from the end that shows it first."""
    result = Planner(Task.from_rules(rules.ground(9), 1), rules.arch(9)).run()
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.reached == 1
    assert result.steps == 16
    assert len(result.rejected) > 0


def test_no_plan_found_is_not_no_plan(rules: Any) -> None:
    """With width one and no choice ahead of a hard place the planner gives up, and says that it did."""
    oracle = rules.blocks(100)
    # Everything needs part 99, which the guide tries last; 64 candidates ahead do not reach it.
    oracle.supports[1:] = [[frozenset({99})] if part != 99 else [frozenset()] for part in range(1, 100)]

    def guide(states: Any, actions: Any, direction: Direction) -> Any:
        return np.tile(-np.arange(100.0), 2)[None].repeat(len(states), axis=0)

    task = Task.from_rules(rules.ground(100), 1)
    settings = PlannerSettings(width=1, directions=(Direction.ASSEMBLY,))
    result = Planner(task, oracle, settings, guide=guide).run()
    assert result.outcome is Outcome.NOT_FOUND
    assert "wider ones may come through" in result.limit
    wider = PlannerSettings(width=64, directions=(Direction.ASSEMBLY,))
    assert Planner(task, oracle, wider, guide=guide).run().found


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 0}, "width is 0"),
        ({"directions": ()}, "no direction"),
        ({"directions": ("up",)}, "there is no direction 'up'; give disassembly or assembly"),
        ({"alternatives": 0}, "alternatives is 0"),
        ({"seed": -1}, "a seed is not negative"),
    ],
)
def test_bad_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PlannerSettings(**settings)


@pytest.mark.parametrize("given", ["assembly", ("assembly",), [Direction.ASSEMBLY]])
def test_directions_may_be_given_by_their_names(given: Any) -> None:
    assert PlannerSettings(directions=given) == PlannerSettings(directions=(Direction.ASSEMBLY,))


def test_plans_of_a_real_arch(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    planning = find_plans(small_arch, oracle=arch_oracle, settings=PlannerSettings(alternatives=3))
    assert planning.found
    assert len(planning.plans) == 3
    assert len({plan.states.tobytes() for plan in planning.plans}) == 3
    for plan, route in zip(planning.plans, planning.alternatives.routes, strict=True):
        assert np.array_equal(plan.route.states, route.states)
        assert validate_plan(plan, small_arch).good
    # A plan and its mirror image differ much; three plans cannot all be opposites.
    assert planning.alternatives.least_distance > 0.4


def test_one_robot_cannot_take_an_arch_apart(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    planning = find_plans(small_arch, make_task(small_arch, robots=1), oracle=arch_oracle)
    assert not planning.found
    assert planning.result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert planning.plans == ()
    verdicts = arch_oracle.verdicts(planning.result.rejected, require_certificate=True)
    assert verdicts.unstable.all()
    assert verdicts.velocity is not None


def test_where_histories_decide_the_direction_that_can_prove_that_there_is_no_plan_is_last() -> None:
    settings, ways = StabilitySettings(criterion="contact"), list[Direction]()
    found = find_plans(
        "arch:blocks=5", robots=1, stability=settings, progress=lambda event: ways.append(event.direction)
    )
    assert found.result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert [way for way, _ in groupby(ways)] == [Direction.ASSEMBLY, Direction.DISASSEMBLY]


def test_half_a_job(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """From the middle of a plan to near its end, and with a part that must stay."""
    plan = find_plans(small_arch, oracle=arch_oracle).plans[0]
    middle = Task.from_rules(
        small_arch.boundary, 2, start=plan.states[10], target=plan.states[4], identity=small_arch.identity
    )
    found = find_plans(small_arch, middle, oracle=arch_oracle)
    assert len(found.plans[0]) == 6
    assert validate_plan(found.plans[0], small_arch).good
    last = int(plan.inserted_parts[0])
    stays = Task.from_rules(small_arch.boundary, 2, fixed=[last], identity=small_arch.identity)
    kept = find_plans(small_arch, stays, oracle=arch_oracle)
    assert last not in kept.plans[0].actions % small_arch.part_count
    assert ((kept.plans[0].states[0] > 0) & ~small_arch.boundary).sum() == 1


def test_a_checkpoint_is_resumed_and_removed(
    small_arch: Assembly, arch_oracle: StabilityOracle, tmp_path: Path
) -> None:
    path = tmp_path / "search.npz"
    calls = iter(range(4))
    halted = find_plans(small_arch, oracle=arch_oracle, checkpoint=path, stop=lambda: next(calls, None) is None)
    assert halted.result.interrupted
    assert not halted.found
    assert path.exists()
    levels: list[int] = []
    found = find_plans(
        small_arch, oracle=arch_oracle, checkpoint=path, progress=lambda event: levels.append(event.level)
    )
    assert found.found
    assert levels[0] == 5
    assert not path.exists()


@pytest.mark.parametrize("changed", [{"reserve": 1.5}, {"tolerance": 1e-3}, {"cone": "octagon"}, {"load": 100.0}])
def test_a_checkpoint_of_other_verdicts_is_refused(small_arch: Assembly, tmp_path: Path, changed: Any) -> None:
    """States that stand under other settings, or without margins that are demanded, are none of this search."""
    path, stop = tmp_path / "search.npz", iter(range(4))
    settings, demands = StabilitySettings(criterion="equilibrium", cone="quadratic"), Demands()
    if "load" in changed:
        other = MarginOracle(small_arch, settings, Demands(**changed))
    else:
        other = MarginOracle(small_arch, replace(settings, **changed), demands)
    oracle = MarginOracle(small_arch, settings, demands)
    halted = find_plans(small_arch, oracle=oracle, checkpoint=path, stop=lambda: next(stop, None) is None)
    assert halted.result.interrupted
    with pytest.raises(InputError, match="belongs to another structure, task or settings; remove it"):
        find_plans(small_arch, oracle=other, checkpoint=path)
    assert find_plans(small_arch, oracle=MarginOracle(small_arch, settings, demands), checkpoint=path).found


def test_same_seed_same_plan(small_arch: Assembly) -> None:
    plans = [find_plans(small_arch, settings=PlannerSettings(seed=seed)).plans[0] for seed in (0, 0)]
    assert np.array_equal(plans[0].states, plans[1].states)


def test_another_guide(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """The mirror image of the support guide's preferences still leads to a plan, but another one."""
    support = SupportGuide(small_arch)
    found = find_plans(
        small_arch, oracle=arch_oracle, guide=lambda states, actions, way: -support(states, actions, way)
    )
    usual = find_plans(small_arch, oracle=arch_oracle)
    assert validate_plan(found.plans[0], small_arch).good
    assert not np.array_equal(found.plans[0].actions, usual.plans[0].actions)


@pytest.mark.parametrize("name", ["bottle", "polycube", "wall", "corbel", "dome", "catenary", "vault"])
def test_built_in_structures_have_plans(name: str) -> None:
    assembly = load_structure(name)
    planning = find_plans(assembly)
    assert planning.found
    assert validate_plan(planning.plans[0], assembly).good


def test_a_rule_that_does_not_exist_is_named() -> None:
    with pytest.raises(InputError, match="find_plans: the option robot is not known; did you mean robots"):
        find_plans("arch:blocks=3", robot=2)  # type: ignore[call-arg]
    with pytest.raises(InputError, match="find_plans: the option xyz is not known; known are "):
        find_plans("arch:blocks=3", xyz=2)  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 0}, "width is 0; give at least 1"),
        ({"width": float("nan")}, "width is nan; give a whole number"),
        ({"patience": float("nan")}, "the patience of a search must be above 0"),
        ({"seed": 1.5}, "a seed is a whole number; 1.5 was given"),
        ({"directions": ()}, "no direction to search in"),
        ({"alternatives": 0}, "alternatives is 0; give at least 1"),
        ({"alternatives": 2.5}, "alternatives is 2.5; give a whole number"),
        ({"patience": 0.0}, "the patience of a search must be above 0"),
        ({"bound_after": -1.0}, "the seconds before a bound not below 0"),
    ],
)
def test_settings_that_allow_no_search(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PlannerSettings(**wrong)

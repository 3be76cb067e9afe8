"""The hybrid planner: it finds valid plans, is deterministic for a seed, and explains failures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from falsework import Assembly, Direction, StabilityOracle, Task, load_structure, plan_robots
from falsework.assembly import HELD, complete_state
from falsework.errors import CellError, InputError, StateError
from falsework.robots import Cell, HybridSettings, KeyframeGraph, Obstacle, Placement
from falsework.robots.keyframes.keyframe_graph import KeyframeSettings
from falsework.robots.keyframes.keyframes import Edge, Node
from falsework.robots.model.shapes import block
from falsework.robots.planning.boundary_motions import BoundaryMotions
from falsework.robots.planning.hybrid_result import HybridResult
from falsework.robots.planning.hybrid_search import HybridSearch
from falsework.robots.planning.initial_keyframe import task_in_cell
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.search import BeamSearch, SupportGuide
from falsework.search.plans.plan_check import validate_plan
from falsework.search.problem.deadline import Deadline
from tests.robots.plans.orders import APART


def test_a_plan_is_found_and_its_states_are_proven(result: HybridResult, column: Assembly) -> None:
    assert result.found
    plan = result.value
    assert plan is not None
    assert len(plan) == 2 * int((~column.boundary).sum())
    assert validate_plan(plan.plan, column).good
    assert plan.plan.removable_only_if_clear
    for row, action in enumerate(plan.actions):
        if action >= column.part_count:
            assert column.clearance.can_leave(plan.states[row][None])[0, action - column.part_count]
    assert result.statistics["dead_ends"] >= 0


def test_the_same_seed_gives_the_same_plan(result: HybridResult, column: Assembly, cell: Cell) -> None:
    again = plan_robots(column, cell, settings=APART)
    assert again.value is not None
    assert result.value is not None
    np.testing.assert_array_equal(again.value.actions, result.value.actions)
    for one, other in zip(again.value.moves(), result.value.moves(), strict=True):
        np.testing.assert_array_equal(one[2].positions, other[2].positions)
        np.testing.assert_array_equal(one[2].times, other[2].times)


def test_from_midway_with_robots_where_they_stand(
    result: HybridResult, column: Assembly, cell: Cell, oracle: StabilityOracle
) -> None:
    """From every keyframe of a plan the rest of the way is found, and ends as the plan does."""
    plan = result.value
    assert plan is not None
    for index in range(1, len(plan), 2):
        frame = plan.keyframes[index]
        task = Task.from_rules(column.boundary, 2, start=plan.states[index], identity=column.identity)
        rest = plan_robots(
            column,
            cell,
            task=task,
            configurations=frame.configurations,
            held=frame.held,
            oracle=oracle,
            settings=APART,
        )
        assert rest.value is not None
        assert len(rest.value) == len(plan) - index
        np.testing.assert_array_equal(rest.value.states[0], plan.states[index])
        np.testing.assert_array_equal(rest.value.states[-1], plan.states[-1])


def test_a_guide_decides_the_order(column: Assembly, cell: Cell, oracle: StabilityOracle) -> None:
    def prefer_two(states, actions, direction) -> np.ndarray:
        assert direction in (Direction.DISASSEMBLY, Direction.ASSEMBLY)
        scores = np.zeros(actions.shape)
        scores[:, [2, 2 + column.part_count]] = 10.0
        return scores

    found = plan_robots(column, cell, oracle=oracle, guide=prefer_two, settings=APART)
    assert found.value is not None
    assert found.value.plan.inserted_parts[-1] == 2


def test_a_guide_is_asked_about_each_state_once(column: Assembly, cell: Cell, oracle: StabilityOracle) -> None:
    """A rollout of the guide is a plan already; looking for motions along it asks nothing new."""
    asked: list[bytes] = []

    def counting(states, actions, direction) -> np.ndarray:
        asked.extend(state.tobytes() for state in states)
        return np.zeros(actions.shape)

    found = plan_robots(column, cell, oracle=oracle, guide=counting, settings=APART)
    assert found.value is not None
    assert asked == [state.tobytes() for state in found.value.states[:-1]]
    assert found.statistics["dead_ends"] == 0
    again = plan_robots(column, cell, guide=counting, settings=APART)
    assert again.value is not None
    np.testing.assert_array_equal(again.value.actions, found.value.actions)
    assert len(asked) == 2 * len(found.value)


def test_where_rollouts_fail_the_plan_is_searched_for(
    column: Assembly, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("falsework.robots.planning.solvability.follow_scores", lambda *_, **__: [])
    found = plan_robots(column, cell, guide=SupportGuide(column), settings=APART)
    assert found.value is not None
    assert validate_plan(found.value.plan, column).good


def test_a_target_and_missing_parts(column: Assembly, cell: Cell, oracle: StabilityOracle) -> None:
    target = complete_state(column.boundary)
    target[1] = 0
    task = Task.from_rules(column.boundary, 2, target=target)
    found = plan_robots(column, cell, task=task, oracle=oracle, settings=APART)
    assert found.value is not None
    assert found.value.plan.inserted_parts.tolist() == [1]
    late = plan_robots(
        column,
        cell,
        task=Task.from_rules(column.boundary, 2, missing=[2]),
        oracle=oracle,
        settings=APART,
    )
    assert late.value is not None
    assert late.value.plan.inserted_parts[-1] == 2  # taken off first: put in last
    guided = plan_robots(
        column,
        cell,
        task=Task.from_rules(column.boundary, 2, missing=[2]),
        oracle=oracle,
        guide=SupportGuide(column),
        settings=APART,
    )
    assert guided.value is not None
    assert guided.value.plan.inserted_parts[-1] == 2


def test_what_no_gripper_can_carry_is_named_before_the_search(column: Assembly, cell_of: Callable[..., Cell]) -> None:
    """The message has all parts, and what of the gripper and of the part does not agree."""
    strong = cell_of(2)
    wide = [replace(robot, gripper=replace(robot.gripper, cup=0.12)) for robot in strong.robots]
    started: list[object] = []
    for cell, why in (
        (cell_of(2, payload=0.01), "more than the payload of 0.01 kg"),
        (replace(strong, robots=tuple(wide)), "its cup has a radius of 120 mm, the largest face takes one of 100 mm"),
    ):
        with pytest.raises(CellError, match=r"can carry 3 parts: block-0 \(.*\), block-1 \(.*\), block-2") as caught:
            plan_robots(column, cell, settings=APART, progress=started.append)
        assert why in str(caught.value)
    assert not started
    # One arm that can carry them is enough.
    mixed = replace(strong, robots=(strong.robots[0], wide[1]))
    assert plan_robots(column, mixed, settings=APART).found


def test_what_is_out_of_reach_is_named(column: Assembly, cell_of: Callable[..., Cell]) -> None:
    found = plan_robots(column, cell_of(2, 4.0), settings=APART)
    assert not found.found
    why = found.explanation
    assert why is not None
    assert set(why.unreachable) == {0, 1, 2}
    assert why.reached == 0
    assert "no robot can hold block-0, block-1, block-2" in why.text
    assert any(entry["what"] == "out of reach" for entry in why.details)
    assert "\n" not in why.text


def test_what_is_in_the_way_is_named_and_what_was_found_is_kept(
    column: Assembly, cell: Cell, oracle: StabilityOracle
) -> None:
    """A roof close above the lower cubes: what stands on top of them is under it too, so nothing leaves upwards."""
    roof = Obstacle("roof", (block((-0.35, -0.35, 0.5), (0.35, 0.35, 0.52)),))
    walls = tuple(
        Obstacle(f"wall {k}", (block(low, high),))
        for k, (low, high) in enumerate(
            [
                ((-0.37, -0.37, 0.0), (-0.35, 0.37, 0.52)),
                ((0.35, -0.37, 0.0), (0.37, 0.37, 0.52)),
                ((-0.37, -0.37, 0.0), (0.37, -0.35, 0.52)),
                ((-0.37, 0.35, 0.0), (0.37, 0.37, 0.52)),
            ]
        )
    )
    closed = replace(cell, obstacles=(roof, *walls))
    found = plan_robots(column, closed, oracle=oracle, settings=HybridSettings(Direction.DISASSEMBLY, attempts=2))
    assert not found.found
    assert found.partial is None
    assert found.explanation is not None
    assert found.explanation.reached == 0
    pairs = [name for entry in found.explanation.details for name in entry["pair"] or ()]
    assert any(name == "roof" or name.startswith("wall") for name in pairs)


def test_a_partial_plan_is_a_plan(column: Assembly, cell: Cell, oracle: StabilityOracle) -> None:
    """A cage around the lower cubes only: the upper one leaves, and the plan for that is kept and proven."""
    cage = Obstacle(
        "cage", (block((-0.6, -0.35, 0.0), (-0.25, 0.35, 0.25)), block((0.45, -0.35, 0.0), (0.6, 0.35, 0.25)))
    )
    ring = Obstacle("ring", (block((0.06, -0.2, 0.202), (0.4, 0.2, 0.22)),))
    quick = KeyframeSettings(grasps=6, candidates=4, nodes=100)
    settings = HybridSettings(Direction.DISASSEMBLY, attempts=1, dead_ends=2, keyframes=quick)
    found = plan_robots(column, replace(cell, obstacles=(cage, ring)), oracle=oracle, settings=settings)
    assert not found.found
    assert found.explanation is not None
    assert found.partial is not None
    assert len(found.partial) == found.explanation.reached > 0
    assert validate_plan(found.partial.plan, column).good
    assert found.partial.statistics["failure"]["outcome"] == "not_found"
    assert found.explanation.hopeless is not None


def test_a_dead_end_leads_back_to_the_hold_that_causes_it(
    column: Assembly, cell: Cell, oracle: StabilityOracle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first grip of the plan lets its part never go: what other arms do meanwhile is not varied before it."""

    def dead_ends() -> int:
        graph, parts, bad = KeyframeGraph(column, cell), column.part_count, []
        plain = graph.edges

        def edges(node: Node, action: int) -> Iterator[Edge]:
            for edge in plain(node, action):
                robot = edge.robot
                if not bad:
                    bad.append((robot, action + parts, edge.node.configurations[robot].tobytes()))
                if (robot, action, node.configurations[robot].tobytes()) not in bad:
                    yield edge

        monkeypatch.setattr(graph, "edges", edges)
        result = plan_robots(column, cell, graph=graph, oracle=oracle, settings=APART)
        assert result.found
        assert bad
        return result.statistics["dead_ends"]

    found = dead_ends()
    monkeypatch.setattr("falsework.robots.planning.action_ranking.FailedActions.blamed", lambda *_: set())
    assert 0 < found < dead_ends()


@pytest.fixture
def search(column: Assembly, cell: Cell, oracle: StabilityOracle) -> HybridSearch:
    """A search that restarts after dead ends at two states."""
    graph, settings = KeyframeGraph(column, cell), HybridSettings(Direction.DISASSEMBLY, dead_ends=1)
    task = task_in_cell(column, cell, None, graph.exits, oracle)
    return HybridSearch(graph, task, oracle, None, settings, None, BoundaryMotions(graph), Deadline(None))


@pytest.mark.parametrize(("parts", "found"), [((1,), True), ((1, 2), False)])
def test_dead_ends_at_one_state_count_once(
    search: HybridSearch, column: Assembly, parts: tuple[int, ...], found: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten grips of each part lead nowhere; after those of one part the search goes on, after those of two it ends."""
    homes, nobody = search.cell.homes, (None,) * search.cell.robot_count
    root = search.graph.start(complete_state(column.boundary), homes, nobody)

    def options(node: Node, _: np.random.Generator) -> Iterator[Edge]:
        if node is not root:
            return
        for part in parts:
            state = root.state.copy()
            state[part] = HELD
            for grip in range(10):
                yield Edge(part, 0, (), search.graph.start(state, (homes[0] + 0.1 * grip, *homes[1:]), (part, None)))
        yield Edge(0, 0, (), search.graph.start(search.task.target, homes, nobody))

    monkeypatch.setattr(search, "options", options)
    monkeypatch.setattr(search.solvability, "falls", lambda _: None)
    chain = search.depth_first_search(root, np.random.default_rng(0))
    assert (chain is not None) == found
    assert search.counts["dead_ends"] == (10 if found else 11)


@pytest.mark.parametrize("solvable", [True, False])
def test_where_nothing_leads_on_the_steps_back_grow(
    search: HybridSearch, column: Assembly, solvable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    homes, nobody = search.cell.homes, (None,) * search.cell.robot_count
    nodes = [search.graph.start(complete_state(column.boundary), homes, nobody) for _ in range(60)]
    asked: list[int] = []

    def reroute(state: np.ndarray) -> bool:
        asked.append(next(number for number, node in enumerate(nodes) if node.state is state))
        return solvable and asked[-1] <= 40

    monkeypatch.setattr(search.solvability, "stays", lambda _: False)
    monkeypatch.setattr(search.solvability, "reroute", reroute)
    assert search._extendable_keyframes(nodes) == (39 if solvable else 0)
    assert asked == ([59, 58, 54, 38] if solvable else [59, 58, 54, 38, 0])


def test_a_structure_that_locks_itself_is_proven_so(cell: Cell) -> None:
    shelf = load_structure("shelf:shelves=0,width=0.3,depth=0.18,gap=0.1,thickness=0.02")
    found = plan_robots(shelf, replace(cell, placement=Placement(density=300.0)), settings=APART)
    assert not found.found
    assert found.explanation is not None
    assert found.explanation.outcome == "proved_impossible"
    assert "no plan exists" in found.explanation.text


def test_a_deadline_ends_the_search(column: Assembly, cell: Cell) -> None:
    found = plan_robots(column, cell, settings=HybridSettings(Direction.DISASSEMBLY), deadline=1e-6)
    assert not found.found
    assert found.explanation is not None
    assert found.explanation.outcome == "interrupted"
    assert found.explanation.text == (
        "the search for a robot plan was stopped; not even an order of actions without motions was found by then; "
        "the deadline has passed"
    )


@pytest.mark.parametrize("allow_regrasp", [False, True])
def test_ctrl_c_in_a_search_for_states_ends_the_whole_search(
    column: Assembly, cell: Cell, oracle: StabilityOracle, monkeypatch: pytest.MonkeyPatch, allow_regrasp: bool
) -> None:
    """Searches for states end in good order and report the interruption; nothing begins anew after it."""
    asked = 0

    def interrupted(self: BeamSearch) -> None:
        nonlocal asked
        asked += 1
        raise KeyboardInterrupt

    monkeypatch.setattr(BeamSearch, "step", interrupted)
    task = Task.from_rules(column.boundary, 2, identity=column.identity, allow_regrasp=allow_regrasp)
    with pytest.raises(KeyboardInterrupt):
        plan_robots(column, cell, task=task, oracle=oracle, settings=APART)
    assert asked == 1
    check = SolvabilityCheck(column, task, oracle)
    with pytest.raises(KeyboardInterrupt):
        check.perturb(1)


def test_wrong_starts(column: Assembly, cell: Cell, oracle: StabilityOracle) -> None:
    with pytest.raises(InputError, match="has 2 robots"):
        plan_robots(column, cell, configurations=[cell.homes[0]], oracle=oracle, settings=APART)
    with pytest.raises(InputError, match="configuration of arm 1"):
        plan_robots(
            column,
            cell,
            configurations=[np.full(6, 9.0), cell.homes[1]],
            oracle=oracle,
            settings=APART,
        )
    with pytest.raises(StateError, match="the part that each robot holds"):
        plan_robots(column, cell, held=(1, None), oracle=oracle, settings=APART)
    start = complete_state(column.boundary)
    start[1] = HELD
    task = Task.from_rules(column.boundary, 2, start=start)
    with pytest.raises(InputError, match=r"away from part .*, which it should hold"):
        plan_robots(column, cell, task=task, held=(1, None), oracle=oracle, settings=APART)
    down = np.array([0.0, 1.4, 0.3, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"at the start bodies are too near: .* m?m into each other; move arm"):
        plan_robots(column, cell, configurations=[down, cell.homes[1]], oracle=oracle, settings=APART)
    with pytest.raises(InputError, match="leaves no time"):
        plan_robots(column, cell, oracle=oracle, deadline=0.0)
    with pytest.raises(InputError, match="at least one attempt"):
        HybridSettings(Direction.DISASSEMBLY, attempts=0)


def test_solvable_states_are_those_of_the_census(column: Assembly) -> None:
    """What the proposals call solvable is solvable, by exhaustion; in so small a structure they miss nothing."""
    from falsework.search import ExhaustiveSearch

    oracle = StabilityOracle(column)
    task = Task.from_rules(column.boundary, 1, clearance=column.clearance, identity=column.identity)
    graph = ExhaustiveSearch(task, oracle).run().graph
    solvability = SolvabilityCheck(column, task, oracle)
    assert solvability.prepare().found
    index = {state.tobytes(): row for row, state in enumerate(graph.states)}
    for row, state in enumerate(graph.states):
        for action in solvability.legal(state):
            after = task.follow(state[None], np.array([action]), Direction.DISASSEMBLY)[0]
            known = index.get(after.tobytes())
            truly = known is not None and bool(graph.solvable[known])
            if graph.solvable[row]:
                assert solvability.solvable(state, action) == truly

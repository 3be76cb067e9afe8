"""Order of trial: rollouts obey the rules and stay stable, easy actions come before hard ones."""

from __future__ import annotations

import numpy as np
import pytest

from falsework import Assembly, Direction, StabilityOracle, Task, load_structure
from falsework.assembly import complete_state
from falsework.robots import Cell, KeyframeGraph
from falsework.robots.planning.action_ranking import ExecutionHeuristic
from falsework.robots.planning.solvability import SolvabilityCheck
from falsework.search import SupportGuide
from falsework.search.problem.guide import MemoizedGuide

ARCH = load_structure("arch:blocks=5")
TASK = Task.from_rules(ARCH.boundary, 2)


@pytest.fixture(scope="module")
def arch_oracle() -> StabilityOracle:
    return StabilityOracle(ARCH)


def removals(states, actions) -> np.ndarray:
    """Remove wherever it can be done."""
    return np.tile(np.repeat([0.0, 1.0], ARCH.part_count), (len(states), 1))


@pytest.mark.parametrize("rng", [None, np.random.default_rng(0)], ids=["greedy", "sampled"])
def test_a_rollout_is_a_plan(arch_oracle: StabilityOracle, rng: np.random.Generator | None) -> None:
    route = SolvabilityCheck(ARCH, TASK, arch_oracle, score=removals).roll_out(rng)
    assert route is not None
    assert len(route.actions) == TASK.steps
    np.testing.assert_array_equal(route.states[0], TASK.start)
    np.testing.assert_array_equal(route.states[-1], TASK.target)
    assert arch_oracle.verdicts(route.states, require_certificate=True).stable.all()
    for state, action, after in zip(route.states, route.actions, route.states[1:], strict=False):
        assert TASK.moves(state[None], Direction.DISASSEMBLY)[0, action]
        np.testing.assert_array_equal(TASK.follow(state[None], action[None], Direction.DISASSEMBLY)[0], after)


def test_a_rollout_may_fail(arch_oracle: StabilityOracle) -> None:
    """One robot cannot take an arch apart, and a search that has been stopped has no rollout."""
    alone = SolvabilityCheck(ARCH, Task.from_rules(ARCH.boundary, 1), arch_oracle, score=removals)
    for rng in (None, np.random.default_rng(0)):
        assert alone.roll_out(rng) is None
    stopped = SolvabilityCheck(ARCH, TASK, arch_oracle, score=removals)
    stopped.prepare(lambda: True)
    assert stopped.roll_out(None) is None


def test_rows_step_together(arch_oracle: StabilityOracle) -> None:
    """The scores of all rows are asked for in one go at each step."""
    sizes = []

    def counting(states, actions) -> np.ndarray:
        sizes.append(len(states))
        return removals(states, actions)

    solvability = SolvabilityCheck(ARCH, TASK, arch_oracle, score=counting)
    assert solvability.roll_out(np.random.default_rng(0)) is not None
    assert len(sizes) == TASK.steps
    assert sizes[0] == 16


def test_what_blocks_and_what_is_high(column: Assembly, cell: Cell) -> None:
    """A removal is easier than any hold, and the upper cube easier than the lower ones."""
    graph = KeyframeGraph(column, cell)
    state = complete_state(column.boundary)
    plain = ExecutionHeuristic(graph, None)
    assert plain.of(state, 1) > plain.of(state, 2) == plain.of(state, 0)
    state[2] = 2
    allowed = np.zeros((1, 2 * column.part_count), dtype=bool)
    allowed[0, [0, 1, column.part_count + 2]] = True
    scores = plain(state[None], allowed)[0]
    assert scores.argmax() == column.part_count + 2
    assert (scores[~allowed[0]] == 0).all()
    guided = ExecutionHeuristic(graph, lambda states, actions, direction: np.full(actions.shape, 0.5))
    np.testing.assert_allclose(guided(state[None], allowed)[0] - scores, 0.5)


def test_a_guide_with_a_memory_says_the_same() -> None:
    base = SupportGuide(ARCH)
    memory = MemoizedGuide(base, limit=3)
    rng = np.random.default_rng(0)
    states = rng.integers(0, 3, (8, ARCH.part_count)).astype(np.uint8)
    actions = rng.random((8, 2 * ARCH.part_count)) < 0.5
    for direction in Direction:
        np.testing.assert_array_equal(memory(states, actions, direction), base(states, actions, direction))
    assert memory.calls == 2
    np.testing.assert_array_equal(
        memory(states[-2:], actions[-2:], direction), base(states[-2:], actions[-2:], direction)
    )
    assert memory.calls == 2  # the last ones are still there ...
    memory(states[:1], actions[:1], direction)
    assert memory.calls == 3  # ... the first are not
    assert memory(states[:0], actions[:0], direction).shape == (0, 2 * ARCH.part_count)

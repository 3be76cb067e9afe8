"""Exhaustive search against closed forms and against an enumeration by plain recursion."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Outcome, StabilityOracle, Task
from falsework.search import ExhaustiveSearch, Oracle


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_free_blocks_have_all_orders(rules: Any, robots: int) -> None:
    """Blocks that stand alone: one robot has `m!` plans; robots for all have `(2m)! / 2^m`, and `3^m` states."""
    blocks = 3
    census = ExhaustiveSearch(Task.from_rules(rules.ground(blocks + 1), robots), rules.blocks(blocks + 1)).run()
    assert census.complete
    if robots == 1:
        assert census.plans == math.factorial(blocks)
        assert census.states == 2**blocks + blocks * 2 ** (blocks - 1)
    if robots == blocks:
        assert census.plans == math.factorial(2 * blocks) // 2**blocks
        assert census.states == 3**blocks
    assert census.solvable_states == census.states


def test_counts_are_exact_beyond_64_bits(rules: Any) -> None:
    """`18! / 2^9` fits 64 bits, the count for twelve blocks does not."""
    blocks = 12
    census = ExhaustiveSearch(Task.from_rules(rules.ground(blocks + 1), blocks), rules.blocks(blocks + 1)).run()
    assert census.plans == math.factorial(2 * blocks) // 2**blocks > 2**64


@pytest.mark.parametrize("height", [2, 5, 9])
def test_a_tower_has_one_plan_with_one_robot(rules: Any, height: int) -> None:
    """Only the top can be removed, so only the top is worth holding: one order."""
    census = ExhaustiveSearch(Task.from_rules(rules.ground(height + 1), 1), rules.tower(height + 1)).run()
    assert census.plans == 1
    assert census.result.outcome is Outcome.FOUND
    removed = census.result.routes[0].actions[1::2] - (height + 1)
    assert removed.tolist() == list(range(height, 0, -1))


def test_an_arch_of_rules_needs_two_robots(rules: Any) -> None:
    """With one robot the first removal leaves both neighbours without support: proved impossible."""
    task = Task.from_rules(rules.ground(6), 1)
    census = ExhaustiveSearch(task, rules.arch(6)).run()
    assert census.result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert census.plans == 0
    assert census.result.reached == 1
    assert len(census.result.rejected) == 5


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.parametrize("robots", [1, 2])
def test_agrees_with_plain_recursion(rules: Any, seed: int, robots: int) -> None:
    oracle, clearance = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), robots, clearance=clearance if seed % 2 else None)
    expected = rules.enumeration(task, oracle)
    census = ExhaustiveSearch(task, oracle).run()
    assert census.complete
    assert census.plans == expected.count()
    assert {tuple(state) for state in census.graph.states.tolist()} == expected.reachable()
    assert census.result.found == (census.plans > 0)
    assert (census.result.outcome is Outcome.PROVED_IMPOSSIBLE) == (census.plans == 0)


@pytest.mark.parametrize("seed", range(20))
def test_agrees_between_other_ends(rules: Any, seed: int) -> None:
    """From and to states with held and absent parts, and with fixed ones."""
    oracle, _ = rules.random(seed, 7)
    rng = np.random.default_rng(seed)
    while True:
        start, target = rng.integers(0, 3, size=(2, 7)).astype(np.uint8)
        start[0] = target[0] = 2
        fixed = int(rng.integers(1, 7))
        target[fixed] = start[fixed]
        stage = np.array([2, 0, 1])
        held = max((start[1:] == 2).sum(), (target[1:] == 2).sum())
        if (stage[target] >= stage[start]).all() and held <= 2 and oracle.stands(tuple(start)):
            break
    task = Task.from_rules(rules.ground(7), 2, start=start, target=target, fixed=[fixed])
    census = ExhaustiveSearch(task, oracle).run()
    assert census.plans == rules.enumeration(task, oracle).count()


def test_without_repeated_holds_nothing_is_proven_of_plans_with_them(rules: Any) -> None:
    task = Task.from_rules(rules.ground(6), 1, allow_regrasp=True)
    census = ExhaustiveSearch(task, rules.arch(6)).run()
    assert census.complete
    assert census.result.outcome is Outcome.NOT_FOUND
    assert census.result.limit.startswith("each part was held once")


def test_gives_up_honestly(rules: Any) -> None:
    task = Task.from_rules(rules.ground(9), 2)
    census = ExhaustiveSearch(task, rules.blocks(9), state_limit=50).run()
    assert census.result.outcome is Outcome.NOT_FOUND
    assert not census.complete
    assert "gave up after 50 states" in census.result.limit
    assert not census.result.interrupted


def test_no_proof_on_undecided_verdicts(rules: Any) -> None:
    class Unsure(Oracle):
        def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
            stable = (states == states[:, 1:2])[:, 1:].all(axis=1)  # of the two ends alone
            return rules.verdicts(stable, ~stable)

    census = ExhaustiveSearch(Task.from_rules(rules.ground(4), 1), Unsure()).run()
    assert census.result.outcome is Outcome.NOT_FOUND
    assert census.result.undecided == 3
    assert "neither stable nor unstable" in census.result.limit


@pytest.mark.parametrize("sure", [True, False])
@pytest.mark.parametrize(("end", "name"), [("start", "complete structure"), ("target", "target state")])
def test_no_plan_between_ends_that_do_not_stand(rules: Any, end: str, name: str, sure: bool) -> None:
    """Free blocks come apart in any order, but not from or to a state that is not stable itself."""
    task = Task.from_rules(rules.ground(4), 1)

    class OneEnd(Oracle):
        def verdicts(self, states: Any, *, near: Any = None, require_certificate: bool = False) -> Any:
            wrong = (states == getattr(task, end)).all(axis=1)
            return rules.verdicts(~wrong, None if sure else wrong)

    census = ExhaustiveSearch(task, OneEnd()).run()
    assert not census.result.found
    assert census.plans == 0
    assert (census.result.outcome is Outcome.PROVED_IMPOSSIBLE) == sure
    words = "is unstable" if sure else "could be proved neither stable nor unstable"
    assert census.result.notes[0] == f"the {name} {words}"


def test_stopped_it_can_be_run_on(rules: Any) -> None:
    oracle, _ = rules.random(3, 8)
    task = Task.from_rules(rules.ground(8), 2)
    whole = ExhaustiveSearch(task, oracle).run()
    calls = iter(range(100))
    search = ExhaustiveSearch(task, oracle)
    halted = search.run(stop=lambda: next(calls) >= 4)
    assert halted.result.interrupted
    assert not halted.complete
    resumed = search.run()
    assert resumed.plans == whole.plans
    assert resumed.states == whole.states
    assert resumed.result.outcome is whole.result.outcome


def test_a_real_arch_cannot_be_opened_by_one_robot(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """Whichever block one robot takes out, the two halves next to it fall."""
    census = ExhaustiveSearch(Task.from_rules(small_arch.boundary, 1), arch_oracle).run()
    assert census.result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert census.states == 1 + 7  # the complete arch, and one state for each block held


def test_two_robots_open_a_real_arch(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    census = ExhaustiveSearch(Task.from_rules(small_arch.boundary, 2), arch_oracle).run()
    assert census.result.outcome is Outcome.FOUND
    assert census.plans == census.graph.count_routes() > 0
    # The arch is its own mirror image, so plans come in pairs: none is its own mirror image, since steps are single.
    assert census.plans % 2 == 0

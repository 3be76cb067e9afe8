"""Beams whose verdicts and clusters come from a device, and the rules of `Task` on tensors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import Direction, Outcome, StabilityOracle, StateGraph, Task, load_structure
from falsework.errors import InputError
from falsework.geometry.clearance.table import ClearanceTable
from falsework.search import BeamSearch, BeamSettings, TensorRules
from falsework.search.beam.k_means import k_means
from falsework.search.device.beam import beam_search, device_beam
from falsework.search.device.k_means import find_centers
from falsework.search.device.oracle import HostOracle
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.result import Route
from falsework.utils.bits import pack
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import choose_device, mix, put, uniform

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")

CPU = torch.device("cpu")
BOTH = pytest.mark.parametrize("direction", list(Direction))


def beam(task: Task, oracle: Any, **settings: Any) -> BeamSearch:
    return device_beam(task, HostOracle(oracle), BeamSettings(**settings))


def rows_of(states: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(state) for state in states.tolist()}


def check_route(route: Route, task: Task, oracle: Any, rules: Any) -> None:
    """Legal by the rules as the enumeration knows them, stable, and from start to target."""
    states = [tuple(state) for state in route.states.tolist()]
    moves = rules.enumeration(task, oracle).moves
    for before, action, after in zip(states[:-1], route.actions.tolist(), states[1:], strict=True):
        assert (action, after) in list(moves(before))
    assert states[0] == tuple(task.start)
    assert states[-1] == tuple(task.target)


def random_task(rng: np.random.Generator, rules: Any, parts: int) -> Task:
    """A task with any start, target, robots, fixed and missing parts that fit together."""
    while True:
        start = np.where(np.arange(parts) == 0, 2, rng.choice([0, 1, 1, 1, 2], size=parts)).astype(np.uint8)
        target = np.where(np.arange(parts) == 0, 2, rng.choice([0, 0, 0, 1, 2], size=parts)).astype(np.uint8)
        goes = np.flatnonzero((start != 0) & (target == 0))
        missing = rng.choice(goes, size=min(2, len(goes)), replace=False).tolist()
        clearance = rules.random(int(rng.integers(100)), parts)[1] if rng.random() < 0.4 else None
        try:
            task = Task.from_rules(
                rules.ground(parts),
                int(rng.integers(1, 4)),
                start=start,
                target=target,
                missing=missing,
                clearance=clearance,
            )
        except InputError:
            continue
        return task.postpone(sorted(rng.integers(0, max(task.steps, 1), size=len(missing)).tolist()))


@BOTH
def test_rules_on_tensors_are_those_of_the_task(rules: Any, direction: Direction) -> None:
    rng = np.random.default_rng(7)
    states = rules.all_states(6)
    moved = 0
    for _ in range(60):
        task = random_task(rng, rules, 6)
        task = replace(task, holds_keep_stable=len(task.missing) % 2 == 1)
        tensor_rules = TensorRules(task, CPU, direction)
        inside = states[task.contains(states)]
        tensors = put(inside, CPU)
        expected = task.moves(inside, direction)
        assert np.array_equal(tensor_rules.moves(tensors).numpy(), expected)
        assert np.array_equal(tensor_rules.dead_ends(tensors).numpy(), task.dead_ends(inside, direction))
        row, action = np.nonzero(expected)
        moved += len(row)
        after = task.follow(inside[row], action, direction)
        actions = put(action, CPU)
        assert np.array_equal(tensor_rules.follow(tensors[put(row, CPU)], actions).numpy(), after)
        assert np.array_equal(tensor_rules.needs_verdict(actions).numpy(), task.needs_verdict(action, direction))
        hashes = tensor_rules.hashes(tensors)
        state_hash = StateHash.for_parts(6)
        assert np.array_equal(hashes.numpy().view(np.uint64), state_hash(inside))
        children = tensor_rules.hashes_after(tensors, hashes, actions, put(row, CPU))
        assert np.array_equal(children.numpy().view(np.uint64), state_hash(after))
    assert moved > 1000


@BOTH
@pytest.mark.parametrize("parts", [5, 70])
def test_ways_out_on_tensors_are_those_of_the_table(rules: Any, direction: Direction, parts: int) -> None:
    """More parts than bits in a word, parts with no way out at all, and ways that nothing blocks."""
    rng = np.random.default_rng(parts)
    ways = rng.integers(0, 4, size=parts)
    blockers = pack(rng.random((ways.sum(), parts)) < 3 / parts)
    table = ClearanceTable(
        np.zeros((ways.sum(), 3)),
        blockers,
        np.concatenate([[0], np.cumsum(ways)]).astype(np.int32),
        np.ones(parts, bool),
        0,
    )
    task = Task.from_rules(rules.ground(parts), parts, clearance=table)
    states = rng.choice([0, 0, 1, 2], size=(500, parts)).astype(np.uint8)
    states[:, 0] = 2
    tensor_rules = TensorRules(task, CPU, direction)
    moves = tensor_rules.moves(put(states, CPU)).numpy()
    assert np.array_equal(moves, task.moves(states, direction))
    assert not np.array_equal(moves, Task.from_rules(rules.ground(parts), parts).moves(states, direction))
    dead = tensor_rules.dead_ends(put(states, CPU)).numpy()
    assert np.array_equal(dead, task.dead_ends(states, direction))
    assert dead.any() == (direction is Direction.ASSEMBLY)


@BOTH
@pytest.mark.parametrize("seed", range(12))
def test_without_a_limit_it_finds_what_the_other_beam_finds(rules: Any, direction: Direction, seed: int) -> None:
    """Level by level the same states, and the same counters."""
    oracle, clearance = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), 1 + seed % 2, clearance=clearance if seed % 3 == 0 else None)
    one = BeamSearch(task, oracle, BeamSettings(width=10_000, direction=direction))
    two = beam(task, oracle, width=10_000, direction=direction)
    expected, result = one.run(), two.run()
    assert result.outcome is expected.outcome
    assert result.counters == expected.counters
    assert len(two.levels) == len(one.levels)
    for a, b in zip(one.levels, two.levels, strict=True):
        assert rows_of(a.states) == rows_of(b.states)
        assert len(a.states) == len(b.states)
    if result.found:
        check_route(result.routes[0], task, oracle, rules)
    elif result.outcome is Outcome.PROVED_IMPOSSIBLE:
        assert rows_of(result.rejected) == rows_of(expected.rejected)


@BOTH
@pytest.mark.parametrize("diversity", ["k-means", "none"])
@pytest.mark.parametrize("seed", range(6))
def test_what_a_narrow_beam_finds_is_a_plan(rules: Any, direction: Direction, diversity: str, seed: int) -> None:
    oracle, _ = rules.random(seed, 9)
    task = Task.from_rules(rules.ground(9), 2)
    search = beam(task, oracle, width=3, direction=direction, diversity=diversity, seed=seed)
    result = search.run()
    if result.found:
        check_route(result.routes[0], task, oracle, rules)
    else:
        assert result.outcome is Outcome.NOT_FOUND or rules.enumeration(task, oracle).count() == 0
    assert all(oracle.stands(tuple(state)) for state in search.states().tolist())
    for level in search.levels:
        assert len(level.states) <= 3
        assert len(rows_of(level.states)) == len(level.states)


def test_devices_that_do_not_exist_are_refused() -> None:
    with pytest.raises(InputError, match="choose auto"):
        choose_device("cuda:99")
    with pytest.raises(InputError, match="unknown device"):
        choose_device("abacus")
    assert choose_device("cpu") == CPU


def test_the_device_decides_which_beam_runs(arch_oracle: StabilityOracle, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a GPU the same call runs on the processor, and asking for one says so."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    task = Task.from_rules(arch_oracle.assembly.boundary, 2)
    for device in ("cpu", "auto"):
        with beam_search(task, arch_oracle, BeamSettings(width=4), device) as (search, first):
            assert isinstance(search, BeamSearch)
            assert first
    with pytest.raises(InputError, match="0 CUDA devices"), beam_search(task, arch_oracle, device="cuda"):
        pass


def test_random_words_are_uniform_and_depend_on_the_salt() -> None:
    keys = torch.arange(100_000)
    numbers = uniform(mix(keys, 3)).numpy()
    assert abs(numbers.mean() - 0.5) < 5 / np.sqrt(12 * len(numbers))
    assert np.abs(np.histogram(numbers, 50, (0, 1))[0] / 2000 - 1).max() < 0.15
    assert (uniform(mix(keys, 4)).numpy() != numbers).all()


@pytest.mark.parametrize("dimensions", [12, 62, 1100])
def test_clusters_are_as_tight_as_those_of_k_means_plus_plus(dimensions: int) -> None:
    """Mean squared distance from the centre, against the other implementation, on states of a few kinds."""
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 3, (40, dimensions))
    states = np.where(rng.random((1500, dimensions)) < 0.8, kinds[rng.integers(40, size=1500)], 1).astype(np.uint8)
    states = np.unique(states, axis=0)
    words = put(rng.integers(0, 2**63, len(states)), CPU)
    labels, distance = find_centers(put(states, CPU), words, 40).assign(put(states, CPU))
    _, expected = k_means(states, 40, np.random.default_rng(1))
    centers = np.array([states[labels.numpy() == k].mean(axis=0) for k in np.unique(labels)])
    gap = ((states[:, None, :].astype(np.float32) - centers[None]) ** 2).sum(axis=2)
    assert gap.min(axis=1).mean() < 1.15 * expected.mean()
    assert distance.min() >= 0
    assert len(centers) > 30


def test_shares_cover_everything_once() -> None:
    for size, count in ((1, 5), (3, 10), (4, 3), (4, 0)):
        shards = [ProcessGroup(rank, size) for rank in range(size)]
        whole = np.arange(count)
        assert np.array_equal(np.concatenate([whole[shard.block(count)] for shard in shards]), whole)
        assert sorted(np.concatenate([whole[shard.interleaved()] for shard in shards]).tolist()) == whole.tolist()


@pytest.mark.parametrize("name", ["bottle-12"])
def test_a_real_structure_gives_as_many_states(shared_assembly: Callable[[str], Path], name: str) -> None:
    """The paper's data set of bottle-12 at width 64 has 1,077 states; all of these can be taken apart."""
    assembly = load_structure(str(shared_assembly(name)))
    task = Task.from_rules(assembly.boundary, 2)
    search = beam(task, StabilityOracle(assembly), width=64)
    result = search.run()
    assert result.found
    graph = StateGraph.from_states(task, search.states())
    assert len(graph) == len(search.states())
    assert graph.solvable.all()
    assert 950 < len(graph) < 1250

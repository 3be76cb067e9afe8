"""Beam search: complete where nothing is left out, sound where something is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Direction, Outcome, StabilityOracle, Task, load_structure
from falsework.errors import InputError
from falsework.search import BeamSearch, BeamSettings, ExhaustiveSearch, SearchProgress, SupportGuide
from falsework.search.beam.frontier import Level, PackedLevel, expand, pack
from falsework.search.beam.scores import Scores
from falsework.search.problem.hashing import StateHash
from falsework.search.problem.result import Route

BOTH = pytest.mark.parametrize("direction", list(Direction))
WAYS = pytest.mark.parametrize("way", [{}, {"lookahead": 8}, {"lookahead": 4, "commit": True}, {"diversity": "none"}])


def check_route(route: Route, task: Task, oracle: Any, rules: Any) -> None:
    """Legal by the rules as the enumeration knows them, stable, and from start to target."""
    states = [tuple(state) for state in route.states.tolist()]
    moves = rules.enumeration(task, oracle).moves
    for before, action, after in zip(states[:-1], route.actions.tolist(), states[1:], strict=True):
        assert (action, after) in list(moves(before))
    assert states[0] == tuple(task.start)
    assert states[-1] == tuple(task.target)


@BOTH
@pytest.mark.parametrize("seed", range(30))
def test_without_a_limit_it_decides(rules: Any, direction: Direction, seed: int) -> None:
    oracle, clearance = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), 1 + seed % 2, clearance=clearance if seed % 3 == 0 else None)
    result = BeamSearch(task, oracle, BeamSettings(width=10_000, direction=direction)).run()
    plans = rules.enumeration(task, oracle).count()
    assert result.outcome is (Outcome.FOUND if plans else Outcome.PROVED_IMPOSSIBLE)
    if plans:
        check_route(result.routes[0], task, oracle, rules)


@pytest.mark.parametrize("seed", range(15))
def test_every_state_of_an_assembly_beam_is_solvable(rules: Any, seed: int) -> None:
    """Found from the empty structure, each can be taken apart: that is what makes them data (paper, section 5)."""
    oracle, _ = rules.random(seed, 8)
    search = BeamSearch(Task.from_rules(rules.ground(8), 2), oracle, BeamSettings(width=6))
    search.run()
    for level, found in enumerate(search.levels):
        assert len(found.states) <= 6
        for state in found.states:
            rest = Task.from_rules(rules.ground(8), 2, start=state)
            assert rest.steps == level
            assert rules.enumeration(rest, oracle).count() > 0


@BOTH
@WAYS
@pytest.mark.parametrize("seed", range(8))
def test_what_a_narrow_beam_finds_is_a_plan(rules: Any, direction: Direction, way: dict[str, Any], seed: int) -> None:
    oracle, _ = rules.random(seed, 9)
    task = Task.from_rules(rules.ground(9), 2)
    search = BeamSearch(task, oracle, BeamSettings(width=3, direction=direction, seed=seed, **way))
    result = search.run()
    if result.found:
        check_route(result.routes[0], task, oracle, rules)
    else:
        assert result.outcome is Outcome.NOT_FOUND or rules.enumeration(task, oracle).count() == 0
    assert all(oracle.stands(tuple(state)) for state in search.states().tolist())
    for level in search.levels:
        assert len(np.unique(level.states, axis=0)) == len(level.states)


@BOTH
def test_only_moves_that_need_one_get_a_verdict(rules: Any, direction: Direction) -> None:
    """Each asked state has, by its parent, one part removed; or in assembly, one part released."""
    oracle, _ = rules.random(1, 8)
    task = Task.from_rules(rules.ground(8), 2)
    search = BeamSearch(task, oracle, BeamSettings(width=20, direction=direction))
    result = search.run()
    asked = np.concatenate(oracle.asked)
    assert len(asked) == result.counters.asked < result.counters.candidates
    held = (asked[:, 1:] == 2).sum(axis=1)
    # A removal frees a robot, and so does a release: two robots cannot both be busy afterwards.
    assert (held < task.robots).all()
    assert result.counters.rejected == sum(not oracle.stands(tuple(state)) for state in asked.tolist())


def test_a_promising_beam_asks_little(rules: Any) -> None:
    """Free blocks: the first batch of four always holds a stable state, so four verdicts a part are enough."""
    task = Task.from_rules(rules.ground(21), 2)
    settings = BeamSettings(width=1, lookahead=32, commit=True, diversity="none")
    result = BeamSearch(task, rules.blocks(21), settings).run()
    assert result.found
    assert 20 <= result.counters.asked <= 4 * 20
    eager = BeamSearch(task, rules.blocks(21), BeamSettings(width=32)).run()
    assert eager.counters.asked > 4 * 20


def test_narrow_beam_with_choice_ahead_climbs_a_high_tower(rules: Any) -> None:
    """Of sixty parts one can be placed at a time; width one with all insertions ahead finds it, without it never."""
    task = Task.from_rules(rules.ground(61), 1)
    lookahead = BeamSearch(task, rules.tower(61), BeamSettings(width=1, lookahead=64, commit=True)).run()
    assert lookahead.found
    blind = BeamSearch(task, rules.tower(61), BeamSettings(width=1)).run()
    assert blind.outcome is Outcome.NOT_FOUND
    assert "width of 1" in blind.limit


@BOTH
def test_a_dead_beam_says_where(rules: Any, direction: Direction) -> None:
    task = Task.from_rules(rules.ground(6), 1)
    result = BeamSearch(task, rules.arch(6), BeamSettings(direction=direction)).run()
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.reached == 1
    assert result.steps == 10
    assert len(result.deepest) == len(result.rejected) == 5
    assert not any(rules.arch(6).stands(tuple(state)) for state in result.rejected.tolist())


@BOTH
@WAYS
def test_resuming_changes_nothing(rules: Any, direction: Direction, way: dict[str, Any]) -> None:
    oracle, _ = rules.random(5, 10)
    task = Task.from_rules(rules.ground(10), 2)
    settings = BeamSettings(width=4, direction=direction, seed=3, **way)
    whole = BeamSearch(task, oracle, settings)
    expected = whole.run()
    halted = BeamSearch(task, oracle, settings)
    result = halted.run(stop=lambda: len(halted.levels) > 5)
    assert result.interrupted
    assert result.outcome is Outcome.NOT_FOUND
    assert result.reached == 5
    resumed = BeamSearch.unpack(*halted.pack(), task, oracle)
    result = resumed.run()
    assert np.array_equal(resumed.states(), whole.states())
    assert result.outcome is expected.outcome
    assert result.counters == expected.counters
    assert np.array_equal(result.rejected, expected.rejected)


def test_an_interruption_from_the_keyboard_keeps_what_was_found(rules: Any) -> None:
    oracle, _ = rules.random(5, 10)
    task = Task.from_rules(rules.ground(10), 2)
    seen: list[SearchProgress] = []

    def press(event: SearchProgress) -> None:
        seen.append(event)
        if event.level == 4:
            raise KeyboardInterrupt

    search = BeamSearch(task, oracle, BeamSettings(width=4))
    result = search.run(progress=press)
    assert result.interrupted
    assert len(search.levels) == 5
    assert [event.level for event in seen] == [1, 2, 3, 4]
    assert search.run().outcome is not Outcome.PROVED_IMPOSSIBLE
    assert search.done


def test_same_seed_same_beam(rules: Any) -> None:
    oracle, _ = rules.random(2, 12)
    task = Task.from_rules(rules.ground(12), 2)
    found = [BeamSearch(task, oracle, BeamSettings(width=8, seed=seed)) for seed in (1, 1, 2)]
    for search in found:
        search.run()
    assert np.array_equal(found[0].states(), found[1].states())
    assert not np.array_equal(found[0].states(), found[2].states())


def test_a_guide_decides(rules: Any) -> None:
    """Free blocks, one robot, width one: the order of removal is that of the scores."""
    wanted = np.array([0, 3, 1, 5, 2, 4])

    def guide(states: Any, actions: Any, direction: Direction) -> Any:
        return np.concatenate([wanted, wanted])[None].repeat(len(states), axis=0).astype(float)

    task = Task.from_rules(rules.ground(6), 1)
    settings = BeamSettings(width=1, diversity="none", direction=Direction.DISASSEMBLY)
    result = BeamSearch(task, rules.blocks(6), settings, guide=guide).run()
    assert (result.routes[0].actions[1::2] - 6).tolist() == [3, 5, 1, 4, 2]
    with pytest.raises(InputError, match=r"shape \(1, 6\); expected \(1, 12\)"):
        BeamSearch(task, rules.blocks(6), settings, guide=lambda states, actions, direction: np.zeros((1, 6))).run()


def test_support_guide_prefers_neighbours(small_arch: Assembly) -> None:
    """From the empty structure only the blocks at the abutments have support, and equally much."""
    guide = SupportGuide(small_arch)
    empty = np.where(small_arch.boundary, 2, 0).astype(np.uint8)[None]
    parts = small_arch.part_count
    score = guide(empty, np.ones((1, 2 * parts), dtype=bool), Direction.ASSEMBLY)[0, parts:]
    blocks = np.flatnonzero(~small_arch.boundary)
    assert np.sort(score[blocks])[-2:] == pytest.approx([0.5, 0.5])
    assert np.sort(score[blocks])[:-2] == pytest.approx(0.0)
    out = guide(empty, np.ones((1, 2 * parts), dtype=bool), Direction.DISASSEMBLY)
    assert np.array_equal(out[0, parts:], -score)


@pytest.mark.parametrize("alike", [True, False])
def test_support_guide_of_a_large_structure(alike: bool) -> None:
    """The scores are shares of contact area, whether states of the batch are alike or not."""
    vault = load_structure("vault:parts=320")
    random, parts = np.random.default_rng(0), vault.part_count
    states = random.integers(0, 3, (8, parts)).astype(np.uint8)
    if alike:
        states[1:] = states[0]
        states[np.arange(1, 8), random.integers(0, parts, 7)] = 0
    area = np.zeros((parts, parts))
    for (a, b), size in zip(vault.contacts.parts.tolist(), vault.contacts.areas.tolist(), strict=True):
        area[a, b] += size
        area[b, a] += size
    expected = (states != 0) @ area / area.sum(axis=0)
    score = SupportGuide(vault)(states, np.ones((8, 2 * parts), dtype=bool), Direction.ASSEMBLY)
    np.testing.assert_allclose(score, np.concatenate([expected, expected], axis=1), atol=1e-6)


def test_no_verdict_is_guessed(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """Every state that a beam keeps is stable by the exact solver."""
    for direction in Direction:
        search = BeamSearch(
            Task.from_rules(small_arch.boundary, 2), arch_oracle, BeamSettings(width=8, direction=direction)
        )
        search.run()
        assert arch_oracle.exact.check(search.states()).stable.all()


def test_unlimited_beam_and_exhaustive_search_agree_on_real_states(
    small_arch: Assembly, arch_oracle: StabilityOracle
) -> None:
    """States between both ends are those found from the one and from the other."""
    task = Task.from_rules(small_arch.boundary, 2)
    census = ExhaustiveSearch(task, arch_oracle).run()
    backward = BeamSearch(task, arch_oracle, BeamSettings(width=100_000))
    assert backward.run().found
    forward = {tuple(state) for state in census.graph.states[census.graph.solvable].tolist()}
    behind = {tuple(state) for state in backward.states().tolist()}
    assert forward <= behind


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"width": 0}, "width 0"), ({"lookahead": -1}, "-1 states ahead"), ({"pool": 0}, "pool")],
)
def test_bad_settings(settings: dict[str, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        BeamSettings(**settings)  # type: ignore[arg-type]


def test_large_frontiers_are_sampled(rules: Any) -> None:
    """With room for few candidates at a time the beam still fills its width, from all of them over time."""
    task = Task.from_rules(rules.ground(31), 2)
    result = BeamSearch(task, rules.blocks(31), BeamSettings(width=8, pool=31 * 16)).run()
    assert result.found


def test_going_back(rules: Any) -> None:
    """A beam that died narrow comes through when it is taken back and widened; one taken back knows no more."""
    task = Task.from_rules(rules.ground(31), 1)
    search = BeamSearch(task, rules.tower(31), BeamSettings(width=1))
    assert not search.run().found
    assert not search.exhaustive
    search.rewind(0, BeamSettings(width=64))
    assert len(search.levels) == 1
    assert search.exhaustive
    assert not search.done
    assert search.run().found
    with pytest.raises(InputError, match="cannot rewind"):
        search.rewind(99, BeamSettings())
    with pytest.raises(InputError, match="cannot rewind"):
        search.rewind(0, BeamSettings(direction=Direction.DISASSEMBLY))


def test_packed_levels_have_the_same_states() -> None:
    random = np.random.default_rng(0)
    states = np.repeat(random.integers(0, 3, 700).astype(np.uint8)[None], 40, axis=0)
    states[np.arange(40), random.integers(0, 700, 40)] = 1
    none = np.zeros(40)
    level = Level(states, none.astype(np.int64), none.astype(np.int64), none, none.astype(np.int8))
    packed = pack(level)
    assert isinstance(packed, PackedLevel)
    np.testing.assert_array_equal(packed.states, states)
    assert packed.size < states.nbytes / 10
    assert pack(packed) is packed
    diverse = replace(level, states=random.integers(0, 3, states.shape).astype(np.uint8))
    assert pack(diverse) is diverse


@pytest.mark.parametrize("direction", Direction)
def test_frontiers_have_each_state_once(rules: Any, direction: Direction) -> None:
    """As if all moves of all states were written down and equal states removed, the first move kept."""
    random, task = np.random.default_rng(0), Task.from_rules(rules.ground(9), 3).judged_by(rules.tower(9))
    level = task.origin(direction)[None]
    for _ in range(9):
        frontier = expand(task, direction, level, StateHash.for_parts(9))
        row, action = np.nonzero(task.moves(level, direction))
        states = task.follow(level[row], action, direction)
        _, first, position = np.unique(states, axis=0, return_index=True, return_inverse=True)
        found = frontier.candidates()
        np.testing.assert_array_equal(found, np.sort((row * 18 + action)[first]))
        np.testing.assert_array_equal(frontier.states(found), states[np.sort(first)])
        fixing = np.zeros(len(first), dtype=bool)
        fixing[position.ravel()[task.fixes(action, direction)]] = True
        np.testing.assert_array_equal(frontier.fixes(found), fixing[np.argsort(first)])
        np.testing.assert_array_equal(
            frontier.held(found), ((frontier.states(found) == 2) & ~task.boundary).sum(axis=1)
        )
        level = frontier.states(random.permutation(found)[:12])


@pytest.mark.parametrize("direction", Direction)
@pytest.mark.parametrize("ties", [False, True])
def test_the_best_are_the_first_of_all(rules: Any, direction: Direction, ties: bool) -> None:
    """Sorting those that may be among the best is sorting all, with equal ones in the same random order."""
    random, task = np.random.default_rng(1), Task.from_rules(rules.ground(9), 3).judged_by(rules.tower(9))
    level = task.origin(direction)[None]
    for step in range(9):
        frontier = expand(task, direction, level, StateHash.for_parts(9))
        shapes = (len(level),), (len(level), 18)
        before, guide = (random.random(shape).round(0 if ties else 9) for shape in shapes)
        scores = Scores(frontier, before, guide)
        rows = np.flatnonzero(frontier.fixing)
        everything = scores.of(frontier.candidates())
        gap = np.ptp(everything) + 1.0
        np.testing.assert_array_equal(scores.promise(rows), scores.of(rows) - gap * frontier.held(rows))
        shuffled = np.random.default_rng(step).permutation(rows)
        ordered = shuffled[np.argsort(-scores.promise(shuffled), kind="stable")]
        for most_held in (np.inf, 2, 1):
            wanted = ordered[frontier.held(ordered) <= most_held]
            for count in (1, 3, 10, 1000):
                best = scores.best_fixing(count, most_held, np.random.default_rng(step))
                if not ties:
                    assert len(np.unique(scores.promise(rows))) == len(rows)
                np.testing.assert_array_equal(best, wanted[:count])
        found = frontier.candidates()
        level = frontier.states(random.permutation(found)[:12])

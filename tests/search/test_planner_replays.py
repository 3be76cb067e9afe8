"""Plans are found only where a replay stands: a replayer made of rules that fells chosen states."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence, Set
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework import Direction, Outcome, PlannerSettings, StabilitySettings, Task, find_plans
from falsework.assembly import States
from falsework.errors import InputError
from falsework.search import BeamSearch, BeamSettings
from falsework.search.find import PLANS
from falsework.search.planner import Planner
from falsework.search.problem.deadline import Deadline
from falsework.search.problem.result import SearchProgress, Stop
from falsework.stability.contact.history import Change, History, Replay, ReplaySettings
from falsework.stability.contact.varied_replay import FEW, MANY, TRUE_FRICTION, AllVariations, variations
from falsework.stability.judges import discrete_elements
from falsework.stability.judges.judgement import Judgement
from falsework.stability.verdict import Verdict, Verdicts
from falsework.utils.interruption import check_interruption


class RuleReplayer:
    """A structure falls in the states that are named, however they are reached."""

    assembly: Any = None
    problem: Any = SimpleNamespace(parts=1, points=1)
    settings = StabilitySettings()
    varies = True
    changes: tuple[Change, ...] = ()

    def __init__(
        self,
        falls: Set[tuple[int, ...]],
        varied: Set[tuple[int, ...]] = frozenset(),
        slow: Sequence[float] = (),
        slips: Set[tuple[int, ...]] = frozenset(),
        true: Set[tuple[int, ...]] = frozenset(),
    ) -> None:
        self.falls = falls
        self.true = true
        """States in which the structure falls under the true friction alone."""
        self.slips = slips
        """States in which parts come to rest far from where they were."""
        self.slow = list(slow)
        """Seconds that steps take, one after the other."""
        self.varied = varied
        """States in which the structure falls with a thicker medium alone."""
        self.replayed = self.iterations = 0

    def vary(self, change: Change) -> RuleReplayer:
        if change.reserve is not None and change.reserve < self.settings.reserve:
            return RuleReplayer(self.falls | self.true)
        thicker = change.replay.first_step < ReplaySettings.first_step
        return RuleReplayer(self.falls | self.varied if thicker else self.falls)

    def also_under(self, changes: Sequence[Change]) -> None:
        """Fall in all states that are named once the change is tried at every step."""
        self.changes = tuple(changes)
        self.falls |= self.varied if set(changes) - {TRUE_FRICTION} else set()
        self.falls |= self.true if TRUE_FRICTION in changes else set()

    def replay(self, states: Any, history: History | None = None, presses: Any = None) -> Replay:
        self.replayed += 1
        stands = np.array([-1 if tuple(state.tolist()) in self.falls else 1 for state in states], np.int8)
        bad = np.flatnonzero(stands < 0)
        reached = int(bad[0]) if len(bad) else len(states)
        stands[reached + 1 :] = 0
        none = History(np.zeros((1, 6)), np.zeros((1, 3)), np.zeros(1, bool), np.zeros(1, np.int32))
        zeros = np.zeros(len(states))
        part = zeros.astype(np.int32) - 1
        return Replay(stands, zeros, part, zeros, (none,) * reached, ((),) * reached)

    def first_tipping(self, states: States, histories: Sequence[History], known: int = 0) -> int | None:
        return None

    def loads(self, states: States, histories: Sequence[History]) -> tuple[()]:
        return ()

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        check_interruption()
        if self.slow:
            time.sleep(self.slow.pop())
        here = tuple(after.tolist())
        self.iterations += 70 if here in self.falls else 10
        return here not in self.falls, replace(history, moved=float(here in self.slips))

    def slip(self, before: History, after: History) -> float:
        return after.moved


def tower(rules: Any, falls: set[tuple[int, ...]], parts: int = 5) -> tuple[Task, Any]:
    """Parts on the ground, which is one, each of which stands whatever else is there; two robots."""
    oracle, _ = rules.random(3, parts)
    oracle.supports = [[frozenset()] for _ in range(parts)]
    oracle.replayer = RuleReplayer(falls)
    return Task.from_rules(rules.ground(parts), 2), oracle


def middle_state(task: Task, oracle: Any, settings: PlannerSettings) -> tuple[int, ...]:
    """Return the state in the middle of the first route of a search."""
    states = Planner(task, oracle, settings).run().routes[0].states
    return tuple(states[len(states) // 2].tolist())


@pytest.mark.parametrize("direction", list(Direction))
def test_a_route_avoids_what_falls(rules: Any, direction: Direction) -> None:
    task, oracle = tower(rules, set())
    settings = PlannerSettings(directions=(direction,))
    middle = middle_state(task, oracle, settings)
    task, oracle = tower(rules, {middle})
    planner = Planner(task, oracle, settings)
    result = planner.run()
    assert result.found
    assert middle not in set(map(tuple, result.routes[0].states.tolist()))
    assert oracle.replayer.replay(result.routes[0].states[::-1]).good


@pytest.mark.parametrize("proven", [False, True])
def test_what_is_left_out_before_its_replay_without_a_proof_proves_nothing(rules: Any, proven: bool) -> None:
    """Such as states that do not keep a margin, or those that replays excluded: the search ends, but says no more."""

    class Strict(type(tower(rules, set())[1])):  # type: ignore[misc]
        def verdicts(self, states: States, **given: Any) -> Verdicts:
            found = super().verdicts(states, **given)
            found.verdict[(states[:, 1:] == 1).any(axis=1)] = Verdict.UNSTABLE if proven else Verdict.SLIDES
            return found

    task, oracle = tower(rules, set())
    strict = Strict(oracle.supports, replayer=oracle.replayer)
    search = BeamSearch(task, strict, BeamSettings(width=64, direction=Direction.ASSEMBLY, lookahead=4096))
    result = search.run()
    assert not result.found
    assert result.outcome is (Outcome.PROVED_IMPOSSIBLE if proven else Outcome.NOT_FOUND)
    assert (search.done and not search.found and search.exhaustive) == proven


def test_parts_slip_far_only_where_nothing_else_is_left(rules: Any) -> None:
    settings = PlannerSettings(directions=(Direction.ASSEMBLY,))
    task, oracle = tower(rules, set())
    first = Planner(task, oracle, settings).run().routes[0].states
    free = [tuple(state.tolist()) for state in first if (state[1:] != 2).all()]
    slips = free[-2]  # after the first part
    oracle.replayer = RuleReplayer(set(), slips={slips})
    around = Planner(task, oracle, settings).run()
    assert around.found
    assert slips not in set(map(tuple, around.routes[0].states.tolist()))
    complete = tuple(task.start.tolist())
    oracle.replayer = RuleReplayer(set(), slips={complete})  # every plan ends there
    assert Planner(task, oracle, settings).run().found


def test_a_replay_that_fails_counts_for_a_turn_by_its_iterations(rules: Any) -> None:
    """Else a strategy whose replays fail, which takes many iterations, keeps its turn for too long."""
    task, oracle = tower(rules, set())
    complete = task.start
    search = BeamSearch(task, oracle, BeamSettings.from_width(direction=Direction.ASSEMBLY))
    assert search.run(1).found
    assert search.effort == search.asked
    oracle.replayer = RuleReplayer({tuple(complete.tolist())})
    search = BeamSearch(task, oracle, BeamSettings.from_width(direction=Direction.ASSEMBLY))
    search.run(1)
    failed = search.judge.sliding
    assert failed > 0
    assert search.effort == search.asked + 7 * failed


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize("falls", ["complete", "second"])
def test_a_search_ends_where_every_replay_falls(rules: Any, direction: Direction, falls: str) -> None:
    """No plan survives: none is delivered, nothing is claimed to be proven, and the best one is kept to be shown."""
    task, oracle = tower(rules, set())
    complete = tuple(task.start.tolist())
    bars = {complete}
    if falls == "second":
        bars = {tuple(2 if part == k else value for part, value in enumerate(complete)) for k in range(5)}
    task, oracle = tower(rules, bars)
    planner = Planner(task, oracle, PlannerSettings(directions=(direction,), width=4))
    result = planner.run()
    assert result.outcome is Outcome.NOT_FOUND
    assert result.routes == ()
    if direction is Direction.DISASSEMBLY:
        assert planner.tests.fallen is not None
        route, step = planner.tests.fallen
        assert tuple(route.states[::-1][step].tolist()) in bars


def test_a_search_does_not_depend_on_how_long_replays_take(rules: Any) -> None:
    settings = PlannerSettings(directions=(Direction.ASSEMBLY,))
    task, oracle = tower(rules, set())
    easy = Planner(task, oracle, settings).run()
    falls = {tuple(easy.routes[0].states[::-1][row].tolist()) for row in (2, 4, 6)}
    found = []
    for seed in range(4):
        oracle.replayer = RuleReplayer(falls, slow=np.random.default_rng(seed).choice([0.0, 0.01], 500).tolist())
        planner = Planner(task, oracle, settings)
        result = planner.run()
        assert result.found
        assert not falls & set(map(tuple, result.routes[0].states.tolist()))
        found.append((result.routes[0].states.tobytes(), result.counters.asked))
        assert list(planner.tests.replays) == [result.routes[0].states.tobytes()]
    assert len(set(found)) == 1


def test_what_a_replay_raises_reaches_the_search(rules: Any) -> None:
    class BrokenReplayer(RuleReplayer):
        def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
            raise ArithmeticError("broken")

    task, oracle = tower(rules, set())
    oracle.replayer = BrokenReplayer(set())
    with pytest.raises(ArithmeticError, match="broken"):
        Planner(task, oracle, PlannerSettings(directions=(Direction.ASSEMBLY,))).run()


def test_a_deadline_is_kept_between_replays(rules: Any) -> None:
    task, oracle = tower(rules, set())
    oracle.replayer = RuleReplayer(set())
    search = BeamSearch(task, oracle, BeamSettings(width=4, direction=Direction.ASSEMBLY, lookahead=8))
    with Deadline(1e-6).interrupts():
        assert search.run().interrupted
    assert search.run().found


def test_a_deadline_without_end_is_none() -> None:
    assert not Deadline(np.inf).limited
    found = find_plans("arch:blocks=3", deadline=np.inf)
    assert found.unwrap().claim.reserve == PLANS.reserve


def test_without_a_replayer_nothing_is_replayed(rules: Any) -> None:
    task, oracle = tower(rules, set())
    oracle.replayer = None
    assert Planner(task, oracle).run().found


class RuleJudge:
    """A structure falls in the states that are named, and some time passes before each state."""

    def __init__(self, falls: set[tuple[int, ...]]) -> None:
        self.falls = falls

    def judge(self, states: States, presses: Any, stop: Stop) -> Judgement:
        for row, state in enumerate(states.tolist()):
            if stop():
                return Judgement(row, len(states))
            if tuple(state) in self.falls:
                return Judgement(row, len(states), row, 1)
        return Judgement(len(states), len(states), undecided=(1,))


@pytest.fixture
def judged_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[set[tuple[int, ...]]], None]:
    """Set the states in which the judge sees structures fall."""
    return lambda falls: monkeypatch.setattr(discrete_elements, "BuildJudge", lambda *structure: RuleJudge(falls))


@pytest.mark.parametrize("direction", list(Direction))
def test_a_route_avoids_what_the_judge_sees_fall(rules: Any, judged_by: Any, direction: Direction) -> None:
    task, oracle = tower(rules, set())
    settings = PlannerSettings(directions=(direction,), judge=True)
    judged_by(set())
    middle = middle_state(task, oracle, settings)
    judged_by({middle})
    planner = Planner(task, oracle, settings)
    (route,) = planner.run().routes
    assert middle not in set(map(tuple, route.states.tolist()))
    count = len(route.states)
    assert planner.tests.replays[route.states.tobytes()].judgement == Judgement(count, count, undecided=(1,))
    assert planner.tests.fallen is None


@pytest.mark.parametrize("direction", list(Direction))
def test_the_route_that_the_judge_builds_farthest_is_kept(rules: Any, judged_by: Any, direction: Direction) -> None:
    task, oracle = tower(rules, set())
    complete = tuple(task.start.tolist())
    judged_by({complete})
    planner = Planner(task, oracle, PlannerSettings(directions=(direction,), width=4, judge=True))
    result = planner.run()
    assert result.outcome is Outcome.FOUND
    assert not result.interrupted
    assert len(result.routes) == 1
    assert not planner.routes
    judgement = planner.tests.replays[result.routes[0].states.tobytes()].judgement
    assert judgement == Judgement(result.steps, result.steps + 1, result.steps, 1)


def test_a_judge_is_interrupted(rules: Any, judged_by: Any) -> None:
    """The route is not lost, nor is it called accepted; the search can go on."""
    task, oracle = tower(rules, set())
    judged_by(set())
    planner = Planner(task, oracle, PlannerSettings(directions=(Direction.ASSEMBLY,), judge=True))
    levels: list[int] = []
    result = planner.run(progress=lambda event: levels.append(event.level), stop=lambda: len(levels) == task.steps)
    assert result.interrupted
    assert result.found
    judgement = planner.tests.replays[result.routes[0].states.tobytes()].judgement
    assert judgement == Judgement(0, task.steps + 1)
    result = planner.run()
    assert not result.interrupted
    assert planner.tests.replays[result.routes[0].states.tobytes()].judgement is not None
    assert planner.routes


def test_a_route_that_is_given_is_judged(rules: Any, judged_by: Any) -> None:
    """So is that of a search which was saved after it."""
    task, oracle = tower(rules, set())
    route = Planner(task, oracle).run().routes[0]
    judged_by(set())
    planner = Planner(task, oracle, PlannerSettings(judge=True))
    planner.begin_with(route)
    assert planner.run().routes == (route,)
    judgement = planner.tests.replays[route.states.tobytes()].judgement
    assert judgement is not None
    assert judgement.stands


def test_a_judge_needs_replays(rules: Any) -> None:
    task, oracle = tower(rules, set())
    oracle.replayer = None
    with pytest.raises(InputError, match="criterion contact"):
        Planner(task, oracle, PlannerSettings(judge=True))


@pytest.mark.parametrize("direction", list(Direction))
def test_a_robust_route_avoids_what_falls_under_a_variation(rules: Any, direction: Direction) -> None:
    task, oracle = tower(rules, set())
    middle = middle_state(task, oracle, PlannerSettings(directions=(direction,)))
    for robust in (False, True):
        oracle.replayer = RuleReplayer(set(), {middle})
        planner = Planner(task, oracle, PlannerSettings(directions=(direction,), robust=robust))
        route = planner.run().routes[0]
        assert (middle in set(map(tuple, route.states.tolist()))) != robust
        fresh = RuleReplayer(set(), {middle})
        falls = AllVariations(fresh).falls_at(route.states[::-1], [()] * len(route.states))  # type: ignore[arg-type]
        assert (falls is None) == robust


@pytest.mark.parametrize("count", [FEW, MANY])
def test_where_a_route_falls_every_step_is_tried_under_changes_from_then_on(rules: Any, count: int) -> None:
    """Under all four that have every extreme together; another test of plans begins without them."""
    task, oracle = tower(rules, set())
    states = Planner(task, oracle).run().routes[0].states[::-1]
    replayer: Any = RuleReplayer(set(), {tuple(states[3].tolist())})
    every, presses = AllVariations(replayer, count), [()] * len(states)
    assert every.falls_at(states, presses) == 3
    assert list(replayer.changes) == variations(4)
    AllVariations(replayer, count)
    assert replayer.changes == ()


@pytest.mark.parametrize("direction", list(Direction))
def test_a_search_goes_on_under_the_change_that_it_learned(rules: Any, direction: Direction) -> None:
    """Whether it replays steps itself or whole routes; the rest of a structure is planned as before."""
    task, oracle = tower(rules, set())
    settings = PlannerSettings(directions=(direction,))
    middle = middle_state(task, oracle, settings)
    oracle.replayer = RuleReplayer(set(), {middle})
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    planner = Planner(task, oracle, settings)
    result = planner.run()
    assert result.found
    assert middle not in set(map(tuple, result.routes[0].states.tolist()))
    assert planner.tests.replays[result.routes[0].states.tobytes()].varied
    assert list(oracle.replayer.changes) == variations(FEW)


@pytest.mark.parametrize("direction", list(Direction))
def test_a_search_goes_on_under_the_true_friction_where_a_plan_fell_under_it(rules: Any, direction: Direction) -> None:
    """And under that alone; where the search replays its steps, no state is excluded."""
    task, oracle = tower(rules, set())
    settings = PlannerSettings(directions=(direction,))
    middle = middle_state(task, oracle, settings)
    oracle.replayer = RuleReplayer(set(), true={middle})
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    planner = Planner(task, oracle, settings)
    result = planner.run()
    assert result.found
    assert middle not in set(map(tuple, result.routes[0].states.tolist()))
    assert oracle.replayer.changes == (TRUE_FRICTION,)
    assert len(planner.tests.forbidden) == (direction is Direction.DISASSEMBLY)  # which replays complete routes only


def test_what_is_built_is_tested_under_the_true_friction_before_the_plan_is_complete(rules: Any) -> None:
    task, oracle = tower(rules, set(), 30)
    settings = PlannerSettings(directions=(Direction.ASSEMBLY,))
    middle = middle_state(task, oracle, settings)
    oracle.replayer = RuleReplayer(set(), true={middle})
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    planner = Planner(task, oracle, settings)
    planner.run(stop=lambda: bool(oracle.replayer.changes))
    assert oracle.replayer.changes == (TRUE_FRICTION,)
    assert planner.tests.doubted is None  # no complete route was tested
    assert planner.run().found


def test_a_route_is_replayed_under_changes_from_where_it_differs_from_the_last(
    rules: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[bool] = []
    replay = RuleReplayer.replay

    def noted(self: RuleReplayer, states: Any, history: History | None = None, presses: Any = None) -> Replay:
        begun.append(history is None)
        return replay(self, states, history, presses)

    monkeypatch.setattr(RuleReplayer, "replay", noted)
    task, oracle = tower(rules, set())
    states = Planner(task, oracle).run().routes[0].states[::-1]
    states = np.concatenate([np.repeat(states[:1], 40, axis=0), states])  # so that it has several parts
    presses: list[tuple[()]] = [()] * len(states)
    late, last = tuple(states[-2].tolist()), states.copy()
    last[-2] = last[-1]
    replayer: Any = RuleReplayer(set(), {late})
    every = AllVariations(replayer, MANY)
    assert every.falls_at(states, presses) == len(states) - 2
    assert sum(begun) > 1
    begun.clear()
    assert every.falls_at(last, presses) is None
    assert begun
    assert not any(begun)


def test_a_search_goes_back_to_where_its_plan_fell_under_a_change(rules: Any) -> None:
    """And keeps what leads there."""
    settings = PlannerSettings(directions=(Direction.ASSEMBLY,))
    task, oracle = tower(rules, set())
    states = Planner(task, oracle, settings).run().routes[0].states[::-1]
    late = next(row for row in range(len(states) - 2, 0, -1) if (states[row] == 1).sum() > (states[row - 1] == 1).sum())
    oracle.replayer = RuleReplayer(set(), {tuple(states[late].tolist())})
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    found = Planner(task, oracle, settings).run().routes[0].states[::-1]
    assert list(oracle.replayer.changes) == variations(FEW)
    np.testing.assert_array_equal(found[: late - 1], states[: late - 1])


@pytest.mark.parametrize("varied", [False, True])
@pytest.mark.parametrize("directions", [*((direction,) for direction in Direction), tuple(Direction)])
def test_resuming_forgets_nothing_that_a_search_has_learned(
    rules: Any, tmp_path: Path, directions: tuple[Direction, ...], varied: bool
) -> None:
    """Neither the states that replays exclude, nor changes of settings."""
    settings, path = PlannerSettings(directions=directions), tmp_path / "planner.npz"
    task, oracle = tower(rules, set())
    seen: set[tuple[int, ...]] = set()
    for _ in range(4):  # several routes fall, one after the other
        oracle.replayer = RuleReplayer(seen)
        seen = seen | {middle_state(task, oracle, settings)}

    def begin() -> Planner:
        oracle.replayer = RuleReplayer(set(), seen) if varied else RuleReplayer(seen)
        oracle.replayer.settings = StabilitySettings(reserve=1.1)
        return Planner(task, oracle, settings)

    whole = begin()
    expected = whole.run()
    changes = oracle.replayer.changes
    assert bool(changes) == varied
    planner = begin()
    for _ in range(300):
        result = planner.run(stop=halting(3))
        if not result.interrupted:
            break
        planner.save(path)
        begin()
        planner = Planner.load(path, task, oracle, settings)
    assert not result.interrupted
    assert result.outcome is expected.outcome
    assert result.counters == expected.counters
    assert oracle.replayer.changes == changes
    np.testing.assert_array_equal(planner.tests.forbidden, whole.tests.forbidden)
    np.testing.assert_array_equal(result.routes[0].states, expected.routes[0].states)


def halting(levels: int) -> Stop:
    """Stop after some levels."""
    calls = iter(range(levels))
    return lambda: next(calls, None) is None


def test_what_is_built_is_tested_before_the_plan_is_complete(rules: Any) -> None:
    """A fall near the beginning costs nothing that comes after it."""
    settings = PlannerSettings(directions=(Direction.ASSEMBLY,))
    oracle, _ = rules.random(3, 40)
    oracle.supports = [[frozenset()] for _ in range(40)]
    task = Task.from_rules(rules.ground(40), 2)
    oracle.replayer = RuleReplayer(set())
    states = Planner(task, oracle, settings).run().routes[0].states[::-1]
    built = (states == 1).sum(axis=1)
    early = next(row for row in range(5, len(states)) if built[row] > built[row - 1])
    oracle.replayer = RuleReplayer(set(), {tuple(states[early].tolist())})
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    learned: list[int] = []
    planner = Planner(task, oracle, settings)

    def progress(event: SearchProgress) -> None:
        if oracle.replayer.changes:
            learned.append(event.level)

    assert planner.run(progress=progress).found
    assert learned[0] <= early
    assert len(learned) >= len(states) - early


def test_a_route_that_stands_is_announced_once(rules: Any) -> None:
    """So that a deadline does not leave time for plans without a reserve where there is one with it."""
    task, oracle = tower(rules, set())
    oracle.replayer = RuleReplayer(set(), {middle_state(task, oracle, PlannerSettings())})
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    planner = Planner(task, oracle)
    clock, stands = Deadline(100.0), list[bool]()
    clock.reserve = 50.0

    def when_one_stands() -> None:
        stands.append(True)
        clock.use_reserve()

    planner.tests.when_one_stands = when_one_stands
    assert planner.run().found
    assert stands == [True]
    assert clock.reserve == 0.0


def test_a_replayer_of_one_setting_is_not_asked_for_others(rules: Any) -> None:
    """As in replanning, where there is no time for that."""
    task, oracle = tower(rules, set())
    oracle.replayer = RuleReplayer(set(), {tuple(task.start.tolist())})
    oracle.replayer.settings, oracle.replayer.varies = StabilitySettings(reserve=1.1), False
    planner = Planner(task, oracle, PlannerSettings(directions=(Direction.DISASSEMBLY,)))
    assert planner.run().found
    assert oracle.replayer.changes == ()


def test_the_plan_that_stands_under_the_settings_alone_is_delivered_where_there_is_no_other(rules: Any) -> None:
    """It does not say that it stands under changed ones."""
    task, oracle = tower(rules, set())
    oracle.replayer = RuleReplayer(set(), {tuple(task.start.tolist())})  # the complete structure falls: none stands
    oracle.replayer.settings = StabilitySettings(reserve=1.1)
    planner = Planner(task, oracle)
    result = planner.run()
    assert result.found
    assert not planner.tests.replays[result.routes[0].states.tobytes()].varied


def test_a_route_says_whether_its_replay_was_varied(rules: Any) -> None:
    for reserve in (1.0, 1.1):
        task, oracle = tower(rules, set())
        oracle.replayer.settings = StabilitySettings(reserve=reserve)
        planner = Planner(task, oracle)
        route = planner.run().routes[0]
        assert planner.tests.replays[route.states.tobytes()].varied == (reserve > 1.0)

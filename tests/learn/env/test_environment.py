"""The environment: rewards, verdicts and rollouts, against the slow way of doing the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import (  # noqa: E402
    Assembly,
    Direction,
    StabilityOracle,
    StabilitySettings,
    StateGraph,
    Task,
    Verdict,
    find_plans,
    load_structure,
    make_task,
)
from falsework.assembly.store import load_assembly  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.geometry import TriangleMesh  # noqa: E402
from falsework.learn import Environment, roll_out  # noqa: E402
from falsework.learn.env.environment import Rollouts  # noqa: E402
from falsework.learn.env.rollout import choose_actions, play  # noqa: E402
from falsework.search.device.oracle import DeviceOracle, HostOracle, without_fallback  # noqa: E402
from falsework.stability import ExactSolver, PressOracle, Verdicts  # noqa: E402

EQUILIBRIUM = StabilitySettings(criterion="equilibrium")
"""The criterion that the exact solver decides."""


class Counting:
    """Passes questions on and writes down what was asked."""

    def __init__(self, assembly: Assembly, settings: StabilitySettings = StabilitySettings()) -> None:
        self.oracle = StabilityOracle(assembly, settings)
        self.holds_keep_stable = self.oracle.holds_keep_stable
        self.asked: list[bytes] = []
        self.from_rest: list[bool] = []

    def verdicts(
        self, states: np.ndarray, *, near: np.ndarray | None = None, require_certificate: bool = False
    ) -> Verdicts:
        self.asked += [state.tobytes() for state in states]
        self.from_rest.append(near is None)
        return self.oracle.verdicts(states, near=near)


class Indifferent:
    """Thinks nothing of anything, so that drawn actions are drawn evenly."""

    def __init__(self) -> None:
        self.rows: list[int] = []

    def __call__(self, states, targets=None):
        self.rows.append(len(states))
        return torch.zeros(len(states), 2 * states.shape[1]), torch.zeros(len(states))


class Scripted:
    """Prefers the next action of a plan, told by the number of steps done."""

    def __init__(self, assembly: Assembly, actions: list[int]) -> None:
        self.task = make_task(assembly)
        self.actions = actions

    def __call__(self, states, targets=None):
        logits = torch.zeros(len(states), 2 * states.shape[1])
        done = self.task.steps_done(states.numpy())
        logits[torch.arange(len(states)), [self.actions[step] for step in done]] = 5.0
        return logits, torch.zeros(len(states))


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure("arch:blocks=7")


@pytest.fixture(scope="module")
def bottle() -> Assembly:
    return load_structure("bottle")


def random_rollouts(assembly: Assembly, count: int, seed: int = 0, **options) -> tuple[Environment, Rollouts]:
    options: dict[str, Any] = {"oracle": StabilityOracle(assembly, EQUILIBRIUM), **options}
    environment = Environment(assembly, 2, device="cpu", **options)
    starts = environment.rules.complete(count)
    generator = environment.generator(seed)
    return environment, roll_out(environment, Indifferent(), starts, greedy=False, generator=generator)


def check_rollouts(assembly: Assembly, rollouts: Rollouts, targets: np.ndarray | None = None) -> None:
    """Replay every rollout with arrays, tasks and the exact solver."""
    exact = ExactSolver(assembly)
    states, actions = rollouts.states.numpy(), rollouts.actions.numpy()
    for row, length in enumerate(rollouts.length.tolist()):
        task = Task.from_rules(
            assembly.boundary, 2, start=states[0, row], target=None if targets is None else targets[row]
        )
        passed = states[: length + 1, row]
        for step in range(length):
            assert task.moves(passed[step][None], Direction.DISASSEMBLY)[0, actions[step, row]]
            after = task.follow(passed[step][None], actions[step, row][None], Direction.DISASSEMBLY)[0]
            assert np.array_equal(after, passed[step + 1])
        assert (actions[length:, row] == -1).all()
        assert (states[length:, row] == passed[-1]).all()
        stable = exact.check(np.unique(passed[1:], axis=0)).stable if length else np.ones(1, bool)
        assert stable.all() == (not rollouts.unstable[row])
        assert not rollouts.unstable[row] or exact.check(passed[-2][None]).stable[0]
        assert bool(rollouts.success[row]) == np.array_equal(passed[-1], task.target)
        if rollouts.stuck[row]:
            assert not task.moves(passed[-1][None], Direction.DISASSEMBLY).any()
        good = rollouts.passed()[:, row].numpy()
        assert good.sum() == length + 1 - int(rollouts.unstable[row])


def test_random_rollouts_obey_rules_and_exact_solver(arch: Assembly) -> None:
    _, rollouts = random_rollouts(arch, 40)
    assert rollouts.unstable.any()
    check_rollouts(arch, rollouts)


def test_random_rollouts_with_targets(bottle: Assembly) -> None:
    environment, free = random_rollouts(bottle, 30)
    last = free.length - free.unstable.long()
    targets = free.states[last, torch.arange(30)]
    starts = free.states[last // 3, torch.arange(30)]
    rollouts = roll_out(environment, Indifferent(), starts, targets, greedy=False, generator=environment.generator(1))
    assert rollouts.success.any()
    check_rollouts(bottle, rollouts, targets.numpy())


def test_a_plan_is_a_success_with_the_rewards_of_the_paper(arch: Assembly) -> None:
    route = find_plans(arch, make_task(arch)).plans[0].route
    environment = Environment(arch, 2, device="cpu")
    rollouts = roll_out(environment, Scripted(arch, list(route.actions)), environment.rules.complete(3))
    assert rollouts.success.all()
    assert np.array_equal(rollouts.states[:, 1].numpy(), route.states)
    state, rewards = environment.rules.complete(), []
    for action in route.actions:
        step = environment.step(state, torch.tensor([action]))
        state = step.states
        rewards.append(step.reward.item())
    assert rewards == [0.0] * (len(route.actions) - 1) + [1.0]
    assert step.done.all()
    assert step.success.all()


def test_the_first_unstable_state_costs_one(arch: Assembly) -> None:
    environment = Environment(arch, 2, device="cpu")
    middle = 1 + int((~arch.boundary).sum()) // 2
    held = environment.step(environment.rules.complete(), torch.tensor([middle]))
    assert held.reward.tolist() == [0.0]
    fallen = environment.step(held.states, torch.tensor([arch.part_count + middle]))
    assert not StabilityOracle(arch).verdicts(fallen.states.numpy()).stable[0]
    assert fallen.reward.tolist() == [-1.0]
    assert fallen.done.all()
    assert fallen.unstable.all()
    assert not fallen.success.any()


def test_checked_rollouts_take_back_what_falls(arch: Assembly) -> None:
    """They go on with the next best action, and fail only where every action falls."""
    environment = Environment(arch, 2, device="cpu")
    starts = environment.rules.complete(20)
    options: dict[str, Any] = {"greedy": False, "generator": environment.generator(0)}
    plain = roll_out(environment, Indifferent(), starts, **options)
    checked = roll_out(environment, Indifferent(), starts, checked=True, **options)
    assert plain.unstable.any()
    assert checked.length.sum() > plain.length.sum()
    moved = (checked.states[1:] != checked.states[:-1]).any(dim=2)
    taken = checked.actions >= 0
    assert (taken & ~moved).any()
    last = torch.arange(len(taken))[:, None] == checked.length - 1
    kept = checked.states[1:][taken & ~(last & checked.unstable)]
    assert StabilityOracle(arch).verdicts(kept.numpy()).stable.all()
    for row in checked.unstable.nonzero()[:, 0].tolist():
        before = checked.states[checked.length[row] - 1, row][None]
        actions = environment.rules.moves(before).nonzero()[:, 1]
        assert environment.step(before.expand(len(actions), -1).contiguous(), actions).unstable.all()


def test_a_state_without_legal_action_has_failed() -> None:
    """Robots that hold two parts neither of which can leave wait for ever."""
    environment = Environment(load_structure("polycube"), 1, device="cpu", removable_only_if_clear=True)
    starts = environment.rules.complete(50)
    rollouts = roll_out(environment, Indifferent(), starts, greedy=False, generator=environment.generator(0))
    stuck = rollouts.stuck.nonzero()[:, 0]
    assert len(stuck)
    row = int(stuck[0])
    before = rollouts.states[rollouts.length[row] - 1, row][None]
    step = environment.step(before, rollouts.actions[rollouts.length[row] - 1, row][None].long())
    assert step.reward.tolist() == [-1.0]
    assert step.done.all()
    assert not step.unstable.any()
    again = roll_out(environment, Indifferent(), rollouts.last[stuck])
    assert not again.success.any()
    assert (again.length == 0).all()


def test_only_removals_are_judged_and_every_state_once(bottle: Assembly) -> None:
    """Under equilibrium, where a hold does no harm."""
    oracle = Counting(bottle, EQUILIBRIUM)
    environment, first = random_rollouts(bottle, 300, oracle=oracle)
    assert len(oracle.asked) == len(set(oracle.asked)) == environment.counters.states_asked
    removed = first.actions >= environment.part_count
    assert set(oracle.asked) == {state.numpy().tobytes() for state in first.states[1:][removed]}
    asked = len(oracle.asked)
    roll_out(
        environment, Indifferent(), environment.rules.complete(300), greedy=False, generator=environment.generator(0)
    )
    assert len(oracle.asked) == asked
    assert environment.counters.steps == 2 * int(first.length.sum())
    shares = environment.counters.to_dict()
    assert abs(sum(value for name, value in shares.items() if name.startswith("share_")) - 1) < 1e-9


def test_under_contact_every_action_is_judged(bottle: Assembly) -> None:
    oracle = Counting(bottle)
    environment, first = random_rollouts(bottle, 100, oracle=oracle)
    assert len(oracle.asked) == len(set(oracle.asked)) == environment.counters.states_asked
    assert set(oracle.asked) == {state.numpy().tobytes() for state in first.states[1:][first.actions >= 0]}
    # The last state of a rollout is one that is not proven stable exactly if it is called so; all others stand.
    last = oracle.oracle.verdicts(first.last.numpy(), require_certificate=True)
    stands = last.stable | last.tips  # which rollouts do not ask
    assert np.array_equal(stands, ~first.unstable.numpy())
    passed = np.unique(first.states[first.passed()].numpy(), axis=0)
    found = oracle.oracle.verdicts(passed, require_certificate=True)
    assert (found.stable | found.tips).all()


def test_a_hold_after_which_a_part_slides_ends_a_rollout(bottle: Assembly) -> None:
    """A robot that takes over a part takes its weight off the neighbours, and one that leant on it slides."""
    slides = np.array([1, 0, 1, 0, 0, 2, 1, 1, 0, 1, 2, 2], dtype=np.uint8)
    contact = StabilityOracle(bottle)
    taken = next(
        part for part in (5, 10) if contact.verdicts(np.where(np.arange(12) == part, 1, slides)[None]).stable[0]
    )
    before = np.where(np.arange(12) == taken, 1, slides).astype(np.uint8)
    assert contact.verdicts(slides, require_certificate=True).slides[0]
    assert ExactSolver(bottle).check(slides[None]).stable[0]

    def eager(states, targets=None):
        logits = torch.zeros(len(states), 2 * bottle.part_count)
        logits[:, taken] = 50.0
        return logits, torch.zeros(len(states))

    environment = Environment(bottle, 2, oracle=contact, device="cpu")
    for _ in range(2):  # the second time the verdict is known
        rollouts = roll_out(environment, eager, torch.from_numpy(before)[None])
        assert rollouts.unstable.all()
        assert rollouts.length.tolist() == [1]
        assert np.array_equal(rollouts.states[rollouts.passed()].numpy(), before[None])
        assert environment.counters.states_asked == 1
    assert (environment.verdict_cache.verdict == Verdict.SLIDES).sum() == 1
    balanced = Environment(bottle, 2, oracle=StabilityOracle(bottle, EQUILIBRIUM), device="cpu")
    step = balanced.step(torch.from_numpy(before)[None], torch.tensor([taken]))
    assert not step.unstable.any()
    assert balanced.counters.states_asked == 0


def test_verdicts_are_right_when_slots_are_fought_over(bottle: Assembly) -> None:
    """A table with few slots forgets; what it says stays true."""
    from falsework.learn.env.verdict_cache import VerdictTable

    environment, rollouts = random_rollouts(bottle, 500)
    states = rollouts.states.view(-1, environment.part_count)
    states = states[torch.randperm(len(states), generator=torch.Generator().manual_seed(0))]
    environment.verdict_cache = VerdictTable(environment.rules, memory=1)
    environment.verdict_cache.slots = 32
    truth = torch.from_numpy(StabilityOracle(bottle, EQUILIBRIUM).verdicts(states.numpy()).stable)
    for begin in range(0, len(states), 700):
        rows = slice(begin, begin + 700)
        assert torch.equal(environment.stable(states[rows]), truth[rows])


class HalfBlind:
    """A solver on a GPU that leaves every other state of a batch open."""

    def __init__(self, assembly: Assembly) -> None:
        self.oracle = StabilityOracle(assembly, EQUILIBRIUM)
        self.asked = 0

    def check_tensor(self, states):
        self.asked += len(states)
        verdict = torch.from_numpy(self.oracle.verdicts(states.numpy()).verdict)
        verdict[::2] = 0
        return verdict, torch.full((len(states),), torch.nan, dtype=torch.float64)


def half_blind_oracle(assembly: Assembly) -> DeviceOracle:
    oracle = DeviceOracle.__new__(DeviceOracle)
    oracle.solver, oracle.fallback = HalfBlind(assembly), StabilityOracle(assembly, EQUILIBRIUM)  # type: ignore[assignment]
    return oracle


def test_states_left_open_go_to_the_exact_solver_unless_they_may_be_given_up(arch: Assembly) -> None:
    """Given up they count as not proven, and are not remembered as such."""
    environment = Environment(arch, 2, oracle=StabilityOracle(arch, EQUILIBRIUM), device="cpu")
    oracle = half_blind_oracle(arch)
    environment.on_device = oracle
    _, rollouts = random_rollouts(arch, 60)
    states = torch.unique(rollouts.states.flatten(0, 1), dim=0)
    truth = torch.from_numpy(StabilityOracle(arch, EQUILIBRIUM).verdicts(states.numpy()).stable)
    assert truth.any()
    assert not truth.all()
    solver: Any = oracle.solver
    environment.exact = False
    first = environment.stable(states, states)
    assert not first[::2].any()
    assert torch.equal(first[1::2], truth[1::2])
    assert solver.asked == len(states)
    environment.exact = True
    assert torch.equal(environment.stable(states, states), truth)
    again = (len(states) + 1) // 2
    assert solver.asked == len(states) + again
    environment.exact = False
    assert torch.equal(environment.stable(states, states), truth)
    assert solver.asked == len(states) + again
    host = HostOracle(StabilityOracle(arch))
    assert without_fallback(host) is host


def test_same_seed_same_rollouts_and_ends_are_the_ends(bottle: Assembly) -> None:
    environment, one = random_rollouts(bottle, 100, seed=5)
    _, two = random_rollouts(bottle, 100, seed=5)
    _, other = random_rollouts(bottle, 100, seed=6)
    assert torch.equal(one.states, two.states)
    assert torch.equal(one.actions, two.actions)
    assert one.states.shape != other.states.shape or not torch.equal(one.states, other.states)
    ends = roll_out(
        environment,
        Indifferent(),
        environment.rules.complete(100),
        greedy=False,
        generator=environment.generator(5),
        keep="ends",
    )
    assert torch.equal(ends.last, one.last)
    assert torch.equal(ends.states[0], one.states[0])
    assert torch.equal(ends.length, one.length)
    assert ends.actions.shape == (0, 100)


def test_finished_rollouts_cost_nothing(bottle: Assembly) -> None:
    environment, _ = random_rollouts(bottle, 1)
    policy = Indifferent()
    rollouts = roll_out(
        environment, policy, environment.rules.complete(200), greedy=False, generator=environment.generator(0)
    )
    going = [int((rollouts.length > step).sum()) for step in range(int(rollouts.length.max()))]
    assert policy.rows == going
    environment.rows_at_once = 16
    pieces = Indifferent()
    again = roll_out(
        environment, pieces, environment.rules.complete(200), greedy=False, generator=environment.generator(0)
    )
    assert max(pieces.rows) == 16
    assert torch.equal(again.states, rollouts.states)


def test_a_policy_without_memory_for_so_many_states_is_asked_in_pieces(bottle: Assembly) -> None:
    environment = Environment(bottle, 2, device="cpu")
    policy = Indifferent()

    def small(states, targets=None):
        if len(states) > 20:
            raise torch.OutOfMemoryError("no more memory")
        return policy(states, targets)

    starts = environment.rules.complete(100)
    rollouts = roll_out(environment, small, starts, greedy=False, generator=environment.generator(0))
    expected = roll_out(environment, Indifferent(), starts, greedy=False, generator=environment.generator(0))
    assert torch.equal(rollouts.states, expected.states)
    assert environment.rows_at_once == 12

    def never(states, targets=None):
        raise torch.OutOfMemoryError("no memory at all")

    with pytest.raises(torch.OutOfMemoryError):
        roll_out(environment, never, starts)


def test_starts_at_the_target_and_empty_batches(arch: Assembly) -> None:
    environment = Environment(arch, 2, device="cpu")
    complete = environment.rules.complete(2)
    there = roll_out(environment, Indifferent(), complete, complete.clone())
    assert there.success.all()
    assert (there.length == 0).all()
    assert there.states.shape == (1, 2, arch.part_count)
    assert there.actions.shape == (0, 2)
    nothing = roll_out(environment, Indifferent(), complete[:0], keep="ends")
    assert nothing.states.shape == (2, 0, arch.part_count)
    assert environment.stable(complete[:0]).shape == (0,)


def test_drawn_actions_follow_the_probabilities_and_are_legal() -> None:
    generator = torch.Generator().manual_seed(0)
    logits = torch.log(torch.tensor([0.1, 0.2, 0.3, 0.4])).expand(60_000, 4)
    mask = torch.tensor([True, False, True, True]).expand(60_000, 4)
    drawn = choose_actions(logits, mask, greedy=False, generator=generator)
    share = torch.bincount(drawn, minlength=4) / len(drawn)
    assert torch.allclose(share, torch.tensor([0.125, 0.0, 0.375, 0.5]), atol=0.01)
    cold = choose_actions(logits, mask, greedy=False, temperature=1e-3, generator=generator)
    assert (cold == 3).all()
    for bad in (torch.nan, torch.inf, -torch.inf):
        assert choose_actions(torch.full((1, 4), bad), torch.tensor([[False, False, True, False]])).item() in (0, 2)
    assert choose_actions(torch.full((1, 4), torch.nan), torch.tensor([[False, False, True, False]])).item() == 2


def test_every_state_of_a_graph_is_proven_stable(shared_assembly) -> None:
    assembly = load_assembly(shared_assembly("bottle-12"))
    environment = Environment(assembly, 2, device="cpu")
    from falsework.search import BeamSearch, BeamSettings

    task = make_task(assembly)
    search = BeamSearch(task, environment.oracle, BeamSettings(width=8))
    search.run()
    graph = StateGraph.from_states(task, search.states())
    states = torch.from_numpy(graph.states)
    assert environment.stable(states).all()
    parents = states[torch.from_numpy(graph.source).long()]
    assert environment.stable(states[torch.from_numpy(graph.target).long()], parents).all()


@pytest.mark.parametrize("settings", [EQUILIBRIUM, StabilitySettings()], ids=lambda one: one.criterion)
def test_verdicts_under_contact_are_from_rest(arch: Assembly, settings: StabilitySettings) -> None:
    oracle: Any = Counting(arch, settings)
    environment = Environment(arch, 2, oracle=oracle, device="cpu")
    roll_out(environment, Indifferent(), environment.rules.complete(4))
    assert set(oracle.from_rest) == {settings.criterion == "contact"}


def test_bad_input_is_one_clear_line(arch: Assembly) -> None:
    environment = Environment(arch, 2, device="cpu")
    state = environment.rules.complete()
    with pytest.raises(InputError, match="temperature is 0"):
        roll_out(environment, Indifferent(), state, greedy=False, temperature=0.0)
    with pytest.raises(InputError, match="temperature is nan"):
        next(play(environment, Indifferent(), state, temperature=float("nan")))
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="0 CUDA devices were found"):
            Environment(arch, 2, device="cuda")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no GPU")
def test_rollouts_on_a_gpu_obey_rules_and_exact_solver(arch: Assembly) -> None:
    environment = Environment(arch, 2, oracle=StabilityOracle(arch, EQUILIBRIUM), device="cuda")

    def indifferent(states, targets=None):
        return torch.zeros(len(states), 2 * states.shape[1], device=states.device), torch.zeros(
            len(states), device=states.device
        )

    starts = environment.rules.complete(40)
    rollouts = roll_out(environment, indifferent, starts, greedy=False, generator=environment.generator(0))
    names = ("states", "actions", "length", "success", "unstable")
    check_rollouts(arch, Rollouts(*(getattr(rollouts, name).cpu() for name in names)))


def test_a_removal_that_needs_a_press_is_legal_where_robots_press() -> None:
    """Plates beside a wall: without the outer one, friction alone holds the inner one while the next is pressed."""
    corners = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    faces = [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4)]
    faces += [(2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
    plates = [TriangleMesh.from_arrays(f"plate-{k}", corners * [0.2, 1, 1] + [0.2 * k, 0, 0], faces) for k in range(3)]
    wall = TriangleMesh.from_arrays("wall", corners * [1, 3, 3] - [1, 1, 1], faces)
    assembly = Assembly.from_meshes([*plates, wall], boundary=[3], friction=0.5)
    states = torch.tensor([[1, 2, 2, 2], [2, 1, 2, 2]], dtype=torch.uint8)
    actions = torch.tensor([4 + 2, 4 + 2])  # the second leaves nothing on the outer plate that could press
    oracle = StabilityOracle(assembly)
    plain = Environment(assembly, oracle=oracle, device="cpu").step(states, actions)
    pressing = Environment(assembly, oracle=PressOracle(oracle), device="cpu").step(states, actions)
    assert plain.unstable.tolist() == [True, True]
    assert pressing.unstable.tolist() == [False, True]
    assert pressing.reward.tolist()[0] == 0.0

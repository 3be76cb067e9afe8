"""Proximal policy optimisation: its arithmetic by hand, a game whose answer is known, and what must never happen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from torch import Tensor  # noqa: E402

from falsework import Assembly, StabilityOracle, StateGraph, load_structure  # noqa: E402
from falsework.errors import InputError, TrainingError  # noqa: E402
from falsework.learn import (  # noqa: E402
    PPO,
    REINFORCEMENT,
    Curriculum,
    Environment,
    LearnerContext,
    Policy,
    PolicySettings,
    PpoPhase,
    collect_transitions,
    make_policy,
    masked_log_probabilities,
    roll_out,
)
from falsework.learn.algorithms.advantages import explained_variance, generalized_advantages, normalized  # noqa: E402
from falsework.learn.algorithms.ppo_loss import ppo_loss  # noqa: E402
from falsework.learn.algorithms.rollout_storage import Transitions  # noqa: E402
from falsework.learn.algorithms.start_states import MixedStarts, StartBatch  # noqa: E402
from falsework.learn.data.dataset import Dataset, DataSettings, build_dataset, training_task  # noqa: E402
from falsework.learn.data.random_walks import GoalSampler, RandomWalkGoals  # noqa: E402
from falsework.learn.data.solvable_states import SolvableStates  # noqa: E402

MLP = PolicySettings(kind="mlp", layers=2, channels=32)
RESIDUAL = PolicySettings(kind="resmlp", layers=2, channels=32)
SMALL = PpoPhase(rollouts=64, batch=64, learning_rate=2e-3)


@pytest.fixture(scope="module")
def stack() -> Environment:
    """Four blocks that lie on each other: there is one way to take them off."""
    return Environment(load_structure("stack:blocks=4"), 1, device="cpu")


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure("arch:blocks=9")


@pytest.fixture(scope="module")
def data(arch: Assembly) -> Dataset:
    return build_dataset(arch, training_task(arch), DataSettings(train_width=8, test_width=16), device="cpu")


SCRATCH = REINFORCEMENT.resolved("cpu")
"""Settings from scratch, with the sizes of a CPU."""


def learner(environment: Environment, settings: PpoPhase = SCRATCH, seed: int = 0, **options: Any) -> PPO:
    """From the complete structure, as the paper trains."""
    policy = options.pop("policy", None) or make_policy(environment.assembly, MLP, "cpu", seed)
    complete = Curriculum(environment.rules.complete(), environment.rules)
    return PPO(LearnerContext(environment, policy, complete, settings, seed=seed, **options))


def fine_tuner(arch: Assembly, data: Dataset, *, settings: PpoPhase = SMALL, seed: int = 0, **options: Any) -> PPO:
    """From mixed start states, as by default, with the test states held out."""
    environment = Environment(arch, 2, oracle=StabilityOracle(arch), device="cpu")
    solved = SolvableStates(environment.rules)
    solved.hold_out(torch.as_tensor(data.test))
    solved.add(torch.as_tensor(data.train))
    starts = MixedStarts(torch.as_tensor(data.train), solved, settings.rollouts)
    policy = make_policy(arch, RESIDUAL)
    return PPO(LearnerContext(environment, policy, starts, settings, solved=solved, seed=seed, **options))


@dataclass(frozen=True)
class Table:
    """Sampler of tasks of a table, without actions to imitate."""

    states: Tensor
    targets: Tensor

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        rows = torch.randint(len(self.states), (count,), generator=generator)
        valid = torch.zeros((count, 2 * self.states.shape[1]), dtype=torch.bool)
        return self.states[rows], self.targets[rows], valid


def with_targets(
    environment: Environment,
    starts: Tensor,
    targets: Tensor,
    settings: PpoPhase = SMALL,
    *,
    tasks: GoalSampler | None = None,
    solved: SolvableStates | None = None,
    begin: float = 0.0,
) -> PPO:
    solved = SolvableStates(environment.rules) if solved is None else solved
    policy = make_policy(environment.assembly, replace(RESIDUAL, goal_conditioned=True))
    tasks = Table(starts, targets) if tasks is None else tasks
    sampler = MixedStarts(starts, solved, settings.rollouts, tasks=tasks)
    return PPO(LearnerContext(environment, policy, sampler, settings, solved=solved, begin=begin))


def test_pairs_of_uncertain_success_come_first() -> None:
    """Of four pairs in a row one with a target of its own is the only one whose outcome is open."""
    starts, targets = torch.zeros((64, 3), dtype=torch.uint8), torch.zeros((64, 3), dtype=torch.uint8)
    targets[::4] = 1

    class Rows(Table):
        def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
            rows = torch.arange(count) % len(starts)
            return starts[rows], targets[rows], torch.zeros((count, 6), dtype=torch.bool)

    def value(states: Tensor, goals: Tensor) -> Tensor:
        return torch.where(goals[:, 0] == 1, 0.1, 1.0)

    solved: Any = None
    sampler = MixedStarts(starts, solved, 16, tasks=Rows(starts, targets), value=value)
    batch = sampler.sample(16, torch.Generator().manual_seed(0))
    assert batch.targets is not None
    assert batch.targets.shape == (16, 3)
    assert batch.targets.all()


def weights_of(ppo: PPO) -> list[Any]:
    return [weight.detach().clone() for weight in ppo.policy.parameters()]


def test_advantages_by_hand() -> None:
    """Rollout 0 takes three actions, rollout 1 one, rollout 2 none; discount 1/2, lambda 1/2."""
    rows = [torch.tensor([0, 1]), torch.tensor([0]), torch.tensor([0])]
    values = [torch.tensor([0.4, 0.2]), torch.tensor([0.6]), torch.tensor([0.8])]
    rewards = [torch.tensor([0.0, -1.0]), torch.tensor([0.0]), torch.tensor([1.0])]
    first, second, third = generalized_advantages(rows, values, rewards, 3, 0.5, 0.5)
    last = 1.0 - 0.8
    middle = 0.0 + 0.5 * 0.8 - 0.6 + 0.25 * last
    assert third.tolist() == pytest.approx([last])
    assert second.tolist() == pytest.approx([middle])
    assert first.tolist() == pytest.approx([0.0 + 0.5 * 0.6 - 0.4 + 0.25 * middle, -1.2])


def test_a_lambda_of_one_compares_with_the_discounted_outcome() -> None:
    """The sum of all differences telescopes: only the outcome and the estimate are left."""
    generator = torch.Generator().manual_seed(0)
    rows = [torch.arange(5), torch.tensor([0, 2, 4]), torch.tensor([2])]
    values = [torch.rand(len(active), generator=generator) for active in rows]
    rewards = [torch.tensor([0.0, -1.0, 0.0, 1.0, 0.0]), torch.tensor([1.0, 0.0, -1.0]), torch.tensor([1.0])]
    outcomes = [torch.tensor([0.9, -1.0, 0.81, 1.0, -0.9]), torch.tensor([1.0, 0.9, -1.0]), torch.tensor([1.0])]
    found = generalized_advantages(rows, values, rewards, 5, 0.9, 1.0)
    for value, outcome, advantage in zip(values, outcomes, found, strict=True):
        assert torch.allclose(advantage, outcome - value, atol=1e-6)


def test_normalized_advantages() -> None:
    """Deviation 1; mean 0 or the sign kept."""
    values = torch.tensor([1.0, 2.0, 3.0, 6.0])
    assert torch.allclose(normalized(values), values / values.std(correction=0), rtol=1e-5)
    assert normalized(torch.zeros(0)).tolist() == []


def transition(log_probability: float, advantage: float, mask: list[bool], returns: float = -0.5) -> Transitions:
    one = torch.ones(1)
    return Transitions(
        states=torch.zeros(1, 2, dtype=torch.uint8),
        targets=None,
        actions=torch.tensor([1]),
        mask=torch.tensor([mask]),
        log_probability=one * log_probability,
        advantage=one * advantage,
        returns=one * returns,
        rollout=torch.tensor([0]),
        success=torch.tensor([True]),
        total=one,
    )


@pytest.mark.parametrize(
    ("old", "advantage", "surrogate"),
    [(0.5, 2.0, -2.0), (0.25, 2.0, -2.4), (0.25, -2.0, 4.0), (0.8, -2.0, 1.6), (0.8, 2.0, -1.25)],
)
def test_loss_by_hand(old: float, advantage: float, surrogate: float) -> None:
    """Two legal actions of equal probability: the new one is 1/2; the ratio is clipped to 0.8 and 1.2."""
    logits = torch.zeros(1, 4, requires_grad=True)
    batch = transition(np.log(old), advantage, [False, True, True, False])
    one = torch.ones(1)
    loss = ppo_loss(logits, torch.tensor([0.75]), batch, weight=one, entropy_weight=0.01 * one)
    chance = 0.5 + 0.5 * 0.75
    error = -0.25 * np.log(chance) - 0.75 * np.log(1 - chance)
    assert loss.surrogate.item() == pytest.approx(surrogate, rel=1e-5)
    assert loss.total.item() == pytest.approx(surrogate + 0.5 * error - 0.01 * np.log(2), rel=1e-3)
    ratio = 0.5 / old
    divergence = ratio - 1 - np.log(ratio)
    expected = [surrogate, error, np.log(2), divergence, float(abs(ratio - 1) > 0.2)]
    assert loss.statistics.tolist() == pytest.approx(expected, rel=1e-3)
    loss.total.backward()
    assert logits.grad is not None
    assert logits.grad[0, [0, 3]].tolist() == [0.0, 0.0]
    assert logits.grad.isfinite().all()


def test_padding_counts_for_nothing() -> None:
    logits = torch.zeros(1, 4, requires_grad=True)
    zero = torch.zeros(1)
    batch = transition(-700.0, 1.0, [False] * 4)
    value = torch.tensor([0.75])
    loss = ppo_loss(logits, value, batch, weight=zero, entropy_weight=zero)
    loss.total.backward()
    assert loss.total.item() == 0.0
    assert loss.statistics.tolist() == [0.0] * 5
    assert logits.grad is not None
    assert (logits.grad == 0).all()


def test_every_transition_is_seen_once_an_epoch(stack: Environment) -> None:
    ppo = learner(stack, replace(SCRATCH, batch=7))
    for count in (1, 6, 7, 8, 50):
        pieces = ppo.minibatches(count)
        assert len({len(rows) for rows, _ in pieces}) == 1
        seen = torch.cat([rows[counts > 0] for rows, counts in pieces])
        assert sorted(seen.tolist()) == list(range(count))
    assert ppo.minibatches(0) == []


def test_minibatches_of_a_compiled_network_have_one_size(stack: Environment) -> None:
    """Those of the settings, filled evenly."""
    ppo = learner(stack, replace(SCRATCH, batch=7), compiled=True)
    for count, used in ((50, [7, 6]), (6, [6]), (8, [4])):
        pieces = ppo.minibatches(count)
        assert {len(rows) for rows, _ in pieces} == {7}
        assert {int(counts.sum()) for _, counts in pieces} == {*used}
        assert sorted(torch.cat([rows[counts > 0] for rows, counts in pieces]).tolist()) == list(range(count))


def test_a_game_with_one_answer_is_solved(stack: Environment) -> None:
    """From the complete stack, every action but one ends badly; the value is the discounted reward."""
    settings = replace(SCRATCH, batch=256, epochs=5, learning_rate=2e-3, discount=0.9, entropy_floor=0.0)
    ppo = learner(stack, settings)
    starts = StartBatch(stack.rules.complete(32), rows=torch.zeros(32, dtype=torch.int64))
    assert not roll_out(stack, ppo.policy, starts.states[:1]).success.all()
    reports = [ppo.update(starts) for _ in range(50)]
    rollouts = roll_out(stack, ppo.policy, starts.states[:1])
    assert rollouts.success.all()
    order = [action - 5 for action in rollouts.actions[:, 0].tolist() if action >= 5]
    heights = [stack.assembly.meshes[part].bounds[1][2] for part in order]
    assert heights == sorted(heights, reverse=True)
    assert reports[-1]["rollout_success"] > 0.9 > reports[0]["rollout_success"]
    with torch.no_grad():
        values = ppo.policy(rollouts.states[:-1, 0])[1]
    assert torch.allclose(values, 0.9 ** torch.arange(7, -1, -1.0), atol=0.15)
    assert ppo.updates == 50


def test_targets_are_learned_too(stack: Environment) -> None:
    """Take off the first two blocks, hold the third: no other action is even legal in the end."""
    starts = stack.rules.complete(32)
    order = np.argsort([-mesh.bounds[1][2] for mesh in stack.assembly.meshes])
    targets = starts.clone()
    targets[:, order[:2].tolist()] = 0
    targets[::2, int(order[2])] = 2
    ppo = with_targets(stack, starts, targets, replace(SCRATCH, batch=256))
    for _ in range(30):
        report = ppo.update(StartBatch(starts, targets))
    assert report["rollout_success"] > 0.9
    assert roll_out(stack, ppo.policy, starts[:2], targets[:2]).success.all()


def collect(environment: Environment, policy: Policy, starts: Tensor, targets: Tensor | None = None) -> Transitions:
    options = {"discount": 1.0, "gae_lambda": 0.9}
    return collect_transitions(environment, policy, starts, targets, environment.generator(1), **options)


def test_every_action_of_every_rollout_is_stored(arch: Assembly, data: Dataset) -> None:
    """One row an action; those of a successful rollout are as many as steps to the end, and all are legal."""
    environment = Environment(arch, 2, oracle=StabilityOracle(arch), device="cpu")
    starts = torch.as_tensor(data.train)
    played = collect(environment, make_policy(arch, RESIDUAL), starts)
    assert played.success.any()
    assert not played.success.all()
    taken = torch.bincount(played.rollout, minlength=len(starts))
    left = environment.rules.steps_left(starts)
    assert torch.equal(taken[played.success], left[played.success])
    assert bool(played.mask.gather(1, played.actions[:, None]).all())
    assert bool((played.returns.abs() <= 1).all())


def test_rollouts_that_cannot_begin_have_no_transitions(arch: Assembly, data: Dataset) -> None:
    """From the empty structure nothing is left to do, which is success; an update with nothing changes no weight."""
    ppo = fine_tuner(arch, data, settings=replace(SMALL, imitation=0.0))
    empty = ppo.environment.rules.goals(torch.as_tensor(data.train[:3]))
    played = collect(ppo.environment, ppo.policy, empty)
    assert len(played) == 0
    assert played.success.all()
    before = weights_of(ppo)
    ppo.update(StartBatch(empty))
    for one, two in zip(before, weights_of(ppo), strict=True):
        assert torch.equal(one, two)


def test_rollouts_make_a_policy_better(arch: Assembly, data: Dataset) -> None:
    """From random weights, without any imitation, on states that were never started from."""
    ppo = fine_tuner(arch, data, settings=replace(SMALL, imitation=0.0))
    environment = Environment(arch, 2, oracle=StabilityOracle(arch), device="cpu")

    def greedy(policy: Policy) -> float:
        return float(roll_out(environment, policy, torch.as_tensor(data.test), keep="ends").success.float().mean())

    before = greedy(make_policy(arch, RESIDUAL))
    for block in range(12):
        ppo.block(10, (block / 12, (block + 1) / 12))
    after = greedy(ppo.export_policy(make_policy(arch, RESIDUAL)))
    assert after > max(before, 0.8), f"{before:.2f} before, {after:.2f} after"


def test_a_target_one_action_away_is_learned(arch: Assembly) -> None:
    """Whatever the target keeps."""
    environment = Environment(arch, 2, oracle=StabilityOracle(arch), device="cpu")
    complete = environment.rules.complete()
    actions = environment.rules.moves(complete).nonzero()[:, 1]
    starts = complete.expand(len(actions), -1).contiguous()
    ppo = with_targets(environment, starts, environment.rules.follow(starts, actions))
    assert ppo.block(60, (0.0, 1.0))["rollout_success"] > 0.9


def test_after_imitation_the_first_rollouts_reinforce_success(arch: Assembly) -> None:
    """The value head says then that all ends well, and all advantages would be negative."""
    environment = Environment(arch, 2, oracle=StabilityOracle(arch), device="cpu")
    starts = environment.rules.complete(32)
    actions = environment.rules.moves(starts[:1]).nonzero()[:, 1]
    targets = environment.rules.follow(starts[: len(actions)], actions).repeat(32, 1)[:32]
    surrogate = {}
    for begin in (0.0, 0.5):
        ppo = with_targets(environment, starts, targets, begin=begin)
        torch.nn.init.constant_(dict(ppo.policy.named_parameters())["value_head.bias"], 10.0)
        surrogate[begin] = ppo.update(StartBatch(starts, targets))["surrogate_loss"]
    assert surrogate[0.5] < 0.0 <= surrogate[0.0]


def test_tasks_are_drawn_anew(bottle: Assembly, bottle_graph: StateGraph) -> None:
    """With a source of tasks hardly any start comes twice."""
    environment = Environment(bottle, 2, oracle=StabilityOracle(bottle), device="cpu")
    ways = RandomWalkGoals(bottle_graph, device=environment.device)
    states, targets, _ = ways.draw(1, environment.generator(7))
    ppo = with_targets(environment, states, targets, tasks=ways)
    batch = ppo.sampler.sample(64, ppo.generator)
    assert batch.targets is not None
    assert len(torch.unique(torch.cat([batch.states, batch.targets], dim=1), dim=0)) > 0.9 * 64


def test_no_loss_is_taken_at_held_out_states(arch: Assembly, data: Dataset) -> None:
    """Neither by gradients of rollouts nor by imitation, although rollouts come across them."""
    ppo = fine_tuner(arch, data)
    seen = recorded(ppo)
    ppo.block(20, (0.0, 0.5))
    assert ppo.solved.is_held_out(collect(ppo.environment, ppo.policy, torch.as_tensor(data.train)).states).any()
    assert seen
    assert not ppo.solved.is_held_out(torch.cat(seen)).any()
    assert not ppo.solved.is_held_out(ppo.solved.states).any()


def recorded(ppo: PPO) -> list[Tensor]:
    """States, and targets if there are any, that a loss is taken at from now on."""
    seen: list[Tensor] = []
    network: Callable[..., Any] = ppo.network

    def record(states: Tensor, targets: Tensor | None = None) -> Any:
        seen.extend([states] if targets is None else [states, targets])
        return network(states, targets)

    ppo.network = record  # type: ignore[assignment]
    return seen


def test_hindsight_keeps_held_out_states_out(arch: Assembly) -> None:
    """As starts and as goals, of rollouts that pass them again and again."""
    environment = Environment(arch, 2, oracle=StabilityOracle(arch), device="cpu")
    solved = SolvableStates(environment.rules)
    starts = environment.rules.complete(64)
    targets = environment.rules.goals(starts)
    ppo = with_targets(environment, starts, targets, solved=solved)
    states = collect(environment, ppo.policy, starts, targets).states.unique(dim=0)
    solved.hold_out(states[~(states == starts[0]).all(dim=1)][::2])
    seen = recorded(ppo)
    for _ in range(8):
        ppo.block(1, (0.0, 0.1))
    assert solved.is_held_out(collect(environment, ppo.policy, starts, targets).states).any()
    local = ppo.local_state_dict()
    assert len(local["starts.passed"]) > 20
    for name in ("starts.passed", "starts.passed_targets"):
        assert not solved.is_held_out(local[name]).any()
    assert not solved.is_held_out(torch.cat(seen)).any()


@pytest.mark.parametrize("default", [True, False])
def test_saved_learning_goes_on_the_same(stack: Environment, arch: Assembly, data: Dataset, default: bool) -> None:
    """Saved between two blocks and loaded by another learner, it goes on as if nothing had happened."""

    def make(seed: int) -> PPO:
        return fine_tuner(arch, data, seed=seed) if default else learner(stack, replace(SCRATCH, rollouts=16), seed)

    whole, first, second = make(3), make(3), make(5)
    whole.block(6, (0.0, 0.5))
    first.block(6, (0.0, 0.5))
    second.solved.load(first.solved.tensors())
    saved = [{name: one.clone() for name, one in part().items()} for part in (first.state_dict, first.local_state_dict)]
    second.load_state_dict(saved[0], saved[1])
    reports = [one.block(6, (0.5, 1.0)) for one in (whole, second)]
    assert reports[0] == reports[1]
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, second.state_dict()[name]), name
    assert second.updates == whole.updates


def test_explained_variance() -> None:
    """By numpy; 1 for a perfect estimate, 0 for the mean, and less for a worse one."""
    returns = torch.tensor([0.0, 1.0, 1.0, 0.5])
    estimate = torch.tensor([0.1, 0.7, 0.9, 0.2])
    expected = 1 - np.var((returns - estimate).numpy()) / np.var(returns.numpy())
    assert explained_variance(returns - estimate, returns) == pytest.approx(expected)
    assert explained_variance(torch.zeros(4), returns) == pytest.approx(1.0)
    assert explained_variance(returns - returns.mean(), returns) == pytest.approx(0.0, abs=1e-6)
    assert explained_variance(2 * returns, returns) < 0
    assert explained_variance(estimate, torch.ones(4)) == 0.0


def test_the_weight_of_the_entropy_rises_below_its_floor(stack: Environment) -> None:
    """Up to a limit, less late in the phase, and it is part of the checkpoint."""
    ppo = learner(stack, replace(SCRATCH, batch=64, entropy_floor=10.0))
    for _ in range(9):
        ppo.update(ppo.sampler.sample(4, ppo.generator), progress=0.5)
    assert ppo.entropy_factor == 20.0
    other = learner(stack, replace(SCRATCH, batch=64, entropy_floor=10.0))
    other.load_state_dict(ppo.state_dict(), ppo.local_state_dict())
    assert other.entropy_factor == 20.0
    other.update(other.sampler.sample(4, other.generator), progress=1.0)
    assert other.entropy_factor == pytest.approx(20.0 / 1.5)  # the floor has fallen to zero
    free = learner(stack, replace(SCRATCH, batch=64, entropy_floor=0.0))
    free.update(free.sampler.sample(4, free.generator))
    assert free.entropy_factor == 1.0


def test_learning_rate(stack: Environment) -> None:
    """Linearly to a tenth over the phase."""
    ppo = learner(stack, replace(SCRATCH, learning_rate=1e-3), begin=0.5)
    assert [ppo.learning_rate(place) for place in (0.2, 0.5, 0.75, 1.0)] == pytest.approx([1e-3, 1e-3, 5.5e-4, 1e-4])


def break_value(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Let values be no numbers where a gradient is asked for, from some call on."""
    from falsework.learn.networks.autocast import Network

    whole, calls = Network.forward, 0

    def broken(self: Any, states: Any, targets: Any = None) -> Any:
        nonlocal calls
        logits, value = whole(self, states, targets)
        calls += torch.is_grad_enabled()
        return (logits, value * torch.nan) if torch.is_grad_enabled() and calls > after else (logits, value)

    monkeypatch.setattr(Network, "forward", broken)


@pytest.mark.parametrize("default", [True, False])
def test_a_step_that_is_not_finite_is_left_out(
    stack: Environment, arch: Assembly, data: Dataset, default: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the middle of training, by the default settings and by those of the paper."""
    settings = replace(SCRATCH, batch=16, rollouts=16, learning_rate=1e-3)
    ppo = fine_tuner(arch, data) if default else learner(stack, settings)
    ppo.block(3, (0.0, 0.1))
    taken, before = ppo.steps, weights_of(ppo)
    break_value(monkeypatch, 0)
    with pytest.raises(TrainingError, match=f"not a finite number at step {taken + 1}; continue from the last"):
        ppo.block(20, (0.1, 0.2))
    for one, two in zip(before, weights_of(ppo), strict=True):
        assert torch.equal(one, two)


def test_illegal_actions_have_probability_zero_in_every_rollout(stack: Environment) -> None:
    ppo = learner(stack)
    ppo.update(ppo.sampler.sample(32, ppo.generator))
    played = collect(stack, ppo.policy, stack.rules.complete(32))
    assert played.mask.gather(1, played.actions[:, None]).all()
    logits, _ = ppo.policy(played.states)
    assert (masked_log_probabilities(logits, played.mask).exp()[~played.mask] == 0).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (lambda: PpoPhase(batch=-1), "sizes and learning rate of PPO are not negative"),
        (lambda: PpoPhase(rollouts=-1), "sizes and learning rate of PPO are not negative"),
        (lambda: PpoPhase(learning_rate=-1.0), "sizes and learning rate of PPO are not negative"),
        (lambda: PpoPhase(epochs=0), "epochs is 0"),
        (lambda: PpoPhase(discount=1.5), "discount is 1.5; give a number between 0 and 1"),
        (lambda: PpoPhase(gae_lambda=1.5), "gae_lambda is 1.5"),
        (lambda: PpoPhase(average=1.0), "average is 1; give 0 or more"),
        (lambda: PpoPhase(starts="middle"), "unknown starts 'middle'; choose mixed, curriculum, complete"),  # type: ignore[arg-type]
    ],
)
def test_settings_out_of_range(settings: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings()

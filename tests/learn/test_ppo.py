"""Reinforcement learning: its arithmetic by hand, a game whose answer is known, and what must never happen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from safetensors.torch import load_file  # noqa: E402

from falsework.assembly import load_structure  # noqa: E402
from falsework.errors import InputError, TrainingError  # noqa: E402
from falsework.learn.algorithms.nan_guard import NanGuard  # noqa: E402
from falsework.learn.algorithms.ppo import PPO, Batch, ppo_loss  # noqa: E402
from falsework.learn.algorithms.rollout_storage import Storage  # noqa: E402
from falsework.learn.config.policy import PolicySettings  # noqa: E402
from falsework.learn.config.ppo import CurriculumSettings, PpoSettings  # noqa: E402
from falsework.learn.env.environment import Environment, Step  # noqa: E402
from falsework.learn.env.rollout import Move, roll_out  # noqa: E402
from falsework.learn.networks.factory import make_policy  # noqa: E402
from falsework.learn.networks.policy import masked_log_probabilities  # noqa: E402

MLP = PolicySettings(kind="mlp", layers=2, channels=32)


@pytest.fixture(scope="module")
def stack() -> Environment:
    """Four blocks that lie on each other: there is one way to take them off."""
    return Environment(load_structure("stack:blocks=4"), 1, device="cpu")


def learner(environment: Environment, settings: PpoSettings = PpoSettings(), seed: int = 0, **options) -> PPO:
    policy = make_policy(environment.assembly, MLP, "cpu", seed)
    return PPO(policy, environment, settings, environment.generator(seed), **options)


def weights_of(ppo: PPO) -> list[Any]:
    return [weight.detach().clone() for weight in ppo.policy.parameters()]


def write(storage: Storage, rows: list[int], value: list[float], reward: list[float], done: list[bool]) -> None:
    count, parts = len(rows), storage.states.shape[2]
    states = torch.zeros(count, parts, dtype=torch.uint8)
    mask = torch.zeros(count, 2 * parts, dtype=torch.bool)
    zeros = torch.zeros(count)
    ended = torch.tensor(done)
    step = Step(states, torch.tensor(reward), ended, ended, ended, mask)
    move = Move(torch.tensor(rows), states, None, mask, zeros, torch.tensor(value), zeros.long(), step)
    storage.write(move, zeros)


def test_advantages_by_hand() -> None:
    """Rollout 0 takes three actions, rollout 1 one, rollout 2 none; discount 1/2, trace 1/2."""
    storage = Storage(5, 3, 2, torch.device("cpu"))
    for _ in range(2):  # the second time over what the first left behind
        storage.clear(torch.tensor([False, False, True]), None)
        write(storage, [0, 1], [0.4, 0.2], [0.0, -1.0], [False, True])
        write(storage, [0], [0.6], [0.0], [False])
        write(storage, [0], [0.8], [1.0], [True])
        advantage, returns = storage.returns(0.5, 0.5)
    last = 1.0 - 0.8
    middle = 0.0 + 0.5 * 0.8 - 0.6 + 0.25 * last
    first = 0.0 + 0.5 * 0.6 - 0.4 + 0.25 * middle
    expected = torch.tensor([[first, -1.2, 0.0], [middle, 0.0, 0.0], [last, 0.0, 0.0]])
    assert torch.allclose(advantage, expected)
    values = torch.tensor([[0.4, 0.2, 0.0], [0.6, 0.0, 0.0], [0.8, 0.0, 0.0]])
    assert torch.allclose(returns, expected + values)
    place, rollout = storage.pairs()
    assert place.tolist() == [0, 1, 3, 6]
    assert rollout.tolist() == [0, 1, 0, 0]
    assert storage.success.tolist() == [True, True, True]


def test_with_full_trace_returns_are_the_discounted_rewards() -> None:
    storage = Storage(6, 1, 2, torch.device("cpu"))
    storage.clear(torch.tensor([False]), None)
    rng = np.random.default_rng(0)
    for step in range(6):
        write(storage, [0], [float(rng.normal())], [1.0 if step == 5 else 0.0], [step == 5])
    _, returns = storage.returns(0.9, 1.0)
    assert torch.allclose(returns[:, 0], torch.tensor([0.9**k for k in range(5, -1, -1)]))


def make_batch(log_probability: float, advantage: float, mask: list[bool], weight: float = 1.0) -> Batch:
    one = torch.ones(1)
    return Batch(
        states=torch.zeros(1, 2, dtype=torch.uint8),
        mask=torch.tensor([mask]),
        actions=torch.tensor([1]),
        log_probability=one * log_probability,
        advantage=one * advantage,
        returns=one * 0.25,
        weight=one * weight,
        entropy=one * 0.01,
        rollout=torch.tensor([0]),
        targets=None,
    )


@pytest.mark.parametrize(
    ("old", "advantage", "surrogate"),
    [(0.5, 2.0, -2.0), (0.25, 2.0, -2.4), (0.25, -2.0, 4.0), (0.8, -2.0, 1.6), (0.8, 2.0, -1.25)],
)
def test_loss_by_hand(old: float, advantage: float, surrogate: float) -> None:
    """Two legal actions of equal probability: the new one is 1/2; the ratio is clipped to 0.8 and 1.2."""
    logits = torch.zeros(1, 4, requires_grad=True)
    batch = make_batch(np.log(old), advantage, [False, True, True, False])
    loss = ppo_loss(logits, torch.tensor([0.75]), batch, 0.2, 0.5)
    assert loss.surrogate.item() == pytest.approx(surrogate, rel=1e-5)
    assert loss.total.item() == pytest.approx(surrogate + 0.5 * 0.25 - 0.01 * np.log(2), rel=1e-5)
    ratio = 0.5 / old
    divergence = ratio - 1 - np.log(ratio)
    expected = [surrogate, 0.25, np.log(2), divergence, float(abs(ratio - 1) > 0.2)]
    assert loss.statistics.tolist() == pytest.approx(expected, rel=1e-5)
    loss.total.backward()
    assert logits.grad is not None
    assert logits.grad[0, [0, 3]].tolist() == [0.0, 0.0]
    assert logits.grad.isfinite().all()


def test_padding_counts_for_nothing() -> None:
    logits = torch.zeros(1, 4, requires_grad=True)
    loss = ppo_loss(logits, torch.tensor([0.75]), make_batch(-700.0, 1.0, [False] * 4, weight=0.0), 0.2, 0.5)
    loss.total.backward()
    assert loss.total.item() == 0.0
    assert loss.statistics.tolist() == [0.0] * 5
    assert logits.grad is not None
    assert (logits.grad == 0).all()


def test_every_pair_is_seen_once_an_epoch(stack: Environment) -> None:
    ppo = learner(stack, PpoSettings(batch=7))
    for pairs in (1, 6, 7, 8, 50):
        pieces = list(ppo._minibatches(pairs))
        assert len({len(rows) for rows, _ in pieces}) == 1
        seen = torch.cat([rows[counts > 0] for rows, counts in pieces])
        assert sorted(seen.tolist()) == list(range(pairs))
    assert list(ppo._minibatches(0)) == []


def test_a_game_with_one_answer_is_solved(stack: Environment) -> None:
    """From the complete stack, every action but one ends badly; the value is the discounted reward."""
    settings = PpoSettings(batch=256, discount=0.9, curriculum=CurriculumSettings(entropy=0.01))
    ppo = learner(stack, settings)
    complete = stack.rules.complete(32)
    assert not roll_out(stack, ppo.policy, complete[:1]).success.all()
    reports = [ppo.update(complete) for _ in range(50)]
    rollouts = roll_out(stack, ppo.policy, complete[:1])
    assert rollouts.success.all()
    order = [action - 5 for action in rollouts.actions[:, 0].tolist() if action >= 5]
    heights = [stack.assembly.meshes[part].bounds[1][2] for part in order]
    assert heights == sorted(heights, reverse=True)
    assert reports[-1]["success"] > 0.9 > reports[0]["success"]
    with torch.no_grad():
        values = ppo.policy(rollouts.states[:-1, 0])[1]
    assert torch.allclose(values, 0.9 ** torch.arange(7, -1, -1.0), atol=0.15)
    assert ppo.updates == 50


def test_targets_are_learned_too(stack: Environment) -> None:
    """Take off the first two blocks, hold the third: no other action is even legal in the end."""
    policy = make_policy(stack.assembly, PolicySettings(kind="mlp", two_states=True, layers=2, channels=32), "cpu", 0)
    ppo = PPO(policy, stack, PpoSettings(batch=256), stack.generator(0))
    starts = stack.rules.complete(32)
    order = np.argsort([-mesh.bounds[1][2] for mesh in stack.assembly.meshes])
    targets = starts.clone()
    targets[:, order[:2].tolist()] = 0
    targets[::2, int(order[2])] = 2
    for _ in range(30):
        report = ppo.update(starts, targets)
    assert report["success"] > 0.9
    assert roll_out(stack, policy, starts[:2], targets[:2]).success.all()


def test_in_hindsight_failed_rollouts_teach_how_to_get_where_they_came() -> None:
    """Their samples are legal steps of their new tasks, and become more probable than without them."""
    arch = Environment(load_structure("arch:blocks=5"), 2, device="cpu")
    starts = arch.rules.complete(32)
    targets = arch.rules.goals(starts)
    gained = []
    for weight in (0.0, 5.0):
        policy = make_policy(
            arch.assembly, PolicySettings(kind="mlp", two_states=True, layers=2, channels=32), "cpu", 0
        )
        ppo = PPO(policy, arch, PpoSettings(batch=64, hindsight=weight or 1e-9), arch.generator(0))
        samples = ppo._hindsight(ppo._play(starts, targets))
        assert samples is not None
        states, aims, actions = samples
        mask = arch.rules.moves(states, aims)
        assert mask.gather(1, actions[:, None]).all()
        assert arch.rules.contains(states, aims).all()
        assert arch.stable(aims).all()

        def likelihood(policy=policy, states=states, aims=aims, actions=actions, mask=mask) -> float:
            with torch.no_grad():
                logits, _ = policy(states, aims)
            return float(masked_log_probabilities(logits, mask).gather(1, actions[:, None]).mean())

        before = likelihood()
        for _ in range(3):
            ppo.update(starts, targets)
        gained.append(likelihood() - before)
    assert gained[1] > gained[0]


def test_same_seed_same_weights_and_saved_learning_goes_on_the_same(stack: Environment) -> None:
    starts = stack.rules.complete(16)
    one, two = learner(stack, seed=3), learner(stack, seed=3)
    for ppo in (one, two):
        ppo.update(starts)
    tensors, own = one.tensors(), one.own_tensors()
    tensors = {name: tensor.clone() for name, tensor in tensors.items()}
    own = {name: tensor.clone() for name, tensor in own.items()}
    later = [one.update(starts) for _ in range(2)]
    again = learner(stack, seed=4)
    again.load(tensors, own)
    assert [again.update(starts) for _ in range(2)] == later
    for first, second in zip(weights_of(one), weights_of(again), strict=True):
        assert torch.equal(first, second)
    assert again.updates == 3


def test_learning_rate_falls_at_milestones(stack: Environment) -> None:
    ppo = learner(stack, PpoSettings(learning_rate=1e-3, milestones=(2, 4)))
    rates = []
    for updates in range(5):
        ppo.updates = updates
        rates.append(ppo.learning_rate)
    assert rates == pytest.approx([1e-3, 1e-3, 1e-4, 1e-4, 1e-5])
    ppo.updates, ppo.rate = 0, 0.5
    assert ppo.learning_rate == pytest.approx(5e-4)


def test_an_update_ends_early_once_the_policy_has_moved_far(stack: Environment) -> None:
    starts = stack.rules.complete(16)
    counts = []
    for limit in (0.0, 1e-9):
        ppo = learner(stack, PpoSettings(batch=10_000, target_divergence=limit, epochs=4))
        ppo.update(starts)
        states = ppo.tensors()
        counts.append(int(states["optimizer.0.step"]))
    assert counts[0] == 4
    assert counts[1] < 4


class Broken(torch.nn.Module):
    """A policy whose answer is not a number where its weight is used."""

    def __init__(self, parts: int) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))
        self.parts = parts

    def forward(self, states, targets=None):
        logits = torch.zeros(len(states), 2 * self.parts) * self.weight
        broken = torch.log(self.weight - 2.0) if torch.is_grad_enabled() else self.weight
        return logits, broken.expand(len(states))


def test_a_loss_that_is_not_finite_is_caught_with_its_batch(stack: Environment, tmp_path: Path) -> None:
    policy = Broken(stack.part_count)
    ppo = PPO(policy, stack, PpoSettings(batch=8), stack.generator(0), folder=tmp_path)
    with pytest.raises(TrainingError, match="not a finite number at update 1 epoch 1 step 1; the batch") as caught:
        ppo.update(stack.rules.complete(8))
    assert policy.weight.item() == 1.0
    path = tmp_path / "not-finite-update-1-epoch-1-step-1.safetensors"
    assert str(path) in str(caught.value)
    batch = load_file(path)
    assert batch["states"].shape[1] == stack.part_count
    assert len(batch["states"]) == len(batch["advantage"]) > 0
    assert list(tmp_path.iterdir()) == [path]


def test_the_guard_names_the_step_that_failed_even_where_nothing_can_be_written(tmp_path: Path) -> None:
    guard = NanGuard(tmp_path / "nowhere")
    batch = {"states": torch.zeros(1)}
    guard.watch(torch.tensor(1.0), batch, "step 1")
    guard.watch(torch.tensor(torch.inf), batch, "step 2")
    with pytest.raises(TrainingError, match=r"at step 2 \(its batch could not be saved: cannot write"):
        guard.watch(torch.tensor(1.0), batch, "step 3")
    guard.check()
    silent = NanGuard()
    silent.watch(torch.tensor(torch.nan), batch, "step 9")
    with pytest.raises(TrainingError, match="at step 9; go on from the last checkpoint"):
        silent.check()


def test_illegal_actions_have_probability_zero_in_every_rollout(stack: Environment) -> None:
    ppo = learner(stack)
    ppo.update(stack.rules.complete(32))
    storage = ppo._storage
    assert storage is not None
    place, _ = storage.pairs()
    mask = storage.mask.flatten(0, 1)[place]
    assert mask.gather(1, storage.actions.flatten()[place][:, None]).all()
    logits, _ = ppo.policy(storage.states.flatten(0, 1)[place])
    assert (masked_log_probabilities(logits, mask).exp()[~mask] == 0).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (lambda: PpoSettings(batch=0), "batch and epochs are counts"),
        (lambda: PpoSettings(learning_rate=0.0), "learning_rate is 0"),
        (lambda: PpoSettings(discount=1.5), "discount is 1.5; give a number between 0 and 1"),
        (lambda: PpoSettings(clip=0.0), "clip and gradient_norm are above zero"),
        (lambda: CurriculumSettings(pass_mark=0.0), "pass_mark is 0"),
        (lambda: CurriculumSettings(stages=0), "stages and corrected_after are counts"),
        (lambda: CurriculumSettings(entropy=-1.0), "entropy is -1; give 0 or more"),
    ],
)
def test_settings_out_of_range(settings, message: str) -> None:
    with pytest.raises(InputError, match=message):
        settings()

"""Refinement: advantages by hand, what may be learned from, and that rollouts make a policy better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework.assembly import Assembly, load_structure  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn.algorithms.imitation import imitation_loss  # noqa: E402
from falsework.learn.algorithms.policy_gradient import Refinement  # noqa: E402
from falsework.learn.algorithms.transitions import advantages, hindsight, play_and_judge  # noqa: E402
from falsework.learn.config.policy import PolicySettings  # noqa: E402
from falsework.learn.config.policy_gradient import RefineSettings  # noqa: E402
from falsework.learn.data.dataset import Dataset, DataSettings, build_dataset, task_for  # noqa: E402
from falsework.learn.data.random_walks import Ways  # noqa: E402
from falsework.learn.data.solvable_states import SolvedStates  # noqa: E402
from falsework.learn.env.environment import Environment  # noqa: E402
from falsework.learn.env.rollout import roll_out  # noqa: E402
from falsework.learn.networks.factory import make_policy  # noqa: E402
from falsework.learn.networks.policy import Policy  # noqa: E402
from falsework.search import StateGraph  # noqa: E402
from falsework.stability import Stability  # noqa: E402

SMALL = RefineSettings(rollouts=64, batch=64, learning_rate=2e-3)


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure("arch:blocks=9")


@pytest.fixture(scope="module")
def data(arch: Assembly) -> Dataset:
    return build_dataset(arch, task_for(arch), DataSettings(train_width=8, test_width=16), device="cpu")


def policy_for(arch: Assembly) -> Policy:
    return make_policy(arch, PolicySettings(kind="residual", channels=32, layers=2))


def learner(arch: Assembly, data: Dataset, *, settings: RefineSettings = SMALL, seed: int = 0) -> Refinement:
    environment = Environment(arch, 2, oracle=Stability(arch), device="cpu")
    solved = SolvedStates(environment.rules)
    solved.forbid(torch.as_tensor(data.test))
    solved.add(torch.as_tensor(data.train))
    return Refinement(environment, policy_for(arch), solved, torch.as_tensor(data.train), settings, seed=seed)


def test_advantages_by_hand() -> None:
    """Two rollouts: one of two steps that succeeds, one of a single step that fails."""
    rows = [torch.tensor([0, 1]), torch.tensor([0])]
    chances = [torch.tensor([0.5, 0.25]), torch.tensor([0.75])]
    first, second = advantages(rows, chances, torch.tensor([True, False]), 0.5)
    assert second.tolist() == pytest.approx([1.0 - 0.75])
    assert first.tolist() == pytest.approx([(0.75 - 0.5) + 0.5 * 0.25, -0.25])


def test_a_trace_of_one_compares_with_the_end() -> None:
    """The sum of all differences telescopes: only the end and the estimate are left."""
    generator = torch.Generator().manual_seed(0)
    rows = [torch.arange(5), torch.tensor([0, 2, 4]), torch.tensor([2])]
    chances = [torch.rand(len(going), generator=generator) for going in rows]
    success = torch.tensor([True, False, True, True, False])
    for going, chance, advantage in zip(rows, chances, advantages(rows, chances, success, 1.0), strict=True):
        assert torch.allclose(advantage, success[going].float() - chance, atol=1e-6)


def test_every_action_of_every_rollout_is_there(arch: Assembly, data: Dataset) -> None:
    """One row an action; those of a successful rollout are as many as steps to the end, and lead there."""
    environment = Environment(arch, 2, oracle=Stability(arch), device="cpu")
    starts = torch.as_tensor(data.train)
    moves = play_and_judge(environment, policy_for(arch), starts, None, 0.9, environment.generator(1))
    assert moves.success.any()
    assert not moves.success.all()
    taken = torch.bincount(moves.rollout, minlength=len(starts))
    left = environment.rules.steps_left(starts)
    assert torch.equal(taken[moves.success], left[moves.success])
    assert bool(moves.mask.gather(1, moves.actions[:, None]).all())
    assert bool(((moves.chance >= 0) & (moves.chance <= 1)).all())


def test_rollouts_that_cannot_begin_are_no_moves(arch: Assembly, data: Dataset) -> None:
    """From the empty structure nothing is left to do, which is success."""
    environment = Environment(arch, 2, oracle=Stability(arch), device="cpu")
    empty = environment.rules.goals(torch.as_tensor(data.train[:3]))
    moves = play_and_judge(environment, policy_for(arch), empty, None, 0.9, environment.generator(1))
    assert len(moves) == 0
    assert moves.success.all()


def greedy(arch: Assembly, policy: Policy, states: np.ndarray) -> float:
    environment = Environment(arch, 2, oracle=Stability(arch), device="cpu")
    return float(roll_out(environment, policy, torch.as_tensor(states), keep="ends").success.float().mean())


def test_rollouts_make_a_policy_better(arch: Assembly, data: Dataset) -> None:
    """From random weights, without any imitation, on states that were never started from."""
    refinement = learner(arch, data, settings=RefineSettings(rollouts=64, batch=64, learning_rate=2e-3, imitation=0.0))
    before = greedy(arch, policy_for(arch), data.test)
    for block in range(12):
        refinement.block(10, (block / 12, (block + 1) / 12))
    after = greedy(arch, refinement.best(policy_for(arch)), data.test)
    assert after > max(before, 0.8), f"{before:.2f} before, {after:.2f} after"


def test_nothing_is_learned_at_test_states(arch: Assembly, data: Dataset) -> None:
    """Rollouts come across them, but neither imitation nor the gradient ever sees them."""
    refinement = learner(arch, data)
    seen = []
    network = refinement._network

    def watched(states, targets=None):
        seen.append(states)
        return network(states, targets)

    refinement._network = watched  # type: ignore[assignment]
    refinement.block(20, (0.0, 0.5))
    assert seen
    assert not refinement._solved.is_forbidden(torch.cat(seen)).any()
    assert not refinement._solved.is_forbidden(refinement._solved.states).any()


def test_two_pieces_are_one_run(arch: Assembly, data: Dataset) -> None:
    """Saved between two blocks and loaded by another learner, it goes on as if nothing had happened."""
    whole, first, second = learner(arch, data), learner(arch, data), learner(arch, data, seed=5)
    whole.block(6, (0.0, 0.5))
    first.block(6, (0.0, 0.5))
    second._solved.load(first._solved.tensors())
    second.load(
        {name: tensor.clone() for name, tensor in first.tensors().items()},
        {name: tensor.clone() for name, tensor in first.own_tensors().items()},
    )
    for one in (whole, second):
        one.block(6, (0.5, 1.0))
    for name, tensor in whole.tensors().items():
        assert torch.equal(tensor, second.tensors()[name]), name


def test_with_targets(arch: Assembly) -> None:
    """A start that is one action away from its target is learned, whatever the target keeps."""
    environment = Environment(arch, 2, oracle=Stability(arch), device="cpu")
    complete = environment.rules.complete()
    actions = environment.rules.moves(complete).nonzero()[:, 1]
    targets = environment.rules.follow(complete.expand(len(actions), -1).contiguous(), actions)
    policy = make_policy(arch, PolicySettings(kind="residual", channels=32, layers=2, two_states=True))
    refinement = Refinement(
        environment,
        policy,
        SolvedStates(environment.rules),
        complete.expand(len(actions), -1).contiguous(),
        SMALL,
        targets=targets,
    )
    numbers = refinement.block(60, (0.0, 1.0))
    assert numbers["rollout_success"] > 0.9


@pytest.mark.parametrize(
    "wrong", [{"rollouts": -1}, {"from_data": 0.9, "from_failures": 0.2}, {"trace": 1.5}, {"clip_ratio": 0.0}]
)
def test_settings_out_of_range(wrong: dict) -> None:
    """Each is refused by a line of its own."""
    with pytest.raises(InputError):
        RefineSettings(**wrong)


def test_what_a_rollout_passed_can_be_reached(arch: Assembly, data: Dataset) -> None:
    """A later state of a rollout is a legal, stable target of an earlier one, as the task and the solver see it."""
    environment = Environment(arch, 2, oracle=Stability(arch), device="cpu")
    starts = torch.as_tensor(data.train)
    moves = play_and_judge(environment, policy_for(arch), starts, None, 0.9, environment.generator(3))
    states, targets = hindsight(moves, 200, environment.generator(4))
    assert len(states) > 100
    assert bool(environment.rules.contains(states, targets).all())
    assert bool((environment.rules.steps_left(states, targets) > 0).all())
    assert Stability(arch).stable(np.concatenate([states.numpy(), targets.numpy()])).all()
    none = hindsight(moves.take(torch.arange(0)), 10, environment.generator(4))
    assert len(none[0]) == 0


def test_tasks_are_drawn_anew_and_imitated(bottle: Assembly, bottle_graph: StateGraph) -> None:
    """With a source of tasks hardly any start comes twice, and what the source knows is learned beside."""
    environment = Environment(bottle, 2, oracle=Stability(bottle), device="cpu")
    ways = Ways(bottle_graph, device=environment.device)
    states, targets, valid = ways.draw(300, environment.generator(7))

    def learned(imitation: float) -> float:
        policy = make_policy(bottle, PolicySettings(kind="residual", channels=32, layers=2, two_states=True))
        refinement = Refinement(
            environment,
            policy,
            SolvedStates(environment.rules),
            states[:1],
            replace(SMALL, imitation=imitation),
            targets=targets[:1],
            tasks=ways,
        )
        starts, aims = refinement._choose_starts(10**6)
        assert aims is not None
        assert len(torch.unique(torch.cat([starts, aims], dim=1), dim=0)) > 0.9 * len(starts)
        refinement.block(60, (0.0, 1.0))
        with torch.no_grad():
            logits, _ = policy(states, targets)
        return float(imitation_loss(logits, environment.rules.moves(states, targets), valid))

    assert learned(1.0) < learned(0.0)

"""Losses against plain sums of probabilities, schedules, averages, and a step that is not finite."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import load_structure  # noqa: E402
from falsework.errors import InputError, TrainingError  # noqa: E402
from falsework.learn import Environment, ImitationPhase, PolicySettings, make_policy, roll_out  # noqa: E402
from falsework.learn.algorithms.imitation import Imitation, imitation_loss  # noqa: E402
from falsework.learn.data.dataset import DataSettings, build_dataset, training_task  # noqa: E402
from falsework.learn.data.solvable_states import SolvableStates  # noqa: E402
from falsework.learn.networks.autocast import Network  # noqa: E402
from falsework.utils.distributed import ProcessGroup  # noqa: E402

SMALL = PolicySettings("mlp")


@pytest.fixture(scope="module")
def arch() -> Any:
    return load_structure("arch:blocks=7")


@pytest.fixture(scope="module")
def states(arch: Any) -> Any:
    return build_dataset(arch, training_task(arch, 2), DataSettings(16, 1), device="cpu").train


def settings(**changes: Any) -> ImitationPhase:
    return ImitationPhase(**changes).resolved("cpu")


def test_the_loss_is_minus_the_logarithm_of_the_probability_of_all_valid_actions() -> None:
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn((50, 8), generator=generator)
    mask = torch.rand((50, 8), generator=generator) < 0.7
    valid = mask & (torch.rand((50, 8), generator=generator) < 0.5)
    expected = []
    for row in range(50):
        if valid[row].any():
            weights = [float(torch.exp(logits[row, a])) if mask[row, a] else 0.0 for a in range(8)]
            good = sum(w for w, v in zip(weights, valid[row].tolist(), strict=True) if v)
            expected.append(-np.log(good / sum(weights)))
    assert float(imitation_loss(logits, mask, valid)) == pytest.approx(np.mean(expected), rel=1e-5)


def test_rows_without_a_valid_or_a_legal_action_are_left_out() -> None:
    """And their gradients are zeros, not NaN."""
    logits = torch.randn((4, 6), generator=torch.Generator().manual_seed(1), requires_grad=True)
    mask = torch.ones((4, 6), dtype=torch.bool)
    mask[1] = False
    valid = mask.clone()
    valid[:, 3:] = False
    valid[2] = False
    loss = imitation_loss(logits, mask, valid)
    assert torch.isfinite(loss)
    (gradient,) = torch.autograd.grad(loss, logits)
    assert torch.isfinite(gradient).all()
    assert (gradient[1:3] == 0).all()
    alone = imitation_loss(logits[[0, 3]], mask[[0, 3]], valid[[0, 3]])
    assert imitation_loss(logits, mask, valid).item() == pytest.approx(alone.item())


def test_an_action_that_is_not_legal_is_not_imitated() -> None:
    """Alone it makes its row count for nothing; beside others it adds nothing."""
    logits = torch.randn((3, 6), generator=torch.Generator().manual_seed(2))
    mask = torch.ones((3, 6), dtype=torch.bool)
    mask[:, 5] = False
    valid = torch.zeros_like(mask)
    valid[0, 1] = valid[1, 5] = valid[2, 2] = True
    without = imitation_loss(logits[[0, 2]], mask[[0, 2]], valid[[0, 2]])
    assert imitation_loss(logits, mask, valid).item() == pytest.approx(without.item())
    valid[2, 5] = True
    assert imitation_loss(logits, mask, valid).item() == pytest.approx(without.item())


def test_it_learns_what_the_valid_actions_are(arch: Any, states: Any) -> None:
    environment = Environment(arch, 2, device="cpu")
    solved = SolvableStates(environment.rules, torch.from_numpy(states))
    imitation = Imitation(make_policy(arch, SMALL), solved, settings())
    first = imitation.block(20, (0.0, 0.05))["loss"]
    imitation.block(400, (0.05, 1.0))
    assert imitation.block(20, (1.0, 1.0))["loss"] < 0.1 * first
    best = imitation.export_policy(make_policy(arch, SMALL, seed=1))
    assert roll_out(environment, best, solved.states).success.all()


def test_the_learning_rate_rises_stays_and_falls(arch: Any, states: Any) -> None:
    environment = Environment(arch, 2, device="cpu")
    solved = SolvableStates(environment.rules, torch.from_numpy(states))
    imitation = Imitation(make_policy(arch, SMALL), solved, settings(warm_up=10, decay=0.5))
    assert imitation.schedule(0, 0.0) == pytest.approx(0.1)
    assert imitation.schedule(50, 0.3) == imitation.schedule(50, 0.5) == 1.0
    falling = [imitation.schedule(50, place) for place in np.linspace(0.5, 1.0, 20)]
    assert all(a > b for a, b in pairwise(falling))
    assert falling[-1] == pytest.approx(0.01)


@pytest.mark.parametrize("kind", ["mlp", "resmlp", "transformer"])
def test_a_step_that_is_not_finite_is_left_out(
    arch: Any, states: Any, kind: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = Environment(arch, 2, device="cpu")
    solved = SolvableStates(environment.rules, torch.from_numpy(states))
    policy = make_policy(arch, PolicySettings(kind, layers=1, channels=8, heads=1))
    imitation = Imitation(policy, solved, settings(batch=16))
    imitation.block(3, (0.0, 0.1))
    weights = [weight.clone() for weight in policy.parameters()]
    whole = Network.forward

    def broken(self: Any, batch: Any, targets: Any = None) -> Any:
        logits, value = whole(self, batch, targets)
        return logits * torch.nan, value

    monkeypatch.setattr(Network, "forward", broken)
    with pytest.raises(TrainingError, match="not a finite number at step 4"):
        imitation.block(2, (0.1, 0.2))
    for before, after in zip(weights, policy.parameters(), strict=True):
        assert torch.equal(before, after)


def test_saved_and_loaded_it_goes_on_alike(arch: Any, states: Any) -> None:
    environment = Environment(arch, 2, device="cpu")
    solved = SolvableStates(environment.rules, torch.from_numpy(states))
    whole = Imitation(make_policy(arch, SMALL), solved, settings())
    whole.block(10, (0.0, 0.5))
    other = Imitation(make_policy(arch, SMALL, seed=5), solved, settings(), seed=9)
    saved = [{name: one.clone() for name, one in part().items()} for part in (whole.state_dict, whole.local_state_dict)]
    other.load_state_dict(saved[0], saved[1])
    for one in (whole, other):
        one.block(10, (0.5, 1.0))
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name]), name


def test_a_batch_smaller_than_the_processes_is_refused(arch: Any) -> None:
    environment = Environment(arch, 2, device="cpu")
    with pytest.raises(InputError, match="cannot be shared by 4 processes"):
        Imitation(
            make_policy(arch, SMALL), SolvableStates(environment.rules), settings(batch=3), shards=ProcessGroup(0, 4)
        )


def test_visits_to_held_out_states_are_recorded(arch: Any, states: Any) -> None:
    environment = Environment(arch, 2, device="cpu")
    solved = SolvableStates(environment.rules, torch.from_numpy(states))
    solved.hold_out(torch.from_numpy(states[::3].copy()))
    policy, starts = make_policy(arch, SMALL), solved.states
    roll_out(environment, policy, starts, greedy=False, generator=environment.generator(0))
    assert solved.visited == 0
    environment.record = solved.record_visits
    rollouts = roll_out(environment, policy, starts, greedy=False, generator=environment.generator(0))
    visited = rollouts.states[1:].flatten(0, 1)
    assert solved.visited == len(torch.unique(visited[solved.is_held_out(visited)], dim=0)) > 0

"""Labels of removals, and what policies learn from them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from falsework import StabilityOracle, load_structure
from falsework.assembly.state import HELD, INSTALLED, REMOVED
from falsework.learn import Environment, PolicySettings
from falsework.learn.algorithms.removals import Removals
from falsework.learn.algorithms.rollout_storage import Transitions, collect_transitions
from falsework.learn.networks.factory import make_policy


@pytest.fixture(scope="module")
def arch() -> Environment:
    assembly = load_structure("arch:blocks=9")
    return Environment(assembly, 2, oracle=StabilityOracle(assembly), device="cpu")


@pytest.fixture(scope="module")
def transitions(arch: Environment) -> Transitions:
    policy = make_policy(arch.assembly, PolicySettings("mlp"))
    starts = arch.rules.complete(64)
    return collect_transitions(arch, policy, starts, None, arch.generator(0), discount=1.0, gae_lambda=0.9)


def test_labels_are_verdicts_without_the_part(arch: Environment, transitions: Transitions) -> None:
    drawn = Removals.draw(arch, transitions, arch.generator(1))
    conditions = transitions.states.gather(1, drawn.part[:, None])[:, 0]
    assert torch.equal(drawn.held, conditions == HELD)
    assert (conditions[~drawn.held] == INSTALLED).all()
    action = drawn.part + arch.part_count * drawn.held
    assert transitions.mask.gather(1, action[:, None]).all()
    without = transitions.states.clone()
    without.scatter_(1, drawn.part[:, None], REMOVED)
    verdicts = arch.oracle.verdicts(without.numpy())
    assert drawn.stable.bool().tolist() == [bool(one) for one in verdicts.stable]
    assert len(drawn.stable.unique()) == len(drawn.held.unique()) == 2


def test_loss_by_hand() -> None:
    """A part that could be held and falls, a held one that falls, a held one that does not, and padding."""
    drawn = Removals(torch.tensor([0, 1, 1, 0]), torch.tensor([0.0, 0.0, 1.0, 0.0]), torch.tensor([0, 1, 1, 0]).bool())
    mask = torch.tensor([[1, 0, 0, 1], [0, 0, 1, 1], [0, 0, 1, 1], [0, 0, 0, 0]]).bool()
    logits = torch.zeros((4, 4), requires_grad=True)
    loss = drawn.loss(logits, mask, torch.tensor([1.0, 1.0, 1.0, 0.0]))
    assert loss.item() == pytest.approx(2 * torch.log(torch.tensor(2.0)).item() / 3)
    loss.backward()
    assert logits.grad is not None
    assert torch.allclose(logits.grad[0], torch.tensor([0.0, 0.0, 0.5, 0.0]) / 3)
    assert torch.allclose(logits.grad[1], torch.tensor([0.0, 0.0, -0.5, 0.5]) / 3)
    assert not logits.grad[2:].any()


def test_a_certain_fall_keeps_the_loss_finite() -> None:
    drawn = Removals(torch.tensor([0]), torch.tensor([0.0]), torch.tensor([True]))
    logits = torch.zeros((1, 2), requires_grad=True)
    loss = drawn.loss(logits, torch.tensor([[False, True]]), torch.ones(1))
    loss.backward()
    assert loss.isfinite()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()


def test_selected_rows_keep_their_labels(arch: Environment, transitions: Transitions) -> None:
    drawn = Removals.draw(arch, transitions, arch.generator(1))
    rows = torch.tensor([3, 1])
    for name in ("part", "stable", "held"):
        assert torch.equal(getattr(drawn.take(rows), name), getattr(drawn, name)[rows])


def test_the_network_learns_what_falls(arch: Environment, transitions: Transitions) -> None:
    policy = make_policy(arch.assembly, PolicySettings("resmlp", layers=2, channels=32))
    drawn = Removals.draw(arch, transitions, arch.generator(1))
    adam = torch.optim.Adam(policy.parameters(), lr=3e-3)
    losses = []
    for _ in range(100):
        loss = drawn.loss(policy(transitions.states)[0], transitions.mask, torch.ones(len(transitions)))
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert losses[-1] < 0.3 * losses[0]


def test_nothing_is_drawn_without_transitions(arch: Environment, transitions: Transitions) -> None:
    none = replace(transitions, **{name: getattr(transitions, name)[:0] for name in ("states", "mask", "actions")})
    assert len(Removals.draw(arch, none, arch.generator(0)).part) == 0

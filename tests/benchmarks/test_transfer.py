"""Policies that meet structures that they were not trained on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from experiments.policy_cost import policy_cost
from experiments.structure_generator import rotated_copies
from experiments.transfer import Budget, Harness, compare_networks, transfer_experiment

from falsework import load_structure
from falsework.errors import InputError
from falsework.learn import PolicySettings, make_policy, transfer
from falsework.learn.training.evaluate import greedy_success

SMALL = PolicySettings("transformer", layers=2, channels=32, heads=4)


@pytest.mark.parametrize("kind", ["transformer", "local", "gat"])
def test_a_policy_moves_to_another_structure(kind: str) -> None:
    settings = PolicySettings(kind, layers=2, channels=16, heads=2)  # type: ignore[arg-type]
    source, other = load_structure("arch:blocks=5"), load_structure("arch:blocks=6,thickness=0.3")
    rows = list(transfer_experiment(source, [other], settings, budget=Budget(steps=100)))
    assert [(row["fine_tuned"], row["from"]) for row in rows] == [
        (0, "weights"), (0, "weights"), (0, "nothing"), (20, "weights"), (20, "nothing")
    ]  # fmt: skip
    assert rows[0]["success"]["train"] > 0.9
    assert rows[1]["success"]["train"] >= rows[2]["success"]["train"]


def test_policies_that_know_parts_by_number_are_refused_at_once() -> None:
    arch = load_structure("arch:blocks=4")
    with pytest.raises(InputError, match="fits its own structure only"):
        next(transfer_experiment(arch, [arch], PolicySettings("mlp"), budget=Budget(1e9)))


def test_networks_are_compared_on_the_same_data_for_the_same_time() -> None:
    settings = [PolicySettings("mlp"), SMALL]
    rows = list(compare_networks(load_structure("arch:blocks=5"), settings, budget=Budget(steps=100)))
    assert [row["kind"] for row in rows] == ["mlp", "transformer"]
    assert rows[0]["states"] == rows[1]["states"]
    assert all(row["success"]["train"] > 0.8 for row in rows)


def test_operations_of_the_perceptrons_are_those_of_their_matrices() -> None:
    arch = load_structure("arch:blocks=4")
    parts = arch.part_count
    row = policy_cost(arch, [PolicySettings("mlp")])[0]
    assert row["flops_forward"] == 2 * (4 * parts * 64 + 2 * 64 * 64 + 64 * 2 * parts + 64)
    assert 2 * row["flops_forward"] < row["flops_training"] <= 3 * row["flops_forward"]


def test_operations_of_attention_are_those_of_its_docstring() -> None:
    """`L (2 m c^2 (4 + 2 e) + 4 m^2 c)`, and little besides."""
    vault = load_structure("vault:parts=40")
    m, c = vault.part_count, 128
    row = policy_cost(vault, [PolicySettings("transformer")])[0]
    formula = 4 * (2 * m * c * c * (4 + 2 * 2) + 4 * m * m * c)
    assert formula < row["flops_forward"] < 1.15 * formula


def test_turned_copies_train_the_policy_itself() -> None:
    """Steps on the copies move the one set of weights, and a turned structure is as well known as the one as it was."""
    arch = load_structure("arch:blocks=5")
    bench = Harness(arch)
    settings = PolicySettings("transformer", layers=2, channels=16, heads=2)
    policy = make_policy(arch, settings, "cpu", 0)
    copies = list(rotated_copies(arch, 4, np.random.default_rng(0)))
    assert copies[0] is arch
    assert len({copy.meshes[0].vertices.tobytes() for copy in copies}) == 4
    trained, steps = bench.imitate(policy, Budget(steps=60), turns=4)
    straight, _ = bench.imitate(policy, Budget(steps=60))
    assert steps == 60
    assert not torch.equal(trained.state_dict()["state_in.weight"], straight.state_dict()["state_in.weight"])
    for copy in copies:
        turned_policy = transfer(trained.state_dict(), settings, copy)
        states = torch.from_numpy(bench.dataset.train)
        assert greedy_success(bench.environment, turned_policy, states)[0].share > 0.9

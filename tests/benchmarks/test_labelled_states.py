"""Labelled states of many structures, their files, batches and training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from experiments.general_training import GeneralSettings, GeneralTraining
from experiments.labelled_states import (
    LabelledStructure,
    LabelSettings,
    label_states,
    legal_actions,
    load_labelled,
    save_labelled,
)
from experiments.structure_batches import StructureBatches

from falsework import Direction, StabilityOracle, StabilitySettings, load_policy, load_structure
from falsework.errors import InputError
from falsework.learn import Environment, PolicySettings, load_run, make_policy, roll_out
from falsework.learn.data.dataset import training_task
from falsework.search import TensorRules

QUICK = LabelSettings(width=8, searches=1, rollouts=8, most=64)
SMALL = PolicySettings("local", layers=2, channels=16, heads=2)


@pytest.fixture(scope="module")
def labelled() -> list[LabelledStructure]:
    found = []
    for name, robots in (("arch:blocks=5", 2), ("stack:blocks=5", 1), ("wall:bricks=2,courses=3", 3)):
        one = label_states(load_structure(name), robots, "equilibrium", QUICK, family=name.split(":")[0])
        assert one is not None
        found.append(one)
    return found


def test_labels_are_legal_and_lead_to_stable_states() -> None:
    arch = load_structure("arch:blocks=6")
    one = label_states(arch, 2, "contact", QUICK, seed=3)
    assert one is not None
    rules = TensorRules(training_task(arch, 2))
    states, valid = torch.from_numpy(one.states), torch.from_numpy(one.valid)
    assert (valid <= rules.moves(states)).all()
    assert valid.any(dim=1).all(), "every state has a way on"
    rows, actions = valid.nonzero(as_tuple=True)
    after = rules.follow(states[rows], actions)
    assert StabilityOracle(arch, StabilitySettings(criterion="contact")).verdicts(after.numpy()).verdict.all()


def test_walks_leave_the_states_of_the_search() -> None:
    wall = load_structure("wall:bricks=3,courses=3")
    near, far = (
        label_states(wall, 2, "equilibrium", LabelSettings(width=4, searches=1, around=around, most=10_000))
        for around in (0, 3)
    )
    assert near is not None
    assert far is not None
    assert len(far.states) > len(near.states)
    assert {row.tobytes() for row in near.states} <= {row.tobytes() for row in far.states}


def test_no_labels_where_no_plan_is_found() -> None:
    assert label_states(load_structure("arch:blocks=7"), 1, "equilibrium", QUICK) is None


def test_rollouts_add_states_and_report_success() -> None:
    arch = load_structure("arch:blocks=5")
    first = label_states(arch, 2, "equilibrium", QUICK)
    assert first is not None
    policy = make_policy(arch, SMALL).eval()
    again = label_states(arch, 2, "equilibrium", QUICK, policy=policy, known=first, seed=1)
    assert again is not None
    assert again.success is not None
    assert 0 <= again.success <= 1
    assert first.success is None
    old = {row.tobytes(): actions for row, actions in zip(first.states, first.valid, strict=True)}
    both = [
        (old[row.tobytes()], new) for row, new in zip(again.states, again.valid, strict=True) if row.tobytes() in old
    ]
    assert both
    assert all((before <= new).all() for before, new in both), "no label is lost"


def test_legal_actions_are_those_of_the_rules() -> None:
    arch = load_structure("arch:blocks=6")
    states = np.random.default_rng(0).integers(0, 3, (200, arch.part_count), dtype=np.uint8)
    states[:, arch.boundary] = 2
    tensor = torch.from_numpy(states)
    for robots in (1, 2, 4):
        fixed = torch.tensor(arch.boundary.tolist())
        expected = TensorRules(training_task(arch, robots), direction=Direction.DISASSEMBLY).moves(tensor)
        assert torch.equal(legal_actions(tensor, fixed, torch.tensor([robots])), expected)


def test_a_file_keeps_states_and_labels(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    save_labelled(labelled, tmp_path / "data.npz", {"failed": [7]})
    back, about = load_labelled(tmp_path / "data.npz")
    assert about == {"failed": [7]}
    for one, other in zip(labelled, back, strict=True):
        assert (one.name, one.family, one.robots, one.criterion) == (
            other.name, other.family, other.robots, other.criterion
        )  # fmt: skip
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.valid, other.valid)
        np.testing.assert_array_equal(one.graph.neighbour, other.graph.neighbour)
        np.testing.assert_array_equal(one.graph.boundary, other.graph.boundary)
        np.testing.assert_allclose(one.graph.pair, other.graph.pair, atol=5e-3)
        np.testing.assert_allclose(one.graph.part, other.graph.part, atol=5e-3)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        load_labelled(tmp_path / "none.npz")
    np.savez(tmp_path / "odd.npz", a=np.zeros(3))
    with pytest.raises(InputError, match=r"damaged or not a falsework\.labelled/1 file"):
        load_labelled(tmp_path / "odd.npz")


def test_batches_hold_states_of_their_structures(labelled: list[LabelledStructure]) -> None:
    batches = StructureBatches(labelled, "cpu")
    assert batches.structures == 3
    assert batches.states == sum(len(one.states) for one in labelled)
    batch = batches.draw(400, 3, np.random.default_rng(0), torch.Generator().manual_seed(0))
    assert (batch.valid <= batch.legal).all()
    assert batch.valid.any(dim=2).all()
    known = {(one.robots, row.tobytes()) for one in labelled for row in one.states}
    for row, robots in enumerate(batch.graph.robots.int().tolist()):
        parts = int(batch.graph.real[row].sum())
        assert all((robots, state[:parts].numpy().tobytes()) in known for state in batch.states[row])


def test_no_states_are_refused() -> None:
    with pytest.raises(InputError, match="generate some first"):
        StructureBatches([], "cpu")


def settings(**options: object) -> GeneralSettings:
    values = {"policy": SMALL, "steps": 100, "tokens": 512, "mix": 3, "warm_up": 10, "learning_rate": 5e-3}
    return GeneralSettings(**{**values, **options})  # type: ignore[arg-type]


def test_one_policy_learns_several_structures(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    training = GeneralTraining(tmp_path, settings())
    numbers = training.run(StructureBatches(labelled, "cpu"), 60.0)
    assert training.steps == 100
    assert training.progress == 1.0
    assert numbers["share"] > 0.7
    training.save()
    for name, robots in (("arch:blocks=5", 2), ("stack:blocks=5", 1)):
        assembly = load_structure(name)
        policy = load_policy(tmp_path, assembly=assembly).of_task(robots, equilibrium=True)
        oracle = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium"))
        environment = Environment(assembly, robots, oracle=oracle, device="cpu")
        states = torch.from_numpy(next(one.states for one in labelled if one.name == name))
        assert roll_out(environment, policy, states, keep="ends").success.float().mean() > 0.8


def test_training_continues_where_it_ended(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    batches = StructureBatches(labelled, "cpu")
    first = GeneralTraining(tmp_path, settings(steps=5))
    first.run(batches, 60.0)
    first.save()
    again = GeneralTraining(tmp_path, settings(steps=8))
    assert again.steps == 5
    assert again.seconds == first.seconds
    for one, other in zip(first.averaged().parameters(), again.averaged().parameters(), strict=True):
        assert torch.equal(one, other)
    again.run(batches, 60.0)
    assert again.steps == 8
    with pytest.raises(InputError, match="was trained with other settings"):
        GeneralTraining(tmp_path, settings(learning_rate=1e-4))


def test_the_same_seed_trains_the_same_policy(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    batches = StructureBatches(labelled, "cpu")
    trained = []
    for name, seed in (("one", 1), ("same", 1), ("other", 2)):
        training = GeneralTraining(tmp_path / name, settings(steps=3, seed=seed))
        training.run(batches, 60.0)
        trained.append(torch.cat([weight.flatten() for weight in training.averaged().parameters()]))
    assert torch.equal(trained[0], trained[1])
    assert not torch.equal(trained[0], trained[2])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"policy": PolicySettings("transformer")}, "is of kind local"),
        ({"mix": 0}, "mix is 0; give at least 1"),
        ({"seconds": 0.0}, "learns nothing"),
    ],
)
def test_wrong_settings_are_refused(options: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        settings(**options)


def test_a_policy_for_any_structure_needs_one(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    training = GeneralTraining(tmp_path, settings(steps=1))
    training.run(StructureBatches(labelled, "cpu"), 60.0)
    training.save()
    with pytest.raises(InputError, match="is a policy for any structure; name the structure"):
        load_run(tmp_path)
    run = load_run(tmp_path, assembly=load_structure("arch:blocks=4"))
    assert run.policy.part_count == 6

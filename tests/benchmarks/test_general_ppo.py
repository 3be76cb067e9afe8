"""Reinforcement of one policy for several structures: what it improves, what it keeps, and what it refuses."""

from __future__ import annotations

from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from experiments.general_ppo import GeneralPpo, GeneralPpoSettings, Playground
from experiments.general_training import GeneralSettings, GeneralTraining
from experiments.labelled_states import LabelledStructure, LabelSettings, label_states
from experiments.structure_batches import StructureBatches

from falsework import Assembly, load_structure
from falsework.errors import InputError
from falsework.learn import PolicySettings
from falsework.learn.training.checkpoint import CheckpointFile

NAMES = (("arch:blocks=6", 2), ("stack:blocks=5", 1), ("wall:bricks=2,courses=3", 2))
SETTINGS = GeneralPpoSettings(together=2, kept=3, rollouts=24, tokens=800, steps=8, learning_rate=5e-3)


@pytest.fixture(scope="module")
def labelled() -> list[LabelledStructure]:
    quick = LabelSettings(width=8, searches=1, most=64)
    found = [label_states(load_structure(name), robots, "equilibrium", quick) for name, robots in NAMES]
    return [one for one in found if one is not None]


GENERAL = GeneralSettings(PolicySettings("local", layers=2, channels=16, heads=2), tokens=256, mix=3, warm_up=1, seed=1)


def made(folder: Path, labelled: list[LabelledStructure]) -> GeneralPpo:
    turn = cycle(labelled)

    def draw() -> tuple[Assembly, LabelledStructure]:
        one = next(turn)
        return load_structure(one.name), one

    return GeneralPpo(GeneralTraining(folder, GENERAL), SETTINGS, draw)


def test_rollouts_improve_one_policy_on_several_structures(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    """From random weights, with next to no imitation."""
    learner, batches = made(tmp_path, labelled), StructureBatches(labelled, "cpu")

    def greedy() -> float:
        network = learner.training.averaged()
        return float(
            np.mean([Playground(load_structure(one.name), one, network, 1, "cpu").greedy(64) for one in labelled])
        )

    before = greedy()
    rows = [learner.update(batches, step / 26) for step in range(26)]
    assert learner.training.steps > 26
    after = greedy()
    assert after > max(before + 0.1, 0.8), f"{before:.2f} before, {after:.2f} after"
    entropy = [row["entropy"] for row in rows]
    assert np.mean(entropy[-5:]) < np.mean(entropy[:5])  # of one collection it depends on the states drawn
    assert all(row["transitions"] > 0 for row in rows)


def test_it_goes_on_with_the_weights_of_the_folder(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    learner = made(tmp_path, labelled)
    numbers = learner.run(StructureBatches(labelled, "cpu"), 0.01, (0.0, 1.0))
    assert numbers["updates"] == 1.0
    learner.training.reinforced = 7.0
    learner.training.save()
    again = made(tmp_path, labelled).training
    assert again.steps == learner.training.steps > 0
    assert again.reinforced == 7.0
    for one, other in zip(learner.training.averaged().parameters(), again.averaged().parameters(), strict=True):
        assert torch.equal(one, other)


def test_settings_of_older_checkpoints_are_completed(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    """A setting of the network that a version did not have yet has its default."""
    training = made(tmp_path, labelled).training
    settings: dict[str, Any] = {
        name: value for name, value in asdict(GENERAL).items() if name not in ("seconds", "steps")
    }
    settings["policy"] = {name: value for name, value in settings["policy"].items() if name != "options"}
    CheckpointFile(tmp_path).save(training.optimizer.state_dict(), {"settings": settings, "seconds": 3.0})
    assert made(tmp_path, labelled).training.seconds == 3.0


@pytest.mark.parametrize(
    ("options", "words"),
    [({"rollouts": 0}, "rollouts is 0; give at least 1"), ({"together": 9}, "9 structures of an update are more than")],
)
def test_wrong_settings_are_refused(options: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        GeneralPpoSettings(**options)


def test_structures_that_cannot_be_judged_are_left_out(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    def refused() -> tuple[Assembly, LabelledStructure]:
        raise InputError("not on this device")

    learner = GeneralPpo(GeneralTraining(tmp_path, GENERAL), SETTINGS, refused)
    with pytest.raises(InputError, match="hardly any structure can be judged on this device"):
        learner.update(StructureBatches(labelled, "cpu"))

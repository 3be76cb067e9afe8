"""Reinforcement of one policy for several structures: what it improves, what it keeps, and what it refuses."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from experiments.general_ppo import GeneralPpo, GeneralPpoSettings
from experiments.general_training import GeneralSettings, GeneralTraining
from experiments.labelled_states import LabelledStructure, LabelSettings, label_states

from falsework import load_structure
from falsework.errors import InputError
from falsework.learn import PolicySettings

NAMES = (("arch:blocks=6", 2), ("stack:blocks=5", 1), ("wall:bricks=2,courses=3", 2))
SETTINGS = GeneralPpoSettings(rollouts=24, tokens=800, mix=3, learning_rate=5e-3, average=0.9)


@pytest.fixture(scope="module")
def labelled() -> list[LabelledStructure]:
    quick = LabelSettings(width=8, searches=1, most=64)
    found = [label_states(load_structure(name), robots, "equilibrium", quick) for name, robots in NAMES]
    return [one for one in found if one is not None]


GENERAL = GeneralSettings(PolicySettings("local", layers=2, channels=16, heads=2), tokens=256, mix=3, warm_up=1, seed=1)


@contextmanager
def made(folder: Path, labelled: list[LabelledStructure], load: Any = load_structure) -> Iterator[GeneralPpo]:
    learner = GeneralPpo(GeneralTraining(folder, GENERAL), labelled, SETTINGS, load, processes=1)
    try:
        yield learner
    finally:
        learner.close()


def test_rollouts_of_another_process_improve_one_policy_on_several_structures(
    labelled: list[LabelledStructure], tmp_path: Path
) -> None:
    """From random weights; a structure that is not known is left out."""
    unknown = replace(labelled[0], name="none")
    with made(tmp_path, [*labelled, unknown]) as learner:
        before = learner.validate(labelled, 60.0)
        assert len(before) == len(labelled)
        assert len(learner.validate([unknown, labelled[0]], 3.0)) == 1  # one process, which takes them in turn
        rows, end = [], time.perf_counter() + 90.0
        while time.perf_counter() < end and (not rows or rows[-1]["success"] < 0.8 * rows[-1]["collections"]):
            rows.append(learner.run(2.0, (0.1, 0.1)))
        assert sum(row["updates"] for row in rows) > 10
        assert sum(row["moves"] for row in rows) > 100
        after = learner.validate(labelled, 60.0)
        assert np.mean(after) > max(np.mean(before) + 0.1, 0.7), f"{before} before, {after} after"
        # It goes on with what it kept.
        learner.training.reinforced = 7.0
        learner.training.save()
        again = GeneralTraining(tmp_path, GENERAL)
        assert again.steps == learner.training.steps > 0
        assert again.reinforced == 7.0
        for one, other in zip(learner.training.averaged().parameters(), again.averaged().parameters(), strict=True):
            assert one.equal(other)


def test_a_process_that_fails_is_reported(labelled: list[LabelledStructure], tmp_path: Path) -> None:
    with (
        made(tmp_path, labelled, load=int) as learner,
        pytest.raises(RuntimeError, match=r"(arch|stack|wall).*: "),
    ):
        learner.run(60.0, (0.0, 0.0))


@pytest.mark.parametrize("name", ["rollouts", "tokens", "mix", "passes"])
def test_wrong_settings_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"{name} is 0; give at least 1"):
        GeneralPpoSettings(**{name: 0})

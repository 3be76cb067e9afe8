"""Trainings that begin with the weights of another run: which weights they have, and which runs do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from falsework import load_structure
from falsework.cli.main import main
from falsework.errors import InputError
from falsework.learn import PolicySettings, PpoPhase, TrainSettings, load_run
from falsework.learn.config.train import phases_of
from falsework.learn.training.train import train

SMALL = PolicySettings("transformer", layers=1, channels=16, heads=2)
STILL = PpoPhase(rollouts=8, batch=16, learning_rate=1e-12, imitation=0.0)
"""Steps too small to be seen, so that a run ends with the weights that it began with."""
SETTINGS = TrainSettings(policy=SMALL, phases=(STILL,), steps=1, widths=(4,), evaluation_states=8, robots=3)


def trained(
    folder: Path, structure: str = "arch:blocks=5", settings: TrainSettings = SETTINGS, **options: object
) -> Path:
    train(load_structure(structure), settings, folder=folder, device="cpu", logs=(), **options)  # type: ignore[arg-type]
    return folder


def weights(folder: Path) -> torch.Tensor:
    return torch.cat([one.flatten() for one in load_run(folder).policy.parameters()])


def test_weights_and_network_are_those_of_the_run(tmp_path: Path) -> None:
    """Of another structure, whatever the settings say of the network; another seed alone has other weights."""
    first = trained(tmp_path / "first")
    other = replace(SETTINGS, policy=PolicySettings("resmlp"), seed=5)
    second = trained(tmp_path / "second", "wall:bricks=2,courses=3", other, begin=first)
    assert torch.allclose(weights(second), weights(first), atol=1e-6)
    assert load_run(second).settings.policy == load_run(first).settings.policy
    fresh = trained(tmp_path / "fresh", "wall:bricks=2,courses=3", replace(SETTINGS, seed=5))
    assert not torch.allclose(weights(fresh), weights(first), atol=1e-3)


def test_a_network_that_numbers_parts_fits_its_own_structure(tmp_path: Path) -> None:
    settings = replace(SETTINGS, policy=PolicySettings("resmlp", layers=1, channels=8))
    first = trained(tmp_path / "first", settings=settings)
    again = trained(tmp_path / "again", settings=replace(settings, seed=3), begin=first)
    assert torch.allclose(weights(again), weights(first), atol=1e-6)
    with pytest.raises(InputError, match="identifies parts by their number fits its own structure only"):
        trained(tmp_path / "other", "wall:bricks=2,courses=3", begin=first)


def test_the_command_fine_tunes(tmp_path: Path) -> None:
    """Without imitation, which would forget what the weights know."""
    first = trained(tmp_path / "first")
    command = [
        "train",
        "arch:blocks=4",
        "--begin",
        first,
        "--out",
        tmp_path / "second",
        "--steps",
        1,
        "--device",
        "cpu",
    ]
    assert main([str(word) for word in command]) == 0
    settings = load_run(tmp_path / "second").settings
    assert settings.policy == load_run(first).settings.policy
    assert [phase.algorithm for phase in settings.phases] == ["ppo"]
    assert settings.phases[0] == phases_of(begun=True)[0].resolved("cpu")


def test_runs_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        trained(tmp_path / "out", begin=tmp_path / "none")
    first = trained(tmp_path / "first")
    goals = replace(SETTINGS, policy=replace(SMALL, goal_conditioned=True))
    with pytest.raises(InputError, match="differ on goals; choose another run"):
        trained(tmp_path / "out", settings=goals, begin=first)
    with pytest.raises(InputError, match="hand yours over as policy"):
        trained(tmp_path / "out", begin=first, policy=torch.nn.Linear(1, 1))


@pytest.mark.parametrize("begun", [True, False])
def test_an_interruption_before_the_first_step_says_how_to_go_on(
    begun: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"

    def interrupted(*_: object, **__: object) -> None:
        if begun:
            run.mkdir()
            (run / "run.json").write_text("{}")
        raise KeyboardInterrupt

    monkeypatch.setattr("falsework.learn.training.train.train", interrupted)
    assert main(["train", "arch:blocks=5", "--friction", "0.7", "--out", str(run)]) == 130
    error = capsys.readouterr().err
    assert (f"falsework train arch:blocks=5 --friction 0.7 --out {run} --resume continues" in error) == begun
    assert error.count("\n") == 1

"""The weights of a run are the best on validation, and training ends when validation no longer rises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
pytest.importorskip("filelock", reason="filelock is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, load_structure, train  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import (  # noqa: E402
    REINFORCEMENT,
    ImitationPhase,
    PolicySettings,
    PpoPhase,
    TrainSettings,
    load_run,
    make_policy,
)
from falsework.learn.training import trainer as module  # noqa: E402
from falsework.learn.training.evaluate import Success  # noqa: E402
from falsework.learn.training.logger import read_progress  # noqa: E402
from falsework.learn.training.selection import BestWeights  # noqa: E402

POLICY = PolicySettings("mlp", channels=8, layers=1)
SETTINGS = TrainSettings(
    phases=(PpoPhase(rollouts=8, batch=16),),
    steps=40,
    block=4,
    evaluations=10,
    widths=(8,),
    policy=POLICY,
    patience=0.0,
)


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure("arch:blocks=7")


def policies(arch: Assembly, count: int) -> list[Any]:
    return [make_policy(arch, POLICY, "cpu", seed) for seed in range(count)]


def same(one: Any, other: Any) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_the_best_weights_are_kept_and_of_equal_ones_the_latest(arch: Assembly) -> None:
    made = policies(arch, 5)
    best, found = BestWeights(0.0), make_policy(arch, POLICY, "cpu", 9)
    for step, (policy, succeeded, winner) in enumerate(zip(made, (3, 5, 4, 5, 2), (0, 1, 1, 3, 3), strict=True)):
        best.consider(policy, Success(8, succeeded), step, step / 5)
        best.write(found)
        assert same(found, made[winner])
        assert best.step == winner
    assert best.success == Success(8, 5)
    again = BestWeights(0.0)
    again.load({f"best.{name}": one for name, one in best.tensors().items()}, best.state_dict(), torch.device("cpu"))
    again.consider(made[4], Success(8, 4), 5, 1.0)
    again.write(found)
    assert same(found, made[3])


def test_without_validation_states_the_latest_weights_are_kept(arch: Assembly) -> None:
    made = policies(arch, 2)
    best, found = BestWeights(0.1), make_policy(arch, POLICY, "cpu", 9)
    for step, policy in enumerate(made):
        best.consider(policy, Success(0, 0), step, 0.5 * step)
    best.write(found)
    assert same(found, made[1])
    assert not best.over(1.0)


def test_patience(arch: Assembly) -> None:
    """Counts from the last rise; not before the first success, nor while tasks get harder."""
    (policy,) = policies(arch, 1)
    best = BestWeights(0.25)
    best.consider(policy, Success(8, 0), 1, 0.1)
    assert not best.over(0.9)
    best.consider(policy, Success(8, 2), 2, 0.2)
    best.consider(policy, Success(8, 2), 3, 0.3)  # as good is no rise
    assert not best.over(0.45)
    assert best.over(0.46)
    best.consider(policy, Success(8, 1), 4, 0.4, waiting=True)
    assert not best.over(0.65)
    assert best.over(0.66)
    best.wait(0.5)
    assert not best.over(0.75)
    assert best.over(0.76)


def scripted(monkeypatch: pytest.MonkeyPatch, validation: list[int]) -> list[Any]:
    """Let evaluations on the validation set give these numbers; return the weights that were evaluated."""
    weights: list[Any] = []

    def succeed(self: Any, sets: Any, *, exact: bool = True) -> dict[str, Success]:
        if "validation" not in sets:
            return {name: Success(1, 1) for name in sets}
        weights.append({name: one.clone() for name, one in self.exported.state_dict().items()})
        place = min(len(weights), len(validation)) - 1
        return {"train": Success(1, 1), "validation": Success(10, validation[place])}

    monkeypatch.setattr(module.Trainer, "succeeded", succeed)
    return weights


def test_a_run_saves_the_weights_that_were_best_on_validation(
    arch: Assembly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = scripted(monkeypatch, [1, 4, 9, 3, 2])
    result = train(arch, SETTINGS, folder=tmp_path / "run", device="cpu", source={"built_in": "arch:blocks=7"})
    assert len(weights) == 10
    assert result.validation == Success(10, 9)
    kept = load_run(tmp_path / "run").policy.state_dict()
    assert all(torch.equal(kept[name], one) for name, one in weights[2].items())
    assert any(not torch.equal(kept[name], one) for name, one in weights[-1].items())
    assert all(torch.equal(result.policy.state_dict()[name], one) for name, one in kept.items())


def test_training_ends_when_validation_no_longer_rises(arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    weights = scripted(monkeypatch, [1, 4, 9, 3, 2])
    result = train(arch, replace(SETTINGS, patience=0.25), folder=None, device="cpu")
    assert result.steps == 24  # the best at 12 of 40, and more than a quarter of 40 later
    assert len(weights) == 6
    assert not result.interrupted


def test_patience_begins_anew_with_each_phase(arch: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    """PPO may lose at first what imitation has learned: 12 of 40 steps of its own, not of the best before it."""
    scripted(monkeypatch, [9, 1])
    phases = (ImitationPhase(steps=8, batch=16), *SETTINGS.phases)
    result = train(arch, replace(SETTINGS, phases=phases, patience=0.25), folder=None, device="cpu")
    assert result.steps == 8 + 12


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"evaluations": -1}, "evaluations are not negative, and patience is a share"),
        ({"patience": 1.5}, "evaluations are not negative, and patience is a share"),
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        TrainSettings(**wrong)


def test_progress_is_written_between_evaluations(arch: Assembly, tmp_path: Path) -> None:
    """With speed, divergence, explained variance and success of rollouts; at most one line in the given time."""
    several = (ImitationPhase(steps=8, batch=16), replace(REINFORCEMENT, rollouts=8, batch=16))
    often = replace(SETTINGS, phases=several, progress_every=0.0)
    train(arch, often, folder=tmp_path / "run", device="cpu", logs=())
    every = [line["step"] for line in read_progress(tmp_path / "run")]
    assert every == sorted(every)
    between = [line for line in read_progress(tmp_path / "run") if "success/validation" not in line]
    assert len(between) >= 7
    wanted = {"steps_per_second", "environment_steps_per_second", "seconds", "train/loss"}
    assert all(wanted < set(line) for line in between)
    wanted = {f"train/{name}" for name in ("kl", "rollout_return", "explained_variance", "rollout_success", "entropy")}
    assert [wanted < set(line) for line in between] == [line["step"] > 8 for line in between]
    assert all(line["steps_per_second"] > 0 for line in between)
    train(arch, replace(SETTINGS, progress_every=1e9), folder=tmp_path / "other", device="cpu", logs=())
    assert all("success/validation" in line for line in read_progress(tmp_path / "other"))


def test_a_run_without_a_step_says_so(arch: Assembly) -> None:
    result = train(arch, replace(SETTINGS, steps=0, minutes=1e-4), folder=None, device="cpu", logs=())
    assert result.steps == 0
    (note,) = (note for note in result.notes if "nothing was trained" in note)
    assert note.endswith("give more minutes")


def test_a_resumed_run_without_another_step_says_so(arch: Assembly, tmp_path: Path) -> None:
    options: dict[str, Any] = {"folder": tmp_path / "run", "device": "cpu", "logs": ()}
    first = train(arch, SETTINGS, **options)
    assert not any("was trained" in note for note in first.notes)
    again = train(arch, TrainSettings(), resume=True, **options)
    assert again.steps == first.steps
    (note,) = (note for note in again.notes if "nothing more was trained" in note)
    assert note.startswith(f"nothing more was trained: {first.steps} steps in ")
    assert note.endswith("give more steps")

"""Commands with a policy for any structure: plan, replan and evaluate without training."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from experiments.general_training import GeneralSettings, GeneralTraining
from experiments.labelled_states import LabelSettings, label_states
from experiments.structure_batches import StructureBatches

from falsework import load_structure
from falsework.learn import PolicySettings
from falsework.learn.training import checkpoint

ARCH = "arch:blocks=4"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a policy for any structure, of hardly any training."""
    folder = tmp_path_factory.mktemp("general")
    labelled = label_states(load_structure("arch:blocks=5"), 2, "equilibrium", LabelSettings(width=8, searches=1))
    assert labelled is not None
    settings = GeneralSettings(PolicySettings("local", layers=1, channels=16, heads=2), steps=20, tokens=256, warm_up=5)
    training = GeneralTraining(folder, settings)
    training.run(StructureBatches([labelled], "cpu"), 60.0)
    training.save()
    return folder


def test_a_policy_guides_the_search_of_a_structure_it_has_never_seen(
    falsework: Callable, run: Path, tmp_path: Path
) -> None:
    out = tmp_path / "plan.json"
    answer = json.loads(falsework("plan", ARCH, "--guide", run, "--out", out, "--json").out)
    plain = json.loads(falsework("plan", ARCH, "--out", tmp_path / "plain.json", "--json").out)
    assert answer["plans"][0]["steps"] == plain["plans"][0]["steps"]
    assert answer["verdicts"] > 0
    assert falsework("check", out).code == 0


def test_replanning_takes_a_policy_for_any_structure(falsework: Callable, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.json"
    answer = falsework("replan", ARCH, "--policy", run, "--confidences", "--out", out, "--json")
    assert answer.code == 0
    assert json.loads(answer.out)["confidences"]
    assert falsework("check", out).code == 0


def test_evaluation_takes_structure_and_robots(falsework: Callable, run: Path) -> None:
    answer = json.loads(falsework("evaluate", run, "--structure", ARCH, "--robots", 3, "--states", 8, "--json").out)
    assert (answer["structure"], answer["trained_on"], answer["robots"]) == (ARCH, "", 3)
    assert 0 <= answer["test"]["success"] <= 1


def test_what_is_missing_is_said(
    falsework: Callable, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "PRETRAINED", tmp_path / "none")
    for command, words in (
        (("evaluate", run), "is a policy for any structure; name the structure"),
        (("plan", ARCH, "--guide", "general"), "this installation has no policy for any structure; make one"),
        (("plan", ARCH, "--guide", tmp_path / "no"), "there is no folder"),
        (("plan", ARCH, "--guide", run, "--robots", "auto"), "--robots auto takes no --guide yet"),
        (("replan", run, "--policy", run), "is a policy for any structure; name the structure"),
    ):
        answer = falsework(*command)
        assert answer.code == 2, command
        assert words in answer.error, command


def test_the_policy_of_the_package_has_a_name(
    falsework: Callable, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checkpoint, "PRETRAINED", run)
    assert falsework("plan", ARCH, "--guide", "general", "--out", tmp_path / "plan.json").code == 0

"""Evaluation: what counts as success, the command, and policies on structures and targets they were not trained for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
pytest.importorskip("safetensors", reason="safetensors is not installed")

import falsework as fw  # noqa: E402
from falsework import StabilityOracle, load_structure, train  # noqa: E402
from falsework.cli.main import main  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import Environment, ImitationPhase, PolicySettings, TrainSettings, make_policy  # noqa: E402
from falsework.learn.config.train import phases_of  # noqa: E402
from falsework.learn.data.dataset import Dataset, DataSettings, build_dataset, training_task  # noqa: E402
from falsework.learn.training.evaluate import greedy_success, measure_success, sample  # noqa: E402
from falsework.search.problem.state_graph import load_state_graph  # noqa: E402

WIDE = "arch:blocks=13"
"""Has more states than a search of width 64 finds from either end."""
PARTS = PolicySettings("transformer", channels=16, layers=1, heads=2)


@pytest.fixture(scope="module")
def arch() -> Any:
    return load_structure("arch:blocks=9")


@pytest.fixture(scope="module")
def data(arch: Any) -> Dataset:
    return build_dataset(arch, training_task(arch, 2), DataSettings(16, 32), device="cpu")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, arch: Any) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    settings = TrainSettings(phases=(ImitationPhase(),), steps=60, widths=(16,), policy=PARTS)
    train(arch, settings, folder=folder, device="cpu", logs=(), source={"built_in": "arch:blocks=9"})
    return folder


def test_success_is_a_way_to_the_end_that_stands(arch: Any, data: Dataset) -> None:
    """Against rollouts step by step with the oracle."""
    environment = Environment(arch, 2, device="cpu")
    policy = make_policy(arch, PARTS, seed=1)
    states = torch.from_numpy(data.train)
    success, which = greedy_success(environment, policy, states)
    assert 0 < success.succeeded < success.states == len(states)
    oracle, rules = StabilityOracle(arch), environment.rules
    for start, expected in list(zip(states, which.tolist(), strict=True))[::7]:
        state = start[None]
        while (mask := rules.moves(state)).any():
            logits, _ = policy(state)
            state = rules.follow(state, torch.where(mask, logits, -torch.inf).argmax(dim=1))
            if not oracle.verdicts(state.numpy()).stable[0]:
                break
        assert bool(rules.reached(state)[0]) == expected
    assert success.to_dict() == {"states": len(states), "success": round(int(which.sum()) / len(states), 6)}


def test_search_on_top_finds_a_plan_from_every_state(arch: Any, data: Dataset) -> None:
    """All of them are known to have one, and a policy that knows nothing does not stand in the way."""
    environment = Environment(arch, 2, device="cpu")
    sets = {"train": (data.train, None), "test": (data.test, None)}
    found = measure_success(environment, make_policy(arch, PARTS, seed=1), sets, search=True)
    assert found["test"]["success"] < 1.0
    assert found["test"]["search"]["share"] == 1.0
    assert sum(found["test"]["search"]["decided_by"].values()) == len(data.test)
    assert "search" not in found["train"]


def test_samples_are_fixed_and_without_repetition() -> None:
    rows = np.arange(100)
    assert len(set(sample(rows, 10).tolist())) == 10
    assert np.array_equal(sample(rows, 10), sample(rows, 10))
    assert np.array_equal(sample(rows, 0), rows)
    assert np.array_equal(sample(rows, 200), rows)


def test_the_command_reports_one_object(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(run), "--json", "--search", "--device", "cpu"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    record = json.loads(line)
    for name in ("train", "test"):
        assert 0 <= record[name]["success"] <= 1
        assert record[name]["states"] > 20
    assert record["test"]["search"]["share"] == 1.0
    assert main(["evaluate", str(run), "--json", "--states", "7", "--device", "cpu"]) == 0
    assert json.loads(capsys.readouterr().out)["test"]["states"] == 7
    assert main(["evaluate", str(run), "--states", "7", "--device", "cpu"]) == 0
    assert "states succeed" in capsys.readouterr().out


def test_the_function_and_the_command_agree(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = fw.evaluate(run, states=7, device="cpu")
    assert record is not None
    assert main(["evaluate", str(run), "--json", "--states", "7", "--device", "cpu"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {name: told[name] for name in ("train", "validation", "test")} == {
        name: record[name] for name in ("train", "validation", "test")
    }
    with pytest.raises(InputError, match="0 states leave nothing to evaluate"):
        fw.evaluate(run, states=0)


def test_the_criterion_is_that_of_the_run_unless_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "run")
    words = ["train", "arch:blocks=9", "--method", "reinforcement", "--steps", "5", "--out", out, "--device", "cpu"]
    assert main([*words, "--criterion", "equilibrium", "--json"]) == 0
    capsys.readouterr()
    for extra, expected in ((), "equilibrium"), (("--criterion", "contact"), "contact"):
        assert main(["evaluate", out, "--json", "--states", "3", "--device", "cpu", *extra]) == 0
        assert json.loads(capsys.readouterr().out)["criterion"] == expected
    for options in (("--sets", "64,128"), ()):
        for criterion in ("contact", "equilibrium"):
            file = str(tmp_path / f"{len(options)}.npz")
            assert main(["graph", "arch:blocks=5", *options, "--json", "--out", file, "--criterion", criterion]) == 0
            assert json.loads(capsys.readouterr().out)["criterion"] == criterion
    assert load_state_graph(file).criterion == "equilibrium"


def test_a_policy_is_asked_about_another_structure(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(run), "--json", "--structure", "arch:blocks=7", "--device", "cpu"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["structure"] == "arch:blocks=7"
    assert record["trained_on"] == "arch:blocks=9"
    assert record["train"]["success"] > 0.5  # arches are alike


def test_a_policy_of_one_state_is_masked_to_targets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, wide = tmp_path / "run", load_structure(WIDE)
    settings = TrainSettings(phases=(ImitationPhase(),), steps=60, widths=(16,), policy=PARTS, random_tries=2)
    train(wide, settings, folder=folder, device="cpu", logs=(), source={"built_in": WIDE})
    assert main(["evaluate", str(folder), "--json", "--targets", "--states", "50", "--device", "cpu"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["targets"]
    assert not record["goal_conditioned"]
    assert 0 < record["test"]["success"] <= 1


@pytest.mark.parametrize("method", ["imitation", "default"])
def test_a_policy_of_two_states_learns_targets(method: Any, tmp_path: Path) -> None:
    settings = TrainSettings(
        phases=tuple(
            replace(one, batch=64) if isinstance(one, ImitationPhase) else one
            for one in {"default": phases_of(), "imitation": (ImitationPhase(),)}[method]
        ),
        steps={"imitation": 150, "default": 30}[method],
        policy=PolicySettings("resmlp", goal_conditioned=True, channels=32, layers=1),
        random_tries=2,
        widths=(8,),
        evaluation_states=64,
    )
    wide = load_structure(WIDE)
    result = train(wide, settings, folder=tmp_path / "run", device="cpu", logs=(), source={"built_in": WIDE})
    assert result.test.states == 4 * result.train.states == 64
    assert result.test.share > (0.5 if method == "imitation" else 0.0)
    assert main(["evaluate", str(tmp_path / "run"), "--json", "--targets", "--states", "20", "--device", "cpu"]) == 0


def test_a_resumed_run_with_targets_does_not_search_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of its time went into searches, and pieces are to be short."""
    settings = TrainSettings(
        steps=20,
        block=10,
        policy=PolicySettings("resmlp", goal_conditioned=True, channels=32, layers=1),
        random_tries=2,
        widths=(8,),
        evaluation_states=32,
    )
    wide, folder = load_structure(WIDE), tmp_path / "run"
    first = train(wide, settings, folder=folder, device="cpu", logs=(), source={"built_in": WIDE})

    def search_states(*arguments: Any, **options: Any) -> Any:
        raise AssertionError("it searched again")

    monkeypatch.setattr("falsework.learn.data.goal_dataset.search_states", search_states)
    more = replace(settings, steps=40)
    second = train(wide, more, folder=folder, device="cpu", logs=(), source={"built_in": WIDE}, resume=True)
    assert (first.steps, second.steps) == (20, 40)


def test_what_cannot_be_evaluated_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(tmp_path / "none")]) == 2
    assert "there is no folder" in capsys.readouterr().err
    assert main(["evaluate", str(run), "--states", "0"]) == 2
    assert "give at least 1" in capsys.readouterr().err
    assert main(["evaluate", str(run), "--structure", "nothing"]) == 2
    assert main(["train", "arch:blocks=7", "--out", str(tmp_path / "run"), "--minutes", "0"]) == 2
    assert "leaves no time to learn" in capsys.readouterr().err
    # Everything there is to an arch of nine blocks is found by a narrow search, which leaves nothing to test on.
    assert main(["evaluate", str(run), "--targets", "--device", "cpu"]) == 2
    assert "finds no pair of states" in capsys.readouterr().err


def test_the_command_trains_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "arch:blocks=7", "--out", str(tmp_path / "run"), "--device", "cpu"]
    assert main([*words, "--steps", "6", "--json", "--robots", "3"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["steps"] == 6
    assert record["files"] == [str(tmp_path / "run")]
    assert main([*words, "--steps", "12", "--json", "--resume"]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 12
    assert json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["robots"] == 3
    assert main([*words]) == 2
    assert "holds a run already" in capsys.readouterr().err

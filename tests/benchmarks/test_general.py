"""Commands that make and test a policy for all structures, on a few small ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from experiments.general_cases import CASES, TESTED, VALIDATION, evaluate_case, guide_case
from experiments.general_training import GeneralSettings, GeneralTraining
from experiments.inference import Inference, RemotePolicy
from experiments.structure_batches import StructureBatches
from experiments.structure_generator import HELD_OUT, TRAINED, UNSEEN
from general import PER_FILE, Library, Options, card, case_label, number_of

from falsework import load_policy, load_structure
from falsework.learn import PolicySettings
from falsework.learn.networks.local_attention import LocalAttentionPolicy

SMALL = PolicySettings("local", layers=1, channels=16, heads=2)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with data and a run of hardly any training."""
    folder = tmp_path_factory.mktemp("general")
    library = Library(folder)
    for number in (0, 5, 8):
        library.add(*case_label(number))
    library.add(*case_label(VALIDATION))
    library.add(17, None)
    library.save()
    training = GeneralTraining(folder, GeneralSettings(SMALL, steps=3, tokens=256))
    training.run(StructureBatches(list(library.structures.values()), "cpu"), 60.0)
    training.save()
    return folder


def test_a_library_keeps_its_structures(trained: Path) -> None:
    library = Library.load(trained)
    assert sorted(library.structures) == [0, 5, 8]
    assert library.failed == {17}
    assert [number_of(one) for one in library.validation.values()] == [VALIDATION]
    assert PER_FILE > 3
    assert (trained / "data-00.npz").exists()


def test_a_run_without_a_checkpoint_lends_its_weights(trained: Path, tmp_path: Path) -> None:
    for name in ("run.json", "weights.safetensors"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    again = GeneralTraining(tmp_path, GeneralSettings(SMALL, steps=3, tokens=256))
    before = GeneralTraining(trained, GeneralSettings(SMALL, steps=3, tokens=256)).averaged()
    assert again.steps == 0
    for network in (again.network, again.averaged()):
        for one, other in zip(network.parameters(), before.parameters(), strict=True):
            assert one.equal(other)


def test_known_structures_are_improved_by_rollouts(trained: Path) -> None:
    known = Library.load(trained).structures[0]
    number, again = case_label(0, known=known, folder=trained)
    assert number == 0
    assert again.success is not None
    assert (again.name, again.robots) == (known.name, known.robots)


def test_no_case_is_a_structure_of_training() -> None:
    groups = {case.group for case in CASES.values()}
    assert groups == {"validation", "validation family", "unseen member", "unseen family", "paper", "public"}
    assert not set(TRAINED) & {*UNSEEN, *HELD_OUT}
    assert not set(UNSEEN) & set(HELD_OUT)
    for case in CASES.values():
        if case.group.startswith("unseen"):
            assert int(case.structure.rpartition("-")[2]) >= TESTED > VALIDATION


def test_a_case_has_success_and_verdicts(trained: Path) -> None:
    policy = cast(LocalAttentionPolicy, load_policy(trained, "cpu", assembly=load_structure("arch")))
    inference = Inference(policy.network, policy.settings, 1, torch.device("cpu"))
    row = evaluate_case(f"stack-{TESTED}", RemotePolicy(inference.connections[0]), width=8, most=6)
    inference.close()
    assert 0 <= row["greedy"] <= row["sampled"] <= 1
    assert row["states"] <= 8
    guided = guide_case(f"stack-{TESTED}", trained)
    assert guided["plans"]["support"]["found"]
    assert guided["ratio"] is None or guided["ratio"] > 0
    json.dumps([row, guided])


def test_the_card_is_made_of_the_evaluation(trained: Path, capsys: pytest.CaptureFixture) -> None:
    row = {"case": "a", "group": "paper", "states": 4, "greedy": 0.5, "sampled": 0.25, "ratio": 2.0}
    rows = [row, {**row, "case": "b", "greedy": 1.0, "sampled": 1.0, "ratio": None}, {"case": "c", "group": "paper"}]
    (trained / "evaluation.jsonl").write_text("".join(json.dumps(one) + "\n" for one in rows))
    card(Options("card", folder=trained))
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    group = next(line for line in lines if line["benchmark"] == "general group")
    assert group["cases"] == 3
    assert group["without"] == ["c"]
    assert group["failures"] == ["a"]
    assert group["greedy"]["mean"] == pytest.approx(0.75)
    assert np.isclose(group["ratio"]["median"], 2.0)

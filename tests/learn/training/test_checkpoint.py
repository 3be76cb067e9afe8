"""Runs on disk: whole or not at all, and never mistaken for those of another version or structure."""

from __future__ import annotations

import errno
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import load_structure  # noqa: E402
from falsework.assembly.store import save_assembly  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import PolicySettings, PpoPhase, TrainSettings, load_run, make_policy  # noqa: E402
from falsework.learn.config.train import from_dict  # noqa: E402
from falsework.learn.networks.factory import describe  # noqa: E402
from falsework.learn.training.checkpoint import CheckpointFile, describe_structure, save_run  # noqa: E402

SETTINGS = TrainSettings(policy=PolicySettings("resmlp", channels=8, layers=1), widths=(4, 8), robots=3)


@pytest.fixture(scope="module")
def arch() -> Any:
    return load_structure("arch:blocks=5")


def metadata(assembly: Any, policy: Any, **source: Any) -> dict[str, Any]:
    return {
        "structure": describe_structure(assembly, source),
        "settings": asdict(SETTINGS),
        "policy": describe(policy, SETTINGS.policy),
        "results": {},
        "versions": {},
    }


@pytest.fixture
def run(arch: Any, tmp_path: Path) -> Path:
    policy = make_policy(arch, SETTINGS.policy, seed=3)
    save_run(tmp_path / "run", policy, metadata(arch, policy, built_in="arch:blocks=5"))
    return tmp_path / "run"


def change(run: Path, **entries: Any) -> None:
    content = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**content, **entries}))


def spoil_structure(run: Path, **entries: Any) -> None:
    change(run, structure={**json.loads((run / "run.json").read_text())["structure"], **entries})


def test_a_run_comes_back_as_it_was(arch: Any, run: Path) -> None:
    loaded = load_run(run)
    expected = make_policy(arch, SETTINGS.policy, seed=3).state_dict()
    assert loaded.settings == SETTINGS
    assert loaded.assembly.identity == arch.identity
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.policy.state_dict().items())
    assert not loaded.policy.training
    assert load_run(run, assembly=arch).assembly is arch


def test_a_run_names_its_criterion(arch: Any, run: Path) -> None:
    assert load_run(run).settings.criterion == "contact"
    change(run, settings=asdict(replace(SETTINGS, criterion="equilibrium")))
    assert load_run(run).settings == replace(SETTINGS, criterion="equilibrium")
    with pytest.raises(InputError, match="unknown criterion 'good'; choose contact or equilibrium"):
        TrainSettings(criterion="good")  # type: ignore[arg-type]


def test_a_structure_on_disk_is_found_beside_the_run(arch: Any, tmp_path: Path) -> None:
    save_assembly(arch, tmp_path / "here" / "my-arch")
    assembly = load_structure(str(tmp_path / "here" / "my-arch"))
    policy = make_policy(assembly, SETTINGS.policy)
    save_run(tmp_path / "here" / "run", policy, metadata(assembly, policy, path="../my-arch"))
    shutil.move(tmp_path / "here", tmp_path / "there")  # both together
    assert load_run(tmp_path / "there" / "run").assembly.identity == assembly.identity
    shutil.rmtree(tmp_path / "there" / "my-arch")
    with pytest.raises(InputError, match=r"is not at .*my-arch any more; put it back"):
        load_run(tmp_path / "there" / "run")


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda run: change(run, format="falsework.run/3"), "has format 'falsework.run/3'; this version reads"),
        (lambda run: change(run, extra=1), "extra is not known; known are format, policy,"),
        (lambda run: change(run, settings={"robot": 2}), "'robot' is not a setting of TrainSettings"),
        (lambda run: change(run, settings={"robots": "two"}), "TrainSettings.robots is 'two'"),
        (lambda run: change(run, settings={"phases": [{"algorithm": "ppo", "batch": None}]}), "PpoPhase.batch is None"),
        (lambda run: change(run, settings={"phases": [{"batch": 3}]}), "a phase of the algorithm None"),
        (lambda run: change(run, settings={"phases": "ppo"}), "a phase of the algorithm None"),
        (lambda run: change(run, structure=[]), r"structure is \[\]; give an object"),
        (lambda run: change(run, structure={"name": "arch"}), "structure.identity is missing; train again"),
        (lambda run: spoil_structure(run, parts="many"), "structure.parts is 'many'"),
        (lambda run: spoil_structure(run, source={}), "structure.source must have either built_in or path"),
        (
            lambda run: spoil_structure(run, source={"built_in": "arch", "colour": 1}),
            "structure.source.colour is not known",
        ),
        (lambda run: spoil_structure(run, source={"path": 3}), "structure.source.path is 3; give a text"),
        (
            lambda run: spoil_structure(run, source={"path": "x", "boundary": [[1]]}),
            r"source.boundary\[0\] is \[1\]; give a whole number or a text",
        ),
        (
            lambda run: (run / "run.json").write_text('{"format": 1, "format": 2}'),
            "is damaged .*the entry 'format' twice",
        ),
        (lambda run: (run / "run.json").write_text("{"), "is damaged"),
        (lambda run: (run / "run.json").unlink(), "is not a run: it has no run.json"),
        (lambda run: (run / "weights.safetensors").unlink(), "there is no file .*weights.safetensors"),
        (lambda run: (run / "weights.safetensors").write_bytes(b"0" * 99), "weights.safetensors is damaged"),
        (lambda run: shutil.rmtree(run), "there is no folder"),
    ],
)
def test_what_is_no_run_is_refused(run: Path, spoil: Callable[[Path], Any], message: str) -> None:
    spoil(run)
    with pytest.raises(InputError, match=message) as caught:
        load_run(run)
    assert "\n" not in str(caught.value)


def test_a_run_of_another_structure_is_refused(run: Path) -> None:
    with pytest.raises(InputError, match=r"another structure \(arch:blocks=5, 7 parts\) than arch:blocks=6"):
        load_run(run, assembly=load_structure("arch:blocks=6"))
    content = json.loads((run / "run.json").read_text())
    change(run, structure={**content["structure"], "identity": "0" * 8})
    with pytest.raises(InputError, match="was trained for another structure"):
        load_run(run)


def test_weights_of_another_network_are_refused(arch: Any, run: Path) -> None:
    other = make_policy(arch, PolicySettings("mlp"))
    save_run(run, other, metadata(arch, other, built_in="arch:blocks=5"))
    with pytest.raises(InputError, match="weights of another network"):
        load_run(run)


def test_a_full_disk_leaves_the_last_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whenever it fills up: at the first byte, in the middle, or when the file is renamed."""
    file = CheckpointFile(tmp_path)
    assert file.save({"x": torch.arange(5)}, {"step": 1}) == ""
    good = file.path.read_bytes()

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    for step in ("pathlib.Path.open", "os.fsync", "os.replace"):
        monkeypatch.setattr(step, full)
        said = file.save({"x": torch.arange(6)}, {"step": 2})
        monkeypatch.undo()
        assert re.fullmatch(
            "cannot write .*: the disk is full; .*; the last checkpoint stays, training continues", said
        )
    assert file.path.read_bytes() == good
    assert [path.name for path in file.path.parent.iterdir()] == ["last.safetensors"]
    tensors, state = file.load()
    assert torch.equal(tensors["x"], torch.arange(5))
    assert state == {"step": 1}


def test_checkpoints_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    file = CheckpointFile(tmp_path)
    with pytest.raises(InputError, match="nothing to resume"):
        file.load()
    file.save({"x": torch.arange(5)}, {})
    content = file.path.read_bytes()
    file.path.write_bytes(content[:-8])
    with pytest.raises(InputError, match="is damaged"):
        file.load()
    file.path.write_bytes(content.replace(b"falsework.checkpoint/3", b"falsework.checkpoint/9"))
    with pytest.raises(InputError, match=r"this version reads 'falsework.checkpoint/3'"):
        file.load()


def test_settings_survive_json() -> None:
    assert from_dict(TrainSettings, json.loads(json.dumps(asdict(SETTINGS)))) == SETTINGS
    filled = SETTINGS.resolved(62, "cuda")
    assert from_dict(TrainSettings, json.loads(json.dumps(asdict(filled)))) == filled
    assert filled.resolved(62, "cuda") == filled


def test_a_source_that_could_not_be_read_again_is_refused_at_once(arch: Any) -> None:
    with pytest.raises(InputError, match=r"cannot be recorded: structure\.source\.colour is not known"):
        describe_structure(arch, {"built_in": "arch:blocks=5", "colour": "red"})
    assert describe_structure(arch, {"path": Path("a") / "b"})["source"] == {"path": "a/b"}


def test_settings_that_earlier_versions_had_are_left_out() -> None:
    """Others are unknown."""
    phase = {**asdict(PpoPhase(rollouts=7)), "hindsight": 0.0, "weight_decay": 0.01}
    read = from_dict(TrainSettings, {**asdict(TrainSettings()), "phases": [phase], "pairs": 20_000})
    assert read.phases == (PpoPhase(rollouts=7),)
    with pytest.raises(InputError, match="'weight' is not a setting of PpoPhase"):
        from_dict(PpoPhase, {**phase, "weight": 1.0})

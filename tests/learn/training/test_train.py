"""Training as a whole: it learns, it resumes to the same curve, and nothing takes the last good state away."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
filelock = pytest.importorskip("filelock", reason="filelock is not installed: pip install 'falsework[learn]'")
safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")

from falsework import load_structure, train  # noqa: E402
from falsework.assembly.store import save_assembly  # noqa: E402
from falsework.errors import DependencyError, InputError, TrainingError  # noqa: E402
from falsework.learn import REINFORCEMENT, ImitationPhase, PolicySettings, PpoPhase, TrainSettings, load_run  # noqa: E402
from falsework.learn.config.train import METHODS, Phase, phases_of  # noqa: E402
from falsework.learn.data.dataset import load_dataset  # noqa: E402
from falsework.learn.data.symmetry import symmetries  # noqa: E402
from falsework.learn.networks.autocast import Network  # noqa: E402
from falsework.learn.training import train as module  # noqa: E402
from falsework.learn.training.logger import read_progress  # noqa: E402
from falsework.learn.training.train import TrainResult  # noqa: E402
from falsework.learn.training.trainer import Trainer  # noqa: E402

IMITATION = ImitationPhase(batch=16)
PHASES: dict[str, tuple[Phase, ...]] = {
    "default": (replace(IMITATION, until=0.5), PpoPhase(rollouts=8, batch=16)),
    "reinforcement": (replace(REINFORCEMENT, rollouts=4),),
    "begun": (PpoPhase(rollouts=4),),
    "imitation": (IMITATION,),
    "complete": (PpoPhase(starts="complete", rollouts=4),),
    "imitation, then reinforcement": (replace(IMITATION, until=0.4), replace(REINFORCEMENT, rollouts=4)),
}
"""Every preset, with small batches, and other combinations."""
SMALL = TrainSettings(
    phases=PHASES["default"],
    steps=40,
    block=5,
    widths=(8,),
    evaluations=4,
    patience=0.0,
    evaluation_states=32,
    random_tries=2,
    policy=PolicySettings("resmlp", channels=16, layers=1),
)


@pytest.fixture(scope="module")
def arch() -> Any:
    return load_structure("arch:blocks=7")


def weights(folder: Path) -> dict[str, Any]:
    return safetensors.load_file(folder / "weights.safetensors")


def curve(folder: Path) -> list[dict[str, Any]]:
    """Evaluations in progress.jsonl without what the clock says."""
    lines = [line for line in read_progress(folder) if "success/validation" in line]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def interrupted(arch: Any, settings: TrainSettings, folder: Path, at: int, **options: Any) -> TrainResult:
    """Train, and be interrupted by a signal after so many blocks."""
    blocks = 0
    number = options.pop("number", signal.SIGINT)

    def report(done: float, text: str) -> None:
        nonlocal blocks
        blocks += text.startswith("step")
        if blocks == at:
            blocks += 1
            os.kill(os.getpid(), number)

    return train(arch, settings, folder=folder, device="cpu", report=report, **options)


def test_a_small_arch_is_learned_completely(tmp_path: Path) -> None:
    """And most states of a wider search, although the mirror images of these are held out as well."""
    arch = load_structure("arch:blocks=9")
    policy = PolicySettings("transformer", channels=32, layers=2, heads=4)
    settings = TrainSettings(phases=(ImitationPhase(),), steps=160, policy=policy)
    begun = time.process_time()  # of one thread: other work on the machine does not count
    result = train(arch, settings, folder=tmp_path / "run", device="cpu")
    assert time.process_time() - begun < 60
    assert result.test.states > 20
    assert result.train.share == 1.0
    assert result.test.share > 0.8
    assert not result.interrupted


@pytest.mark.parametrize(
    ("share", "most", "imitated"), [(1.0, 10, 2), (0.5, 0, 4), (0.25, 1000, 2), (0.0, 0, 0)], ids=str
)
def test_imitation_ends_by_share_or_steps(arch: Any, share: float, most: int, imitated: int) -> None:
    """Only PPO after it plays rollouts; blocks are of five steps."""
    first = replace(IMITATION, until=share, steps=most)
    settings = replace(SMALL, phases=(first, *SMALL.phases[1:]), evaluations=8)
    result = train(arch, settings, folder=None, device="cpu")
    assert ["train/rollout_success" in line for line in result.curve] == [False] * imitated + [True] * (8 - imitated)


def test_every_preset_is_tested() -> None:
    assert set(METHODS) < set(PHASES)
    for name, phases in METHODS.items():
        assert [type(one) for one in phases] == [type(one) for one in PHASES[name]]


def test_the_default_preset_knows_weights_to_begin_with() -> None:
    assert phases_of() == METHODS["default"]
    assert phases_of(begun=True) == METHODS["default"][1:]
    assert phases_of("reinforcement", begun=True) == METHODS["reinforcement"]


@pytest.mark.parametrize("phases", list(PHASES.values()), ids=list(PHASES))
def test_two_pieces_are_one_run(arch: Any, phases: tuple[Phase, ...], tmp_path: Path) -> None:
    """To the last bit of the weights, and line by line of the curve; in every phase of every preset."""
    settings = replace(SMALL, phases=phases, steps=20, evaluations=2)
    whole = train(arch, settings, folder=tmp_path / "whole", device="cpu")
    piece = interrupted(arch, settings, tmp_path / "pieces", 1)
    assert piece.interrupted
    assert piece.steps == 5
    piece = interrupted(arch, TrainSettings(), tmp_path / "pieces", 2, number=signal.SIGTERM, resume=True)
    assert piece.steps == 15
    rest = train(arch, TrainSettings(), folder=tmp_path / "pieces", device="cpu", resume=True)
    assert not rest.interrupted
    assert rest.steps == whole.steps == 20
    assert rest.to_dict()["test"] == whole.to_dict()["test"]
    assert rest.held_out_visit_rate == whole.held_out_visit_rate
    expected = weights(tmp_path / "whole")
    assert all(torch.equal(tensor, expected[name]) for name, tensor in weights(tmp_path / "pieces").items())
    assert [line for line in curve(tmp_path / "pieces") if line["step"] % 10 == 0] == curve(tmp_path / "whole")


def test_the_seed_decides(arch: Any, tmp_path: Path) -> None:
    runs = {}
    for name, seed in (("one", 0), ("two", 0), ("other", 1)):
        train(arch, replace(SMALL, steps=10, seed=seed), folder=tmp_path / name, device="cpu")
        runs[name] = weights(tmp_path / name)
    assert all(torch.equal(tensor, runs["two"][name]) for name, tensor in runs["one"].items())
    assert any(not torch.equal(tensor, runs["other"][name]) for name, tensor in runs["one"].items())
    data = [load_dataset(tmp_path / name / "data.npz", arch) for name in ("one", "other")]
    assert (data[0].test == data[1].test).all()  # one test set for all seeds


def test_after_a_crash_the_last_checkpoint_goes_on(arch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after a power cut: nothing is written at the end, and lines of steps that are taken again are dropped."""
    settings = replace(SMALL, checkpoint_every=0.0)
    whole = train(arch, settings, folder=tmp_path / "whole", device="cpu")

    class Crash(Exception):
        pass

    blocks = 0

    def report(done: float, text: str) -> None:
        nonlocal blocks
        blocks += text.startswith("step")
        if blocks == 6:
            raise Crash

    with pytest.raises(Crash):
        train(arch, settings, folder=tmp_path / "run", device="cpu", report=report)
    assert [line["step"] for line in curve(tmp_path / "run")] == [10, 20, 30]
    rest = train(arch, TrainSettings(), folder=tmp_path / "run", device="cpu", resume=True)
    assert rest.test == whole.test
    expected = weights(tmp_path / "whole")
    assert all(torch.equal(tensor, expected[name]) for name, tensor in weights(tmp_path / "run").items())
    assert curve(tmp_path / "run") == curve(tmp_path / "whole")


def test_a_disk_that_fills_up_costs_checkpoints_only(
    arch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Training goes on and says so; when it cannot save its result either, the last good checkpoint resumes."""
    settings, rename = replace(SMALL, checkpoint_every=0.0), os.replace
    expected = train(arch, settings, folder=tmp_path / "whole", device="cpu")
    written = 0

    def filling(draft: Path, target: Path) -> None:
        nonlocal written
        written += target.suffix == ".safetensors"
        if target.name == "data.npz" or written > 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        rename(draft, target)

    monkeypatch.setattr("os.replace", filling)
    told: list[str] = []
    with pytest.raises(InputError, match=r"cannot write .*weights.*: the disk is full"):
        train(arch, settings, folder=tmp_path / "run", device="cpu", report=lambda _, text: told.append(text))
    assert sum("the last checkpoint stays, training continues" in text for text in told) >= 4
    monkeypatch.undo()
    rest = train(arch, TrainSettings(), folder=tmp_path / "run", device="cpu", resume=True)
    assert rest.test == expected.test
    again = weights(tmp_path / "whole")
    assert all(torch.equal(tensor, again[name]) for name, tensor in weights(tmp_path / "run").items())


@pytest.mark.parametrize("goal_conditioned", [False, True])
@pytest.mark.parametrize("name", list(PHASES))
def test_no_loss_is_taken_at_test_states(name: str, goal_conditioned: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By no preset, at none of them and at none of their mirror images, as states or as targets."""
    if goal_conditioned and getattr(PHASES[name][-1], "starts", "mixed") != "mixed":
        return  # knows no targets
    arch = load_structure("arch:blocks=13" if goal_conditioned else "arch:blocks=9")
    permutations = symmetries(arch)
    assert len(permutations) == 2
    seen: list[Any] = []
    kept: dict[str, Any] = {}

    def keep(*arguments: Any, **named: Any) -> Any:
        kept["trainer"] = Trainer(*arguments, **named)
        return kept["trainer"]

    whole = Network.forward

    def watch(self: Any, states: Any, targets: Any = None) -> Any:
        if torch.is_grad_enabled():
            seen.extend([states] if targets is None else [states, targets])
        return whole(self, states, targets)

    monkeypatch.setattr(module, "Trainer", keep)
    monkeypatch.setattr(Network, "forward", watch)
    policy = replace(SMALL.policy, goal_conditioned=goal_conditioned)
    settings = replace(SMALL, phases=PHASES[name], policy=policy, steps=30, evaluations=3)
    train(arch, settings, folder=None, device="cpu")
    trainer = kept["trainer"]
    solved, data = trainer.solved, trainer.data
    test = torch.cat(
        [torch.from_numpy(one) for one in (*data.curve["validation"], *data.test["test"]) if one is not None]
    )
    images = torch.cat([test[:, np.argsort(one)] for one in permutations])
    assert len(images.unique(dim=0)) > len(test.unique(dim=0)) > 0
    assert solved.is_held_out(images).all()
    met = torch.cat(seen)
    assert len(met) > 100
    assert not solved.is_held_out(met).any()
    assert not solved.is_held_out(solved.states).any()
    assert not solved.is_held_out(data.starts).any()
    if name == "default" and not goal_conditioned:
        assert 0 < solved.held_out_visit_rate < 1  # although rollouts come across them


def test_a_step_that_is_not_finite_stops_the_default_training(
    arch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the phase after imitation; the last checkpoint is whole."""
    whole = Network.forward
    broken = False

    def forward(self: Any, states: Any, targets: Any = None) -> Any:
        logits, value = whole(self, states, targets)
        return (logits, value * torch.nan) if broken and torch.is_grad_enabled() else (logits, value)

    def report(done: float, text: str) -> None:
        nonlocal broken
        broken = text.startswith("step 30")

    monkeypatch.setattr(Network, "forward", forward)
    settings = replace(SMALL, checkpoint_every=0.0)
    with pytest.raises(TrainingError, match=r"not a finite number at step \d+; continue from the last checkpoint"):
        train(arch, settings, folder=tmp_path / "run", device="cpu", logs=(), report=report)
    broken = False
    rest = train(arch, TrainSettings(), folder=tmp_path / "run", device="cpu", logs=(), resume=True)
    assert rest.steps == 40


def test_the_papers_data_alone(arch: Any, tmp_path: Path) -> None:
    settings = replace(SMALL, phases=PHASES["imitation"], data="width64", steps=5)
    result = train(arch, settings, folder=tmp_path / "run", device="cpu")
    data = load_dataset(tmp_path / "run" / "data.npz", arch)
    assert len(data.more) == 0
    assert result.solved == len(data.train)


def test_minutes_are_kept(arch: Any, tmp_path: Path) -> None:
    settings = replace(SMALL, steps=0, minutes=0.02, phases=PHASES["imitation"])
    result = train(arch, settings, folder=tmp_path / "run", device="cpu")
    assert result.steps > 0
    assert result.seconds < 20
    more = train(arch, TrainSettings(minutes=0.04), folder=tmp_path / "run", device="cpu", resume=True)
    assert more.steps > result.steps
    assert more.seconds > result.seconds


def test_the_run_can_be_used(arch: Any, tmp_path: Path) -> None:
    train(arch, SMALL, folder=tmp_path / "run", device="cpu", source={"built_in": "arch:blocks=7"})
    run = load_run(tmp_path / "run")
    assert run.settings.steps == 40
    assert run.metadata["results"]["steps"] == 40
    assert set(run.metadata["results"]["test"]) == {"states", "success"}
    assert list((tmp_path / "run" / "tensorboard").iterdir())
    lines = curve(tmp_path / "run")
    assert [line["step"] for line in lines] == [10, 20, 30, 40]
    assert {"success/validation", "success/train", "held_out_visit_rate", "train/loss"} <= set(lines[0])
    assert not any("success/test" in line for line in lines)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_folder_whose_name_is_no_text_does_not_lose_the_run(arch: Any, tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"run-\xff")
    result = train(arch, replace(SMALL, steps=5), folder=folder, device="cpu")
    assert (folder / "weights.safetensors").is_file()
    assert any("tensorboard writes no logs" in note for note in result.notes)


def test_without_tensorboard_there_is_a_note(arch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    result = train(arch, replace(SMALL, steps=5), folder=tmp_path / "run", device="cpu")
    assert any("tensorboard" in note for note in result.notes)
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(DependencyError, match="--log wandb needs wandb"):
        train(arch, replace(SMALL, steps=5), folder=tmp_path / "other", device="cpu", logs=("wandb",))
    with pytest.raises(InputError, match="unknown log 'csv'; choose tensorboard or wandb"):
        train(arch, replace(SMALL, steps=5), folder=tmp_path / "other", device="cpu", logs=("csv",))
    assert not (tmp_path / "other").exists()


def test_folders_that_are_taken_and_runs_that_are_not_there(arch: Any, tmp_path: Path) -> None:
    train(arch, replace(SMALL, steps=5), folder=tmp_path / "run", device="cpu", logs=())
    with pytest.raises(InputError, match="holds a run already; continue it with --resume"):
        train(arch, SMALL, folder=tmp_path / "run", device="cpu")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="exists and is not a run"):
        train(arch, SMALL, folder=tmp_path / "other", device="cpu")
    with pytest.raises(InputError, match="there is no folder"):
        train(arch, SMALL, folder=tmp_path / "none", device="cpu", resume=True)
    with pytest.raises(InputError, match="was trained for another structure"):
        train(load_structure("arch:blocks=8"), SMALL, folder=tmp_path / "run", device="cpu", resume=True)
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="0 CUDA devices were found"):
            train(arch, SMALL, folder=tmp_path / "gpu", device="cuda")


@pytest.mark.parametrize("resume", [False, True])
def test_a_second_training_in_a_folder_is_refused(arch: Any, tmp_path: Path, resume: bool) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with filelock.FileLock(folder / module.LOCK):
        with pytest.raises(InputError, match=r"another process trains in .*wait for its end, or choose another folder"):
            train(arch, SMALL, folder=folder, resume=resume)
        assert [entry.name for entry in folder.iterdir()] == [module.LOCK]


def test_a_killed_training_does_not_keep_the_folder(arch: Any, tmp_path: Path) -> None:
    (tmp_path / module.LOCK).write_text("")  # of a process that is gone
    train(arch, replace(SMALL, steps=5), folder=tmp_path)
    assert not (tmp_path / module.LOCK).exists()
    with pytest.raises(InputError, match="holds a run already"):
        train(arch, SMALL, folder=tmp_path)


def test_a_training_that_cannot_begin_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arch: Any
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise InputError("no room")

    monkeypatch.setattr(module, "Trainer", fail)
    with pytest.raises(InputError, match="no room"):
        train(arch, SMALL, folder=tmp_path / "a" / "run")
    assert not (tmp_path / "a" / "run").exists()


def test_a_run_of_an_older_format_is_refused(arch: Any, tmp_path: Path) -> None:
    """With one line that says what to do, to resume it and to use it."""
    train(arch, replace(SMALL, steps=5), folder=tmp_path / "run", device="cpu", logs=())
    path = tmp_path / "run" / "run.json"
    path.write_text(path.read_text().replace("falsework.run/2", "falsework.run/1"))
    message = r"has format 'falsework.run/1'; this version reads 'falsework.run/2' only; train again$"
    with pytest.raises(InputError, match=message):
        train(arch, SMALL, folder=tmp_path / "run", device="cpu", resume=True)
    with pytest.raises(InputError, match=message):
        load_run(tmp_path / "run")


@pytest.mark.parametrize(
    "wrong",
    [
        {"phases": ()},
        {"phases": (REINFORCEMENT, ImitationPhase())},
        {"data": "all"},
        {"steps": -1},
        {"seed": -1},
        {"robots": 0},
        {"phases": (PpoPhase(starts="complete"),), "policy": PolicySettings(goal_conditioned=True)},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        TrainSettings(**wrong)


def test_weights_and_biases_gets_the_same_numbers(arch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in that writes down what it is given."""
    told: dict[str, Any] = {"numbers": []}

    class StandIn(types.ModuleType):
        @staticmethod
        def init(**options: Any) -> Any:
            told["options"] = options
            return types.SimpleNamespace(
                log=lambda values, step: told["numbers"].append({"step": step, **values}),
                finish=lambda: told.setdefault("finished", True),
            )

    monkeypatch.setitem(sys.modules, "wandb", StandIn("wandb"))
    train(arch, replace(SMALL, steps=10), folder=tmp_path / "run", device="cpu", logs=("wandb",))
    assert told["numbers"] == read_progress(tmp_path / "run")
    assert told["finished"]
    assert told["options"]["config"]["steps"] == 10


def test_nothing_is_kept_where_no_folder_is_named(arch: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "safetensors", None)  # not needed then
    result = train(arch, replace(SMALL, steps=20, evaluations=2), folder=None, device="cpu")
    assert not list(tmp_path.iterdir())
    assert [one["step"] for one in result.curve] == [10, 20]
    kept = train(arch, SMALL, folder=None, device="cpu")
    again = train(arch, SMALL, folder=None, device="cpu")
    assert all(torch.equal(a, b) for a, b in zip(kept.policy.parameters(), again.policy.parameters(), strict=True))
    with pytest.raises(InputError, match="nothing to resume without the folder"):
        train(arch, SMALL, folder=None, device="cpu", resume=True)


def test_a_search_that_never_arrives_is_said(tmp_path: Path) -> None:
    """One robot cannot build an arch: what is learned is of little use."""
    settings = replace(SMALL, robots=1, phases=PHASES["imitation"], steps=5)
    result = train(load_structure("arch:blocks=5"), settings, folder=tmp_path / "run", device="cpu", logs=())
    assert any("not every search reached the complete structure" in note for note in result.notes)


def test_a_run_without_time_for_further_searches_says_so() -> None:
    settings = replace(SMALL, policy=replace(SMALL.policy, goal_conditioned=True), steps=2)
    arch = load_structure("arch:blocks=13")
    hurried, whole = (
        train(arch, one, folder=None, device="cpu", logs=())
        for one in (replace(settings, steps=0, minutes=1e-4), settings)
    )
    assert sum("no time was left for searches" in note for note in hurried.notes) == 1
    assert not any("no time was left for searches" in note for note in whole.notes)


def test_a_structure_by_name_or_path_is_found_again(arch: Any, tmp_path: Path) -> None:
    save_assembly(arch, tmp_path / "mine")
    for number, given in enumerate(("arch:blocks=7", tmp_path / "mine", str(tmp_path / "mine"))):
        folder = tmp_path / f"run {number}"
        train(given, replace(SMALL, steps=5), folder=folder, device="cpu", logs=())
        assert load_run(folder).assembly.identity == arch.identity

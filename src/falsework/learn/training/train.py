"""Training runs: data, phases, evaluation and checkpoints, resumable and over several processes."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from falsework.assembly.load import AnyStructure, as_assembly, means_built_in
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.algorithms.reward import Reward, environment_reward
from falsework.learn.config.train import TrainSettings, from_dict
from falsework.learn.data.dataset import Dataset
from falsework.learn.data.goal_dataset import GoalDataset
from falsework.learn.networks.custom_policy import PolicyOrClass
from falsework.learn.networks.factory import transfer
from falsework.learn.networks.policy import Policy
from falsework.learn.training.checkpoint import FILE, check_structure, load_policy, read_run, run_folder
from falsework.learn.training.iteration import Callback
from falsework.learn.training.logger import check_logs
from falsework.learn.training.plugins import LearnerMaker, Plugins
from falsework.learn.training.result import TrainResult
from falsework.learn.training.trainer import Report, Trainer
from falsework.utils.collectives import summed
from falsework.utils.display.notebook import notebook_progress
from falsework.utils.distributed import init_distributed

LOCK = "run.lock"
"""File in the folder of a run while a process trains there."""


def train(
    assembly: AnyStructure,
    settings: TrainSettings = TrainSettings(),
    *,
    folder: Path | str | None,
    policy: PolicyOrClass | None = None,
    begin: Path | str | None = None,
    reward: Reward = environment_reward,
    learner: LearnerMaker | None = None,
    callbacks: Sequence[Callback] = (),
    source: Mapping[str, Any] | None = None,
    device: str = "auto",
    resume: bool = False,
    logs: Sequence[str] = ("tensorboard",),
    report: Report | None = None,
    dataset: Dataset | GoalDataset | None = None,
) -> TrainResult:
    """Train a policy for one structure, and write a run that `load_run` reads.

    Under `torchrun` all processes call this alike; the first one writes.

    Args:
        assembly: the structure, or its name or path.
        settings: of the run; with `resume`, only `minutes` and `steps` of it count, where they are given.
        folder: of the run; None keeps nothing but what is returned.
        policy: a network of your own in place of that of the settings: a module, whose weights are copied, or a class,
            called with the assembly, as `falsework.learn.networks.custom_policy` describes it. A resumed run that
            cannot import it needs it again; so with the reward and the learner.
        begin: folder of a run whose weights come in place of random ones, and whose network in place of that of the
            settings: of this structure, of another one if its network knows parts by their geometry, or of a policy for
            any structure. Choose phases without imitation, such as `phases_of(begun=True)`.
        reward: of each action, for PPO. Weights are chosen by success on the validation set all the same.
        learner: makes the learner in place of PPO.
        callbacks: called after each iteration; one that returns True ends the training.
        source: where the structure can be loaded from again; if not given, the path, or a built-in of its name.
        device: `auto`, `cpu` or `cuda`.
        resume: continue the run in the folder.
        logs: `tensorboard` and `wandb`.
        report: called with progress messages; notebooks show them if not given.
        dataset: states to learn from and to test on, in place of those that searches would find; of a policy with goals
            a `GoalDataset`.

    Raises:
        DependencyError: a package is missing that the device or a log needs.
        InputError: no such device, a folder that holds another run, nothing to resume, no room to write, a policy,
            reward or learner that breaks its protocol, or weights to begin with that do not fit.
    """
    if source is None and isinstance(assembly, (str, Path)) and not means_built_in(assembly):
        source = {"path": str(Path(assembly).resolve())}
    assembly = as_assembly(assembly)
    check_logs(logs)
    plugins = Plugins(policy, reward, learner, tuple(callbacks))
    settings = plugins.named_in(settings)
    first = None
    if begin is not None and not resume:
        first = _first_policy(Path(begin), assembly, settings)
        settings = replace(settings, policy=first.settings)
    with init_distributed(device) as (shards, where):
        place = None if folder is None else Path(folder)
        begun = time.perf_counter()
        with _locked(place if shards.is_main_process else None, resume):
            kept = _begin(place, assembly, settings, where, resume)
            plugins = plugins.filled_from(kept)
            # No process writes before all have read the folder.
            summed([1.0], shards, where)
            with _repeatable(kept), _threads(kept, where):
                origin = dict(source or {"built_in": assembly.name})
                trainer = Trainer(assembly, kept, place, origin, where, shards, plugins, begin=first)
                trainer.report = report or notebook_progress("training") or trainer.report
                return trainer.run(begun, resume=resume, logs=logs, dataset=dataset)


def _first_policy(folder: Path, assembly: Assembly, settings: TrainSettings) -> Policy:
    """Return the policy of a run for a structure, to begin a training with.

    Raises:
        InputError: no run, one of a policy of users or with other goals, or a network that numbers the parts of another
            structure.
    """
    metadata = read_run(run_folder(folder))
    trained = from_dict(TrainSettings, metadata["settings"]).policy
    if trained.custom or settings.policy.custom:
        raise InputError("a training begins with the weights of a network of this package; hand yours over as policy")
    if trained.goal_conditioned != settings.policy.goal_conditioned:
        raise InputError(f"{folder} and this training differ on goals; choose another run to begin with")
    if metadata["structure"] is None or metadata["structure"]["identity"] == assembly.identity:
        return load_policy(folder, assembly=assembly)
    return transfer(load_policy(folder).state_dict(), trained, assembly)


@contextmanager
def _locked(folder: Path | None, resume: bool) -> Iterator[None]:
    """Keep other processes from training in a folder, which each would overwrite.

    Raises:
        InputError: another process trains there.
    """
    if folder is None or (not folder.is_dir() if resume else folder.is_file()):
        yield  # nothing is written there
        return
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK, blocking=False)
        lock.acquire()
    except Timeout:
        raise InputError(f"another process trains in {folder}; wait for its end, or choose another folder") from None
    except OSError as error:
        raise InputError(f"cannot write {folder}: {error.strerror or error}; choose another place") from None
    try:
        yield
    finally:
        with suppress(OSError):
            (folder / LOCK).unlink()
        lock.release()
        if made and not any(folder.iterdir()):
            folder.rmdir()


def _begin(
    folder: Path | None, assembly: Assembly, settings: TrainSettings, device: torch.device, resume: bool
) -> TrainSettings:
    """Return the resolved settings, those of the run if it is resumed."""
    if folder is None:
        if resume:
            raise InputError("there is nothing to resume without the folder of a run; name it")
        return settings.resolved(assembly.part_count, device.type)
    if not resume:
        if (folder / FILE).exists():
            raise InputError(f"{folder} holds a run already; continue it with --resume, or choose another folder")
        if folder.exists() and (not folder.is_dir() or any(entry.name != LOCK for entry in folder.iterdir())):
            raise InputError(f"{folder} exists and is not a run; choose another folder")
        return settings.resolved(assembly.part_count, device.type)
    metadata = read_run(folder)
    check_structure(folder, metadata, assembly)
    kept = from_dict(TrainSettings, metadata["settings"])
    if settings.steps or settings.minutes:
        kept = replace(kept, steps=settings.steps, minutes=settings.minutes or kept.minutes)
    return kept


@contextmanager
def _threads(settings: TrainSettings, device: torch.device) -> Iterator[None]:
    """Use as many threads as the settings say, where the network is on the processor."""
    before = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(settings.threads or max(before // 2, 1))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _repeatable(settings: TrainSettings) -> Iterator[None]:
    """Use deterministic kernels only, if the run is to depend on the seed alone."""
    if not settings.steps:
        yield
        return
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*deterministic.*")
            yield
    finally:
        torch.use_deterministic_algorithms(before)

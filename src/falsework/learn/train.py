"""Training: data, a way to learn, a curve, checkpoints; in pieces and by several processes if need be."""

from __future__ import annotations

import os
import platform
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from falsework import __version__
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.checkpoint import (
    DATA,
    FILE,
    CheckpointFile,
    check_structure,
    describe_structure,
    read_run,
    save_run,
    write_run,
)
from falsework.learn.data import Dataset, DataSettings, build_dataset, task_for
from falsework.learn.distributed import decided, same_weights
from falsework.learn.evaluate import Success, greedy_success, sample, throughput
from falsework.learn.imitation import Network
from falsework.learn.learners import Learner, PpoLearner, SearchLearner, merged, names, own_of, without_curriculum
from falsework.learn.log import Journal
from falsework.learn.pace import Pace
from falsework.learn.policy import describe, make_policy
from falsework.learn.refine import Refinement
from falsework.learn.settings import TrainSettings, as_json, from_json
from falsework.learn.solved import SolvedStates
from falsework.learn.watch import WatchedEnvironment
from falsework.search.shards import Shards, joined
from falsework.search.tensor_judge import oracle_on
from falsework.search.tensors import put
from falsework.stability.oracle import Stability

Report = Callable[[float, str], None]
"""Told how far the run is, between 0 and 1, and words."""

_COMPILE_FROM = 4.0
"""Minutes of training from which compiling the network pays."""


@dataclass(frozen=True)
class TrainResult:
    """What training came to."""

    folder: Path
    steps: int
    """Steps of the optimizer."""
    seconds: float
    """All of it, data and earlier pieces included."""
    data_seconds: float
    train: Success
    """Greedy success on a sample of the paper's training set."""
    test: Success
    """Greedy success on a sample of the test set."""
    solved: int
    """States that were learned from."""
    met_share: float
    """Share of the test states that rollouts came across while training."""
    interrupted: bool
    processes: int
    device: str
    throughput: dict[str, Any]
    """Of the environment, in this piece of the run."""
    notes: tuple[str, ...] = ()
    first: bool = True
    """This process is the one that reports."""

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return {
            "steps": self.steps,
            "seconds": round(self.seconds, 2),
            "data_seconds": round(self.data_seconds, 2),
            "train": self.train.as_json(),
            "test": self.test.as_json(),
            "solved": self.solved,
            "test_states_met": round(self.met_share, 6),
            "interrupted": self.interrupted,
            "processes": self.processes,
            "device": self.device,
            "environment": self.throughput,
        }


def train(
    assembly: Assembly,
    settings: TrainSettings = TrainSettings(),
    *,
    folder: Path | str,
    source: Mapping[str, Any] | None = None,
    device: str = "auto",
    resume: bool = False,
    logs: Sequence[str] = ("tensorboard",),
    report: Report | None = None,
    dataset: Dataset | None = None,
) -> TrainResult:
    """Train a policy for one structure, and leave a run behind that `falsework.learn.checkpoint.load_run` reads.

    Under `torchrun` all processes call this alike; the first one writes.

    Args:
        assembly: the structure.
        settings: what to do; with `resume`, only `minutes` and `steps` of it count, where they are given.
        folder: of the run.
        source: where the structure can be loaded from again; a built-in of the name of the assembly if not given.
        device: `auto`, `cpu` or `cuda`.
        resume: go on with the run in the folder.
        logs: `tensorboard` and `wandb`.
        report: told how far it is.
        dataset: states to learn from and to test on, in place of those that searches would find.

    Raises:
        DependencyError: a package is missing that the device or a log needs.
        InputError: no such device, a folder that holds another run, nothing to resume, or no room to write.
    """
    with joined(device) as (shards, where):
        folder = Path(folder)
        begun = time.perf_counter()
        kept = _begin(folder, assembly, settings, where, resume)
        with _repeatable(kept), _threads(kept, where):
            trainer = _Trainer(assembly, kept, folder, dict(source or {"built_in": assembly.name}), where, shards)
            trainer.report = report or trainer.report
            return trainer.run(begun, resume=resume, logs=logs, dataset=dataset)


def _begin(
    folder: Path, assembly: Assembly, settings: TrainSettings, device: torch.device, resume: bool
) -> TrainSettings:
    """Settings filled in, those of the run that is resumed if so."""
    if not resume:
        if (folder / FILE).exists():
            raise InputError(f"{folder} holds a run already; go on with it by --resume, or choose another folder")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} is there and is no run; choose another folder")
        return settings.resolved(assembly.part_count, device.type)
    metadata = read_run(folder)
    check_structure(folder, metadata, assembly)
    kept = from_json(TrainSettings, metadata["settings"])
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
    """Where a run is to depend on the seed alone, use only kernels that always add up in the same order."""
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


class _Trainer:
    """One run in one process."""

    def __init__(
        self,
        assembly: Assembly,
        settings: TrainSettings,
        folder: Path,
        source: dict[str, Any],
        device: torch.device,
        shards: Shards,
    ) -> None:
        self.assembly, self.settings, self.folder = assembly, settings, folder
        self.device, self.shards = device, shards
        self.report: Report = lambda done, text: None
        self.notes: list[str] = []
        self.steps = 0
        self._phase = 0
        self.data_seconds = 0.0
        self.pace = Pace(minutes=settings.minutes, steps=settings.steps, shards=shards, device=device)
        self._structure = describe_structure(assembly, source)
        self._results: dict[str, Any] = {}
        self._checkpoint = CheckpointFile(folder)
        self._saved = time.perf_counter()
        self._oracle = Stability(assembly)
        self._environment = WatchedEnvironment(
            assembly,
            settings.robots,
            oracle=self._oracle,
            device=device,
            clearance=settings.removable_only_if_clear,
            memory=settings.imitation.memory,
        )
        self._solved = SolvedStates(self._environment.rules)
        self._policy = make_policy(assembly, settings.policy, device, settings.seed)
        self._best = make_policy(assembly, settings.policy, device, settings.seed)
        same_weights(self._policy, shards)
        self._asked = Network(self._best, settings.precision)

    def run(self, begun: float, *, resume: bool, logs: Sequence[str], dataset: Dataset | None) -> TrainResult:
        """Data, blocks, result."""
        self.pace.before = time.perf_counter() - begun
        saved = self._checkpoint.load() if resume and self._checkpoint.exists() else None
        if self.shards.first:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_run(self.folder, self._metadata())
        data = self._data(dataset, resume)
        self._solved.forbid(put(data.test, self.device))
        samples = {
            name: put(sample(states, self.settings.evaluation_states), self.device)
            for name, states in (("train", data.train), ("test", data.test))
        }
        self._environment.solved = self._solved
        if saved is None:
            self._solved.add(put(np.concatenate([data.train, data.more]), self.device))
        self._make = lambda: self._learner(self._phases()[self._phase][0], self._begin_of_phase(), data)
        if saved is not None:
            self._phase = saved[1]["phase"]
        learner = self._make()
        if saved is not None:
            self._load(learner, *saved)
        if not len(self._solved):
            raise InputError(f"no state of {self.assembly.name} is left to learn from; use wider searches")
        journal = None
        if self.shards.first:
            at = self.steps if saved is not None else None
            journal = Journal(self.folder, logs, configuration=self._metadata()["settings"], resumed_at=at)
            self.notes += journal.notes
        try:
            with self.pace.interruptible():
                return self._blocks(learner, samples, journal)
        finally:
            if journal is not None:
                journal.close()

    def _blocks(self, learner: Learner, samples: dict[str, torch.Tensor], journal: Journal | None) -> TrainResult:
        settings, evaluated = self.settings, -1
        success = {name: Success(0, 0) for name in samples}
        numbers: dict[str, float] = {}
        blocks = interrupted = 0
        here = time.perf_counter()
        while self.pace.progress(self.steps) < 1.0 and not learner.exhausted:
            if self.pace.asked_to_stop():
                interrupted = 1
                break
            steps, progress = self.pace.stretch(self.steps, settings.block)
            if progress[0] >= self._phases()[self._phase][1]:
                learner = self._next_phase(learner)
            numbers = learner.block(steps, progress)
            self.steps += steps
            blocks += 1
            if self.steps // settings.block % settings.evaluate_every == 0:
                success, evaluated = self._evaluate(learner, samples), self.steps
                self._log(journal, numbers, success)
            self.report(self.pace.progress(self.steps), self._words(numbers, success["test"]))
            since = decided(time.perf_counter() - self._saved, self.shards, self.device)
            if since >= settings.checkpoint_every:
                self._save(learner)
        if evaluated != self.steps:
            success = self._evaluate(learner, samples)
            self._log(journal, numbers, success)
        result = self._result(success, bool(interrupted), time.perf_counter() - here)
        self._results = result.as_json()
        self._save(learner)
        if self.shards.first:
            save_run(self.folder, learner.best(self._best), self._metadata())
        return replace(result, notes=tuple(self.notes))

    def _data(self, dataset: Dataset | None, resume: bool) -> Dataset:
        """States to learn from and to test on: given, kept from an earlier piece, or searched for."""
        settings, path = self.settings, self.folder / DATA
        begun = time.perf_counter()
        if resume and path.exists():
            data = Dataset.load(path, self.assembly)
        else:
            task = task_for(self.assembly, settings.robots, settings.removable_only_if_clear)
            searches = DataSettings(widths=settings.widths if settings.data == "wide" else (), seed=settings.data_seed)
            data = dataset or build_dataset(
                self.assembly,
                task,
                searches,
                oracle=oracle_on(self._oracle, self.device),
                device=str(self.device),
                shards=self.shards,
                report=lambda text: self.report(0.0, text),
            )
            if self.shards.first:
                try:
                    data.save(path)
                except OSError as error:
                    self.notes.append(f"cannot keep {path}: {error.strerror}; a resumed run searches again")
        self.data_seconds = time.perf_counter() - begun
        return data

    def _phases(self) -> tuple[tuple[str, float], ...]:
        """Ways to learn one after the other, each with the progress at which it ends."""
        settings = self.settings
        first = {"refine": settings.refine.imitation, "imitation+ppo": settings.ppo.imitation}.get(settings.method)
        if first is None:
            return ((settings.method, 1.0),)
        return ("imitation", first), (settings.method.removeprefix("imitation+"), 1.0)

    def _learner(self, way: str, begin: float, data: Dataset) -> Learner:
        """What learns in one phase.

        Args:
            way: which.
            begin: progress of the run at which it begins.
            data: states that searches found.
        """
        settings, shards = self.settings, self.shards
        compiled = settings.compile == "on" or (
            settings.compile == "auto" and self.device.type == "cuda" and settings.minutes >= _COMPILE_FROM
        )
        if way in ("search", "imitation"):
            return SearchLearner(
                self._environment,
                self._policy,
                self._solved,
                settings,
                rounds=way == "search",
                compiled=compiled,
                shards=shards,
                folder=self.folder,
            )
        starts = put(np.concatenate([data.train, data.more]), self.device)
        if way == "refine":
            return Refinement(
                self._environment,
                self._policy,
                self._solved,
                starts,
                settings.refine.settings,
                begin=begin,
                seed=settings.seed,
                precision=settings.precision,
                compiled=compiled,
                shards=shards,
            )
        if way == "ppo-complete":
            starts = self._environment.rules.complete()
            settings = replace(settings, ppo=replace(settings.ppo, settings=without_curriculum(settings.ppo.settings)))
        return PpoLearner(self._environment, self._policy, starts, settings, shards=shards, folder=self.folder)

    def _begin_of_phase(self) -> float:
        return self._phases()[self._phase - 1][1] if self._phase else 0.0

    def _next_phase(self, learner: Learner) -> Learner:
        """Go on another way with the weights that the last one arrived at."""
        learner.best(self._best)
        self._phase += 1
        following = self._make()
        following.adopt(self._best)
        return following

    def _evaluate(self, learner: Learner, samples: dict[str, torch.Tensor]) -> dict[str, Success]:
        learner.best(self._best)
        with self._environment.unwatched():
            return {
                name: greedy_success(self._environment, self._asked, states, shards=self.shards)[0]
                for name, states in samples.items()
            }

    def _log(self, journal: Journal | None, numbers: dict[str, float], success: dict[str, Success]) -> None:
        if journal is None:
            return
        curve = {f"success/{name}": one.share for name, one in success.items()}
        curve |= {"seconds": round(self.pace.seconds, 3), "test_states_met": self._solved.met_share}
        journal.write(self.steps, {**curve, **{f"train/{name}": value for name, value in numbers.items()}})

    def _words(self, numbers: dict[str, float], test: Success) -> str:
        loss = f"loss {numbers['loss']:.3f}" if "loss" in numbers else ""
        tested = f"test {100 * test.share:.1f} %" if test.states else ""
        return ", ".join(text for text in (f"step {self.steps}", loss, f"{len(self._solved)} states", tested) if text)

    def _save(self, learner: Learner) -> None:
        """Write a checkpoint, in all processes together; a disk that is full is worth a note, not the run."""
        own = merged(learner.own_tensors(), self.shards, self.device)
        self._saved = time.perf_counter()
        if not self.shards.first:
            return
        tensors = {f"learner.{name}": tensor for name, tensor in learner.tensors().items()}
        tensors |= {f"solved.{name}": tensor for name, tensor in self._solved.tensors().items()}
        state = {
            "steps": self.steps,
            "phase": self._phase,
            "pace": self.pace.state(),
            "data_seconds": self.data_seconds,
        }
        problem = self._checkpoint.save({**tensors, **own}, state)
        if problem:
            self.notes.append(f"no checkpoint at step {self.steps}: {problem}")
            self.report(self.pace.progress(self.steps), self.notes[-1])

    def _load(self, learner: Learner, tensors: dict[str, torch.Tensor], state: dict[str, Any]) -> None:
        self.steps = state["steps"]
        self.pace.load(state["pace"])
        self.data_seconds = state["data_seconds"]
        self._solved.load(names(tensors, "solved."))
        own = own_of(tensors, self.shards)
        if own is None:
            self.notes.append("the number of processes has changed, so the run goes on with other random numbers")
        learner.load(names(tensors, "learner."), own)

    def _result(self, success: dict[str, Success], interrupted: bool, seconds: float) -> TrainResult:
        gpu = self.device.type == "cuda"
        return TrainResult(
            self.folder,
            self.steps,
            self.pace.seconds,
            self.data_seconds,
            success["train"],
            success["test"],
            len(self._solved),
            self._solved.met_share,
            interrupted,
            self.shards.size,
            torch.cuda.get_device_name(self.device) if gpu else platform.processor() or "cpu",
            throughput(self._environment, seconds, self.shards),
            first=self.shards.first,
        )

    def _metadata(self) -> dict[str, Any]:
        return {
            "structure": self._structure,
            "settings": as_json(self.settings),
            "policy": describe(self._policy),
            "results": self._results,
            "versions": {"falsework": __version__, "torch": torch.__version__, "python": platform.python_version()},
        }

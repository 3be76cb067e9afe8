"""Training and held-out data of one run: states, or states with targets."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from falsework.errors import InputError
from falsework.learn.config.train import TrainSettings
from falsework.learn.data.dataset import Dataset, DataSettings, build_dataset, load_dataset, save_dataset
from falsework.learn.data.goal_dataset import GoalDataset, GoalDataSettings, SearchStates, build_goal_dataset
from falsework.learn.data.goal_pairs import Pairs
from falsework.learn.data.random_walks import GoalSampler, RandomWalkGoals
from falsework.learn.data.symmetry import symmetries
from falsework.learn.data.symmetry_augmentation import SymmetryAugmentation, symmetric_images, turned_states
from falsework.learn.training.checkpoint import DATA, SEARCHED
from falsework.learn.training.evaluate import Sets, sample
from falsework.learn.training.run_context import RunContext
from falsework.search.problem.hashing import StateIndex
from falsework.utils.tensors import put

_MOST_STATES = 16_000_000
"""States to start from, images included, of which each takes a byte a part and some 40 more."""


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Data of a run as tensors."""

    starts: torch.Tensor
    """States to start from, none of them held out, shape (count, parts)."""
    tasks: GoalSampler | None
    """With goals: draws starts and targets among these, with valid actions."""
    held_out: torch.Tensor
    """States never used for training: those of the test and the validation set with their images under the
    symmetries of the structure, shape (count, parts)."""
    curve: Sets
    """Fixed samples of training and validation states, for the curve."""
    test: Sets
    """A fixed sample of test states, for the end."""
    seconds: float
    """Time to collect the data."""


def collect_training_data(
    run: RunContext,
    *,
    kept: bool = False,
    dataset: Dataset | GoalDataset | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> TrainingData:
    """Search for states, or read those that an earlier session found.

    Args:
        run: training run; states are kept in its folder.
        kept: read them if they are there.
        dataset: states to use instead; of a policy with goals a `GoalDataset`.
        should_stop: called between searches for goals; true if no time is left for more, alike in all processes.

    Raises:
        InputError: data of another criterion than the run.
    """
    begun = time.perf_counter()
    assembly, settings, device = run.assembly, run.settings, run.device
    count, images = settings.evaluation_states, symmetries(assembly)
    if settings.policy.goal_conditioned:
        pairs = dataset if isinstance(dataset, GoalDataset) else find_pairs(run, _searched(run, kept, should_stop))
        held_out = symmetric_images(pairs.held_out, images)
        tasks: GoalSampler = RandomWalkGoals(pairs.wide, device=device, held_out=held_out)
        if len(images) > 1:
            tasks = SymmetryAugmentation(tasks, images, device=device, held_out=held_out)
        states = pairs.wide.states
        return TrainingData(
            put(states[StateIndex(held_out).find(states) < 0], device),
            tasks,
            put(held_out, device),
            {"train": _some(pairs.train, count // 4), "validation": _some(pairs.validation, count)},
            {"test": _some(pairs.test, count)},
            time.perf_counter() - begun,
        )
    path = None if run.folder is None else run.folder / DATA
    if kept and path is not None and path.exists():
        data, fresh = load_dataset(path, assembly), False
    else:
        data, fresh = dataset, True
        if not isinstance(data, Dataset):
            searches = DataSettings(widths=_widths(settings))
            data = build_dataset(
                assembly,
                run.task,
                searches,
                oracle=run.oracle,
                device=str(device),
                shards=run.shards,
                report=run.report,
            )
        if not data.complete:
            run.note("not every search reached the complete structure, so little is known of it; wider ones may")
    if data.criterion != settings.criterion:
        raise InputError(
            f"the states to learn from are stable under the criterion {data.criterion}, and the run is of "
            f"{settings.criterion}; choose one of them for both"
        )
    if fresh:
        _keep(run, path, lambda where: save_dataset(data, where))
    held_out = symmetric_images(np.concatenate([data.test, data.validation]), images)
    held = StateIndex(held_out)
    train, more = (states[held.find(states) < 0] for states in (data.train, data.more))
    starts = put(np.concatenate([train, more]), device)
    if settings.data == "wide" and not settings.policy.transfers:  # others know parts by geometry, which images share
        starts = turned_states(starts, images, _MOST_STATES)
    return TrainingData(
        starts,
        None,
        put(held_out, device),
        {"train": (sample(train, count // 4), None), "validation": (sample(data.validation, count), None)},
        {"test": (sample(data.test, count), None)},
        time.perf_counter() - begun,
    )


def _searched(run: RunContext, kept: bool, should_stop: Callable[[], bool] | None) -> SearchStates:
    """Search for states of tasks with targets, or read those in the folder of the run."""
    path = None if run.folder is None else run.folder / SEARCHED
    if kept and path is not None and path.exists():
        return SearchStates.load(path, run.task)
    searches = _target_searches(run.settings)
    searched = SearchStates.find(
        run.task, searches, run.oracle, device=run.device, shards=run.shards, report=run.report, should_stop=should_stop
    )
    _keep(run, path, lambda where: searched.save(where, run.task))
    if searches.widths and not len(searched.more):
        run.note("no time was left for searches beyond the protocol's, without which few unseen pairs succeed")
    return searched


def find_pairs(run: RunContext, searched: SearchStates | None = None) -> GoalDataset:
    """Find the pairs of states and targets for training and testing with goals; always the same ones."""
    return build_goal_dataset(
        run.assembly,
        run.task,
        _target_searches(run.settings),
        oracle=run.oracle,
        device=str(run.device),
        shards=run.shards,
        searched=searched,
    )


def _target_searches(settings: TrainSettings) -> GoalDataSettings:
    return GoalDataSettings(widths=_widths(settings), random_tries=settings.random_tries)


def _keep(run: RunContext, path: Path | None, save: Callable[[Path], None]) -> None:
    """Keep data in the folder of a run, if it has one; a full disk causes a note, and does not end the run."""
    if path is None or not run.shards.is_main_process:
        return
    try:
        save(path)
    except InputError as error:
        run.note(f"{error}; a resumed run searches again")


def _widths(settings: TrainSettings) -> tuple[int, ...]:
    return settings.widths if settings.data == "wide" else ()


def _some(pairs: Pairs, count: int) -> tuple[np.ndarray, np.ndarray]:
    rows = sample(np.arange(len(pairs)), count)
    return pairs.states[rows], pairs.targets[rows]

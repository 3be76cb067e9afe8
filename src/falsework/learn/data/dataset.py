"""Data sets: states of beam searches to learn from, to choose by, and to test on (paper, sections 5.1 and 7.2)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, Mask, States
from falsework.errors import InputError
from falsework.learn.data.parallel_beams import parallel_beam_search
from falsework.search.beam.settings import BeamSettings
from falsework.search.device.beam import device_beam
from falsework.search.device.oracle import TensorOracle, tensor_oracle, without_fallback
from falsework.search.problem.hashing import StateIndex
from falsework.search.problem.result import Stop
from falsework.search.problem.state_graph import criterion_of, read_criterion
from falsework.search.problem.task import Direction, Task
from falsework.stability.verdict import Criterion
from falsework.utils.archive import check_header, read_archive, write_archive
from falsework.utils.distributed import ProcessGroup
from falsework.utils.files.damage import blamed_on
from falsework.utils.quantity import check_seed
from falsework.utils.tensors import choose_device

if TYPE_CHECKING:
    import torch

FORMAT = "falsework.dataset/2"

VALIDATION_STATES = 1024
"""States of the validation set, at most: enough to resolve a difference of one in a hundred."""

_SETS = ("train", "test", "validation", "more")
_ARRAYS = frozenset({*_SETS, "boundary"})
_KINDS: dict[str, type] = {
    "name": str,
    "identity": str,
    "robots": int,
    "removable_only_if_clear": bool,
    "fixed": list,
    "train_width": int,
    "test_width": int,
}

Report = Callable[[str], None]
"""Called with progress messages."""


@dataclass(frozen=True)
class DataSettings:
    """Searches of a data set."""

    train_width: int = 64
    """Width of the search whose states are the paper's training set."""
    test_width: int = 128
    """Width of the search whose states, those of the first search left out, are the test set."""
    widths: tuple[int, ...] = ()
    """Widths of further searches to learn from; what is in the test or the validation set is left out. Equal ones that
    follow each other run side by side, see `search_several`."""
    seed: int = 0
    """Of the first search; each further one adds one: those of test and validation set, then those of `widths`."""

    def __post_init__(self) -> None:
        for width in (self.train_width, self.test_width, *self.widths):
            if width < 1:
                raise InputError(f"a search of width {width} finds nothing; give at least 1")
        check_seed(self.seed)


@dataclass(frozen=True, eq=False)
class Dataset:
    """Solvable states of one task: all of them were found by searches that began at the empty structure."""

    train: States
    """The paper's training set, shape (count, parts)."""
    test: States
    """States of a wider search that are not in `train`; never used for training, shape (count, parts)."""
    validation: States
    """States of another search of that width that are in neither; never used for training, but for choosing settings,
    networks and lengths of training, shape (count, parts)."""
    more: States
    """States of further searches that are in none of these, shape (count, parts)."""
    task: Task
    name: str = ""
    """Name of the structure."""
    settings: DataSettings = DataSettings()
    complete: bool = True
    """Whether every search reached the complete structure; of those that ran side by side, one of them."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time of each search."""

    @property
    def criterion(self) -> Criterion:
        """Stability criterion of its states."""
        return criterion_of(self.task)

    def levels(self) -> dict[str, list[int]]:
        """Count the states of each set by number of steps from the complete structure."""
        count = self.task.steps + 1
        return {
            name: np.bincount(self.task.steps_done(states), minlength=count).tolist()
            for name, states in ((name, getattr(self, name)) for name in _SETS)
        }


def save_dataset(dataset: Dataset, path: Path | str) -> None:
    """Write the data set as a versioned `.npz`."""
    header = {
        "name": dataset.name,
        "identity": dataset.task.identity,
        "robots": dataset.task.robots,
        "removable_only_if_clear": dataset.task.clearance is not None,
        "fixed": list(dataset.task.fixed),
        "train_width": dataset.settings.train_width,
        "test_width": dataset.settings.test_width,
        "criterion": dataset.criterion,
    }
    arrays = {name: getattr(dataset, name) for name in _SETS}
    write_archive(path, FORMAT, header, arrays | {"boundary": dataset.task.boundary})


def load_dataset(path: Path | str, assembly: Assembly) -> Dataset:
    """Read a data set that `save_dataset` wrote.

    Raises:
        InputError: no such file, a damaged one, one of another version, or one of another structure.
    """
    header, arrays = read_archive(path, FORMAT, _ARRAYS)
    criterion = read_criterion(path, header, "make it anew")
    check_header(path, header, _KINDS, "make it anew")
    if header["identity"] != assembly.identity:
        raise InputError(f"{path} is a data set of {header['name']}, not of {assembly.name}; make one for it")
    with blamed_on(path, "make it anew"):
        task = training_task(assembly, header["robots"], header["removable_only_if_clear"], header["fixed"])
        task = replace(task, holds_keep_stable=criterion == "equilibrium")
        found = {name: arrays[name] for name in _SETS}
        check_states(path, found, task.part_count, "make it anew")
        settings = DataSettings(header["train_width"], header["test_width"])
    train, test, validation, more = (found[name] for name in _SETS)
    return Dataset(train, test, validation, more, task=task, name=header["name"], settings=settings)


def check_states(path: Path | str, arrays: Mapping[str, NDArray[Any]], parts: int, remedy: str) -> None:
    """Refuse arrays of a file that are not states of so many parts.

    Args:
        arrays: by name.
        remedy: remedy, for the message.

    Raises:
        InputError: one of them holds anything else.
    """
    for name, states in arrays.items():
        if states.ndim != 2 or states.shape[1] != parts or states.dtype != np.uint8 or (states > HELD).any():
            raise InputError(f"{path} is damaged ({name} contains no states of {parts} parts); {remedy}")


def training_task(
    assembly: Assembly, robots: int = 2, removable_only_if_clear: bool = False, fixed: Sequence[int] = ()
) -> Task:
    """Return the task of complete disassembly that data sets and policies use.

    Args:
        robots: parts held at a time.
        removable_only_if_clear: parts are removed only if they have a free exit direction.
        fixed: parts that are never touched.

    Raises:
        InputError: fewer than one robot, or parts that do not exist.
    """
    table = assembly.clearance if removable_only_if_clear else None
    return Task.from_rules(assembly.boundary, robots, fixed=tuple(fixed), clearance=table, identity=assembly.identity)


def search_states(
    task: Task,
    oracle: TensorOracle,
    width: int,
    seed: int,
    *,
    device: torch.device | str = "cpu",
    shards: ProcessGroup = ProcessGroup(),
    direction: Direction = Direction.ASSEMBLY,
    report: Report | None = None,
    stop: Stop | None = None,
) -> tuple[States, bool]:
    """Return the states of one beam search, and whether it reached its other end.

    In the direction of assembly each of them is solvable, since the search reached it from the empty structure.

    Args:
        oracle: verdicts on tensors.
        width: states kept a level.
        device: where to search; the states are the same on each.
        shards: processes that search together.
        report: called with progress messages.
        stop: asked before every level; true ends the search with the states that it has.

    Returns:
        Shape (count, parts), and a truth value.
    """
    search = device_beam(task, oracle, BeamSettings(width, direction, seed=seed), device, shards)

    def show(now: Any) -> None:
        if report is not None:
            report(f"search of width {width}: step {now.level} of {now.levels}")

    result = search.run(progress=show, stop=stop)
    if result.interrupted and not (stop is not None and stop()):
        raise KeyboardInterrupt
    return search.states(), result.found


def search_several(
    task: Task,
    oracle: TensorOracle,
    count: int,
    width: int,
    direction: Direction,
    seed: int,
    *,
    device: torch.device,
    shards: ProcessGroup = ProcessGroup(),
) -> tuple[States, float]:
    """Return the states of narrow searches run side by side over all processes, and how many searches completed.

    Args:
        oracle: verdicts on tensors.
        count: searches.
        width: states that each keeps a level.
        shards: processes that share the searches.

    Returns:
        Shape (count, parts), and a number of searches.
    """
    import torch

    from falsework.utils.collectives import gather_rows, summed

    mine = len(range(shards.rank, count, shards.size))
    states, through = np.empty((0, task.part_count), dtype=np.uint8), 0.0
    if mine:
        own = seed * shards.size + shards.rank
        states, found = parallel_beam_search(task, oracle, mine, width, direction=direction, seed=own, device=device)
        through = float(found.sum())
    if shards.size > 1:
        states = gather_rows(torch.from_numpy(states).to(device), shards).cpu().numpy()
        through = summed([through], shards, device)[0]
    return states, through


def build_dataset(
    assembly: Assembly,
    task: Task,
    settings: DataSettings = DataSettings(),
    *,
    oracle: TensorOracle | None = None,
    device: str = "auto",
    shards: ProcessGroup = ProcessGroup(),
    report: Report | None = None,
    stop: Stop | None = None,
) -> Dataset:
    """Run the searches of the paper's protocol and, with `widths`, further ones.

    Args:
        task: task to learn, as of `training_task`.
        settings: widths and seed.
        oracle: verdicts, whose criterion the data set then names; made if not given.
        device: `auto`, `cpu` or `cuda`.
        shards: processes that search together.
        report: called with progress messages.
        stop: of one process, asked before every level and search; true ends all with the states that they have, and the
            data set is not complete then.

    Raises:
        DependencyError: torch is not installed.
        InputError: no such device, or no path leads from the empty structure to the complete one.
    """
    from falsework.stability.oracle import StabilityOracle

    where = choose_device(device)
    asked = tensor_oracle(StabilityOracle(assembly), where) if oracle is None else oracle
    task = task.judged_by(asked)
    seconds: dict[str, float] = {}
    found: list[States] = []
    complete = True
    # States to test on are judged to the last one; of those to learn from a few may be missing.
    searches = [(width, 1) for width in (settings.train_width, settings.test_width, settings.test_width)]
    searches += [(width, len(list(equal))) for width, equal in groupby(settings.widths)]
    seed = settings.seed
    for width, count in searches:
        begin = time.perf_counter()
        if count == 1:
            states, reached = search_states(
                task, asked, width, seed, device=where, shards=shards, report=report, stop=stop
            )
        elif stop is not None and stop():
            states, reached = found[0][:0], False
        else:
            if report is not None:
                report(f"{count} searches of width {width}")
            judge, way = without_fallback(asked), Direction.ASSEMBLY
            states, through = search_several(task, judge, count, width, way, seed, device=where, shards=shards)
            reached = through > 0
        complete &= reached
        found.append(states)
        several = f"{count} of " if count > 1 else ""
        seconds[f"{several}width {width}, seed {seed}"] = round(time.perf_counter() - begin, 3)
        seed += count
    train = found[0]
    test = found[1][_absent(found[1], train)]
    validation = found[2][_absent(found[2], np.concatenate([train, test]))]
    chosen = np.random.default_rng(settings.seed).permutation(len(validation))[:VALIDATION_STATES]
    validation = validation[np.sort(chosen)]
    more = np.concatenate([train[:0], *found[3:]])
    if len(more):
        more = np.unique(more, axis=0)
        more = more[_absent(more, np.concatenate([train, test, validation]))]
        more = more[np.argsort(task.steps_done(more), kind="stable")]
    return Dataset(train, test, validation, more, task, assembly.name, settings, complete, seconds)


def _absent(states: States, others: States) -> Mask:
    """Return whether each state is absent from others, shape (batch,)."""
    return StateIndex(np.unique(others, axis=0)).find(states) < 0

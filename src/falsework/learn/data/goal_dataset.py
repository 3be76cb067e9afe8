"""Data of goal-conditioned policies: tasks to learn from, and unseen ones to test on (paper, section 7.2, Table 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.learn.data.dataset import DataSettings, Report, check_states, search_several, search_states
from falsework.learn.data.goal_pairs import Pairs, PairSource, unsolved_at_random
from falsework.learn.env.verdict_cache import VerdictTable
from falsework.search.device.oracle import TensorOracle, tensor_oracle, without_fallback
from falsework.search.device.rules import TensorRules
from falsework.search.problem.state_graph import StateGraph, criterion_of, read_criterion
from falsework.search.problem.task import Direction, Task
from falsework.utils.archive import read_archive, write_archive
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import choose_device

if TYPE_CHECKING:
    import torch

FORMAT = "falsework.searched/1"

_ARRAYS = frozenset({"train", "test", "more"})

_BATCH_GPU, _BATCH_CPU = 64, 4
"""Further searches that run side by side, on a GPU and on a processor; the time is looked at between them."""
_ROUNDS = 8
"""Times that a pair is drawn for each target, at most, to find enough of them."""
_VALIDATION = 5
"""One unseen pair in so many is for validation, at least; so many times fewer of them than test pairs are enough."""
_COMPLETED_SHARE = 0.25
"""Share of searches that must complete, or the next ones begin at the other end."""


@dataclass(frozen=True)
class GoalDataSettings(DataSettings):
    """Searches of a data set of pairs (paper, section 7.2, Table 4); those of the protocol begin at its start."""

    test_pairs: int = 2_000
    """Unseen pairs at most."""
    random_tries: int = 16
    """Rollouts of random legal actions none of which may solve a pair that is tested. A pair that they solve with
    probability p stays with probability (1 - p)^16: were all p equally frequent, those of the pairs that stay would
    have a mean of 1 / 18."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("test_pairs", "random_tries"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is a count; give at least 1")


@dataclass(frozen=True, eq=False)
class GoalDataset:
    """Pairs of start and target of one structure; no start or target of a test pair is one of the training states."""

    train: Pairs
    """From the search of the training width, as many as test pairs at most; no others are learned from."""
    test: Pairs
    """Unseen: neither start nor target is in the training graph."""
    validation: Pairs
    """Unseen as well, other pairs than those of the test, to choose by."""
    graph: StateGraph
    """All training states."""
    wide: StateGraph
    """Those and the states of further searches; the same graph where there are none."""
    task: Task
    name: str = ""
    settings: GoalDataSettings = field(default_factory=GoalDataSettings)

    @property
    def held_out(self) -> States:
        """Every start and target of test and validation pairs once, never used for training. Shape (count, parts)."""
        kept = (self.test, self.validation)
        return np.unique(np.concatenate([states for pairs in kept for states in (pairs.states, pairs.targets)]), axis=0)


@dataclass(frozen=True, eq=False)
class SearchStates:
    """States of the searches of a `GoalDataset`; finding them takes far longer than connecting them."""

    train: States
    """Of the first search, shape (count, parts)."""
    test: States
    """Of the search that unseen pairs come from."""
    more: States
    """Of all further ones, one after the other: few come twice, and a graph holds them once."""

    @classmethod
    def find(
        cls,
        task: Task,
        settings: GoalDataSettings,
        oracle: TensorOracle,
        *,
        device: torch.device,
        shards: ProcessGroup = ProcessGroup(),
        report: Report | None = None,
        should_stop: Callable[[], bool] | None = None,
    ) -> SearchStates:
        """Search.

        Args:
            task: as of `build_goal_dataset`, like the next four.
            settings: widths and seed.
            shards: processes that search together.
            report: called with progress messages.
            should_stop: asked before each lot of further searches, in all processes alike, whether they and those after
                them can be left out.
        """
        # A search from the complete structure passes many states that a GPU leaves open, each a wait for the processor.
        judge, first = without_fallback(oracle), []
        for number, width in enumerate((settings.train_width, settings.test_width)):
            if report is not None:
                report(f"search {number + 1} of {2 + len(settings.widths)}, width {width}")
            seed, way = settings.seed + number, Direction.DISASSEMBLY
            first.append(search_states(task, judge, width, seed, device=device, shards=shards, direction=way)[0])
        together = _BATCH_GPU if device.type == "cuda" else _BATCH_CPU
        more, done, way = [first[0][:0]], 0, Direction.DISASSEMBLY
        while done < len(settings.widths) and not (should_stop is not None and should_stop()):
            width = settings.widths[done]
            count = sum(1 for _ in takewhile(width.__eq__, settings.widths[done : done + together * shards.size]))
            if report is not None:
                report(f"searches {done + 3} to {done + count + 2} of {2 + len(settings.widths)}, width {width}")
            seed = settings.seed + 2 + done
            states, through = search_several(task, judge, count, width, way, seed, device=device, shards=shards)
            more.append(states)
            done += count
            # States beyond the point where most searches die out are found from the other end.
            died = way is Direction.DISASSEMBLY and through < _COMPLETED_SHARE * count
            way = Direction.ASSEMBLY if died else Direction.DISASSEMBLY
        return cls(first[0], first[1], np.concatenate(more))

    def save(self, path: Path | str, task: Task) -> None:
        """Write the states as a versioned `.npz`."""
        header = {"identity": task.identity, "criterion": criterion_of(task)}
        write_archive(path, FORMAT, header, {name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def load(cls, path: Path | str, task: Task) -> SearchStates:
        """Read what `save` wrote.

        Raises:
            InputError: no such file, a damaged one, one of another version, or one of another structure or criterion.
        """
        header, arrays = read_archive(path, FORMAT, _ARRAYS)
        criterion = read_criterion(path, header, "remove it")
        if criterion != criterion_of(task):
            raise InputError(f"{path} has states that are stable under the criterion {criterion}; remove it")
        if header.get("identity") != task.identity:
            raise InputError(f"{path} has states of another structure; remove it")
        check_states(path, arrays, task.part_count, "remove it")
        return cls(**arrays)


def build_goal_dataset(
    assembly: Assembly,
    task: Task,
    settings: GoalDataSettings = GoalDataSettings(),
    *,
    oracle: TensorOracle | None = None,
    device: str = "auto",
    shards: ProcessGroup = ProcessGroup(),
    searched: SearchStates | None = None,
) -> GoalDataset:
    """Run the searches of the protocol of Table 4 and draw the pairs.

    The paper's training set is what a search of width 64 from the complete structure finds; unseen pairs come from a
    search of width 128, and both their states are new. For all of them a path leads from start to target that uniformly
    random legal actions did not find: pairs that these solve say little about a policy. Further searches add states,
    and with them paths, along which `falsework.learn.data.random_walks.RandomWalkGoals` draws tasks.

    Args:
        task: complete disassembly, as of `falsework.learn.data.dataset.training_task`.
        settings: widths, numbers of pairs and seed.
        oracle: verdicts; made if not given.
        device: `auto`, `cpu` or `cuda`.
        shards: processes that search together.
        searched: states of these searches, if there are any already.

    Raises:
        DependencyError: torch is not installed.
        InputError: no such device, or a structure so small that the wider search finds no new pair.
    """
    from falsework.stability.oracle import StabilityOracle

    where = choose_device(device)
    asked = tensor_oracle(StabilityOracle(assembly), where) if oracle is None else oracle
    task = task.judged_by(asked)
    if searched is None:
        searched = SearchStates.find(task, settings, asked, device=where, shards=shards)
    graph = StateGraph.from_states(task, searched.train, name=assembly.name)
    wider = StateGraph.from_states(task, searched.test, name=assembly.name)
    rng = np.random.default_rng(settings.seed)
    train = PairSource(graph).draw(rng, settings.test_pairs)
    wanted = settings.test_pairs + -(-settings.test_pairs // _VALIDATION)
    unseen = _unseen(wider, graph.states, wanted, TensorRules(task, where), without_fallback(asked), rng, settings)
    count = min(settings.test_pairs, len(unseen) - len(unseen) // _VALIDATION)
    test = unseen[:count]
    validation = unseen[count:]
    if len(test) == 0:
        raise InputError(
            f"a search of width {settings.test_width} finds no pair of states of {assembly.name} that one of width "
            f"{settings.train_width} has not seen and that random actions do not solve; test with a greater width"
        )
    wide = graph
    if len(searched.more):
        wide = StateGraph.from_states(task, np.concatenate([searched.train, searched.more]), name=assembly.name)
    return GoalDataset(train, test, validation, graph, wide, task, assembly.name, settings)


def _unseen(
    wider: StateGraph,
    seen: States,
    count: int,
    rules: TensorRules,
    oracle: TensorOracle,
    rng: np.random.Generator,
    settings: GoalDataSettings,
) -> Pairs:
    """Return at most `count` pairs of a graph that are not among `seen` and not solved by random actions."""
    try:
        source = PairSource(wider, held_out=seen)
    except InputError:
        return PairSource(wider).draw(rng, 1)[:0]
    kept: list[Pairs] = []
    known = VerdictTable(rules)
    for number in range(_ROUNDS):
        drawn = source.draw(rng, 2 * count)
        kept.append(drawn[unsolved_at_random(drawn, rules, oracle, known, settings.random_tries, number)])
        pairs = Pairs.join(kept)
        both = np.concatenate([pairs.states, pairs.targets], axis=1)
        kept = [pairs[np.sort(np.unique(both, axis=0, return_index=True)[1])]]
        if len(kept[0]) >= count:
            break
    return kept[0][:count]

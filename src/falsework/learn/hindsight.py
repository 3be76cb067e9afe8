"""Two-state tasks: pairs of start and target, and failed rollouts seen as successes at something else.

Any state that a stable way passes can be made the target of that way: the actions that led to it keep what it keeps
(paper, section 5.3). So a state graph searched in the direction of disassembly holds a task for every pair of states
that one way connects, and a rollout that failed still shows how to get to all it passed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States
from falsework.errors import InputError
from falsework.learn.data import search_states
from falsework.learn.rollout import Policy, Rollouts
from falsework.search.graph import StateGraph
from falsework.search.hashing import StateIndex
from falsework.search.shards import Shards
from falsework.search.task import Direction, Task
from falsework.search.tensor_judge import TensorOracle, oracle_on
from falsework.search.tensors import choose_device, put

_WORD = 64
_TARGETS = 1024
"""Targets looked at together."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """States with targets and the actions that are known to lead there."""

    states: States
    """Shape (count, parts)."""
    targets: States
    """Shape (count, parts)."""
    valid: Mask
    """At least one a row, shape (count, 2 parts)."""

    def __len__(self) -> int:
        return len(self.states)

    def tensors(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """States, targets and valid actions on a device."""
        return put(self.states, device), put(self.targets, device), put(self.valid, device)


class PairSource:
    """Draws pairs of states of one graph between which a way runs inside the graph."""

    def __init__(self, graph: StateGraph, *, forbidden: States | None = None) -> None:
        """Prepare a graph, usually one that was searched in the direction of disassembly.

        Args:
            graph: states and valid actions.
            forbidden: states that are neither start nor target of any pair, such as those kept for testing; ways may
                lead through them. Shape (count, parts).

        Raises:
            InputError: no way between any two states that are allowed.
        """
        self.graph = graph
        states = graph.states
        self._allowed = np.ones(len(states), dtype=bool)
        if forbidden is not None and len(forbidden):
            self._allowed = StateIndex(np.unique(forbidden, axis=0)).find(states) < 0
        self._levels = [edges for edges in graph.edges_by_level() if edges.stop > edges.start]
        # Rows of `after` are the successors of each state; the last row, which no target is ever found in, is nobody's.
        self._after = np.full((len(states), 2 * states.shape[1]), len(states), dtype=np.int32)
        self._after[graph.source, graph.action] = graph.target
        has_way = np.zeros(len(states), dtype=bool)
        has_way[graph.target] = True
        self._ends = np.flatnonzero(self._allowed & has_way)
        if len(self._ends) == 0:
            raise InputError("no way leads between two states of this graph; search with a greater width")

    @property
    def ends(self) -> NDArray[np.intp]:
        """States that can be targets, as rows of the graph."""
        return self._ends

    def draw(self, count: int, rng: np.random.Generator) -> Pairs:
        """Pairs with targets drawn evenly, and starts drawn evenly from those with a way to the target.

        Args:
            count: how many; fewer come back only if a target has no allowed start.
            rng: source of randomness.
        """
        per_target = max(1, count // _TARGETS)
        pieces: list[Pairs] = []
        missing = count
        for _ in range(4 * (1 + count // (_TARGETS * per_target))):
            if missing <= 0:
                break
            ends = rng.choice(self._ends, size=min(_TARGETS, -(-missing // per_target)))
            pieces.append(self._pairs(ends, per_target, rng))
            missing -= len(pieces[-1])
        return _joined(pieces, count)

    def one_for_each_end(self, rng: np.random.Generator) -> Pairs:
        """One pair for every state that can be a target and has an allowed start, in random order."""
        ends = rng.permutation(self._ends)
        pieces = [self._pairs(ends[begin : begin + _TARGETS], 1, rng) for begin in range(0, len(ends), _TARGETS)]
        return _joined(pieces, len(ends))

    def _pairs(self, ends: NDArray[np.intp], per_target: int, rng: np.random.Generator) -> Pairs:
        graph = self.graph
        leads = self._leads_to(ends)
        chosen = []
        block = np.empty((0, 0), dtype=bool)
        for column, end in enumerate(ends):
            if column % _WORD == 0:
                bits = leads[:-1, column // _WORD, None].view(np.uint8)
                block = np.ascontiguousarray(np.unpackbits(bits, axis=1, bitorder="little").T).astype(bool)
            starts = block[column % _WORD] & self._allowed
            starts[end] = False
            rows = np.flatnonzero(starts)
            if len(rows):
                chosen.append(np.stack([rng.choice(rows, size=per_target), np.full(per_target, column)]))
        row, column = np.concatenate(chosen, axis=1) if chosen else np.empty((2, 0), dtype=np.intp)
        word, bit = column // _WORD, (column % _WORD).astype(np.uint64)
        after = self._after[row]
        valid = (leads[after, word[:, None]] >> bit[:, None]) & np.uint64(1)
        return Pairs(graph.states[row], graph.states[ends[column]], valid.astype(bool))

    def _leads_to(self, ends: NDArray[np.intp]) -> NDArray[np.uint64]:
        """From which states a way leads to each end: bit `k` of a row says whether it leads to `ends[k]`.

        Returns:
            Shape (states + 1, words); the last row is empty.
        """
        words = -(-len(ends) // _WORD)
        leads = np.zeros((len(self.graph) + 1, words), dtype=np.uint64)
        place = np.arange(len(ends))
        bits = np.uint64(1) << (place % _WORD).astype(np.uint64)
        np.bitwise_or.at(leads, (ends, place // _WORD), bits)
        for edges in reversed(self._levels):
            source, begin = np.unique(self.graph.source[edges], return_index=True)
            leads[source] |= np.bitwise_or.reduceat(leads[self.graph.target[edges]], begin, axis=0)
        return leads


def sample_pairs(graph: StateGraph, count: int, rng: np.random.Generator, *, forbidden: States | None = None) -> Pairs:
    """Draw pairs of a graph once; `PairSource` draws again and again.

    Args:
        graph: searched in the direction of disassembly.
        count: how many.
        rng: source of randomness.
        forbidden: states that are neither start nor target.
    """
    return PairSource(graph, forbidden=forbidden).draw(count, rng)


def relabel(
    rollouts: Rollouts, count: int, generator: torch.Generator, *, failed_only: bool = True
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Hindsight: states of rollouts with a state that was passed later as the target.

    Whatever the rollouts were after, and however they ended, the actions up to a stable state were legal on the way
    to that state and led there.

    Args:
        rollouts: with all states kept.
        count: samples wanted.
        generator: source of randomness on the device of the rollouts.
        failed_only: leave rollouts out that reached what they were after.

    Returns:
        States and targets, both `uint8`, shape (samples, parts), and the action that was taken, `int64`, shape
        (samples,). No samples if no rollout took an action that left it stable.
    """
    stable = rollouts.length - rollouts.unstable.long()
    usable = (stable > 0) & ~(rollouts.success if failed_only else torch.zeros_like(rollouts.success))
    rows = usable.nonzero()[:, 0]
    if len(rows) == 0:
        none = rollouts.states.new_empty((0, rollouts.states.shape[2]))
        return none, none, rollouts.length.new_empty(0)
    device = rows.device
    # A long rollout has more to tell: draw pairs of steps, not rollouts, evenly.
    steps = stable[rows].double()
    row = rows[torch.multinomial(steps * (steps + 1) / 2, count, replacement=True, generator=generator)]
    last = stable[row]
    one, two = (torch.rand(count, generator=generator, device=device, dtype=torch.float64) for _ in range(2))
    first = (one * (last + 1)).long()
    second = (two * last).long()
    second = second + (second >= first).long()  # any other step
    begin, end = torch.minimum(first, second), torch.maximum(first, second)
    return rollouts.states[begin, row], rollouts.states[end, row], rollouts.actions[begin, row].long()


class OneState:
    """A policy that is not told the target, as the baseline for targets.

    What the target keeps, it keeps only because the rules forbid to touch it (`Rules.mask` with targets).
    """

    def __init__(self, policy: Policy) -> None:
        """Wrap a policy of one state."""
        self._policy = policy

    def __call__(self, states: torch.Tensor, targets: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """As `Policy`; takes no notice of the targets."""
        return self._policy(states)


@dataclass(frozen=True)
class TargetDataSettings:
    """Which searches make a data set of pairs (paper, section 7.2, Table 4)."""

    train_width: int = 64
    """Width of the search, in the direction of disassembly, whose states are those to learn from."""
    test_width: int = 128
    """Width of the search that unseen pairs come from."""
    widths: tuple[int, ...] = ()
    """Widths of further searches to learn from."""
    pairs: int = 20_000
    """Pairs to learn from, drawn from the first graph and as many again from each further one."""
    test_pairs: int = 2_000
    """Unseen pairs at most."""
    seed: int = 0
    """Of the first search; each further one, the test search included, adds one."""

    def __post_init__(self) -> None:
        for width in (self.train_width, self.test_width, *self.widths):
            if width < 1:
                raise InputError(f"a search of width {width} finds nothing; give at least 1")
        if self.pairs < 1 or self.test_pairs < 1:
            raise InputError("pairs and test_pairs are counts; give at least 1")
        if self.seed < 0:
            raise InputError(f"a seed is not negative; {self.seed} was given")


@dataclass(frozen=True, eq=False)
class TargetDataset:
    """Pairs of start and target of one structure; no start or target of a test pair is one of the training states."""

    train: Pairs
    """From the search of the training width."""
    test: Pairs
    """Unseen: neither start nor target is in the training graph."""
    more: Pairs
    """From further searches; neither start nor target is in a test pair."""
    graph: StateGraph
    """All training states."""
    task: Task
    name: str = ""
    settings: TargetDataSettings = field(default_factory=TargetDataSettings)

    @property
    def test_states(self) -> States:
        """Every start and target of the test pairs once, to be kept out of training; shape (count, parts)."""
        return np.unique(np.concatenate([self.test.states, self.test.targets]), axis=0)


def target_dataset(
    assembly: Assembly,
    task: Task,
    settings: TargetDataSettings = TargetDataSettings(),
    *,
    oracle: TensorOracle | None = None,
    device: str = "auto",
    shards: Shards = Shards(),
) -> TargetDataset:
    """Run the searches of the protocol of Table 4 and draw the pairs.

    The paper's training set is what a search of width 64 from the complete structure finds; unseen pairs come from
    a search of width 128, and both their states are new. All of them have a way from start to target.

    Args:
        assembly: the structure.
        task: taking all of it apart, as of `falsework.learn.data.task_for`.
        settings: widths, numbers of pairs and seed.
        oracle: verdicts; made if not given.
        device: `auto`, `cpu` or `cuda`.
        shards: processes that search together.

    Raises:
        DependencyError: torch is not installed.
        InputError: no such device, or a structure so small that the wider search finds no new pair.
    """
    from falsework.stability import Stability

    where = choose_device(device)
    asked = oracle_on(Stability(assembly), where) if oracle is None else oracle
    forward = Direction.DISASSEMBLY

    def graph_of(number: int, width: int) -> StateGraph:
        seed = settings.seed + number
        states, _ = search_states(task, asked, width, seed, device=where, shards=shards, direction=forward)
        return StateGraph.build(task, states, name=assembly.name)

    graph = graph_of(0, settings.train_width)
    wider = graph_of(1, settings.test_width)
    rng = np.random.default_rng(settings.seed)
    train = PairSource(graph).draw(settings.pairs, rng)
    source = _unseen(wider, graph.states)
    if source is None:
        raise InputError(
            f"a search of width {settings.test_width} finds no pair of states of {assembly.name} that one of width "
            f"{settings.train_width} has not seen; test with a greater width"
        )
    test = _cut(source.one_for_each_end(rng), settings.test_pairs)
    kept = np.unique(np.concatenate([test.states, test.targets]), axis=0)
    more = [
        PairSource(graph_of(2 + number, width), forbidden=kept).draw(settings.pairs, rng)
        for number, width in enumerate(settings.widths)
    ]
    return TargetDataset(
        train, test, _joined([_none(task.part_count), *more], None), graph, task, assembly.name, settings
    )


def _unseen(wider: StateGraph, seen: States) -> PairSource | None:
    """Pairs of states of a graph that are not among `seen`; None if there is no such pair."""
    try:
        source = PairSource(wider, forbidden=seen)
    except InputError:
        return None
    return source if len(source.one_for_each_end(np.random.default_rng(0))) else None


def _none(parts: int) -> Pairs:
    empty = np.empty((0, parts), dtype=np.uint8)
    return Pairs(empty, empty, np.empty((0, 2 * parts), dtype=bool))


def _cut(pairs: Pairs, count: int) -> Pairs:
    return Pairs(pairs.states[:count], pairs.targets[:count], pairs.valid[:count])


def _joined(pieces: list[Pairs], count: int | None) -> Pairs:
    columns = ([getattr(piece, name) for piece in pieces] for name in ("states", "targets", "valid"))
    return _cut(
        Pairs(*(np.concatenate(column) for column in columns)), sum(map(len, pieces)) if count is None else count
    )

"""Beam search on tensors, on one device, in one process or several (paper, section 5.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from falsework.errors import InputError
from falsework.search.beam.frontier import Level
from falsework.search.beam.level_search import LevelSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.device.k_means import find_centers
from falsework.search.device.oracle import BatchedTensorOracle, TensorOracle
from falsework.search.device.rules import TensorRules
from falsework.search.problem.result import (
    REPORTED_STATES,
    Outcome,
    SearchCounters,
    SearchResult,
    beam_failure,
)
from falsework.search.problem.task import Task
from falsework.stability.verdict import Verdict
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import import_torch, mix, place_in_group

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch

T = TypeVar("T")

_SAMPLES_PER_CLUSTER = 4
"""Candidates a cluster that the centres are found from; all are assigned to clusters afterwards."""
_CHUNK_BYTES = 1 << 28
"""Memory for states expanded at once where they are only read, in bytes."""


@dataclass(eq=False)
class _TensorLevel:
    """States kept the same number of steps away from the origin, as in `Level`, with their hashes."""

    states: torch.Tensor
    parent: torch.Tensor
    action: torch.Tensor
    hashes: torch.Tensor


@dataclass(eq=False)
class _Candidates:
    """Distinct states one move away from a level, ordered by hash and not written down."""

    parent: torch.Tensor
    action: torch.Tensor
    hashes: torch.Tensor
    free: torch.Tensor
    """Stable because the level is."""

    def __len__(self) -> int:
        return len(self.parent)

    def take(self, rows: torch.Tensor | slice) -> _Candidates:
        """Return some of the candidates."""
        return _Candidates(*(getattr(self, name)[rows] for name in ("parent", "action", "hashes", "free")))


class _Beside(Generic[T]):
    """Work on a stream of its own, on the multiprocessors that verdicts leave idle."""

    def __init__(self, stream: torch.cuda.Stream | None, work: Callable[[], T]) -> None:
        """Take note of what is queued so far, on which the work may build; without a stream, it is done in turn."""
        self._stream, self._work = stream, work
        self._before = None if stream is None else import_torch().cuda.current_stream(stream.device).record_event()
        self._found: list[T] = []

    def begin(self) -> None:
        """Queue the work."""
        if self._stream is None or self._before is None:
            self._found = [self._work()]
            return
        with import_torch().cuda.stream(self._stream):
            self._stream.wait_event(self._before)
            self._found = [self._work()]

    def result(self) -> T:
        """Return what was found, for what is queued from now on."""
        if self._stream is not None:
            import_torch().cuda.current_stream(self._stream.device).wait_stream(self._stream)
        return self._found[0]


class DeviceBeam(LevelSearch):
    """Beam search as `BeamSearch`, with the states of all levels on one device.

    Rules, direction, width, diversity and verdicts mean the same; which of equally good states survive differs, since
    random numbers come from the hashes of states, and all candidates of a level are put in clusters while verdicts are
    awaited, so that a cluster may be left without a stable state. A level reads five sizes of lists back to the host,
    one more with a clearance table; nothing else leaves the device before the end. Several processes share verdicts and
    clustering and repeat the rest, which is cheap, each for itself (docs/decisions/gpu-solver.md): for one seed the
    levels are the same whatever the number of processes.
    """

    def __init__(
        self,
        task: Task,
        oracle: TensorOracle,
        settings: BeamSettings = BeamSettings(),
        *,
        device: torch.device | str = "cpu",
        shards: ProcessGroup = ProcessGroup(),
    ) -> None:
        """Begin at the origin of the direction; the start and the target are taken as stable.

        Args:
            task: rules between start and target.
            oracle: verdicts on tensors; it also determines which moves need one, see `Task.judged_by`.
            settings: width, direction, diversity and seed; levels are always judged whole (`lookahead` is 0).
            device: where the search lives.
            shards: the processes that search together; all must be given the same task and settings.

        Raises:
            DependencyError: torch is not installed.
            InputError: settings with `lookahead`, which requests verdicts one by one.
        """
        if settings.lookahead:
            raise InputError("a beam on a device judges whole levels; set lookahead to 0, or use BeamSearch")
        torch = import_torch()
        task = task.judged_by(oracle)
        super().__init__(task, settings)
        self._levels: list[_TensorLevel]
        self.device = torch.device(device)
        self.shards = shards
        self.exhaustive = True
        """No state was left out so far: if the search dies now, there is no plan."""
        self.rules = TensorRules(task, self.device, settings.direction)
        self._judge = BatchedTensorOracle(oracle, shards)
        self._side = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        self._candidates = self._verdicts = 0
        self._refused = torch.zeros(3, dtype=torch.int64, device=self.device)
        """Numbers of states that are not stable, and of these undecided and sliding."""
        self._rejected = np.empty((0, task.part_count), dtype=np.uint8)
        self._host: list[Level] = []
        origin = self.rules.origin()
        self._dead = not task.contains(task.origin(settings.direction)[None])[0]
        if not self._dead:
            none = torch.zeros(1, dtype=torch.int64, device=self.device)
            self._levels.append(_TensorLevel(origin, none, none - 1, self.rules.hashes(origin)))

    @property
    def counters(self) -> SearchCounters:
        """Work done so far, by all processes."""
        states = sum(len(level.states) for level in self._levels)
        return SearchCounters(states, self._candidates, self._verdicts, int(self._refused[0]))

    @property
    def levels(self) -> list[Level]:  # type: ignore[override]
        """Levels so far, copied to the host."""
        for level in self._levels[len(self._host) :]:
            states, parent, action = (one.cpu().numpy() for one in (level.states, level.parent, level.action))
            count = len(states)
            self._host.append(Level(states, parent, action, np.zeros(count), np.ones(count, dtype=np.int8)))
        return self._host

    def step(self) -> bool:
        """Find the next level; False if there is none."""
        torch = import_torch()
        if self.done:
            return False
        level, width = self._levels[-1], self.settings.width
        candidates = self._expand(level)
        stable = candidates.free.clone()
        asked = (~stable).nonzero()[:, 0]
        clusters = _Beside(self._side, lambda: self._cluster(level, candidates))
        mine = candidates.take(asked[self.shards.interleaved()])
        after, before = self._written(level, mine), level.states[mine.parent]
        verdicts = self._judge.verdicts(after, before, len(asked), clusters.begin)
        stable[asked] = verdicts == Verdict.STABLE
        moving = (verdicts == Verdict.SLIDES) | (verdicts == Verdict.TIPS)
        answers = (verdicts != Verdict.STABLE, verdicts == Verdict.UNDECIDED, moving)
        self._refused += torch.stack([answer.sum() for answer in answers])
        chosen, found = _choose(stable, *clusters.result(), width)
        self._candidates += len(candidates)
        self._verdicts += len(asked)
        self.exhaustive &= found <= width
        self._dead = found == 0
        if self._dead:
            some = candidates.take(asked[:REPORTED_STATES])
            self._rejected = self._written(level, some).cpu().numpy()
            return False
        kept = candidates.take(chosen)
        self._levels.append(_TensorLevel(self._written(level, kept), kept.parent, kept.action, kept.hashes))
        return True

    def _advance(self) -> None:
        self.step()

    @property
    def _asked(self) -> int:
        return self._verdicts

    def result(self, *, interrupted: bool = False) -> SearchResult:
        """See `LevelSearch.result`."""
        (_, undecided, sliding), limit = self._refused.tolist(), ""
        outcome = Outcome.FOUND if self.found else Outcome.NOT_FOUND
        if not self.found and not interrupted:
            outcome, limit = beam_failure(self.settings.width, self.exhaustive, undecided, sliding, self.task.caveat)
        return SearchResult(
            outcome=outcome,
            routes=(self.route(),) if self.found else (),
            direction=self.settings.direction,
            steps=self.task.steps,
            reached=max(len(self._levels) - 1, 0),
            deepest=self.levels[-1].states[:REPORTED_STATES] if self._levels else self._rejected[:0],
            rejected=self._rejected,
            counters=self.counters,
            seconds=self._seconds,
            interrupted=interrupted,
            limit=limit,
            undecided=undecided,
            sliding=sliding,
            notes=tuple(self._judge.notes),
        )

    def _expand(self, level: _TensorLevel) -> _Candidates:
        """Return every legal move from a level; states reached twice are kept once, dead ends not at all."""
        torch = import_torch()
        rules = self.rules
        mask = rules.moves(level.states)
        parent, action, hashes = rules.children(level.states, level.hashes, mask)
        first, group = self._merge(level, hashes, parent, action)
        free = torch.zeros(len(first), dtype=torch.int32, device=self.device)
        free.index_add_(0, group, (~rules.needs_verdict(action)).int())
        candidates = _Candidates(parent[first], action[first], hashes[first], free > 0)
        if self.task.clearance is None:
            return candidates
        alive = torch.ones(len(candidates), dtype=torch.bool, device=self.device)
        for rows in self._chunks(len(candidates)):
            alive[rows] = ~rules.dead_ends(self._written(level, candidates.take(rows)))
        return candidates.take(alive.nonzero()[:, 0])

    def _merge(
        self, level: _TensorLevel, hashes: torch.Tensor, parent: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Find equal states among many.

        Returns:
            First occurrence of each distinct state, ordered by hash, shape (distinct,), and for every state the
            position of its representative in that list.
        """
        torch = import_torch()
        count = len(hashes)
        if count == 0:
            return parent, parent
        ordered, order = torch.sort(hashes, stable=True)
        repeats = torch.zeros(count, dtype=torch.bool, device=self.device)
        repeats[1:] = ordered[1:] == ordered[:-1]
        differ = torch.zeros((), dtype=torch.int64, device=self.device)
        previous = torch.roll(order, 1)
        for rows in self._chunks(count):
            one, two = (
                self.rules.follow(level.states[parent[which[rows]]], action[which[rows]]) for which in (order, previous)
            )
            differ += ((one != two).any(dim=1) & repeats[rows]).sum()
        distinct, collisions = torch.stack([count - repeats.sum(), differ]).tolist()
        if collisions:
            # Two states share a word of 64 bits: compare all states themselves; practically never.
            states = self.rules.follow(level.states[parent], action)
            _, group = torch.unique(states, dim=0, return_inverse=True)
            distinct = int(group.max()) + 1
            order = torch.sort(group, stable=True).indices
            repeats[1:] = group[order][1:] == group[order][:-1]
        place = torch.cumsum(~repeats, dim=0) - 1
        # Repeats write to a slot that is cut off, since a list of unknown length would need a synchronisation.
        first = torch.empty(distinct + 1, dtype=torch.int64, device=self.device)
        first.scatter_(0, torch.where(repeats, distinct, place), order)
        return first[:distinct], torch.empty_like(place).scatter_(0, order, place)

    def _cluster(
        self, level: _TensorLevel, candidates: _Candidates
    ) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None]:
        """Put candidates, stable or not, in random order, and as many of the first as there is room for in clusters.

        Returns:
            The order, and for those in clusters label and distance from the centre; None where all may be kept.
        """
        torch = import_torch()
        width = self.settings.width
        words = mix(candidates.hashes, (self.settings.seed << 20) + len(self._levels))
        order = torch.argsort(words, stable=True)
        if len(order) <= width or self.settings.diversity != "k-means":
            return order, None, None
        some = order[: max(self.settings.pool // self.task.part_count, 2 * width)]
        sample = some[: _SAMPLES_PER_CLUSTER * width]  # a fair one, since the order is random
        centers = find_centers(self._written(level, candidates.take(sample)), words[sample], width)
        mine, _ = self.shards.block(len(some))
        joined = torch.stack(centers.assign(self._written(level, candidates.take(some[mine]))), dim=1).int()
        labels, distance = self.shards.gather_blocks(joined, len(some)).unbind(dim=1)
        return order, labels, distance

    def _written(self, level: _TensorLevel, candidates: _Candidates) -> torch.Tensor:
        """Return candidates written down as states, shape (candidates, parts)."""
        return self.rules.follow(level.states[candidates.parent], candidates.action)

    def _chunks(self, count: int) -> list[slice]:
        """Return rows whose states fit into a bounded piece of memory."""
        rows = max(_CHUNK_BYTES // max(self.task.part_count, 1), 1)
        return [slice(begin, begin + rows) for begin in range(0, count, rows)]


def _choose(
    stable: torch.Tensor, order: torch.Tensor, labels: torch.Tensor | None, distance: torch.Tensor | None, width: int
) -> tuple[torch.Tensor, int]:
    """Choose up to `width` of the stable candidates, as `DeviceBeam._cluster` orders them; and count these."""
    torch = import_torch()
    rows = stable[order].nonzero()[:, 0]
    found, order = len(rows), order[rows]
    if labels is not None and distance is not None and found > width:
        inside = rows if len(labels) == len(stable) else rows[rows < len(labels)]
        dealt = _deal(order[: len(inside)], labels[inside], distance[inside])
        order = torch.cat([dealt, order[len(inside) :]])
    return order[:width], found


def _deal(order: torch.Tensor, labels: torch.Tensor, distance: torch.Tensor) -> torch.Tensor:
    """Return the nearest to the centre of each cluster, then the next of each, and so on."""
    torch = import_torch()
    by = torch.argsort(distance, stable=True)
    by = by[torch.argsort(labels[by], stable=True)]
    return order[by[torch.argsort(place_in_group(labels[by]), stable=True)]]

"""Beam search on tensors, on one device, in one process or several (paper, section 5.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from falsework.assembly.state import HELD, States
from falsework.errors import InputError
from falsework.search.beam.frontier import Level
from falsework.search.beam.level_search import LevelSearch
from falsework.search.beam.settings import MEMORY, BeamSettings
from falsework.search.device.k_means import find_centers
from falsework.search.device.oracle import BatchedTensorOracle, TensorOracle
from falsework.search.device.parallel_beams import SPARE
from falsework.search.device.rules import TensorRules
from falsework.search.problem.guide import Guide
from falsework.search.problem.hashing import chunks
from falsework.search.problem.result import REPORTED_STATES, Outcome, SearchCounters
from falsework.search.problem.task import Task
from falsework.stability.verdict import Verdict
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import import_torch, mix, place_in_group, put

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import torch

T = TypeVar("T")


@dataclass(eq=False)
class _TensorLevel:
    """States kept the same number of steps away from the origin, as in `Level`, with their hashes."""

    states: torch.Tensor
    parent: torch.Tensor
    action: torch.Tensor
    score: torch.Tensor
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
    awaited, so that a cluster may be left without a stable state. A level that is judged whole reads five sizes of
    lists back to the host, one more with a clearance table; nothing else leaves the device before the end. With
    `lookahead` the guide, which is of the host, scores a copy of the level, and verdicts are requested in batches of
    `SPARE` for each state wanted. No contact histories are kept: such a beam leaves what a hold changes to the replay
    of its route. Several processes share verdicts and clustering and repeat the rest, which is cheap, each for itself
    (docs/decisions/gpu-solver.md): for one seed the levels are the same whatever the number of processes.
    """

    def __init__(
        self,
        task: Task,
        oracle: TensorOracle,
        settings: BeamSettings = BeamSettings(),
        *,
        guide: Guide | None = None,
        device: torch.device | str = "cpu",
        shards: ProcessGroup = ProcessGroup(),
    ) -> None:
        """Begin at the origin of the direction; the start and the target are taken as stable.

        Args:
            task: rules between start and target.
            oracle: verdicts on tensors; it also determines which moves need one, see `Task.judged_by`.
            settings: width, direction and how states are chosen.
            guide: scores actions, with `lookahead`.
            device: where the search lives.
            shards: the processes that search together; all must be given the same task and settings.

        Raises:
            DependencyError: torch is not installed.
            InputError: a guide without `lookahead`.
        """
        if guide is not None and not settings.lookahead:
            raise InputError("a beam on a device that judges whole levels has no use for a guide; set lookahead")
        torch = import_torch()
        task = task.judged_by(oracle)
        if settings.lookahead:
            task = replace(task, holds_keep_stable=True)
        super().__init__(task, settings, guide)
        self._levels: list[_TensorLevel]
        self.device = torch.device(device)
        self.shards = shards
        self.rules = TensorRules(task, self.device, settings.direction)
        self._judge = BatchedTensorOracle(oracle, shards)
        self._side = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        self._candidates = self._verdicts = 0
        self._refused = torch.zeros(3, dtype=torch.int64, device=self.device)
        """Numbers of states that are not stable, and of these undecided and sliding."""
        self._forbidden = torch.zeros(0, dtype=torch.int64, device=self.device)
        """Hashes of the states that are ruled out."""
        self._host: list[Level] = []
        if not self._dead:
            origin, none = self.rules.origin(), torch.zeros(1, dtype=torch.int64, device=self.device)
            self._levels.append(_TensorLevel(origin, none, none - 1, none.double(), self.rules.hashes(origin)))

    @property
    def asked(self) -> int:
        """See `Search.asked`."""
        return self._verdicts

    @property
    def counters(self) -> SearchCounters:
        """Work done so far, by all processes; see `Search.counters`."""
        states = sum(len(level.states) for level in self._levels)
        return SearchCounters(states, self._candidates, self._verdicts, int(self._refused[0]))

    @property
    def levels(self) -> list[Level]:  # type: ignore[override]
        """Levels so far, copied to the host."""
        for level in self._levels[len(self._host) :]:
            columns = level.states, level.parent, level.action, level.score
            states, parent, action, score = (column.cpu().numpy() for column in columns)
            self._host.append(Level(states, parent, action, score, np.ones(len(states), dtype=np.int8)))
        return self._host

    def _advance(self) -> bool:
        level = self._levels[-1]
        legal, refuted = self.rules.moves(level.states), False
        score = self._scores(level, legal)
        if self.conflicts.refuted:
            barred = tuple(put(index, self.device) for index in self.conflicts.barred(self.levels[-1].states))
            refuted = bool(legal[barred].any())
            legal[barred] = False
        candidates = self._expand(level, legal)
        kept, rejected, whole = (self._most_promising if self.settings.lookahead else self._all_judged)(
            level, candidates, score[candidates.parent, candidates.action]
        )
        self._candidates += len(candidates)
        self._whole = [*self._whole[: len(self._levels) - 1], whole and self._whole_before and not refuted]
        if len(kept) == 0:
            self._died(self._written(level, candidates.take(rejected[:REPORTED_STATES])).cpu().numpy())
            return False
        chosen = candidates.take(kept)
        columns = chosen.parent, chosen.action, score[chosen.parent, chosen.action], chosen.hashes
        self._levels.append(_TensorLevel(self._written(level, chosen), *columns))
        return True

    def forbid(self, states: States) -> None:
        """See `Search.forbid`."""
        torch = import_torch()
        self._forbidden = torch.cat([self._forbidden, self.rules.hashes(put(states, self.device))])
        for number, level in enumerate(self._levels):
            if torch.isin(level.hashes, self._forbidden).any():
                self._go_back(number)
                return

    def rewind(self, level: int, settings: BeamSettings) -> None:
        """See `LevelSearch.rewind`."""
        super().rewind(level, settings)
        del self._host[level + 1 :]

    def _ended(self) -> None:
        len(self.levels)  # waits for the device, and copies what it found

    def _notes(self, outcome: Outcome) -> tuple[str, ...]:
        return tuple(self._judge.notes)

    def _open(self) -> tuple[int, int]:
        _, undecided, sliding = self._refused.tolist()
        return undecided, sliding

    def _scores(self, level: _TensorLevel, legal: torch.Tensor) -> torch.Tensor:
        """Return the sum of the guide's scores on the path to what each action leads to, shape (level, 2 parts)."""
        if self._guide is None:
            return level.score[:, None].expand(legal.shape)
        scores = self._guided(self.levels[-1].states, legal.cpu().numpy())
        return level.score[:, None] + put(np.asarray(scores, dtype=np.float64), self.device)

    def _ask(
        self,
        level: _TensorLevel,
        candidates: _Candidates,
        rows: torch.Tensor,
        meanwhile: Callable[[], object] | None = None,
    ) -> torch.Tensor:
        """Return which of some candidates are stable, shape (rows,); see `BatchedTensorOracle.verdicts`."""
        mine = candidates.take(rows[self.shards.interleaved()])
        after, before = self._written(level, mine), level.states[mine.parent]
        verdicts = self._judge.verdicts(after, before, len(rows), meanwhile)
        moving = (verdicts == Verdict.SLIDES) | (verdicts == Verdict.TIPS)
        answers = (verdicts != Verdict.STABLE, verdicts == Verdict.UNDECIDED, moving)
        self._refused += import_torch().stack([answer.sum() for answer in answers])
        self._verdicts += len(rows)
        return verdicts == Verdict.STABLE

    def _all_judged(
        self, level: _TensorLevel, candidates: _Candidates, score: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, bool]:
        """Ask for every candidate, then keep some stable ones, as `Selector.select_from_all`.

        Returns:
            Candidates kept, candidates asked for, and whether no stable one was left out.
        """
        stable = candidates.free.clone()
        asked = (~stable).nonzero()[:, 0]
        clusters = _Beside(self._side, lambda: self._cluster(level, candidates))
        stable[asked] = self._ask(level, candidates, asked, clusters.begin)
        kept, found = _choose(stable, *clusters.result(), self.settings.width)
        return kept, asked, found <= self.settings.width

    def _most_promising(
        self, level: _TensorLevel, candidates: _Candidates, score: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, bool]:
        """Ask for candidates in the order of promise until enough are stable, as `Selector.select_lazily`.

        Returns:
            Candidates kept, the best scored first, candidates found not stable, and whether there are no others.
        """
        torch, settings = import_torch(), self.settings
        if not len(candidates):
            return candidates.parent, candidates.parent, True
        value = self.rules.moved_value(candidates.action)
        held = self.rules.held(level.states)[candidates.parent] + torch.where(value == HELD, 1, -1)
        promise = score - held * (score.max() - score.min() + 1.0)  # free robots decide first
        order = torch.argsort(mix(candidates.hashes, (settings.seed << 20) + settings.number), stable=True)
        order = order[torch.argsort(promise[order], descending=True, stable=True)]
        free = candidates.free[order]
        waiting, fixing, kept, rejected = order[~free], order[free], [order[:0]], [order[:0]]
        wanted = settings.width
        while wanted > 0 and len(waiting):
            batch, waiting = waiting[: SPARE * wanted], waiting[SPARE * wanted :]
            stable = self._ask(level, candidates, batch)
            kept.append(batch[stable])
            rejected.append(batch[~stable])
            wanted -= len(kept[-1])
        if settings.commit and wanted <= 0:
            fixing = fixing[held[fixing] <= held[torch.cat(kept)].max()]
        chosen, refused = torch.cat([*kept, fixing[: settings.lookahead]]), torch.cat(rejected)
        best_first = chosen[torch.argsort(score[chosen], descending=True, stable=True)]
        return best_first, refused, len(chosen) + len(refused) == len(candidates)

    def _expand(self, level: _TensorLevel, legal: torch.Tensor) -> _Candidates:
        """Return what moves from a level lead to; states reached twice are kept once, dead ends not at all."""
        torch = import_torch()
        rules = self.rules
        parent, action, hashes = rules.children(level.states, level.hashes, legal)
        first, group = self._merge(level, hashes, parent, action)
        free = torch.zeros(len(first), dtype=torch.int32, device=self.device)
        free.index_add_(0, group, (~rules.needs_verdict(action)).int())
        candidates = _Candidates(parent[first], action[first], hashes[first], free > 0)
        if len(self._forbidden):
            ruled_out = torch.isin(candidates.hashes, self._forbidden)
            self._refused[[0, 2]] += ruled_out.sum()
            candidates = candidates.take((~ruled_out).nonzero()[:, 0])
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
        sample = some[: SPARE * width]  # a fair one, since the order is random
        centers = find_centers(self._written(level, candidates.take(sample)), words[sample], width)
        mine, _ = self.shards.block(len(some))
        joined = torch.stack(centers.assign(self._written(level, candidates.take(some[mine]))), dim=1).int()
        labels, distance = self.shards.gather_blocks(joined, len(some)).unbind(dim=1)
        return order, labels, distance

    def _written(self, level: _TensorLevel, candidates: _Candidates) -> torch.Tensor:
        """Return candidates written down as states, shape (candidates, parts)."""
        return self.rules.follow(level.states[candidates.parent], candidates.action)

    def _chunks(self, count: int) -> Iterator[slice]:
        """Yield rows whose states fit into a bounded piece of memory."""
        return chunks(count, max(MEMORY // self.task.part_count, 1))


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
    by = distance.argsort(stable=True)
    by = by[labels[by].argsort(stable=True)]
    return order[by[place_in_group(labels[by]).argsort(stable=True)]]

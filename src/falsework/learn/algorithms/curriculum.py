"""Curriculum of start states from the state graph, hard ones more often (paper, section 5.2)."""

from __future__ import annotations

import torch

from falsework.errors import InputError
from falsework.learn.algorithms.exploration import Exploration
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.algorithms.start_states import StartBatch, StartSampler
from falsework.learn.data.solvable_states import SolvableStates
from falsework.search.device.rules import TensorRules
from falsework.utils.collectives import gather_rows
from falsework.utils.distributed import ProcessGroup

_FAR = 0.75
"""Share of the horizon beyond which rollouts decide whether the horizon moves on."""
_FAR_ROLLOUTS = 32
"""Rollouts from there that decide it."""
_PASS_MARK = 0.6
"""Share of them that must succeed before states farther away follow."""
_STAGES = 10
"""Stages in which the distance to the complete structure is covered."""
_RANK_POWER = 0.8
"""States are drawn with probability `rank ** -0.8`, the one of highest surrogate loss first."""
_CORRECTION = 0.1
"""Initial exponent of the importance weights of prioritised replay; grows to 1."""
_ENTROPY, _ENTROPY_RISE, _ENTROPY_MOST = 0.005, 0.001, 0.01
"""Weight of the entropy of the policy in the loss; what is added to that for a state each time its rollout fails, until
one succeeds; and the upper bound of that weight."""
CORRECTED_AFTER = 500
"""Updates until importance weights correct completely for how often states are drawn."""


class Curriculum(StartSampler):
    """Prioritised sampling of start states that are known to be solvable.

    Every state is drawn once before any is drawn again; then those whose last rollout had a high surrogate loss, from
    which there is most to learn, are drawn more often. Where rollouts fail again and again, the policy is made to
    explore more. Only states near the end take part at first. A share of the starts are other states within the
    horizon: any solvable ones, and those that are explored for this.
    """

    def __init__(
        self,
        starts: torch.Tensor,
        rules: TensorRules,
        *,
        solved: SolvableStates | None = None,
        anywhere: float = 0.0,
        exploration: Exploration | None = None,
        explored: float = 0.0,
        shards: ProcessGroup = ProcessGroup(),
    ) -> None:
        """Begin.

        Args:
            starts: stable states with a path to the end, shape (count, parts); those that are the end are left out.
            rules: of the structure.
            solved: states known to be solvable, which grow, those that rollouts passed included.
            anywhere: share of the starts that is drawn from `solved`.
            exploration: finds solvable states far from those of the searches.
            explored: share of the starts that is drawn from there.
            shards: processes; each draws for itself, and outcomes are shared.

        Raises:
            InputError: no start states.
        """
        self.updates = 0
        self._rules, self._shards = rules, shards
        self._solved, self._anywhere = solved, anywhere if solved is not None else 0.0
        self._exploration, self._explored = exploration, explored if exploration is not None else 0.0
        left = rules.steps_left(starts)
        self.starts, self._left = starts[left > 0], left[left > 0]
        if len(self) == 0:
            raise InputError("a curriculum needs start states that are not the end; give at least one")
        self.visited = torch.zeros_like(self._left, dtype=torch.bool)
        self.surrogate = torch.zeros_like(self._left, dtype=torch.float32)
        self.entropy = torch.full_like(self.surrogate, _ENTROPY)
        self.far = self.surrogate.new_zeros(2)
        """Rollouts from the far end of what is drawn, and successes among them, since the horizon moved."""
        self.horizon = 0
        """Steps to the end that states may be away to be drawn."""
        self.horizon = self._next_horizon()

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def widening(self) -> bool:  # type: ignore[override]
        """See `StartSampler`."""
        return self.horizon < self._longest()

    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """See `StartSampler`; `rows` are those of the curriculum itself, which come first."""
        anywhere, explored = round(count * self._anywhere), round(count * self._explored)
        others = [self._solved.within(self.horizon, anywhere, generator)] if self._solved is not None else []
        if self._exploration is not None and explored:
            others.append(self._exploration.draw(explored, self.horizon, generator))
        rows, weight = self._draw(count - anywhere - explored, generator)
        more = sum(map(len, others))
        return StartBatch(
            torch.cat([self.starts[rows], *others]),
            None,
            torch.cat([self.entropy[rows], self.entropy.new_full((more,), _ENTROPY)]),
            torch.cat([weight, weight.new_full((more,), float(weight.mean()))]),
            rows,
        )

    def _draw(self, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows of the curriculum and their importance weights, both of shape (count,)."""
        inside = self._left <= self.horizon
        fresh = (inside & ~self.visited).nonzero()[:, 0]
        order = torch.randperm(len(fresh), generator=generator, device=fresh.device)
        rows = fresh[order[:count]]
        probability = self.probability(inside)
        if len(rows) < count:
            more = torch.multinomial(probability, count - len(rows), replacement=True, generator=generator)
            rows = torch.cat([rows, more])
        return rows, self._correction(probability[rows])

    def record(
        self, batch: StartBatch, transitions: Transitions, surrogate: torch.Tensor, generator: torch.Generator
    ) -> None:
        """See `StartSampler`."""
        assert batch.rows is not None
        own = len(batch.rows)
        self.record_outcomes(batch.rows, transitions.success[:own], surrogate[:own])

    def record_outcomes(self, rows: torch.Tensor, success: torch.Tensor, surrogate: torch.Tensor) -> None:
        """Record rollouts of this process by the indices of their starts; all columns of shape (rollouts,)."""
        rows = gather_rows(rows, self._shards)
        success = gather_rows(success, self._shards)
        surrogate = gather_rows(surrogate, self._shards)
        self.visited[rows] = True
        # Rows may be there several times: means, and one success is enough to be called one.
        times = torch.zeros_like(self.surrogate).index_add_(0, rows, torch.ones_like(surrogate))
        drawn = times > 0
        total = torch.zeros_like(times).index_add_(0, rows, surrogate)
        solved = torch.zeros_like(times).index_add_(0, rows, success.float()) > 0
        self.surrogate = torch.where(drawn, total / times.clamp(min=1), self.surrogate)
        risen = (self.entropy + _ENTROPY_RISE).clamp(max=_ENTROPY_MOST)
        entropy = torch.where(solved, _ENTROPY, torch.maximum(risen, self.entropy))
        self.entropy = torch.where(drawn, entropy, self.entropy)
        self.updates += 1
        far = self._left[rows] > _FAR * self.horizon
        self.far += torch.stack([far.sum(), (far & success).sum()])
        self._grow()

    def report(self) -> dict[str, float]:
        """Report the horizon as a share of the distance, the share of states drawn so far, and what is explored."""
        numbers = {
            "curriculum_horizon": self.horizon / max(self._longest(), 1),
            "curriculum_visited": float(self.visited.float().mean()),
            "curriculum_entropy": float(self.entropy.mean()),
        }
        if self._exploration is not None:
            numbers |= {"explored": float(len(self._exploration))}
            numbers |= {"explored_distance": self._exploration.mean_distance}
        return numbers

    def state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        columns = {name: getattr(self, name) for name in ("starts", "visited", "surrogate", "entropy", "far")}
        return {**columns, "counts": torch.tensor([self.updates, self.horizon])}

    def local_state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        return {} if self._exploration is None else self._exploration.tensors()

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """See `StartSampler`."""
        device = self._left.device
        for name in ("starts", "visited", "surrogate", "entropy", "far"):
            setattr(self, name, tensors[name].to(device).clone())
        self.visited = self.visited.bool()
        self._left = self._rules.steps_left(self.starts)
        self.updates, self.horizon = tensors["counts"].tolist()
        if self._exploration is not None and local is not None:
            self._exploration.load(local)

    def probability(self, inside: torch.Tensor) -> torch.Tensor:
        """Return the probability of drawing each state: by its rank in surrogate loss, zero beyond the horizon."""
        surrogate = torch.where(inside, self.surrogate, -1.0)
        order = torch.argsort(surrogate, descending=True, stable=True)
        rank = torch.arange(1, len(order) + 1, device=order.device, dtype=torch.float32)
        probability = torch.empty_like(rank).scatter_(0, order, rank.pow(-_RANK_POWER))
        probability = probability * inside
        return probability / probability.sum()

    def _correction(self, probability: torch.Tensor) -> torch.Tensor:
        """Return the weights of samples drawn with these probabilities (Schaul et al. 2016), at most 1."""
        done = min(self.updates / CORRECTED_AFTER, 1.0)
        weight = probability.pow(-(_CORRECTION + (1.0 - _CORRECTION) * done))
        return weight / weight.max()

    def _longest(self) -> int:
        return int(self._left.max()) if len(self) else 0

    def _next_horizon(self) -> int:
        """Return the least horizon a stage farther away that includes more states."""
        longest = self._longest()
        stage = max(-(-longest // _STAGES), 1)
        farther = self._left[self._left > self.horizon]
        nearest = int(farther.min()) if len(farther) else longest
        return min(max(self.horizon + stage, nearest), longest)

    def _grow(self) -> None:
        seen, solved = self.far.tolist()
        if seen >= _FAR_ROLLOUTS and solved >= _PASS_MARK * seen:
            self.horizon = max(self._next_horizon(), self.horizon)
            self.far.zero_()
        elif seen >= 8 * _FAR_ROLLOUTS:  # outdated results say nothing about the present policy
            self.far *= 0.5

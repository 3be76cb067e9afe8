"""Curriculum of start states from the state graph, hard ones more often (paper, section 5.2)."""

from __future__ import annotations

import torch

from falsework.errors import InputError
from falsework.learn.algorithms.rollout_storage import Transitions
from falsework.learn.algorithms.start_states import StartBatch, StartSampler
from falsework.learn.config.ppo import CurriculumSettings
from falsework.search.device.rules import TensorRules
from falsework.utils.collectives import gather_rows
from falsework.utils.distributed import ProcessGroup

_FAR = 0.75
"""Share of the horizon beyond which rollouts decide whether the horizon moves on."""
_FAR_ROLLOUTS = 32
"""Rollouts from there that decide it."""
CORRECTED_AFTER = 500
"""Updates until importance weights correct completely for how often states are drawn."""


class Curriculum(StartSampler):
    """Prioritised sampling of start states that are known to be solvable.

    Every state is drawn once before any is drawn again; then those whose last rollout had a high surrogate loss, from
    which there is most to learn, are drawn more often. Where rollouts fail again and again, the policy is made to
    explore more. With `growing` settings, only states near the end take part at first.
    """

    def __init__(
        self,
        starts: torch.Tensor,
        rules: TensorRules,
        settings: CurriculumSettings = CurriculumSettings(),
        *,
        shards: ProcessGroup = ProcessGroup(),
    ) -> None:
        """Begin.

        Args:
            starts: stable states with a path to the end, shape (count, parts); those that are the end are left out.
            rules: of the structure.
            settings: how to draw.
            shards: processes; each draws for itself, and outcomes are shared.

        Raises:
            InputError: no start states.
        """
        self.settings = settings
        self.updates = 0
        self.horizon = 0
        """Steps to the end that states may be away to be drawn."""
        self._rules = rules
        self._shards = shards
        device = starts.device
        self.starts = starts[:0]
        self._left = torch.zeros(0, dtype=torch.int64, device=device)
        self.visited = torch.zeros(0, dtype=torch.bool, device=device)
        self.surrogate = torch.zeros(0, device=device)
        self.entropy = torch.zeros(0, device=device)
        self.far = torch.zeros(2, device=device)
        """Rollouts from the far end of what is drawn, and successes among them, since the horizon moved."""
        self.add(starts)
        if len(self) == 0:
            raise InputError("a curriculum needs start states that are not the end; give at least one")
        self.horizon = self._next_horizon() if settings.growing else self._longest()

    def __len__(self) -> int:
        return len(self.starts)

    def add(self, starts: torch.Tensor) -> None:
        """Take in more states, shape (count, parts), not drawn yet; equal ones are not looked for."""
        left = self._rules.steps_left(starts)
        rows = (left > 0).nonzero()[:, 0]
        new = {
            "starts": starts[rows],
            "_left": left[rows],
            "visited": torch.zeros(len(rows), dtype=torch.bool, device=starts.device),
            "surrogate": torch.zeros(len(rows), device=starts.device),
            "entropy": torch.full((len(rows),), self.settings.entropy, device=starts.device),
        }
        for name, values in new.items():
            setattr(self, name, torch.cat([getattr(self, name), values]))
        if not self.settings.growing and len(self):
            self.horizon = self._longest()

    @property
    def mean_steps(self) -> float:  # type: ignore[override]
        """Steps from a start within the horizon to the end, on average."""
        return float(self._left[self._left <= self.horizon].double().mean())

    @property
    def widening(self) -> bool:  # type: ignore[override]
        """See `StartSampler`."""
        return self.horizon < self._longest()

    def sample(self, count: int, generator: torch.Generator) -> StartBatch:
        """See `StartSampler`."""
        inside = self._left <= self.horizon
        fresh = (inside & ~self.visited).nonzero()[:, 0]
        order = torch.randperm(len(fresh), generator=generator, device=fresh.device)
        rows = fresh[order[:count]]
        probability = self.probability(inside)
        if len(rows) < count:
            more = torch.multinomial(probability, count - len(rows), replacement=True, generator=generator)
            rows = torch.cat([rows, more])
        weight = self._correction(probability[rows])
        return StartBatch(self.starts[rows], None, self.entropy[rows], weight, rows)

    def record(
        self, batch: StartBatch, transitions: Transitions, surrogate: torch.Tensor, generator: torch.Generator
    ) -> None:
        """See `StartSampler`."""
        assert batch.rows is not None
        self.record_outcomes(batch.rows, transitions.success, surrogate)

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
        risen = (self.entropy + self.settings.entropy_rise).clamp(max=self.settings.entropy_most)
        entropy = torch.where(solved, self.settings.entropy, torch.maximum(risen, self.entropy))
        self.entropy = torch.where(drawn, entropy, self.entropy)
        self.updates += 1
        if self.settings.growing:
            far = self._left[rows] > _FAR * self.horizon
            self.far += torch.stack([far.sum(), (far & success).sum()])
            self._grow()

    def report(self) -> dict[str, float]:
        """Report progress: the horizon as a share of the distance, and the share of states drawn so far."""
        return {
            "curriculum_horizon": self.horizon / max(self._longest(), 1),
            "curriculum_visited": float(self.visited.float().mean()),
            "curriculum_entropy": float(self.entropy.mean()),
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        """See `StartSampler`."""
        columns = {name: getattr(self, name) for name in ("starts", "visited", "surrogate", "entropy", "far")}
        return {**columns, "counts": torch.tensor([self.updates, self.horizon])}

    def load_state_dict(self, tensors: dict[str, torch.Tensor], local: dict[str, torch.Tensor] | None) -> None:
        """See `StartSampler`."""
        device = self._left.device
        for name in ("starts", "visited", "surrogate", "entropy", "far"):
            setattr(self, name, tensors[name].to(device).clone())
        self.visited = self.visited.bool()
        self._left = self._rules.steps_left(self.starts)
        self.updates, self.horizon = tensors["counts"].tolist()

    def probability(self, inside: torch.Tensor) -> torch.Tensor:
        """Return the probability of drawing each state: by its rank in surrogate loss, zero beyond the horizon."""
        surrogate = torch.where(inside, self.surrogate, -1.0)
        order = torch.argsort(surrogate, descending=True, stable=True)
        rank = torch.arange(1, len(order) + 1, device=order.device, dtype=torch.float32)
        probability = torch.empty_like(rank).scatter_(0, order, rank.pow(-self.settings.rank_power))
        probability = probability * inside
        return probability / probability.sum()

    def _correction(self, probability: torch.Tensor) -> torch.Tensor:
        """Return the weights of samples drawn with these probabilities (Schaul et al. 2016), at most 1."""
        done = min(self.updates / CORRECTED_AFTER, 1.0)
        power = min(self.settings.correction + (1.0 - self.settings.correction) * done, 1.0)
        if power == 0 or self.settings.rank_power == 0:
            return torch.ones_like(probability)
        weight = probability.pow(-power)
        return weight / weight.max()

    def _longest(self) -> int:
        return int(self._left.max()) if len(self) else 0

    def _next_horizon(self) -> int:
        """Return the least horizon a stage farther away that includes more states."""
        longest = self._longest()
        stage = max(-(-longest // self.settings.stages), 1)
        farther = self._left[self._left > self.horizon]
        nearest = int(farther.min()) if len(farther) else longest
        return min(max(self.horizon + stage, nearest), longest)

    def _grow(self) -> None:
        seen, solved = self.far.tolist()
        if seen >= _FAR_ROLLOUTS and solved >= self.settings.pass_mark * seen:
            self.horizon = max(self._next_horizon(), self.horizon)
            self.far.zero_()
        elif seen >= 8 * _FAR_ROLLOUTS:  # outdated results say nothing about the present policy
            self.far *= 0.5

"""Proven plans from many states at once: the policy first, then searches where it fails."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import torch

from falsework.learn.algorithms.policy_beam import policy_beam_search
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import PolicyFunction, roll_out
from falsework.replanning.result import Stage
from falsework.search.planner import Planner
from falsework.search.problem.guide import SupportGuide
from falsework.search.problem.task import Task
from falsework.search.settings import PlannerSettings

_ROWS = 1 << 14
"""Rollouts whose states are in memory together."""
_PLAIN_WIDTH = 64
"""Widest beam of the search without a policy, in states."""


@dataclass(frozen=True, eq=False)
class SolveReport:
    """States from which a plan was found, and the stage that found it.

    Every state of the plan is stable from rest; only plans of the last stage are also replayed as they are built, as a
    `Replanner` does with every plan.
    """

    decided_by: np.ndarray
    """Name of a `Stage` for each start, `Stage.NONE` where no plan was found. Shape (starts,)."""
    seconds: float
    verdicts: int
    stages: dict[str, float] = field(default_factory=dict)
    """Seconds by stage."""

    @property
    def share(self) -> float:
        """Of the starts with a proven plan, between 0 and 1."""
        return float((self.decided_by != Stage.NONE).mean()) if len(self.decided_by) else 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        count = {decider.value: int((self.decided_by == decider).sum()) for decider in Stage}
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "decided_by"}
        return {"states": len(self.decided_by), "share": self.share, "decided_by": count, **own}


def solve_all(
    environment: Environment,
    policy: PolicyFunction,
    starts: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    samples: int = 16,
    widths: tuple[int, ...] = (8, 64),
    plain_limit: int = 64,
    generator: torch.Generator | None = None,
) -> SolveReport:
    """Find a proven plan from every state: the policy first, then searches where it fails.

    All stages work on all remaining states at once, except the last, which searches without the policy.

    Args:
        environment: rules and verdicts.
        policy: proposes actions in rollouts and guides the beam.
        starts: stable, `uint8` on the device, shape (starts, parts).
        targets: shape (starts, parts), or None.
        samples: rollouts drawn from each state where the greedy rollout fails.
        widths: of the beams guided by the policy, in turn.
        plain_limit: number of states from which to search without the policy, at most.
        generator: of drawn actions.
    """
    begun, asked = time.perf_counter(), environment.counters.states_asked
    decided = np.full(len(starts), Stage.NONE, dtype=object)
    stages: dict[str, float] = {}

    def settle(rows: torch.Tensor, good: torch.Tensor, by: Stage, since: float) -> torch.Tensor:
        decided[rows[good].cpu().numpy()] = by
        stages[by.value] = stages.get(by.value, 0.0) + time.perf_counter() - since
        return rows[~good]

    def goals(rows: torch.Tensor) -> torch.Tensor | None:
        return None if targets is None else targets[rows]

    left, since = torch.arange(len(starts), device=starts.device), time.perf_counter()
    left = settle(left, roll_out(environment, policy, starts, targets, keep="ends").success, Stage.GREEDY, since)
    if len(left) and samples:
        since, rows = time.perf_counter(), left.repeat_interleave(samples)
        options: dict[str, Any] = {"greedy": False, "generator": generator, "keep": "ends"}
        good = [
            roll_out(environment, policy, starts[piece], goals(piece), **options).success for piece in rows.split(_ROWS)
        ]
        left = settle(left, torch.cat(good).view(len(left), samples).any(dim=1), Stage.SAMPLED, since)
    for width in widths:
        if len(left) == 0:
            break
        since = time.perf_counter()
        good = [
            policy_beam_search(environment, policy, starts[piece], goals(piece), width=width).found
            for piece in left.split(max(_ROWS // width, 1))
        ]
        left = settle(left, torch.cat(good), Stage.GUIDED, since)
    if len(left) and plain_limit:
        since, rows = time.perf_counter(), left[:plain_limit]
        good = [_plain(environment, starts[row], None if targets is None else targets[row]) for row in rows]
        settle(rows, torch.tensor(good, device=starts.device), Stage.SEARCH, since)
    verdicts = environment.counters.states_asked - asked
    return SolveReport(decided, time.perf_counter() - begun, verdicts, stages)


def _plain(environment: Environment, start: torch.Tensor, target: torch.Tensor | None) -> bool:
    """Return whether a search without a policy finds a plan."""
    rules = environment.rules
    task = Task.from_rules(
        rules.task.boundary,
        rules.task.robots,
        start=start.cpu().numpy(),
        target=None if target is None else target.cpu().numpy(),
        fixed=rules.task.fixed,
        clearance=rules.task.clearance,
    )
    planner = Planner(task, environment.oracle, PlannerSettings(_PLAIN_WIDTH), guide=SupportGuide(environment.assembly))
    return planner.run().found

"""Policy improvement by verified search: play, search where that fails, and know more solvable states afterwards.

A policy is played from states that are known to be solvable. Whatever stable way reaches the target proves that all
states on it are solvable, also those that no wide search would have kept: states where this policy comes along. Where
all rollouts of a state fail, a beam search that the policy guides finds the way. What imitation then learns are the
policy's own successes and the searches' corrections of its mistakes; the paper reaches for curriculum learning here
(section 5.2), which needs many more rollouts for each mistake.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
import torch

from falsework.errors import InputError
from falsework.learn.algorithms.policy_beam import search_from
from falsework.learn.data.solvable_states import SolvedStates
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import Policy, Rollouts, roll_out
from falsework.replanning.result import Decider
from falsework.search.planner import Planner
from falsework.search.problem.guide import SupportGuide
from falsework.search.problem.task import Task
from falsework.search.settings import PlannerSettings

_ROWS = 1 << 14
"""Rollouts whose states are in memory together."""
_BRANCHES = (2, 4, 8, 16)
"""Steps before the end of a failed rollout from which it is played again."""
_SEARCHES = {"cpu": 32, "cuda": 1024}
"""Starts that are searched from in a round, at most, by kind of device: searches cost more than rollouts."""


@dataclass(frozen=True)
class Improvement:
    """What a round of `improve` did."""

    starts: int
    """States that it began at."""
    rollouts: int = 0
    successes: int = 0
    """Of the rollouts."""
    succeeded: int = 0
    """Starts from which a rollout of the policy reached the target."""
    searched: int = 0
    """Starts whose rollouts all failed and that were searched from."""
    found: int = 0
    """Of these, a way was found."""
    new_states: int = 0
    """States that were not known to be solvable."""
    verdicts: int = 0
    """States that the oracle was asked about."""
    met: int = 0
    """Test states that rollouts have come across so far, this round included; they are not learned from."""
    seconds: float = 0.0

    def as_dict(self) -> dict[str, int | float]:
        """Plain numbers for reports."""
        return asdict(self)


def improve(
    environment: Environment,
    policy: Policy,
    solved: SolvedStates,
    starts: torch.Tensor,
    *,
    generator: torch.Generator | None = None,
    samples: int = 8,
    temperature: float = 1.0,
    width: int = 8,
    searches: int | None = None,
) -> Improvement:
    """Play from some states, the more often the more it fails there, and learn which states are solvable.

    Every start is played once with the most probable actions and once with drawn ones. Where neither arrives, half of
    `samples` more are drawn from the start, and half branch off the failed rollout some steps before its end, which is
    where most mistakes are. Where these fail too, a beam search from the start follows.

    Args:
        environment: rules and verdicts; disassembly to the empty structure.
        policy: plays and guides.
        solved: grows by all states on ways that reached the end. Test states among them are not stored, and nothing
            starts there.
        starts: stable, `uint8` on the device, shape (starts, parts).
        generator: of drawn actions; same state of it, same round.
        samples: rollouts from each start that fails at first.
        temperature: what logits are divided by before drawing.
        width: of the beam searches.
        searches: starts to search from at most; by device if not given.

    Raises:
        InputError: no samples or width below one.
    """
    if samples < 1 or width < 1:
        raise InputError(f"improving needs at least 1 sample and a width of 1, not {samples} and {width}")
    begun, asked, known = time.perf_counter(), environment.counters.states_asked, len(solved)
    tally = _Tally(environment, policy, solved, temperature, generator)
    arrived = torch.zeros(len(starts), dtype=torch.bool, device=starts.device)
    number = torch.arange(len(starts), device=starts.device)
    tally.play(starts, number, arrived, greedy=True)
    tally.play(starts, number, arrived, greedy=False)
    failed = (~arrived).nonzero()[:, 0]
    if len(failed):
        tally.play(starts[failed].repeat_interleave((samples + 1) // 2, 0), _each(failed, (samples + 1) // 2), arrived)
        branches, owner = tally.branches(starts, failed, samples // 2)
        tally.play(branches, owner, arrived)
    failed = (~arrived).nonzero()[:, 0]
    limit = _SEARCHES.get(starts.device.type, _SEARCHES["cpu"]) if searches is None else searches
    searched = failed[:limit]
    found = 0
    if len(searched):
        result = search_from(environment, policy, starts[searched], width=width)
        found = int(result.found.sum())
        solved.meet(result.states)
        solved.add(result.states)
    return Improvement(
        starts=len(starts),
        rollouts=tally.rollouts,
        successes=tally.successes,
        succeeded=int(arrived.sum()),
        searched=len(searched),
        found=found,
        new_states=len(solved) - known,
        verdicts=environment.counters.states_asked - asked,
        met=solved.met,
        seconds=time.perf_counter() - begun,
    )


class _Tally:
    """Plays, and keeps what is learned from it."""

    def __init__(
        self,
        environment: Environment,
        policy: Policy,
        solved: SolvedStates,
        temperature: float,
        generator: torch.Generator | None,
    ) -> None:
        self.rollouts = 0
        self.successes = 0
        self._environment = environment
        self._policy = policy
        self._solved = solved
        self._options: dict[str, Any] = {"temperature": temperature, "generator": generator}
        self._greedy: list[Rollouts] = []

    def play(self, starts: torch.Tensor, owner: torch.Tensor, arrived: torch.Tensor, *, greedy: bool = False) -> None:
        """Play from `starts`; mark the owners of those that arrive, and learn their states."""
        for begin in range(0, len(starts), _ROWS):
            rows = slice(begin, begin + _ROWS)
            rollouts = roll_out(self._environment, self._policy, starts[rows], greedy=greedy, **self._options)
            if greedy:
                self._greedy.append(rollouts)
            good = rollouts.success
            self._solved.meet(rollouts.states.flatten(0, 1))
            self._solved.add(rollouts.states[:, good][rollouts.passed()[:, good]])
            arrived[owner[rows][good]] = True
            self.rollouts += len(good)
            self.successes += int(good.sum())

    def branches(self, starts: torch.Tensor, failed: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """States of greedy rollouts some steps before they failed, and whose they are; never a test state."""
        if count == 0:
            return starts[:0], failed[:0]
        back = torch.tensor([_BRANCHES[n % len(_BRANCHES)] for n in range(count)], device=starts.device)
        states = []
        for piece, rollouts in enumerate(self._greedy):
            rows = failed[(failed >= piece * _ROWS) & (failed < (piece + 1) * _ROWS)] - piece * _ROWS
            step = (rollouts.length[rows][:, None] - back).clamp(min=0)
            states.append(rollouts.states[step, rows[:, None]].flatten(0, 1))
        owner = _each(failed, count)
        branches = torch.cat(states)
        return torch.where(self._solved.is_forbidden(branches)[:, None], starts[owner], branches), owner


@dataclass(frozen=True, eq=False)
class SolveAll:
    """From which of some states a proven plan was found, and who found it."""

    decided_by: np.ndarray
    """Name of a `Decider` for each start, `Decider.NOBODY` where no plan was found. Shape (starts,)."""
    seconds: float
    verdicts: int
    stages: dict[str, float] = field(default_factory=dict)
    """Seconds by stage."""

    @property
    def share(self) -> float:
        """Of the starts with a proven plan, between 0 and 1."""
        return float((self.decided_by != Decider.NOBODY).mean()) if len(self.decided_by) else 1.0

    def record(self) -> dict[str, Any]:
        """As JSON."""
        count = {decider.value: int((self.decided_by == decider).sum()) for decider in Decider}
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "decided_by"}
        return {"states": len(self.decided_by), "share": self.share, "decided_by": count, **own}


def solve_all(
    environment: Environment,
    policy: Policy,
    starts: torch.Tensor,
    targets: torch.Tensor | None = None,
    *,
    samples: int = 16,
    temperature: float = 1.0,
    widths: tuple[int, ...] = (8, 64),
    plain_width: int = 64,
    plain_limit: int = 64,
    generator: torch.Generator | None = None,
) -> SolveAll:
    """Find a proven plan from every state: the policy first, then searches for what it leaves.

    All stages work on all states that are left at once, except the last, which searches without the policy.

    Args:
        environment: rules and verdicts.
        policy: plays and guides.
        starts: stable, `uint8` on the device, shape (starts, parts).
        targets: shape (starts, parts), or None.
        samples: rollouts drawn from each state from which the most probable actions fail.
        temperature: what logits are divided by before drawing.
        widths: of the beams that the policy guides, in turn.
        plain_width: widest beam of the search without a policy.
        plain_limit: states for which that is tried, at most.
        generator: of drawn actions.
    """
    begun, asked = time.perf_counter(), environment.counters.states_asked
    decided = np.full(len(starts), Decider.NOBODY, dtype=object)
    stages: dict[str, float] = {}

    def settle(rows: torch.Tensor, good: torch.Tensor, by: Decider, since: float) -> torch.Tensor:
        decided[rows[good].cpu().numpy()] = by
        stages[by.value] = stages.get(by.value, 0.0) + time.perf_counter() - since
        return rows[~good]

    def aims(rows: torch.Tensor) -> torch.Tensor | None:
        return None if targets is None else targets[rows]

    left, since = torch.arange(len(starts), device=starts.device), time.perf_counter()
    left = settle(left, roll_out(environment, policy, starts, targets, keep="ends").success, Decider.GREEDY, since)
    if len(left) and samples:
        since, rows = time.perf_counter(), _each(left, samples)
        options: dict[str, Any] = {"greedy": False, "temperature": temperature, "generator": generator, "keep": "ends"}
        good = [
            roll_out(environment, policy, starts[piece], aims(piece), **options).success for piece in rows.split(_ROWS)
        ]
        left = settle(left, torch.cat(good).view(len(left), samples).any(dim=1), Decider.SAMPLED, since)
    for width in widths:
        if len(left) == 0:
            break
        since = time.perf_counter()
        good = [
            search_from(environment, policy, starts[piece], aims(piece), width=width).found
            for piece in left.split(max(_ROWS // width, 1))
        ]
        left = settle(left, torch.cat(good), Decider.GUIDED, since)
    if len(left) and plain_width:
        since, rows = time.perf_counter(), left[:plain_limit]
        good = [
            _plain(environment, starts[row], None if targets is None else targets[row], plain_width) for row in rows
        ]
        settle(rows, torch.tensor(good, device=starts.device), Decider.SEARCH, since)
    verdicts = environment.counters.states_asked - asked
    return SolveAll(decided, time.perf_counter() - begun, verdicts, stages)


def _plain(environment: Environment, start: torch.Tensor, target: torch.Tensor | None, width: int) -> bool:
    """Whether a search without a policy finds a plan."""
    rules = environment.rules
    task = Task.create(
        rules.task.boundary,
        rules.task.robots,
        start=start.cpu().numpy(),
        target=None if target is None else target.cpu().numpy(),
        fixed=rules.task.fixed,
        clearance=rules.task.clearance,
    )
    planner = Planner(task, environment.oracle, PlannerSettings(width), guide=SupportGuide(environment.assembly))
    return planner.run().found


def _each(rows: torch.Tensor, times: int) -> torch.Tensor:
    return rows.repeat_interleave(times)

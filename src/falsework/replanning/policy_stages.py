"""Policy stages of a replanner: greedy rollouts, then sampled rollouts."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.replanning.deadline import Pace
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.result import Decider
from falsework.replanning.rollout import Rollout, roll_out
from falsework.replanning.session import Job, Kit
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task
from falsework.stability.verdict import Verdict

_SHARE = 0.6
"""Share of the time before a deadline that rollouts may take."""
_AMBITIONS = 5
"""Rollouts for different hopes of how long missing parts can be done without."""
_VERDICTS = 16
"""States of a rollout judged before looking whether one of them falls."""
_BACK = 2
"""Half of the samples branch off the proven part of the greedy rollout: 2, 4, 8, ... steps before its end."""


def follow_greedily(jobs: Sequence[Job], kit: Kit) -> None:
    """Take the most probable actions for all jobs at once, then judge where they lead.

    What the network says does not depend on verdicts, so it is asked for whole rollouts first, and the oracle then
    gets their states together, which keeps all cores busy.
    """
    if kit.guide is None:
        return
    jobs = [job for job in jobs if not job.settled]
    jobs = with_time([(job, len(_hopes(job))) for job in jobs], kit.guide)
    variants = [(job, task) for job in jobs for task in _hopes(job)]
    if not variants:
        return
    owners = [job for job, _ in variants]
    with _policy_time(jobs):
        rollouts = roll_out(
            kit.guide,
            [task for _, task in variants],
            [task.start for _, task in variants],
            np.arange(len(variants)),
            stop=lambda number: _late(owners[number]),
        )
    proven = _proven_steps(owners, rollouts)
    for job, rollout, steps in zip(owners, rollouts, proven, strict=True):
        if rollout.reached and steps == len(rollout.states) - 1:
            job.found([Route.through(rollout.states)], Decider.GREEDY)
        if steps >= len(job.prefix):
            job.prefix = rollout.states[: steps + 1]


def follow_samples(jobs: Sequence[Job], kit: Kit) -> None:
    """Draw rollouts for all jobs at once; half of them branch off the proven part of the greedy one."""
    jobs = [job for job in jobs if not job.settled and (not job.routes or job.request.alternatives > 1)]
    count = kit.samples
    if not count or kit.guide is None:
        return
    jobs = with_time([(job, count) for job in jobs], kit.guide)
    if not jobs:
        return
    prefixes = [prefix for job in jobs for prefix in _branches(job, count)]
    owner = np.repeat(np.arange(len(jobs)), count)

    def stable(numbers: NDArray[np.int64], states: States, parents: States) -> Mask:
        return _judge([jobs[number] for number in numbers.tolist()], states, parents) > 0

    before = [sum(job.clock.spent.values()) for job in jobs]
    begun = time.perf_counter()
    rollouts = roll_out(
        kit.guide,
        [job.task for job in jobs],
        [prefix[-1] for prefix in prefixes],
        owner,
        rng=np.random.default_rng([job.request.seed for job in jobs]),
        temperature=kit.settings.temperature,
        stable=stable,
        stop=lambda number: _late(jobs[number]),
    )
    for job, spent in zip(jobs, before, strict=True):
        job.clock.add("policy", time.perf_counter() - begun - (sum(job.clock.spent.values()) - spent))
    for prefix, rollout in zip(prefixes, rollouts, strict=True):
        if rollout.reached:
            states = np.concatenate([prefix[:-1], rollout.states])
            jobs[rollout.task].found([Route.through(states)], Decider.SAMPLED)


def _late(job: Job) -> bool:
    """Return whether the clock of a job has run out; if so, it need not wait for the others any longer."""
    if job.clock.passed:
        job.others()
    return job.clock.passed


def with_time(wanted: Sequence[tuple[Job, int]], guide: PolicyGuide) -> list[Job]:
    """Return jobs whose deadline leaves time for rollouts, and as much again for a search if they fail.

    Args:
        wanted: jobs and the number of their rollouts.
        guide: the policy.
    """
    jobs = list(wanted)
    while jobs:
        rows = sum(count for _, count in jobs)
        seconds = guide.seconds_for(rows) * max(job.task.steps for job, _ in jobs)
        tight = [job for job, _ in jobs if _SHARE * (job.clock.left - job.clock.reserve) < seconds]
        if not tight:
            break
        # Fewer rollouts at a time are faster for each: the most urgent job gives way.
        urgent = min(tight, key=lambda job: job.clock.left)
        jobs = [(job, count) for job, count in jobs if job is not urgent]
    return [job for job, _ in jobs]


def _hopes(job: Job) -> list[Task]:
    """Return the task, and where parts are missing, with them later and later."""
    task = job.task
    if not task.missing:
        return [task]
    latest = task.steps - len(task.missing)
    steps = sorted({round(latest * share) for share in np.linspace(0, 1, _AMBITIONS)})
    return [task.postpone((step,) * len(task.missing)) for step in steps]


def _branches(job: Job, count: int) -> list[States]:
    """Return proven ways that samples go on from."""
    ways = [job.prefix[:1]] * ((count + 1) // 2)
    length, back = len(job.prefix), _BACK
    while len(ways) < count:
        keep = length - back
        ways.append(job.prefix[: max(keep, 1)])
        back = back * 2 if keep > 1 else _BACK
    return ways


def _proven_steps(owners: Sequence[Job], rollouts: Sequence[Rollout]) -> list[int]:
    """Count the leading steps of each rollout whose states are proven stable."""
    proven = np.array([len(rollout.states) - 1 for rollout in rollouts])
    steps = [(s, n) for n, r in enumerate(rollouts) for s in _judged_steps(r, owners[n].task)]
    steps.sort()
    waiting, size = steps, _VERDICTS * len(rollouts)
    while waiting:
        alive = [(s, n) for s, n in waiting if s <= proven[n]]
        piece, waiting = alive[:size], alive[size:]
        if not piece:
            break
        states = np.stack([rollouts[n].states[s] for s, n in piece])
        parents = np.stack([rollouts[n].states[s - 1] for s, n in piece])
        verdict = _judge([owners[n] for _, n in piece], states, parents)
        for (s, n), stands in zip(piece, verdict > 0, strict=True):
            if not stands:
                proven[n] = min(proven[n], s - 1)
    return proven.tolist()


def _judged_steps(rollout: Rollout, task: Task) -> list[int]:
    """Return steps of a rollout after which a verdict is needed."""
    actions = Route.through(rollout.states).actions
    return (np.flatnonzero(task.needs_verdict(actions, Direction.DISASSEMBLY)) + 1).tolist()


def _judge(owners: Sequence[Job], states: States, parents: States) -> NDArray[np.int8]:
    """Return verdicts for several jobs in one batch; 0 for those whose clock has run out."""
    verdict = np.zeros(len(states), dtype=np.int8)
    pace = Pace(limited=any(job.clock.limited for job in owners))
    oracle = owners[0].kit.prover.oracle
    begin = 0
    while begin < len(states):
        rows = np.arange(begin, min(begin + pace.batch, len(states)))
        begin += len(rows)
        owners[0].others()
        rows = np.array([row for row in rows.tolist() if not owners[row].clock.passed], dtype=np.int64)
        if len(rows) == 0:
            continue
        since = time.perf_counter()
        with pace.measure():
            verdict[rows] = oracle.judge(states[rows], parents=parents[rows]).verdict
        taken = time.perf_counter() - since
        for row in rows.tolist():
            owners[row].oracle.asked += 1
            if owners[row].oracle.rules_out(states[row][None])[0]:
                verdict[row] = Verdict.SLIDES
        for job in {id(owners[row]): owners[row] for row in rows.tolist()}.values():
            job.clock.add("verdicts", taken)
    return verdict


@contextmanager
def _policy_time(jobs: Sequence[Job]) -> Iterator[None]:
    begun = time.perf_counter()
    yield
    for job in jobs:
        job.clock.add("policy", time.perf_counter() - begun)

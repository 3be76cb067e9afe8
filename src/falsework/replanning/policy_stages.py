"""Policy stages of a replanner: greedy rollouts, then sampled rollouts."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import Mask, States
from falsework.replanning.policy_guide import PolicyGuide
from falsework.replanning.result import Stage
from falsework.replanning.session import ReplanContext, ReplanSession
from falsework.search.problem.result import Route
from falsework.search.problem.rollout import Rollout, follow_scores
from falsework.search.problem.task import Direction, Task
from falsework.utils.interruption import pieces

_SHARE = 0.6
"""Share of the time before a deadline that rollouts may take."""
_AMBITIONS = 5
"""Rollouts for different bounds on when missing parts are needed."""
_VERDICTS = 16
"""States of a rollout that are checked in one batch."""
_BACK = 2
"""Half of the samples branch off the proven part of the greedy rollout: 2, 4, 8, ... steps before its end."""


def of_one_kind(sessions: Sequence[ReplanSession]) -> list[list[ReplanSession]]:
    """Return sessions in groups with the same number of robots, which policies for many tasks are told."""
    groups: dict[int, list[ReplanSession]] = {}
    for session in sessions:
        groups.setdefault(session.task.robots, []).append(session)
    return list(groups.values())


def follow_greedily(sessions: Sequence[ReplanSession], context: ReplanContext) -> None:
    """Take the most probable actions for all sessions of one kind at once, then check the resulting states.

    The output of the network does not depend on verdicts, so whole rollouts are computed first, and the oracle then
    checks their states together, which keeps all cores busy.
    """
    if context.guide is None:
        return
    sessions = [session for session in sessions if not session.done]
    sessions = with_time([(session, len(_postponed_variants(session))) for session in sessions], context.guide)
    variants = [(session, task) for session in sessions for task in _postponed_variants(session)]
    if not variants:
        return
    owners = [session for session, _ in variants]
    begun = time.perf_counter()
    rollouts = follow_scores(
        [task for _, task in variants],
        [task.start for _, task in variants],
        np.arange(len(variants)),
        context.guide.for_task(owners[0].task).log_probabilities,
        stop=lambda number: _late(owners[number]),
    )
    for session in sessions:
        session.clock.add("policy", time.perf_counter() - begun)
    proven = _proven_steps(owners, rollouts)
    for session, rollout, steps in zip(owners, rollouts, proven, strict=True):
        if rollout.reached and steps == len(rollout.states) - 1:
            session.found([Route.from_states(rollout.states)], Stage.GREEDY)
        if steps >= len(session.prefix):
            session.prefix = rollout.states[: steps + 1]


def follow_samples(sessions: Sequence[ReplanSession], context: ReplanContext) -> None:
    """Draw rollouts for all sessions of one kind at once; half of them branch off the proven part of the greedy one."""
    sessions = [
        session for session in sessions if not session.done and (not session.routes or session.request.alternatives > 1)
    ]
    count = context.samples
    if not count or context.guide is None:
        return
    sessions = with_time([(session, count) for session in sessions], context.guide)
    if not sessions:
        return
    prefixes = [prefix for session in sessions for prefix in _branches(session, count)]
    owner = np.repeat(np.arange(len(sessions)), count)

    def stable(numbers: NDArray[np.int64], states: States, parents: States) -> Mask:
        return _judge([sessions[number] for number in numbers.tolist()], states, parents) > 0

    before = [sum(session.clock.spent.values()) for session in sessions]
    begun = time.perf_counter()
    rollouts = follow_scores(
        [session.task for session in sessions],
        [prefix[-1] for prefix in prefixes],
        owner,
        context.guide.for_task(sessions[0].task).log_probabilities,
        rng=np.random.default_rng([session.request.seed for session in sessions]),
        stable=stable,
        stop=lambda number: _late(sessions[number]),
    )
    for session, spent in zip(sessions, before, strict=True):
        session.clock.add("policy", time.perf_counter() - begun - (sum(session.clock.spent.values()) - spent))
    for prefix, rollout in zip(prefixes, rollouts, strict=True):
        if rollout.reached:
            states = np.concatenate([prefix[:-1], rollout.states])
            sessions[rollout.task].found([Route.from_states(states)], Stage.SAMPLED)


def _late(session: ReplanSession) -> bool:
    """Return whether the clock of a session has run out; if so, it need not wait for the others any longer."""
    if session.clock.passed:
        session.clock.between()
    return session.clock.passed


def with_time(wanted: Sequence[tuple[ReplanSession, int]], guide: PolicyGuide) -> list[ReplanSession]:
    """Return sessions whose deadline leaves time for rollouts, and as much again for a search if they fail.

    Not those in which parts may be held again, of which policies know nothing.

    Args:
        wanted: sessions and the number of their rollouts.
    """
    sessions = [(session, count) for session, count in wanted if not session.task.allow_regrasp]
    while sessions:
        rows = sum(count for _, count in sessions)
        seconds = guide.seconds_for(rows) * max(session.task.steps for session, _ in sessions)
        tight = [session for session, _ in sessions if _SHARE * (session.clock.left - session.clock.reserve) < seconds]
        if not tight:
            break
        # Fewer rollouts at a time are faster for each: the most urgent session gives way.
        urgent = min(tight, key=lambda session: session.clock.left)
        sessions = [(session, count) for session, count in sessions if session is not urgent]
    return [session for session, _ in sessions]


def _postponed_variants(session: ReplanSession) -> list[Task]:
    """Return the task and, if parts are missing, variants that need them later and later."""
    task = session.task
    if not task.missing:
        return [task]
    latest = task.steps - len(task.missing)
    steps = sorted({round(latest * share) for share in np.linspace(0, 1, _AMBITIONS)})
    return [task.postpone((step,) * len(task.missing)) for step in steps]


def _branches(session: ReplanSession, count: int) -> list[States]:
    """Return proven paths from which samples continue."""
    prefixes = [session.prefix[:1]] * ((count + 1) // 2)
    length, back = len(session.prefix), _BACK
    while len(prefixes) < count:
        keep = length - back
        prefixes.append(session.prefix[: max(keep, 1)])
        back = back * 2 if keep > 1 else _BACK
    return prefixes


def _proven_steps(owners: Sequence[ReplanSession], rollouts: Sequence[Rollout]) -> list[int]:
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
    actions = Route.from_states(rollout.states).actions
    return (np.flatnonzero(task.needs_verdict(actions, Direction.DISASSEMBLY)) + 1).tolist()


def _judge(owners: Sequence[ReplanSession], states: States, parents: States) -> NDArray[np.int8]:
    """Return verdicts for several sessions in one batch; 0 for those whose clock has run out."""
    verdict = np.zeros(len(states), dtype=np.int8)
    oracle = owners[0].context.prover.oracle
    limited = any(session.clock.limited for session in owners)
    for rows in pieces(len(states), owners[0].clock.between if limited else None):
        rows = np.array([row for row in rows.tolist() if not owners[row].clock.passed], dtype=np.int64)
        if len(rows) == 0:
            continue
        since = time.perf_counter()
        found = oracle.verdicts(states[rows], near=parents[rows])
        taken = time.perf_counter() - since
        for k, row in enumerate(rows.tolist()):
            owners[row].oracle.asked += 1
            verdict[row] = owners[row].oracle.as_replayed(states[row][None], found[k])[0]
        for session in {id(owners[row]): owners[row] for row in rows.tolist()}.values():
            session.clock.add("verdicts", taken)
    return verdict

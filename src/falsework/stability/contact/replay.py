"""Replay of a sequence of states in assembly order, with contact history.

A state that is stable from rest may not be stable when it is reached as on site, because friction depends on earlier
sliding and on the load that a robot carried before its release. A replay carries displacements and spring forces from
state to state. Parts are inserted unstressed, robots release slowly, and every step is quasi-static, without inertia.
Robots that hold parts are springs with limits. Where a part cannot be let go of otherwise, the others press before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import islice, repeat

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from falsework.assembly.joints import SET
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, States, as_states
from falsework.stability.certificate import chunks
from falsework.stability.contact.build_verifier import StepCertificate
from falsework.stability.contact.history import Change, History, Presses, Replay, ReplaySettings, joined
from falsework.stability.contact.hold_loads import Loads, loads_in
from falsework.stability.contact.newton import OPEN, RESTS
from falsework.stability.contact.press import PressPlanner
from falsework.stability.contact.replay_kernel import replay_range
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.layout import COMPILED_LAYOUT
from falsework.stability.cpu.neighbourhood import REACH
from falsework.stability.holds import Press, inexact_presses, pack_presses
from falsework.stability.problem import build_problem
from falsework.stability.second_order.springs import into_cone, springs_at
from falsework.stability.settings import StabilitySettings
from falsework.stability.stiffness import movement_of
from falsework.utils.interruption import check_interruption, pieces

Array = NDArray[np.float64]


class Replayer:
    """Contact replay of state sequences of one structure, under changes of its settings at the same time if asked to.

    A history that has none under the changed settings is continued under the own settings alone.
    """

    def __init__(
        self,
        assembly: Assembly,
        settings: StabilitySettings = StabilitySettings(),
        replay: ReplaySettings = ReplaySettings(),
        solver: ContactSolver | None = None,
        *,
        varies: bool = False,
    ) -> None:
        """Lay out the structure.

        Args:
            settings: cone, gravity, tolerance and stiffness ratio.
            replay: numerical settings of the replay.
            solver: solver of the assembly under these settings, whose layout is then shared.
            varies: whether searches may have steps come to rest under changes of settings too.
        """
        self.varies = varies
        self.changes: tuple[Change, ...] = ()
        """Changes of settings under which every step must come to rest too."""
        self._varied: dict[Change, Replayer] = {}
        self.assembly = assembly
        self.settings = replace(settings, holds=settings.holds.resolved(assembly, settings.gravity))
        self.replay_settings = replay
        if solver is None:
            problem = build_problem(
                assembly, cone=settings.friction_cone, gravity=settings.gravity, reserve=settings.reserve
            )
            solver = ContactSolver(assembly, problem, settings)
        self.problem = solver.problem
        self.solver = solver
        """Solver whose layout of the structure it has."""
        self.law = solver.contact_structure
        later = replay.first_step / settings.numerics.first_step * settings.numerics.warm_first_step
        self.options = solver.contact_options._replace(
            tolerance=settings.tolerance, first_step=replay.first_step, warm_first_step=later
        )
        self._noise = self._draw_noise(replay)
        self._iterations = 0

    @property
    def iterations(self) -> int:
        """Newton iterations so far, under all settings: a measure of work that is the same on every machine."""
        return self._iterations + sum(one.iterations for one in self._varied.values())

    def also_under(self, changes: Sequence[Change]) -> None:
        """Have every step come to rest under these changes too; histories from before do not hold any more."""
        self.changes = tuple(changes)

    def alone(self) -> Replayer:
        """Return a new replayer of the same structure under its settings alone."""
        return Replayer(self.assembly, self.settings, self.replay_settings, self.solver)

    def vary(self, change: Change) -> Replayer:
        """Return the replayer of the same structure under changed settings."""
        if change not in self._varied:
            settings = change.applied_to(self.settings)
            solver = self.solver if settings == self.settings else None
            self._varied[change] = Replayer(self.assembly, settings, change.replay, solver)
        return self._varied[change]

    def replay(self, states: ArrayLike, history: History | None = None, presses: Presses | None = None) -> Replay:
        """Replay consecutive states up to the first that does not come to rest.

        Args:
            states: in assembly order, shape (states, parts).
            history: history of the first state; without it, gravity is ramped up on the first state.
            presses: of the steps that lead to each state. If not given they are chosen where a release does not come to
                rest without, unless the settings forbid it.

        Raises:
            StateError: states of the wrong length or with other values.
        """
        batch = np.require(as_states(states, self.assembly.boundary), requirements=COMPILED_LAYOUT)
        if presses is not None:
            return self._replay_all(batch, history, presses)
        none: list[tuple[Press, ...]] = [()] * len(batch)
        found = self._replay_all(batch, history, none)
        parts = [found]
        done = len(found.histories)
        while 0 < done < len(batch):
            helped = self._press(batch[done - 1], batch[done], found.histories[-1])
            if helped is None:
                break
            found = self._replay_all(batch[done:], helped, none[done:])
            parts.append(found)
            done += len(found.histories)
        return joined(parts, len(batch))

    def step(
        self, history: History, before: States, after: States, presses: Sequence[Press] | None = None
    ) -> tuple[bool, History]:
        """Take one step, as a replay of both states does that begins with the history of the first.

        Args:
            history: history of the state before.
            before, after: consecutive states in assembly order, shape (parts,).
            presses: of this step; chosen where they are needed if not given.

        Returns:
            Whether the structure comes to rest, and its history then.
        """
        given = None if presses is None else [(), tuple(presses)]
        replay = self.replay(np.stack([before, after]), history, given)
        return bool(replay.stands[1] == RESTS), replay.histories[-1]

    def certificates(self, states: ArrayLike, presses: Presses) -> Iterator[StepCertificate]:
        """Yield the certificate of the step to each state, up to the first that does not come to rest.

        Args:
            states: in assembly order, shape (states, parts).
            presses: of the steps that lead to each state.
        """
        batch = np.require(as_states(states, self.assembly.boundary), requirements=COMPILED_LAYOUT)
        history = None
        for some in chunks(np.arange(len(batch)), self.problem.points):
            rows = slice(max(some[0] - 1, 0), some[-1] + 1)
            found = self._replay(batch[rows], history, presses[rows])
            for kept in found.histories[some[0] - rows.start :]:
                assert kept.track is not None
                yield StepCertificate(kept.track, kept.torn, kept.presses)
            if not found.good:
                return
            history = found.histories[-1]

    def first_tipping(self, states: States, histories: Sequence[History], known: int = 0) -> int | None:
        """Return the first state that a small motion of parts near its change leaves, though it is at rest.

        Args:
            states: in assembly order, shape (states, parts).
            histories: of these states.
            known: number of states at the beginning that are known not to tip.
        """
        for row, (state, history) in enumerate(zip(states, histories, strict=True)):
            if row < known or (row and not ((state != states[row - 1]) & (state != HELD)).any()):
                continue  # a part that is held or placed changes no force, and only hinders others
            check_interruption()
            changed = state != states[row - 1] if row else np.ones(len(state), dtype=bool)
            near = np.asarray(changed, dtype=np.float64)
            for _ in range(REACH):
                near = near + self._touches @ near
            local = np.where((state == INSTALLED) & (near == 0), HELD, state).astype(np.uint8)
            forces = (history.springs * self.problem.force_scale[:, None])[None]
            strength = self.problem.strength.at(history.torn, history.age, self.assembly.joints)
            springs = springs_at(self.assembly, local[None], forces, self.settings.claim, strength)
            if self.solver.second_order.growing_motion(local, history.displacement, springs) is not None:
                return row
        return None

    def slip(self, before: History, after: History) -> float:
        """Return the largest movement of a part between two histories, as a share of the movement limit.

        Where steps are replayed under changed settings too, the largest under any of them.
        """
        most = 0.0
        for one, other in zip((before, *before.changed), (after, *after.changed), strict=False):
            moved = movement_of(other.displacement - one.displacement, self.law.reach)
            most = max(most, float(moved.max(initial=0.0)))
        return most / self.law.limit

    def loads(self, states: States, histories: Sequence[History]) -> Loads:
        """Return what robots bear in states in assembly order, after which the histories are these."""
        problem, joints, cone, found = self.problem, self.assembly.joints, self.settings.friction_cone, []
        loads = self.assembly.applied_wrench(self.settings.gravity)
        # Where joints set or break, every state has contacts of its own strength.
        rows = np.arange(len(histories))
        alone = (joints is not None and joints.setting) or any(history.torn.any() for history in histories)
        for together in np.split(rows, rows[1:]) if alone else chunks(rows, problem.points):
            some, here = [histories[row] for row in together], states[together]
            strength = problem.strength.at(some[0].torn, some[0].age, joints)
            springs = np.stack([history.springs for history in some]) * problem.force_scale[:, None]
            acts = problem.geometry.present(here)[..., None]
            forces = np.where(acts, into_cone(springs, strength, cone)[0], 0.0)
            wrenches = -(problem.geometry.wrenches(forces) + loads)
            found += [loads_in(self.assembly, state, wrench) for state, wrench in zip(here, wrenches, strict=True)]
        return tuple(found)

    @cached_property
    def _touches(self) -> csr_array:
        """Which parts are in contact, shape (parts, parts)."""
        a, b = self.problem.pair_parts.T
        ends = np.concatenate([a, b]), np.concatenate([b, a])
        return csr_array((np.ones(len(ends[0])), ends), shape=(self.problem.parts,) * 2)

    @cached_property
    def _presses(self) -> PressPlanner:
        return PressPlanner(self.solver)

    def _press(self, before: States, after: States, history: History) -> History | None:
        """Return the history of a step in which robots press before a part is released; None if none is found."""
        if not self.settings.holds.presses or not ((before == HELD) & (after == INSTALLED)).any():
            return None
        shares, pair = self._set_shares(history.age[None])[0], np.stack([before, after])
        for presses in self._presses.proposals(before, after, history.springs, history.torn, shares):
            found = self._replay_all(pair, history, [(), presses])
            if found.good:
                inexact = ([(), varied] for varied in inexact_presses(presses))
                if all(self._replay(pair, history, varied).good for varied in inexact):
                    return found.histories[-1]
        return None

    def _set_shares(self, ages: NDArray[np.int32]) -> Array:
        """Return shares of the strength that contact points have reached, shape (states, points) or (states, 0)."""
        return np.zeros(ages.shape) if self.assembly.joints is None else self.assembly.joints.set_share(ages)

    def _replay_all(self, batch: States, history: History | None, presses: Presses) -> Replay:
        """Replay checked states with given presses, under the changed settings too, up to the first that falls."""
        found = self._replay(batch, history, presses)
        if not self.changes or (history is not None and not history.changed):
            return found
        others, reached = list[Sequence[History]](), len(found.histories)
        for number, change in enumerate(self.changes):
            if not reached:  # the first state does not come to rest
                break
            past = None if history is None else history.changed[number]
            other = self.vary(change)._replay(batch[:reached], past, change.inexact(presses[:reached]))
            others.append(other.histories)
            if len(other.histories) < reached:
                reached = len(other.histories)
                found = _cut(found, other, reached)
        whole = [
            replace(own, changed=tuple(some[row] for some in others))
            for row, own in enumerate(found.histories[:reached])
        ]
        return replace(found, histories=tuple(whole), presses=found.presses[:reached])

    def _replay(self, batch: States, history: History | None, presses: Presses) -> Replay:
        """Replay checked states with given presses, under the own settings alone."""
        count, problem = len(batch), self.problem
        increments, keeps_track = self.replay_settings.increments, self.replay_settings.keeps_track
        track = np.zeros((count, increments if keeps_track else 0, problem.parts, 6))
        displacement, springs = np.zeros((count, problem.parts, 6)), np.zeros((count, problem.points, 3))
        torn = np.zeros((count, problem.points), bool)
        age = self._ages(batch, None if history is None else history.age)
        result, residual, moved = np.full(count, OPEN, np.int8), np.full(count, np.nan), np.zeros(count)
        part, iterations = np.full(count, -1, np.int32), np.zeros(count, np.int32)
        if history is not None:
            displacement[0], springs[0], torn[0] = history.displacement, history.springs, history.torn
            moved[0], part[0] = history.moved, history.part
            if keeps_track and history.track is not None:
                track[0] = history.track
        start, pressed, wrench = pack_presses(presses)
        given = (start, pressed, (problem.whitening[pressed] @ wrench[:, :, None])[:, :, 0])
        arrays = displacement, springs, torn, self._set_shares(age), track, result, residual, part, moved, iterations
        reached = 0
        for rows in pieces(count):
            first, last = int(rows[0]), int(rows[-1]) + 1
            options = self.options, increments, self._noise
            reached = replay_range(self.law, batch, first, last, history is None, *given, *options, *arrays)
            if reached < last:
                break
        self._iterations += int(iterations.sum())
        done = [tuple(some) for some in presses]
        if history is not None:
            done[0] = history.presses
        tracks = track if keeps_track else repeat(None)
        rows = zip(displacement, springs, torn, age, moved.tolist(), part.tolist(), done, tracks, strict=False)
        histories = tuple(History(*row) for row in islice(rows, reached))
        return Replay(result, moved, part, residual, histories, tuple(one.presses for one in histories))

    def _ages(self, states: States, age: NDArray[np.int32] | None) -> NDArray[np.int32]:
        """Return for how many steps both parts of each contact point have been present.

        Args:
            states: in assembly order, shape (states, parts).
            age: age in the first of them; without it, the joints present there have set.

        Returns:
            Shape (states, points), or (states, 0) where no joint sets.
        """
        if self.assembly.joints is None or not self.assembly.joints.setting:
            return np.zeros((len(states), 0), np.int32)
        there = self.problem.geometry.present(states)
        ages = np.zeros(there.shape, np.int32)
        ages[0] = SET if age is None else age
        for row in range(1, len(states)):
            ages[row] = np.where(there[row] & there[row - 1], ages[row - 1] + 1, 0)
        return ages

    def _draw_noise(self, replay: ReplaySettings) -> Array:
        noise = np.zeros((self.problem.points, 2))
        if replay.friction_noise:
            rng = np.random.default_rng(replay.seed)
            mass = self.assembly.mass.mass[~self.assembly.immovable]
            typical = self.problem.friction * self.settings.gravity * (mass.mean() if len(mass) else 0.0) / 8
            angle = rng.uniform(0, 2 * np.pi, self.problem.points)
            size = replay.friction_noise * typical * rng.uniform(0, 1, self.problem.points)
            noise = np.stack([np.cos(angle), np.sin(angle)], axis=1) * (size / self.problem.force_scale)[:, None]
        return noise


def _cut(found: Replay, other: Replay, row: int) -> Replay:
    """Return a replay that ends in a state which does not come to rest in another."""
    stands, part = found.stands.copy(), found.part.copy()
    stands[row], part[row] = other.stands[row], other.part[row]
    stands[row + 1 :] = OPEN
    return replace(found, stands=stands, part=part)

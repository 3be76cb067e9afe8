"""Last tests of the routes of a search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from falsework.assembly.state import States
from falsework.errors import InputError
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.plan_replay import PlanReplay
from falsework.stability.contact.history import Presses, of_all
from falsework.stability.contact.varied_replay import FEW, MANY, TRUE_FRICTION, AllVariations, RouteReplay
from falsework.stability.holds import HoldLoad

if TYPE_CHECKING:
    from falsework.search.problem.result import Stop
    from falsework.stability.contact.replay import Replayer


class Acceptance:
    """Last tests of a route: it comes to rest under the true friction too, and no state of it tips.

    With a reserve it also comes to rest under each of a few changes of all settings. Where it is asked for, these are
    many, and discrete elements build it as well.
    """

    def __init__(self, replayer: Replayer | None, *, robust: bool = False, judge: bool = False) -> None:
        """Prepare the test; without a replayer there is none.

        Raises:
            InputError: a judge without a replayer, or of a structure with joints.
        """
        if judge and replayer is None:
            raise InputError("the judge builds plans under the criterion contact; choose it, or leave the judge out")
        self._judge = None
        if judge and replayer is not None:
            from falsework.stability.judges.discrete_elements import BuildJudge

            self._judge = BuildJudge(replayer.assembly, replayer.settings.holds, replayer.settings.gravity)
        self._replayer, self._plain = replayer, None
        self.variations: AllVariations | None = None
        """Test under changed settings."""
        self._loads: list[tuple[HoldLoad, ...]] = []
        """What robots bear in the states of the last route, as far as it was tested."""
        if replayer is not None and replayer.varies and (robust or replayer.settings.reserve > 1.0):
            self.variations = AllVariations(replayer, MANY if robust else FEW)
        if replayer is not None:
            self._plain = RouteReplay(replayer, TRUE_FRICTION)

    @property
    def varies(self) -> bool:
        """Whether settings are changed."""
        return self.variations is not None

    def fails_at(self, states: States, presses: Presses) -> int | None:
        """Return the first state of a route, or of its beginning, that slides under the true friction, or tips.

        Where one slides, the replayer tries steps under the true friction too from then on.

        Args:
            states: in assembly order, shape (steps + 1, parts); they come to rest with the reserve.
            presses: of the steps that lead to each state.

        Returns:
            None if there is no such state. Then what robots bear is known.
        """
        assert self._plain is not None
        plain, done = self._plain.replayer, self._plain.begin(states, presses)
        loads = self._loads = self._loads[:done]
        try:
            for first, histories in self._plain.pieces(states):
                some, known = states[first : first + len(histories)], done - first
                row = plain.first_tipping(some, histories, known)
                if row is not None:
                    return row + first
                loads += plain.loads(some[known:], histories[known:])
                done = first + len(histories)
        except DeadlineExceeded:
            plain.replay(states, presses=presses)  # which notes that this route was not replayed to its end
            raise
        if done == len(states):
            return None
        if self.variations is not None:
            self.variations.add(TRUE_FRICTION)
        return done

    def tested(self, states: States, found: PlanReplay) -> PlanReplay:
        """Return the replay of a route with what robots bear; the one that fails if a state slides or tips.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            found: replay with the reserve, which stands.
        """
        if self._plain is None:
            return found
        row = self.fails_at(states, of_all(found.presses, len(states)))
        if row is not None:
            return replace(found, stands=False, falls_at=row)
        return replace(found, loads=tuple(self._loads))

    def judged(self, states: States, found: PlanReplay, stop: Stop | None = None) -> PlanReplay:
        """Return the replay of a route that stands with how far discrete elements built it, if that is asked for.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            found: its replay.
            stop: asked before every state; true leaves the others out.
        """
        if self._judge is None:
            return found
        presses = of_all(found.presses, len(states))
        return replace(found, judgement=self._judge.judge(states, presses, stop or (lambda: False)))

    def falls_at(self, states: States) -> int | None:
        """Return the first state that does not come to rest, with presses chosen anew, or tips.

        Args:
            states: in assembly order, shape (steps + 1, parts).

        Returns:
            None if all stand, with the reserve of the replayer, under the true friction and under changed settings;
            always without a replayer.
        """
        return None if self._replayer is None else self.replayed(states)[0].falls_at

    def replayed(
        self,
        states: States,
        known: PlanReplay | None = None,
        stood: Callable[[PlanReplay], None] = lambda found: None,
    ) -> tuple[PlanReplay, int | None]:
        """Replay a route, and again with presses chosen anew under the changes of settings under which it falls.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            known: its replay, where a search has made it, which then makes the next one, too.
            stood: called with each replay that stands, before settings are changed.

        Returns:
            The last replay, and where the one that is known fell under a change from which the replayer has learned;
            None if it did not.
        """
        assert self._replayer is not None
        while True:
            before = self._replayer.changes
            found = known or PlanReplay.from_replay(self._replayer.replay(states))
            found = self.tested(states, found) if found.stands else found
            row = found.falls_at if self._replayer.changes != before else None
            if found.stands:
                stood(found)
                if self.variations is not None:  # from a fall on, the replayer tries steps under changes too
                    row = self.variations.falls_at(states, of_all(found.presses, len(states)))
            if row is None or known is not None:
                return found, row

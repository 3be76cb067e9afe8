"""Tests that a complete route must pass before a search delivers it, and what a search learns from those that fail."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from falsework.assembly.state import States
from falsework.search.plans.acceptance import Acceptance
from falsework.search.problem.oracle import Oracle
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.result import Route, Stop, barred_row
from falsework.search.problem.search import Search
from falsework.search.settings import PlannerSettings
from falsework.stability.contact.history import Change
from falsework.stability.contact.replay import Replayer


def barred_state(states: States, row: int) -> States:
    """Return the state to exclude where a route fails in one, shape (parts,).

    Args:
        states: of the route, shape (steps + 1, parts).
        row: of the state that fails.
    """
    return states[barred_row(row, len(states)) or 0]


class RouteTests:
    """Margins, replay, acceptance and judge of the routes of a search; a state in which one fails is excluded."""

    def __init__(self, oracle: Oracle, settings: PlannerSettings, parts: int) -> None:
        """Begin without routes.

        Raises:
            InputError: a judge that the settings ask for cannot be had; see `Acceptance`.
        """
        self.fallen: tuple[Route, int] | None = None
        """Route whose replay gets farthest before it fails, and the step of assembly at which it fails."""
        self.replays: dict[bytes, PlanReplay] = {}
        """Replays that come to rest in every state, by the states of the routes."""
        self.doubted: Route | None = None
        """Of the routes that stand in their replays, and fail under changed settings or in the judge, the one built
        farthest."""
        self.when_one_stands: Callable[[], None] = lambda: None
        """Called when the first route stands in its replay."""
        self.forbidden = np.empty((0, parts), dtype=np.uint8)
        """Excluded states, shape (count, parts)."""
        self.again: States | None = None
        """State in which the last route fell under changed settings, if the search can build that far anew."""
        self.replayer: Replayer | None = oracle.replayer
        """Replayer of complete routes; None where there is no history to take into account."""
        self._settings = settings
        self._acceptance = Acceptance(self.replayer, robust=settings.robust, judge=settings.judge)
        self._oracle = oracle

    @property
    def slow(self) -> bool:
        """Whether tests other than a replay decide."""
        return self._settings.judge or self._acceptance.varies

    @property
    def changes(self) -> tuple[Change, ...]:
        """Changes of settings under which replays are tried so far."""
        return () if self.replayer is None else self.replayer.changes

    def test_so_far(self, search: Search) -> None:
        """Test what a search has built under changed settings; where that falls, have it go back, and learn them.

        The same holds for the true friction. A state that tips is excluded.
        """
        variations = self._acceptance.variations
        if variations is None or (built := search.built()) is None or len(built[0]) < 2:
            return
        (states, presses), known = built, self.changes
        row = variations.falls_at(states, presses)
        if row is None:
            row = self._acceptance.fails_at(states, presses)
        if row is None:
            return
        state = states[max(row, 1)]  # every path begins with the first
        if self.changes != known:
            search.go_back(state)
        else:
            self._exclude(state)
            search.forbid(self.forbidden)

    def passes(self, route: Route, known: PlanReplay | None = None, stop: Stop | None = None) -> bool:
        """Return whether a route passes all tests; exclude the first state that fails.

        An oracle that requires margins first checks every state in full. The slow tests come last: changed settings,
        and the judge. Where the route falls under changes, these are among `Replayer.changes` from then on. No state
        is excluded if the search has replayed the steps itself, since it can do so under them.

        Args:
            known: its replay, where the search has made it along the way.
            stop: asked before every state that is judged.

        Raises:
            KeyboardInterrupt: `stop` returned true before the judge was done.
        """
        self.again = None
        weak = np.flatnonzero(~self._oracle.keeps(route.states[1:-1])) + 1
        if len(weak):
            self._exclude(route.states[weak])
            return False
        if self.replayer is None:
            return True
        states, key, before = route.states[::-1], route.states.tobytes(), self.changes

        def stood(found: PlanReplay) -> None:
            self.replays[key] = found
            if self.doubted is None:  # until the slow tests are done, or a deadline or the keyboard ends them
                self.doubted = route
                self.when_one_stands()

        found, row = self._acceptance.replayed(states, known, stood)
        if row is not None:
            self.again = barred_state(states, row) if self.changes != before else None
            return False
        if found.stands:
            self.replays[key] = found = replace(found, varied=self._acceptance.varies)
            if self._settings.judge:
                found = self._judge(route, found, stop)
            if found.fails_at is None:
                return True
        row = found.fails_at or 0
        if not found.stands and (self.fallen is None or row > self.fallen[1]):
            self.fallen = route, row
        self._exclude(barred_state(states, row))
        return False

    def pack(self) -> tuple[dict[str, Any], dict[str, States]]:
        """Return what a search has learned from its routes: plain values, and arrays with names after `tests_`."""
        none = self.forbidden[:0]
        fallen, row = (None, 0) if self.fallen is None else self.fallen
        arrays = {"tests_forbidden": self.forbidden}
        for name, route in (("fallen", fallen), ("doubted", self.doubted)):
            arrays[f"tests_{name}"] = none if route is None else route.states
        return {"changes": [change.name for change in self.changes], "fallen_at": row}, arrays

    def restore(self, header: Mapping[str, Any], arrays: Mapping[str, States]) -> None:
        """Go on with what `pack` returned.

        Raises:
            KeyError, TypeError, ValueError: it is something else.
        """
        self.forbidden = arrays["tests_forbidden"]
        fallen, doubted = (arrays[f"tests_{name}"] for name in ("fallen", "doubted"))
        self.fallen = (Route.from_states(fallen), int(header["fallen_at"])) if len(fallen) else None
        self.doubted = Route.from_states(doubted) if len(doubted) else None
        if self._acceptance.variations is not None:
            self._acceptance.variations.learn(header["changes"])

    def _exclude(self, states: States) -> None:
        self.forbidden = np.concatenate([self.forbidden, np.atleast_2d(states)])

    def _judge(self, route: Route, found: PlanReplay, stop: Stop | None) -> PlanReplay:
        """Return the replay of a route with what the judge says; keep the route if it gets farther than others."""
        assert self.doubted is not None
        found = self._acceptance.judged(route.states[::-1], found, stop)
        self.replays[route.states.tobytes()] = found
        known = self.replays.get(self.doubted.states.tobytes())  # a search that was resumed has none
        judgement, best = found.judgement, None if known is None else known.judgement
        if judgement is not None and (best is None or judgement.built > best.built):
            self.doubted = route
        if judgement is not None and not judgement.stands and judgement.falls_at is None:
            raise KeyboardInterrupt
        return found

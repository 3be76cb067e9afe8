"""Solvability check: states from which the target is known to be reachable, and a search that connects others to them.

One abstract plan is found first: by a rollout if there is an action score, else by a search. Its states are
solvable, and so is every state from which a short, narrow forward search reaches a solvable one. The set grows with
every result, so that alternatives near a plan are cheap to check.

Under the criterion `contact` a plan is followed only if its replay in assembly order succeeds. The state in which
the structure collapses is then forbidden, and states that could only continue through it are no longer solvable.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence, Set
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, Mask, States
from falsework.geometry.clearance.locked import PartSet
from falsework.robots.keyframes.joint_holds import HoldingOracle, JointHolds
from falsework.robots.keyframes.keyframes import set_action, state_after
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.settings import BeamSettings
from falsework.search.beam.state_search import StateSearch
from falsework.search.planner import MOST_FALLS, Planner
from falsework.search.plans.acceptance import Acceptance
from falsework.search.problem.guide import Guide, SupportGuide
from falsework.search.problem.result import Route, SearchResult, Stop, barred_row
from falsework.search.problem.rollout import follow_scores
from falsework.search.problem.search import Search
from falsework.search.problem.task import Direction, Task
from falsework.search.settings import PlannerSettings
from falsework.search.together.exits import exit_path, sets_of
from falsework.stability.cache import unique_rows
from falsework.stability.oracle import StabilityOracle

_LEVELS = 8
"""Lookahead of the search, in steps."""
_WIDTH = 6
"""Beam width of the search."""
_VERDICTS = 48
"""Verdict budget of the search: states that do not join soon rarely do."""
ActionScore = Callable[[States, Mask], NDArray[np.floating]]
"""Score of the actions out of states, like a `falsework.search.problem.guide.Guide` in disassembly."""
_FIRST_BEAM_WIDTH = 256
"""Widest beam for the first plan."""
_VARIED_WIDTH = 16
"""Widest beam for a varied plan, and number of simultaneous rollouts with random actions."""
_VARIED_VERDICTS = 2000
"""Verdict budget for a varied plan from each end: a beam that needs more is stuck, and slow under `contact`."""


class ConnectingSearch:
    """Searches for paths to solvable states, with an account of what they cost."""

    def __init__(self, oracle: StabilityOracle | HoldingOracle, guide: Guide) -> None:
        self._oracle, self._guide = oracle, guide
        self.spent = 0
        """Number of verdicts spent."""
        self._left = 0

    def path(self, task: Task, start: States, solvable: Set[bytes], forbidden: Set[bytes]) -> States | None:
        """Return the stable states from one to the last before a solvable one; None without a path."""
        refused = set(forbidden)
        while (path := self._unverified_path(task, start, solvable, refused)) is not None:
            # Holds rarely fail, and most searches reach nothing: holds are checked only on a path that was found.
            holds = path[1:][(path[1:] != REMOVED).sum(axis=1) == (path[:-1] != REMOVED).sum(axis=1)]
            if not self._oracle.holds_keep_stable and len(holds):
                fallen = holds[~self._oracle.verdicts(holds).stable]
                refused |= {state.tobytes() for state in fallen}
                if len(fallen):
                    continue
            return path
        return None

    def _unverified_path(self, task: Task, start: States, solvable: Set[bytes], refused: Set[bytes]) -> States | None:
        """Return states from a stable one to the last before a solvable one; none is refused, holds are not checked."""
        self._left = _VERDICTS
        paths: States = start[None, None]
        judged: States = start[None]  # on each path, the last state that has a verdict
        for _ in range(_LEVELS):
            states = paths[:, -1]
            rows, actions = np.nonzero(task.moves(states, Direction.DISASSEMBLY))
            if not len(rows):
                return None
            after = task.follow(states[rows], actions, Direction.DISASSEMBLY)
            first = np.sort(unique_rows(after)[0])
            rows, actions, after = rows[first], actions[first], after[first]
            hit = next((k for k, state in enumerate(after) if state.tobytes() in solvable), None)
            if hit is not None:  # solvable states are stable, so the step to one needs no verdict
                return paths[rows[hit]]
            kept = self._stable_few(task, states[rows], judged[rows], after, actions, refused)
            if not len(kept):
                return None
            removed = actions[kept] >= task.part_count
            judged = np.where(removed[:, None], after[kept], judged[rows[kept]])
            paths = np.concatenate([paths[rows[kept]], after[kept][:, None]], axis=1)
        return None

    def _stable_few(
        self, task: Task, before: States, judged: States, after: States, actions: NDArray[np.intp], refused: Set[bytes]
    ) -> NDArray[np.intp]:
        """Return the most promising successors: few held, then the guide's score; after removals only stable ones."""
        removal = actions >= task.part_count
        mask = np.zeros((len(before), 2 * task.part_count), dtype=bool)
        mask[np.arange(len(before)), actions] = True
        score = np.asarray(self._guide(before, mask, Direction.DISASSEMBLY))[np.arange(len(before)), actions]
        held = ((after == HELD) & ~task.boundary).sum(axis=1)
        order = np.lexsort((-score, held))
        order = order[[after[k].tobytes() not in refused for k in order]]
        # Successors beyond the limits on holds and verdicts are dropped.
        number = np.where(removal[order], removal[order].cumsum(), (~removal[order]).cumsum())
        order = order[number <= np.where(removal[order], self._left, 2 * _WIDTH)]
        kept: list[NDArray[np.intp]] = []
        room = 3 * _WIDTH
        while room and len(order):
            batch, order = order[:room], order[room:]
            asked = batch[removal[batch]]
            self._left -= len(asked)
            self.spent += len(asked)
            good = ~removal[batch]
            if len(asked):
                good[~good] = self._oracle.verdicts(after[asked], near=judged[asked]).stable
            kept.append(batch[good])
            room -= int(good.sum())
        return np.concatenate([np.empty(0, np.intp), *kept])


class SolvabilityCheck:
    """Abstract actions for the hybrid planner that provably keep the target reachable."""

    def __init__(
        self,
        assembly: Assembly,
        task: Task,
        oracle: StabilityOracle,
        *,
        guide: Guide | None = None,
        score: ActionScore | None = None,
        seed: int = 0,
        joint: JointHolds | None = None,
        varied_verdicts: int = _VARIED_VERDICTS,
    ) -> None:
        """Know only the target to be solvable; by default the guide lets parts with much support go in first."""
        self.joint, self._varied_verdicts = joint, varied_verdicts
        self.oracle = oracle if joint is None else HoldingOracle(oracle, joint)
        self._acceptance = Acceptance(oracle.replayer)
        self.task = task.judged_by(self.oracle)
        self._guide, self._score, self._seed = guide or SupportGuide(assembly), score, seed
        self._touched = ~task.boundary & ~np.isin(np.arange(task.part_count), task.fixed)
        self._sets = sets_of(task, self._touched)[0]
        self.postponed: tuple[int, ...] = ()
        self.fallen: tuple[Route, int] | None = None
        """Where `prepare` finds nothing: the plan that got farthest in its replay, and the state of its collapse."""
        self.joining = ConnectingSearch(self.oracle, self._guide)
        """Searches for paths to solvable states."""
        self._preferred: dict[bytes, int] = {}  # states of the plan to follow, with their places in it
        self._solvable: set[bytes] = {task.target.tobytes()}
        self._not_found, self._forbidden = set[bytes](), set[bytes]()
        self._moves: dict[bytes, list[int]] = {}
        self._stop: Stop = lambda: False

    def __len__(self) -> int:
        return len(self._solvable)

    def prepare(self, stop: Stop | None = None) -> SearchResult:
        """Find one abstract plan, with releases where no other is found; of missing parts the latest step of each."""
        self._stop = stop or self._stop  # what is searched later ends with it too
        settings = PlannerSettings(width=_FIRST_BEAM_WIDTH, seed=self._seed)
        planner = Planner(replace(self.task, allow_regrasp=False), self.oracle, settings, guide=self._guide)
        route = self.roll_out(None) or self.roll_out(np.random.default_rng(self._seed))
        if route is not None:
            planner.begin_with(route)
        result = planner.run(stop=stop).unless_interrupted(stop)  # replays the plans that it finds
        self.fallen = planner.tests.fallen
        if result.found:
            self.postponed = planner.postponed
            self.task = self.task.postpone(planner.postponed)
            self.follow(planner.routes)
        elif self.task.allow_regrasp:
            again = Planner(self.task, self.oracle, settings, guide=self._guide)
            if again.regrasps:
                result, self.fallen = again.run(stop=stop).unless_interrupted(stop), again.tests.fallen
                self.follow(again.routes)
        return result

    def perturb(self, seed: int) -> None:
        """Find another abstract plan to follow, with a perturbed guide score; the old one stays known."""
        rng = np.random.default_rng([self._seed, seed])
        if (route := self.roll_out(rng)) is not None:
            self.follow([route])
            return

        def disturbed(states: States, actions: Mask, direction: Direction) -> NDArray[np.floating]:
            scores = np.asarray(self._guide(states, actions, direction), dtype=np.float64)
            return scores + rng.normal(scale=0.3 * (scores.std() + 1e-3), size=scores.shape)

        for direction in [*Direction][:: -1 if seed % 2 else 1]:
            beam = self._beam(self.task, direction, seed, disturbed)
            if self.follow(self._search(beam, _VARIED_WIDTH, self._varied_verdicts)):
                return

    def falls(self, route: Route) -> int | None:
        """Return the first state in assembly order in which the replay of a route collapses; None if it succeeds.

        It must come to rest with the reserve of the oracle, and under the true friction; `equilibrium` has no history.
        """
        return self._acceptance.falls_at(route.states[::-1])

    def forbid(self, route: Route, row: int) -> int | None:
        """Forbid the state in which the replay of a route collapses, and all states that continue only through it.

        `row` and the result are indices in assembly order; None for a route without states between its ends.
        """
        barred = barred_row(row, len(route.states))
        if barred is not None:
            self._forbidden.add(route.states[::-1][barred].tobytes())
            self._prune()
        return barred

    def stays(self, state: States) -> bool:
        """Return whether a state is known to be solvable."""
        return state.tobytes() in self._solvable

    def reroute(self, state: States) -> bool:
        """Find a path from a stable state to the target that avoids excluded holds; return whether there is one."""
        self._prune()
        if self.stays(state):
            return True
        if self.joint is None or self.task.missing:
            return False
        task = replace(self.task, start=state)
        for _ in range(MOST_FALLS):
            beam = self._beam(task, seed=self._seed)
            routes = self._search(beam, _VARIED_WIDTH, self._varied_verdicts)
            if not routes or not any(self.joint.learn_from(route.states) for route in routes):
                return self.follow(routes)
        return False

    def _prune(self) -> None:
        """Keep the solvable states that still have a path to the target."""
        known = np.array([np.frombuffer(key, np.uint8) for key in self._solvable - self._forbidden])
        if self.joint is not None:
            known = known[self.joint.possible(known)]
        moves = self.task.moves(known, Direction.DISASSEMBLY)
        moves[:, : self.task.part_count] |= self.releasable(known)
        before: dict[bytes, set[bytes]] = defaultdict(set)
        steps = [*zip(*(index.tolist() for index in np.nonzero(moves)), strict=True)]
        for row, state in enumerate(known):
            steps += [(row, set_action(parts, len(state))) for parts in self._leaving_sets(state)]
        for row, action in steps:
            before[state_after(known[row], action).tobytes()].add(known[row].tobytes())
        left = new = {self.task.target.tobytes()}
        while new:
            new = set().union(*(before[state] for state in new)) - left
            left = left | new
        self._solvable = left
        self._preferred = {state: place for state, place in self._preferred.items() if state in left}

    def _beam(
        self, task: Task, direction: Direction = Direction.DISASSEMBLY, seed: int = 0, guide: Guide | None = None
    ) -> Search:
        """Return a beam over the states of a task, by default with the guide of this search."""
        guide = guide or self._guide
        if task.together is not None:
            return StateSearch(replace(task, allow_regrasp=False), self.oracle, direction, guide=guide)
        return BeamSearch(task, self.oracle, BeamSettings.from_width(1, direction, seed=seed), guide=guide)

    def _search(self, beam: Search, widest: int, verdicts: float = np.inf) -> Sequence[Route]:
        """Return routes of a beam search with successful replays; none if time or verdicts do not suffice."""

        def stop() -> bool:
            return beam.counters.asked >= verdicts or self._stop()

        def found() -> Sequence[Route]:
            if self._forbidden:
                beam.forbid(np.array([np.frombuffer(key, np.uint8) for key in sorted(self._forbidden)]))
            return beam.run(widest, stop=stop).unless_interrupted(stop).routes

        return self._standing(found)

    def _standing(self, found: Callable[[], Sequence[Route]]) -> Sequence[Route]:
        """Return routes that are found; where the replay of the first falls its state is forbidden, and it goes on."""
        for _ in range(MOST_FALLS):
            routes = found()
            row = self.falls(routes[0]) if routes else None
            if row is None:
                return routes
            if self.forbid(routes[0], row) is None:
                break
        return ()

    def roll_out(self, rng: np.random.Generator | None) -> Route | None:
        """Roll out the action score to the target, greedily or sampled; None without a score or a complete rollout.

        After every action the structure is stable, or the next best one is taken; none leads to a forbidden state.
        """
        if self._score is None or self.task.steps == 0:
            return None
        score, rows = self._score, 1 if rng is None else _VARIED_WIDTH

        def found() -> Sequence[Route]:
            rollouts = follow_scores(
                [self.task],
                np.repeat(self.task.start[None], rows, axis=0),
                np.zeros(rows, dtype=np.int64),
                lambda states, legal, _: score(states, legal),
                rng=rng,
                stable=self._allowed,
                next_best=True,
                stop=lambda _: self._stop(),
            )
            return [Route.from_states(rollout.states) for rollout in rollouts if rollout.reached][:1]

        return next(iter(self._standing(found)), None)

    def _allowed(self, _: NDArray[np.int64], states: States, parents: States) -> Mask:
        """Return which states are stable and not forbidden; a forbidden one costs no verdict."""
        allowed = np.array([state.tobytes() not in self._forbidden for state in states], dtype=bool)
        if allowed.any():
            allowed[allowed] = self.oracle.verdicts(states[allowed], near=parents[allowed]).stable
        return allowed

    def preferred(self, state: States, action: int) -> bool:
        """Return whether an action follows the plan found last."""
        place = self._preferred.get(state_after(state, action).tobytes(), -1)
        return place > self._preferred.get(state.tobytes(), -1)

    def follow(self, routes: Sequence[Route]) -> bool:
        """Take the states of routes for solvable, and prefer the steps along them; return whether there are any."""
        if routes:
            self._preferred = {state.tobytes(): k for route in routes for k, state in enumerate(route.states)}
            self._solvable |= self._preferred.keys()
        return bool(routes)

    def relax(self, share: float) -> None:
        """Let missing parts come after a share of the steps that stability alone allows them to wait."""
        if share == 1.0:
            return
        self.task = self.task.postpone([int(share * steps) for steps in self.postponed])
        self._moves.clear()
        self._not_found.clear()
        # The known states surround the plan with the latest parts: add one for the new rules.
        beam = self._beam(self.task, seed=self._seed)
        self.follow(self._search(beam, _FIRST_BEAM_WIDTH))

    def legal(self, state: States) -> list[int]:
        """Return actions that the rules allow, stability and releases aside."""
        key = state.tobytes()
        if key not in self._moves:
            single = np.flatnonzero(self.task.moves(state[None], Direction.DISASSEMBLY)[0]).tolist()
            self._moves[key] = single + [set_action(parts, len(state)) for parts in self._leaving_sets(state)]
        return self._moves[key]

    def _leaving_sets(self, state: States) -> list[PartSet]:
        """Return the sets of held parts that can leave at the same instant in a state."""
        held = [parts for parts in self._sets if (state[list(parts)] == HELD).all()]
        return [parts for parts in held if exit_path(self.task, state, parts) is not None]

    def planned_releases(self, state: States) -> list[int]:
        """Return the part that the plan found last releases in a state, if it does."""
        parts = np.flatnonzero(self.releasable(state) & (state.tobytes() in self._preferred)).tolist()
        return [part for part in parts if self.preferred(state, part)]

    def releasable(self, states: States) -> Mask:
        """Return which parts robots hold and may release, stability aside. Shape that of the states."""
        return (states == HELD) & self._touched & self.task.allow_regrasp

    def known(self, state: States, action: int) -> bool:
        """Return whether the state after an action is known to be solvable."""
        return state_after(state, action).tobytes() in self._solvable

    def solvable(self, state: States, action: int) -> bool:
        """Return whether the state after an action is stable and a path from there to the target is found; cached."""
        after = state_after(state, action)
        key = after.tobytes()
        if key in self._solvable:
            return True
        if key in self._not_found or key in self._forbidden:
            return False
        if self.joint is not None and not self.joint.possible(after[None])[0]:
            return False
        release = action < len(state) and state[action] == HELD
        number = np.array([min(action, len(state))])
        asked = release or self.task.needs_verdict(number, Direction.DISASSEMBLY)[0]
        if (asked and not self.oracle.verdicts(after[None], near=state[None]).stable[0]) or not self._join(after):
            self._not_found.add(key)
            return False
        return True

    def _join(self, start: States) -> bool:
        """Search forwards from a stable state until a solvable one is reached; all on the path then are."""
        path = self.joining.path(self.task, start, self._solvable, self._forbidden)
        if path is None:
            return False
        self._solvable |= {state.tobytes() for state in path}
        return True

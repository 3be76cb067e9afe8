"""Fewest robots: a plan with `n`, and a proof that none exists with `n - 1`, or the strongest bound found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.load import AnyStructure, as_assembly
from falsework.assembly.model import Assembly
from falsework.assembly.state import REMOVED, held_count
from falsework.search.find import FIRST_SHARE, PLANS, make_task
from falsework.search.planner import Planner
from falsework.search.plans.plan import Plan
from falsework.search.plans.proofs import prove_route
from falsework.search.problem.deadline import Deadline, DeadlineExceeded
from falsework.search.problem.ends import judge_ends
from falsework.search.problem.guide import SupportGuide
from falsework.search.problem.hold_bound import Barrier, HoldBound
from falsework.search.problem.result import Outcome, Progress, Result, SearchResult, progress_text
from falsework.search.problem.task import Direction, Task
from falsework.search.settings import PlannerSettings
from falsework.search.task_rules import TaskRules
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.utils.display.notebook import or_notebook
from falsework.utils.models import check_options
from falsework.utils.quantity import listed

EFFORT = 60.0
"""Seconds for the whole question without a deadline, with so many for a verdict, whatever the load."""
_VERDICT = 3e-5
"""Seconds that a verdict takes for each part of the structure, where they are not measured."""
_FIRST_SHARE, _BELOW_SHARE = 0.1, 0.5
"""Shares of the time left for the first search for a plan with each number of robots and, once there is a plan, with
one robot fewer before refuting that."""
_SPAN = 4
"""Numbers of robots that are tried at first, one after the other; in each further round one more."""


@dataclass(frozen=True, eq=False, repr=False)
class MinRobots(Result[int]):
    """Answer to how many robots a task needs."""

    value: int | None
    """Fewest robots with which a plan was found; None if none was found with any number that was tried."""
    bound: int
    """Number of robots below which it is proven that no plan exists."""
    plan: Plan | None
    """Plan with so many robots."""
    reasons: tuple[str, ...]
    """Why no plan exists, or none was found, with 1, 2, ... robots, one sentence each."""
    impossible: str = ""
    """Why no number of robots suffices; empty if one may."""
    certain: bool = True
    """Whether that is proven; not where the start or the target was found to slide."""
    barrier: Barrier | None = None
    """Parts that `bound - 1` robots cannot place, where that is the proof."""
    verdicts: int = 0
    """Verdicts requested."""
    seconds: float = 0.0
    interrupted: bool = False
    """Whether the keyboard ended the search."""
    deadline_passed: bool = False
    """Whether the deadline, or without one the limit of verdicts, ended the search."""
    unreserved: str = ""

    @property
    def outcome(self) -> Outcome:
        """Whether a number was found, and if not, whether it is proved that none suffices."""
        if self.value is not None:
            return Outcome.FOUND
        return Outcome.PROVED_IMPOSSIBLE if self.impossible and self.certain else Outcome.NOT_FOUND

    @property
    def statistics(self) -> dict[str, Any]:
        """Work of the searches: `seconds` and `verdicts`."""
        return {"seconds": self.seconds, "verdicts": self.verdicts}

    @property
    def reason(self) -> str:
        """Why there is no number: of all, or of the last one that was tried."""
        return "" if self.value is not None else self.impossible or (self.reasons[-1] if self.reasons else "")

    @property
    def proven(self) -> bool:
        """Whether it is proven that fewer robots do not suffice, or that no number does."""
        return self.certain if self.impossible else self.value == self.bound

    def to_dict(self) -> dict[str, Any]:
        """Return the answer without the plan as a JSON object."""
        return {
            "robots": self.value,
            "least": self.bound,
            "proven": self.proven,
            "reasons": list(self.reasons),
            "impossible": self.impossible or None,
            "certain": self.certain,
            "barrier": None if self.barrier is None else self.barrier.to_dict(),
            "verdicts": self.verdicts,
            "seconds": round(self.seconds, 3),
            "interrupted": self.interrupted,
            "deadline_passed": self.deadline_passed,
        }


def min_robots(
    assembly: AnyStructure,
    *,
    oracle: StabilityOracle | None = None,
    stability: StabilitySettings = PLANS,
    settings: PlannerSettings = PlannerSettings(),
    deadline: float | None = None,
    progress: Progress | None = None,
    forces: bool = True,
    **rules: Unpack[TaskRules],
) -> MinRobots:
    """Find the fewest robots with which a structure can be disassembled, and why fewer do not suffice.

    Numbers of robots are tried upwards from the least that is not refuted. Once there is a plan, the remaining time is
    spent on the number below: an exhaustive search, and `HoldBound`.

    Args:
        assembly: the structure, or its name or path.
        oracle: decides stability; pass an existing one to reuse its cache.
        stability: criterion, reserve and robots, where no oracle is given. Where no plan keeps the reserve with any
            number of robots, half of the deadline is left to ask for plans without; `Plan.claim` has its reserve.
        settings: effort of the search for each plan.
        deadline: seconds for all searches together; without one they ask for so many verdicts as take about a minute.
        progress: called after every level of every search; notebooks show it if not given.
        forces: keep the contact forces that prove each state in the plan.
        rules: start, target, fixed, missing, removable_only_if_clear, support and props; see `TaskRules`.

    Returns:
        The best that was found by the deadline, or until the keyboard interrupted the search.

    Raises:
        InputError: a deadline of zero or less, or rules that the structure cannot keep.
    """
    check_options(min_robots, rules, TaskRules.__annotations__)
    clock, assembly = Deadline(deadline), as_assembly(assembly)
    progress = or_notebook(progress, "searching")
    first = oracle or StabilityOracle(assembly, stability)
    again = oracle is None and stability.reserve > 1.0
    share = Deadline(None if deadline is None else FIRST_SHARE * deadline) if again else clock
    effort = FIRST_SHARE * EFFORT if again else EFFORT
    answer = _Query(assembly, first, settings, share, effort, progress, forces, rules).answer()
    if answer.value is not None or not again or answer.interrupted or clock.passed:
        return answer
    weaker = StabilityOracle(assembly, replace(stability, reserve=1.0))
    found = _Query(assembly, weaker, settings, clock, effort, progress, forces, rules).answer()
    return replace(found, unreserved=answer.reason)


class _Query:
    """State of `min_robots`: results for each number of robots."""

    def __init__(
        self,
        assembly: Assembly,
        oracle: StabilityOracle,
        settings: PlannerSettings,
        clock: Deadline,
        effort: float,
        progress: Progress | None,
        forces: bool,
        rules: TaskRules,
    ) -> None:
        self._assembly, self._oracle, self._settings, self._clock = assembly, oracle, settings, clock
        self._effort, self._progress, self._forces, self._rules = effort, progress, forces, rules
        task = make_task(assembly, max(assembly.part_count, 1), **rules)
        self._task = task
        ends = np.stack([task.start, task.target])
        self._least = max(1, int(held_count(ends, task.boundary).max()))
        # With a robot for every part that may be held, one more changes nothing.
        self._most = max(int((~task.boundary).sum()), self._least)
        self._bound = HoldBound(assembly, task, oracle.settings, clock)
        self._planners: dict[int, Planner] = {}
        self._reasons = dict.fromkeys(range(1, self._least), "the start or the target has more parts held")
        self._barrier: Barrier | None = None
        self._plan: Plan | None = None
        self._certain = True

    def answer(self) -> MinRobots:
        impossible, interrupted, late = "", False, False
        try:
            with self._clock.interrupts():
                impossible = self._no_number()
                if not impossible:
                    self._search()
        except DeadlineExceeded:
            late = True
        except KeyboardInterrupt:
            interrupted = True
        robots = None if self._plan is None else self._plan.robots
        if robots is None and self._least > self._most:
            impossible = impossible or "a robot for every part does not suffice"
        last = max([self._least, *(n + 1 for n in self._planners)]) if robots is None else robots
        return MinRobots(
            value=robots,
            bound=self._least,
            plan=self._plan,
            reasons=tuple(self._reasons.get(n, "not tried") for n in range(1, last)),
            impossible=impossible,
            certain=self._certain,
            barrier=self._barrier,
            verdicts=self._asked,
            seconds=self._clock.seconds,
            interrupted=interrupted,
            deadline_passed=late,
        )

    @property
    def _asked(self) -> int:
        """Verdicts requested."""
        return self._bound.asked + sum(planner.asked for planner in self._planners.values())

    @property
    def _spent(self) -> float:
        """Seconds since the beginning: by the clock, or without a deadline by verdicts."""
        return self._clock.seconds if self._clock.limited else _VERDICT * self._assembly.part_count * self._asked

    @property
    def _left(self) -> float:
        """Seconds until the end."""
        return self._clock.left if self._clock.limited else self._effort - self._spent

    def _no_number(self) -> str:
        """Return why no number of robots suffices; empty if that is not known."""
        unstable, _ = judge_ends(self._task, self._oracle, self._settings.directions)
        if unstable is not None:
            self._certain = unstable.outcome is Outcome.PROVED_IMPOSSIBLE
            return unstable.notes[0]
        stuck = unremovable_parts(self._task)
        if not len(stuck):
            return ""
        names = listed([self._assembly.names[part] for part in stuck])
        return f"even with every part held, {names} cannot leave without a collision"

    def _search(self) -> None:
        """Increase the number of robots until there is a plan, then decrease it while plans or proofs are found."""
        # At first an equal share of the effort for each of the numbers that are tried.
        seconds, span = EFFORT / _SPAN, _SPAN
        while self._plan is None and not all(self._over(n) for n in range(self._least, self._most + 1)):
            for number in range(self._least, min(self._least + span, self._most + 1)):
                # If a number is not refuted, no larger one is.
                if number == self._least and self._refuted(number):
                    continue
                if self._plan is None and not self._over(number):
                    self._look(number, min(_FIRST_SHARE * self._left, seconds))
            seconds, span = 2 * seconds, span + 1
        while self._plan is not None and self._plan.robots > self._least:
            below = self._plan.robots - 1
            if not self._over(below):
                self._look(below, min(_BELOW_SHARE * self._left, seconds))
            if self._plan.robots <= below:
                continue
            if not self._refuted(below) and not self._over(below):
                self._look(below, np.inf)
            if self._plan.robots > below:
                return

    def _over(self, robots: int) -> bool:
        """Return whether a search with so many robots is at its end."""
        return robots in self._planners and self._planners[robots].done

    def _refuted(self, robots: int) -> bool:
        """Return whether it is proven that no plan exists with so many robots."""
        if robots < self._least:
            return True
        if self._task.prop_limit or self._task.together is not None:  # which the bound does not cover
            return False
        barrier = self._bound.barrier(robots)
        if barrier is None:
            return False
        self._refute(robots, barrier.text)
        self._barrier = barrier
        return True

    def _refute(self, robots: int, reason: str) -> None:
        for number in range(self._least, robots + 1):
            self._reasons[number] = f"no plan exists: {reason}"
        self._least = max(self._least, robots + 1)

    def _look(self, robots: int, seconds: float) -> None:
        """Search for a plan with so many robots for some time.

        Raises:
            DeadlineExceeded: there is no time left.
            KeyboardInterrupt: from the keyboard.
        """
        if robots not in self._planners:
            task = replace(self._task, robots=robots)
            guide = SupportGuide(self._assembly)
            self._planners[robots] = Planner(task, self._oracle, self._settings, guide=guide)
        planner, end, told = self._planners[robots], self._spent + seconds, False

        def stop() -> bool:
            nonlocal told
            told = self._spent > end or self._left <= 0
            return told

        result = planner.run(progress=self._progress, stop=stop)
        self._take(robots, result)
        if self._left <= 0:
            raise DeadlineExceeded
        if result.interrupted and not told:
            raise KeyboardInterrupt

    def _take(self, robots: int, result: SearchResult) -> None:
        """Record the result of a search."""
        planner = self._planners[robots]
        if result.found and result.interrupted and not planner.routes and self._left > 0:
            self._reasons[robots] = (
                "none found: the plan that was found was not shown to stand under each change of settings"
            )
        elif result.found:
            task, route = replace(self._task, robots=robots), result.routes[0]
            known = planner.tests.replays.get(route.states.tobytes())
            plan = prove_route(route, self._assembly, task, self._oracle, forces=self._forces, replay=known)
            if plan.replay is None or plan.replay.stands:
                self._plan = plan
                return
            self._reasons[robots] = "none found: the plan that was found falls in its replay"
        elif result.outcome is Outcome.PROVED_IMPOSSIBLE:
            self._refute(robots, "every state that can be reached was examined")
        else:
            backwards = result.direction is Direction.DISASSEMBLY
            self._reasons[robots] = f"none found: {progress_text(result.reached, result.steps, backwards=backwards)}"


def unremovable_parts(task: Task) -> NDArray[np.intp]:
    """Return the ids of the parts that cannot leave with any number of robots; none if that is not proven.

    A part that has an exit keeps it when others are removed, so removing every part that can leave is complete.
    """
    leaving = (task.start != REMOVED) & (task.target == REMOVED)
    if (
        task.clearance is None or task.together is not None or task.caveat or task.moves_out > 1
    ):  # where others move aside, the number of robots matters
        return np.flatnonzero(leaving & False)
    state = task.start.copy()
    while True:
        now = leaving & (state != REMOVED) & task.clearance.can_leave(state[None])[0]
        if not now.any():
            return np.flatnonzero(leaving & (state != REMOVED))
        state[now] = REMOVED

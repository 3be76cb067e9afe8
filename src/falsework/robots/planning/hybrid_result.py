"""Settings, progress and result of the hybrid planner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.robots.keyframes.failure_report import Explanation
from falsework.robots.keyframes.keyframe_graph import KeyframeSettings
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.problem.result import Outcome, Result
from falsework.search.problem.task import Direction
from falsework.utils.quantity import check_seed


@dataclass(frozen=True)
class HybridSettings:
    """Order and limits of the search for a robot plan."""

    direction: Direction = Direction.ASSEMBLY
    """Order in which the plan is executed, and in which its makespan is made short."""
    seed: int = 0
    """Same seed, same machine, same result, unless the deadline passes."""
    attempts: int = 40
    """Number of searches, each in another order."""
    dead_ends: int = 15
    """States at which the first search may go no further; then the next one begins, and may have more."""
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)

    def __post_init__(self) -> None:
        if self.direction not in set(Direction):
            raise InputError(f"direction is {self.direction!r}; it must be assembly or disassembly")
        object.__setattr__(self, "direction", Direction(self.direction))
        if min(self.attempts, self.dead_ends) < 1:
            raise InputError("a search needs at least one attempt and dead end; give numbers from 1 on")
        check_seed(self.seed)


@dataclass(frozen=True, eq=False, repr=False)
class HybridResult(Result[RobotPlan]):
    """Result of a search for a robot plan."""

    value: RobotPlan | None
    """Plan in the order of the settings, or None."""
    partial: RobotPlan | None
    """Without a plan: the longest partial plan whose replay succeeds, if it has any step. As searches begin at the
    complete structure, it has the first steps of a disassembly, or the last ones of an assembly."""
    explanation: Explanation | None
    """Explanation where there is no plan."""
    statistics: dict[str, Any]
    no_order: bool = False
    """Whether no order of the parts was found in which the structure stands, whatever the arms."""
    structure: Assembly | None = None
    """Structure that the plan is for, where arms carry groups of parts: each group is one part (`join_parts`)."""
    unreserved: str = ""

    @property
    def outcome(self) -> Outcome:
        """Whether there is a plan, and if not, whether that is proved; an interrupted search proves nothing."""
        if self.explanation is None:
            return Outcome.FOUND
        proved = self.explanation.outcome == Outcome.PROVED_IMPOSSIBLE
        return Outcome.PROVED_IMPOSSIBLE if proved else Outcome.NOT_FOUND

    @property
    def bound(self) -> float | None:
        """Makespan that no schedule of the motions can be below, seconds; None without a schedule."""
        return None if self.value is None or self.value.schedule is None else self.value.schedule.lower_bound

    @property
    def reason(self) -> str:
        """Why there is no plan, in one line."""
        return "" if self.explanation is None else self.explanation.text


@dataclass(frozen=True)
class HybridProgress:
    """Progress of a running search."""

    reached: int
    """Steps of the longest plan so far."""
    steps: int
    attempt: int
    dead_ends: int
    seconds: float

    @property
    def share(self) -> float:
        """How far the search is, from 0 to 1."""
        return self.reached / max(self.steps, 1)

    @property
    def words(self) -> str:
        """The progress on one line."""
        return f"step {self.reached} of {self.steps}, {self.dead_ends} dead ends"


Progress = Callable[[HybridProgress], None]

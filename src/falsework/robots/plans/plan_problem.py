"""Problems that checks of robot plans find."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlanProblem:
    """Problem found by a check."""

    step: int
    """Step of the plan, from 0."""
    robot: str
    what: str
    """Description of the problem."""
    pair: tuple[str, str] | None = None
    """Names of the colliding bodies, for a collision."""
    seconds: float | None = None
    """Nominal time from the start of its trajectory; from the start of the schedule for a problem of the schedule
    without delays."""
    configuration: tuple[float, ...] | None = None
    distance: float | None = None
    """Distance of bodies that some delay brings together, metres; 0 where they collide."""

    def __str__(self) -> str:
        when = "" if self.seconds is None else f" after {self.seconds:.2f} s"
        return f"step {self.step + 1}, {self.robot}{when}: {self.what}"

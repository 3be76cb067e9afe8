"""`falsework check`: does every step of a plan hold, by the exact solver?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, Command, Exit, LoadOptions

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class CheckPlan(Command):
    """Verify every step of a plan with the exact solver, up to the first that does not hold.

    The exact solver shares nothing with the one that made the plan. The structure is the one that the plan names; a
    plan for another structure is refused. Exit code 1 at the first bad step.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework check plan.json",
        "falsework check plan.json --structure my-folder --steps",
    )

    plan: Annotated[Positional[Path], arg(metavar="PLAN")]
    """Plan to check, as `falsework plan` wrote it."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure to check it on, instead of the one that the plan names."""
    reading: LoadOptions
    steps: bool = False
    """Print the steps in words as well."""

    def run(self, output: Output) -> Exit:
        """Load, compare, verify."""
        from falsework.cli.loading import structure_of
        from falsework.cli.motion import describe, motions
        from falsework.search.plan import Plan

        plan = Plan.load(self.plan)
        assembly = structure_of(plan, self.plan, self.structure, **self.reading.given())
        with output.bar("checking") as show:
            found = plan.validate(assembly, progress=lambda done, total: show(done, total, f"state {done} of {total}"))
        moving = []
        if found.verdict is not None and found.verdict.unstable[0] and found.verdict.velocity is not None:
            moving = motions(assembly, found.verdict.velocity[0])
        output.record(
            {
                "plan": str(self.plan),
                "good": found.good,
                "states": found.states,
                "checked": found.checked,
                "residual": found.residual,
                "bad_step": found.bad_step,
                "reason": found.reason,
                "moving": [motion.record(assembly) for motion in moving],
                "seconds": found.seconds,
            }
        )
        if self.steps:
            for step in range(len(plan)):
                output.say(f"{step + 1:4d}  {plan.describe(step)}")
        if found.good:
            output.say(
                f"{self.plan}: all {found.states} states are stable, "
                f"proven by the exact solver; residual at most {found.residual:.1e} of gravity"
            )
            return Exit.DONE
        output.note(
            f"falsework: {self.plan}: {found.reason}{'; ' if moving else ''}{describe(assembly, moving, limit=3)}"
        )
        return Exit.NO

"""`falsework robots`: arm motions for a plan, their independent verification, and export to controllers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

from tyro.conf import Positional, arg

from falsework.cli.arguments import spell_options
from falsework.cli.claim_options import ClaimOptions
from falsework.cli.command import UNSET, Command, LoadOptions
from falsework.cli.exit_code import Exit
from falsework.cli.output import exit_of_good
from falsework.cli.robot_reports import (
    check_record,
    check_texts,
    holds_record,
    holds_text,
    problem_record,
    runs_record,
    runs_text,
    scope_record,
    scope_text,
    unverified,
)
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.cli.output import Output


@dataclass(frozen=True, kw_only=True)
class CheckRobots(Command):
    """Verify all motions of a robot plan by independent libraries, and the stability of every state.

    Pinocchio computes the kinematics and Coal the collisions of the meshes of parts and links, every 0.01 rad; built-in
    arms have no meshes, so their convex pieces are checked. Limits of position, velocity and acceleration and the
    continuity of motions are checked too. A plan with a schedule is checked as a whole as well: every 0.01 s all that
    moves against all else; and for any delays the order of the states, and all positions of two arms that can coincide,
    between samples too. States are checked as by `falsework check`, those of joined parts also as loose ones: the
    options set the criterion, and a plan that claims less is refused. Forces and moments that robots bear for held
    parts are compared with the limits of their grippers. Options of the structure that the plan records, such as its
    friction, count only if they are given here too. Exit code 1 if anything is wrong; 3 if all is well, but only with
    such options of the plan.
    """

    rare: ClassVar[tuple[str, ...]] = ("resolution", "delays", "max_delay")

    examples: ClassVar[tuple[str, ...]] = (
        "falsework robots check robot_plan.json",
        "falsework robots check robot_plan.json --cell cell.toml --steps",
        "falsework robots check robot_plan.json --delays 1000 --json",
        "falsework robots check robot_plan.json --accept-overrides",
    )

    outcomes: ClassVar[tuple[str, str]] = ("verified", "refuted")

    plan: Annotated[Positional[Path], arg(metavar="ROBOT_PLAN")]
    """Plan to check, as `falsework robots plan` wrote it."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure to check it on, instead of the one that the plan names."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell to check it in, instead of the one that the plan names."""
    reading: LoadOptions
    accept_overrides: bool = False
    """Accept the options of the structure that the plan records, as if all were given."""
    claim: ClaimOptions
    resolution: float = 0.01
    """Largest joint step between two samples, rad."""
    delays: Annotated[int | None, arg(metavar="RUNS", help_behavior_hint=UNSET)] = None
    """Simulate the schedule this often with random delays too: order of the states, makespans, and whether
    every run keeps to the checked positions."""
    max_delay: Annotated[float, arg(metavar="SHARE")] = 1.0
    """Largest share by which a motion takes longer in these runs; each has its own."""
    motions_only: bool = False
    """Skip the stability of the states."""
    steps: bool = False
    """Print the steps as text too."""

    def run(self, output: Output) -> Exit:
        """Load, compare, verify."""
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.checks.check import check_robot_plan
        from falsework.robots.checks.check_plan import check_states
        from falsework.robots.plans.robot_forces import grip_loads, overloads
        from falsework.robots.plans.robot_plan import acts
        from falsework.robots.plans.robot_plan_file import load_robot_plan
        from falsework.robots.schedule.simulation import simulate
        from falsework.search.plans.plan_source import structure_to_check

        if self.delays is None and self.max_delay != 1.0:
            raise InputError("--max-delay is for delayed runs; give their number too, such as --delays 1000")
        if self.motions_only and self.claim != ClaimOptions():
            raise InputError("--motions-only checks no states; leave it out, or --criterion and what goes with it")
        plan = load_robot_plan(self.plan)
        assembly, overrides = structure_to_check(plan.plan, self.plan, self.structure, **self.reading.given())
        place = self.cell or plan.cell_place(self.plan)
        cell = load_cell(place)
        with output.bar("checking motions") as show:
            report = check_robot_plan(
                plan,
                assembly,
                cell,
                step=self.resolution,
                progress=lambda done, total: show(done, total, f"step {done}"),
            )
        # Only a plan whose motions are within limits, and so of bounded duration, is worth simulating.
        runs = None
        if self.delays is not None and report.good:
            runs = simulate(plan, runs=self.delays, most=self.max_delay)
        stable = (
            None if self.motions_only else check_states(plan, assembly, self.claim.settings(), self.claim.demands())
        )
        loads = [] if report.loads is None else list(report.loads)
        if report.loads is None and stable is not None and stable.good:
            loads = grip_loads(plan, assembly, cell)
        heavy = [] if report.loads is None else overloads(loads, plan, cell)
        holds = holds_record(loads, plan, cell)
        good = report.good and (stable is None or stable.good) and (runs is None or runs.good)
        open_claims = unverified(plan, report, states=stable is not None)
        output.record(
            {
                "checked": scope_record(plan, assembly, cell, place),
                "overrides": overrides,
                "unverified": open_claims,
                "stable": None if stable is None else stable.good,
                "claim": None if stable is None else stable.claim.to_dict(),
                **check_record(report),
                "holds": holds,
                "overloads": [problem_record(problem) for problem in heavy],
                "delayed_runs": None if runs is None else runs_record(runs, self.max_delay),
            }
        )
        if self.steps:
            for step in range(len(plan)):
                own = "" if plan.number(step) == step + 1 else f"; step {plan.number(step)} of the plan"
                output.say(f"{step + 1:4d}  {plan.describe(step)}{own * acts(plan.steps[step])}")
        for problem in report.problems:
            output.note(f"falsework: {problem}")
        if stable is not None and not stable.good:
            output.note(f"falsework: {self.plan}: {stable.reason}")
        if runs is not None and not runs.good:
            output.note(f"falsework: {self.plan}: {runs_text(runs, self.max_delay)}")
        if not good:
            return Exit.NO
        output.say(scope_text(plan, assembly, cell, place))
        if overrides:
            output.say(f"options of the structure that the plan sets: {spell_options(overrides)}")
        for text in check_texts(str(self.plan), report, stable):
            output.say(text)
        if runs is not None:
            output.say(runs_text(runs, self.max_delay))
        for record in holds:
            output.say(holds_text(record))
        for claim in open_claims:
            output.say(f"not verified: {claim}")
        return exit_of_good(self.plan, overrides, output, accepted=self.accept_overrides)

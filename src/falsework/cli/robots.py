"""`falsework robots`: arm motions for a plan, their independent verification, and export to controllers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import Positional, arg

from falsework.cli.arguments import parse_parts, parse_state
from falsework.cli.command import UNSET, Command, LoadOptions, StructureOptions
from falsework.cli.exit_code import Exit
from falsework.cli.output import counted
from falsework.cli.overrides import exit_of_good, say_overrides
from falsework.cli.planning import HoldOptions, lacks_reserve, press_text, refuse_unstable, writable
from falsework.cli.robot_arguments import parse_grips, parse_holding, parse_joints, parse_now
from falsework.cli.robot_reports import (
    can_schedule,
    check_record,
    check_texts,
    found_texts,
    holds_record,
    holds_text,
    overloads_of,
    runs_record,
    runs_text,
    scope_record,
    scope_text,
    times_record,
    unverified,
)
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.cli.output import Output
    from falsework.robots.model.cell import Cell
    from falsework.robots.planning.hybrid_result import HybridResult
    from falsework.robots.plans.robot_plan import RobotPlan
    from falsework.search.problem.guide import Guide
    from falsework.search.problem.task import Task


@dataclass(frozen=True, kw_only=True)
class PlanRobots(Command):
    """Plan arm motions that disassemble a structure and, in reverse, assemble it.

    Actions and motions are planned together: every state is stable, a replay in assembly order succeeds in which
    robots bear and press no more than their grippers allow, every motion is collision-free. Then motions of different
    robots are scheduled to take place at the same time wherever that is proven safe, whatever the delays. Exit code 1
    if no plan was found, or none that keeps the reserve and the limits of grippers; the report lists parts out of
    reach, obstacles, and the progress of the search. A partial plan is saved, except where an assembly is continued.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework robots plan my-folder --cell cell.toml --out robot_plan.json",
        "falsework robots plan my-folder --cell cell.toml --policy my-run --seed 3 --deadline 60",
        "falsework robots plan my-folder --cell cell.toml --state 2210 --joints now.json --holding left=3 --support",
        "falsework robots plan my-folder --cell cell.toml --direction assembly --state 2110 --joints now.json "
        "--holding left=2,right=3 --grips robot_plan.json --out rest.json",
    )

    structure: StructureOptions
    cell: Annotated[str, arg(metavar="CELL")]
    """Cell file, or the name of a built-in cell such as dome-37."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("robot_plan.json")
    """File to write."""
    policy: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint=UNSET)] = None
    """Trained run whose policy proposes the actions."""
    seed: int = 0
    """Random seed; results are reproducible on one machine."""
    deadline: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=UNSET)] = None
    """Time limit."""
    direction: Literal["disassembly", "assembly"] = "disassembly"
    """`assembly` goes on building from where the robots are: --state, --joints, --holding and --grips describe its
    start, and the motions are written in the order of assembly. Otherwise they describe the start of disassembly."""
    start: Annotated[
        str | None, arg(metavar="STATE", help_behavior_hint="(default: complete or empty)", aliases=["--state"])
    ] = None
    """State to start from: `complete`, `empty`, digits such as 2110, or a file."""
    joints: Annotated[str | None, arg(metavar="JOINTS", help_behavior_hint="(default: all at home)")] = None
    """Joint values of the robots in rad at the start, such as left=0,0.1,-0.5,0,1,0;right=home, or a JSON file with
    such lists by robot."""
    holding: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts that robots hold at the start, such as left=3,right=keystone; a part that is not in place is carried."""
    grips: Annotated[str | None, arg(metavar="GRIPS", help_behavior_hint=UNSET)] = None
    """For carried parts the joint values with which their robots would hold them at their places, as with --joints, or
    the file of the robot plan that was under way."""
    target: Annotated[str | None, arg(metavar="STATE", help_behavior_hint="(default: empty or complete)")] = None
    """State to end in: `empty`, `complete`, digits, or a file."""
    missing: Annotated[str | None, arg(metavar="PARTS", help_behavior_hint=UNSET)] = None
    """Parts not delivered yet, such as 3,4; assembly does without them as long as possible."""
    support: bool = False
    """Let arms release parts that stand without them and hold them again with another grasp, hand other parts to
    another arm, and put parts down on the way to grip them in another way, where there is no other way."""
    assembly_order: bool = False
    """Write the motions in the order of assembly."""
    sequential: bool = False
    """One robot moves at a time; without this, robots move together wherever that is proven safe."""
    proofs: bool = False
    """Write the contact forces that prove each state into the plan."""
    holds: HoldOptions
    criterion: Literal["contact", "equilibrium"] = "contact"
    """Stability criterion: compliant contacts without prestress bring every part to rest, in every state and in a
    replay of the whole plan; or (paper) contact forces in balance exist."""

    def run(self, output: Output) -> Exit:
        """Search, save, report."""
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.model.cell_holds import CellScale
        from falsework.robots.planning.end_motions import Continuation
        from falsework.robots.planning.hybrid_planner import plan_robots
        from falsework.robots.planning.hybrid_result import HybridSettings
        from falsework.robots.planning.plan_together import plan_together
        from falsework.stability import Stability

        writable(self.out)
        cell = load_cell(self.cell)
        together = not self.sequential and cell.robot_count > 1 and can_schedule(output)
        settings = HybridSettings(seed=self.seed, deadline=self.deadline, forces=self.proofs)
        assembly = self.structure.load()
        building = self.direction == "assembly"
        held = parse_holding(self.holding, cell, assembly)
        joints, task = parse_joints(self.joints, cell), self._task(assembly, cell, held)
        grips = parse_grips(self.grips, held, task.target if building else task.start, cell, assembly)
        stability = self.holds.settings(self.criterion)
        if refuse_unstable(
            assembly, Stability(assembly, replace(stability, reserve=1.0)), task, output, building=building
        ):
            output.record({"robot_plan": None, "found": False})
            return Exit.NO
        guide = self._guide(assembly, task)
        given: dict[str, Any] = {"task": task, "stability": stability, "guide": guide, "settings": settings}
        now: dict[str, Any] = {"configurations": joints, "held": held, "gripped": grips}
        given |= {"continued": Continuation(**now)} if building else now
        assembly_order = self.assembly_order or building
        with output.bar("planning motions") as show:
            given["progress"] = lambda now: show(now.reached, now.steps, f"step {now.reached} of {now.steps}")
            if together:
                result = plan_together(assembly, cell, assembly_order=assembly_order, **given)
            else:
                result = plan_robots(assembly, cell, **given)
        found = result.partial if result.plan is None else result.plan  # a plan without steps is false
        if found is not None and assembly_order and not together:
            found = found.reverse()
        done = self._report(result, found, output)
        if done is not Exit.DONE or found is None:
            return done
        if text := press_text(found.plan, CellScale.of(assembly, cell).force):
            output.say(text)
        lost, heavy = lacks_reserve(found.plan, stability.reserve), overloads_of(found, assembly, cell)
        if heavy:
            output.record({"overloads": [asdict(problem) for problem in heavy]})
        for text in (*([lost] if lost else []), *heavy):
            output.note(f"falsework: {text}")
        return Exit.NO if lost or heavy else Exit.DONE

    def _task(self, assembly: Assembly, cell: Cell, held: Sequence[int | None]) -> Task:
        from falsework.search.problem.task import Task

        building = self.direction == "assembly"
        now = parse_now(self.start or ("empty" if building else "complete"), held, assembly)
        end = None if self.target is None else parse_state(self.target, "--target", assembly)
        start, target = (end, now) if building else (now, end)  # plans are found as disassembly
        return Task.create(
            assembly.boundary,
            cell.robot_count,
            start=start,
            target=target,
            missing=() if self.missing is None else parse_parts(self.missing, "--missing", assembly.names),
            clearance=assembly.clearance,
            identity=assembly.identity,
            support=self.support,
        )

    def _guide(self, assembly: Assembly, task: Task) -> Guide | None:
        if self.policy is None:
            return None
        from falsework.learn import load_run  # says what to install where torch is missing
        from falsework.replanning.policy_guide import PolicyGuide

        return PolicyGuide(load_run(self.policy, assembly=assembly).policy, task=task)

    def _report(self, result: HybridResult, found: RobotPlan | None, output: Output) -> Exit:
        if found is not None:
            saved = self._save(found)
            output.record(
                {
                    "robot_plan": str(self.out),
                    "found": result.found,
                    "steps": len(saved),
                    "motion_seconds": round(saved.seconds, 3),
                    **result.statistics,
                    **times_record(saved),
                }
            )
            if result.found:
                for text in found_texts(saved, str(self.out), result.statistics):
                    output.say(text)
                return Exit.DONE
            output.note(f"{self.out} has the first {counted(len(saved), 'step')}")
        else:
            why = result.explanation.to_dict() if result.explanation else {}
            output.record({"robot_plan": None, "found": False, "failure": why, **result.statistics})
        if result.explanation is not None:
            output.note(f"falsework: {result.explanation.text}")
        return Exit.NO

    def _save(self, plan: RobotPlan) -> RobotPlan:
        from falsework.robots.plans.robot_plan_file import save_robot_plan

        cell_source = self.cell
        if Path(self.cell).is_file():
            cell_source = Path(os.path.relpath(Path(self.cell).resolve(), self.out.resolve().parent)).as_posix()
        abstract = replace(plan.plan, source=self.structure.source(self.out))
        plan = replace(plan, plan=abstract, cell_source=cell_source)
        save_robot_plan(plan, self.out)
        return plan


@dataclass(frozen=True, kw_only=True)
class CheckRobots(Command):
    """Verify all motions of a robot plan by independent libraries, and the stability of every state.

    Pinocchio computes the kinematics and Coal the collisions of the meshes of parts and links, every 0.01 rad; built-in
    arms have no meshes, so their convex pieces are checked. Limits of position, velocity and acceleration and the
    continuity of motions are checked too. A plan with a schedule is checked as a whole as well: every 0.01 s all that
    moves against all else; and for any delays the order of the states, and all positions of two arms that can coincide,
    between samples too. The exact solver checks the stability of the states. Forces and moments that robots bear for
    held parts are compared with the limits of their grippers. Options of the structure that the plan records, such as
    its friction, count only if they are given here too. Exit code 1 if anything is wrong; 3 if all is well, but only
    with such options of the plan.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "falsework robots check robot_plan.json",
        "falsework robots check robot_plan.json --cell cell.toml --steps",
        "falsework robots check robot_plan.json --delays 1000 --json",
        "falsework robots check robot_plan.json --accept-overrides",
    )

    plan: Annotated[Positional[Path], arg(metavar="ROBOT_PLAN")]
    """Plan to check, as `falsework robots plan` wrote it."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure to check it on, instead of the one that the plan names."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell to check it in, instead of the one that the plan names."""
    reading: LoadOptions
    accept_overrides: bool = False
    """Accept the options of the structure that the plan records, as if all were given."""
    resolution: float = 0.01
    """Largest joint step between two samples, rad."""
    delays: Annotated[int | None, arg(metavar="RUNS", help_behavior_hint=UNSET)] = None
    """Simulate the schedule this often with random delays too: deadlocks, order of the states, makespans, and whether
    every run keeps to the checked positions."""
    longest_delay: Annotated[float, arg(metavar="SHARE")] = 1.0
    """Largest share by which a motion takes longer in these runs; each has its own."""
    motions_only: bool = False
    """Skip the stability of the states."""
    steps: bool = False
    """Print the steps as text too."""

    def run(self, output: Output) -> Exit:
        """Load, compare, verify."""
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.checks.check import check_robot_plan
        from falsework.robots.plans.grip_loads import grip_loads, overloads
        from falsework.robots.plans.robot_plan_file import load_robot_plan
        from falsework.robots.schedule.simulation import simulate
        from falsework.search.plans.plan_check import validate_plan
        from falsework.search.plans.plan_source import structure_to_check

        if self.delays is None and self.longest_delay != 1.0:
            raise InputError("--longest-delay is for delayed runs; give their number too, such as --delays 1000")
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
            runs = simulate(plan, runs=self.delays, most=self.longest_delay)
        stable = None if self.motions_only else validate_plan(plan.plan, assembly)
        loads = [] if report.loads is None else list(report.loads)
        if report.loads is None and stable is not None and stable.good:
            loads = grip_loads(plan, assembly, cell)
        heavy = [] if report.loads is None else overloads(loads, plan, cell)
        holds = holds_record(loads, plan, cell)
        good = report.good and (stable is None or stable.good) and (runs is None or runs.good)
        open_claims = unverified(plan, report, states=stable is not None)
        output.record(
            {
                "robot_plan": str(self.plan),
                "good": good,
                "checked": scope_record(plan, assembly, cell, place),
                "overrides": overrides,
                "unverified": open_claims,
                "stable": None if stable is None else stable.good,
                **check_record(report),
                "holds": holds,
                "overloads": [asdict(problem) for problem in heavy],
                "delayed_runs": None if runs is None else runs_record(runs, self.longest_delay),
            }
        )
        if self.steps:
            for step in range(len(plan)):
                output.say(f"{step + 1:4d}  {plan.describe(step)}")
        for problem in report.problems:
            output.note(f"falsework: {problem}")
        if stable is not None and not stable.good:
            output.note(f"falsework: {self.plan}: {stable.reason}")
        if runs is not None and not runs.good:
            output.note(f"falsework: {self.plan}: {runs_text(runs, self.longest_delay)}")
        if not good:
            return Exit.NO
        output.say(scope_text(plan, assembly, cell, place))
        say_overrides(overrides, output)
        for text in check_texts(str(self.plan), report, None if stable is None else stable.states):
            output.say(text)
        if runs is not None:
            output.say(runs_text(runs, self.longest_delay))
        for record in holds:
            output.say(holds_text(record))
        for claim in open_claims:
            output.say(f"not verified: {claim}")
        return exit_of_good(self.plan, overrides, output, accepted=self.accept_overrides)
